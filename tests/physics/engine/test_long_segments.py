"""Segments on CUDA are long, as far as one window serves them, and frames are launched before the host has looked at the last one.
Here on a CPU: the same bits as short ones, the same gradients."""

from dataclasses import replace

import pytest
import torch

from mosa.errors import SimulationDiverged
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.engine.solver import SegmentSolver
from mosa.types import Ground

PARAMETERS = {"mu": 4e4, "lam": 5e4}
COLLIDER = Collider(
    Sphere(0.06), "separate", 0.3, Motion((0.15, 0.0, 0.1), velocity=(0.0, 1.0, 0.0))
)


def run(state, long, *, substeps=70, dt=2e-4, parameters=PARAMETERS, frames=3, **options):
    """(rollout, lengths of the segments that had buffers)."""
    options = {
        "ground": Ground(0.0),
        "dtype": torch.float64,
        "options": LawOptions(on_inversion="ignore"),
        **options,
    }
    sim = Simulator("corotated", dx=0.04, substeps=substeps, frame_dt=substeps * dt, **options)
    sim.gathers = long
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    return sim.rollout(state, parameters, volume, 1000.0, frames), {
        work.substeps for work in sim.buffers
    }


def assert_same(found, expected):
    for name in ("x", "v", "F", "F_tot", "reactions"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a is None and b is None) or torch.equal(a, b), name


@pytest.mark.parametrize("colliders", [(), (COLLIDER,)])
def test_a_long_segment_is_its_short_ones_bit_for_bit(colliders, make_block):
    (long, lengths), (short, short_lengths) = (
        run(make_block(), long, colliders=colliders) for long in (True, False)
    )
    assert lengths == {70} and max(short_lengths) <= 32
    assert_same(long, short)


def test_a_fast_body_gets_shorter_segments(make_block):
    """At this speed 70 substeps would need a window of many times the body's nodes."""
    state = make_block(velocity=(60.0, 60.0, 60.0))
    (long, lengths), (short, _) = (run(state, long, ground=None) for long in (True, False))
    assert lengths == {35}
    assert_same(long, short)


def test_a_body_that_leaves_the_window_of_a_long_segment(make_block):
    """A compressed body shows no speed at the start."""
    state = make_block(velocity=(0.0, 0.0, 0.0))
    state = replace(state, F=0.5 * state.F, C_affine=0 * state.C_affine)
    options = {
        "dt": 1e-4,
        "parameters": {"mu": 1e7, "lam": 7e6},
        "gravity": (0, 0, 0),
        "ground": None,
        "frames": 2,
    }
    (long, lengths), (short, _) = (run(state, long, **options) for long in (True, False))
    assert 70 in lengths and min(lengths) <= 32  # it was tried in one, and then cut
    assert_same(long, short)


def test_divergence_in_a_long_segment_names_the_substep_of_the_short_one(make_block):
    messages = []
    for long in (True, False):
        with pytest.raises(SimulationDiverged, match="outside the box") as error:
            run(
                make_block(),
                long,
                box=torch.tensor([[-1.0, 0.012, -1.0], [1.0, 1.0, 1.0]]),
                ground=None,
            )
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def gradients(state, long, monkeypatch, *, kept=True, frames=9, stiffness=1.0, **options):
    """(gradients in positions, velocities, their affine part and modulus, lengths of the segments that had buffers)."""
    monkeypatch.setattr("mosa.physics.engine.budget.KEPT_ON_CPU", 2**30 if kept else 0)
    modulus = torch.tensor(4e4 * stiffness, dtype=torch.float64)
    leaves = [t.clone().requires_grad_() for t in (state.x, state.v, state.C_affine, modulus)]
    start = replace(state, x=leaves[0], v=leaves[1], C_affine=leaves[2])
    found, lengths = run(
        start, long, frames=frames, parameters={"mu": leaves[3], "lam": 5e4 * stiffness}, **options
    )
    loss = (found.x[1:] ** 2).sum() + 1e-3 * (found.F[1:] ** 2).sum()
    if found.reactions is not None:
        loss = loss + 1e-6 * found.reactions.square().sum()
    return torch.autograd.grad(loss, leaves), lengths


@pytest.mark.parametrize("case", ["falling", "against a collider", "fast", "leaves the window"])
def test_gradients_through_long_segments(case, make_block, monkeypatch):
    state, options, lengths = make_block(), {}, {70}
    if case == "against a collider":
        options = {"colliders": (COLLIDER,)}
    elif case == "fast":
        state, options, lengths = make_block(velocity=(60.0, 60.0, 60.0)), {"ground": None}, {35}
    elif case == "leaves the window":  # a compressed body shows no speed at the start
        state = make_block(velocity=(0.0, 0.0, 0.0))
        state = replace(state, F=0.5 * state.F, C_affine=0 * state.C_affine)
        options = {"dt": 1e-4, "stiffness": 200.0, "gravity": (0, 0, 0), "ground": None}
    (long, found), (short, short_lengths) = (
        gradients(state, long, monkeypatch, **options) for long in (True, False)
    )
    assert max(short_lengths) <= 32 and (
        lengths <= found if case == "leaves the window" else found == lengths
    )
    for a, b in zip(long, short, strict=True):
        assert float(b.abs().max()) > 0
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11 * float(b.abs().max()))


def test_segments_are_long_only_where_their_states_are_kept(make_block, monkeypatch):
    for kept, frames, expected in ((False, 9, {24, 23}), (True, 3, {24, 23}), (True, 6, {35})):
        assert gradients(make_block(), True, monkeypatch, kept=kept, frames=frames)[1] == expected


@pytest.mark.parametrize("leaves", [False, True])
def test_frames_are_launched_before_the_host_looks_at_them(leaves, make_block, looks, monkeypatch):
    """As many as one window serves; where a particle leaves it they are done again, and what they kept is free."""
    state, options, solvers, made = (
        make_block(),
        {"substeps": 20, "frames": 9},
        [],
        SegmentSolver.__init__,
    )
    if leaves:  # a compressed body shows no speed at the start
        state = make_block(velocity=(0.0, 0.0, 0.0))
        state = replace(state, F=0.5 * state.F, C_affine=0 * state.C_affine)
        options |= {"dt": 1e-4, "stiffness": 200.0, "gravity": (0, 0, 0), "ground": None}
    monkeypatch.setattr(
        SegmentSolver, "__init__", lambda self, *given: solvers.append(self) or made(self, *given)
    )
    (long, _), (short, _) = (
        gradients(state, long, monkeypatch, **options) for long in (True, False)
    )
    assert looks[0] == 8 and (len(looks) > 1) == leaves
    assert [solver.room for solver in solvers] == [2**30] * 2
    for a, b in zip(long, short, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11 * float(b.abs().max()))
