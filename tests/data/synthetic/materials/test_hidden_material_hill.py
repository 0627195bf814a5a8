"""The directional yield: admissible afterwards, associated, symmetric about its axes, von Mises where all coefficients are 1."""

import math

import pytest
import torch
from anisotropic_states import check_gradients, drawn_rotations, drawn_states, mapped, stress
from hill_material import HillMaterial
from substep_reference import deviator, hencky_material, polar

from mosa.data.synthetic.materials.hill import COEFFICIENTS, HILL
from mosa.errors import ConfigError
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

AXES = drawn_rotations(1, 31)[0]
CLAY = HillMaterial(
    E=8.0, nu=0.3, yield_stress=0.8, coefficients=(0.6, 1.5, 2.2, 0.7, 1.9, 0.5), axes=AXES
)


def in_axes(F):
    """dev log W (N, 3, 3) in the material axes."""
    return AXES.T @ deviator(hencky_material(F)) @ AXES


def equivalent(e, material):
    """Hill's equivalent stress [Pa] of a deviatoric strain (N, 3, 3) in the axes, from its definition."""
    f, g, h, l, m, n = material.coefficients
    s = 2 * float(material.parameters()["mu"]) * e
    normal = (
        f * (s[:, 1, 1] - s[:, 2, 2]) ** 2
        + g * (s[:, 2, 2] - s[:, 0, 0]) ** 2
        + h * (s[:, 0, 0] - s[:, 1, 1]) ** 2
    )
    shear = l * s[:, 1, 2] ** 2 + m * s[:, 0, 2] ** 2 + n * s[:, 0, 1] ** 2
    return torch.sqrt(normal / 3 + 2 * shear)


def operator(e, material):
    """M e = half the gradient of e:M:e over symmetric matrices."""
    leaf = e.clone().requires_grad_()
    mu = float(material.parameters()["mu"])
    (gradient,) = torch.autograd.grad((equivalent(leaf, material) ** 2).sum() / (2 * mu) ** 2, leaf)
    return 0.25 * (gradient + gradient.mT)


def test_return_is_admissible_associated_and_idempotent():
    F, p = (
        torch.cat([drawn_states(), torch.eye(3) + 0.1 * (drawn_states(4) - torch.eye(3))]),
        CLAY.parameters(),
    )
    before, A = in_axes(F), mapped(HILL, F, p)
    after = in_axes(A)
    trial = equivalent(before, CLAY)
    elastic = trial <= CLAY.yield_stress
    assert min(int(elastic.sum()), int((~elastic).sum())) > 3
    assert torch.equal(A[elastic], F[elastic])
    assert (equivalent(after, CLAY) - trial.clamp(max=CLAY.yield_stress)).abs().max() < 1e-12
    assert (torch.linalg.det(A) - torch.linalg.det(F)).abs().max() < 1e-12
    assert (mapped(HILL, A, p) - A).abs().max() < 1e-12
    assert (polar(A) - polar(F)).abs().max() < 1e-12
    # the plastic step points along the gradient of the criterion at where it ends, outwards
    step, normal = (before - after)[~elastic], operator(after, CLAY)[~elastic]
    gamma = (step * normal).sum((1, 2)) / (normal**2).sum((1, 2))
    assert gamma.min() > 0
    assert (step - gamma[:, None, None] * normal).abs().max() < 1e-12
    # and so does not keep the directions of the trial strain: the control
    radial = before[~elastic] * (CLAY.yield_stress / trial[~elastic])[:, None, None]
    assert (after[~elastic] - radial).abs().max() > 1e-2


def test_far_outside_the_surface():
    """Strains up to 100 times the yield strain: the multiplier's iteration has to hold on."""
    weak = HillMaterial(E=8.0, nu=0.3, yield_stress=0.02, coefficients=CLAY.coefficients, axes=AXES)
    A = mapped(HILL, drawn_states(), weak.parameters())
    assert equivalent(in_axes(A), weak).max() < weak.yield_stress * (1 + 1e-11)


