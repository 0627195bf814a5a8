"""Without gradients a segment on CUDA is long, as far as one window serves it. Here on a CPU: the same bits as short ones."""

from dataclasses import replace

import pytest
import torch

from mosa.errors import SimulationDiverged
from mosa.physics.collider_motion import Motion
from mosa.physics.colliders import Collider, Sphere
from mosa.physics.rollout import Simulator
from mosa.types import Ground

PARAMETERS = {"mu": 4e4, "lam": 5e4}
COLLIDER = Collider(Sphere(0.06), "separate", 0.3, Motion((0.15, 0.0, 0.1), velocity=(0.0, 1.0, 0.0)), 0.02)


def run(state, long, *, substeps=70, dt=2e-4, parameters=PARAMETERS, frames=3, **options):
    """(rollout, lengths of the segments that had buffers)."""
    options = {"ground": Ground(0.0), "dtype": torch.float64, "on_inversion": "ignore", **options}
    sim = Simulator("corotated", dx=0.04, substeps=substeps, frame_dt=substeps * dt, **options)
    sim._long = long
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    return sim.rollout(state, parameters, volume, 1000.0, frames), {key[1] for key in sim._workspaces}


def assert_same(found, expected):
    for name in ("x", "v", "F", "F_tot", "reactions"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a is None and b is None) or torch.equal(a, b), name


@pytest.mark.parametrize("colliders", [(), (COLLIDER,)])
def test_a_long_segment_is_its_short_ones_bit_for_bit(colliders, make_block):
    (long, lengths), (short, short_lengths) = (run(make_block(), long, colliders=colliders) for long in (True, False))
    assert lengths == {70} and max(short_lengths) <= 32
    assert_same(long, short)


def test_a_fast_body_gets_shorter_segments(make_block):
    """At 40 m/s 70 substeps would need a window of many times the body's nodes."""
    state = make_block(velocity=(40.0, 3.0, 0.0))
    (long, lengths), (short, _) = (run(state, long, ground=None) for long in (True, False))
    assert lengths == {35}
    assert_same(long, short)


def test_a_body_that_leaves_the_window_of_a_long_segment(make_block):
    """A compressed body shows no speed at the start."""
    state = make_block(velocity=(0.0, 0.0, 0.0))
    state = replace(state, F=0.5 * state.F, C_affine=0 * state.C_affine)
    options = {"dt": 1e-4, "parameters": {"mu": 1e7, "lam": 7e6}, "gravity": (0, 0, 0), "ground": None, "frames": 2}
    (long, lengths), (short, _) = (run(state, long, **options) for long in (True, False))
    assert 70 in lengths and min(lengths) <= 32  # it was tried in one, and then cut
    assert_same(long, short)


def test_divergence_in_a_long_segment_names_the_substep_of_the_short_one(make_block):
    messages = []
    for long in (True, False):
        with pytest.raises(SimulationDiverged, match="outside the box") as error:
            run(make_block(), long, box=torch.tensor([[-1.0, 0.012, -1.0], [1.0, 1.0, 1.0]]), ground=None)
        messages.append(str(error.value))
    assert messages[0] == messages[1]
