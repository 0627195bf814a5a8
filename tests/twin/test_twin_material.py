"""A twin's material: read, set, presets, and what the twin says of itself."""

import pytest
import torch
from small_bodies import FRAME_DT, NU, STICKY, E, small_body, start
from strangers import checkpoint

from mosa.errors import ConfigError
from mosa.modules.adapters.microplane import isotropic_stiffness
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.twin.material_files import described
from mosa.twin.presets import PRESETS
from mosa.twin.saved import save_twin
from mosa.twin.twin import Twin


def twin(**options):
    return Twin(small_body(**options), STICKY, FRAME_DT, None, start(height=0.1, speed=-1.0))


def test_values_are_read_in_physical_units():
    material = twin(modes=True).material
    assert material.law == "corotated" and material.damping == 0
    assert (material.E, material.nu, material.density) == (
        pytest.approx(E),
        pytest.approx(NU),
        1000.0,
    )
    assert torch.equal(material.field, torch.ones(120).double())
    mu = E / (2 * (1 + NU))
    expected = 2 * mu * isotropic_stiffness(torch.tensor(NU).double())
    assert torch.allclose(material.stiffness, expected, rtol=1e-6, atol=1e-6 * E)


def test_stiffness_holds_the_learned_correction():
    numbers = 0.3 * torch.randn(19, generator=torch.Generator().manual_seed(1))
    made = twin(numbers=numbers)
    mu = E / (2 * (1 + NU))
    expected = 2 * mu * made.body.adapter.stiffness().detach()
    assert torch.allclose(made.material.stiffness, expected, rtol=1e-6, atol=1e-6 * E)
    made.body.adapter = StressAdapter()
    made.body.adapter.switch_on(E, NU)
    isotropic = 2 * mu * isotropic_stiffness(torch.tensor(NU).double())
    assert torch.allclose(made.material.stiffness, isotropic, rtol=1e-5, atol=1e-5 * E)


def test_what_is_set_is_simulated():
    soft, stiff = twin(adapter=False), twin(adapter=False, E=4 * E)
    before = soft.simulate(frames=8)
    soft.material.E = 4 * E
    assert soft.material.E == pytest.approx(4 * E)
    after, expected = soft.simulate(frames=8), stiff.simulate(frames=8)
    assert torch.allclose(after.x, expected.x, atol=1e-9)
    assert float((after.x - before.x).abs().max()) > 1e-4
    soft.material.set(damping=20.0, density=500)
    assert soft.material.damping == pytest.approx(20) and soft.body.density == 500
    assert soft.body.material.law == "corotated~damped"
    assert float((soft.simulate(frames=8).x - after.x).abs().max()) > 1e-5
    soft.material.damping = 0
    assert soft.body.material.law == "corotated"


def test_a_value_out_of_range_is_named():
    material = twin(adapter=False).material
    with pytest.raises(ConfigError, match=r"^nu: expected a number between .*incompressible=true"):
        material.nu = 0.7
    with pytest.raises(ConfigError, match="density: expected"):
        material.density = -1
    with pytest.warns(UserWarning, match=r"^density: 1.1 kg/m\^3 is lighter .* in g/cm\^3"):
        material.density = 1.1
    material.density = 1000.0
    with pytest.warns(UserWarning, match="^E: 20 Pa does not carry the body's weight"):
        material.E = 20.0
    with pytest.raises(ConfigError, match="preset: expected one of jelly, "):
        material.preset("steel")
    assert material.nu == pytest.approx(NU)


def test_an_unknown_value_is_named_with_those_of_the_law():
    material = twin(adapter=False).material
    known = "expected one of E, nu, damping, bulk_damping, density"
    with pytest.raises(ConfigError, match=f"^rho: unknown value; {known}$"):
        material.set(rho=900)
    with pytest.raises(ConfigError, match=f"^densty: unknown value; {known}; the nearest is dens"):
        material.densty = 900
    with pytest.raises(
        ConfigError, match=r"^yield: unknown value; expected one of E, yield_stress, nu"
    ):
        material.set(law="von_mises", **{"yield": 2e4})
    with pytest.raises(ConfigError, match=r"^E goes with nu, found E, yield_stress"):
        material.set(law="von_mises", E=1e5, yield_stress=2e4)


