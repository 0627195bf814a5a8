"""How a small body touches its ground, found from its own rollouts; what a run makes of it."""

import math
from dataclasses import asdict, replace

import pytest
import strangers
import torch
from small_bodies import FRAME_DT, NU, WORLD, E, small_body, start, take_of
from without_trainer import identify

from mosa.config.checkpoints import check_resumed
from mosa.config.record import BodyRecord
from mosa.data.scene import ground_from
from mosa.errors import ConfigError, DataError, SimulationDiverged
from mosa.evaluation.analysis.statements import determined_text, ground_table, ground_text
from mosa.evaluation.analysis.tables import parameter_table
from mosa.modules.body.body import World
from mosa.modules.body.contact import ContactOffset
from mosa.modules.body.material import Material
from mosa.modules.fitting import newton_steps
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.newton_steps import NewtonSteps
from mosa.modules.fitting.parameters import read_numbers
from mosa.modules.fitting.search import ground as ground_search
from mosa.modules.fitting.search.ground import (
    better_friction,
    choose_ground,
    contact,
    named,
    rivals_of,
    taken_of,
)
from mosa.modules.fitting.stages import Stage
from mosa.training.lit_mosa import LitMosa
from mosa.types import AUTO, Ground

FRAMES = 9


def world(ground: Ground) -> World:
    return World(ground, WORLD.gravity, WORLD.up, WORLD.box)


def search(body, take):
    """`choose_ground` as a run does it."""
    stage, criterion, settings = (
        Stage(name="prior", iterations=40, lr=0.1),
        Criterion(name="corrected"),
        IdentificationSettings(),
    )
    return choose_ground(
        body,
        Ground(0.0),
        lambda g: Identification(body, [take], world(g), stage, criterion, settings, seats=1),
    )


@pytest.mark.parametrize(
    "truth",
    [
        Ground(0.0, "sticky"),
        Ground(0.0, "separate", 0.2),
        Ground(0.0, "separate", 0.6),
        Ground(0.0, "touch", 0.3),
    ],
)
def test_contact_and_friction_are_found_with_the_law(truth):
    """A turned block that moves along the ground. The friction is known to within the steps of the search."""
    begins = start(turn=0.5, speed=-2.0)
    begins.velocity[0] = 0.8
    take = take_of(small_body(adapter=False), begins, FRAMES, world(truth))
    body = small_body(adapter=False, E=1.7 * E, nu=0.3)
    found, distances = search(body, take)
    assert found.mode == truth.mode and found.height == 0.0
    assert distances[named(found)] == min(distances.values()) and len(distances) == 9 + 2 * (
        truth.mode != "sticky"
    )
    if truth.mode != "sticky":
        assert truth.friction / 2**0.25 * 0.99 < found.friction < truth.friction * 2**0.25 * 1.01
    values = {name: float(value.detach()) for name, value in body.material.physical().items()}
    assert values["E"] == pytest.approx(E, rel=0.05) and values["nu"] == pytest.approx(NU, abs=0.03)


def test_a_contact_that_cannot_be_simulated_is_left_out(monkeypatch):
    """And the body is where the best one's calibration left it."""
    body, seen = small_body(adapter=False), []

    class Calibration:
        def __init__(self, ground):
            self.ground = ground

        def search(self):
            seen.append(self.ground)

        def iterate(self):
            if self.ground.friction > 0.5:
                raise SimulationDiverged("it cannot")
            with torch.no_grad():
                body.material.raw["E"].fill_(self.ground.friction)

        def distance(self):
            return 1 + self.ground.friction if self.ground.mode == "separate" else 2.0

    found, costs = choose_ground(body, Ground(0.1), Calibration)
    assert (
        found.height == 0.1
        and found.mode == "separate"
        and found.friction == pytest.approx(0.15 / math.sqrt(2))
    )
    assert [ground.mode for ground in seen] == ["sticky"]
    assert (
        math.isinf(costs["separate_0.6"])
        and math.isinf(costs["separate_1.2"])
        and costs["sticky"] == 2
    )
    assert float(body.material.raw["E"].detach()) == pytest.approx(found.friction)
    monkeypatch.setattr(
        Calibration, "iterate", lambda self: (_ for _ in ()).throw(SimulationDiverged("nowhere"))
    )
    with pytest.raises(SimulationDiverged):  # not even the body that sticks
        choose_ground(body, Ground(0.1), Calibration)


