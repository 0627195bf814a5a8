"""Rigid colliders that move along a prescribed motion: what a user describes, and what the kernels get.

A collider is a shape, a mode (sticky | slip | separate | touch) with Coulomb friction, and a motion (`motion`). Its effect on
particles is in `collider_kernels`, the shapes' distances in `shapes`. A collider should be at least two grid cells thick: a
B-spline grid lets material on both sides of a thinner one touch.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact import shapes as packing
from mosa.physics.contact.keys import check_keys
from mosa.physics.contact.mesh import SignedDistanceField, field_of_mesh
from mosa.physics.contact.motion import Motion, Points, Trajectory
from mosa.physics.contact.planes import Plane, check_contact
from mosa.physics.contact.touch import GRIP


@dataclass(frozen=True)
class HalfSpace:
    """Solid below its xy plane: {q: q_z <= 0}. A plane that may move and turn."""


@dataclass(frozen=True)
class Sphere:
    """radius [m]."""

    radius: float


@dataclass(frozen=True)
class Capsule:
    """All points within `radius` [m] of a segment of `length` [m] along z, centred."""

    radius: float
    length: float


@dataclass(frozen=True)
class Cylinder:
    """radius, length [m], capped, axis z, centred."""

    radius: float
    length: float


@dataclass(frozen=True)
class Box:
    """size: (3,) full edge lengths [m], centred."""

    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Particles:
    """No solid: particles of the body itself, which the motion holds (`driven`). indices: (n,),
    None where the simulator is told them with each rollout. Such colliders come after all solids."""

    indices: Tensor | None = None


STIFFER = 2.4
"""Springs of solids that squeeze, over those of mode `touch`: plates then press with the force of the body's own law, to 1 %."""
HOLD = 1.75
"""Share of its sliding velocity that a particle loses in a substep on a solid of mode `sticky`. No friction coefficient bounds the
force there, and from 2 on a particle that is alone in its cells would go back as fast as it came, or faster."""
Shape = HalfSpace | Sphere | Capsule | Cylinder | Box | SignedDistanceField | Particles
KINDS = {HalfSpace: packing.HALF_SPACE, Sphere: packing.SPHERE, Capsule: packing.CAPSULE, Cylinder: packing.CYLINDER,
         Box: packing.BOX, SignedDistanceField: packing.FIELD, Particles: packing.SPHERE}  # fmt: skip
"""A shape of one's own goes in here, below in `_sizes`, `half_width`, `reach` and `_FIELDS`, in `keys.KEYS`, in
`shape_functions`, in `reference.signed_distance`, and to be seen in `twin.shown_solids` and `viewer.pages`."""
NOWHERE = -1e30
"""Radius [m] of the ball that stands for driven particles among the solids: nothing ever meets it.
"""


@dataclass(frozen=True)
class Collider:
    """A moving rigid solid, which particles meet at its surface, at any angle to the grid (`collider_kernels`).

    mode: how a particle that touches it slides: `sticky` not at all, `slip` freely, `separate` and `touch` with Coulomb
    `friction`. In all modes a body comes off freely. `touch` is a ground's mode of that name, softer than the others: a body loses
    less of its bounce, and plates press with too little force (docs/verification.md)."""

    shape: Shape
    mode: str = "sticky"
    friction: float = 0.0
    motion: Motion | Trajectory | Points = field(default_factory=Motion)
    name: str = ""

    def __post_init__(self) -> None:
        check_contact(f"collider {self.name}: " if self.name else "", self.mode, self.friction)


class PackedColliders(NamedTuple):
    """K colliders for the kernels, without their motion. shapes: (K, 11): size 3, friction, lattice origin 3 and spacing,
    stiffness, grip, reach; codes: (K, 5) int32: kind, lattice nodes 3, offset; fields: (M,) lattice values [m]."""

    shapes: Tensor
    codes: Tensor
    fields: Tensor

    def __len__(self) -> int:
        return len(self.codes)


