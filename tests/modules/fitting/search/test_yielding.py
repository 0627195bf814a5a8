"""Bodies that stay deformed, and the laws that are then compared."""

import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small_bodies import NU, WORLD, E, small_body, start, take_of

from mosa.errors import SimulationDiverged
from mosa.modules.body.material import Material, taken
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.search import backbone
from mosa.modules.fitting.search.backbone import BETTER, choose_law
from mosa.modules.fitting.search.yielding import LASTS, lasting, warn_of_yielding
from mosa.modules.fitting.stages import Stage
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.types import MarkerCues

BEGINS = start(turn=0.5, speed=-3.0)
YIELDS = 2500.0
LAWS = ("corotated", "stvk", "von_mises")
GIVEN = {"E": E, "nu": NU, "mu": 15.0, "kappa": 2e4, "yield_stress": YIELDS, "friction_angle": 25.0, "cohesion": 0.0}  # fmt: skip


def body_of(law, scale=1.0, **changes):
    body = small_body(adapter=False)
    given = GIVEN | {"E": scale * E} | changes
    body.material = Material(law, {name: given[name] for name in taken(law, given)}).double()
    return body


def film(law, frames=12, **changes):
    return take_of(body_of(law, **changes), BEGINS, frames)


def test_a_body_that_yields_keeps_a_shape_that_no_elastic_law_has():
    yielded, elastic = film("von_mises"), film("stvk")
    for E_of in (0.3, 1.0):  # a calibration of an elastic law takes such a body for a soft one
        assert LASTS < lasting(body_of("stvk", scale=E_of), [yielded], WORLD, unexplained=True)
    assert lasting(body_of("von_mises"), [yielded], WORLD, unexplained=True) == 0.0
    assert lasting(body_of("von_mises"), [yielded], WORLD) > LASTS
    # a law that is wrong, of an elastic body
    assert lasting(body_of("corotated", scale=1.3), [elastic], WORLD) < 0.5 * LASTS
    assert lasting(body_of("corotated"), [elastic, yielded], WORLD) > LASTS
    # a prediction that ends in another shape says nothing of a body that has its own again
    assert lasting(body_of("von_mises"), [elastic], WORLD) < 0.5 * LASTS
    # films that end as the body is squashed, and of a body that flows to the end
    assert lasting(body_of("corotated"), [film("stvk", frames=3)], WORLD) == 0.0
    assert lasting(body_of("stvk"), [film("von_mises", yield_stress=800.0)], WORLD) > LASTS


@pytest.mark.parametrize("velocity, share", [(0.0, True), (0.1, False)])
def test_a_body_that_is_pressed_does_not_tell(velocity, share):
    far = Collider(Sphere(0.05), motion=Motion((0.0, 5.0, 0.0), velocity=(0.0, velocity, 0.0)))
    world = replace(WORLD, colliders=(far,))
    assert (lasting(body_of("stvk"), [film("von_mises")], world) > LASTS) == share


def test_a_liquid_that_a_very_soft_law_explains_is_one_that_stays_deformed():
    liquid, soft = film("newtonian"), body_of("stvk", scale=0.01)
    assert lasting(soft, [liquid], WORLD, unexplained=True) < LASTS < lasting(soft, [liquid], WORLD)


def test_tracked_points_tell_it_too():
    take, body = film("von_mises"), body_of("stvk")
    few = torch.arange(0, len(body.rest), 5)
    seen = take.cues.positions[:, few].clone()
    seen[3, 0] = torch.nan
    take.cues = MarkerCues(seen, few[:, None], torch.ones(len(few), 1).double())
    for unexplained in (False, True):
        assert lasting(body, [take], WORLD, unexplained) > LASTS
    seen[torch.arange(len(few)) % len(seen), torch.arange(len(few))] = torch.nan
    assert lasting(body, [take], WORLD) == 0.0  # each was lost once


