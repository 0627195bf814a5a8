"""Driven particles: parts of the body itself that a motion holds, rigidly or point by point, and loads that are fixed to a part.

A set of driven particles stands among the colliders, after the solids: it has a motion, a pose at every substep, and takes a force
and a torque, as they have. What acts on its particles is in `driven_kernels`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import Collider, Particles, Shape
from mosa.physics.contact.motion import Motion, Trajectory
from mosa.physics.contact.reference import signed_distance


@dataclass(frozen=True)
class Points:
    """A motion that is given point by point: points (T, n, 3) [m] at times (T,) [s], linear between them, at rest before and after.

    Each driven particle keeps its place relative to the point that is nearest to it at the start. Differentiable in the points.
    The pose is that of their mean, without rotation: torques are about it. Errors: ConfigError naming the field.
    """

    times: Tensor | Sequence[float]
    points: Tensor

    def __post_init__(self) -> None:
        times = torch.as_tensor(self.times, dtype=torch.float64).cpu()
        points = torch.as_tensor(self.points, dtype=torch.float64).cpu()
        if times.ndim != 1 or len(times) < 2 or not bool((times.diff() > 0).all()):
            raise ConfigError(
                f"motion: times: expected at least two ascending numbers, found shape {tuple(times.shape)}"
            )
        if (
            points.ndim != 3
            or len(points) != len(times)
            or not points.shape[1]
            or points.shape[-1] != 3
        ):
            raise ConfigError(
                f"motion: points: expected shape ({len(times)}, n, 3), found {tuple(points.shape)}"
            )
        if not bool(torch.isfinite(points.detach()).all()):
            raise ConfigError("motion: points: expected finite numbers, found others")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "points", points)

    def at(self, times: Tensor) -> Tensor:
        """(S, n, 3) points at times (S,) [s]."""
        place = times.clamp(float(self.times[0]), float(self.times[-1]))
        after = torch.searchsorted(self.times, place, right=True).clamp(1, len(self.times) - 1)
        share = (place - self.times[after - 1]) / (self.times[after] - self.times[after - 1])
        return torch.lerp(self.points[after - 1], self.points[after], share[:, None, None])

    def paths(self, ends: Tensor) -> tuple[Tensor, Tensor]:
        """(where each point is beside the mean of all, since the start (S, n, 3) [m], its mean rate (S, n, 3) [m/s]) in the
        substeps between `ends` (S + 1,) [s]."""
        points = self.at(ends)
        beside = points - points.mean(1, keepdim=True)
        first = self.at(torch.zeros(1, dtype=torch.float64))
        moved = beside - (first - first.mean(1, keepdim=True))
        return moved[:-1], moved.diff(dim=0) / ends.diff()[:, None, None]

    def sample(
        self, frames: int, substeps: int, dt: float, start: float = 0.0, first: int = 0
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As `Motion.sample`."""
        mean = self.at(_ends(frames * substeps, dt, start, first)).mean(1)
        eye = torch.eye(3, dtype=torch.float64).expand(len(mean) - 1, 3, 3)
        return mean[:-1], eye, mean.diff(dim=0) / dt, torch.zeros_like(mean[:-1])

    def timed(self, frames: int | None, frame_dt: float) -> Points:
        return self

    def shifted(self, offset: Tensor) -> Points:
        return replace(self, points=self.points + offset.double().cpu())

    def max_speed(self, reach: float) -> float:
        steps = self.points.detach().diff(dim=0).norm(dim=-1).amax(1)
        return float((steps / self.times.diff()).max())


def _ends(count: int, dt: float, start: float, first: int) -> Tensor:
    return start + dt * torch.arange(first, first + count + 1, dtype=torch.float64)


def sample_paths(
    motions: Sequence, count: int, dt: float, start: float, first: int = 0
) -> tuple[Tensor, ...]:
    """(paths, rates), (S, P, 3) float64 each, of all points of the motions at S = count substeps; () where there are no points."""
    found = [m.paths(_ends(count, dt, start, first)) for m in motions if isinstance(m, Points)]
    return tuple(torch.cat(parts, 1) for parts in zip(*found))


