"""A simulator's own axes: worlds that are turned or far away have the motion of the same world along the grid at its origin."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mosa.errors import ConfigError, SimulationDiverged
from mosa.physics.contact.colliders import Box, Collider
from mosa.physics.contact.motion import Motion, rotation_matrices
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.axes import PERIOD, Axes, shift_to, turn_along
from mosa.physics.engine.simulator import Simulator
from mosa.physics.grid.window import extent
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive
from mosa.types import Ground, ParticleState

DX, FRAME_DT, SUBSTEPS = 0.04, 0.02, 40
GRAVITY, UP = torch.tensor([0.0, -9.8, 0.0]).double(), torch.tensor([0.0, 1.0, 0.0]).double()
PARAMETERS = {"mu": 4e4, "lam": 6e4}
PADDLE = Motion((0.02, 0.06, 0.1), (0.0, 0.0, 0.3), (1.2, 0.1, 0.0), (0.0, 0.5, 1.0))
NAMES = ("x", "v", "C_affine", "F", "F_tot")


def turn(degrees, axis=(0.0, 0.0, 1.0)):
    axis = np.array(axis) / np.linalg.norm(axis)
    return torch.tensor(Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix())


def seen(state, Q, s, dtype):
    """A state in the world that is turned by Q and moved by s."""
    parts = state.x @ Q.T + s, state.v @ Q.T, Q @ state.C_affine @ Q.T, Q @ state.F, Q @ state.F_tot
    return ParticleState(parts[0], *(t.to(dtype).contiguous() for t in parts[1:]))


def moved(motion, Q, s):
    """A motion of the world that is turned by Q and moved by s."""
    turned = {
        name: torch.as_tensor(getattr(motion, name)).double() @ Q.T
        for name in ("velocity", "angular_velocity")
    }
    position, rotation = (
        Q @ torch.as_tensor(motion.position).double() + s,
        Q @ rotation_matrices(motion.rotation),
    )
    return replace(motion, position=position, rotation=rotation, **turned)


def fall(
    state,
    Q,
    s,
    mode="sticky",
    dtype=torch.float64,
    frames=9,
    law="neo_hookean",
    parameters=PARAMETERS,
    **options,
):
    up = Q @ UP
    sim = Simulator(law, dx=DX, substeps=SUBSTEPS, frame_dt=FRAME_DT, gravity=Q @ GRAVITY, up=up, dtype=dtype,
                    ground=Ground(float(s @ up), mode, 0.3 if mode in ("separate", "touch") else 0.0), **options)  # fmt: skip
    volume = torch.full((state.x.shape[-2],), (DX / 2) ** 3, dtype=dtype)
    return sim.rollout(seen(state, Q, s, dtype), parameters, volume, 1000.0, frames)


NOWHERE, FAR = (
    torch.zeros(3).double(),
    PERIOD * DX * torch.tensor([120.0, 1.0, -119.0]).double(),
)  # 9.8 km


@pytest.mark.parametrize("mode", ["sticky", "slip", "separate"])
@pytest.mark.parametrize("degrees, axis", [(10, (0, 0, 1)), (30, (1, 0, 0)), (44, (1, 0, -1))])
def test_a_turned_world_has_the_motion_of_one_along_the_grid(mode, degrees, axis, make_block):
    Q, state = turn(degrees, axis), make_block()
    with torch.no_grad():
        first, second = (
            fall(state, torch.eye(3).double(), NOWHERE, mode),
            fall(state, Q, NOWHERE, mode),
        )
    assert (second.x - first.x @ Q.T).abs().max() < 1e-9 * DX
    assert (second.F[-1] - Q @ first.F[-1]).abs().max() < 1e-9
    assert (second.v[-1] - first.v[-1] @ Q.T).abs().max() < 1e-8
    assert (
        float(first.v[-1][:, 1].mean()) > -1.0
    )  # it has met the ground: free fall would have passed -3


@pytest.mark.parametrize("place", [1.0, 0.1, 0.01])
def test_a_body_ten_kilometres_away_moves_as_one_at_the_origin(place, make_block):
    """In float32, with positions in float64; given in float32 they are rounded to a millimetre, once."""
    state, s = make_block(), place * FAR
    s = DX * torch.round(s / DX)  # the grid lies in the body as before
    with torch.no_grad():
        near, there = (
            fall(state, torch.eye(3).double(), at, "separate", torch.float32) for at in (NOWHERE, s)
        )
    assert there.x.dtype == torch.float64 == there.final.x.dtype and near.x.dtype == torch.float32
    assert (there.x - s - near.x).abs().max() < 1e-4  # 0.0025 cells
    rounded = replace(seen(state, torch.eye(3).double(), s, torch.float32), x=(state.x + s).float())
    with torch.no_grad():
        ground = Ground(float(s[1]), "separate", 0.3)
        sim = Simulator(
            "neo_hookean",
            dx=DX,
            substeps=SUBSTEPS,
            frame_dt=FRAME_DT,
            gravity=GRAVITY,
            ground=ground,
        )
        found = sim.rollout(
            rounded, PARAMETERS, torch.full((len(state.x),), (DX / 2) ** 3), 1000.0, 9
        )
    assert (
        found.x.mean(1) - found.x[0].mean(0) - (near.x.mean(1) - near.x[0].mean(0))
    ).abs().max() < 2e-3


def test_all_that_is_spatial_is_turned(make_block):
    """Plastic flow, spin, an adapter's law, gradients, reactions of a collider with a motion, in a world that is far away too."""
    Q = turn(37, (1, 0, -0.5))
    made = make_block()
    law = {"law": "von_mises", "parameters": PARAMETERS | {"yield_stress": 800.0}}

    def run(Q, s):
        state = replace(made, x=made.x.clone().requires_grad_())
        velocity = torch.tensor([1.2, 0.1, 0.0]).double().requires_grad_()
        motion = replace(PADDLE, velocity=velocity)
        motion = moved(motion, Q, s)
        paddle = Collider(Box((0.1, 0.1, 0.2)), "separate", 0.2, motion)
        out = fall(state, Q, s, "separate", colliders=(paddle,), frames=5, **law)
        loss = ((out.x[-1] - s) @ Q).square().sum() + (
            out.reactions.sum((0, 1)).view(-1, 2, 3) @ Q
        )[0, 0] @ UP
        return out, torch.autograd.grad(loss, (state.x, velocity))

    (first, gradients), (second, again) = run(torch.eye(3).double(), NOWHERE), run(Q, Q @ FAR)
    assert (second.F_tot[-1] - Q @ first.F_tot[-1]).abs().max() < 1e-6 and not torch.allclose(
        first.F[-1], first.F_tot[-1]
    )
    forces = first.reactions.view(4, SUBSTEPS, -1, 2, 3)
    assert forces.abs().max() > 1
    torch.testing.assert_close(second.reactions.view_as(forces), forces @ Q.T, rtol=1e-5, atol=1e-6)
    for one, other in zip(gradients, again):
        torch.testing.assert_close(other, one, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("timing", [None, Adaptive(StepControl(maximum=80))])
def test_steps_have_the_bits_of_a_rollout_in_axes_of_their_own(timing, make_block):
    """A hundred steps ten kilometres away, a driven solid among them: nothing is rounded between steps."""
    Q, state = turn(25), make_block()
    up = Q @ UP
    sim = Simulator("neo_hookean", dx=DX, substeps=2, frame_dt=FRAME_DT / SUBSTEPS * 2, gravity=Q @ GRAVITY, up=up,
                    ground=Ground(float(FAR @ up), "sticky"),
                    colliders=(Collider(Box((0.1, 0.1, 0.2)), motion=moved(PADDLE, Q, FAR)),))  # fmt: skip
    given = (
        seen(state, Q, FAR, torch.float32),
        PARAMETERS,
        torch.full((len(state.x),), (DX / 2) ** 3),
        1000.0,
    )
    with torch.no_grad():
        whole = sim.rollout(*given, 101, timing=timing)
        stepper, moment = sim.stepper(*given, timing=timing)
        for _ in range(100):
            # where the caller says where a solid is, he does so in the world
            sample = (
                None
                if timing
                else stepper.sample(moment, 2, sim.dt, [c.motion for c in sim.colliders])
            )
            moment, forces, _ = stepper.step(moment, sample)
    torch.testing.assert_close(
        stepper.axes.world.state(moment.state).x, whole.final.x, rtol=0, atol=1e-9
    )
    torch.testing.assert_close(forces, whole.reactions[-1], rtol=1e-4, atol=1e-4)
    assert float(whole.reactions.abs().max()) > 0.1


def test_worlds_have_gravities_of_their_own_in_axes_that_are_turned(make_block):
    state, Q = make_block(), turn(30, (1, 0, 1))
    pulls = torch.tensor([[0.0, -9.8, 0.0], [3.0, -5.0, 1.0]]).double()
    both = ParticleState(*(torch.stack([getattr(state, n)] * 2) for n in NAMES))
    volume = torch.full((len(state.x),), (DX / 2) ** 3).double()

    def run(turned):
        sim = Simulator("neo_hookean", dx=DX, substeps=SUBSTEPS, frame_dt=FRAME_DT, up=turned @ UP, ground=Ground(0.0, "slip"),
                        dtype=torch.float64)  # fmt: skip
        with torch.no_grad():
            return sim.rollout(
                seen(both, turned, NOWHERE, torch.float64),
                PARAMETERS,
                volume,
                1000.0,
                6,
                gravity=pulls @ turned.T,
            )

    first, second = run(torch.eye(3).double()), run(Q)
    assert (second.x - first.x @ Q.T).abs().max() < 1e-9 * DX and (
        first.x[-1, 0] - first.x[-1, 1]
    ).abs().max() > 0.01


def test_one_simulator_serves_places_that_are_far_from_each_other(make_block):
    """Its buffers know the plane where it was; a stepper that was made before goes on as it was."""
    state, up = make_block(), torch.eye(3).double()
    sim = Simulator(
        "neo_hookean",
        dx=DX,
        substeps=10,
        frame_dt=FRAME_DT / 4,
        ground=Ground(0.0),
        dtype=torch.float64,
    )
    volume = torch.full((len(state.x),), (DX / 2) ** 3).double()
    places = [torch.tensor([k * PERIOD * DX, 0.0, 0.0]).double() for k in (0, 3, 0, -5)]
    with torch.no_grad():
        stepper, moment = sim.stepper(state, PARAMETERS, volume, 1000.0)
        moved = [
            sim.rollout(seen(state, up, s, torch.float64), PARAMETERS, volume, 1000.0, 12).x - s
            for s in places
        ]
        for _ in range(11):
            moment = stepper.step(moment).moment
    assert torch.equal(moved[0], moved[2]) and torch.equal(moment.state.x, moved[0][-1])
    assert (
        max(float((x - moved[0]).abs().max()) for x in moved) < 1e-6
    )  # nodes with next to no mass are badly conditioned
    assert float(moved[0][-1, :, 1].min()) > 0


def test_along_the_grid_and_near_the_origin_nothing_is_computed():
    x = torch.tensor([[0.49 * PERIOD * DX, -0.49 * PERIOD * DX, 0.0]])
    near, far = (shift_to(extent(at).numpy(), x.dtype, None, DX) for at in (x, x + 1.0))
    assert near is None and far is not None
    for normal in ((0, 2, 0), (0, 0, -1), (1, 1e-8, 0)):
        assert turn_along([Plane((0, 0, 0), normal)]) is None
    assert turn_along([Plane((0, 0, 0), (1, 2, 3), "touch")]) is None
    state = ParticleState.at_rest(x)
    assert Axes().state(state).x is x and Axes().world == Axes()


def test_planes_at_right_angles_are_turned_together_and_others_refused():
    Q = turn(50, (1, 2, 0.5))
    corner = [
        Plane((0, 0, 0), tuple((Q @ torch.tensor(n).double()).tolist()))
        for n in ((0, 1, 0), (-1, 0, 0), (0, 0, 1))
    ]
    turned = [
        turn_along(corner) @ torch.tensor(plane.normal, dtype=torch.float64) for plane in corner
    ]
    assert all(sorted(n.abs().tolist())[1] < 1e-9 for n in turned)
    wall = Plane((0, 0, 0), (1, 0.5, 0), "separate")
    with pytest.raises(ConfigError, match=r"plane \d .*right angles.*touch"):
        Simulator(
            "neo_hookean", dx=DX, substeps=1, frame_dt=1e-3, ground=Ground(0.0), planes=[wall]
        )
    Simulator(
        "neo_hookean", dx=DX, substeps=1, frame_dt=1e-3, ground=Ground(0.0, "touch"), planes=[wall]
    )
    Simulator(
        "neo_hookean",
        dx=DX,
        substeps=1,
        frame_dt=1e-3,
        ground=Ground(0.0),
        planes=[replace(wall, mode="touch")],
    )


def test_a_box_of_the_world_holds_in_turned_axes(make_block):
    Q, state = turn(30), make_block()
    x = state.x @ Q.T
    room = torch.stack([x.amin(0) - 1.0, x.amax(0) + 1.0])
    fall(state, Q, NOWHERE, frames=3, box=room)
    tight = torch.stack([x.amin(0) - 1.0, x.amax(0) + 0.001])
    with pytest.raises(
        SimulationDiverged, match=r"particle \d+: position is outside the box \[-?\d.*larger box"
    ):
        fall(state, Q, NOWHERE, box=tight)
    x = state.x + FAR
    with pytest.raises(SimulationDiverged, match=r"outside the box \[9829\.\d+, "):
        fall(
            state, torch.eye(3).double(), FAR, box=torch.stack([x.amin(0) - 1.0, x.amax(0) + 0.001])
        )


def test_worlds_that_are_far_from_each_other_are_refused(make_block):
    state = make_block()
    apart = torch.tensor([0.0, 1e4]).double()[:, None, None]
    both = ParticleState(*(torch.stack([getattr(state, n)] * 2) for n in NAMES))
    with pytest.raises(
        ConfigError, match=r"x: expected worlds within 655 m of each other, found 1e\+04 m"
    ):
        Simulator("neo_hookean", dx=DX, substeps=1, frame_dt=1e-3, dtype=torch.float64).rollout(
            replace(both, x=both.x + apart), PARAMETERS, torch.full((len(state.x),), 8e-6).double(), 1000.0, 2
        )  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*det F <= 0")
def test_a_body_that_flies_apart_is_given_more_substeps_before_a_larger_box(make_block):
    """An unstable time step throws particles out of any box."""
    state = make_block()
    box = torch.stack([state.x.amin(0) - 0.3, state.x.amax(0) + 0.3])
    coarse = Simulator(
        "corotated", dx=DX, substeps=2, frame_dt=1 / 60, dtype=torch.float64, box=box
    )
    moduli, volume = {"mu": 1e6, "lam": 1e6}, torch.full((len(state.x),), 1e-5).double()
    nudged = replace(state, v=state.v + 0.1 * state.x.cos())
    with pytest.raises(
        SimulationDiverged,
        match=r"outside the box .*\(dt 0\.00833 s.*simulation\.courant.* larger box",
    ):
        coarse.rollout(nudged, moduli, volume, 1000.0, 60)
