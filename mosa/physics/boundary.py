"""Planes that a body meets, acting on the velocities of grid nodes, and their adjoint.

A node at or below a plane (tolerance 1e-6 m) gets: `sticky` zero velocity; `slip` no normal part; `separate` no inward normal
part, and the tangential part shrinks by Coulomb friction, |u_t| <- max(0, |u_t| - friction |u_n|).
Planes act in the order given, after gravity.
"""

import math
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError
from mosa.types import Ground

MODES = {"sticky": 0, "slip": 1, "separate": 2}


@dataclass(frozen=True)
class Plane:
    """A half space {y: (y - point).normal <= 0} that is solid. point: (3,) [m]; normal: (3,) outward, any length.

    mode: sticky | slip | separate; friction: Coulomb coefficient, for `separate`.
    """

    point: tuple[float, float, float]
    normal: tuple[float, float, float]
    mode: str = "sticky"
    friction: float = 0.0


def ground_plane(ground: Ground, up: Tensor) -> Plane:
    """The plane of a ground; up: (3,) unit vector."""
    up = torch.as_tensor(up, dtype=torch.float64).cpu()
    up = up / up.norm()
    return Plane(tuple((ground.height * up).tolist()), tuple(up.tolist()), ground.mode, ground.friction)


def pack_planes(planes: list[Plane], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """(values (P, 5): normal, offset normal.point, friction; modes (P,) int32) for the kernels.

    Errors: ConfigError naming the plane and the field.
    """
    values, modes = torch.zeros(max(len(planes), 1), 5, dtype=torch.float64), torch.zeros(max(len(planes), 1)).int()
    for i, plane in enumerate(planes):
        if plane.mode not in MODES:
            raise ConfigError(f"plane {i}: mode: expected one of {', '.join(MODES)}, found {plane.mode!r}")
        if isinstance(plane.friction, bool) or not 0 <= plane.friction < math.inf:
            raise ConfigError(f"plane {i}: friction: expected a finite number >= 0, found {plane.friction}")
        if plane.friction > 0 and plane.mode != "separate":
            raise ConfigError(f"plane {i}: friction acts on mode separate only, found mode {plane.mode!r}")
        normal = torch.tensor(plane.normal, dtype=torch.float64)
        if not normal.norm() > 0:
            raise ConfigError(f"plane {i}: normal: expected a non-zero vector, found {plane.normal}")
        normal = normal / normal.norm()
        values[i, :3] = normal
        values[i, 3] = normal @ torch.tensor(plane.point, dtype=torch.float64)
        values[i, 4] = plane.friction
        if not bool(torch.isfinite(values[i]).all()):
            raise ConfigError(f"plane {i}: expected a finite point and normal, found {plane.point} and {plane.normal}")
        modes[i] = MODES[plane.mode]
    return values.to(dtype=dtype, device=device), modes.to(device)


def make_plane_functions(scalar):
    """Warp functions (collide, adj_collide) on one node velocity, for wp.float32 or wp.float64."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def collide(u: vec3, normal: vec3, mode: int, friction: scalar):
        """Velocity of a node inside the plane after contact."""
        r = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        un = wp.dot(u, normal)
        if mode == 1:
            r = u - un * normal
        if mode == 2:
            r = u
            if un < scalar(0.0):
                t = u - un * normal
                r = t
                if friction > scalar(0.0):
                    length = wp.length(t)
                    keep = length + friction * un
                    r = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
                    if keep > scalar(0.0):
                        r = (keep / length) * t
        return r

    @wp.func
    def adj_collide(u: vec3, normal: vec3, mode: int, friction: scalar, a: vec3):
        """Transposed Jacobian of `collide` at u, applied to a."""
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        r = zero
        un = wp.dot(u, normal)
        at = a - wp.dot(a, normal) * normal
        if mode == 1:
            r = at
        if mode == 2:
            r = a
            if un < scalar(0.0):
                r = at
                if friction > scalar(0.0):
                    t = u - un * normal
                    length = wp.length(t)
                    keep = length + friction * un
                    r = zero
                    if keep > scalar(0.0):
                        d = t / length
                        along = wp.dot(d, a)
                        # r = t + friction un t/|t|
                        r = at + friction * (along * normal + (un / length) * (at - along * d))
        return r

    return collide, adj_collide


def make_normal_adjoint(scalar):
    """Warp function adj_collide_normal: transposed Jacobian of `collide` in the normal, applied to a (moving colliders)."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def adj_collide_normal(u: vec3, normal: vec3, mode: int, friction: scalar, a: vec3):
        r = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        un = wp.dot(u, normal)
        # t = u - un n:  dt = -(u.dn) n - un dn
        if mode == 1:
            r = -wp.dot(a, normal) * u - un * a
        if mode == 2:
            if un < scalar(0.0):
                at = a
                aun = scalar(0.0)
                if friction > scalar(0.0):
                    t = u - un * normal
                    length = wp.length(t)
                    keep = length + friction * un
                    at = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
                    if keep > scalar(0.0):
                        d = t / length
                        along = wp.dot(d, a)
                        # r = t + friction un t/|t|
                        at = a + (friction * un / length) * (a - along * d)
                        aun = friction * along
                r = (aun - wp.dot(at, normal)) * u - un * at
        return r

    return adj_collide_normal
