"""Signed distances of solids in torch float64: of a body at its start, and as a twin of the kernels' (`shapes`) in tests."""

import torch
from torch import Tensor

from mosa.physics.contact.colliders import Box, Capsule, Cylinder, HalfSpace, Sphere
from mosa.physics.contact.mesh import SignedDistanceField


def signed_distance(shape, q: Tensor) -> Tensor:
    """(M,) signed distances of points q (M, 3) in the shape's axes."""
    if isinstance(shape, HalfSpace):
        return q[:, 2]
    if isinstance(shape, Sphere):
        return q.norm(dim=1) - shape.radius
    if isinstance(shape, SignedDistanceField):
        return _trilinear(shape, q)
    if isinstance(shape, Capsule):
        end = q[:, 2].clamp(-shape.length / 2, shape.length / 2)
        return (q - torch.stack([0 * end, 0 * end, end], 1)).norm(dim=1) - shape.radius
    if isinstance(shape, Cylinder):
        d = torch.stack([q[:, :2].norm(dim=1) - shape.radius, q[:, 2].abs() - shape.length / 2], 1)
    elif isinstance(shape, Box):
        d = q.abs() - 0.5 * torch.tensor(shape.size, dtype=torch.float64)
    else:
        raise NotImplementedError(f"no signed distance of a {type(shape).__name__}")
    outside = (d > 0).any(1)
    distance = torch.zeros(len(q), dtype=torch.float64)
    distance = distance.index_put((outside,), d[outside].clamp_min(0).norm(dim=1))
    return distance.index_put((~outside,), d[~outside].max(1).values)


def _trilinear(field: SignedDistanceField, q: Tensor) -> Tensor:
    t = (q - torch.tensor(field.origin, dtype=torch.float64)) / field.spacing
    base = torch.floor(t.detach())
    inside = ((base >= 0) & (base < torch.tensor(field.values.shape) - 1)).all(1)
    f, n = t - base, torch.where(inside[:, None], base, torch.zeros(())).long()
    value = torch.zeros(len(q), dtype=torch.float64)
    for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
        at = n + corner
        w = torch.where(corner == 1, f, 1 - f).prod(1)
        value = value + w * field.values[at[:, 0], at[:, 1], at[:, 2]]
    return torch.where(inside, value, torch.full((), 1e30, dtype=torch.float64))
