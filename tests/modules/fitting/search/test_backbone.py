"""prior=auto: the backbone that the isotropic laws choose, and another one that what was learned asks for."""

import copy

import pytest
import torch
from small_bodies import NU, WORLD, E, small_body, start, take_of
from without_trainer import identify

from mosa.config.record import BodyRecord
from mosa.modules.body.material import AUTO, Material
from mosa.modules.fitting import newton_steps
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.search.ground import EXPLAINED
from mosa.modules.fitting.stages import Stage
from mosa.training.lit_mosa import LitMosa

LAWS = ("corotated", "neo_hookean")


@pytest.mark.parametrize("truth", LAWS)
def test_the_fit_begins_again_about_the_backbone_that_explains_the_learned_law_better(
    monkeypatch, truth
):
    """The isotropic laws have chosen corotated: an anisotropic body may look like another form of law than it has."""

    def corotated(body, candidates, *asked):
        body.choose("corotated")
        return dict.fromkeys(candidates, 1e-3)

    monkeypatch.setattr(newton_steps, "choose_law", corotated)
    begins = start(turn=0.5, speed=-3.0)
    numbers = torch.linspace(-0.2, 0.3, 19, dtype=torch.float64)
    take = take_of(small_body(numbers=numbers, law=truth), begins, 9)
    take.again = None

    def start_body():
        body = small_body(E=1.1 * E, on=False)
        given = {"E": 1.1 * E, "nu": NU, "yield_stress": 1e4}
        body.material = Material(AUTO, given, candidates=(*LAWS, "von_mises")).double()
        for kept in body.frozen.values():
            kept["material"] = copy.deepcopy(body.material)
        return body

    body = start_body()
    record = BodyRecord.of(body, WORLD, 0.02, begins)
    stages = [
        Stage(name=name, iterations=3, lr=0.1, optimizer="gauss_newton")
        for name in ("prior", "joint")
    ]
    module = LitMosa.of_parts(body, takes=[take], world=WORLD, background=torch.ones(3), record=record,
                              weights={"position": 1.0}, stages=stages, criterion=Criterion(name="corrected"),
                              settings=IdentificationSettings(grid_error=0.0))  # fmt: skip
    begun, begin = [], module.begin
    monkeypatch.setattr(
        module,
        "begin",
        lambda stage: begun.append((stage.name, module.body.material.law)) or begin(stage),
    )
    identify(module)
    again = [("prior", truth), ("joint", truth)] if truth != "corotated" else []
    assert begun == [("prior", "corotated"), ("joint", "corotated"), *again]
    assert (module.law_gains["neo_hookean"] > EXPLAINED) == bool(again)
    assert set(module.law_gains) == {"neo_hookean"}  # a law that yields has other numbers
    assert module.body.material.law == truth and module.record.law == truth
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    assert checkpoint["mosa"]["fit"]["law_gains"] == module.law_gains
    resumed = LitMosa.of_parts(start_body(), takes=[take], world=WORLD, background=torch.ones(3),
                               record=record, weights={"position": 1.0}, stages=stages)  # fmt: skip
    resumed.on_load_checkpoint(checkpoint)  # which does not begin again once more
    assert resumed.body.material.law == truth and resumed.law_gains == module.law_gains


def test_a_liquid_that_is_found_has_no_adapter_and_goes_on_from_its_checkpoint(monkeypatch):
    def liquid(body, candidates, *asked):
        body.choose("newtonian")
        return dict.fromkeys(candidates, 1e-3)

    monkeypatch.setattr(newton_steps, "choose_law", liquid)
    given = {"E": E, "nu": NU, "mu": 15.0, "kappa": 2e4}

    def start_body():
        body = small_body(on=False, modes=True)
        body.material = Material(AUTO, given, candidates=("corotated", "newtonian")).double()
        for kept in body.frozen.values():
            kept["material"] = copy.deepcopy(body.material)
        return body

    film = small_body(adapter=False)
    film.material = Material("newtonian", {"mu": 18.0, "kappa": 2e4}).double()
    take = take_of(film, start(turn=0.5, speed=-3.0), 6)
    take.again = None
    stages = [Stage(name=name, iterations=1, lr=0.1, optimizer="gauss_newton") for name in ("prior", "joint")]  # fmt: skip
    body = start_body()
    parts = dict(record=BodyRecord.of(body, WORLD, 0.02, take.start), weights={"position": 1.0},
                 world=WORLD, background=torch.ones(3), stages=stages)  # fmt: skip
    module = LitMosa.of_parts(body, takes=[take], **parts)
    with pytest.warns(UserWarning, match="newtonian has no shear stiffness"):
        identify(module)
    assert module.body.adapter is None and module.stage is None and module.record.law == "newtonian"
    assert module.body.material.learned == ["mu", "kappa"]
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    resumed = LitMosa.of_parts(start_body(), takes=[take], **parts)
    with pytest.warns(UserWarning, match="newtonian has no shear stiffness"):
        resumed.on_load_checkpoint(checkpoint)
    resumed.load_state_dict(module.state_dict())
    assert resumed.body.material.physical() == module.body.material.physical()