def test_a_body_sticks_unless_another_contact_is_clearly_nearer():
    """Rough grounds hold a body about as one that it sticks to does, and an isotropic law is wrong by more than the difference."""
    assert taken_of({"sticky": 1.0, "separate_1.2": 0.92, "separate_0.15": 3.0}) == "sticky"
    assert taken_of({"sticky": 1.0, "separate_1.2": 0.88, "separate_0.15": 3.0}) == "separate_1.2"


def test_the_rivals_are_the_roughest_grounds_on_which_no_sliding_is_seen():
    slides = {"separate_0.3": 13.5, "separate_0.6": 11.9, "separate_1.2": 11.91}
    assert rivals_of({"sticky": 10.5} | slides) == [("separate", 1.2)]
    near = {"touch_0.3": 11.0, "touch_0.6": 10.9, "touch_1.2": 13.0}
    assert rivals_of({"sticky": 10.5} | slides | near) == [("separate", 1.2), ("touch", 0.6)]
    assert rivals_of({"sticky": 10.5, "touch_0.3": 13.3, "touch_1.2": 13.4} | slides) == [
        ("separate", 1.2)
    ]  # touch is told apart
    assert rivals_of(
        {"sticky": 10.5, "separate_0.15": 12.0, "separate_0.3": 14.0, "touch_1.2": math.inf}
    ) == [("separate", 0.15)]
    assert rivals_of({"sticky": 10.5, "separate_0.15": 8.0}) == []  # a body that slides was taken
    assert rivals_of({"sticky": 10.5, "separate_0.15": math.inf}) == []


@pytest.mark.parametrize(
    "ground", [Ground(0.1, "sticky"), Ground(0.1, "separate", 0.424), Ground(0.1, "touch", 1.2)]
)
def test_a_contact_is_read_from_its_name(ground):
    assert contact(named(ground)) == (ground.mode, ground.friction)


def test_a_report_says_how_the_ground_is_touched():
    slides = {"sticky": 20e-3, "separate_0.3": 12e-3, "separate_0.6": 15.5e-3}
    text = ground_text(slides)
    assert text.startswith(
        "Ground: the body leaves it freely, friction 0.3 (separate) (mean distance from the training motion"
    )
    assert (
        "friction 0.3 (separate) 12.00 mm, leaves it freely, friction 0.6 (separate) 15.50 mm, sticks to it 20.00 mm)."
        in text
    )
    again = ground_text(
        slides, {"separate_0.6": -9.0, "separate_0.15": 6.0, "touch_0.15": 8.0}
    )  # of the law that was learned then
    assert (
        again.startswith("Ground: the body leaves it freely, friction 0.15 (touch) (mean")
        and "determined" not in again
    )
    assert again.endswith(
        "friction 0.15 (touch) explains the motion better by 8.0 of the logarithm of the likelihood."
    )
    worse = ground_text(slides, {"separate_0.6": -9.0, "touch_0.3": -8.0})
    assert (
        worse.startswith("Ground: the body leaves it freely, friction 0.3 (separate) (mean")
        and "determined" not in worse
    )
    assert worse.endswith(
        "friction 0.3 (touch) explains the motion worse by 8.0 of the logarithm of the likelihood."
    )
    near = {"sticky": 20e-3, "touch_0.6": 19.5e-3, "touch_0.15": 30e-3}
    assert ground_text(near, {"touch_0.6": 7.5}).startswith(
        "Ground: the body leaves it freely, friction 0.6 (touch) (mean"
    )
    assert ("leaves it freely, friction 0.6 (touch) explains the motion better by 7.5 of the logarithm of the likelihood."
            in ground_text(near, {"touch_0.6": 7.5}))  # fmt: skip
    sticks = ground_text(near, {"touch_0.6": -8.0})
    assert sticks.startswith("Ground: the body sticks to it (mean") and "worse by 8.0" in sticks
    assert "determined" not in sticks and "hardly" not in sticks


