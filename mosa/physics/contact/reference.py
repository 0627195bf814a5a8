"""Pure torch float64 twin of the colliders: slow and obvious, for tests and for bodies that overlap
solids at the start (`overlap`); gradients by plain autograd."""

import torch
from torch import Tensor

from mosa.physics.contact.colliders import (
    HOLD,
    STIFFER,
    Box,
    Capsule,
    Collider,
    Cylinder,
    HalfSpace,
    Sphere,
)
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.touch import GRIP


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


def collide(
    v: Tensor, x: Tensor, mass: Tensor, radius: Tensor, spring: Tensor, colliders: list[Collider], poses: tuple[Tensor, ...],
    dt: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """(velocities (M, 3) after contact, force (K, 3), torque (K, 3)) of particles at x (M, 3) with mass, radius and spring (M,).

    poses: position (K, 3), rotation (K, 3, 3), linear (K, 3), angular (K, 3) of one substep.
    """
    forces, torques = [], []
    for collider, origin, Q, linear, angular in zip(colliders, *poses):
        near = signed_distance(collider.shape, (x - origin) @ Q).detach() < radius
        r = (x - origin)[near]
        q = r @ Q
        if not q.requires_grad:
            q = q.detach().requires_grad_()
        phi = signed_distance(collider.shape, q)
        (gradient,) = torch.autograd.grad(phi.sum(), q, create_graph=True)
        n = (gradient / gradient.norm(dim=1, keepdim=True)) @ Q.mT
        u = v[near] - linear - torch.linalg.cross(angular.expand_as(r), r)
        push = (
            dt * spring[near] * (1 if collider.mode == "touch" else STIFFER) * (radius[near] - phi)
        )
        tangential = u - (u * n).sum(1, keepdim=True) * n
        lost = torch.full_like(push, HOLD)
        if collider.mode != "sticky":
            lost = (collider.friction * push / tangential.norm(dim=1)).clamp_max(GRIP)
        change = push[:, None] * n - lost[:, None] * tangential
        f = -(mass[near] / dt)[:, None] * change
        forces.append(f.sum(0))
        torques.append(torch.linalg.cross(r, f).sum(0))
        v = v.index_put((near,), v[near] + change)
    return v, torch.stack(forces), torch.stack(torques)
