"""Motions as npz files of plain numbers: rollouts, what colliders did and felt, what was seen, what is true (docs/figures.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mosa.physics.contact.colliders import (
    Box,
    Capsule,
    Collider,
    Cylinder,
    Particles,
    Shape,
    Sphere,
)
from mosa.physics.contact.motion import Motion, Points, Trajectory, rotation_matrices
from mosa.system.npz import write_npz
from mosa.types import MotionCues, Rollout


def save_rollout(
    path: str | Path, parts: Mapping[str, Rollout], colliders: Sequence[Collider] = ()
) -> None:
    """npz of rollouts under `<name>/...`: x, v [T, N, 3] (m, m/s), F, F_tot [T, N, 3, 3], times [T] (s), counts [T - 1].

    Where there are K colliders also reactions [T - 1, substeps, K, 6]: force (N) and torque about each one's origin (N m) of
    every substep (one mean where the substeps vary), and collider_position [T, K, 3] (m), collider_rotation [T, K, 3, 3] at the
    frames, in the order of the configuration, and collider_shape [K, 4]: 1 sphere, 2 capsule,
    3 cylinder (radius, length), 4 box (edges) (m), 0 others, -1 driven particles."""
    arrays: dict[str, np.ndarray] = {}
    for name, rollout in parts.items():
        tensors = {key: getattr(rollout, key) for key in ("x", "v", "F", "F_tot", "times")}
        tensors["counts"] = torch.tensor(rollout.counts, dtype=torch.int64)
        if rollout.reactions is not None:
            tensors["reactions"] = rollout.reactions
        if colliders:
            position, rotation = poses(colliders, rollout.times)
            tensors |= {"collider_position": position, "collider_rotation": rotation}
            shapes = [_numbers(each.shape) for each in colliders]
            tensors["collider_shape"] = torch.tensor(shapes, dtype=torch.float64)
        arrays |= {f"{name}/{key}": t.detach().cpu().numpy() for key, t in tensors.items()}
    write_npz(path, arrays)


DRAWN = (Sphere, Capsule, Cylinder, Box)


def _numbers(shape: Shape) -> list[float]:
    if not isinstance(shape, DRAWN):
        return [-1.0 if isinstance(shape, Particles) else 0.0, 0.0, 0.0, 0.0]
    sizes = shape.size if isinstance(shape, Box) else tuple(vars(shape).values())
    return [1.0 + DRAWN.index(type(shape)), *sizes, 0.0, 0.0][:4]


def shape_of(numbers: Sequence[float]) -> Shape | None:
    """The shape of a row of collider_shape, None for those that are not drawn."""
    kind = int(numbers[0]) - 1
    if kind not in range(len(DRAWN)) or not all(0 <= each < 1e6 for each in numbers[1:]):
        return None
    a, b, c = map(float, numbers[1:])
    return (Sphere(a), Capsule(a, b), Cylinder(a, b), Box((a, b, c)))[kind]


def poses(colliders: Sequence[Collider], times: Tensor) -> tuple[Tensor, Tensor]:
    """(positions (T, K, 3) [m], rotations (T, K, 3, 3)) float64 at equally spaced times (T,) [s] from 0 on."""
    frames = len(times)
    frame_dt = float(times[1] - times[0]) if frames > 1 else 1.0
    found = [pose(collider.motion, frames, frame_dt) for collider in colliders]
    return torch.stack([position for position, _ in found], 1), torch.stack(
        [rotation for _, rotation in found], 1
    )


def pose(
    motion: Motion | Trajectory | Points, frames: int, frame_dt: float
) -> tuple[Tensor, Tensor]:
    """(position (T, 3), rotation (T, 3, 3)) of one collider at its frames; of a trajectory, which ends before the last one, the
    last pose it has."""
    if isinstance(motion, Trajectory):
        index = (torch.arange(frames) * (len(motion.position) // max(frames - 1, 1))).clamp(
            max=len(motion.position) - 1
        )
        return motion.position.detach().double().cpu()[index], rotation_matrices(
            motion.rotation, 1
        ).detach().double().cpu()[index]
    return motion.timed(max(frames - 1, 1), frame_dt).sample(frames, 1, frame_dt)[:2]


def save_observed(path: str | Path, parts: Mapping[str, MotionCues]) -> None:
    """npz with x [T, N, 3] and covariances [T, N, 3, 3] of the motions learned from, under `<name>/...` as `save_rollout`."""
    kinds = {name: {"x": c.positions, "covariances": c.covariances} for name, c in parts.items()}
    save_parts(path, kinds)


def save_spread(path: str | Path, parts: Mapping[str, Tensor]) -> None:
    """npz with sd [T, N], the predicted standard deviation of every particle's position [m], under `<name>/sd`."""
    save_parts(path, {name: {"sd": sd.float()} for name, sd in parts.items()})


def save_truth(path: str | Path, parts: Mapping[str, Tensor]) -> None:
    """npz with x [T, N, 3], single precision, where the body's particles would truly be, under `<name>/...` as `save_rollout`."""
    save_parts(path, {name: {"x": x.float()} for name, x in parts.items()})


def save_parts(path: str | Path, parts: Mapping[str, dict[str, Tensor]]) -> None:
    """npz of the tensors under `<name>/<key>`."""
    arrays = {f"{name}/{key}": t for name, tensors in parts.items() for key, t in tensors.items()}
    write_npz(path, {key: t.detach().cpu().numpy() for key, t in arrays.items()})
