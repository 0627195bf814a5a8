"""The page of a capture: what was found, how sure it is, and pictures to check it by eye."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from mosa.capture.fall import Fall
from mosa.capture.phones import Phone
from mosa.capture.resampling import Exposure
from mosa.capture.world import World
from mosa.system.whole_files import write_whole

TILE, COLUMNS, SPARE = 1.8, 8, 10  # inches of a picture, pictures in a row, pixels around it


def write_report(
    folder: Path, found: dict[str, Any], phones: list[Phone], fall: Fall, exposures: list[Exposure], world: World,
    times: np.ndarray,
) -> None:  # fmt: skip
    """capture.md, contact.png and fall.png into the folder."""
    draw_contact_sheet(folder, [phone.name for phone in phones], len(times))
    draw_fall(folder / "fall.png", phones, fall, exposures, world)
    write_whole(folder / "capture.md", page(found))


def page(found: dict[str, Any]) -> str:
    """What was found, in Markdown."""
    fall, said, ground = found["fall"], found["warnings"], found["ground"]
    sure = lambda value, unit="": "given" if value is None else f"{value:.2g}{unit}"  # noqa: E731
    unusual = "\n".join(["**To be looked at first:**", "", *(f"- {line}" for line in said)])
    tilt = ground["tilt_degrees"]
    tilted = "" if tilt is None else f"| tilt of the floor's points [degrees] | {tilt:.2f} | |\n"
    first, up = found["phones"][0]["name"], ", ".join(f"{x:.4f}" for x in found["up"])
    rows = "\n".join(
        f"| {p['name']} | {p['fps']:.5g} | {p['seen']} of {p['frames']} frames | "
        f"{1e3 * p['offset']:.2f} +- {1e3 * p['offset_sd']:.2f} | {1e3 * p['readout']:.1f} +- "
        f"{1e3 * p['readout_sd']:.1f} ({p['scan']}) | {p['shift'][0]:.1f}, {p['shift'][1]:.1f} | "
        f"{', '.join(f'{g:.2f}' for g in p['gain'] or ())} |"
        for p in found["phones"]
    )
    return f"""# A capture by {len(found["phones"])} phones

{unusual if said else "Nothing unusual was found."}

Learn from it:

    {found["command"]}

## What the fall says

| | found | one standard deviation |
|---|---|---|
| metres per unit of the poses | {found["scale"]:.6g} | {sure(found["scale_sd"])} |
| up in the poses' world | {up} | {sure(found["up_sd_degrees"], " degrees")} |
| ground [m], from {ground["from"]} | 0, by definition | {sure(ground["sd"])} |
{tilted}| radius of the object [m] | {found["radius"]:.3g} | |
| free fall [s, clock of {first}] | {fall["window"][0]:.3f} to {fall["window"][1]:.3f} | |
| acceleration in it [m/s^2] | {fall["acceleration"]:.4g} | |
| centres used, and their noise [px] | {fall["centres"]} | {fall["noise_px"]:.2f} |
| frames written, of them free | {found["frames"]}, {found["free_frames"]} | at {found["rate"]:.5g} per second |

A modulus of elasticity is known to twice the relative error of the scale, beside all else.

## Phones

| phone | frames/s | whole object in | clock [ms] | readout [ms] | appears off by [px] | colour factors |
|---|---|---|---|---|---|---|
{rows}

Clock: what is added to a phone's own time to have that of {first}. Readout: time from the sensor's
first row to its last, and where the next row lies in the picture.

![frames and outlines of the mattes](contact.png)

![height of the object's centre, and what is left](fall.png)
"""


def draw_contact_sheet(folder: Path, names: list[str], frames: int) -> None:
    """contact.png: a row of pictures per phone, at the same moments, around the object, with the matte's outline."""
    chosen = np.unique(np.linspace(0, frames - 1, COLUMNS).round().astype(int))
    size = TILE * len(chosen), TILE * len(names)
    figure, rows = plt.subplots(len(names), len(chosen), figsize=size, squeeze=False)
    for name, row in zip(names, rows):
        pictures = [plt.imread(folder / "images" / f"{name}_{k:03d}.png") for k in chosen]
        covered = np.max([p[..., 3] for p in pictures], 0) > 0.5
        y, x = (np.flatnonzero(covered.any(axis)) for axis in (1, 0))
        down, across = (slice(max(0, at[0] - SPARE), at[-1] + SPARE) for at in (y, x))
        for axis, picture, k in zip(row, pictures, chosen):
            part = picture[down, across]
            axis.imshow(part)
            axis.contour(part[..., 3], [0.5], colors="red", linewidths=0.7)
            axis.set_title(f"{name} {k}", fontsize=8)
            axis.set_axis_off()
    figure.tight_layout(pad=0.3)
    figure.savefig(folder / "contact.png", dpi=100, facecolor="0.8")
    plt.close(figure)


def draw_fall(
    file: Path, phones: list[Phone], fall: Fall, exposures: list[Exposure], world: World
) -> None:
    """Heights at which each phone sees the centre, with the parabola; and how far each sees it from there, in pixels. exposures: of
    the tracks that the fall was fitted to."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 7), sharex=True, height_ratios=(2, 1))
    first, last = fall.window
    t = np.linspace(first, last, 100)
    above.plot(t, world.points(fall.at(t))[:, 1], "k-", lw=1, label="free fall")
    low, high = first - 0.05, last + 0.35
    for v, (phone, exposure) in enumerate(zip(phones, exposures)):
        when = exposure.seen_times
        inside = (when > max(low, exposure.span[0])) & (when < min(high, exposure.span[1]))
        pixels = exposure.path(when[inside])
        # the height on the vertical through the parabola's centre, which is where the object is all the time
        point = np.broadcast_to(fall.at(np.array(last)), (int(inside.sum()), 3))
        rays, arm = phone.camera.rays(pixels - fall.shifts[v]), point - phone.camera.centre
        across = rays - (rays @ fall.up)[:, None] * fall.up
        way = (arm * across).sum(1) / np.square(across).sum(1)
        heights = world.points(phone.camera.centre + way[:, None] * rays)[:, 1]
        line = above.plot(when[inside], heights, ".", ms=4, label=phone.name)[0]
        free = (when >= first) & (when <= last)
        off = exposure.path(when[free]) - fall.shifts[v] - phone.camera.project(fall.at(when[free]))
        below.plot(when[free], off[:, 0], "x", ms=3, color=line.get_color())
        below.plot(when[free], off[:, 1], ".", ms=4, color=line.get_color())
    above.set_ylabel("height of the centre [m]")
    above.legend(fontsize=8)
    below.set_ylabel("off the parabola [px]\n(x across, . down)")
    below.set_xlabel(f"time [s], clock of {phones[0].name}")
    for axis in (above, below):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    plt.close(figure)
