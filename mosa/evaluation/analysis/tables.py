"""Tables a person reads at the end of a run."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from mosa.evaluation.metrics import IMAGE_METRICS, MOTION_METRICS
from mosa.modules.body.material import unit_of

ROWS = {
    "floor": "the true law on the learner's grid and particles",
    "prior": "the calibrated isotropic law",
    "prior + eta": "the prior with a stiffness that varies over the body",
    "adapted": "the learned law",
}
MODELS = (("floor", "floor/"), ("prior", "prior/"), ("prior + eta", "prior_eta/"), ("adapted", ""))
UNITS = {
    "rms_m": ("rms [mm]", 1e3, 2),
    "cd_m": ("CD [mm]", 1e3, 2),
    "emd_m": ("EMD [mm]", 1e3, 1),
    "psnr_crop": ("PSNR crop", 1, 2),
    "ssim_crop": ("SSIM crop", 1, 4),
}
TRACKED = "*rms*: root mean square distance of tracked points from their measured places after the release"
METRICS = ("rms_m", "cd_m", "psnr_crop", "ssim_crop")
FIGURES = {
    "rms_m": "*rms*: root mean square distance of particles from their true places after contact",
    "cd_m": "*CD*: mean distance to the nearest true particle, plus that in the other direction",
    "psnr_crop": "*PSNR*, *SSIM*: likeness of pictures in a window around the body, more is better",
}


def results_table(figures: Mapping[str, float]) -> str:
    """Markdown table of floor, prior, prior + eta and adapted on each training and each held-out sequence, of `METRICS` and those
    that were registered."""
    sequences = _sequences(figures)
    rows = []
    units = UNITS | {name: own[1:] for name, own in MOTION_METRICS.items()}
    units |= {f"{name}_crop": own[1:] for name, own in IMAGE_METRICS.items()}
    for metric in (*METRICS, *(name for name in units if name not in UNITS)):
        label, scale, digits = units[metric]
        for name, prefix in MODELS:
            values = [figures.get(f"{prefix}{s}/{metric}") for s in sequences]
            if any(v is not None for v in values):
                shown = ("" if v is None else f"{v * scale:.{digits}f}" for v in values)
                rows.append([label, name, *shown])
    return markdown(["figure", "model", *sequences], rows)


def columns_text(figures: Mapping[str, float], recording: str, tracked: bool = False) -> str:
    """What rows, columns and figures of `results_table` are; empty where nothing of the training sequence was measured.
    recording: name of the scene that is learned from first, which no column has; tracked: it is of points in place of films."""
    columns = _sequences(figures)
    if "train" not in columns:
        return ""
    parts = [f"`train` is the recording {recording}"]
    others = {
        "frames": "`frames` its last frames, held out",
        "camera": "`camera` its held-out cameras",
        "train/": "`train/...` the others that were learned from",
        "test/": "`test/...` those held out, `test` their mean",
    }
    parts += [about for start, about in others.items() if any(c.startswith(start) for c in columns)]
    prefixes = dict(MODELS)
    rows = [f"*{name}*: {about}" for name, about in ROWS.items()
            if any(f"{prefixes[name]}{column}/{metric}" in figures for column in columns for metric in UNITS)]  # fmt: skip
    said = [
        about
        for metric, about in (FIGURES | {"rms_m": TRACKED} if tracked else FIGURES).items()
        if any(key.endswith(f"/{metric}") for key in figures)
    ]
    return f"Rows: {'; '.join(rows)}. Columns: {', '.join(parts)}. Figures: {'; '.join(said)}."


def _sequences(figures: Mapping[str, float]) -> list[str]:
    names = {key.rsplit("/", 1)[0] for key in figures if key.endswith(("/psnr_crop", "/rms_m"))}
    others = [n for start in ("train/", "test") for n in sorted(names) if n.startswith(start)]
    return [n for n in ("train", "frames", "camera") if n in names] + others


def parameter_table(figures: Mapping[str, float], law: str, fixed: Collection[str] = ()) -> str:
    """Markdown table of identified parameters: of the prior and of the learned law, with columns of their relative errors where a
    truth is known. law: of the prior, which says what they are measured in; fixed: those that were not learned, no rows."""
    found = (k.split("/", 1)[1] for k in figures if k.startswith("id_prior/") and k.count("/") == 1)
    names = [n for n in found if n not in fixed and not n.endswith(("_relative_error", "_ratio"))]
    stages = ("id_prior", "id")
    rows = [[with_unit(law, n), *(f"{figures.get(f'{stage}/{n}', float('nan')):.5g}" for stage in stages),
             *(f"{figures[key]:.1%}" if (key := f"{stage}/{n}_relative_error") in figures else "" for stage in stages)]
            for n in names]  # fmt: skip
    header = ["parameter", "prior", "adapted", "error of prior", "error of adapted"]
    shown = len(header) if any(any(row[3:]) for row in rows) else 3
    return markdown(header[:shown], [row[:shown] for row in rows]) if rows else ""


def with_unit(law: str, name: str) -> str:
    """A parameter as a row names it: `E [Pa]`, and bare where it has no unit."""
    unit = unit_of(law, name)
    return f"{name} [{unit}]" if unit else name


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A padded markdown table."""
    widths = [max(len(str(r[i])) for r in [header, *rows]) for i in range(len(header))]

    def line(cells) -> str:
        return "| " + " | ".join(str(c).ljust(w) for c, w in zip(cells, widths)) + " |"

    ruler = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([line(header), ruler, *map(line, rows)])
