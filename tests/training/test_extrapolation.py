"""The law's numbers on two grids, and where a grid without spacing would put them."""

import math
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_dir

from mosa.config.composition import configuration
from mosa.errors import ConfigError
from mosa.evaluation.analysis.tables import continued_text
from mosa.evaluation.uncertainty import INFLATION
from mosa.modules.body.material import FORMS
from mosa.modules.fitting.stages import Stage
from mosa.training.assembly import assemble
from mosa.training.extrapolation import Identified, check_can_extrapolate, continued, extrapolated


def test_what_is_linear_in_the_spacing_is_continued_to_its_value_at_0():
    """In the logarithm of E, with the standard deviations of both grids: at 1 and 1.5 mm the finer one counts three times."""

    def at(dx: float) -> float:
        return math.log(3e5) + 200.0 * dx

    found = continued(
        Identified(1e-3, {"E": (at(1e-3), 0.01)}), Identified(1.5e-3, {"E": (at(1.5e-3), 0.02)})
    )
    coarse, limit, sd = found["E"]
    assert coarse == pytest.approx(3e5 * math.exp(0.3), rel=1e-6) and limit == pytest.approx(
        3e5, rel=1e-6
    )
    assert sd == pytest.approx(3e5 * math.hypot(3 * 0.01, 2 * 0.02), rel=1e-5)


def test_a_poisson_number_stays_in_its_range():
    inverse = FORMS["nu"].inverse
    found = continued(
        Identified(1e-3, {"nu": (inverse(0.45), 0.1)}),
        Identified(1.44e-3, {"nu": (inverse(0.3), 0.1)}),
    )
    assert 0.45 < found["nu"][1] < 0.49


def test_a_calibration_is_continued_from_the_scene_s_own_images(tmp_path):
    """Of a body without adapter and eta: what is printed follows from two fits, one of a third of the particles."""
    overrides = ["scene=tiny", "scene.material=isotropic", "scene.scale=0.25", f"scene.cache={tmp_path}",
                 "trainer=cpu", "prior=neo_hookean", "simulation.particles=200", "adapter=none", "heterogeneity.enabled=false",
                 "reconstruction.resolution=40", "reconstruction.points=500", "reconstruction.static.iterations=10",
                 "reconstruction.dynamic.track_iterations=2",
                 "reconstruction.dynamic.iterations=5", "reconstruction.appearance.iterations=2",
                 "reconstruction.carried.iterations=2", "fit.prior.newton_iterations=1"]  # fmt: skip
    with initialize_config_dir(configuration(), version_base=None):
        cfg = compose("train", overrides=overrides)
    run = assemble(cfg, held_out=False)
    check_can_extrapolate(run.module)
    run.module.identify()
    found = extrapolated(cfg, run, {"E": 1e5})
    assert found["extrapolated/coarse_dx_m"] == pytest.approx(
        3 ** (1 / 3) * found["extrapolated/dx_m"], rel=0.1
    )
    weight = found["extrapolated/dx_m"] / (
        found["extrapolated/coarse_dx_m"] - found["extrapolated/dx_m"]
    )
    fine, other = (
        math.log(float(run.body.material.physical()["E"].detach())),
        math.log(found["extrapolated/E_coarse"]),
    )
    assert math.log(found["extrapolated/E"]) == pytest.approx(
        fine + weight * (fine - other), abs=1e-4
    )
    own = INFLATION * float(run.module.posterior.covariance[0, 0]) ** 0.5
    assert found["extrapolated/E_sd"] > (1 + weight) * own * found["extrapolated/E"]
    assert found["extrapolated/E_relative_error"] == pytest.approx(
        abs(found["extrapolated/E"] / 1e5 - 1)
    )
    law = run.body.material.law
    lines = continued_text(found | {f"id/{name}": 1.0 for name in ("E", "nu")}, law).splitlines()
    assert (
        lines[0].startswith("On grids of ")
        and sum(line.startswith("- ") for line in lines) == 2
        and not continued_text({}, law)
    )


def test_a_fit_by_adam_cannot_be_continued():
    stages = [
        Stage(name="prior", iterations=5, lr=0.1, optimizer="gauss_newton"),
        Stage(name="joint", iterations=5, lr=0.1, optimizer="adam"),
    ]
    with pytest.raises(ConfigError, match=r"extrapolate.*fit\.joint\.optimizer=adam"):
        check_can_extrapolate(SimpleNamespace(stages=stages))
