"""Driven particles: parts of the body that a motion holds, rigidly or point by point, and loads.

A set of driven particles stands among the colliders, after the solids: it has a motion, a pose at
every substep, and takes a force and a torque, as they have. What acts on its particles is in
`driven_kernels`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError, DataError
from mosa.physics.contact.colliders import Collider, Particles, Shape, collider_of
from mosa.physics.contact.keys import MotionKeys, rows, three, told
from mosa.physics.contact.motion import Motion, Points, Trajectory, ends, pose_at
from mosa.physics.contact.reference import signed_distance
from mosa.settings import Expected, Section, Text, Weight, Whole, check_values
from mosa.system.npz import read_npz

FARTHEST = 0.5
"""Of the body's size: no particle is meant by a point that is farther from all of them."""


def sample_paths(
    motions: Sequence, count: int, dt: float, start: float, first: int = 0
) -> tuple[Tensor, ...]:
    """(paths, rates), (S, P, 3) float64 each, of all points of the motions at S = count substeps;
    () where there are no points."""
    found = [m.paths(ends(count, dt, start, first)) for m in motions if isinstance(m, Points)]
    return tuple(torch.cat(parts, 1) for parts in zip(*found))


@dataclass(frozen=True, eq=False)
class Driven:
    """Particles of a body, by the place where they start, and the motion that holds them.

    region: a shape in the pose that the motion has at t = 0; indices (n,) of particles; or places
    (n, 3) [m], each of which means the particle nearest to it. None with `Points`: those places
    are the points. held: False for a load alone, which goes with its particles. mass [kg]: fixed
    to them, each has its share by volume. place: motion whose pose at t = 0 is the region's, None
    for `motion`. Errors: ConfigError."""

    region: Shape | Tensor | Sequence[int] | None
    motion: Motion | Trajectory | Points = field(default_factory=Motion)
    mass: float = 0.0
    held: bool = True
    name: str = ""
    place: Motion | Trajectory | Points | None = None

    def chosen(self, x: Tensor) -> Tensor:
        """(n,) indices of the particles x (N, 3) [m] where the body starts. Errors: ConfigError
        where there are none."""
        place, where = x.detach().double().cpu(), f"driven set {self.name!r}"
        region = self.region
        if region is None:
            if not isinstance(self.motion, Points):
                raise ConfigError(f"{where}: expected a region, or points that move, found neither")
            region = self.motion.at(torch.zeros(1, dtype=torch.float64))[0].detach()
        if isinstance(region, Tensor) and region.ndim == 2:
            away, found = torch.cdist(region.double().cpu(), place).min(1)
            if float(away.max()) > FARTHEST * float((place.amax(0) - place.amin(0)).max()):
                raise ConfigError(f"{where}: points: expected places on the body, found one beside")
            return found.unique()
        if isinstance(region, Tensor | Sequence):
            found = torch.as_tensor(region, dtype=torch.int64).cpu().unique()
            if len(found) and not 0 <= int(found[0]) <= int(found[-1]) < len(x):
                raise ConfigError(
                    f"{where}: indices: expected numbers of particles below {len(x)}, found {int(found[-1])}"
                )
        else:
            position, rotation = pose_at(self.motion if self.place is None else self.place)
            inside = signed_distance(region, (place - position) @ rotation) <= 0
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


def held_in(driven: Sequence[Driven], x: Tensor, solids: int = 0) -> Held | None:
    """What the sets hold of a body whose particles start at x (N, 3) [m], behind `solids` solids;
    None where nothing is held."""
    if not (holding := [each for each in driven if each.held]):
        return None
    return hold([each.chosen(x) for each in holding], [each.motion for each in holding], x, solids)


class Held(NamedTuple):
    """Which particles are driven, and from where.

    sets: (N,) int32 number of the column of poses, -1 for free particles; local: (N, 3) [m] places
    in the axes of their motions; points: (N,) int32 number of the point that each follows, -1 for
    none. Of W worlds: (W, N, ...)."""

    sets: Tensor
    local: Tensor
    points: Tensor


def stack_held(each: Sequence[Held]) -> Held:
    """Of so many worlds."""
    return Held(*map(torch.stack, zip(*each)))


def hold(
    indices: Sequence[Tensor], motions: Sequence, x: Tensor, solids: int = 0, start: float = 0.0
) -> Held:
    """The sets `indices`, one for each of `motions`, of particles at x (N, 3) [m] at time `start`
    of the motions, behind `solids` solids. Without gradient: places in the motions' axes are those
    of the start. Errors: ConfigError where sets share a particle."""
    place = x.detach().double().cpu()
    sets, points = (torch.full((len(x),), -1, dtype=torch.int32) for _ in range(2))
    local, passed = torch.zeros_like(place), 0
    for k, (chosen, motion) in enumerate(zip(indices, motions, strict=True)):
        if bool((sets[chosen] >= 0).any()):
            raise ConfigError(
                f"driven sets: expected sets without a common particle, found particle "
                f"{int(chosen[sets[chosen] >= 0][0])} in two of them"
            )
        position, rotation = pose_at(motion, start)
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


