"""Planes that a body meets, acting on the velocities of grid nodes, and their adjoint.

A node at or below a plane (tolerance 1e-6 m) gets: `sticky` zero velocity; `slip` no normal part; `separate` no inward normal
part, and the tangential part shrinks by Coulomb friction, |u_t| <- max(0, |u_t| - friction |u_n|).
Above it, up to the plane's `thickness`, the change of velocity counts with a weight that fades to 0 (`make_fade`), and that is the
smaller the faster a node comes or goes (`make_slowness`).
Planes act in the order given, after gravity. One with mode `touch` is not met by nodes, but by particles (`touch`).

Why friction needs a thickness: an elastic body without damping that is shaken, as a block is that is released suddenly on an
incline, opens and closes its contact as it vibrates, and each time it slides a little. Such sliding feeds the vibration (a
mode-coupling instability), so the block creeps down an incline on which it should stay. Finite elements with Coulomb's law at
their nodes do so too: it is the undamped model's own motion. Real contacts damp; this one does where it fades in, since what
approaches is slowed before it is stopped. Only what is slow: an impact would be felt a cell early and lose its bounce, by an
amount that depends on dx. The price is that slow rolling is damped as well.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.touch import TOUCH
from mosa.settings import Expected, Weight, arguments_of, check, is_number
from mosa.types import RUBBING, Ground

Triple = Annotated[tuple[float, float, float], Expected("a tuple of three finite numbers")]
NODE_MODES = {"sticky": 0, "slip": 1, "separate": 2}
"""How nodes of a grid meet a plane."""
MODES = NODE_MODES | {"touch": TOUCH}
THICKNESS = 1.4
"""Cells: of a contact whose thickness is not given. With it a shaken block stays (docs/verification.md)."""
WHOLE = 0.45
"""Share of the thickness, next to the surface, in which a node is in contact as those inside are."""

SLOW = 0.05
"""m/s: of a node along a plane's normal, at which the contact above the plane counts half. What shakes a resting body moves at
g H/c, hundredths of it for the softest; a tenth of a second's fall is twenty times as fast."""
TOUCHING = 1e-6
"""m: above a plane, where a node counts as inside."""


@dataclass(frozen=True)
class Plane:
    """A half space {y: (y - point).normal <= 0} that is solid. point: (3,) [m]; normal: (3,) outward, any length.

    mode: sticky | slip | separate | touch; friction: Coulomb coefficient, for separate and touch; thickness [m]: over this
    distance above the plane the contact with what is slow fades in; None: `THICKNESS` cells where there is friction, else 0.
    """

    point: Triple
    normal: Triple
    mode: str = "sticky"
    friction: float = 0.0
    thickness: Weight | None = None

    def __post_init__(self) -> None:
        """Errors: ConfigError naming the field."""
        arguments_of(Plane, "plane").read(vars(self))
        check_contact("plane.", self.mode, self.friction)
        if not any(self.normal):
            raise ConfigError(f"plane.normal: expected a non-zero vector, found {self.normal}")


def ground_plane(ground: Ground, up: Tensor) -> Plane:
    """The plane of a ground; up: (3,) unit vector."""
    up = torch.as_tensor(up, dtype=torch.float64).cpu()
    up = up / up.norm()
    check("ground.height", ground.height, float)
    check_contact("ground.", ground.mode, ground.friction)
    return Plane(
        tuple((ground.height * up).tolist()), tuple(up.tolist()), ground.mode, ground.friction
    )


def check_contact(where: str, mode: str, friction: float) -> None:
    """Of a plane or a solid; where: it, as the message begins. Errors: ConfigError."""
    if mode not in MODES:
        raise ConfigError(f"{where}mode: expected one of {', '.join(MODES)}, found {mode!r}")
    if not (is_number(friction) and friction >= 0):
        raise ConfigError(f"{where}friction: expected a finite number >= 0, found {friction}")
    check_rubbing(where, mode, friction)


def check_rubbing(where: str, mode: str, friction: float) -> None:
    """Errors: ConfigError for friction in a mode without."""
    if friction > 0 and mode not in RUBBING:
        raise ConfigError(
            f"{where}friction: acts on modes {' and '.join(RUBBING)} only, found mode {mode!r}"
        )


def pack_planes(
    planes: list[Plane], dtype: torch.dtype, device: torch.device, dx: float
) -> tuple[Tensor, Tensor]:
    """(values (P, 6): normal, offset normal.point, friction, thickness; modes (P,) int32) for the kernels. dx [m]: of the grid."""
    values = torch.zeros(max(len(planes), 1), 6, dtype=torch.float64)
    modes = torch.zeros(max(len(planes), 1)).int()
    for i, plane in enumerate(planes):
        thickness = plane.thickness
        if thickness is None:
            thickness = THICKNESS * dx if plane.friction > 0 and plane.mode != "touch" else 0.0
        normal = torch.tensor(plane.normal, dtype=torch.float64)
        normal = normal / normal.norm()
        values[i, :3] = normal
        values[i, 3] = normal @ torch.tensor(plane.point, dtype=torch.float64)
        values[i, 4], values[i, 5] = plane.friction, thickness
        modes[i] = MODES[plane.mode]
    return values.to(dtype=dtype, device=device), modes.to(device)


def make_fade(scalar):
    """Warp function fade(phi, thickness): weight of the contact of a node at distance phi [m]."""
    whole, rest = WHOLE, 1.0 - WHOLE

    @wp.func
    def fade(phi: scalar, thickness: scalar):
        w = scalar(0.0)
        if phi <= wp.max(scalar(wp.static(TOUCHING)), scalar(wp.static(whole)) * thickness):
            w = scalar(1.0)
        elif phi < thickness:
            s = (phi / thickness - scalar(wp.static(whole))) / scalar(wp.static(rest))
            w = (scalar(1.0) - s) * (scalar(1.0) - s) * (scalar(1.0) + scalar(2.0) * s)
        return w

    return fade


def make_slowness(scalar):
    """Warp function slowness(speed): (share that a contact above a plane has at this speed along the normal [m/s], its slope)."""

    @wp.func
    def slowness(speed: scalar):
        q = speed / scalar(wp.static(SLOW))
        share = scalar(1.0) / (scalar(1.0) + q * q)
        return share, scalar(-2.0) * q * share * share / scalar(wp.static(SLOW))

    return slowness


def make_plane_functions(scalar):
    """Warp functions (collide, adj_collide) on one node velocity, for wp.float32 or wp.float64."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def collide(u: vec3, normal: vec3, mode: int, friction: scalar):
        """Velocity of a node inside the plane after contact."""
        r = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        un = wp.dot(u, normal)
        if mode == TOUCH:
            r = u
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
        if mode == TOUCH:
            r = a
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
