"""Pure torch float64 twin of the colliders: slow and obvious; gradients by plain autograd."""

import torch
from torch import Tensor

from mosa.physics.contact.colliders import HOLD, STIFFER, Collider
from mosa.physics.contact.reference import signed_distance
from mosa.physics.contact.touch import GRIP


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
