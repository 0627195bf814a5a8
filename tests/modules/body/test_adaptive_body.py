"""Adaptive substeps of a learned body: from the configuration to the twin."""

import math
from dataclasses import replace

import pytest
import torch
from replay import Replay

from mosa.config.build import build_body, build_world
from mosa.config.record import BodyRecord
from mosa.errors import ConfigError
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.body.body import Body, SimulationSettings, Start
from mosa.modules.body.material import Material
from mosa.twin.twin import Twin

WORLD = {"ground": {"height": 0.0, "mode": "separate", "friction": 0.2}, "gravity": [0, -9.8, 0], "up": [0, 1, 0],
         "box": [[-0.5, -0.5, -0.5], [0.5, 1.0, 0.5]]}  # fmt: skip
PLATE = {"type": "box", "size": [0.6, 0.1, 0.6], "mode": "separate",
         "motion": {"waypoints": [{"time": 0.0, "position": [0, 0.36, 0]}, {"time": 0.1, "position": [0, 0.21, 0]}]}}  # fmt: skip


SOFT = {"material": ("neo_hookean", {"E": 2e4, "nu": 0.3}), "stride": 1, "courant": 0.05}


def tensors():
    axis = (torch.arange(6) + 0.5) * 0.03 - 0.09
    rest = torch.cartesian_prod(axis, axis, axis)
    n = len(rest)
    return {"rest": rest, "volume": torch.full((n,), 0.03**3), "colors": torch.ones(n, 3), "opacities": torch.ones(n),
            "covariances": 1e-4 * torch.eye(3).expand(n, 3, 3)}  # fmt: skip


def twin(material=("neo_hookean", {"E": 5e4, "nu": 0.3}), adapter=None, **settings):
    settings = SimulationSettings(dx=0.06, **{"adaptive": True, **settings})
    body = Body(
        **tensors(),
        density=1000.0,
        material=Material(*material),
        heterogeneity=None,
        adapter=adapter,
        settings=settings,
    )
    start = Start(
        torch.eye(3), torch.tensor([0.0, 0.15, 0.0]), torch.tensor([0.0, -2.0, 0.0]), torch.zeros(3)
    )
    return Twin(body, build_world(WORLD), 0.02, None, start)


def test_the_twin_records_and_replays_its_counts():
    """With a plate, in single precision; counts are whole strides, the same again, and near the fixed step's motion."""
    one = twin(**SOFT)
    rollout = one.simulate(frames=8, colliders=[PLATE])
    assert len(set(rollout.counts)) > 1 and all(count % 8 == 0 for count in rollout.counts)
    assert rollout.reactions.shape == (7, 1, 1, 6) and rollout.reactions[-1, 0, 0, 1] > 5
    again = twin(**SOFT).simulate(frames=8, colliders=[PLATE])
    assert again.counts == rollout.counts and torch.equal(again.x, rollout.x)
    alone = one.simulate(frames=8)
    assert alone.substeps == math.ceil(sum(alone.counts) / 7)
    start, world = one.training_start, one.world
    ready = replace(one.body.ready(start, world, 8, 0.02), timing=Replay(alone.counts, lag=0.0))
    assert torch.equal(ready.simulate(8, world.solids).x, alone.x)
    fixed = twin(**SOFT, adaptive=False).simulate(frames=8, colliders=[PLATE])
    assert set(fixed.counts) == {fixed.reactions.shape[1]}
    # sticking and sliding of single nodes differ with the step
    assert (rollout.x - fixed.x).norm(dim=-1).mean() < 0.1 * 0.06


def test_an_adapter_keeps_its_margin_and_its_stride():
    plain, adapted = (
        twin(adapter=adapter, stride=5).body for adapter in (None, StressAdapter(hidden=4))
    )
    assert (
        plain.step_control(False).factor == 1.0
        and adapted.step_control(True).factor == ADAPTER_MARGIN
    )
    assert plain.step_control(False).multiple == 10
    one = twin(adapter=StressAdapter(hidden=4), stride=6, courant=0.2)
    one.body.adapter.switch_on(5e4, 0.3)
    asked = []
    rollout = one.body.simulate(one.training_start, one.world, 4, 0.02, collect=asked.append)
    assert len(asked) == sum(count // 6 for count in rollout.counts)


def test_gradient_through_the_body_is_that_of_the_replay():
    """Adaptive and replayed: one graph; against differences of the replay in Young's modulus."""
    one = twin(precision=64, courant=0.15, stride=4, min_substeps=8)
    body, raw = one.body.double(), one.body.material.raw["E"]
    start = Start(
        *(
            getattr(one.training_start, k).double()
            for k in ("rotation", "center", "velocity", "angular_velocity")
        )
    )
    probe = torch.randn(
        len(body.rest), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )

    def value(counts=None):
        ready = body.ready(start, one.world, 5, 0.02)
        if counts is not None:
            ready = replace(ready, timing=Replay(counts, lag=0.0))
        rollout = ready.simulate(5, one.world.solids)
        return (probe * rollout.x[-1]).sum() + rollout.F[-1].square().sum(), rollout.counts

    result, counts = value()
    slope = float(torch.autograd.grad(result, raw)[0])
    assert slope == float(torch.autograd.grad(value(counts)[0], raw)[0])
    h, original = 1e-4, raw.data.clone()

    def at(t):
        with torch.no_grad():
            raw.data = original + t
            loss = float(value(counts)[0])
            raw.data = original
        return loss

    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    assert abs(slope) > 1e-3
    assert slope == pytest.approx(difference, rel=1e-6)


def test_the_configuration_reaches_the_body():
    simulation = {"stride": 8, "max_substeps": 20, "courant": 0.6, "precision": 32, "contact_offset": False, "adaptive": True,
                  "min_substeps": 3}  # fmt: skip
    cfg = {"seed": 0, "simulation": simulation, "prior": {"law": "newtonian", "parameters": {"mu": 100.0, "kappa": 1e5}},
           "heterogeneity": {"enabled": False}, "adapter": {}}  # fmt: skip
    world = {name: WORLD[name] for name in ("gravity", "up", "box")}
    record = BodyRecord(
        settings=cfg, ground=WORLD["ground"], world=world, dx=0.06, density=1000.0, frame_dt=0.03
    )
    body = build_body(record, tensors())
    assert body.settings.adaptive and body.settings.min_substeps == 3
    start = twin().training_start
    with pytest.raises(
        ConfigError,
        match=r"simulation\.max_substeps: expected at least 2\d for frame 1, found 20.*simulation\.dx",
    ):
        body.simulate(start, build_world(WORLD), 3, 0.03)
