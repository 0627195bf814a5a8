"""Contact at the nodes: kernel against the torch twin, its adjoint against the twin's autograd and against differences."""

import pytest
import torch
import warp as wp

from mosa.physics.contact.collider_kernels import collider_kernels
from mosa.physics.contact.colliders import Box, Capsule, Collider, Cylinder, HalfSpace, Sphere, pack_colliders
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.motion import exponential
from mosa.physics.contact.reference import collide

DT, DX, DIMS, COUNT = 0.01, 0.05, (12, 11, 10), 12 * 11 * 10
KERNELS = collider_kernels(wp.float64)
VEC3, MAT33, VEC4 = wp.vec3d, wp.mat33d, wp.vec4d


def uneven_field():
    """A smooth lattice of values that is no distance of anything: all its derivatives differ from 0."""
    axes = [0.06 * torch.arange(n).double() - 0.3 for n in (11, 12, 10)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    values = torch.sqrt((1.3 * x + 0.2 * y) ** 2 + y**2 + (z + 0.4 * x * y) ** 2 + 0.01) - 0.22
    return SignedDistanceField(values, (-0.3,) * 3, 0.06, 0.1)


SHAPES = {"half space": HalfSpace(), "sphere": Sphere(0.2), "capsule": Capsule(0.1, 0.2), "cylinder": Cylinder(0.15, 0.25),
          "box": Box((0.3, 0.2, 0.35)), "field": uneven_field()}  # fmt: skip


def drawn(colliders, seed=0):
    """(velocity, mass, position, rotation vectors, linear, angular, seeds of velocity, force, torque); the scene is 0.5 m wide."""
    g = torch.Generator().manual_seed(seed)
    k = len(colliders)
    u, mass = torch.randn(COUNT, 3, generator=g).double(), 0.1 + torch.rand(COUNT, generator=g).double()
    mass = mass * (torch.rand(COUNT, generator=g) > 0.1)
    centre = torch.tensor([0.27, 0.24, 0.22]).double() + 0.02 * torch.randn(k, 3, generator=g).double()
    others = [torch.randn(n, 3, generator=g).double() for n in (k, k, k, COUNT, k, k)]
    return [u, mass, centre, *others]


def nodes():
    return DX * torch.cartesian_prod(*[torch.arange(n) for n in DIMS]).double()


def arguments(threads, colliders, grid, poses, *free):
    """free: impulses and planes, of the kernel that begins with the momentum."""
    packed = pack_colliders(colliders, torch.float64, torch.device("cpu"), 0.1)
    kinds = (VEC3, MAT33, VEC3, VEC3)
    # poses are those of substep 2 of 3
    held = [torch.stack([torch.full_like(p, 7.0), torch.full_like(p, 7.0), p]).contiguous() for p in poses]
    return [
        wp.array([(0, 0, 0), DIMS, (0, 0, 0)], dtype=wp.vec3i, device="cpu"), threads, wp.from_torch(grid, dtype=VEC4), *free[:1],
        0.0, DX, *free[1:], 1 / DT, len(colliders), 2,
        *(wp.from_torch(t, dtype=kind) for t, kind in zip(packed, (wp.float64, wp.int32, wp.float64))),
        *(wp.from_torch(p, dtype=kind) for p, kind in zip(held, kinds)),
    ]  # fmt: skip


def padded(u):
    """Node vectors (n, 3) as the kernels have them, with an unused fourth number."""
    return torch.cat([u, torch.full_like(u[:, :1], torch.nan)], 1)


def forward(colliders, u, mass, poses):
    """(velocity, force, torque) of the kernel, of nodes that neither gravity nor a plane changes; it clears another grid beside."""
    velocity, threads = padded(torch.full_like(u, torch.nan)), 11  # some nodes for each
    grid, cleared = torch.cat([mass[:, None] * u, mass[:, None]], 1), torch.ones(COUNT, 4).double()
    nothing = ((1, VEC3), ((1, 6), wp.float64), (1, int))
    free = *(wp.zeros(shape, dtype=kind, device="cpu") for shape, kind in nothing), 0
    force, torque = (torch.zeros(3, len(colliders), 3).double() for _ in range(2))
    inputs = [*arguments(threads, colliders, grid, poses, *free), wp.from_torch(velocity, dtype=VEC4),
              wp.from_torch(cleared, dtype=VEC4), *(wp.from_torch(t, dtype=VEC3) for t in (force, torque))]  # fmt: skip
    wp.launch(KERNELS.update_and_collide, threads, inputs=inputs, device="cpu")
    assert float(force[:2].abs().sum() + torque[:2].abs().sum()) == 0 and not cleared.any()
    return velocity[:, :3], force[2], torque[2]


def backward(colliders, u, mass, poses, seeds):
    """Gradients in (u, mass, position, rotation, linear, angular) of the kernel."""
    a, threads = padded(seeds[0]), COUNT + 5  # some without a node
    adj_force, adj_torque = (torch.stack([torch.full_like(s, 3.0)] * 2 + [s]).contiguous() for s in seeds[1:])
    adj_mass = torch.zeros(COUNT).double()
    adj_poses = [torch.zeros(3, *p.shape).double() for p in poses]
    kinds = [VEC4, VEC3, VEC3, VEC4, wp.float64, VEC3, MAT33, VEC3, VEC3]
    arrays = [padded(u), adj_force, adj_torque, a, adj_mass, *adj_poses]
    grid = torch.cat([torch.zeros(COUNT, 3).double(), mass[:, None]], 1)
    inputs = [*arguments(threads, colliders, grid, poses), *(wp.from_torch(t, dtype=kind) for t, kind in zip(arrays, kinds))]
    wp.launch(KERNELS.adj_collide_nodes, threads, inputs=inputs, device="cpu")
    return [a[:, :3], adj_mass, *(p[2] for p in adj_poses)]


CASES = [(name, mode, friction, thickness)
         for name in SHAPES for mode, friction in (("sticky", 0.0), ("slip", 0.0), ("separate", 0.0), ("separate", 0.4))
         for thickness in (0.0, 0.08)]  # fmt: skip


@pytest.mark.parametrize("name, mode, friction, thickness", CASES)
def test_kernel_and_adjoint_against_the_twin(name, mode, friction, thickness):
    """With a second collider after it, so that the order of contacts is differentiated through."""
    colliders = [Collider(SHAPES[name], mode, friction, thickness=thickness),
                 Collider(Sphere(0.15), "separate", 0.2, thickness=0.05)]  # fmt: skip
    u, mass, position, turns, linear, angular, *seeds = drawn(colliders)
    inside = mass > 0
    leaves = [t.clone().requires_grad_() for t in (u, mass, position, exponential(turns), linear, angular)]
    expected = collide(leaves[0], leaves[1], nodes(), colliders, leaves[2:], DT)
    poses = [t.detach() for t in leaves[2:]]
    found = forward(colliders, u, mass, poses)
    torch.testing.assert_close(found[0][inside], expected[0].detach()[inside], rtol=1e-12, atol=1e-12)
    for a, b in zip(found[1:], expected[1:]):
        torch.testing.assert_close(a, b.detach(), rtol=1e-12, atol=1e-10)
    assert ((found[0] - u)[inside].abs() > 1e-6).any(1).sum() > 100
    loss = (expected[0] * seeds[0])[inside].sum() + (expected[1] * seeds[1]).sum() + (expected[2] * seeds[2]).sum()
    gradients = torch.autograd.grad(loss, leaves)
    for i, (a, b) in enumerate(zip(backward(colliders, u, mass, poses, seeds), gradients)):
        if i < 2:
            a, b = a[inside], b[inside]
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10 * float(b.abs().max()))


