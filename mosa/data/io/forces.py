"""Measured forces as observations: a load cell's curve, compared with what a solid or a driven set takes in a rollout."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from warnings import warn

import torch
from torch import Tensor

from mosa.data.io.tables import number, read_table
from mosa.errors import ConfigError, DataError
from mosa.physics.contact.colliders import Collider
from mosa.physics.world import World
from mosa.settings import LARGEST, Entries, Positive, Settings, Text, check
from mosa.types import Rollout

COLUMNS = ("time", "fx", "fy", "fz")
MODEL_ERROR = 0.01  # of the largest force: error of a grid (docs/driven.md)
FAR = 5.0  # standard deviations of a misfit (rms) beyond which it is warned of


class Measured(Settings):
    """An entry of world.forces."""

    of: Text
    file: Text
    sd: Positive | None = None
    recording: Text | None = None


@dataclass(frozen=True, eq=False)
class ForceCurve:
    """Force on what is called `of`, as the body exerts it. times: (n,) [s] from frame 0 on, ascending; forces: (n, 3) [N], NaN for
    a component that was not measured; sd [N]: noise of one sample, None: found from the samples' roughness; recording: in which it
    was measured, None: the first."""

    of: str
    times: Tensor
    forces: Tensor
    sd: float | None = None
    recording: str | None = None

    @property
    def name(self) -> str:
        """Of its figures."""
        return self.of if self.recording is None else f"{self.recording}/{self.of}"

    def noise(self) -> float:
        """Standard deviation of one sample [N]: of white noise the second differences have six times its variance."""
        if self.sd is not None:
            return self.sd
        rough = self.forces.diff(n=2, dim=0)
        rough = rough[torch.isfinite(rough)]
        return float((rough.square().mean() / 6).sqrt()) if len(rough) else 0.0

    @property
    def largest(self) -> float:
        """[N] of all components."""
        return float(self.forces.nan_to_num().abs().max())

    def means(self, frames: int, frame_dt: float) -> tuple[Tensor, Tensor]:
        """(mean force (T - 1, 3) [N] in each frame interval, NaN where it is not covered; its standard deviation (T - 1, 3) [N],
        with what a grid gets wrong). The samples are joined by straight lines. Errors: ConfigError where they cover none."""
        ends = frame_dt * torch.arange(frames, dtype=torch.float64)
        whole = torch.zeros(1, 3, dtype=torch.float64)
        steps = 0.5 * (self.forces[1:] + self.forces[:-1]) * self.times.diff()[:, None]
        blank = torch.isnan(steps)
        passed = torch.cat([whole, torch.where(blank, 0.0, steps).cumsum(0)])
        blanks = torch.cat([whole, blank.double().cumsum(0)])
        place = ends.clamp(float(self.times[0]), float(self.times[-1]))
        at = torch.searchsorted(self.times, place, right=True).clamp(1, len(self.times) - 1)
        since = (place - self.times[at - 1])[:, None]
        slope = (self.forces.diff(dim=0) / self.times.diff()[:, None])[at - 1]
        impulse = passed[at - 1] + since * (self.forces[at - 1] + 0.5 * since * slope)
        mean = impulse.diff(dim=0) / frame_dt
        slack = 1e-6 * frame_dt
        covered = (ends[:-1] >= self.times[0] - slack) & (ends[1:] <= self.times[-1] + slack)
        mean[~covered] = torch.nan
        mean[blanks[at][1:] > blanks[at - 1][:-1]] = torch.nan
        if not bool(torch.isfinite(mean).any()):
            raise ConfigError(
                f"world.forces: expected a curve of {self.of!r} that covers an interval between frames (0 to "
                f"{float(ends[-1]):.6g} s), found {float(self.times[0]):.6g} to {float(self.times[-1]):.6g} s"
            )
        inside = (self.times[:, None] > ends[:-1]) & (self.times[:, None] <= ends[1:])
        count = inside.sum(0).clamp_min(1)[:, None]
        sd = (self.noise() ** 2 / count + (MODEL_ERROR * self.largest) ** 2).sqrt().expand_as(mean)
        return mean, sd


def forces_from_config(
    items: Sequence[Mapping[str, Any]] | None,
) -> tuple[ForceCurve, ...]:
    """Of entries {of: name of a collider or driven set, file: csv, sd [N], recording: name}.

    Columns of the file: time [s], fx, fy, fz [N]. A column that is missing, and an empty cell, was not measured. Errors:
    ConfigError naming the entry, DataError the file."""
    check("world.forces", items, Entries | None)
    read = [Measured.read(item, f"world.forces[{i}]") for i, item in enumerate(items or ())]
    return tuple(
        replace(read_forces(Path(each.file), each.of, each.sd), recording=each.recording)
        for each in read
    )


def curves_of(curves: Sequence[ForceCurve], recording: str, first: bool) -> list[ForceCurve]:
    """Those that were measured in a recording; first: whether a run begins with it."""
    return [
        each for each in curves if each.recording in ((recording, None) if first else (recording,))
    ]


def read_forces(path: Path, of: str, sd: float | None = None) -> ForceCurve:
    """Errors: DataError naming the file, what was expected and found."""
    try:
        names, rows = read_table(path)
        known = [name for name in names if name in COLUMNS]
        if len(set(known)) < max(2, len(known)) or "time" not in known:
            raise ValueError(f"the columns {', '.join(names)}")
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(
            f"{path}: expected a csv of {', '.join(COLUMNS)} (SI units), found {error}"
        ) from error
    kept = {i: row for i, row in enumerate(rows, 1) if row[0][:1] != "#"}
    found = {}
    for name in known:
        at = names.index(name)
        found[name] = [number(row[at], f"{path}: row {i}: {name}") for i, row in kept.items()]
    blank = [math.nan] * len(kept)
    times, *columns = (
        torch.tensor(found.get(name, blank), dtype=torch.float64) for name in COLUMNS
    )
    forces = torch.stack(columns, 1)
    every = times.tolist()
    late = [(i, b) for i, a, b in zip(kept, [-math.inf, *every], every) if not a < b < math.inf]
    if late or len(every) < 2:
        told = f"{late[0][1]:g} in row {late[0][0]}" if late else f"{len(every)} rows"
        raise DataError(f"{path}: time: expected at least two ascending numbers [s], found {told}")
    there = forces[~torch.isnan(forces)]
    if not len(there) or not 1 / LARGEST < float(there.abs().max()) <= LARGEST:
        raise DataError(f"{path}: expected forces [N], not all 0, up to {LARGEST:g}, found others")
    return ForceCurve(of, times, forces, sd)


def warn_of_clock(curve: ForceCurve, frames: int, frame_dt: float) -> None:
    """A warning where a force changes between samples that are farther apart than the film is long: joined by a straight line they
    are a curve of any clock, here one that hardly begins to rise."""
    end = frame_dt * (frames - 1)
    before, after = int((curve.times <= 0).sum()) - 1, int((curve.times < end).sum())
    if after <= before + 1 and curve.forces[[before, after]].diff(dim=0).nan_to_num().any():
        first, then = map(float, curve.times[[before, after]])
        warn(
            f"world.forces: {curve.name}: expected samples within the {end:.3g} s of the film, found none between {first:.6g} "
            f"and {then:.6g} s: a clock that counts in milliseconds? (time: seconds from frame 0 on)",
            stacklevel=2,
        )


def columns_of(curves: Sequence[ForceCurve], solids: Sequence[Collider]) -> list[int]:
    """The reactions' columns that the curves are of. solids: `World.solids`. Errors: ConfigError
    naming a curve of nothing that is there."""
    names = [solid.name or str(i) for i, solid in enumerate(solids)]
    for curve in curves:
        if names.count(curve.of) != 1:
            raise ConfigError(
                f"world.forces: of: expected the name of one collider or driven set ({', '.join(names) or 'there are none'}), "
                f"found {curve.of!r}"
            )
    return [names.index(curve.of) for curve in curves]


def force_residuals(
    rollout: Rollout, curves: Sequence[ForceCurve], world: World, frame_dt: float
) -> Tensor:
    """(M,) differences from the mean forces of all frame intervals that were measured, over their standard deviations."""
    parts = compared_forces(rollout, curves, world, frame_dt)
    return torch.cat([(felt - mean) / sd for felt, mean, sd in parts])


def force_figures(
    rollout: Rollout, curves: Sequence[ForceCurve], world: World, frame_dt: float
) -> dict[str, float]:
    """`forces/<of>/...`, of the mean forces of frame intervals: `rms_share`, predicted minus
    measured, and `allowed_share`, its standard deviation, over the largest measured force;
    `measured_N` and `predicted_N` where that is. Warns of a misfit far beyond what is allowed."""
    found: dict[str, float] = {}
    for curve, (felt, mean, sd) in zip(curves, compared_forces(rollout, curves, world, frame_dt)):
        at = mean.abs().argmax()
        most = float(mean[at].abs()) or curve.largest  # 0 in all frames: the body was not met yet
        off, allowed = (
            float((v.detach() / most).square().mean().sqrt()) for v in (felt - mean, sd)
        )
        names = ("rms_share", "allowed_share", "measured_N", "predicted_N")
        values = (off, allowed, float(mean[at]), float(felt[at]))
        found |= {f"forces/{curve.name}/{name}": value for name, value in zip(names, values)}
        if off > FAR * allowed:
            warn(
                f"world.forces: {curve.name}: the predicted force is off by {off:.0%} of the largest measured, allowed are "
                f"{allowed:.1%}. Expected: the force that the body exerts (check the sign), world axes, N, times from frame 0",
                stacklevel=2,
            )
    return found


def compared_forces(
    rollout: Rollout, curves: Sequence[ForceCurve], world: World, frame_dt: float
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """By curve: predicted and measured mean forces that were measured, and their standard deviation, (M,) [N]."""
    parts = []
    if rollout.reactions is None:
        raise ConfigError(
            "world.forces: expected a law on a grid, found an adapter without reactions"
        )
    for curve, column in zip(curves, columns_of(curves, world.solids)):
        mean, sd = (t.to(rollout.x.device) for t in curve.means(len(rollout.x), frame_dt))
        felt = rollout.reactions.mean(1)[:, column, :3].double()
        there = torch.isfinite(mean)
        parts.append((felt[there], mean[there], sd[there]))
    return parts