def pack_colliders(
    colliders: Sequence[Collider], dtype: torch.dtype, device: torch.device
) -> PackedColliders:
    """Errors: ConfigError naming the collider and the field."""
    shapes = torch.zeros(len(colliders), packing.SHAPE_COLUMNS, dtype=torch.float64)
    codes = torch.zeros(len(colliders), packing.CODE_COLUMNS, dtype=torch.int32)
    fields, offset = [torch.zeros(1, dtype=torch.float64)], 1
    for i, collider in enumerate(colliders):
        where, shape = f"collider {collider.name or i}", collider.shape
        if type(shape) not in KINDS:
            raise ConfigError(
                f"{where}: shape: expected one of {', '.join(k.__name__ for k in KINDS)}, found {shape!r}"
            )
        if isinstance(shape, Particles):
            shapes[i, packing.SIZE] = NOWHERE
        for j, value in enumerate(_sizes(shape)):
            if not 0 < value < math.inf:
                raise ConfigError(
                    f"{where}: {type(shape).__name__}: expected positive lengths [m], found {shape}"
                )
            shapes[i, packing.SIZE + j] = value
        sticks = collider.mode == "sticky"
        shapes[i, packing.FRICTION], shapes[i, packing.HOLD] = (
            (math.inf, HOLD) if sticks else (collider.friction, GRIP)
        )
        shapes[i, packing.STIFFNESS] = 1.0 if collider.mode == "touch" else STIFFER
        codes[i, packing.KIND] = KINDS[type(shape)]
        # a little more than it is, so that rounding decides nothing
        shapes[i, packing.REACH] = math.inf if isinstance(shape, HalfSpace) else 1.01 * reach(shape)
        if isinstance(shape, SignedDistanceField):
            shapes[i, packing.ORIGIN : packing.ORIGIN + 3] = torch.as_tensor(
                shape.origin, dtype=torch.float64
            )
            shapes[i, packing.SPACING] = shape.spacing
            codes[i, packing.DIMS : packing.DIMS + 3] = torch.tensor(shape.values.shape)
            codes[i, packing.OFFSET] = offset
            fields.append(shape.values.double().cpu().reshape(-1))
            offset += shape.values.numel()
    values = torch.cat(fields)
    shapes, values = (t.to(dtype=dtype, device=device) for t in (shapes, values))
    return PackedColliders(shapes, codes.to(device), values)


def _sizes(shape: Shape) -> tuple[float, ...]:
    """[m] as `shape_functions` reads them; none of a half space, of a field, of driven particles."""
    if isinstance(shape, Sphere):
        return (shape.radius,)
    if isinstance(shape, Capsule | Cylinder):
        return (shape.radius, 0.5 * shape.length)
    if isinstance(shape, Box):
        return tuple(0.5 * edge for edge in shape.size)
    return ()


def half_width(shape: Shape) -> float:
    """Distance [m] from the surface to the deepest point inside; infinite for a half space."""
    if isinstance(shape, SignedDistanceField):
        return max(0.0, -float(shape.values.min()))
    if isinstance(shape, Capsule):
        return shape.radius
    return min(_sizes(shape), default=math.inf)


def reach(shape: Shape) -> float:
    """Distance [m] of the farthest point of the shape from its origin; 0 for a half space, whose turning has no bound."""
    if isinstance(shape, SignedDistanceField):
        origin = torch.as_tensor(shape.origin, dtype=torch.float64)
        far = origin + shape.spacing * (torch.tensor(shape.values.shape) - 1)
        return float(torch.maximum(origin.abs(), far.abs()).norm())
    sizes = _sizes(shape)
    if isinstance(shape, Capsule):
        return sum(sizes)
    return float(torch.tensor(sizes, dtype=torch.float64).norm())


def domain_walls(box: Tensor, mode: str = "separate", friction: float = 0.0) -> list[Plane]:
    """Six planes that keep a body inside box (2, 3) [m]. Errors: ConfigError naming the key of `world.walls`."""
    check_contact("world.walls.", mode, friction)
    low, high = torch.as_tensor(box).double().tolist()
    planes = []
    for axis in range(3):
        for point, sign in ((low, 1.0), (high, -1.0)):
            normal = [0.0, 0.0, 0.0]
            normal[axis] = sign
            planes.append(Plane(tuple(point), tuple(normal), mode, friction))
    return planes


_FIELDS = {"plane": (HalfSpace, ()), "sphere": (Sphere, ("radius",)), "capsule": (Capsule, ("radius", "length")),
           "cylinder": (Cylinder, ("radius", "length")), "box": (Box, ("size",)), "mesh": (None, ("path",))}  # fmt: skip
_COMMON = ("type", "name", "mode", "friction", "position", "rotation", "motion")


def colliders_from_config(
    items: Sequence[Mapping[str, Any] | Collider], field_name: str = "world.colliders"
) -> tuple[Collider, ...]:
    """Colliders of plain containers, as a YAML file has them; a `Collider` is passed on.

    Each: type: plane | sphere | capsule | cylinder | box | mesh, with radius, length [m], size (3 edges) [m], or path (OBJ, PLY, or
    STL, which needs trimesh; with spacing [m] of the lattice, and scale); plane takes `normal` instead of rotation; mode, friction,
    name; position (3,) [m]; rotation (ax, ay, az, degrees); motion: {velocity, angular_velocity [rad/s], times} or
    {waypoints: [{time, position, rotation}, ...]}. Errors: ConfigError naming the entry and the field."""
    if isinstance(items, Mapping | str) or not isinstance(items, Sequence):
        raise ConfigError(f"{field_name}: expected a list of colliders, found {items!r}")
    return tuple(
        item if isinstance(item, Collider) else collider_of(item, f"{field_name}[{i}]")
        for i, item in enumerate(items)
    )