def test_many_contacts_are_a_table():
    few = {"sticky": 20e-3, "separate_0.3": 12e-3, "touch_0.6": 15.5e-3}
    assert ground_table(few, {}) == "" and "below" not in ground_text(few)
    many, gains = few | {"separate_1.2": 31e-3}, {"touch_0.3": 2.5, "separate_0.3": -1.0}
    said = ground_text(many)
    assert said.startswith(
        "Ground: the body leaves it freely, friction 0.3 (separate) (mean distance from the training motion"
    )
    assert "after calibration in the table below)." in said and " mm" not in said
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in ground_table(many, gains).splitlines()[2:]
    ]
    assert rows[0] == [
        "leaves it freely, friction 0.3 (separate)",
        "12.00",
        "-1.0",
    ]  # the nearest first
    assert rows[-2:] == [
        ["leaves it freely, friction 1.2 (separate)", "31.00", ""],
        ["leaves it freely, friction 0.3 (touch)", "", "+2.5"],
    ]
    figures = {f"id_prior/ground/{name}_m": value for name, value in many.items()}
    assert "gain" not in ground_table(many, {})  # none was asked for
    assert ground_table(many, {}) in determined_text(figures, "neo_hookean")


def test_a_report_says_what_of_the_contact_is_not_determined():
    near = {"sticky": 20e-3, "separate_0.6": 19.5e-3, "separate_0.15": 30e-3}
    for gain in (-2.0, 4.9):
        open_ = ground_text(near, {"separate_0.6": gain, "touch_0.6": -6.0})
        assert open_.startswith("Ground: the body sticks to it (mean")
        assert open_.endswith("Which of the two it is, is *not* determined: that takes 5.")
    alike = {
        "sticky": 2.24e-3,
        "separate_0.15": 2.29e-3,
        "separate_1.2": 2.25e-3,
    }  # a film of five frames of a body that slides
    assert "All of them are within a tenth" in ground_text(
        alike
    ) and "All of them" not in ground_text({"sticky": 1e-3})
    slides = {"sticky": 9.56e-3, "separate_0.15": 12.7e-3, "separate_0.424": 7.76e-3, "separate_0.6": 7.49e-3,
              "separate_1.2": 7.68e-3, "touch_0.3": 7.6e-3}  # fmt: skip
    assert (
        "Its friction is *not* determined: the isotropic law comes within a tenth"
        in ground_text(slides)
    )
    assert ground_text(slides).endswith("of the nearest with 0.424, 0.6, 1.2, and is wrong itself.")
    # what sticks less was not asked of the learned law
    assert ground_text(near, {"separate_0.6": 7.5}).endswith("with 0.6, and is wrong itself.")
    gradual = ground_text(slides, {"separate_0.3": 1.0})  # then the fit goes to that friction
    assert gradual.startswith("Ground: the body leaves it freely, friction 0.3 (separate) (mean")
    assert gradual.endswith("is *not* determined: that takes 5.")
    for stays in ({"touch_0.3": 1.0}, {"separate_0.3": -1.0}):
        assert ground_text(slides, stays).startswith(
            "Ground: the body leaves it freely, friction 0.6 (separate) (mean"
        )


@pytest.mark.parametrize(
    ("truth", "expected"),
    [(0.2, 0.212), (0.4, 0.424), (0.6, 0.3), (1.2, 1.2), (5.0, 3.39), (0.01, 0.053)],
)
def test_another_friction_is_sought_downhill(truth, expected):
    """By halves or doubles from the isotropic law's, then once between. The best of the others is said even where it is worse."""
    asked = []

    def gain(friction):
        asked.append(friction)
        return 10 * (math.log(0.6 / truth) ** 2 - math.log(friction / truth) ** 2)

    friction, most = better_friction(0.6, gain)
    assert (
        friction == pytest.approx(expected, rel=0.01)
        and len(asked) <= 6
        and len(set(asked)) == len(asked)
    )
    assert most == pytest.approx(gain(friction)) and (most > 0) == (truth != 0.6)


def sought(body) -> BodyRecord:
    """Of a run whose ground is sought."""
    ground = Ground(0.0, "sticky")
    return BodyRecord.of(body, world(ground), 0.02, start()).on(replace(ground, mode=AUTO))


def fit_of(take, **changed) -> LitMosa:
    """A calibration of a body whose ground is sought, as a run has it."""
    body = small_body(adapter=False, E=1.7 * E, nu=0.3)
    record = sought(body)
    stage = Stage(name="prior", iterations=1, lr=0.1).but(optimizer="gauss_newton", **changed)
    return LitMosa.of_parts(body, takes=[take], world=world(Ground(0.0, "sticky")), background=torch.ones(3), record=record,
                   weights={"position": 1.0}, stages=[stage])  # fmt: skip


