"""The visible surface of a body: triangles at the zero level of its distance, carried along by the motion of its particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
import warp.geometry
from scipy.spatial import cKDTree

from mosa.data.synthetic.bodies.parts import Shape
from mosa.physics.launching import ON_CPU
from mosa.system.warp_start import start_warp

start_warp()
NEIGHBOURS = 32  # particles that a point of the surface follows


@dataclass(frozen=True)
class Surface:
    """vertices: (M, 3) [m] in the shape's frame; triangles: (K, 3) int32, counter-clockwise from outside; colors: (M, 3)."""

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray


@ON_CPU
def extract_surface(shape: Shape, pitch: float, rng: np.random.Generator) -> Surface:
    """Marching cubes on a grid of `pitch` [m], vertices moved onto the zero level by one Newton step."""
    low, high = shape.bounds[0] - 2 * pitch, shape.bounds[1] + 2 * pitch
    axes = [np.arange(a, b, pitch) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = shape.distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    vertices, indices = wp.geometry.IsoSurfaceMarchingCubes.extract(
        wp.array(values.astype(np.float32), device="cpu"), 0.0
    )
    vertices = vertices.numpy().astype(np.float64) * pitch + low
    gradient = level_gradient(shape, vertices)
    squared = np.maximum((gradient**2).sum(-1, keepdims=True), 0.25)
    vertices -= shape.distance(vertices)[:, None] * gradient / squared
    triangles = indices.numpy().reshape(-1, 3).astype(np.int32)
    facing = areas(vertices, triangles)
    if (facing * gradient[triangles[:, 0]]).sum() < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return Surface(vertices, triangles, shape.color(vertices, rng))


def areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(K, 3) [m^2] along the triangles' normals, twice their areas long."""
    corner = vertices[triangles]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def level_gradient(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Gradient (M, 3) of the distance by central differences of 0.1 mm."""
    sides = [shape.distance(points + e) - shape.distance(points - e) for e in 1e-4 * np.eye(3)]
    return np.stack(sides, -1) / 2e-4


def fill(shape: Shape, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Particles (N, 3) [m] on a lattice of `spacing` inside the shape, the lattice shifted at random."""
    offset = rng.uniform(0, spacing, 3)
    corners = zip(shape.bounds[0] - spacing + offset, shape.bounds[1])
    axes = [np.arange(a, b + spacing, spacing) for a, b in corners]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points[shape.distance(points) < 0]


@dataclass(frozen=True)
class Skin:
    """Weights with which points follow particles. neighbours: (M, k); weights: (M, k), each row sums to 1."""

    neighbours: np.ndarray
    weights: np.ndarray

    def follow(self, positions: np.ndarray) -> np.ndarray:
        """Positions (M, 3) of the points for particles at (N, 3)."""
        return np.einsum("mk,mkd->md", self.weights, positions[self.neighbours])


def bind(points: np.ndarray, particles: np.ndarray, spacing: float) -> Skin:
    """Skin by moving least squares with an affine basis: it reproduces every affine motion of the particles exactly.

    x = sum_i w_i (1 + (X - X_w)^T M^-1 (X_i - X_w)) x_i / sum w, with M the weighted second moment about the weighted mean X_w.
    """
    distance, index = cKDTree(particles).query(points, k=min(NEIGHBOURS, len(particles)))
    weights = np.exp(-0.5 * (distance / (1.5 * spacing)) ** 2) + 1e-9
    weights /= weights.sum(-1, keepdims=True)
    near = particles[index]
    mean = np.einsum("mk,mkd->md", weights, near)
    arms = near - mean[:, None]
    moment = np.einsum("mk,mki,mkj->mij", weights, arms, arms) + 1e-3 * spacing**2 * np.eye(3)
    # the ridge only matters where the neighbours lie in a plane; its effect on other rows is taken back by one refinement
    lever = points - mean
    solution = np.linalg.solve(moment, lever[..., None])[..., 0]
    residual = lever - np.einsum("mk,mki,mkj,mj->mi", weights, arms, arms, solution)
    solution += np.linalg.solve(moment, residual[..., None])[..., 0]
    return Skin(index, weights * (1 + np.einsum("mki,mi->mk", arms, solution)))


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3), area-weighted means over the triangles around each vertex."""
    facing, place = np.repeat(areas(vertices, triangles), 3, axis=0), triangles.ravel()
    sums = [np.bincount(place, facing[:, d], len(vertices)) for d in range(3)]
    normals = np.stack(sums, -1)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)


AROUND = 3.0  # spacings within which particles make the surface of what flows
LEVEL = 0.76
"""Spacings of that surface from the mean of the particles around it: bodies at rest then have their volume to 0.6 % (0.85: 3 to 4 %
too much), or every silhouette would be that of a larger body than the one that fell."""


def flowing_surface(
    positions: np.ndarray, colors: np.ndarray, spacing: float, pitch: float
) -> Surface:
    """Surface of particles (N, 3) [m] that no skin could follow, with the particles' colors (N, 3).

    The level |x - mean of the particles around x| = LEVEL spacings (Zhu and Bridson 2005), weights (1 - (d/3 spacings)^2)^3.
    """
    tree, reach = cKDTree(positions), AROUND * spacing

    def around(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(weights (M, k) with a column of sums at least 1e-12, indices (M, k), whether any particle is near (M,))."""
        distance, index = tree.query(points, k=min(24, len(positions)), distance_upper_bound=reach)
        # a particle beyond the reach is infinitely far away
        weight = np.maximum(1 - (np.minimum(distance, reach) / reach) ** 2, 0) ** 3
        weight = weight / np.maximum(weight.sum(1, keepdims=True), 1e-12)
        return weight, np.minimum(index, len(positions) - 1), np.isfinite(distance[:, 0])

    def distance(points: np.ndarray) -> np.ndarray:
        weight, index, near = around(points)
        mean = np.einsum("mk,mkd->md", weight, positions[index])
        return np.where(near, np.linalg.norm(points - mean, axis=-1), reach) - LEVEL * spacing

    def color(points: np.ndarray, _rng: np.random.Generator) -> np.ndarray:
        weight, index, _ = around(points)
        return np.einsum("mk,mkd->md", weight, colors[index])

    bounds = np.stack([positions.min(0) - 2 * spacing, positions.max(0) + 2 * spacing])
    shape, pitch = Shape(distance, color, bounds), max(pitch, 0.8 * spacing)
    return extract_surface(shape, pitch, np.random.default_rng(0))
