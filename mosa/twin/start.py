"""What a user says about the start of a motion, checked and made a start in a world."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Gt, Le
from scipy.spatial.transform import Rotation
from torch import Tensor

from mosa.config.record import is_rotation
from mosa.errors import ConfigError
from mosa.modules.body.body import VARIANTS, Body, Start, World
from mosa.physics.contact.colliders import (
    HOLD,
    Collider,
    HalfSpace,
    Particles,
    axis_degrees,
    colliders_from_config,
    half_width,
    reach,
)
from mosa.physics.contact.driven import driven_from_config
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.motion import pose_at
from mosa.physics.contact.overlap import HUGE, check_clear
from mosa.physics.contact.reference import signed_distance
from mosa.physics.contact.touch import GRIP
from mosa.physics.engine.inputs import FASTEST, numbers, vector, without_gradients
from mosa.settings import Expected, Number, Settings, such
from mosa.system.limits import counted
from mosa.twin.rollout_file import poses
from mosa.twin.shown_solids import surface
from mosa.types import Rollout, metres

UNDER = 0.25
"""Share of a body that may start below the ground, by a quarter of its spacing: pressed against it, it has less."""
STORED_BYTES = 4 * (3 + 3 + 9 + 9)
"""Of a particle in a frame of a rollout: x, v, F, F_tot."""
LARGE = 50.0
"""A mesh's length, a solid's distance and a height, over the body's size, from which their unit is doubted."""
BESIDE = 0.5
"""Of the body's size, from which a solid is too far away to be meant."""
CREEP = 5e-3
"""[m/s] of a held body from which the number of substeps is doubted."""


Variant = Annotated[str, Expected(f"one of {', '.join(VARIANTS)}"), such(lambda v: v in VARIANTS)]
Seconds = Annotated[float, Gt(0), Le(1)]


class StartArguments(Settings):
    """A start by name, as one of many worlds has it."""

    rotation: Any = None
    height: Number | None = None
    position: Any = None
    velocity: Any = None
    angular_velocity: Any = None


def check_frames(frames: int, particles: int) -> None:
    """Errors: ConfigError where they are more than the machine can hold."""
    said = "frames times particles, of which this machine can hold fewer"
    counted("frames", (frames, particles), said, each=STORED_BYTES)


def check_wants_no_gradients(**given: Any) -> None:
    """Nothing among the arguments of a motion without gradients asks for one: it would wait for it in vain, and be told nothing.
    Errors: ConfigError naming the argument. Under `torch.no_grad()` nothing asks."""
    if not torch.is_grad_enabled():
        return
    for name, value in given.items():
        if asks_for_gradients(value):
            raise ConfigError(
                f"{name}: expected a tensor without gradients, found one that requires them: use "
                "reset(differentiable=True) and step, or tensor.detach()"
            )