def test_a_run_goes_on_with_the_ground_that_it_found():
    """Its world, what it keeps, and a fit that goes on from that; until then it is a ground that nobody knows."""
    truth = Ground(0.0, "separate", 0.3)
    begins = start(turn=0.5, speed=-2.0)
    begins.velocity[0] = 0.8
    take = take_of(small_body(adapter=False), begins, FRAMES, world(truth))
    take.again = None
    module = fit_of(take)
    assert module.ground_is_sought
    identify(module)
    assert (
        not module.ground_is_sought
        and module.world.ground == truth
        and module.record.ground.plain() == asdict(truth)
    )
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    assert checkpoint["mosa"]["fit"]["grounds"]["separate_0.3"] == min(
        checkpoint["mosa"]["fit"]["grounds"].values()
    )
    again = fit_of(take)
    again.on_load_checkpoint(checkpoint)
    assert (
        again.world.ground == truth
        and again.record.ground.plain() == asdict(truth)
        and again.grounds == module.grounds
    )


@pytest.mark.parametrize("chosen", ["corotated", "von_mises"])
def test_the_ground_is_sought_again_with_a_law_that_yields(monkeypatch, chosen):
    """An elastic law of a body that yields is far off on every ground."""
    begins, asked = start(turn=0.5, speed=-2.0), []
    module = fit_of(take_of(small_body(adapter=False), begins, 2))
    laws = ("corotated", "von_mises")
    given = {"E": E, "nu": NU, "yield_stress": 1e4}
    module.body.material = Material(AUTO, given, candidates=laws).double()

    def choose_ground(body, known, calibration):
        asked.append(body.material.law)
        return replace(known, friction=float(len(asked)), mode="touch"), {"sticky": 1e-3}

    monkeypatch.setattr(newton_steps, "choose_ground", choose_ground)
    monkeypatch.setattr(newton_steps, "choose_law", lambda body, *_: body.choose(chosen) or {})
    module.begun(module.stages[0])
    assert asked == ["corotated", "von_mises"][: 1 + (chosen == "von_mises")]
    assert module.world.ground == Ground(0.0, "touch", float(len(asked)))


def learning(truth: Ground) -> LitMosa:
    """A fit of an anisotropic body that slides over a ground, as it is seen, by a body whose law and ground are sought."""
    begins = start(turn=0.5, speed=-2.0)
    begins.velocity[0] = 0.8
    numbers = torch.linspace(-0.02, 0.03, 19, dtype=torch.float64)
    take = take_of(small_body(numbers=numbers), begins, FRAMES, world(truth))
    take.again = None
    body = small_body(E=1.2 * E, nu=0.3, on=False)
    stages = [
        Stage(name=name, iterations=3, lr=0.1).but(optimizer="gauss_newton")
        for name in ("prior", "joint")
    ]
    return LitMosa.of_parts(body, takes=[take], world=world(Ground(0.0, "sticky")),
                   background=torch.ones(3), record=sought(body), weights={"position": 1.0}, stages=stages,
                   criterion=Criterion(name="corrected"), settings=IdentificationSettings(grid_error=0.0))  # fmt: skip


def stages_begun(module: LitMosa, monkeypatch) -> list[tuple[str, Ground]]:
    """(name, ground) of each stage, once the fit runs."""
    begun, begin = [], module.begin
    monkeypatch.setattr(
        module,
        "begin",
        lambda stage: begun.append((stage.name, module.world.ground)) or begin(stage),
    )
    return begun


