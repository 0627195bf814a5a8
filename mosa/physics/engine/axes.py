"""The axes in which a simulator computes: along the planes that nodes meet, with their origin near the body.

Nodes meet a plane askew to their grid elsewhere than one along it, by cells. And float32 resolves a micrometre ten metres from the
origin, a millimetre at ten kilometres. Hence x' = Q x - s: Q turns the normals of the planes onto grid axes, s is a whole number of
cells. Where neither is needed nothing is computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.planes import NODE_MODES, Plane
from mosa.physics.rotations import skew
from mosa.types import ParticleState

ALONG, ASKEW = 1e-6, 1e-2
"""Sine of a plane's angle to the grid: below it the plane is along the grid, above it nodes cannot meet it."""
PERIOD, SPREAD, COARSE = 2048, 8, 0.125
"""Cells of which the origin moves by multiples; periods over which worlds may spread; cells by which given x may be rounded."""


@dataclass(frozen=True)
class Axes:
    """turn: (3, 3) float64 rotation Q, None for none; shift: s [m], None for 0."""

    turn: Tensor | None = None
    shift: tuple[float, ...] | None = None

    @property
    def world(self) -> "Axes":
        """The way back."""
        turn = None if self.turn is None else self.turn.mT
        if self.shift is None:
            return Axes(turn)
        back = -Axes(turn).vectors(torch.tensor(self.shift, dtype=torch.float64))
        return Axes(turn, tuple(back.tolist()))

    def vectors(self, v: Tensor | None) -> Tensor | None:
        """(..., 3), or forces and torques (..., 6)."""
        if v is None or self.turn is None:
            return v
        return (v.unflatten(-1, (-1, 3)) @ self.turn.mT.to(v)).flatten(-2)

    def points(self, x: Tensor) -> Tensor:
        """(..., 3) [m]: float64 where the origin moves."""
        if self.shift is None:
            return self.vectors(x)
        return self.vectors(x.double()) - x.double().new_tensor(self.shift)

    def gradients(self, F: Tensor) -> Tensor:
        """Deformation gradients (..., 3, 3), or rotations of bodies."""
        return F if self.turn is None else self.turn.to(F) @ F

    def state(self, state: ParticleState, dtype: torch.dtype | None = None) -> ParticleState:
        """dtype: of positions, None for what `points` gives."""
        x, F = self.points(state.x), self.gradients(state.F)
        x = x if dtype is None else x.to(dtype)
        C = self.vectors(self.gradients(state.C_affine))
        F_tot = F if state.F_tot is state.F else self.gradients(state.F_tot)
        return ParticleState(x, self.vectors(state.v), C, F, F_tot)


def entered(state: ParticleState, axes: Axes, dtype: torch.dtype, dx: float) -> ParticleState:
    """A state of the world in axes that are chosen already, on a grid of dx [m]. Errors: ConfigError where it is too far away."""
    found, most = axes.state(state), 0.5 * (SPREAD + 1) * PERIOD * dx
    if (far := float(found.x.detach().abs().max())) > most:
        raise ConfigError(
            f"x: expected particles within {most:.3g} m of the place of the reset, found {far:.3g} m: reset there"
        )
    return replace(found, x=found.x.to(dtype))


def turn_along(planes: Sequence[Plane]) -> Tensor | None:
    """(3, 3) float64: turns the normals of all planes that nodes meet, one after the other, onto the nearest grid axes; None where
    they are there. Errors: ConfigError where they are not at right angles."""
    turn, eye = None, torch.eye(3, dtype=torch.float64)
    met = {
        i: torch.tensor(p.normal, dtype=torch.float64)
        for i, p in enumerate(planes)
        if p.mode in NODE_MODES
    }
    met = {i: n / n.norm() for i, n in met.items()}
    for n in met.values():
        m = Axes(turn).vectors(n)
        along = eye[m.abs().argmax()] * m[m.abs().argmax()].sign()
        if float((m - along).norm()) > ALONG:
            S = skew(torch.linalg.cross(m, along))
            turn = Axes(eye + S + S @ S / (1 + m @ along)).gradients(eye if turn is None else turn)
    for i, n in met.items():
        if float(Axes(turn).vectors(n).abs().sort().values[1]) > ASKEW:
            raise ConfigError(
                f"plane {i} (normal {[round(c, 3) for c in n.tolist()]}, mode {planes[i].mode}): expected ground and "
                "walls at right angles, along which a grid can be, or mode touch (scene.ground.mode=touch) at others"
            )
    return turn


def shift_to(
    bounds: np.ndarray, dtype: torch.dtype, turn: Tensor | None, dx: float
) -> tuple[float, ...] | None:
    """`Axes.shift` for particles of `extent` bounds (6,) or (B, 6) and positions of a type, on a grid of dx [m], None where they
    are near the origin. Errors: ConfigError where the type has no digits for the place, or where worlds are too far apart."""
    far = float(np.abs(bounds).max())
    if not 2 * far >= 0.5 * PERIOD * dx or far == float("inf"):
        return None  # near enough in any axes; or the first substep names the particle
    low, high = bounds[..., :3].reshape(-1, 3).min(0), bounds[..., 3:].reshape(-1, 3).max(0)
    if far * torch.finfo(dtype).eps > COARSE * dx:
        raise ConfigError(
            f"x: particles are {far:.3g} m from the origin, where {dtype} has no digits for a grid of {dx:.3g} m: "
            "give x in float64, or place body, ground and solids nearer to the origin"
        )
    if bounds.ndim == 2 and (wide := float((high - low).max())) > SPREAD * PERIOD * dx:
        raise ConfigError(
            f"x: expected worlds within {SPREAD * PERIOD * dx:.3g} m of each other, found {wide:.3g} m: they never "
            "meet, and may be in one place"
        )
    center = Axes(turn).vectors(torch.from_numpy(0.5 * (low + high))).numpy()
    shift = PERIOD * dx * np.round(center / (PERIOD * dx))
    return tuple(shift.tolist()) if shift.any() else None