def test_equal_coefficients_are_von_mises():
    F = drawn_states()
    plain = HillMaterial(E=8.0, nu=0.3, yield_stress=0.8, axes=AXES).parameters()
    von_mises = {name: plain[name] for name in ("mu", "lam", "yield_stress")}
    found = mapped(HILL, F, plain)
    assert (found - mapped("von_mises", F, von_mises)).abs().max() < 1e-12
    assert (found - F).abs().max() > 1e-2
    expected = stress("von_mises", found, von_mises)
    assert (stress(HILL, found, plain) - expected).abs().max() < 1e-12 * expected.abs().max()


def test_objective_and_symmetric_about_its_axes():
    F, p = drawn_states(), CLAY.parameters()
    A, Q = mapped(HILL, F, p), drawn_rotations(len(F), 7)
    assert (mapped(HILL, Q @ F, p) - Q @ A).abs().max() < 1e-12
    for signs in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1]):
        H = AXES @ torch.diag(torch.tensor(signs).double()) @ AXES.T
        assert (mapped(HILL, F @ H, p) - A @ H).abs().max() < 1e-12
    quarter = AXES @ torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double() @ AXES.T
    assert (mapped(HILL, F @ quarter, p) - A @ quarter).abs().max() > 1e-3


@pytest.mark.parametrize(("pair", "coefficient"), [((1, 2), 3), ((0, 2), 4), ((0, 1), 5)])
def test_shear_strength_in_each_plane(pair, coefficient):
    """In the plane of two axes the shear s yields at 2 c s^2 = yield_stress^2."""
    e = torch.zeros(3, 3).double()
    e[pair] = e[pair[::-1]] = 0.4
    F = torch.linalg.matrix_exp(AXES @ e @ AXES.T)[None]
    A = mapped(HILL, F, CLAY.parameters())
    s = 2 * float(CLAY.parameters()["mu"]) * in_axes(A)[0][pair]
    assert float(s) == pytest.approx(
        CLAY.yield_stress / math.sqrt(2 * CLAY.coefficients[coefficient]), rel=1e-12
    )


def test_gradient():
    F = drawn_states()
    leaves = {
        "F": F,
        **{k: v.expand(len(F), *v.shape).contiguous() for k, v in CLAY.parameters().items()},
    }
    del leaves["lam"]  # the flow is deviatoric and does not know it
    lam = CLAY.parameters()["lam"]
    weights = torch.randn(
        len(F), 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )

    def loss(F, **parameters):
        return (weights * mapped(HILL, F, {**parameters, "lam": lam})).sum((1, 2))

    check_gradients(loss, leaves, seed=2)


def test_a_body_of_it_stays_admissible_in_the_simulator():
    """A cube driven into the ground: no particle is outside the criterion, and the plastic strain shows in F_tot."""
    material = HillMaterial(
        E=8e4, nu=0.3, yield_stress=1e3, coefficients=CLAY.coefficients, axes=AXES
    )
    index = (
        torch.stack(torch.meshgrid(*(torch.arange(5),) * 3, indexing="ij"), -1)
        .reshape(-1, 3)
        .double()
    )
    n, eye = len(index), torch.eye(3).double().expand(len(index), 3, 3).contiguous()
    v = torch.tensor([0.3, -2.0, 0.1]).double().expand(n, 3).contiguous()
    state = ParticleState(0.02 * index + 0.03, v, torch.zeros_like(eye), eye, eye)
    sim = Simulator(
        HILL, dx=0.04, substeps=100, frame_dt=0.04, ground=Ground(0.0), dtype=torch.float64
    )
    final = sim.rollout(
        state, material.parameters(), torch.full((n,), 8e-6).double(), 1000.0, 2
    ).final
    assert equivalent(in_axes(final.F), material).max() < material.yield_stress * (1 + 1e-12)
    assert (final.F_tot - final.F).abs().max() > 0.05


def test_mistakes():
    with pytest.raises(ConfigError, match="six positive numbers"):
        HillMaterial(8.0, 0.3, 0.8, coefficients=(1.0, 1.0, 1.0, 1.0, 1.0, 0.0))
    assert set(COEFFICIENTS) < set(CLAY.parameters())