@pytest.mark.parametrize(
    "truth", [Ground(0.0, "separate", 1.2), Ground(0.0, "touch", 1.2), Ground(0.0, "sticky")]
)
def test_a_fit_begins_again_on_the_ground_that_explains_the_learned_law_better(monkeypatch, truth):
    """Where the isotropic law could not tell: here nothing is near enough to be taken but the body that sticks. The rival has the
    friction with which the isotropic law is nearest."""
    monkeypatch.setattr(ground_search, "NEARER", 0.0)
    monkeypatch.setattr(ground_search, "FRICTIONS", (0.3, 1.2))
    module = learning(truth)
    begun = stages_begun(module, monkeypatch)
    identify(module)
    sticks = Ground(0.0, "sticky")
    again = [("prior", truth), ("joint", truth)] if truth.mode != "sticky" else []
    assert begun == [("prior", sticks), ("joint", sticks), *again]
    gains = module.ground_gains
    assert set(gains) == {"separate_1.2", "touch_1.2"} and module.world.ground.mode == truth.mode
    assert (max(gains.values()) > ground_search.EXPLAINED) == bool(again)
    assert gains.get(named(truth), 0.0) == max(0.0, *gains.values())
    assert (
        float(module.body.material.physical()["E"].detach()) == pytest.approx(E, rel=0.1)
        and module.posterior is not None
    )
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    assert (
        checkpoint["mosa"]["fit"]["ground_gains"] == gains
    )  # so that a fit that goes on does not begin again once more


def test_a_fit_goes_to_a_friction_that_is_a_little_better(monkeypatch):
    """With the numbers and the posterior of the fit there, and without beginning again: 0.6 is taken at first, 0.5 true."""
    monkeypatch.setattr(ground_search, "better_friction", lambda own, gain: (0.5, gain(0.5)))
    for each in (ground_search, newton_steps):
        monkeypatch.setattr(each, "EXPLAINED", 1e6)
    monkeypatch.setattr(NewtonSteps, "find_ground", lambda self, stage: found(self))
    module = learning(Ground(0.0, "separate", 0.5))

    def found(self):
        self.grounds = {"sticky": 0.02, "separate_0.6": 0.01, "separate_1.2": 0.012}
        self.settle_ground(Ground(0.0, "separate", 0.6))

    begun = stages_begun(module, monkeypatch)
    identify(module)
    best = max(module.ground_gains, key=module.ground_gains.get)
    assert best == "separate_0.5" and 0 < module.ground_gains[best] and len(begun) == 2
    assert module.world.ground.friction == pytest.approx(
        0.5
    ) and module.record.ground.plain() == asdict(module.world.ground)
    numbers = read_numbers(module.body)
    assert torch.allclose(module.posterior.mean.to(numbers), numbers)


def test_of_frictions_that_explain_the_motion_alike_the_first_is_taken(monkeypatch):
    """Where a body does not slide, more friction changes nothing, not in the last bit: here all of them gain 1."""
    module = fit_of(take_of(small_body(adapter=False), start(turn=0.5), FRAMES))
    module.begin(module.stages[0])
    module.identification = module.identifying(module.stages[0])
    module.identification.iterate()
    module.world = replace(module.world, ground=Ground(0.0, "separate", 0.6))
    module.grounds, fitted, cost = (
        {"sticky": 2.0, "separate_0.6": 1.0},
        module.identification,
        module.identification.cost(),
    )
    monkeypatch.setattr(
        module,
        "fitted_on",
        lambda ground, _: (cost - 1.0 - (ground != module.world.ground), fitted),
    )
    assert module.better_ground(module.stages[0].but(name="joint")) is None
    assert len(module.ground_gains) > 1 and len(set(module.ground_gains.values())) == 1
    assert named(module.world.ground) == next(iter(module.ground_gains))


@pytest.mark.parametrize("truth", [0.3, 0.6])
def test_a_fit_begins_again_with_the_friction_that_explains_the_learned_law_better(
    monkeypatch, truth
):
    """Where the isotropic law could not tell: here it has none but 0.6 to choose."""
    monkeypatch.setattr(ground_search, "FRICTIONS", (0.6,))
    monkeypatch.setattr(ground_search, "BETWEEN", 1.0)
    module = learning(Ground(0.0, "separate", truth))
    begun = stages_begun(module, monkeypatch)
    identify(module)
    slides, found = Ground(0.0, "separate", 0.6), Ground(0.0, "separate", 0.3)
    again = [("prior", found), ("joint", found)] if truth == 0.3 else []
    assert begun == [("prior", Ground(0.0, "sticky")), ("joint", slides), *again]
    gains = (
        module.ground_gains
    )  # nodes or particles is told by the isotropic law here, so it is not asked
    assert set(gains) == ({"separate_0.3"} if truth == 0.3 else {"separate_0.3", "separate_1.2"})
    assert module.world.ground == Ground(0.0, "separate", truth)
    assert (max(gains.values()) > ground_search.EXPLAINED) == (truth == 0.3)


