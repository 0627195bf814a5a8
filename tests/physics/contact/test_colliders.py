"""Moving colliders in rollouts: planes, momentum balance, friction, rolling, squeezing, gradients."""

import math
from dataclasses import replace

import pytest
import torch

from mosa.physics.constitutive.elasticity import lame
from mosa.physics.contact.colliders import (
    Box,
    Capsule,
    Collider,
    Cylinder,
    HalfSpace,
    Sphere,
    domain_walls,
)
from mosa.physics.contact.motion import Motion, Trajectory, exponential
from mosa.physics.contact.planes import Plane
from mosa.physics.contact.reference import signed_distance
from mosa.physics.contact.touch import GRIP
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.types import ParticleState

DX, SPACING, DENSITY = 0.04, 0.02, 1000.0
PARAMETERS = {"mu": 4e4, "lam": 5e4}


DOWN = (0.0, 0.0, -9.8)


def rollout(
    state,
    colliders=(),
    frames=3,
    substeps=25,
    law="corotated",
    parameters=PARAMETERS,
    gravity=DOWN,
    **options,
):
    volume = torch.full((len(state.x),), SPACING**3, dtype=state.x.dtype)
    simulator = Simulator(law, dx=DX, substeps=substeps, frame_dt=4e-4 * substeps, gravity=gravity, colliders=colliders,
                          dtype=state.x.dtype, **options)  # fmt: skip
    return simulator.rollout(state, parameters, volume, DENSITY, frames)


def lattice(size, spacing=SPACING):
    """Particles of a cuboid of this size about the origin."""
    axes = [(torch.arange(round(s / spacing)).double() + 0.5) * spacing - s / 2 for s in size]
    return torch.cartesian_prod(*axes)


def at_rest(x, v=(0.0, 0.0, 0.0)):
    eye = torch.eye(3).double().expand(len(x), 3, 3).contiguous()
    v = torch.tensor(v, dtype=torch.float64).expand_as(x).contiguous()
    return ParticleState(x.contiguous(), v, torch.zeros_like(eye), eye, eye)


def acceleration(times, position):
    """Of the parabola through positions (T,)."""
    A = torch.stack([torch.ones_like(times), times, times**2 / 2], 1)
    return float(torch.linalg.lstsq(A, position).solution[2])


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_a_resting_half_space_or_box_is_the_plane(friction, make_block):
    state = make_block()
    plane = rollout(
        state, planes=[Plane((0, 0.01, 0), (0, 1, 0), "touch", friction)], gravity=(0.0, -9.8, 0.0)
    )
    turned = Motion((0.0, 0.01, 0.0), (-math.pi / 2, 0.0, 0.0))
    slab = Motion(position=(0.0, -0.99, 0.0))
    for collider in (
        Collider(HalfSpace(), "touch", friction, turned),
        Collider(Box((9.0, 2.0, 9.0)), "touch", friction, slab),
    ):
        found = rollout(state, [collider], gravity=(0.0, -9.8, 0.0))
        torch.testing.assert_close(found.x, plane.x, rtol=0, atol=1e-14)
    free = rollout(state, gravity=(0.0, -9.8, 0.0))
    assert (free.x - plane.x).abs().max() > 1e-3 and free.reactions is None


def turned_drop(shape, top: float, mode: str, friction: float, degrees: float):
    """(positions of a block of 1000 particles at 10 frames, reactions), both turned back, of a tilted fall from 0.3 m (2.4 m/s)
    onto a solid whose origin is `top` [m] below its surface. The whole world is turned, about an axis that is none of the grid's.
    """
    R = exponential(math.radians(degrees) * torch.tensor([0.8, 0.6, 0.0]).double())
    x = lattice((0.2, 0.2, 0.2))
    tilt = exponential(torch.tensor([0.3, 0.0, 0.2]).double())
    x = x @ tilt.T + torch.tensor([0.03, -0.02, 0.0]).double()
    x[:, 2] += 0.012 - x[:, 2].min()
    motion = Motion(R @ torch.tensor([0.0, 0.0, -top]).double(), R)
    eye = torch.eye(3).double().expand(len(x), 3, 3).contiguous()
    v = torch.tensor([0.3, 0.0, -2.4]).double() @ R.T
    start = ParticleState((x @ R.T).contiguous(), v.expand_as(x).contiguous(), 0 * eye, eye, eye)
    pull = R @ torch.tensor(DOWN).double()
    result = rollout(
        start, [Collider(shape, mode, friction, motion)], frames=10, law="neo_hookean", gravity=pull
    )
    return result.x @ R, result.reactions.unflatten(-1, (2, 3)) @ R