NUMBERS = 0.2 * torch.randn(19, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("preset, laws", [
    (None, [{"E": 2 * E}, {"nu": 0.2, "E": 2 * E}, {}]),
    ("jelly", [{"E": 2e4}, {}]), ("clay", [{"yield_stress": 1e3}, {}]), ("honey", [{"mu": 10.0}, {"kappa": 1e4}]),
])  # fmt: skip
def test_worlds_of_other_values_are_twins_whose_material_was_set(preset, laws):
    def made():
        found = twin(numbers=NUMBERS, modes=True)
        if preset:
            found.material.preset(preset)
        return found

    together, motion = made(), {"height": 0.02, "frames": 6, "substeps": 160}
    worlds = together.worlds(len(laws), laws=laws)
    before = together.material.parameters
    worlds.reset({"height": motion.pop("height")}, **motion)
    for _ in range(5):
        found = worlds.step().state.positions
    for b, values in enumerate(laws):
        alone = made()
        alone.material.set(**values)
        assert together.material.parameters == before != alone.material.parameters or not values
        expected = alone.simulate(height=0.02, **motion).x[-1]
        assert torch.allclose(found[b], expected, rtol=0, atol=1e-9)
    assert float((found[0] - found[1]).abs().max()) > 1e-5


def test_values_that_worlds_cannot_differ_in_are_named():
    made = twin(adapter=False)
    for values, said in (
        ({"rho": 1.0}, "rho: unknown value; expected one of E, nu, "),
        ({"nu": 0.7}, "nu: expected a number between 0 and 0.49"),
        ({"E": "soft"}, "E: expected a number"),
        (
            {"density": 900},
            r"laws\[1\]: worlds differ in E, nu, .* found density; twin.material.set",
        ),
        ({"damping": 5.0}, r"laws\[1\]: worlds differ in E, nu, .* found damping;"),
        ({"nu": 0.0}, r"laws\[1\]: worlds differ in E, nu, inside their ranges, found nu;"),
    ):
        with pytest.raises(ConfigError, match=f"^{said}"):
            made.worlds(2, laws=[{}, values])
    for laws in ({"E": 1e4}, [{"E": 1e4}], [1e4, 2e4]):
        with pytest.raises(
            ConfigError, match=r"^laws: expected one for each of 2 worlds, .*, or \[{'E'"
        ):
            made.worlds(2, laws=laws)


def rebound(worlds, **options):
    """[m] of the lowest point after the first bounce, by world."""
    worlds.reset({"height": 0.1}, frames=20, **options)
    low = torch.stack([worlds.step().state.positions[..., 1].amin(1) for _ in range(20)])
    return [float(path[int(path.argmin()) :].max()) for path in low.mT]


def test_substeps_damp_and_worlds_of_unlike_stiffness_say_so():
    made = twin(adapter=False, precision=32)
    alone = made.worlds(1)
    heights = [rebound(alone, substeps=count)[0] for count in (20, 40, 80, 160)]
    assert heights == sorted(heights, reverse=True) and heights[-1] < 0.9 * heights[0]
    both = made.worlds(2, laws=[{}, {"E": 50 * E}])
    with pytest.warns(
        UserWarning, match=r"^laws: all .* alone, world 0 takes \d+ and bounces high"
    ):
        soft, _ = rebound(both)
    assert soft == pytest.approx(rebound(alone, substeps=both.episode.substeps)[0], rel=1e-4)
    assert soft < 0.95 * rebound(alone)[0]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_can_be_simulated(name):
    made = twin(modes=True, precision=32)
    made.material.preset(name)
    assert made.body.adapter is None and made.material.density == PRESETS[name].density
    assert made.body.material.law == PRESETS[name].law and len(PRESETS[name].source) > 40
    assert bool(made.simulate(frames=2).x.isfinite().all())


def test_a_correction_that_a_fit_left_out_is_not_said_to_be_learned():
    made = twin()
    assert "no correction of the law" in made.summary() and "Adapter" not in made.summary()
    assert not described(made)["not_in_E_and_nu"]
    with torch.no_grad():
        made.body.adapter.numbers[3] = 0.3
    assert "HyperelasticAdapter, a correction" in made.summary()
    assert "correction" in described(made)["not_in_E_and_nu"][0]


def test_summary_and_reprs_are_short_and_have_units():
    made = twin()
    said = made.summary()
    assert "120 particles" in said and "E = 3e+04 Pa" in said and "sticky" in said
    assert (
        "(20, 3)" not in said
        and "stiffest along" not in said
        and len(max(said.splitlines(), key=len)) < 120
    )
    state = made.reset(frames=2)
    rollout = made.simulate(frames=2)
    sure = Posterior([f"a[{i}]" for i in range(70)], torch.zeros(70), torch.eye(70), torch.ones(70))
    for each in (
        state,
        made.step(),
        rollout,
        made.world,
        made.training_start,
        made.body,
        made.worlds(2),
        sure,
    ):
        assert len(repr(each)) < 500 and type(each).__name__ in repr(each)
    assert repr(made.step()).startswith("Stepped(state=TwinState(x=(120, 3)")
    assert "x=(2, 120, 3)" in repr(rollout) and repr(made.worlds(2)).startswith(
        "TwinWorlds(2 worlds"
    )
    assert repr(made) == (
        "Twin(120 particles, 100 mm, TwinMaterial(corotated: E = 3e+04 Pa, nu = 0.35; 1000 kg/m^3))"
    )


def test_a_checkpoint_keeps_what_was_set(tmp_path):
    body = small_body(precision=32)
    plain = Twin(body, STICKY, FRAME_DT, None, start(dtype=torch.float32))
    law = {"law": "auto", "parameters": {"E": 1e4, "nu": 0.3}, "candidates": ["corotated", "stvk"]}
    settings = {
        "prior": law,
        "adapter": {"name": "hyperelastic"},
        "heterogeneity": {"enabled": False},
    }
    record = plain.record.but(settings=settings, law="corotated")
    for change in (lambda m: m.set(E=5e4, damping=3.0, density=700), lambda m: m.preset("clay")):
        made = Twin(body, STICKY, FRAME_DT, record, plain.training_start)
        change(made.material)
        found = Twin.load(save_twin(made, tmp_path / "last.ckpt"))
        assert found.material.law == made.material.law and found.body.density == made.body.density
        assert found.material.parameters == pytest.approx(made.material.parameters)
        assert (found.body.adapter is None) == (made.body.adapter is None)
        expected = made.simulate(height=0.02, frames=4)
        assert torch.allclose(found.simulate(height=0.02, frames=4).x, expected.x, atol=1e-6)


def test_a_twin_is_loaded_without_a_trace_in_the_callers_random_numbers(tmp_path):
    """They were those of the run's seed: the same after each load."""
    path = checkpoint(tmp_path / "last.ckpt")
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    Twin.load(path)
    assert torch.equal(torch.rand(3), expected)


def test_a_twin_that_is_loaded_in_inference_mode_has_gradients_later(tmp_path):
    path = checkpoint(tmp_path / "last.ckpt")
    with torch.inference_mode():
        loaded = Twin.load(path)
    velocity = torch.zeros(3, requires_grad=True)
    loaded.reset(velocity=velocity, differentiable=True)
    state, _ = loaded.step()
    (slope,) = torch.autograd.grad(state.positions.sum(), velocity)
    assert bool((slope > 0).all())
    loaded.material.E = 2 * E
    assert loaded.material.E == pytest.approx(2 * E)
