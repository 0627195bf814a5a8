"""Contact of particles with solids: kernel against the torch twin, its adjoint against the twin's autograd and differences."""

import pytest
import torch
import warp as wp
from contact_reference import collide

from mosa.physics.contact.collider_kernels import collider_kernels
from mosa.physics.contact.colliders import (
    HOLD,
    Box,
    Capsule,
    Collider,
    Cylinder,
    HalfSpace,
    Sphere,
    pack_colliders,
)
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.motion import exponential
from mosa.physics.launching import filled

DT, COUNT = 0.01, 1000
KERNELS = collider_kernels(wp.float64)
VEC3, MAT33, NUMBER = wp.vec3d, wp.mat33d, wp.float64
POSE = VEC3, MAT33, VEC3, VEC3


def uneven_field():
    """A smooth lattice of values that is no distance of anything: all its derivatives differ from 0."""
    axes = [0.06 * torch.arange(n).double() - 0.3 for n in (11, 12, 10)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    values = torch.sqrt((1.3 * x + 0.2 * y) ** 2 + y**2 + (z + 0.4 * x * y) ** 2 + 0.01) - 0.22
    return SignedDistanceField(values, (-0.3,) * 3, 0.06, 0.1)


SHAPES = {"half space": HalfSpace(), "sphere": Sphere(0.2), "capsule": Capsule(0.1, 0.2), "cylinder": Cylinder(0.15, 0.25),
          "box": Box((0.3, 0.2, 0.35)), "field": uneven_field()}  # fmt: skip


def drawn(colliders, seed=0):
    """(velocities, places, springs; position, rotation vectors, linear, angular of the solids; seeds of velocity, force, torque)
    and (masses, volumes) of particles in a scene that is 0.5 m wide."""
    g, k = torch.Generator().manual_seed(seed), len(colliders)
    v, x = (
        torch.randn(COUNT, 3, generator=g).double(),
        0.5 * torch.rand(COUNT, 3, generator=g).double(),
    )
    mass, volume, spring = (
        (a + b * torch.rand(COUNT, generator=g).double())
        for a, b in ((0.1, 1), (8e-6, 6e-5), (5e4, 5e4))
    )
    centre = (
        torch.tensor([0.27, 0.24, 0.22]).double() + 0.02 * torch.randn(k, 3, generator=g).double()
    )
    others = [torch.randn(n, 3, generator=g).double() for n in (k, k, k, COUNT, k, k)]
    return [v, x, spring, centre, *others], (mass, volume)


def arrays_of(tensors, kinds):
    return [wp.from_torch(t, dtype=kind) for t, kind in zip(tensors, kinds)]


def launch(kernel, colliders, v, x, spring, poses, bodies, further):
    """poses are those of substep 2 of 3; further: arguments."""
    packed = pack_colliders(colliders, torch.float64, torch.device("cpu"))
    held = [
        torch.stack([torch.full_like(p, 7.0), torch.full_like(p, 7.0), p]).contiguous()
        for p in poses
    ]
    mass, volume = bodies
    inputs = [
        *(wp.from_torch(t.contiguous(), dtype=kind) for t, kind in ((x, VEC3), (v, VEC3), (volume, NUMBER), (spring, NUMBER),
                                                                    (mass, NUMBER))),
        DT, COUNT, 2,
        filled(KERNELS.Solids, len(colliders), *arrays_of(packed, (NUMBER, wp.int32, NUMBER))),
        filled(KERNELS.Poses, *arrays_of(held, POSE)),
        *further,
    ]  # fmt: skip
    wp.launch(kernel, COUNT, inputs=inputs, device="cpu")


def forward(colliders, v, x, spring, poses, bodies):
    """(velocity, force, torque) of the kernel."""
    struck = torch.full_like(v, torch.nan)
    force, torque = (torch.zeros(3, len(colliders), 3).double() for _ in range(2))
    launch(
        KERNELS.strike,
        colliders,
        v,
        x,
        spring,
        poses,
        bodies,
        arrays_of((struck, force, torque), (VEC3,) * 3),
    )
    assert float(force[:2].abs().sum() + torque[:2].abs().sum()) == 0
    return struck, force[2], torque[2]


def backward(colliders, v, x, spring, poses, bodies, seeds):
    """Gradients in (v, x, spring, position, rotation, linear, angular) of the kernel."""
    a, of_x, of_spring = seeds[0].clone(), torch.zeros_like(x), torch.zeros_like(spring)
    adj_force, adj_torque = (
        torch.stack([torch.full_like(s, 3.0)] * 2 + [s]).contiguous() for s in seeds[1:]
    )
    of_poses = [torch.zeros(3, *p.shape).double() for p in poses]
    seeded = arrays_of((adj_force, adj_torque, of_x, a, of_spring), (*(VEC3,) * 4, NUMBER))
    sums = filled(KERNELS.PoseSums, *arrays_of(of_poses, POSE))
    launch(KERNELS.adj_strike, colliders, v, x, spring, poses, bodies, [*seeded, sums])
    return [a, of_x, of_spring, *(p[2] for p in of_poses)]


CASES = [(name, mode, friction) for name in SHAPES
         for mode, friction in (("sticky", 0.0), ("slip", 0.0), ("touch", 0.0), ("separate", 0.4), ("touch", 0.4))]  # fmt: skip


@pytest.mark.parametrize("name, mode, friction", CASES)
def test_kernel_and_adjoint_against_the_twin(name, mode, friction):
    """With a second collider after it, so that the order of contacts is differentiated through."""
    colliders = [Collider(SHAPES[name], mode, friction), Collider(Sphere(0.15), "separate", 0.2)]
    (v, x, spring, position, turns, linear, angular, *seeds), bodies = drawn(colliders)
    leaves = [
        t.clone().requires_grad_()
        for t in (v, x, spring, position, exponential(turns), linear, angular)
    ]
    radius = 0.5 * bodies[1] ** (1 / 3)
    expected = collide(
        leaves[0], leaves[1], bodies[0], radius, leaves[2], colliders, leaves[3:], DT
    )
    poses = [t.detach() for t in leaves[3:]]
    found = forward(colliders, v, x, spring, poses, bodies)
    torch.testing.assert_close(found[0], expected[0].detach(), rtol=1e-12, atol=1e-12)
    for a, b in zip(found[1:], expected[1:]):
        torch.testing.assert_close(a, b.detach(), rtol=1e-12, atol=1e-9)
    assert ((found[0] - v).abs() > 1e-6).any(1).sum() > 100
    loss = sum((value * seed).sum() for value, seed in zip(expected, seeds))
    for a, b in zip(
        backward(colliders, v, x, spring, poses, bodies, seeds), torch.autograd.grad(loss, leaves)
    ):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10 * float(b.abs().max()))


