"""The tables of seeing.py, of lines that were measured."""

from __future__ import annotations

import matplotlib
import numpy as np

matplotlib.use("Agg")

from seeing_figures import ASKED


def markdown(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(
        "| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), *rows]
    )


def name_of(line: dict) -> str:
    return f"`{' '.join(line['overrides'])}`" if line["overrides"] else "defaults"


def verdict(met: bool) -> str:
    return "met" if met else "missed"


def image_row(line: dict) -> dict[str, str]:
    held = line["held_out"]
    training = held["training_cameras"]
    pair = "{psnr_full:.2f} / {psnr_crop:.2f}".format_map
    return {
        "width [px]": str(line["width_px"]),
        "particles": str(line["particles"]),
        "static, frame 0: psnr_full / psnr_crop": pair(held["static"]),
        "particles, frame 0: psnr_full / psnr_crop": pair(held["particles_frame_0"]),
        "all frames: psnr_full / psnr_crop": pair(held["dynamic"]),
        "ssim_crop": f"{held['dynamic']['ssim_crop']:.4f}",
        "training cameras: psnr_crop, ssim_crop": f"{training['psnr_crop']:.2f}, {training['ssim_crop']:.4f}",
        "flow - optical flow [px]": f"{line['flow']['median_px']:.2f} / {line['flow']['p90_px']:.2f}",
    }


def silhouette_row(line: dict) -> dict[str, str]:
    held = line["held_out"]
    mean = float(np.mean(held["iou"]))
    below = [str(t) for t, value in enumerate(held["iou"]) if value < ASKED["iou"]]
    return {
        f"IoU, mean; asked {ASKED['iou']:g}": f"{mean:.4f}, {verdict(mean >= ASKED['iou'])}",
        "smallest": f"{min(held['iou']):.4f}",
        "frames below": ", ".join(below) or "none",
        "training cameras, mean": f"{held['training_cameras']['iou']:.4f}",
        "area, rendered / matte": f"{held['area_ratio']:.3f}",
        "bare balls: IoU, area": f"{np.mean(held['iou_balls']):.4f}, {held['area_ratio_balls']:.3f}",
    }


def volume_row(line: dict) -> dict[str, str]:
    volume = {name: 1e3 * value for name, value in line["volume"].items()}
    below = 1 - volume["particles"] / volume["published_hull"]
    return {
        "particles [l]": f"{volume['particles']:.2f}",
        "published hull [l]": f"{volume['published_hull']:.2f}",
        f"below it; asked 0 to {ASKED['volume']:.0%}": f"{below:.1%}, {verdict(0 <= below <= ASKED['volume'])}",
        "own hull before shaving, 10 / 11 cameras [l]": f"{volume['hull_training_cameras']:.2f} / {volume['hull_all_cameras']:.2f}",
    }


def flight_row(line: dict) -> dict[str, str]:
    flight = line["flight"]
    off = flight["gravity_m_s2"] / flight["true_gravity_m_s2"] - 1
    wrong = float(
        np.linalg.norm(np.subtract(flight["velocity_m_s"], flight["published_velocity_m_s"]))
    )
    right = verdict(abs(off) <= ASKED["gravity"])
    return {
        "free frames": f"0 to {flight['free_frames'] - 1}",
        f"g [m/s^2]; asked {ASKED['gravity']:.0%}": f"{flight['gravity_m_s2']:.3f} ({off:+.2%}), {right}",
        "v0 [m/s]": vector(flight["velocity_m_s"]),
        f"its error [m/s]; asked {ASKED['velocity_m_s']:g}": f"{wrong:.4f}, {verdict(wrong <= ASKED['velocity_m_s'])}",
        "v0, g given [m/s]": vector(flight["velocity_given_gravity_m_s"]),
        "v0 that learning starts from [m/s]": vector(flight["start_velocity_m_s"]),
        "RMS of the fit [mm]": f"{1e3 * flight['fit_rms_m']:.2f}",
    }


def tables(lines: list[dict]) -> str:
    """Markdown: images, silhouettes, volume, flight, and the frames of each line."""
    blocks = []
    for cells in (image_row, silhouette_row, volume_row, flight_row):
        rows = [{"line": name_of(line)} | cells(line) for line in lines]
        blocks.append(markdown(list(rows[0]), [list(row.values()) for row in rows]))
    frames = []
    for line in lines:
        held = line["held_out"]
        for key, pattern in (("psnr_crop", "{:.2f}"), ("ssim_crop", "{:.4f}")):
            frames.append(
                [name_of(line), key, *(pattern.format(f[key]) for f in held["per_frame"])]
            )
        frames.append([name_of(line), "IoU", *(f"{x:.4f}" for x in held["iou"])])
    blocks.append(shadow_table(lines))
    return "\n\n".join(
        [*blocks, markdown(["line", "frame", *map(str, range(len(frames[0]) - 2))], frames)]
    )


def shadow_table(lines: list[dict]) -> str:
    """The frame with the most dark pixels in its mattes: dark share / IoU of every camera."""
    rows = []
    for line in lines:
        dark, iou = np.array(line["shadow"]["dark"]), np.array(line["shadow"]["iou"])
        t = int(dark.mean(0).argmax())
        before = dark[:, : line["flight"]["free_frames"]].max()
        rows.append(
            [
                name_of(line),
                str(t),
                f"{before:.1%}",
                *(f"{d:.1%} / {i:.3f}" for d, i in zip(dark[:, t], iou[:, t])),
            ]
        )
    return markdown(
        [
            "line",
            "frame",
            "most in free flight",
            *(f"camera {c}" for c in lines[0]["shadow"]["cameras"]),
        ],
        rows,
    )


def vector(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in values) + ")"


# --- pictures ---------------------------------------------------------------------------------------------------------