@pytest.mark.parametrize("shape, top, mode, friction", [
    (HalfSpace(), 0.0, "sticky", 0.0), (HalfSpace(), 0.0, "touch", 0.4), (HalfSpace(), 0.0, "slip", 0.0),
    (Box((0.3, 0.3, 0.2)), 0.1, "separate", 0.4), (Sphere(0.15), 0.15, "touch", 0.3),
])  # fmt: skip
def test_a_world_that_is_turned_has_the_same_motion(shape, top, mode, friction):
    """To a quarter of a cell, and the same impulse. With nodes in contact in place of particles it was up to two cells."""
    flat, force = turned_drop(shape, top, mode, friction, 0.0)
    impulse = force[..., 0, :].sum((0, 1, 2))
    assert float(impulse.norm()) * 4e-4 > 8.0 * 2.4  # a block of 8 kg is stopped and thrown back
    for degrees in (10.0, 30.0):
        found, felt = turned_drop(shape, top, mode, friction, degrees)
        assert float((found - flat).norm(dim=-1).square().mean(1).sqrt().max()) < 0.25 * DX
        torch.testing.assert_close(
            felt[..., 0, :].sum((0, 1, 2)), impulse, rtol=0, atol=0.02 * float(impulse.norm())
        )


def test_galilean_invariance(make_block):
    """Body and spinning collider seen from a moving frame: the same force and the same change of velocity in a substep."""
    state = make_block()
    w = torch.tensor([4.0, 0.0, -4.0]).double()
    results = []
    for boost in (0 * w, w):
        motion = Motion(
            (0.15, -0.005, 0.11),
            (0.3, 0.0, 0.1),
            torch.tensor([0.1, 0.3, 0.0]).double() + boost,
            (2.0, -3.0, 1.0),
        )
        collider = Collider(Capsule(0.05, 0.1), "separate", 0.3, motion)
        shifted = replace(state, v=state.v + boost)
        results.append(rollout(shifted, [collider], frames=2, substeps=1))
    assert float(results[0].reactions[0, 0, 0, :3].norm()) > 1
    torch.testing.assert_close(results[1].reactions, results[0].reactions, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(results[1].v[1], results[0].v[1] + w, rtol=0, atol=1e-10)


def test_rotated_and_shifted_scene(make_block):
    """Scene and collider turned by 90 degrees and moved by whole cells: the same motion over 200 substeps."""
    state = make_block(velocity=(0.0, -1.0, 0.0))
    Q = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()
    shift = DX * torch.tensor([3.0, -2.0, 5.0]).double()
    eye = torch.eye(3).double().expand_as(state.F).contiguous()
    state = replace(state, F=eye, F_tot=eye)
    turned_F = Q.expand_as(eye).contiguous()
    turned = ParticleState(
        state.x @ Q.T + shift, state.v @ Q.T, Q @ state.C_affine @ Q.T, turned_F, turned_F
    )
    position, spin, velocity = (
        torch.tensor(a).double() for a in ((0.16, -0.05, 0.1), (0.0, 3.0, 5.0), (0.1, 0.2, 0.0))
    )
    attitude = exponential(torch.tensor([0.3, 0.1, 0.0]).double())
    motions = (
        Motion(position, attitude, velocity, spin),
        Motion(Q @ position + shift, Q @ attitude, Q @ velocity, Q @ spin),
    )
    down = torch.tensor([0.0, -9.8, 0.0]).double()
    first, second = (
        rollout(
            start,
            [Collider(Capsule(0.08, 0.1), "separate", 0.4, motion)],
            substeps=100,
            gravity=gravity,
        )
        for start, motion, gravity in zip((state, turned), motions, (down, Q @ down))
    )
    assert first.reactions[..., :3].norm(dim=-1).max() > 10
    assert (second.x[-1] - (first.x[-1] @ Q.T + shift)).abs().max() < 1e-10 * DX
    force = first.reactions.unflatten(-1, (2, 3)) @ Q.T
    torch.testing.assert_close(
        second.reactions.unflatten(-1, (2, 3)), force, rtol=0, atol=1e-8 * float(force.abs().max())
    )


@pytest.mark.parametrize("mode, friction", [("sticky", 0.0), ("slip", 0.0), ("separate", 0.3)])
def test_action_is_reaction(mode, friction, make_block):
    """No gravity, two moving colliders: the change of the body's linear and angular momentum is what the colliders took."""
    state = make_block(n=5, velocity=(0.0, -1.5, 0.0))
    motions = [Motion((0.16, -0.03, 0.12), (0.2, 0.1, 0.0), (0.1, 0.5, 0.0), (1.0, 5.0, 0.0)),
               Motion((0.3, 0.1, 0.1), velocity=(-1.5, 0.0, 0.0))]  # fmt: skip
    colliders = [Collider(Box((0.3, 0.1, 0.2)), mode, friction, motions[0]),
                 Collider(Cylinder(0.06, 0.3), mode, friction, motions[1])]  # fmt: skip
    result = rollout(state, colliders, gravity=(0, 0, 0), frames=4)
    mass, dt = DENSITY * SPACING**3, 4e-4
    x = torch.stack([m.sample(3, 25, dt)[0] for m in motions], 1).reshape(3, 25, 2, 3)
    force, torque = result.reactions[..., :3], result.reactions[..., 3:]

    def momenta(s):
        C = s.C_affine * DX**2 / 4
        spin = torch.stack(
            [C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], 1
        )
        return mass * s.v.sum(0), mass * (torch.linalg.cross(s.x, s.v) + spin).sum(0)

    (p0, l0), (p1, l1) = momenta(state), momenta(result.final)
    given = dt * force.sum((0, 1, 2)), dt * (torque + torch.linalg.cross(x, force)).sum((0, 1, 2))
    assert force.norm(dim=-1).amax((0, 1)).min() > 1 and (p1 - p0).norm() > 0.1 * p0.norm()
    size = mass * state.v.norm(dim=1).sum()
    assert (p1 - p0 + given[0]).abs().max() < 1e-12 * size
    assert (l1 - l0 + given[1]).abs().max() < 1e-12 * size


def test_sticky_drags_a_body_along():
    """A cube glued between two plates is carried and turned with them, and takes no force at constant velocity."""
    x = lattice((0.2, 0.2, 0.2))
    velocity = torch.tensor([0.6, -0.3, 0.2]).double()
    plates = [
        Collider(Box((0.4, 0.4, 0.1)), "sticky", motion=Motion((0.0, 0.0, z), velocity=velocity))
        for z in (-0.13, 0.13)
    ]
    dragged = rollout(at_rest(x), plates, frames=41, gravity=(0, 0, 0))
    late = dragged.v[30:].mean((0, 1))
    assert (late - velocity).norm() < 0.02 * velocity.norm()
    impulse = dragged.reactions[..., :3].sum((0, 1, 2)) * 4e-4
    torch.testing.assert_close(
        -impulse, DENSITY * SPACING**3 * dragged.v[-1].sum(0), rtol=1e-12, atol=1e-12
    )


def test_body_flows_around_and_does_not_enter():
    """A soft block falls on a sphere and a capsule: no particle deeper than a cell, the grid's own blur; without them
    it passes through."""
    x = lattice((0.24, 0.24, 0.24)) + torch.tensor([0.0, 0.0, 0.28]).double()
    shapes = [
        (Sphere(0.12), Motion((0.02, 0.0, 0.0))),
        (Capsule(0.08, 0.3), Motion((-0.12, 0.0, 0.02), (math.pi / 2, 0.0, 0.0))),
    ]
    colliders = [Collider(shape, "separate", 0.1, motion) for shape, motion in shapes]
    mu, lam = lame(torch.tensor(2e4).double(), torch.tensor(0.3).double())
    soft = {
        "frames": 26,
        "law": "von_mises",
        "parameters": {"mu": mu, "lam": lam, "yield_stress": 500.0},
    }
    result, passed = (
        rollout(at_rest(x, (0.0, 0.0, -1.5)), solid, **soft) for solid in (colliders, [])
    )
    for shape, motion in shapes:
        R = exponential(torch.tensor(motion.rotation).double())
        deepest, free = (min(float(signed_distance(shape, (x - torch.tensor(motion.position)) @ R).min()) for x in r.x)
                         for r in (result, passed))  # fmt: skip
        assert -DX < deepest < 0.3 * DX and free < -1.5 * DX
    assert (result.x[-1][:, 2] < 0.05).any()  # and it has flowed past


@pytest.mark.parametrize("turn", [0.0, 20.0])
def test_block_slips_at_the_friction_angle(turn):
    """Along the grid and 20 degrees out of it: one degree below the friction angle it holds, one above it slides. What holds is
    a friction of at most GRIP of a particle's velocity in a substep: it gives way until that is the pull of all layers above."""
    friction, seen = 0.3, []
    R = exponential(torch.tensor([0.0, math.radians(turn), 0.0]).double())
    for degrees in (-1.0, 1.0, 3.0):
        angle = math.atan(friction) + math.radians(degrees)
        gravity = 9.8 * R @ torch.tensor([math.sin(angle), 0.0, -math.cos(angle)]).double()
        mu, lam = lame(torch.tensor(5e5).double(), torch.tensor(0.3).double())
        x = (lattice((0.24, 0.24, 0.12)) + torch.tensor([0.0, 0.0, 0.06]).double()) @ R.mT
        simulator = Simulator("neo_hookean", dx=DX, substeps=45, frame_dt=0.024, gravity=gravity, dtype=torch.float64,
                              colliders=[Collider(HalfSpace(), "separate", friction, Motion(rotation=R))])  # fmt: skip
        volume = torch.full((len(x),), SPACING**3).double()
        result = simulator.rollout(at_rest(x), {"mu": mu, "lam": lam}, volume, DENSITY, 26)
        along = (result.x.mean(1) @ R)[:, 0]
        seen.append((acceleration(result.times[10:], along[10:]), 9.8 * (math.sin(angle) - friction * math.cos(angle)),
                     float((result.v[-1].mean(0) @ R)[0])))  # fmt: skip
    (_, _, held), *sliding = seen
    pull = 9.8 * math.sin(math.atan(friction) - math.radians(1.0))
    assert held == pytest.approx(pull * (0.024 / 45) * (0.12 / SPACING) / GRIP, rel=0.15)
    for found, expected, velocity in sliding:
        assert (
            found == pytest.approx(expected, abs=0.2 * 9.8 * math.radians(1.0)) and velocity > 0.1
        )


def test_sphere_rolls_down_an_incline():
    """5/7 g sin(angle) without slipping; 0.95 and 0.96 of it at 7 and 10 cells, as contact that opens and closes takes energy."""
    cells, radius, angle = 7, 0.1, math.radians(20)
    dx = radius / cells
    x = lattice((2.4 * radius,) * 3, dx / 2)
    x = x[x.norm(dim=1) < radius] + torch.tensor([0.0, 0.0, radius]).double()
    mu, lam = lame(torch.tensor(5e5).double(), torch.tensor(0.3).double())
    substeps = required_substeps(float(lam + 2 * mu), DENSITY, 0.02, dx, 3.0)
    simulator = Simulator("neo_hookean", dx=dx, substeps=substeps, frame_dt=0.02, dtype=torch.float32,
                          gravity=(9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle)),
                          colliders=[Collider(HalfSpace(), "touch", 0.6)])  # fmt: skip
    start = at_rest(x)
    start = ParticleState(
        *(getattr(start, k).float() for k in ("x", "v", "C_affine", "F", "F_tot"))
    )
    result = simulator.rollout(
        start, {"mu": mu, "lam": lam}, torch.full((len(x),), (dx / 2) ** 3), DENSITY, 26
    )
    centre = result.x.double().mean(1)
    found = acceleration(result.times[8:].double(), centre[8:, 0]) / (9.8 * math.sin(angle))
    assert found == pytest.approx(5 / 7, rel=0.06)
    # rolling, not sliding: it spins as fast as it goes, less what it lost when it landed
    arm, v = result.x[-1].double() - centre[-1], result.v[-1].double()
    spin = float((v[:, 0] * arm[:, 2] - v[:, 2] * arm[:, 0]).sum() / (arm[:, [0, 2]] ** 2).sum())
    assert spin * radius == pytest.approx(float(v[:, 0].mean()), rel=0.1)


