"""Tables a person reads at the end of a run."""

from __future__ import annotations

from collections.abc import Mapping

MODELS = (("floor", "floor/"), ("prior", "prior/"), ("prior + eta", "prior_eta/"), ("adapted", ""))
UNITS = {"rms_m": ("rms [mm]", 1e3, 2),
         "cd_m": ("CD [mm]", 1e3, 2), "emd_m": ("EMD [mm]", 1e3, 1), "psnr_crop": ("PSNR crop", 1, 2),
         "ssim_crop": ("SSIM crop", 1, 4)}


def results_table(figures: Mapping[str, float], metrics=("rms_m", "cd_m", "psnr_crop", "ssim_crop")) -> str:
    """Markdown table of floor, prior, prior + eta and adapted on each training and each held-out sequence."""
    sequences = [s for s in _sequences(figures)]
    rows = []
    for metric in metrics:
        label, scale, digits = UNITS[metric]
        for name, prefix in MODELS:
            values = [figures.get(f"{prefix}{s}/{metric}") for s in sequences]
            if any(v is not None for v in values):
                rows.append([label, name, *("" if v is None else f"{v * scale:.{digits}f}" for v in values)])
    return markdown(["figure", "model", *sequences], rows)


def _sequences(figures: Mapping[str, float]) -> list[str]:
    names = {key.rsplit("/", 1)[0] for key in figures if key.endswith("/psnr_crop")}
    plain = {n for n in names if n.split("/")[0] in ("train", "frames", "camera") and n.count("/") == 0}
    others = [sorted(n for n in names if n.startswith(start)) for start in ("train/", "test")]
    return sorted(plain, key=("train", "frames", "camera").index) + others[0] + others[1]


def parameter_table(figures: Mapping[str, float]) -> str:
    """Markdown table of identified parameters: after calibration, after the joint stage, relative error where truth is known."""
    names = [k.split("/", 1)[1] for k in figures if k.startswith("id_prior/") and not k.endswith(("_relative_error", "_ratio"))]
    rows = [[n, f"{figures[f'id_prior/{n}']:.5g}", f"{figures.get(f'id/{n}', float('nan')):.5g}",
             f"{figures[f'id_prior/{n}_relative_error']:.1%}" if f"id_prior/{n}_relative_error" in figures else ""] for n in names]
    return markdown(["parameter", "prior", "joint", "error of prior"], rows)


def geometry_lines(figures: Mapping[str, float]) -> str:
    """Sentences on the body that was filled: how surely its surface is known, and against the true shape where that is known."""
    lines, get = [], lambda name: figures.get(f"geometry/{name}")
    if get("uncertain_share") is not None:
        lines.append(
            f"Geometry: {get('carved_share'):.1%} of the visual hull is air. {get('uncertain_share'):.1%} of the surface is not "
            "told by the images to 0.7 particle spacings and is guessed between outlines; "
            f"{get('free_frames'):.0f} free frames were used.")
    elif get("carved_share") is not None:
        lines.append(f"Geometry: the visual hull, {get('carved_share'):.1%} of it rounded away; no colours were asked.")
    true = {name.rsplit("/", 1)[1]: value for name, value in figures.items() if name.startswith("floor/geometry/")}
    if true:
        lines.append(
            f"Against the true shape: {true['outside_share']:.2%} of the particles outside, {true['missing_share']:.2%} of the "
            f"body missing, volume {true['volume_error']:+.2%}, centre of mass {true['center_error_m'] * 1e3:.2f} mm off.")
    return "\n".join(lines)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A padded markdown table."""
    widths = [max(len(str(r[i])) for r in [header, *rows]) for i in range(len(header))]
    def line(cells) -> str:
        return "| " + " | ".join(str(c).ljust(w) for c, w in zip(cells, widths)) + " |"
    return "\n".join([line(header), "|" + "|".join("-" * (w + 2) for w in widths) + "|", *(line(r) for r in rows)])