@pytest.mark.parametrize("name, mode, friction", CASES)
def test_adjoint_against_differences(name, mode, friction):
    """Of particles, springs, pose and velocity of one collider: 1e-6. A step across which a contact opens or starts to slide, or
    the distance has an edge, has no derivative: two steps tell that, another direction replaces it."""
    colliders = [Collider(SHAPES[name], mode, friction)]
    values, bodies = drawn(colliders)
    values, seeds = values[:7], values[7:]

    def loss(values):
        found = forward(
            colliders, *values[:3], [values[3], exponential(values[4]), *values[5:]], bodies
        )
        return sum((value * seed).sum() for value, seed in zip(found, seeds))

    leaf = values[4].clone().requires_grad_()
    R = exponential(leaf)
    gradients = backward(
        colliders, *values[:3], [values[3], R.detach(), *values[5:]], bodies, seeds
    )
    (gradients[4],) = torch.autograd.grad(R, leaf, gradients[4])
    g = torch.Generator().manual_seed(5)
    rounding = 1e-15 * abs(float(loss(values))) + 1e-12 * sum(float(s.abs().sum()) for s in seeds)
    names = ("v", "x", "spring", "position", "rotation", "linear", "angular")
    for i, (size, name_) in enumerate(zip((1e-5, 1e-8, 1.0, 1e-8, 1e-7, 1e-6, 1e-6), names)):
        for _attempt in range(6):
            direction = torch.randn(values[i].shape, generator=g, dtype=torch.float64)
            # a few particles alone: of a thousand one always starts to slide
            direction[20:] = 0

            def shifted(s, i=i, direction=direction):
                return float(
                    loss([v + s * direction if j == i else v for j, v in enumerate(values)])
                )

            fine, coarse = ((shifted(h) - shifted(-h)) / (2 * h) for h in (size, 2 * size))
            allowed = 1e-6 * abs(fine) + rounding / size
            if abs(fine - coarse) < allowed:
                break
        else:
            pytest.fail(
                f"{name_}: no direction in which differences of two steps agree: {fine}, {coarse}, {allowed}"
            )
        assert abs(float((gradients[i] * direction).sum()) - fine) < allowed, name_


def test_what_a_solid_does_to_one_particle():
    """By hand: a ball of radius 5 mm that is 2 mm deep in a moving plane, in each mode."""
    x, v = (
        torch.tensor([[0.0, 0.0, 0.003]]).double().expand(COUNT, 3),
        torch.tensor([[3.0, 0.0, -1.0]]).double().expand(COUNT, 3),
    )
    ones = torch.ones(COUNT).double()
    eye, none, moves = (
        torch.eye(3).double()[None],
        torch.zeros(1, 3).double(),
        torch.tensor([[1.0, 0.0, 0.5]]).double(),
    )
    stiff = DT * 1e4 * 0.002
    for mode, friction, expected in (("touch", 0.5, (3 - 0.5 * stiff, -1 + stiff)), ("slip", 0.0, (3.0, -1 + 2.4 * stiff)),
                                     ("separate", 0.5, (3 - 1.2 * stiff, -1 + 2.4 * stiff)),
                                     ("sticky", 0.0, (3 - HOLD * 2, -1 + 2.4 * stiff))):  # fmt: skip
        found, force, _ = forward([Collider(HalfSpace(), mode, friction)], v, x, 1e4 * ones, [none, eye, moves, none],
                                  (2 * ones, 1e-6 * ones))  # fmt: skip
        torch.testing.assert_close(found[0], torch.tensor([expected[0], 0.0, expected[1]]).double())
        torch.testing.assert_close(force[0], (v - found).sum(0) * 2 / DT)