def test_squeezed_block_answers_with_the_uniaxial_stress():
    """Quasi-static, between slipping plates: force on either plate = sigma(stretch) times the area, neo-Hooke, within 3 %.

    The stretch is that of the middle half: next to a plate the grid's wall is up to half a cell off the plate's surface."""
    edge, cells, stroke, duration, frames = 0.2, 10, 0.2, 0.8, 40
    dx = edge / cells
    mu, lam = lame(torch.tensor(1e5).double(), torch.tensor(0.3).double())
    x = lattice((edge,) * 3, dx / 2)
    start, rate = at_rest(x), stroke / duration
    shear = torch.diag(torch.tensor([0.3, 0.3, -1.0]).double()) * rate
    start = replace(
        start, v=(x @ shear).contiguous(), C_affine=shear.expand(len(x), 3, 3).contiguous()
    )
    motions = [Motion((0, 0, s * edge), velocity=(0, 0, -s * rate * edge / 2)) for s in (-1, 1)]
    plates = [
        Collider(Box((4 * edge, 4 * edge, edge)), "slip", motion=motion) for motion in motions
    ]
    simulator = Simulator("neo_hookean", dx=dx, substeps=required_substeps(float(lam + 2 * mu), DENSITY, 0.02, dx, 1.0),
                          frame_dt=duration / frames, gravity=(0, 0, 0), colliders=plates, dtype=torch.float64)  # fmt: skip
    result = simulator.rollout(
        start,
        {"mu": mu, "lam": lam},
        torch.full((len(x),), (dx / 2) ** 3).double(),
        DENSITY,
        frames + 1,
    )
    below, above = result.reactions[..., 0, 2].mean(1), -result.reactions[..., 1, 2].mean(1)
    torch.testing.assert_close(-below, -above, rtol=1e-6, atol=1e-6)
    stretch = result.F[:, x[:, 2].abs() < edge / 4, 2, 2].mean(1)
    stretch = 0.5 * (stretch[1:] + stretch[:-1])
    side = torch.ones_like(stretch)  # free sides: mu (side^2 - 1) + lam log(J) = 0
    for _ in range(30):
        rest = mu * (side**2 - 1) + lam * torch.log(side**2 * stretch)
        side = side - rest / (2 * mu * side + 2 * lam / side)
    expected = (mu * (stretch**2 - 1) + lam * torch.log(side**2 * stretch)) / stretch * edge**2
    late = slice(frames // 4, None)
    assert stretch[-1] < 0.88
    assert float(((-below.abs() - expected) / expected)[late].abs().max()) < 0.03


CASES = {
    "glued box": (Box((0.3, 0.1, 0.25)), "sticky", 0.0),
    "rubbing sphere": (Sphere(0.12), "separate", 0.3),
    "slipping capsule": (Capsule(0.07, 0.15), "slip", 0.0),
    "rubbing cylinder": (Cylinder(0.09, 0.3), "touch", 0.3),
}


@pytest.mark.parametrize("name", CASES)
def test_gradient_of_a_rollout(name, make_block, monkeypatch):
    """In pose, velocities (per frame), the body's position and velocity and its stiffness; loss on the state and the reactions."""
    shape, mode, friction = CASES[name]
    monkeypatch.setattr("mosa.physics.engine.stepping.SEGMENT", 8)
    state = make_block(velocity=(0.0, -0.8, 0.0))
    leaves = {"position": [0.15, -0.05, 0.11], "rotation": [0.2, -0.1, 0.3], "velocity": [[0.2, 0.4, 0.0], [0.0, 0.6, -0.2]],
              "angular_velocity": [[1.0, 0.0, 2.0], [0.0, -3.0, 1.0]], "x0": [0.0] * 3, "v0": [0.0] * 3, "mu": 4e4}  # fmt: skip
    leaves = {
        k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in leaves.items()
    }
    simulator = Simulator("corotated", dx=DX, substeps=15, frame_dt=6e-3, gravity=(0, 0, 0), dtype=torch.float64,
                          colliders=[Collider(Sphere(0.05), "slip", motion=Motion((0.15, 0.13, 0.1))),
                                     Collider(shape, mode, friction)])  # fmt: skip
    g = torch.Generator().manual_seed(3)
    weights = {k: torch.randn(s, generator=g, dtype=torch.float64) for k, s in
               {"x": (3, 64, 3), "v": (3, 64, 3), "F": (3, 64, 3, 3), "reactions": (2, 15, 2, 6)}.items()}  # fmt: skip
    weights["reactions"] *= 0.1

    def loss(leaves):
        motion = Motion(
            *(leaves[k] for k in ("position", "rotation", "velocity", "angular_velocity"))
        )
        start = replace(state, x=state.x + leaves["x0"], v=state.v + leaves["v0"])
        result = simulator.rollout(start, {"mu": leaves["mu"], "lam": 5e4}, torch.full((64,), SPACING**3).double(), DENSITY, 3,
                                   motions=[simulator.colliders[0].motion, motion])  # fmt: skip
        assert float(result.reactions.detach()[..., :3].norm(dim=-1).amax((0, 1)).min()) > 1
        return sum((weights[k] * getattr(result, k)).sum() for k in weights)

    found = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values()))))
    steps = {"mu": 0.4, "x0": 1e-7, "position": 1e-7, "rotation": 1e-6}
    if isinstance(shape, Sphere):  # it does not feel its attitude
        assert float(found.pop("rotation").abs().max()) < 1e-8
    for key in found:
        for _attempt in range(3):
            direction = torch.randn(leaves[key].shape, generator=g, dtype=torch.float64)

            def shifted(s, key=key, direction=direction):
                with torch.no_grad():
                    return float(loss({**leaves, key: leaves[key] + s * direction}))

            h = steps.get(key, 1e-6)
            estimates = [
                (8 * (shifted(s) - shifted(-s)) - (shifted(2 * s) - shifted(-2 * s))) / (12 * s)
                for s in (h, 2 * h)
            ]
            # a contact that opens or a node that changes sides between the steps is no derivative (docs/verification.md, check 18)
            apart = abs(estimates[0] - estimates[1]) / abs(estimates[0])
            if apart < 1e-6:
                break
        assert apart < 1e-5, (key, estimates)
        value = float((found[key] * direction).sum())
        allowed = max(1e-6, 10 * apart if mode == "separate" else 0)
        assert min(abs(value - e) / abs(e) for e in estimates) < allowed, (key, value, estimates)


