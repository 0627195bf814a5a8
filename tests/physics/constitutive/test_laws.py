"""A law of another module: registration, per-particle vectors, gradients."""

import pytest
import torch
import warp as wp

from mosa.errors import ConfigError
from mosa.physics.constitutive.elasticity import neo_hookean
from mosa.physics.constitutive.laws import LawParameters, law_named, law_names, register_law
from mosa.physics.engine.simulator import Simulator


@wp.func
def fibre(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    a = F * wp.vec3d(p[3], p[4], p[5])
    extension = wp.dot(a, a) - wp.float64(1.0)
    return neo_hookean(F, R, C_affine, p) + wp.float64(2.0) * p[2] * extension * wp.outer(a, a)


PARAMETERS = {"mu": 1, "lam": 1, "kf": 1, "a": 3}


@pytest.fixture
def law():
    register_law("test_fibre", fibre, PARAMETERS, needs_positive_J=True)
    return "test_fibre"


def test_fibre_law_value_and_gradient(law, make_block):
    state = make_block()
    n = len(state.x)
    generator = torch.Generator().manual_seed(0)
    a = torch.nn.functional.normalize(
        torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1
    )
    values = {"mu": torch.tensor(3e4), "lam": torch.tensor(4e4), "kf": 2e4 * torch.ones(n), "a": a}
    values = {k: v.double().requires_grad_() for k, v in values.items()}
    volume = torch.full((n,), 8e-6, dtype=torch.float64)
    sim = Simulator(law, dx=0.04, substeps=20, frame_dt=0.008, dtype=torch.float64)
    plain = Simulator("neo_hookean", dx=0.04, substeps=20, frame_dt=0.008, dtype=torch.float64)

    seen = sim.material_state(state.F, state.C_affine, values).stress
    tau = torch.zeros(n, 3, 3).double()
    for i, (j, k) in enumerate(((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))):
        tau[:, j, k] = tau[:, k, j] = seen[:, i].detach()
    base = plain.material_state(state.F, state.C_affine, {"mu": 3e4, "lam": 4e4}).stress
    # in the material frame the fibre term is 2 kf (I4 - 1) (W a)(W a)^T
    U, _, Vh = torch.linalg.svd(state.F)
    Wa = ((U @ Vh).mT @ state.F @ a[..., None])[..., 0]
    extra = 4e4 * ((Wa**2).sum(1) - 1)[:, None, None] * Wa[:, :, None] * Wa[:, None, :]
    expected = torch.stack(
        [extra[:, j, k] for j, k in ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))], 1
    )
    torch.testing.assert_close(seen - base, expected, rtol=1e-10, atol=1e-8)

    def loss(values):
        return (sim.rollout(state, values, volume, 1000.0, 3).x[-1] ** 2).sum()

    gradients = dict(zip(values, torch.autograd.grad(loss(values), list(values.values()))))
    for name, h in (("mu", 1.0), ("kf", 1.0), ("a", 1e-4)):
        direction = torch.randn(values[name].shape, generator=generator, dtype=torch.float64)

        def shifted(s, name=name, direction=direction):
            with torch.no_grad():
                return loss({**values, name: values[name] + s * direction})

        found = (gradients[name] * direction).sum()
        expected = (8 * (shifted(h) - shifted(-h)) - (shifted(2 * h) - shifted(-2 * h))) / (12 * h)
        assert abs(float(found - expected)) < 1e-6 * abs(float(expected)), name


@pytest.mark.parametrize(("name", "elastic"), [
    ("stvk", True), ("stvk~damped", True), ("von_mises", False), ("newtonian", False), ("drucker_prager", False),
    ("herschel_bulkley", False),
])  # fmt: skip
def test_an_elastic_law_neither_yields_nor_flows(name, elastic):
    assert law_named(name).elastic == elastic


def test_registration(law):
    assert register_law("test_fibre", fibre, PARAMETERS, needs_positive_J=True).offsets == {
        "mu": 0,
        "lam": 1,
        "kf": 2,
        "a": 3,
    }
    with pytest.raises(ConfigError, match="registered already"):
        register_law("test_fibre", fibre, ("mu", "lam"))
    with pytest.raises(ConfigError, match="at most 12"):
        register_law("test_large", fibre, {"a": 13})


@wp.func
def turned(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """2 mu (F - R) F^T."""
    return wp.float64(2.0) * p[0] * (F - R) * wp.transpose(F)


@wp.func
def flowing(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu sym(C_affine)."""
    return p[0] * wp.float64(0.5) * (C_affine + wp.transpose(C_affine))


@wp.func
def handed_on(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    return neo_hookean(F, R, C_affine, p) + turned(F, R, C_affine, p)


def test_what_a_stress_reads_is_registered_with_it():
    """R was F without a word, and the corotated law of another package one of a change of volume alone."""
    names = ("mu", "lam")
    with pytest.raises(
        ConfigError, match=r"'t_turned': expected .* uses_rotation=True, .*reads R,"
    ):
        register_law("t_turned", turned, names)
    with pytest.raises(ConfigError, match=r"'t_handed_on': expected .*reads R,"):
        register_law("t_handed_on", handed_on, names)
    with pytest.raises(ConfigError, match=r"'t_flowing': expected .* viscosity, .*reads C_affine,"):
        register_law("t_flowing", flowing, names)
    with pytest.raises(
        ConfigError, match=r"'t_plain': expected a wp\.func of its stress, found <f"
    ):
        register_law("t_plain", lambda F, R, C_affine, p: F, names)
    assert not {"t_turned", "t_handed_on", "t_flowing", "t_plain"} & set(law_names())
    register_law("t_turned", turned, names, uses_rotation=True)
    register_law("t_flowing", flowing, names, viscosity=lambda mu, lam: mu)
    assert law_named("t_turned~damped").uses_rotation and law_named("t_turned+t_flowing")
