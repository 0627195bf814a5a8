"""Herschel-Bulkley returns: admissible at viscosity 0, relaxed by their formula otherwise, determinant kept (verification 11)."""

import numpy as np
import pytest
import torch
from substep_reference import deviator, hencky_material

from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.material_operations import first_advance
from mosa.physics.engine.simulator import Simulator

MU, KAPPA, YIELD, DT = 3.0, 7.0, 0.8, 1e-3
LAWS = ["herschel_bulkley", "herschel_bulkley_hencky"]
RADIUS = (2 / 3) ** 0.5 * YIELD


def mapped(law, F, viscosity, **options):
    sim = Simulator(
        law, dx=0.1, substeps=1, frame_dt=DT, dtype=torch.float64, options=LawOptions(**options)
    )
    parameters = {"mu": MU, "kappa": KAPPA, "yield_stress": YIELD, "viscosity": viscosity}
    return first_advance(sim.numerics, F, torch.zeros_like(F), sim.pack(parameters, len(F)))


def norm(law, F):
    """|s| of the yield function, (N,) [Pa]."""
    if law == "herschel_bulkley_hencky":
        return 2 * MU * torch.linalg.matrix_norm(deviator(hencky_material(F)))
    J = torch.linalg.det(F)[:, None, None]
    return MU * torch.linalg.matrix_norm(deviator(J ** (-2 / 3) * F @ F.mT))


@pytest.fixture
def trials(drawn):
    """Trial gradients with J > 0 and S above the clamp: special singular values, generic ones, and barely deformed ones."""
    _, F = drawn
    generator = torch.Generator().manual_seed(6)
    free = (
        torch.eye(3).double()
        + torch.randn(80, 3, 3, generator=generator, dtype=torch.float64)
        * torch.tensor([0.3, 0.04]).double().repeat(40)[:, None, None]
    )
    F = torch.cat([F, free])
    return F[(torch.linalg.det(F) > 0) & (torch.linalg.svdvals(F)[:, 2] > 0.055)]


@pytest.mark.parametrize("law", LAWS)
def test_without_viscosity_it_is_a_projection(law, trials):
    before, A = norm(law, trials), mapped(law, trials, 0.0)
    elastic = before <= RADIUS
    assert min(int(elastic.sum()), int((~elastic).sum())) > 20
    assert torch.equal(A[elastic], trials[elastic])
    assert (norm(law, A) - before.clamp(max=RADIUS)).abs().max() < 1e-12
    J = torch.linalg.det(trials)
    assert ((torch.linalg.det(A) - J) / J).abs().max() < 1e-12
    assert (mapped(law, A, 0.0) - A).abs().max() < 1e-12


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("viscosity", [1e-3, 0.1, 1e3])
def test_relaxed_norm(law, viscosity, trials):
    """|s| = |s_trial| - y/(1 + viscosity/(2 mu' dt)), mu' = mu sum(S^2)/3 or mu; the mean strain or J stays."""
    before, A = norm(law, trials), mapped(law, trials, viscosity)
    modulus = MU * (trials**2).sum((1, 2)) / 3 if law == "herschel_bulkley_hencky" else MU
    y = (before - RADIUS).clamp_min(0)
    expected = before - y / (1 + viscosity / (2 * modulus * DT))
    assert ((norm(law, A) - expected) / before.clamp_min(1)).abs().max() < 1e-12
    J = torch.linalg.det(trials)
    assert ((torch.linalg.det(A) - J) / J).abs().max() < 1e-12
    # coaxial: the same polar rotation, and stretches that commute
    C, D = trials.mT @ trials, A.mT @ A
    assert ((C @ D - D @ C) / torch.linalg.matrix_norm(C)[:, None, None] ** 2).abs().max() < 1e-12


def test_stretches_are_those_of_the_papers_cubic(trials):
    """b_bar_i = d_i + beta, beta the largest real root of the cubic, S_i = J^(1/3) sqrt(b_bar_i)."""
    viscosity = 5e-3
    A = mapped("herschel_bulkley", trials, viscosity)
    fraction = 1 - (1 - RADIUS / norm("herschel_bulkley", trials)).clamp_min(0) / (
        1 + viscosity / (2 * MU * DT)
    )
    yielded = 0
    for F, found, c in zip(trials, A, fraction):
        J, S = float(torch.linalg.det(F)), torch.linalg.svdvals(F).numpy()
        b = J ** (-2 / 3) * S**2
        d = float(c) * (b - b.mean())
        roots = np.roots([1.0, 0.0, d[0] * d[1] + d[0] * d[2] + d[1] * d[2], d.prod() - 1.0])
        beta = max(root.real for root in roots if abs(root.imag) < 1e-9)
        expected = J ** (1 / 3) * np.sqrt(d + beta)
        np.testing.assert_allclose(
            torch.linalg.svdvals(found).numpy(), expected, rtol=1e-9
        )  # np.roots near double roots
        yielded += float(c) < 1
    assert yielded > 20


def test_inverted_particles_are_survived_or_named(drawn):
    """The Hencky variant maps them; the paper's has no value there and leaves them for the error that names the particle."""
    names, F = drawn
    F = F[[i for i, name in enumerate(names) if name.startswith("inverted")]]
    assert torch.equal(mapped("herschel_bulkley", F, 0.0), F)
    A = mapped("herschel_bulkley_hencky", F, 0.0)
    assert bool(torch.isfinite(A).all()) and bool(
        (torch.linalg.det(A) > 0).all()
    )  # the clamp at 0.05 turns them back


@pytest.mark.parametrize("law", LAWS)
def test_a_small_norm_eps_moves_the_result_by_as_little(law, trials):
    A, B = mapped(law, trials, 1e-3), mapped(law, trials, 1e-3, norm_eps=1e-8)
    assert 0 < float((A - B).abs().max()) < 1e-6