def test_an_elastic_prior_of_such_a_body_is_warned_of():
    take = film("von_mises")
    with pytest.warns(UserWarning, match=r"keeps \d+% of its largest change.*von_mises, newtonian"):
        warn_of_yielding(body_of("stvk"), [take], WORLD)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_yielding(body_of("von_mises"), [take], WORLD)
        warn_of_yielding(body_of("stvk"), [film("stvk")], WORLD)


def made(errors, tried):
    """Calibrations of a body whose laws have these errors [m], None where it diverges."""
    given = {"E": E, "nu": NU, "yield_stress": YIELDS}
    body = small_body(adapter=False)
    body.material = Material("auto", given, candidates=LAWS).double()

    def build():
        law = body.material.law
        tried.append(law)

        def search():
            if errors[law] is None:
                raise SimulationDiverged("")
            with torch.no_grad():
                body.material.raw["E"].fill_(float(LAWS.index(law)))

        gains = (0.0,) if law == "von_mises" else (0.5,)
        return SimpleNamespace(search=search, iterate=dict, gains=gains,
                               score=lambda asked: errors[law] if asked == (0.5,) else 1e3)  # fmt: skip

    return body, build


@pytest.mark.parametrize(("share", "yielding", "law"), [
    (0.9 * LASTS, 1e-3, "stvk"), (0.9, 1e-3, "von_mises"), (0.9, 0.99 * BETTER * 8e-3, "von_mises"),
    (0.9, 1.01 * BETTER * 8e-3, "stvk"), (0.9, None, "stvk"),
])  # fmt: skip
def test_laws_that_yield_are_asked_where_the_body_stays_deformed_and_taken_where_they_predict_it(
    share, yielding, law
):
    tried: list[str] = []
    errors = {"corotated": 9e-3, "stvk": 8e-3, "von_mises": yielding}
    body, build = made(errors, tried)
    laws_at = []

    def lasts():
        laws_at.append((body.material.law, body.material.raw["E"].item()))
        return share

    found = choose_law(body, LAWS, build, lasts)
    assert laws_at == [("stvk", 1.0)]  # asked of the best elastic law
    assert tried == list(LAWS[: 3 if share > LASTS else 2]) and set(found) == set(tried)
    assert found.get("von_mises", 1e-3) == (math.inf if yielding is None else yielding)
    assert body.material.law == law and body.material.candidates == ()
    assert body.material.raw["E"].item() == LAWS.index(law)


def test_a_law_that_yields_is_left_where_no_elastic_one_can_be_simulated():
    tried: list[str] = []
    body, build = made({"corotated": None, "stvk": None, "von_mises": 1e-3}, tried)
    choose_law(body, LAWS, build, lambda: pytest.fail("no elastic law is there to be asked"))
    assert body.material.law == "von_mises" and tried == list(LAWS)


FLOWING = ("von_mises", "drucker_prager", "newtonian")


@pytest.mark.parametrize(("truth", "yield_stress"), [("stvk", 1e6), *((law, YIELDS) for law in FLOWING)])  # fmt: skip
def test_all_kinds_of_law_are_compared_by_one_prediction(monkeypatch, truth, yield_stress):
    """With a yield stress that the motion does not reach von Mises is the elastic law."""
    monkeypatch.setattr(Identification, "search", lambda self: 0.0)
    monkeypatch.setattr(backbone, "TRIED", 1)
    take = film(truth)
    body = small_body(adapter=False)
    laws = ("stvk", *FLOWING)
    given = {name: 1.1 * value for name, value in (GIVEN | {"yield_stress": yield_stress}).items()}
    body.material = Material("auto", given, candidates=laws).double()
    stage = Stage(name="prior", iterations=3, lr=0.1, optimizer="gauss_newton")
    errors = choose_law(
        body, laws,
        lambda: Identification(body, [take], WORLD, stage, Criterion(name="corrected"), IdentificationSettings()),
        lambda: 1.0,
    )  # fmt: skip
    if truth == "stvk":
        assert errors["von_mises"] == pytest.approx(errors["stvk"], rel=0.1)
    else:
        assert errors[truth] < 0.5 * errors["stvk"]
    assert body.material.law == truth