def asks_for_gradients(value: Any) -> bool:
    """Whether a tensor does, among lists, entries of a mapping and parts of a collider too."""
    if isinstance(value, Tensor):
        return value.requires_grad
    if isinstance(value, Mapping):
        return any(map(asks_for_gradients, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(asks_for_gradients, value))
    if is_dataclass(value) and not isinstance(value, type):
        return any(asks_for_gradients(getattr(value, field.name)) for field in fields(value))
    return False


def placed(position: Sequence[float | None] | Tensor, center: Tensor) -> Tensor:
    """(3,) the centre with the numbers of `position` that are not None. Errors: ConfigError."""
    if isinstance(position, Sequence) and not isinstance(position, str) and len(position) == 3:
        kept = [number is None for number in position]
        found = vector("position", [0.0 if number is None else number for number in position]).to(
            center
        )
        return torch.where(torch.tensor(kept, device=center.device), center, found)
    return vector("position", position).to(center)


def rotation_matrix(value: Sequence[float] | Tensor) -> Tensor:
    """(3, 3) from (ax, ay, az, degrees) or a matrix. Errors: ConfigError for anything else, and a matrix that is no rotation."""
    expected = "(ax, ay, az, degrees) with a non-zero axis or a 3x3 rotation matrix"
    value = numbers("rotation", value, expected)
    if value.shape == (3, 3):
        if not is_rotation(value.tolist()):
            raise ConfigError(
                f"rotation: expected R R^T = I and det R = 1, found {value.tolist()}: scaled, sheared or mirrored bodies are not "
                "what was learned"
            )
        return value
    turn = axis_degrees(value.cpu()).numpy()
    return torch.tensor(Rotation.from_rotvec(turn).as_matrix(), dtype=torch.float32)


def box_around(value: Sequence[Sequence[float]] | Tensor) -> Tensor:
    """(2, 3) [m] the corners of a box. Errors: ConfigError."""
    expected = f"[low, high] corners, (2, 3) finite numbers within {FASTEST:g} [m] with low below high on every axis"
    result = numbers("box", value, expected, (2, 3), most=FASTEST).detach()
    if not bool((result[0] < result[1]).all()):
        raise ConfigError(f"box: expected {expected}, found {str(value)[:120]}")
    return result


def start_in(
    body: Body, world: World, first: Start, *, rotation=None, height=None, position=None, velocity=None, angular_velocity=None,
    colliders=None, box=None, driven=None, gravity=None,
) -> tuple[Start, World]:  # fmt: skip
    """(the start, the world with its colliders and box) of arguments as `Twin.simulate` takes them, None for those of `first`.

    Errors: ConfigError naming the argument."""
    Q = first.rotation if rotation is None else rotation_matrix(rotation)
    Q = Q.to(body.rest)
    velocity_ = first.velocity if velocity is None else vector("velocity", velocity)
    given = angular_velocity is not None
    spin = vector("angular_velocity", angular_velocity) if given else first.angular_velocity
    center = first.center.to(body.rest)
    if position is not None:
        center = placed(position, center)
    up = world.up.to(body.rest)
    arms = (body.rest - body.center) @ Q.T
    if height is not None:
        k = int(up.abs().argmax())
        if isinstance(position, (list, tuple)) and position[k] is not None:
            said = f"None for {'xyz'[k]} beside height={height:g}, found {position[k]}"
            raise ConfigError(f"position: expected {said}")
        if height < 0 and world.ground is not None:
            raise ConfigError(f"height: expected metres above the ground, >= 0, found {height:g}")
        ground, low = world.ground.height if world.ground is not None else 0.0, arms @ up
        # it is met by balls, where it was found to be
        if world.ground is not None and world.ground.mode == "touch":
            lift = body.contact.lift(world.ground, body.settings.dx).detach()
            low = low - 0.5 * body.volume.to(low) ** (1 / 3) + lift
        center = center + up * (ground + height - low.min() - center @ up)
        if height > LARGE * body.size:
            warnings.warn(
                f"height: expected metres above the ground, found {height:g} m for a body of {body.size:.3g} m",
                stacklevel=4,
            )
    start = Start(Q, center, velocity_.to(body.rest), spin.to(body.rest))
    x = (center + arms).detach()
    if colliders is not None:
        world = replace(world, colliders=colliders_from_config(colliders, "colliders"))
    if driven is not None:
        world = replace(world, driven=driven_from_config(driven, "driven"))
    if gravity is not None:
        pull = without_gradients("gravity", vector("gravity", gravity))
        world = replace(world, gravity=pull.to(world.gravity))
    if box is not None:
        world = replace(world, box=box_around(box).to(world.box))
        low, high = world.box.to(arms)
        outside = float(((x < low) | (x > high)).any(1).double().mean())
        if outside > 0:
            raise ConfigError(
                f"box: expected one that the body starts in, found {outside:.0%} of it outside of "
                f"{metres(world.box)} m; its centre is at {metres(center)} m"
            )
    warn_of_solids(body, world, x, center.detach().cpu(), own=colliders is None)
    if float(world.gravity @ world.up) > 0:
        warnings.warn(f"gravity: {metres(world.gravity)} m/s^2 points up", stacklevel=4)
    if world.ground is not None:
        lowest = world.ground.height - 0.25 * body.spacing
        below = float((x @ up < lowest).double().mean())
        if below > UNDER:
            raise ConfigError(
                f"position: expected a body that starts above the ground of {world.ground.height:g} m, "
                f"found {below:.0%} of it below (height is that of its lowest point above the ground)"
            )
    return start, world


def warn_of_solids(body: Body, world: World, x: Tensor, center: Tensor, own: bool) -> None:
    """Warns of solids that press on the body at its start, lie below the ground, or whose lengths can hardly be metres. x: (N, 3),
    center: (3,) [m] particles and centre at the start; own: whether the run has these solids. Errors: ConfigError for a solid
    that the body is inside of."""
    field = "world.colliders" if own else "colliders"
    hint = "it comes with the twin's run: colliders=[] leaves it out" if own else ""
    pressed = check_clear(world.colliders, x, "the body", field, body.spacing, hint=hint)
    if pressed > 0.25 * body.spacing:
        warnings.warn(
            f"{field}: expected a solid that the body is clear of, found it {1e3 * pressed:.3g} "
            "mm deep in a contact, which throws it off at once: contact begins "
            f"{500 * body.spacing:.3g} mm, half the particles' spacing, outside of a solid",
            stacklevel=5,
        )
    for i, each in enumerate(world.colliders):
        if isinstance(each.shape, (HalfSpace, Particles)):
            continue
        expected, far = f"{field}[{i}]: expected a", LARGE * body.size
        away = float((pose_at(each.motion)[0] - center).norm()) - reach(each.shape)
        if (deep := buried(each, world)) > 0:
            said = f"above the ground, found its highest point {deep:.3g} m below it"
            warnings.warn(f"{expected} solid {said}: up is {metres(world.up)}", stacklevel=5)
        if isinstance(each.shape, SignedDistanceField) and (size := each.shape.longest_side) > far:
            warnings.warn(
                f"{expected} mesh about as large as the body of {body.size:.3g} m, "
                f"found {size:.3g} m: set scale (0.001 for a file in mm), or spacing [m] if it is",
                stacklevel=5,
            )
        elif away > far or half_width(each.shape) > HUGE * body.size:
            thick = f"one {2 * half_width(each.shape):.3g} m thick"
            warnings.warn(
                f"{expected} solid within reach of the body of {body.size:.3g} m, found "
                f"{f'it {away:.3g} m away' if away > far else thick}: lengths are in metres",
                stacklevel=5,
            )


def warn_of_creep(body: Body, world: World, frame_dt: float, substeps: int | None) -> None:
    """Warn where two or more solids may hold the body by friction, and it would slide down faster
    than `CREEP`. Contact takes a share of a particle's sliding velocity in a substep: the speed
    grows with the substep (docs/verification.md). substeps: None where they are chosen."""
    rough = [each for each in world.colliders if each.mode == "sticky" or each.friction > 0]
    rough = [each for each in rough if not isinstance(each.shape, HalfSpace)]
    holds = [HOLD if each.mode == "sticky" else GRIP for each in rough]
    if len(holds) < 2 or substeps is None:
        return
    pull = float(world.gravity.norm()) * body.size / (min(holds) * body.spacing)
    speed, enough = pull * frame_dt / substeps, math.ceil(pull * frame_dt / CREEP)
    if speed > CREEP:
        warnings.warn(
            "substeps: solids that hold the body by friction let it slide at about "
            f"{1e3 * speed:.2g} mm/s with {substeps} substeps by its weight alone; substeps={enough} give "
            f"{1e3 * CREEP:.2g} mm/s. A squeezed body needs more: double them until the motion stays",
            stacklevel=4,
        )


def warn_of_unmet(
    motions: Sequence[Rollout], solids: Sequence[Collider], body: Body, world: World
) -> None:
    """Warn of solids that feel nothing in all motions of a body and stay `BESIDE` it."""
    told = []
    for k, solid in enumerate(solids):
        felt = (m.reactions is not None and bool(m.reactions[..., k, :].any()) for m in motions)
        if isinstance(solid.shape, (HalfSpace, Particles)) or any(felt):
            continue
        away = math.inf
        for motion in motions:
            places = (part[:, 0] for part in poses([solid], motion.times))
            for x, at, turned in zip(motion.x, *places):
                q = (x.detach().cpu().double() - at) @ turned
                d = signed_distance(solid.shape, q)  # far from a mesh 1e30
                away = min(away, float(d.where(d < 1e29, q.norm(dim=1) - reach(solid.shape)).min()))
        if BESIDE * body.size < away < LARGE * body.size and not buried(solid, world):
            told.append(f"{solid.name or f'colliders[{k}]'} never nearer than {away:.2g} m")
    if told:
        said = f"expected solids that the body comes to, found {', '.join(told)}"
        warnings.warn(f"colliders: {said}", stacklevel=4)


@torch.no_grad()
def buried(solid: Collider, world: World) -> float:
    """How far [m] the highest point of a solid at its start is below the ground; 0 where it is not."""
    if world.ground is None:
        return 0.0
    at, turned = (part[0, 0] for part in poses([solid], torch.zeros(1)))
    points = surface(solid.shape, 0.1 * reach(solid.shape)).double() @ turned.mT + at
    deep = world.ground.height - float((points @ world.up.double().cpu()).max())
    return deep if deep > 0.05 * half_width(solid.shape) else 0.0


class Crossings:
    """Warns of each pair of solids that comes to overlap, once: what is between them is pressed through them."""

    def __init__(self, solids: Sequence[Collider]) -> None:
        endless = HalfSpace, Particles
        self.solids = {k: s for k, s in enumerate(solids) if not isinstance(s.shape, endless)}
        self.points: dict[int, Tensor] = {}
        self.known: set[tuple[int, int]] | None = None

    @torch.no_grad()
    def look(self, position: Tensor, rotation: Tensor) -> None:
        """position: (K, 3) [m], rotation: (K, 3, 3) float64, first at the start."""
        found: dict[tuple[int, int], float] = {}
        for i, j in itertools.combinations(self.solids, 2):
            shapes = [self.solids[k].shape for k in (i, j)]
            if float((position[i] - position[j]).norm()) > sum(map(reach, shapes)):
                continue
            inside = [self._inside(k, l, position, rotation) for k, l in ((i, j), (j, i))]
            if max(inside) > 0.1 * min(map(half_width, shapes)):
                found[i, j] = max(inside)
        for i, j in found.keys() - self.known if self.known is not None else ():
            names = " and ".join(self.solids[k].name or str(k) for k in (i, j))
            warnings.warn(
                f"colliders: expected solids that stay apart, found {names} "
                f"{1e3 * found[i, j]:.3g} mm inside each other: they press what is between them "
                "with any force",
                stacklevel=4,
            )
        self.known = (self.known or set()) | set(found)

    def _inside(self, k: int, l: int, position: Tensor, rotation: Tensor) -> float:
        """How deep [m] solid k reaches into solid l."""
        shape = self.solids[k].shape
        if k not in self.points:
            pitch = max(0.1 * reach(shape), 0.7 * half_width(shape))
            self.points[k] = surface(shape, pitch).double()
        at = (self.points[k] @ rotation[k].mT + position[k] - position[l]) @ rotation[l]
        return -float(signed_distance(self.solids[l].shape, at).min())


@torch.no_grad()
def as_started(body: Body, start: Start, places: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """(points [m], velocities [m/s]), (M, 3) both, float64, of places (M, 3) [m] of the rest shape at a start."""
    Q, spin = start.rotation.to(places), start.angular_velocity.to(places)
    arm = (places - body.center) @ Q.T
    moving = start.velocity.to(arm) + torch.linalg.cross(spin.expand_as(arm), arm)
    points = arm + start.center.to(arm)
    return points.double().cpu().numpy(), moving.double().cpu().numpy()
