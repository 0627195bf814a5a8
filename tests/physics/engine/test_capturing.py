"""Substeps captured as a graph: what may break a capture, and what then happens."""

import gc
import warnings
import weakref

import pytest
import torch
import warp as wp

from mosa.physics.engine.capture import ATTEMPTS, uninterrupted
from mosa.physics.engine.simulator import Simulator


def test_no_garbage_is_collected_while_a_graph_is_captured():
    class Freed:
        pass

    for was in (True, False):
        gc.enable() if was else gc.disable()
        try:
            with uninterrupted():
                one = Freed()
                one.itself, ends = one, []
                weakref.finalize(one, ends.append, True)
                del one
                made = [[] for _ in range(200_000)]  # many times what starts a collection
                assert not ends and len(made) == 200_000
            assert gc.isenabled() == was
        finally:
            gc.enable()
        gc.collect()
        assert ends


@pytest.mark.parametrize("broken", [1, ATTEMPTS])
def test_a_broken_capture_costs_time_and_nothing_else(broken, make_block, monkeypatch):
    """Substeps are launched one by one meanwhile, for good (and with a warning) after the last attempt."""
    state, found, tried = make_block(n=4), [], []

    class Breaking(wp.ScopedCapture):
        def __exit__(self, *error):
            super().__exit__(*error)
            if len(tried) < broken:
                tried.append(True)
                raise RuntimeError("operation failed due to a previous error during capture")
            tried.append(False)

    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    for capture in (wp.ScopedCapture, Breaking):
        monkeypatch.setattr(wp, "ScopedCapture", capture)
        sim = Simulator("corotated", dx=0.04, substeps=8, frame_dt=3.2e-3, dtype=torch.float64)
        mu = torch.tensor(8e3, dtype=torch.float64, requires_grad=True)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            x = sim.rollout(state, {"mu": mu, "lam": 1e4}, volume, 1000.0, 12).x
            found.append([x.detach(), *torch.autograd.grad(x.square().sum(), [mu])])
    assert tried[:broken] == [True] * broken and (len(tried) > broken) == (broken < ATTEMPTS)
    assert any("one by one" in str(each.message) for each in said) == (broken == ATTEMPTS)
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)