def loads(driven: Sequence[Driven], x: Tensor, volume: Tensor) -> Tensor | None:
    """(N,) density [kg/m^3] that the sets' masses add to their particles, which start at x (N, 3)
    [m] with volumes (N,) [m^3]; None where there are none. Errors: ConfigError."""
    if not any(each.mass for each in driven):
        return None
    added = torch.zeros_like(volume)
    for each in driven:
        if not 0 <= each.mass < math.inf:
            raise ConfigError(
                f"driven set {each.name!r}: mass: expected a number of at least 0 [kg], found {each.mass}"
            )
        chosen = each.chosen(x).to(volume.device)
        added[chosen] += each.mass / volume[chosen].sum()
    return added


KEYS = {
    "indices": Annotated[list[Whole], Expected("a list of numbers of particles")],
    "points": told("a list of places (x, y, z) [m]", rows(three)), "name": Text, "mass": Weight, "held": bool, "motion": Section,
}  # fmt: skip


def driven_from_config(
    items: Sequence[Mapping[str, Any] | Driven], field_name: str = "world.driven"
) -> tuple[Driven, ...]:
    """Driven sets of plain containers, as a YAML file has them; a `Driven` is passed on.

    Each: the region as a collider's shape (type with its keys, position, rotation or normal),
    `indices`, or `points`; motion as a collider's, or times (T,) [s] and points (T, n, 3) [m], as
    {path: an npz} or as lists; mass [kg]; held; name. Errors: ConfigError naming the entry and
    the field, DataError naming the file."""
    if isinstance(items, Mapping | str) or not isinstance(items, Sequence):
        raise ConfigError(f"{field_name}: expected a list of driven sets, found {items!r}")
    return tuple(
        item if isinstance(item, Driven) else _driven(item, f"{field_name}[{i}]", i)
        for i, item in enumerate(items)
    )


def _driven(item: Mapping, where: str, number: int) -> Driven:
    if not isinstance(item, Mapping):
        raise ConfigError(f"{where}: expected type, indices or points and a motion, found {item!r}")
    item = {key: value for key, value in item.items() if value is not None}
    check_values(item, KEYS, where)
    name = item.pop("name", f"driven{number}")
    more = {key: item.pop(key) for key in ("mass", "held") if key in item}
    own = {key: item.pop(key) for key in ("indices", "points") if key in item}
    moved, given = None, set(item.get("motion") or {})
    known = (*MotionKeys.model_fields, "path", "points")
    if wrong := sorted(given.difference(known)):
        raise ConfigError(
            f"{where}.motion.{wrong[0]}: unknown key; expected one of {', '.join(known)}"
        )
    if given & {"path", "points"}:
        if given not in ({"path"}, {"times", "points"}):
            raise ConfigError(f"{where}.motion: expected path alone, or times and points")
        moved = _points(item.pop("motion"), where)
        if own:
            raise ConfigError(f"{where}: {next(iter(own))} and motion.path: expected type, or none")
    if not more.get("held", True) and (not more.get("mass") or "motion" in item):
        raise ConfigError(
            f"{where}: expected a mass and no motion with held: false, found {sorted(item | more)}"
        )
    if unknown := [key for key in ("mode", "friction") if key in item]:
        raise ConfigError(f"{where}: unknown: {unknown[0]}; particles that are held do not slide")
    if len(own) + ("type" in item) > 1 or not (own or "type" in item or moved):
        raise ConfigError(
            f"{where}: expected one of type (a shape), indices, points or motion.path, found {', '.join(item) or 'none'}"
        )
    region: Shape | Tensor | None = None
    solid = None
    if own or "type" in item:
        solid = collider_of({"type": "plane"} | item if own else item, where)
    if own:
        key, value = next(iter(own.items()))
        kind = torch.int64 if key == "indices" else torch.float64
        region = torch.tensor(value, dtype=kind)
    elif solid is not None:
        region = solid.shape
    place = None if solid is None else solid.motion
    motion = moved or (solid.motion if solid is not None else Motion())
    return Driven(region, motion, place=place, name=name, **more)


def _points(given: Mapping[str, Any], where: str) -> Points:
    path = given.get("path")
    if path is None:
        try:
            return Points(
                *(torch.tensor(given[k], dtype=torch.float64) for k in ("times", "points"))
            )
        except (ConfigError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{where}.motion: expected lists times [s] and points [m] of shape (T,) and "
                f"(T, n, 3), found others ({error})"
            ) from error
    if not isinstance(path := given["path"], str):
        raise ConfigError(f"{where}.motion.path: expected an npz file, found {path!r}")
    arrays = read_npz(Path(path))
    if missing := [key for key in ("times", "points") if key not in arrays]:
        raise DataError(f"{path}: expected times (T,) and points (T, n, 3), found no {missing[0]}")
    try:
        return Points(*(torch.as_tensor(arrays[key]).double() for key in ("times", "points")))
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from error
