"""What a fit does when a step leads nowhere, and a calibration that is all there is."""

from types import SimpleNamespace

import pytest
import torch
from assembled import assembled

from mosa.errors import SimulationDiverged


def ready(module):
    """The module with what Lightning would give it."""
    optimizers = module.configure_optimizers()
    module.optimizers, module.manual_backward = (lambda: optimizers), (lambda loss: loss.backward())
    module.log_dict = lambda *_, **__: None
    module._trainer = SimpleNamespace(should_stop=False)
    return module


def test_a_step_that_cannot_be_simulated_is_taken_back_and_the_fit_goes_on(cache):
    _, _, module = assembled(cache, "adapter=direct", "heterogeneity.enabled=false", "fit.joint.iterations=4")
    module = ready(module)
    while module.stage.name != "joint":
        module.training_step([0], 0)
    descend, weights = module.descend, []

    def failing(*arguments):
        weights.append([p.detach().clone() for p in module.body.adapter.parameters()])
        if len(weights) == 2:
            raise SimulationDiverged("an element turned inside out")
        return descend(*arguments)

    module.descend = failing
    for _ in range(3):
        module.training_step([0], 0)
    assert all(torch.equal(a, b) for a, b in zip(weights[0], weights[2]))  # where the first step began
    moved = [max(float((a - b).abs().max()) for a, b in zip(one, weights[0]))
             for one in (weights[1], [p.detach() for p in module.body.adapter.parameters()])]  # fmt: skip
    assert 0 < moved[1] < 0.6 * moved[0]
    assert len(module.losses) == 3 and module.losses[1] == module.losses[0]

    def ends(*_, **__):
        raise SimulationDiverged("the last step")

    before = [p.detach().clone() for p in module.body.adapter.parameters()]
    body = module.body.simulate
    module.try_last_step = (lambda tried: lambda *arguments: (setattr(module.body, "simulate", ends), tried(*arguments)))(
        module.try_last_step)
    module.training_step([0], 0)
    module.body.simulate = body
    assert module.stage is None and all(torch.equal(a, b) for a, b in zip(before, module.body.adapter.parameters()))


def test_without_a_step_to_take_back_the_fit_stops(cache):
    _, _, module = assembled(cache, "adapter=direct", "heterogeneity.enabled=false", "+fit.prior.optimizer=adam")
    module = ready(module)
    module.descend = lambda *_: (_ for _ in ()).throw(SimulationDiverged("at its start"))
    with pytest.raises(SimulationDiverged, match="at its start"):
        module.training_step([0], 0)


def test_a_calibration_alone_looks_again_and_goes_on_from_there(cache):
    _, _, module = assembled(cache, "adapter=none", "heterogeneity.enabled=false", "fit.prior.looks=2")
    assert [stage.looks_again for stage in module.stages] == [False, True, True]
    first, module = module.takes[0].cues.positions, ready(module)
    seen, starts = [], []
    while module.stage is not None:
        stage, begun = module.stage_index, len(module.losses)
        module.training_step([0], 0)
        if begun == 0:
            seen.append(module.takes[0].cues.positions)
            starts.append(stage)
    assert starts == [0, 1, 2] and torch.equal(seen[0], first)
    assert not torch.equal(seen[1], first) and not torch.equal(seen[2], seen[1])
    assert module.posterior is not None


def test_it_does_not_where_there_is_no_look(cache):
    _, _, module = assembled(cache, "adapter=none", "heterogeneity.enabled=false", "reconstruction.informed.iterations=0")
    assert not any(stage.looks_again for stage in module.stages)
