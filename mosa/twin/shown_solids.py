"""Rigid solids in pictures of splats: Gaussians on their surfaces, so that what is in front hides what is behind."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mosa.physics.contact.colliders import Box, Capsule, Collider, Cylinder, Shape, Sphere
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.rendering.appearance.carried_splats import Seen
from mosa.rendering.appearance.spherical_harmonics import constant_coefficients
from mosa.twin.rollout_file import poses

WIDTH, OPACITY = 0.45, 0.95  # of a surface's Gaussians: standard deviation in pitches
MOST = 30_000  # gaussians of one solid
SOLID = (150, 160, 175)  # 8-bit colour of rigid solids


def lattice(a: float, b: float, pitch: float) -> Tensor:
    """(K, 2) points of a rectangle with edges a and b [m] about 0."""
    ends = [max(2, round(edge / pitch)) for edge in (a, b)]
    return torch.cartesian_prod(
        *(torch.linspace(-0.5 * edge, 0.5 * edge, n) for edge, n in zip((a, b), ends))
    )


def surface(shape: Shape, pitch: float) -> Tensor:
    """(K, 3) points about `pitch` [m] apart on a solid, in its own axes; none on a half space; on a
    mesh as far apart as the nodes of its lattice."""
    if isinstance(shape, Box):
        return torch.cat(
            [_face(shape.size, axis, side, pitch) for axis in range(3) for side in (-0.5, 0.5)]
        )
    if isinstance(shape, SignedDistanceField):
        near = shape.values.abs() < 0.75 * shape.spacing
        slope = torch.stack(torch.gradient(shape.values, spacing=shape.spacing), -1)[near]
        slope = slope / slope.norm(dim=1, keepdim=True).clamp_min(0.1)
        nodes = torch.tensor(shape.origin) + shape.spacing * near.nonzero()
        return (nodes - shape.values[near, None] * slope).float()
    if not isinstance(shape, (Sphere, Capsule, Cylinder)):
        return torch.zeros(0, 3)
    length, radius = getattr(shape, "length", 0.0), shape.radius
    rings = [
        (radius, z)
        for z in torch.linspace(-0.5 * length, 0.5 * length, max(1, round(length / pitch))).tolist()
        if length
    ]
    if isinstance(shape, Cylinder):
        radii = torch.linspace(0, radius, max(2, round(radius / pitch))).tolist()
        caps = [(r, 0.5 * length) for r in radii]
    else:
        angles = torch.linspace(0, 0.5 * math.pi, max(2, round(0.5 * math.pi * radius / pitch)))
        caps = [
            (radius * math.cos(a), 0.5 * length + radius * math.sin(a)) for a in angles.tolist()
        ]
    rings += caps + [(r, -z) for r, z in caps]
    return torch.cat([_ring(r, z, pitch) for r, z in rings])


def _face(size: Sequence[float], axis: int, side: float, pitch: float) -> Tensor:
    u, v = (i for i in range(3) if i != axis)
    flat = lattice(size[u], size[v], pitch)
    face = flat.new_zeros(len(flat), 3)
    face[:, u], face[:, v], face[:, axis] = flat[:, 0], flat[:, 1], side * size[axis]
    return face


def _ring(radius: float, z: float, pitch: float) -> Tensor:
    angle = torch.linspace(0, 2 * math.pi, max(1, round(2 * math.pi * radius / pitch)) + 1)[:-1]
    return torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, z)], 1)


def shaded(points: Tensor, up: Tensor, color: Tensor) -> Tensor:
    """(K, 3) a colour (3,) that is a little darker below: edges then show without a light."""
    high = points @ up
    share = (high - high.min()) / (high.max() - high.min()).clamp_min(1e-6)
    return color * (0.8 + 0.2 * share)[:, None]


def with_solids(
    body: Seen, colliders: Sequence[Collider], times: Tensor, up: Tensor, pitch: float
) -> Seen:
    """A body over T frames among solids where their motions have them at times (T,) [s]. pitch [m]: between Gaussians."""
    parts, wide, colors = [], [], []
    at, turned = (t.to(body.means) for t in poses(colliders, times)) if colliders else (None, None)
    for k, collider in enumerate(colliders):
        points = surface(collider.shape, pitch)
        coarse = pitch * max(1.0, math.sqrt(len(points) / MOST))
        points = (points if coarse == pitch else surface(collider.shape, coarse)).to(body.means)
        coarse = max(coarse, getattr(collider.shape, "spacing", 0.0))
        if len(points):
            parts.append(points @ turned[:, k].mT + at[:, k, None])
            wide.append(torch.full((len(points),), WIDTH * coarse))
            colors.append(shaded(parts[-1][0], up.to(points), points.new_tensor(SOLID) / 255))
    if not parts:
        return body
    means, widths = torch.cat(parts, 1), torch.cat(wide).to(body.means)
    frames, count = means.shape[:2]
    eye = torch.eye(3).to(means)
    plain = body.harmonics.new_zeros(count, *body.harmonics.shape[1:])
    plain[:, :1] = constant_coefficients(torch.cat(colors))
    join = lambda ours, theirs: None if ours is None else torch.cat([ours, theirs], 1)  # noqa: E731
    return Seen(
        torch.cat([body.means, means], 1),
        torch.cat([body.covariances, (widths.square()[:, None, None] * eye).expand(frames, -1, -1, -1)], 1),
        torch.cat([body.opacities, torch.full_like(widths, OPACITY)]), torch.cat([body.harmonics, plain]),
        join(body.rotations, eye.expand(frames, count, 3, 3)), join(body.shades, means.new_ones(frames, count)),
    )  # fmt: skip
