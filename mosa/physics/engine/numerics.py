"""What a rollout takes as given, the times of its substeps, and the state that they advance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.physics.constitutive.laws import Law
from mosa.physics.contact.colliders import PackedColliders
from mosa.types import ParticleState


class State(NamedTuple):
    """Particles (N, ...) between two substeps, as `ParticleState`. F_tot is F itself, the same tensor, where the law does not
    yield."""

    x: Tensor
    v: Tensor
    C_affine: Tensor
    F: Tensor
    F_tot: Tensor

    @classmethod
    def of(cls, particles: ParticleState) -> State:
        """Of one body, or of several worlds as they are."""
        return cls(*(getattr(particles, name) for name in cls._fields))

    @classmethod
    def whole(cls, parts: Sequence[Tensor]) -> State:
        """From (x, v, C_affine, F), and F_tot where the law yields."""
        return cls(*parts) if len(parts) == len(cls._fields) else cls(*parts, parts[-1])


def flat(particles: ParticleState) -> State:
    """Of all particles, one world's after the other's where there are worlds (W, N, ...)."""
    state = State.of(particles)
    return state if state.x.ndim == 2 else State(*(t.flatten(0, 1) for t in state))


@dataclass(frozen=True)
class Numerics:
    """What is constant over a rollout and the same in all worlds, but for gravity where each has its own. dx [m], dt [s] where the
    step is fixed, gravity (3,) [m/s^2], planes (P, 6) and modes (P,) from `pack_planes`, low and high (3,) [m] corners of the
    admissible domain, all in the simulator's axes (`axes`), box: the same corners in the world, norm_eps under the root of yield
    norms, colliders None where there are none, energetic: whether an operator is a stiffness (`stress_kernel`) or acts on the
    stress; touching: whether a plane is met by particles; moduli: the law's
    `moduli_slots` where the stress takes the mean change of volume (`mean_volume`), None where it takes each particle's own.

    driven: how many of the colliders, the last ones, are sets of driven particles; points: how many
    points lead them (`contact.driven`)."""

    law: Law
    dtype: torch.dtype
    device: torch.device
    dx: float
    dt: float
    gravity: tuple[float, float, float]
    planes: Tensor
    modes: Tensor
    plane_count: int
    box: tuple[tuple[float, ...], tuple[float, ...]]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    norm_eps: float
    rebuild: bool
    check_J: bool
    colliders: PackedColliders | None = None
    energetic: bool = False
    touching: bool = False
    moduli: tuple[int, int, int] | None = None
    driven: int = 0
    points: int = 0


class Steps(NamedTuple):
    """Times [s] of a segment's substeps: each moves particles by `dt`; the first one's forces act for `kick`, the others' for dt.

    Velocities lie between positions, half a substep back. Where dt changes, the way from the middle of the last substep to that
    of the next is the mean of the two: with that kick the scheme stays the leapfrog that it is at a constant dt."""

    kick: float
    dt: float