@pytest.mark.parametrize("name, mode, friction, thickness", CASES)
def test_adjoint_against_differences(name, mode, friction, thickness):
    """Pose and velocity of one collider, node velocities and masses: 1e-6. Steps across which a node changes sides, or the contact
    opens or sticks at a node, or the distance has an edge, have no derivative: two steps tell them, a second direction replaces."""
    colliders = [Collider(SHAPES[name], mode, friction, thickness=thickness)]
    u, mass, position, turns, linear, angular, *seeds = drawn(colliders)
    seeds[0] = seeds[0] * (mass > 0)[:, None]  # a node without mass has no velocity

    def loss(values):
        velocity, force, torque = forward(colliders, values[0], values[1], [values[2], exponential(values[3]), *values[4:]])
        return (velocity * seeds[0]).sum() + (force * seeds[1]).sum() + (torque * seeds[2]).sum()

    values = [u, mass, position, turns, linear, angular]
    leaf = turns.clone().requires_grad_()
    R = exponential(leaf)
    gradients = backward(colliders, u, mass, [position, R.detach(), linear, angular], seeds)
    (gradients[3],) = torch.autograd.grad(R, leaf, gradients[3])
    g = torch.Generator().manual_seed(5)
    # rounding of a difference of sums over nodes, whose force terms are of the size m |u|/dt (a sphere does not feel its rotation)
    size = 10.0 * sum(float(s.abs().sum()) for s in seeds[1:]) / DT
    for i, name_ in enumerate(("u", "mass", "position", "rotation", "linear", "angular")):
        for _attempt in range(4):
            direction = torch.randn(values[i].shape, generator=g, dtype=torch.float64)
            direction = direction * (mass > 0) if name_ == "mass" else direction

            def shifted(s, i=i, direction=direction):
                return loss([v + s * direction if j == i else v for j, v in enumerate(values)])

            fine, coarse = ((8 * (shifted(h) - shifted(-h)) - shifted(2 * h) + shifted(-2 * h)) / (12 * h) for h in (1e-5, 2e-5))
            allowed = 1e-6 * abs(float(fine)) + 3e-15 * size / 1e-5
            if abs(float(fine - coarse)) < allowed:
                break
        else:
            pytest.fail(f"{name_}: no direction in which differences of two steps agree: {float(fine)}, {float(coarse)}, {allowed}")
        assert abs(float((gradients[i] * direction).sum() - fine)) < allowed, name_