def test_a_flat_face_is_differentiable_in_its_height():
    """A resting plate's height, against differences: no jump as a particle comes to touch it."""
    x = lattice((0.12, 0.12, 0.12)) + torch.tensor([0.0, 0.0, 0.07]).double()

    def height_after(z):
        motion = Motion(torch.stack([0 * z, 0 * z, z]))
        return (
            rollout(at_rest(x, (0.0, 0.0, -1.0)), [Collider(HalfSpace(), "separate", 0.0, motion)])
            .x[-1][:, 2]
            .mean()
        )

    z = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(height_after(z), z)
    with torch.no_grad():
        difference = (height_after(z + 1e-3) - height_after(z - 1e-3)) / 2e-3
    assert float(slope) > 0.01 and float(slope) == pytest.approx(float(difference), rel=0.02)


def test_continued_rollout_takes_the_motion_up(make_block):
    state = make_block()
    motion = Motion.waypoints(
        [0.0, 0.015, 0.05], [[0.15, -0.1, 0.1], [0.15, 0.0, 0.1], [0.0, 0.0, 0.0]]
    )
    collider = Collider(Sphere(0.1), "separate", 0.2, motion)
    simulator = Simulator(
        "corotated",
        dx=DX,
        substeps=25,
        frame_dt=0.01,
        gravity=DOWN,
        colliders=[collider],
        dtype=torch.float64,
    )
    volume = torch.full((64,), SPACING**3).double()
    whole = simulator.rollout(state, PARAMETERS, volume, DENSITY, 5)
    first = simulator.rollout(state, PARAMETERS, volume, DENSITY, 3)
    rest = simulator.rollout(
        first.final, PARAMETERS, volume, DENSITY, 3, started=True, start_time=0.02
    )
    torch.testing.assert_close(rest.x[-1], whole.x[-1], rtol=0, atol=1e-13)
    assert whole.reactions.shape == (4, 25, 1, 6)
    sampled = Trajectory(*collider.motion.sample(4, 25, simulator.dt))
    again = simulator.rollout(state, PARAMETERS, volume, DENSITY, 5, motions=[sampled])
    assert torch.equal(again.x, whole.x)


def test_a_layer_of_particles_on_what_sticks_stays():
    """Nodes below it hold nothing else, so that all it is given comes back to it."""
    x = lattice((0.12, 0.12, 0.02)) + torch.tensor([0.0, 0.0, 0.012]).double()
    found = rollout(at_rest(x, (1.0, 0.0, -0.1)), [Collider(HalfSpace(), "sticky")], frames=11)
    assert found.v[-1].abs().max() < 0.2 and (found.x[-1] - found.x[0])[:, 0].abs().max() < 0.02


@pytest.mark.parametrize("mode", ["separate", "touch"])
def test_domain_walls_keep_a_body_in(mode):
    walls = domain_walls(torch.tensor([[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]]), mode)
    result = rollout(
        at_rest(lattice((0.12, 0.12, 0.12)), (3.0, -2.0, -1.0)), planes=walls, frames=16
    )
    assert result.x.abs().max() < 0.2 + 0.5 * DX
    assert result.x[:, :, 0].max() > 0.15 and result.v[-1][:, 0].mean() < 2.0
