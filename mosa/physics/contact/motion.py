"""Prescribed rigid motions of colliders: pose and twist at every substep, differentiable in what describes them.

The pose of substep s is the one at its start, t = s dt; the twist is the mean in it. A motion is described by pieces of
constant twist (`Motion`, `Motion.waypoints`), or given substep by substep (`Trajectory`). Everything is torch: gradients reach
positions, rotations and velocities through autograd.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.rotations import axial, skew
from mosa.settings import shown
from mosa.system.limits import counted


class Poses(NamedTuple):
    """K colliders at S substeps. position: (S, K, 3) [m]; rotation: (S, K, 3, 3), body to world; linear: (S, K, 3) [m/s],
    velocity of the collider's origin; angular: (S, K, 3) [rad/s], both in world axes."""

    position: Tensor
    rotation: Tensor
    linear: Tensor
    angular: Tensor


def exponential(vectors: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad], differentiable."""
    return torch.matrix_exp(skew(vectors))


def rotation_matrices(value: Tensor | Sequence, leading: int = 0) -> Tensor:
    """(..., 3, 3) float64 of rotation vectors (..., 3) [rad] or matrices, with `leading` dimensions before. Differentiable.

    Errors: ConfigError for another shape, or matrices that are not rotations (1e-4)."""
    value = torch.as_tensor(value, dtype=torch.float64)
    if value.ndim == leading + 1 and value.shape[-1] == 3:
        return exponential(value)
    if value.ndim != leading + 2 or value.shape[-2:] != (3, 3):
        expected = "(K, 3) or (K, 3, 3)" if leading else "(3,) or (3, 3)"
        raise ConfigError(
            f"rotation: expected rotation vectors or matrices {expected}, found shape {tuple(value.shape)}"
        )
    R = value.detach()
    defect = (R @ R.mT - torch.eye(3, dtype=torch.float64, device=R.device)).abs().max()
    if not (float(defect) < 1e-4 and bool((torch.linalg.det(R) > 0).all())):
        raise ConfigError(
            f"rotation: expected rotation matrices (R R^T = I, det R = 1), found a defect of {float(defect):.3g}"
        )
    return value


def rotation_vector(R: Tensor) -> Tensor:
    """Rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3) by at most pi, differentiable."""
    sine = 0.5 * axial(R)
    cosine = 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    square = (sine**2).sum(-1)
    small = square < 1e-8
    # angle/sin(angle), by its series where the angle (below 1e-4) leaves 1e-17 of it
    size = torch.where(small, torch.ones_like(square), square).sqrt()
    factor = torch.where(small & (cosine > 0), 1 + square / 6, torch.atan2(size, cosine) / size)
    # near pi the sine has no direction, but R + R^T - 2 cos = 2 (1 - cos) n n^T has
    about = R + R.mT - 2 * cosine[..., None, None] * torch.eye(3).to(R)
    about = torch.where((cosine < -0.9)[..., None, None], about, torch.ones_like(about))
    longest = about.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    longest = longest[..., None, None].expand(*R.shape[:-1], 1)
    axis = torch.nn.functional.normalize(about.gather(-1, longest)[..., 0], dim=-1)
    along = (sine * axis).sum(-1, keepdim=True)
    turn = torch.atan2(along.abs(), cosine[..., None]) * torch.where(along < 0, -axis, axis)
    return torch.where((cosine < -0.9)[..., None], turn, factor[..., None] * sine)


def turning(start: Tensor, end: Tensor) -> Tensor:
    """Rotation vectors (..., 3) [rad] of the turns from rotation vectors `start` to `end`: the shortest ones, but what they say
    where both are about one axis and one of them is half a turn or more."""
    shortest = rotation_vector(exponential(end) @ exponential(start).mT)
    far = torch.maximum(start.norm(dim=-1), end.norm(dim=-1)) > math.pi - 1e-6
    told = far & (torch.linalg.cross(*torch.broadcast_tensors(start, end)).norm(dim=-1) < 1e-6)
    return torch.where(told[..., None], end - start, shortest)


def _vectors(name: str, value: Tensor | Sequence) -> Tensor:
    value = torch.as_tensor(value, dtype=torch.float64)
    if value.shape[-1:] != (3,) or value.ndim > 2 or not bool(torch.isfinite(value.detach()).all()):
        raise ConfigError(
            f"motion: {name}: expected (3,) or (K, 3) finite numbers, found shape {tuple(value.shape)}"
        )
    return value.reshape(-1, 3)


def _most(linear: Tensor, angular: Tensor, reach: float) -> float:
    """Bound of the speed [m/s] within `reach` [m] of the origin, of twists (K, 3)."""
    linear, angular = (v.detach().norm(dim=1).max() for v in (linear, angular))
    return float(linear + reach * angular)


def _mean(times: Tensor, pieces: Tensor, ends: Tensor, middle: Tensor) -> Tensor:
    """(S, 3) means of velocities `pieces` (K, 3) from `times` (K,) on between `ends` (S + 1,): those in the `middle`, but where a
    piece begins or ends between them, however short it is."""
    whole = (pieces[:-1] * times.diff()[:, None]).cumsum(0)
    at = (torch.searchsorted(times, ends, right=True) - 1).clamp_min(0)
    passed = torch.cat([torch.zeros(1, 3).to(pieces), whole])[at]
    passed = passed + (ends - times[at]).clamp_min(0)[:, None] * pieces[at]
    mean = passed.diff(dim=0) / ends.diff()[:, None]
    return torch.where(torch.isclose(mean, middle, rtol=1e-6, atol=1e-9), middle, mean)


Pose = tuple[Tensor, Tensor, Tensor, Tensor]
"""Of one collider at S substeps, float64, as `Poses`: position (S, 3), rotation (S, 3, 3), linear (S, 3), angular (S, 3)."""


def ends(count: int, dt: float, start: float, first: int) -> Tensor:
    """(count + 1,) [s]: where substeps of dt from the `first` one after time `start` begin, and the last one ends."""
    return start + dt * torch.arange(first, first + count + 1, dtype=torch.float64)


@dataclass(frozen=True)
class Motion:
    """Pieces of constant twist from a pose at t = 0.

    position: (3,) [m]; rotation: (3,) rotation vector [rad] or (3, 3); velocity, angular_velocity: (3,) for always or (K, 3),
    [m/s], [rad/s], world axes. times: (K,) [s] start of each piece, ascending; at rest before the first, and the last one never
    ends. Without times K is 1, the number of frame intervals, or the number of substeps of the rollout. Numbers or tensors;
    differentiable in all but times."""

    position: Tensor | Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Tensor | Sequence = (0.0, 0.0, 0.0)
    velocity: Tensor | Sequence = (0.0, 0.0, 0.0)
    angular_velocity: Tensor | Sequence = (0.0, 0.0, 0.0)
    times: Sequence[float] | Tensor | None = None

    @classmethod
    def waypoints(
        cls,
        times: Sequence[float] | Tensor,
        positions: Tensor | Sequence,
        rotations: Tensor | Sequence | None = None,
    ):
        """Through poses at `times` (K,) [s], K >= 2, at constant twist between; at rest before the first and after the last.

        positions: (K, 3) [m]; rotations: (K, 3) or (K, 3, 3), turned by less than half a turn from one to the next, or by more
        where vectors about one axis say so (`turning`).
        Errors: ConfigError naming the field."""
        times = torch.as_tensor(times, dtype=torch.float64)
        positions = _vectors("waypoints: positions", positions)
        count = len(times)
        if times.ndim != 1 or count < 2 or not bool((times.diff() > 0).all()):
            raise ConfigError(
                f"motion: waypoints: times: expected at least two ascending numbers, found {times.tolist()}"
            )
        rotations = torch.zeros(count, 3) if rotations is None else rotations
        rotations = torch.as_tensor(rotations, dtype=torch.float64)
        R = rotation_matrices(rotations, 1)
        if len(positions) != count or len(R) != count:
            raise ConfigError(
                f"motion: waypoints: expected one position and rotation for each of {count} times, found {len(positions)} and "
                f"{len(R)}"
            )
        told = rotations.ndim == 2
        turns = (
            turning(rotations[:-1], rotations[1:]) if told else rotation_vector(R[1:] @ R[:-1].mT)
        )
        if not told and bool((turns.detach().norm(dim=-1) > 3.04).any()):
            raise ConfigError(
                "motion: waypoints: rotations: expected less than half a turn between two, put one in between"
            )
        interval, rest = times.diff()[:, None], torch.zeros(1, 3, dtype=torch.float64)
        velocity = torch.cat([(positions[1:] - positions[:-1]) / interval, rest])
        angular = torch.cat([turns / interval, rest])
        return cls(positions[0], R[0], velocity, angular, times)

    def shifted(self, offset: Tensor) -> "Motion":
        """The same motion moved by offset (3,) [m]."""
        position = torch.as_tensor(self.position, dtype=torch.float64).cpu()
        return replace(self, position=position + offset.double().cpu())

    def sample(
        self, frames: int, substeps: int, dt: float, start: float = 0.0, first: int = 0
    ) -> Pose:
        """Poses and velocities at S = frames * substeps substeps of dt [s], from the `first` one after time `start` [s] on.
        Errors: ConfigError naming the field."""
        position = _vectors("position", self.position).cpu()
        attitudes = [rotation_matrices(self.rotation).cpu()]
        if len(position) != 1:
            raise ConfigError(
                f"motion: position: expected (3,), found {len(position)} vectors: see Motion.waypoints"
            )
        linear = _vectors("velocity", self.velocity).cpu()
        angular = _vectors("angular_velocity", self.angular_velocity).cpu()
        times, count = self._pieces(frames, substeps, dt, max(len(linear), len(angular)))
        for name, value in (("velocity", linear), ("angular_velocity", angular)):
            if len(value) not in (1, count):
                raise ConfigError(f"motion: {name}: expected 1 or {count} rows, found {len(value)}")
        linear, angular = linear.expand(count, 3), angular.expand(count, 3)
        interval = times.diff()[:, None]
        knots = torch.cat([position, position + ((linear[:-1] * interval).cumsum(0))])
        for turn in exponential(angular[:-1] * interval):
            attitudes.append(turn @ attitudes[-1])
        limits = ends(frames * substeps, dt, start, first)
        t = limits[:-1]
        # a substep belongs to the piece that its middle is in
        piece = torch.searchsorted(times, t + 0.5 * dt, right=True) - 1
        resting = (piece < 0)[:, None]
        piece = piece.clamp_min(0)
        since = torch.where(resting, torch.zeros(()), (t - times[piece])[:, None])
        x = knots[piece] + since * linear[piece]
        R = exponential(since * angular[piece]) @ torch.stack(attitudes)[piece]
        linear, angular = (_mean(times, v, limits, v[piece] * ~resting) for v in (linear, angular))
        return x, R, linear, angular

    def _pieces(self, frames: int, substeps: int, dt: float, count: int) -> tuple[Tensor, int]:
        """(start times (K,), K)."""
        if self.times is not None:
            times = torch.as_tensor(self.times, dtype=torch.float64).cpu()
            ascending = times.ndim == 1 and len(times) and bool((times.diff() > 0).all())
            if not ascending or not bool(torch.isfinite(times).all()):
                raise ConfigError(f"motion: times: expected ascending ones, found {times.tolist()}")
            return times, len(times)
        length = {1: 0.0, frames: substeps * dt, frames * substeps: dt}
        if count not in length:
            raise ConfigError(
                f"motion: velocity and angular_velocity: expected 1, {frames} (per frame interval) or {frames * substeps} (per "
                f"substep) vectors where no times are given, found {count}"
            )
        return length[count] * torch.arange(count, dtype=torch.float64), count

    def timed(self, frames: int | None, frame_dt: float) -> "Motion":
        """The same motion with `times` said: what one velocity per frame interval means, whatever the substeps.

        frames: intervals of the rollout, None where there may be any number of them.
        Errors: ConfigError for another number of velocities without times: substeps of varying length have no such list."""
        if self.times is not None:
            return self
        count = max(
            len(_vectors(name, getattr(self, name))) for name in ("velocity", "angular_velocity")
        )
        if frames is not None and count not in (1, frames):
            raise ConfigError(
                f"motion: velocity and angular_velocity: expected 1 or {frames} (per frame interval) vectors where no times are "
                f"given and the substeps vary, found {count}; give times"
            )
        return replace(self, times=frame_dt * torch.arange(count, dtype=torch.float64))

    def max_speed(self, reach: float) -> float:
        """Bound of the speed [m/s] of a point within `reach` [m] of the origin."""
        return _most(_vectors("", self.velocity), _vectors("", self.angular_velocity), reach)


@dataclass(frozen=True)
class Trajectory:
    """A motion substep by substep, nothing derived. position: (S, 3) [m]; rotation: (S, 3, 3) or (S, 3); velocity and
    angular_velocity: (S, 3) of the S substeps of a rollout. For optimal control and gradient checks."""

    position: Tensor
    rotation: Tensor
    velocity: Tensor
    angular_velocity: Tensor

    def shifted(self, offset: Tensor) -> "Trajectory":
        return replace(self, position=self.position.double().cpu() + offset.double().cpu())

    def sample(
        self, frames: int, substeps: int, dt: float, start: float = 0.0, first: int = 0
    ) -> Pose:
        """As `Motion.sample`; `start` must be a whole number of substeps into the trajectory."""
        begin, count = round(start / dt), frames * substeps
        first += begin
        rotation = rotation_matrices(self.rotation, 1)
        values = self.position, rotation, self.velocity, self.angular_velocity
        if any(len(v) < first + count for v in values) or not math.isclose(
            begin * dt, start, abs_tol=1e-6 * dt
        ):
            raise ConfigError(
                f"trajectory: expected poses and velocities of substeps {first} to {first + count}, found "
                f"{[len(v) for v in values]}"
            )
        return tuple(v[first : first + count].double().cpu() for v in values)

    def max_speed(self, reach: float) -> float:
        return _most(self.velocity, self.angular_velocity, reach)


@dataclass(frozen=True)
class Points:
    """A motion that is given point by point: points (T, n, 3) [m] at times (T,) [s], linear between
    them, at rest before and after.

    Each driven particle keeps its place relative to the point that is nearest to it at the start.
    Differentiable in the points. The pose is that of their mean, without rotation: torques are
    about it. Errors: ConfigError naming the field."""

    times: Tensor
    points: Tensor

    def __post_init__(self) -> None:
        times = torch.as_tensor(self.times, dtype=torch.float64).cpu()
        points = torch.as_tensor(self.points, dtype=torch.float64).cpu()
        ascending = times.ndim == 1 and bool((times.diff() > 0).all())
        if not ascending or len(times) < 2 or not bool(times.isfinite().all()):
            raise ConfigError(
                f"motion: times: expected at least two ascending finite numbers, found {shown(times)}"
            )
        shaped = points.ndim == 3 and points.shape[1] and points.shape[-1] == 3
        if not shaped or len(points) != len(times):
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
        """(how far each point has moved relative to the mean of all (S, n, 3) [m], its mean rate
        (S, n, 3) [m/s]) in the substeps between `ends` (S + 1,) [s]."""
        points = self.at(ends)
        beside = points - points.mean(1, keepdim=True)
        first = self.at(torch.zeros(1, dtype=torch.float64))
        moved = beside - (first - first.mean(1, keepdim=True))
        return moved[:-1], moved.diff(dim=0) / ends.diff()[:, None, None]

    def sample(
        self, frames: int, substeps: int, dt: float, start: float = 0.0, first: int = 0
    ) -> Pose:
        """As `Motion.sample`."""
        mean = self.at(ends(frames * substeps, dt, start, first)).mean(1)
        eye = torch.eye(3, dtype=torch.float64).expand(len(mean) - 1, 3, 3)
        return mean[:-1], eye, mean.diff(dim=0) / dt, torch.zeros_like(mean[:-1])

    def timed(self, frames: int | None, frame_dt: float) -> "Points":
        return self

    def shifted(self, offset: Tensor) -> "Points":
        return replace(self, points=self.points + offset.double().cpu())

    def max_speed(self, reach: float) -> float:
        steps = self.points.detach().diff(dim=0).norm(dim=-1).amax(1)
        return float((steps / self.times.diff()).max())


def pose_at(motion: Motion | Trajectory | Points, start: float = 0.0) -> tuple[Tensor, ...]:
    """(position (3,), rotation (3, 3)) float64 at a time [s], without gradient."""
    motion = motion.timed(None, 1.0) if isinstance(motion, Motion) else motion
    return tuple(part[0].detach() for part in motion.sample(1, 1, 1e-9, start)[:2])


def sample_frame(
    motions: Sequence[Motion | Trajectory], frame: int, frames: int, count: int, frame_dt: float, start: float,
) -> Poses:  # fmt: skip
    """Poses at the substeps of frame interval `frame` (from 0) of `frames`, where every interval has its own count.

    count: of its substeps. Errors: ConfigError for a trajectory, which fits counts that are known alone."""
    dt, sampled = frame_dt / count, []
    for motion in motions:
        if isinstance(motion, Trajectory):
            raise ConfigError("trajectory: not with adaptive substeps; use a Motion with times")
        timed, begins = motion.timed(frames, frame_dt), start + frame * frame_dt
        sampled.append(timed.sample(1, count, dt, begins))
    return _poses(sampled)


def sample_poses(
    motions: Sequence[Motion | Trajectory], frames: int, substeps: int, dt: float, start: float,
    first: int = 0,
) -> Poses:  # fmt: skip
    """Poses (float64, CPU) of all colliders at every substep of `frames` frame intervals, from the `first` one after time `start`.

    Errors: ConfigError naming a collider whose motion is not finite (a NaN would silently touch nothing)."""
    what, each = "substeps of all frames and colliders", 3 * 8 * (3 + 9 + 3 + 3)
    counted(what, (frames, substeps, len(motions)), "take fewer", each=each)
    return _poses([motion.sample(frames, substeps, dt, start, first) for motion in motions])


def _poses(sampled: Sequence[Sequence[Tensor]]) -> Poses:
    for i, parts in enumerate(sampled):
        for name, part in zip(Poses._fields, parts):
            if not bool((finite := torch.isfinite(part.detach())).all()):
                bad = int((~finite).reshape(len(part), -1).any(1).nonzero()[0])
                raise ConfigError(
                    f"motion of collider {i}: {name}: expected finite numbers, found {part[bad].tolist()} at substep {bad}"
                )
    return Poses(*(torch.stack(parts, 1) for parts in zip(*sampled)))