def collider_of(item: Mapping, where: str) -> Collider:
    """Of one entry of `colliders_from_config`; where: it, for messages. Errors: ConfigError."""
    if not isinstance(item, Mapping):
        raise ConfigError(f"{where}: expected type and the keys of that type, found {item!r}")
    kind = item.get("type")
    if not isinstance(kind, str) or kind not in _FIELDS:
        raise ConfigError(f"{where}.type: expected one of {', '.join(_FIELDS)}, found {kind!r}")
    make, needed = _FIELDS[kind]
    extra = {"plane": ("normal",), "mesh": ("spacing", "scale", "margin")}.get(kind, ())
    if unknown := [key for key in item if key not in (*_COMMON, *needed, *extra)]:
        raise ConfigError(
            f"{where}: unknown: {', '.join(unknown)}; a {kind} takes {', '.join((*needed, *extra, *_COMMON[1:]))}"
        )
    if missing := [key for key in needed if item.get(key) is None]:
        raise ConfigError(f"{where}: a {kind} needs {', '.join(missing)}")
    check_keys(item, where)
    item = {key: value for key, value in item.items() if value is not None}
    try:
        if kind == "mesh":
            options = {key: float(item[key]) for key in extra if item.get(key) is not None}
            shape = field_of_mesh(Path(item["path"]), **options)
        else:
            shape = make(
                *(tuple(map(float, item[k])) if k == "size" else float(item[k]) for k in needed)
            )
        contact = {key: item[key] for key in ("mode", "friction", "name") if key in item}
        return Collider(shape, motion=_motion(item), **contact)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def _motion(item: dict) -> Motion:
    motion = {key: value for key, value in (item.get("motion") or {}).items() if value is not None}
    rotation = item.get("rotation")
    if item.get("normal") is not None:
        if rotation is not None:
            raise ConfigError("normal and rotation: expected one of them")
        rotation = _turn_to(item["normal"])
    else:
        rotation = axis_degrees(rotation)
    if "waypoints" in motion:
        points = motion.pop("waypoints")
        if motion or item.get("position") is not None:
            raise ConfigError(
                "motion: waypoints stand alone, without position, velocity or angular_velocity"
            )
        given = [p.get("rotation") for p in points]
        turns = [rotation if turn is None else axis_degrees(turn) for turn in given]
        return Motion.waypoints(
            [p["time"] for p in points], [p["position"] for p in points], torch.stack(turns)
        )
    return Motion(item.get("position", (0.0, 0.0, 0.0)), rotation, **motion)


TURNS = (30, 45, 60, 90, 120, 135, 180, 270, 360)
"""[degrees] whose radians are asked about."""


def warn_of_radians(where: str, angle: float, stacklevel: int) -> None:
    """Of an angle [degrees] that is one of `TURNS` in radians."""
    for each in TURNS:
        if abs(abs(angle) / math.radians(each) - 1) < 1e-3:
            warnings.warn(
                f"{where}: expected degrees, found {angle:g}, which is {each} degrees in radians",
                stacklevel=stacklevel,
            )


def axis_degrees(value: Sequence[float] | Tensor | None) -> Tensor:
    """Rotation vector (3,) [rad] of (ax, ay, az, degrees). Errors: ConfigError, also for a
    quaternion: four numbers of norm 1 whose first three are no unit axis (0.05 to 0.99)."""
    if value is None:
        return torch.zeros(3, dtype=torch.float64)
    value = torch.as_tensor(value, dtype=torch.float64)
    if value.shape != (4,) or not float(value[:3].norm()) > 0:
        raise ConfigError(
            f"rotation: expected (ax, ay, az, degrees) with a non-zero axis, found {value.tolist()}"
        )
    if abs(float(value.norm()) - 1) < 1e-3 and 0.05 < float(value[:3].norm()) < 0.99:
        raise ConfigError(
            f"rotation: expected (ax, ay, az, degrees), found {value.tolist()}, a quaternion by "
            "its norm of 1"
        )
    if float(value[3]) == 0 and int((value != 0).sum()) > 1 and abs(float(value.norm()) - 1) < 1e-3:
        told = f"rotation: {value.tolist()} turns by 0 degrees: was it a quaternion?"
        warnings.warn(told, stacklevel=5)
    warn_of_radians("rotation", float(value[3]), stacklevel=6)
    return value[:3] / value[:3].norm() * torch.deg2rad(value[3])


def _turn_to(normal: Sequence[float]) -> Tensor:
    """Rotation vector (3,) that turns z to `normal`, the shortest way."""
    n = torch.as_tensor(normal, dtype=torch.float64)
    n = n / n.norm()
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    axis, cosine = torch.linalg.cross(z, n), z @ n
    if float(axis.norm()) == 0:
        return torch.tensor([0.0 if cosine > 0 else torch.pi, 0.0, 0.0], dtype=torch.float64)
    return axis / axis.norm() * torch.atan2(axis.norm(), cosine)
