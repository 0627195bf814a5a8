"""Rigid colliders that move along a prescribed motion: what a user describes, and what the kernels get.

A collider is a shape, a mode (sticky | slip | separate) with Coulomb friction, and a motion (`motion`). Its effect on the
grid is in `collider_kernels`, the shapes' distances in `shapes`. A collider should be at least two grid cells thick: a
B-spline grid lets material on both sides of a thinner one touch.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact import shapes as packing
from mosa.physics.contact.keys import check_keys
from mosa.physics.contact.mesh import SignedDistanceField, field_of_mesh
from mosa.physics.contact.motion import Motion, Trajectory
from mosa.physics.contact.planes import NODE_MODES, THICKNESS, Plane
from mosa.schema import is_number


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


SMOOTH = 0.25
"""Cells: a contact that fades in over them joins a node smoothly enough for a gradient; over none it does so by a jump."""
DEEP, KEPT = 1.8, 0.6
"""Cells from particles that a solid keeps off, by the share `KEPT` of its thickness, to its middle, from which on nodes there no
longer matter (a particle's weights reach 1.5 cells): measured with plates of 0.5 to 5 cells, docs/twin.md, Gradients."""
Shape = HalfSpace | Sphere | Capsule | Cylinder | Box | SignedDistanceField
KINDS = {HalfSpace: packing.HALF_SPACE, Sphere: packing.SPHERE, Capsule: packing.CAPSULE, Cylinder: packing.CYLINDER,
         Box: packing.BOX, SignedDistanceField: packing.FIELD}  # fmt: skip


@dataclass(frozen=True)
class Collider:
    """A moving rigid solid. mode, friction: as for a plane, relative to the solid's velocity at the node.

    thickness [m]: over this distance above the surface the contact fades in: whole in the share `planes.WHOLE` of it next to
    the surface, then falling to nothing, at any speed (a plane's is with what is slow alone). None: `planes.THICKNESS` cells of
    the grid (of a mesh at most its margin). Plates then squeeze a body with the force of its own law, whatever dx, and a shaken
    block stays where friction holds it; but an impact is felt up to a cell and a half early, and rolling is braked. 0: a node is
    in contact or not, as for planes without friction; a ball rolls as it should, and each plate squeezes a body by about a quarter
    of a cell less than its stroke. With a thickness the result is differentiable in the collider's position also where its surface
    is flat; with 0 a node that changes sides is a jump that no gradient sees, and positions act through curvature, lever arms and
    velocities only. The fade is per substep: a node of small weight still comes to a stop within as many substeps as its weight is
    small.
    """

    shape: Shape
    mode: str = "sticky"
    friction: float = 0.0
    motion: Motion | Trajectory = field(default_factory=Motion)
    thickness: float | None = None
    name: str = ""


class PackedColliders(NamedTuple):
    """K colliders for the kernels, without their motion. shapes: (K, 9): size 3, thickness, friction, lattice origin 3 and spacing;
    codes: (K, 6) int32: kind, mode, lattice nodes 3, offset; fields: (M,) lattice values [m]."""

    shapes: Tensor
    codes: Tensor
    fields: Tensor

    def __len__(self) -> int:
        return len(self.codes)


def thickness_on(collider: Collider, dx: float) -> float:
    """[m] of its contact on a grid of spacing dx [m]: its own, or the one of a collider without any."""
    if collider.thickness is not None:
        return collider.thickness
    usual = THICKNESS * dx
    return min(usual, collider.shape.margin) if isinstance(collider.shape, SignedDistanceField) else usual


def differentiable_thickness(collider: Collider, dx: float) -> float:
    """[m], on a grid of spacing dx [m]: from which on the gradient in the collider's pose and velocity is what differences of a
    per cent find, to a few per cent of it (docs/twin.md, Gradients).

    Where it is thinner, nodes change their velocity by a jump as the solid passes over them, which no derivative sees: at the
    surface where nothing fades in; and inside of the solid where the nearest face becomes another one, in modes that act along
    its normal alone. Those nodes matter as long as they carry mass of particles outside: behind the middle of a thin solid, and
    next to the edges of boxes, cylinders and meshes. Half spaces have none inside, and spheres a single point.
    """
    shape, least = collider.shape, SMOOTH * dx
    if collider.mode == "sticky" or isinstance(shape, HalfSpace | Sphere):
        return least
    least = max(least, (DEEP * dx - half_width(shape)) / KEPT)
    return least if isinstance(shape, Capsule) else max(least, THICKNESS * dx)


def half_width(shape: Shape) -> float:
    """Distance [m] from the surface to the deepest point inside; infinite for a half space."""
    if isinstance(shape, SignedDistanceField):
        return max(0.0, -float(shape.values.min()))
    if isinstance(shape, Capsule):
        return shape.radius
    return min(_sizes(shape), default=math.inf)


def pack_colliders(colliders: Sequence[Collider], dtype: torch.dtype, device: torch.device, dx: float) -> PackedColliders:
    """dx [m]: of the grid. Errors: ConfigError naming the collider and the field."""
    shapes = torch.zeros(len(colliders), packing.SHAPE_COLUMNS, dtype=torch.float64)
    codes = torch.zeros(len(colliders), packing.CODE_COLUMNS, dtype=torch.int32)
    fields, offset = [torch.zeros(1, dtype=torch.float64)], 1
    for i, collider in enumerate(colliders):
        where, shape = f"collider {collider.name or i}", collider.shape
        if type(shape) not in KINDS:
            raise ConfigError(f"{where}: shape: expected one of {', '.join(k.__name__ for k in KINDS)}, found {shape!r}")
        if collider.mode not in NODE_MODES:
            raise ConfigError(f"{where}: mode: expected one of {', '.join(NODE_MODES)}, found {collider.mode!r}")
        given, thickness = collider.thickness, thickness_on(collider, dx)
        for name, value in (("friction", collider.friction), ("thickness", thickness)):
            if isinstance(value, bool) or not 0 <= value < math.inf:
                raise ConfigError(f"{where}: {name}: expected a finite number >= 0, found {value}")
        if collider.friction > 0 and collider.mode != "separate":
            raise ConfigError(f"{where}: friction acts on mode separate only, found mode {collider.mode!r}")
        for j, value in enumerate(_sizes(shape)):
            if not 0 < value < math.inf:
                raise ConfigError(f"{where}: {type(shape).__name__}: expected positive lengths [m], found {shape}")
            shapes[i, packing.SIZE + j] = value
        shapes[i, packing.THICKNESS], shapes[i, packing.FRICTION] = thickness, collider.friction
        codes[i, packing.KIND], codes[i, packing.MODE] = KINDS[type(shape)], NODE_MODES[collider.mode]
        if isinstance(shape, SignedDistanceField):
            if given is not None and shape.margin < thickness:
                raise ConfigError(
                    f"{where}: thickness: the field of the mesh reaches {shape.margin:.3g} m beyond it, less than {thickness}: "
                    "make it with a larger margin"
                )
            shapes[i, packing.ORIGIN : packing.ORIGIN + 3] = torch.as_tensor(shape.origin, dtype=torch.float64)
            shapes[i, packing.SPACING] = shape.spacing
            codes[i, packing.DIMS : packing.DIMS + 3] = torch.tensor(shape.values.shape)
            codes[i, packing.OFFSET] = offset
            fields.append(shape.values.double().cpu().reshape(-1))
            offset += shape.values.numel()
    values = torch.cat(fields)
    return PackedColliders(shapes.to(dtype=dtype, device=device), codes.to(device), values.to(dtype=dtype, device=device))


def _sizes(shape: Shape) -> tuple[float, ...]:
    if isinstance(shape, Sphere):
        return (shape.radius,)
    if isinstance(shape, Capsule | Cylinder):
        return (shape.radius, 0.5 * shape.length)
    if isinstance(shape, Box):
        return tuple(0.5 * edge for edge in shape.size)
    return ()


def reach(shape: Shape) -> float:
    """Distance [m] of the farthest point of the shape from its origin; 0 for a half space, whose turning has no bound."""
    if isinstance(shape, SignedDistanceField):
        origin = torch.as_tensor(shape.origin, dtype=torch.float64)
        far = origin + shape.spacing * (torch.tensor(shape.values.shape) - 1)
        return float(torch.maximum(origin.abs(), far.abs()).norm())
    sizes = _sizes(shape)
    return sum(sizes) if isinstance(shape, Capsule) else float(torch.tensor(sizes, dtype=torch.float64).norm())


def domain_walls(box: Tensor, mode: str = "separate", friction: float = 0.0) -> list[Plane]:
    """Six planes that keep a body inside box (2, 3) [m]. Errors: ConfigError naming the key of `world.walls`."""
    if not isinstance(mode, str) or mode not in NODE_MODES:
        raise ConfigError(f"world.walls.mode: expected one of {', '.join(NODE_MODES)}, found {mode!r}")
    if not is_number(friction) or friction < 0:
        raise ConfigError(f"world.walls.friction: expected a finite number >= 0, found {friction!r}")
    if friction > 0 and mode != "separate":
        raise ConfigError(f"world.walls.friction: acts with mode separate only, found mode {mode!r}")
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
_COMMON = ("type", "name", "mode", "friction", "thickness", "position", "rotation", "motion")


def colliders_from_config(items: Sequence[dict | Collider], field_name: str = "world.colliders") -> tuple[Collider, ...]:
    """Colliders of plain containers, as a YAML file has them; a `Collider` is passed on.

    Each: type: plane | sphere | capsule | cylinder | box | mesh, with radius, length [m], size (3 edges) [m], or path (OBJ or PLY,
    with spacing [m] of the lattice, and scale); plane takes `normal` instead of rotation; mode, friction, thickness, name;
    position (3,) [m]; rotation (ax, ay, az, degrees); motion: {velocity, angular_velocity [rad/s], times} or
    {waypoints: [{time, position, rotation}, ...]}. Errors: ConfigError naming the entry and the field.
    """
    if isinstance(items, Mapping | str) or not isinstance(items, Sequence):
        raise ConfigError(f"{field_name}: expected a list of colliders, found {items!r}")
    return tuple(
        item if isinstance(item, Collider) else _collider(item, f"{field_name}[{i}]") for i, item in enumerate(items)
    )


def _collider(item: Mapping, where: str) -> Collider:
    if not isinstance(item, Mapping):
        raise ConfigError(f"{where}: expected type and the keys of that type, found {item!r}")
    kind = item.get("type")
    if not isinstance(kind, str) or kind not in _FIELDS:
        raise ConfigError(f"{where}.type: expected one of {', '.join(_FIELDS)}, found {kind!r}")
    make, needed = _FIELDS[kind]
    extra = {"plane": ("normal",), "mesh": ("spacing", "scale", "margin")}.get(kind, ())
    if unknown := [key for key in item if key not in (*_COMMON, *needed, *extra)]:
        raise ConfigError(f"{where}: unknown: {', '.join(unknown)}; a {kind} takes {', '.join((*needed, *extra, *_COMMON[1:]))}")
    if missing := [key for key in needed if item.get(key) is None]:
        raise ConfigError(f"{where}: a {kind} needs {', '.join(missing)}")
    check_keys(item, where)
    item = {key: value for key, value in item.items() if value is not None}
    if item.get("friction", 0) > 0 and item.get("mode", "sticky") != "separate":
        raise ConfigError(f"{where}.friction: acts on mode separate only, found mode {item.get('mode', 'sticky')!r}")
    try:
        if kind == "mesh":
            options = {key: float(item[key]) for key in extra if item.get(key) is not None}
            if "thickness" in item:
                options.setdefault("margin", 2.0 * float(item["thickness"]))
            shape = field_of_mesh(Path(item["path"]), **options)
        else:
            shape = make(*(tuple(map(float, item[k])) if k == "size" else float(item[k]) for k in needed))
        motion = _motion(item)
        friction = float(item.get("friction", 0.0))
        thickness = float(item["thickness"]) if "thickness" in item else None
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    return Collider(shape, item.get("mode", "sticky"), friction, motion, thickness, str(item.get("name", "")))


def _motion(item: dict) -> Motion:
    motion = {key: value for key, value in (item.get("motion") or {}).items() if value is not None}
    rotation = item.get("rotation")
    if item.get("normal") is not None:
        if rotation is not None:
            raise ConfigError("normal and rotation: expected one of them")
        rotation = _turn_to(item["normal"])
    else:
        rotation = _axis_degrees(rotation)
    if "waypoints" in motion:
        points = motion.pop("waypoints")
        if motion or item.get("position") is not None:
            raise ConfigError("motion: waypoints stand alone, without position, velocity or angular_velocity")
        if len(points) < 2:
            raise ConfigError(f"motion.waypoints: expected at least two poses, found {len(points)}")
        turns = [_axis_degrees(p["rotation"]) if p.get("rotation") is not None else rotation for p in points]
        return Motion.waypoints([p["time"] for p in points], [p["position"] for p in points], torch.stack(turns))
    if unknown := [key for key in motion if key not in ("velocity", "angular_velocity", "times")]:
        raise ConfigError(f"motion: unknown: {', '.join(unknown)}; expected velocity, angular_velocity, times, or waypoints")
    position = torch.as_tensor(item.get("position", (0.0, 0.0, 0.0)), dtype=torch.float64)
    if position.shape != (3,):
        raise ConfigError(f"position: expected three numbers, found {item['position']!r}")
    return Motion(position, rotation, **motion)


def _axis_degrees(value: Sequence[float] | None) -> Tensor:
    """Rotation vector (3,) [rad] of (ax, ay, az, degrees)."""
    if value is None:
        return torch.zeros(3, dtype=torch.float64)
    value = torch.as_tensor(value, dtype=torch.float64)
    if value.shape != (4,) or not float(value[:3].norm()) > 0:
        raise ConfigError(f"rotation: expected (ax, ay, az, degrees) with a non-zero axis, found {value.tolist()}")
    return value[:3] / value[:3].norm() * torch.deg2rad(value[3])


def _turn_to(normal: Sequence[float]) -> Tensor:
    """Rotation vector (3,) that turns z to `normal`, the shortest way."""
    n = torch.as_tensor(normal, dtype=torch.float64)
    if n.shape != (3,) or not float(n.norm()) > 0:
        raise ConfigError(f"normal: expected a non-zero vector, found {normal}")
    n = n / n.norm()
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    axis, cosine = torch.linalg.cross(z, n), z @ n
    if float(axis.norm()) == 0:
        return torch.tensor([0.0 if cosine > 0 else torch.pi, 0.0, 0.0], dtype=torch.float64)
    return axis / axis.norm() * torch.atan2(axis.norm(), cosine)