def test_a_contact_that_cannot_be_simulated_gains_nothing(monkeypatch):
    """And leaves the fit where it was."""
    module = fit_of(take_of(small_body(adapter=False), start(turn=0.5), FRAMES))
    module.begin(stage := module.stages[0])
    module.identification = module.identifying(stage)
    module.identification.iterate()
    before = {name: value.clone() for name, value in module.body.state_dict().items()}
    # the very ground: it is fitted further
    assert module.fitted_on(module.world.ground, stage)[0] < module.identification.cost() + 1e-6
    monkeypatch.setattr(
        Identification,
        "iterate",
        lambda self: (_ for _ in ()).throw(SimulationDiverged("it cannot")),
    )
    assert module.fitted_on(Ground(0.0, "separate", 0.3), stage)[0] == math.inf
    assert all(torch.equal(value, before[name]) for name, value in module.body.state_dict().items())


@pytest.mark.parametrize("near", [1.05, 1.2])
def test_a_fit_is_compared_with_itself_gone_on(monkeypatch, near):
    """It gains by going on, on any ground: by 7 here, on the ground it has and on a rougher one, and stays. Whether its particles
    meet it is asked where the isotropic law does not tell."""
    module = fit_of(take_of(small_body(adapter=False), start(turn=0.5), FRAMES))
    module.begin(module.stages[0])
    module.identification = module.identifying(module.stages[0])
    module.identification.iterate()
    module.world = replace(module.world, ground=Ground(0.0, "separate", 0.6))
    module.grounds, cost = (
        {"sticky": 2.0, "separate_0.6": 1.0, "touch_0.6": near},
        module.identification.cost(),
    )
    monkeypatch.setattr(module, "fitted_on", lambda ground, _: (cost - 7.0, module.identification))
    assert module.better_ground(module.stages[0].but(name="joint")) is None
    assert (
        set(module.ground_gains.values()) == {0.0} and named(module.world.ground) == "separate_0.6"
    )
    assert {contact(name)[0] for name in module.ground_gains} == (
        {"separate", "touch"} if near < 1.1 else {"separate"}
    )


def test_a_fit_that_cannot_go_on_is_compared_as_it_stands(monkeypatch):
    """It began again on whatever ground it was asked for, where the body could not be simulated once more on its own."""
    module = fit_of(take_of(small_body(adapter=False), start(turn=0.5), FRAMES))
    module.begin(module.stages[0])
    module.identification = module.identifying(module.stages[0])
    module.identification.iterate()
    module.world = replace(module.world, ground=Ground(0.0, "separate", 0.6))
    module.grounds, cost = {"sticky": 2.0, "separate_0.6": 1.0}, module.identification.cost()
    monkeypatch.setattr(
        module,
        "fitted_on",
        lambda ground, _: (
            math.inf if ground == module.world.ground else cost + 2.0,
            module.identification,
        ),
    )
    assert module.better_ground(module.stages[0].but(name="joint")) is None
    assert (
        set(module.ground_gains.values()) == {-2.0} and named(module.world.ground) == "separate_0.6"
    )


@pytest.mark.parametrize("mode, friction", [("sticky", 0.0), ("separate", 0.4)])
@pytest.mark.parametrize("cells", [-0.2, 0.37, 1.8])
def test_a_ground_acts_alike_wherever_in_a_cell_it_lies(mode, friction, cells):
    """Body and ground are higher by a part of a cell: the motion is the same, that much higher."""
    body = small_body(adapter=False, contact=True)
    raised, begins = cells * body.settings.dx, start(turn=0.5, speed=-2.0)
    moved = replace(begins, center=begins.center + raised * WORLD.up.to(begins.center))
    low, high = (
        body.simulate(each, world(Ground(height, mode, friction)), FRAMES, FRAME_DT, substeps=40).x
        for each, height in ((begins, 0.0), (moved, raised))
    )
    low, high = low.detach(), high.detach()
    assert float((low - low[0]).abs().max()) > 0.1 * body.size
    assert float((high - low - raised * WORLD.up.to(low)).abs().max()) < 1e-9
    assert float(
        body.contact.height(Ground(raised, mode), body.settings.dx).detach()
    ) == pytest.approx(0.3 * body.settings.dx)


