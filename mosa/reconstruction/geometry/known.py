"""The solid of a body whose rest shape is in a file: a closed mesh, a point cloud or 3D Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.data.formats.particles import read_ply
from mosa.data.hull import Volume
from mosa.data.io.gaussian_ply import load_ply
from mosa.errors import ConfigError, DataError
from mosa.physics.contact.mesh import field_of_triangles, read_mesh
from mosa.reconstruction.gaussians.initial import isotropic_splats
from mosa.reconstruction.geometry.field import at, gradient
from mosa.reconstruction.geometry.refinement import signed_distance
from mosa.reconstruction.geometry.shell import solid_of, together
from mosa.system.ply import check_ply
from mosa.types import KnownBody, Splats

NODES = 64
"""Nodes along the longest side of a mesh, between which its distance is linear."""
VOXELS = 112
"""Along the longest side of a cloud or of Gaussians."""
OPAQUE = 0.1
"""Opacity of Gaussians that count."""
DEEP, FILLED = 0.75, 0.3
"""Spacings below the surface, and the share of a cloud's points that lie deeper, from which on it
fills a body and is no scan of its surface. A dense, noisy scan that passes for one is made larger by
half of its small spacing."""
FEWEST, NEAR = 27, 1e-4
"""Nodes inside of a solid; least extent of a cloud, of its way to the origin (single precision)."""
THIN = 1e-2
"""Standard deviation of a scanned point, in spacings."""


@dataclass(frozen=True)
class Solid:
    """distance: to the surface, negative inside, in units of the longest side of the file's shape,
    with the centre of its volume at the origin; unit: that side, centre: (3,) that point, both in
    the file's units."""

    distance: Volume
    unit: float
    centre: Tensor

    def at(self, points: Tensor) -> Tensor:
        """Distance (...) of points (..., 3), both in units; also beyond the grid, where it is at
        most too large by a half."""
        low = self.distance.origin
        high = low + self.distance.pitch * (torch.tensor(self.distance.values.shape).to(low) - 1)
        near = torch.minimum(torch.maximum(points, low), high)
        return at(self.distance, near) + (points - near).norm(dim=-1)

    @cached_property
    def inside(self) -> Tensor:
        """(N, 3) the nodes inside, in units."""
        return self.distance.points()[self.distance.values < 0]

    @cached_property
    def reach(self) -> float:
        """Radius of the ball about the origin that holds it, in units."""
        return float(self.inside.norm(dim=1).max()) + self.distance.pitch

    @cached_property
    def slopes(self) -> Tensor:
        """(3, X, Y, Z) derivatives of the distance."""
        return gradient(self.distance.values, self.distance.pitch)


@lru_cache(maxsize=1)
def known_solid(body: KnownBody) -> Solid:
    """The solid in its file. Errors: DataError naming the file."""
    path = Path(body.shape)
    if not path.is_file():
        raise DataError(f"scene.body.shape: expected a .ply, .obj or .stl, found none at {path}")
    if path.suffix.lower() == ".ply":
        check_ply(path)
        elements = {e.name: e for e in PlyData.read(str(path)).elements}
        fields = {p.name for p in elements["vertex"].properties} if "vertex" in elements else set()
        if "scale_0" in fields:
            splats, _ = load_ply(path)
            return solid_of_gaussians(splats, path)
        if not len(elements.get("face", ())):
            return solid_of_points(read_ply(path), path)
    try:
        vertices, triangles = read_mesh(path)
        low, high = vertices.min(0), vertices.max(0)
        unit = float((high - low).max())
        middle = (low + high) / 2
        if not NEAR * float(np.abs(middle).max()) < unit < np.inf:
            raise ConfigError(f"{path}: expected a mesh with an extent near 0, found {unit:.3g}")
        field = field_of_triangles((vertices - middle) / unit, triangles, 1 / NODES)
    except ConfigError as error:
        raise DataError(f"scene.body.shape: {error}") from error
    lattice = Volume(field.values.float(), torch.tensor(field.origin).float(), field.spacing)
    return centred(lattice, unit, torch.from_numpy(middle), path)


def centred(distance: Volume, unit: float, middle: Tensor, path: Path) -> Solid:
    """About the centre of what is inside. middle: (3,) of the file, where the lattice has 0.
    Errors: DataError where next to nothing is inside."""
    if int((distance.values < 0).sum()) < FEWEST:
        raise DataError(f"scene.body.shape: {path}: expected a solid, found nothing inside: open?")
    centre = distance.points()[distance.values < 0].mean(0)
    moved = Volume(distance.values, distance.origin - centre, distance.pitch)
    return Solid(moved, unit, (middle + unit * centre).float())


def solid_of_gaussians(splats: Splats, path: Path) -> Solid:
    """What Gaussians enclose. Errors: DataError."""
    chosen = splats.opacities >= OPAQUE
    if int(chosen.sum()) > 1:
        chosen[chosen.clone()] = together(splats.means[chosen])
    kept = Splats(*(value[chosen] for value in vars(splats).values()))
    if len(kept.means) < 100:
        raise DataError(
            f"scene.body.shape: {path}: expected at least 100 Gaussians of an opacity of {OPAQUE:g} "
            f"or points, found {len(kept.means)}"
        )
    middle = kept.means.median(0).values
    unit = float((kept.means.amax(0) - kept.means.amin(0)).max())
    if not NEAR * float(middle.abs().max()) < unit < np.inf:
        raise DataError(f"scene.body.shape: {path}: expected an extent near 0, found {unit:.3g}")
    kept = replace(kept, means=(kept.means - middle) / unit, scales=kept.scales / unit)
    try:
        solid = solid_of(kept, resolution=VOXELS)
    except DataError as error:
        raise DataError(f"scene.body.shape: {path}: {error}") from error
    inside = Volume((solid.values > 0.5).float(), solid.origin, solid.pitch)
    return centred(signed_distance(inside), unit, middle, path)


def solid_of_points(points: Tensor, path: Path) -> Solid:
    """What a cloud encloses: points of the surface, or particles that fill the body, whose surface
    is half a spacing beyond the outermost. Errors: DataError."""
    points = points.unique(dim=0)
    n = len(points)
    places = points.double().numpy()
    gap = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1])) if n > 1 else 0.0
    cloud = isotropic_splats(points, max(THIN * gap, 1e-12), 0.95, torch.full_like(points, 0.5))
    found = solid_of_gaussians(cloud, path)
    gap, grid = gap / found.unit, found.distance
    depth = -found.at((points - found.centre) / found.unit)
    fills = float((depth > DEEP * gap).float().mean()) > FILLED
    surface = float(depth[depth < gap].median()) - (0.5 * gap if fills else 0.0)
    moved = Volume(grid.values + surface, grid.origin, grid.pitch)
    return centred(moved, found.unit, found.centre, path)