@dataclass(frozen=True, eq=False)
class Driven:
    """Particles of a body, by the place where they start, and the motion that holds them.

    region: a shape in the pose that the motion has at t = 0, or indices (n,) of particles; None with `Points`: the particle that is
    nearest to each. held: False for a load alone, which goes with its particles; mass [kg]: fixed to them, each has its share by
    volume. Errors: ConfigError.
    """

    region: Shape | Tensor | Sequence[int] | None
    motion: Motion | Trajectory | Points = field(default_factory=Motion)
    mass: float = 0.0
    held: bool = True
    name: str = ""

    def chosen(self, x: Tensor) -> Tensor:
        """(n,) indices of the particles x (N, 3) [m] where the body starts. Errors: ConfigError where there are none."""
        place, where = x.detach().double().cpu(), f"driven set {self.name!r}"
        if self.region is None:
            if not isinstance(self.motion, Points):
                raise ConfigError(f"{where}: expected a region, or points that move, found neither")
            return torch.cdist(self.motion.at(torch.zeros(1))[0].detach(), place).argmin(1).unique()
        if isinstance(self.region, Tensor | Sequence):
            found = torch.as_tensor(self.region, dtype=torch.int64).cpu().unique()
            if len(found) and not 0 <= int(found[0]) <= int(found[-1]) < len(x):
                raise ConfigError(
                    f"{where}: indices: expected numbers of particles below {len(x)}, found {int(found[-1])}"
                )
        else:
            position, rotation, *_ = _pose(self.motion)
            inside = signed_distance(self.region, (place - position) @ rotation) <= 0
            found = inside.nonzero()[:, 0]
        if not len(found):
            raise ConfigError(
                f"{where}: expected particles of the body inside of it where the body starts, found none; the body is "
                f"between {[round(v, 4) for v in place.amin(0).tolist()]} and "
                f"{[round(v, 4) for v in place.amax(0).tolist()]} m"
            )
        return found

    @property
    def solid(self) -> Collider:
        """As it stands among the colliders."""
        return Collider(Particles(), motion=self.motion, name=self.name)


class Held(NamedTuple):
    """Which particles are driven, and from where. sets: (N,) int32 number of the column of poses, -1 for free particles; local:
    (N, 3) [m] places in the axes of their motions; points: (N,) int32 number of the point that each follows, -1 for none. Of W
    worlds: (W, N, ...)."""

    sets: Tensor
    local: Tensor
    points: Tensor


def _pose(motion, start: float = 0.0) -> tuple[Tensor, ...]:
    """(position (3,), rotation (3, 3)) float64 at a time [s], without gradient."""
    motion = motion.timed(None, 1.0) if isinstance(motion, Motion) else motion
    return tuple(part[0].detach() for part in motion.sample(1, 1, 1e-9, start)[:2])


def hold(
    indices: Sequence[Tensor], motions: Sequence, x: Tensor, solids: int = 0, start: float = 0.0
) -> Held:
    """The sets `indices`, one for each of `motions`, of particles at x (N, 3) [m] at time `start` of the motions, behind `solids`
    solids. Without gradient: places in the motions' axes are those of the start. Errors: ConfigError where sets share a particle.
    """
    place = x.detach().double().cpu()
    sets, points = (torch.full((len(x),), -1, dtype=torch.int32) for _ in range(2))
    local, passed = torch.zeros_like(place), 0
    for k, (chosen, motion) in enumerate(zip(indices, motions, strict=True)):
        if bool((sets[chosen] >= 0).any()):
            raise ConfigError(
                f"driven sets: expected sets without a common particle, found particle "
                f"{int(chosen[sets[chosen] >= 0][0])} in two of them"
            )
        position, rotation = _pose(motion, start)
        sets[chosen], local[chosen] = solids + k, (place[chosen] - position) @ rotation
        if isinstance(motion, Points):
            first = motion.at(torch.zeros(1, dtype=torch.float64))[0].detach()
            now = motion.at(torch.full((1,), start, dtype=torch.float64))[0].detach()
            nearest = torch.cdist(place[chosen], now).argmin(1)
            points[chosen] = (passed + nearest).int()
            moved = (now - now.mean(0)) - (first - first.mean(0))
            local[chosen] -= moved[nearest]
            passed += len(first)
    return Held(sets, local, points)


def loads(driven: Sequence[Driven], indices: Sequence[Tensor], volume: Tensor) -> Tensor | None:
    """(N,) density [kg/m^3] that the sets' masses add to their particles, None where there are none. Errors: ConfigError."""
    if not any(each.mass for each in driven):
        return None
    added = torch.zeros_like(volume)
    for each, chosen in zip(driven, indices, strict=True):
        if not 0 <= each.mass < math.inf:
            raise ConfigError(
                f"driven set {each.name!r}: mass: expected a number of at least 0 [kg], found {each.mass}"
            )
        chosen = chosen.to(volume.device)
        added[chosen] += each.mass / volume[chosen].sum()
    return added