def test_a_ground_of_known_accuracy_bounds_the_contact():
    """Two deviations about what a grid does, of grid and accuracy together; narrow where rollouts are free."""
    offset, ground, dx = ContactOffset(), Ground(0.0), 0.02
    assert offset.prior(ground, dx, free=False) == (offset.UNKNOWN, offset.LIMITS)
    assert offset.prior(None, dx, free=True) == (offset.NARROW, offset.WITHIN)
    sd, bounds = offset.prior(replace(ground, accuracy=0.004), dx, free=True)
    assert sd == pytest.approx(0.25) and bounds == pytest.approx((-0.2, 0.8))


def test_the_accuracy_of_a_ground_is_read_and_checked():
    keys = {"height": 0.1, "mode": "sticky"}
    assert ground_from(keys).accuracy is None
    assert ground_from(keys | {"accuracy": 0.003}) == Ground(0.1, accuracy=0.003)
    for wrong in (-1.0, "low", True):
        with pytest.raises(
            ConfigError, match=r"scene\.ground\.accuracy: expected a number of at least 0"
        ):
            ground_from(keys | {"accuracy": wrong})


def test_particles_that_meet_the_ground_themselves_need_no_lift():
    """The number then is what is not known of the ground's height, from nothing on."""
    offset, sticks, meets = ContactOffset(), Ground(0.0, "sticky"), Ground(0.0, "touch")
    assert (
        float(offset.lift(sticks, 0.1).detach())
        == pytest.approx(0.1 * offset.START)
        == float(offset.lift(None, 0.1).detach())
    )
    assert float(offset.lift(meets, 0.1).detach()) == 0.0
    torch.nn.init.constant_(offset.cells, offset.LIMITS[1])
    assert float(offset.lift(meets, 0.1).detach()) == pytest.approx(
        0.1 * (offset.LIMITS[1] - offset.START)
    )
    assert float(ContactOffset(enabled=False).lift(meets, 0.1).detach()) == 0.0


def test_adam_takes_a_body_that_sticks_and_says_so():
    module = fit_of(
        take_of(small_body(adapter=False), start(turn=0.5), FRAMES), newton_iterations=1
    )
    stage = module.stages[0].but(optimizer="adam")
    with pytest.warns(
        UserWarning, match="scene.ground.mode: auto asks for fit.prior.optimizer=gauss_newton"
    ):
        module.begin(stage)
    assert module.world.ground == Ground(0.0, "sticky") and module.record.ground.mode == "sticky"


@pytest.mark.parametrize("ground, message", [
    ({"height": 0.0, "mode": "auto", "friction": 0.0},
     "mosa.ground.mode: expected sticky or slip or separate or touch, found 'auto'"),
    ({"height": 0.0, "mode": "separate", "friction": -1.0}, "mosa.ground.friction"),
    ({"mode": "sticky"}, "mosa.ground.height: expected this key"),
])  # fmt: skip
def test_a_checkpoint_with_another_ground_is_refused(ground, message):
    saved = strangers.saved()["mosa"] | {"ground": ground}
    parts = {
        name: []
        for name in (
            "state_dict",
            "loops",
            "optimizer_states",
            "lr_schedulers",
            "callbacks",
            "global_step",
            "epoch",
        )
    }
    with pytest.raises(DataError, match=message):
        check_resumed(
            {**parts, "pytorch-lightning_version": "2", "state_dict": {}, "mosa": saved}, "a.ckpt"
        )


def test_frictions_are_within_two_of_each_other():
    """So that the search reaches every coefficient between them to a quarter of a power of two."""
    steps = [b / a for a, b in zip(ground_search.FRICTIONS, ground_search.FRICTIONS[1:])]
    assert all(step == pytest.approx(ground_search.BETWEEN**2) for step in steps)


def test_the_table_of_parameters_has_no_row_for_it():
    figures = {
        "id_prior/E": 1e5,
        "id/E": 1.1e5,
        "id_prior/ground/sticky_m": 0.02,
        "id_prior/ground/separate_1.2_m": 0.021,
        "id_prior/ground/separate_1.2_gain": 1.5,
    }
    text = determined_text(figures, "neo_hookean")
    assert "ground" not in parameter_table(figures, "neo_hookean") and "worse" not in text
    assert text.startswith("Ground: the body sticks to it") and "better by 1.5" in text
