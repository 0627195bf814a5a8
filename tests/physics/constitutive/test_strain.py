"""Stiffnesses with an energy: the stress is the energy's derivative, at equal stretches too, and a closed loop gains
nothing."""

import mpmath
import pytest
import substep_reference as reference
import torch
import warp as wp
from energies import ENERGIES
from mpmath import mpf

from mosa.errors import ConfigError
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.adapters.interface import MaterialState
from mosa.physics.constitutive.laws import SLOTS, law_named, register_law
from mosa.physics.constitutive.material_kernels import field_types, stress_kernel
from mosa.physics.engine.simulator import Simulator

LAW, MU, LAM, NU = "corotated", 2.0, 3.0, 0.3
KINDS = (0, 0, 3, 2, 1, 0)
"""Field types of F, C_affine, parameters, G, h, tau."""


def launch(F, parameters, G, energetic=True, seed=None):
    """tau (N, 3, 3) of the stress kernel, or gradients of sum(seed tau) in F, parameters and G. energetic: as `stress_kernel`."""
    law, kinds = law_named(LAW), field_types(wp.float64)
    kernel = stress_kernel(
        law.stress, law.uses_rotation, wp.float64, True, energetic, law.offsets["mu"]
    )
    tensors = [F, torch.zeros_like(F), parameters, G, F.new_zeros(len(F), 6), torch.empty_like(F)]
    arrays = [wp.from_torch(t.contiguous(), dtype=kinds[k]) for t, k in zip(tensors, KINDS)]
    if seed is None:
        wp.launch(kernel, len(F), inputs=[*arrays, None], device="cpu")
        return wp.to_torch(arrays[-1])
    adjoints = [torch.zeros_like(t) for t in tensors[:-1]] + [seed]
    seeds = [wp.from_torch(t.contiguous(), dtype=kinds[k]) for t, k in zip(adjoints, KINDS)]
    wp.launch(kernel, len(F), inputs=[*arrays, None], device="cpu", adjoint=True, adj_inputs=[*seeds, None])  # fmt: skip
    return adjoints[0], adjoints[2], adjoints[3]


def inputs(F, seed=1):
    """(parameters (N, SLOTS), S (N, 6, 6)) of as many particles, drawn: another mu, lam and S for each."""
    generator = torch.Generator().manual_seed(seed)
    parameters = torch.zeros(len(F), SLOTS, dtype=torch.float64)
    parameters[:, :2] = torch.tensor([MU, LAM]) * (
        0.5 + torch.rand(len(F), 2, generator=generator, dtype=torch.float64)
    )
    A = 0.3 * torch.randn(len(F), 6, 6, generator=generator, dtype=torch.float64)
    return parameters, A + A.mT


def drawn_gradients(count=200, size=0.3, seed=0):
    """F (N, 3, 3) with det F > 0.15 whose squared stretches are at least 1e-3 apart: the twin's eigenvectors need it."""
    generator = torch.Generator().manual_seed(seed)
    F = torch.eye(3).double() + size * torch.randn(
        count, 3, 3, generator=generator, dtype=torch.float64
    )
    gaps = torch.linalg.svdvals(F).square().diff(dim=1).abs().amin(1)
    return F[(torch.linalg.det(F) > 0.15) & (gaps > 1e-3)]


def turned(stretches, seed=3):
    """U diag(stretches) V^T with drawn rotations."""
    generator = torch.Generator().manual_seed(seed)
    U, V = (
        torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
        for _ in range(2)
    )
    F = U @ torch.diag(torch.tensor(stretches, dtype=torch.float64)) @ V.T
    return F * torch.sign(torch.linalg.det(F))


SPECIAL = {
    "identity": torch.eye(3).double(),
    "a b b": torch.diag(torch.tensor([1.2, 0.8, 0.8])).double(),
    "a a b, turned": turned([1.2, 1.2, 0.8]),
    "dilated, turned": turned([1.3, 1.3, 1.3]),
    "1e-12 apart": turned([1.0, 1.0 + 1e-12, 1.0 - 1e-12]),
    "1e-9 apart": turned([1.1 + 1e-9, 1.1, 0.9]),
    "1e-6 apart": turned([1.0 + 1e-6, 1.0, 1.0 - 2e-6]),
    "1e-3 apart": turned([1.001, 1.0, 0.999]),
    "within the series": turned([1.006, 1.0, 0.997]),
    "beyond the series": turned([1.012, 1.0, 0.998]),
    "two and one": turned([1.7, 0.6 + 1e-7, 0.6]),
    "nearly flat": turned([1.2, 0.7, 0.06]),
}


def exact_added_stress(F, mu, S):
    """(dpsi/dF) F^T of psi = mu E : S : E in 60 digits, differences with a step of 1e-20: no formula of the kernel is used."""
    with mpmath.workdps(60):
        F0, root = mpmath.matrix(F.tolist()), mpmath.sqrt(2)
        Sm = mpmath.matrix(S.tolist())

        def energy(F):
            C = F.T * F
            E = (C - mpmath.eye(3)) / 2
            vector = mpmath.matrix(
                [E[0, 0], E[1, 1], E[2, 2], root * E[1, 2], root * E[2, 0], root * E[0, 1]]
            )
            return mpf(mu) * (vector.T * Sm * vector)[0]

        P, h = mpmath.matrix(3, 3), mpf(10) ** -20
        for i in range(3):
            for j in range(3):
                step = mpmath.matrix(3, 3)
                step[i, j] = h
                P[i, j] = (energy(F0 + step) - energy(F0 - step)) / (2 * h)
        tau = P * F0.T
        return torch.tensor(
            [[float(tau[i, j]) for j in range(3)] for i in range(3)], dtype=torch.float64
        )


def test_stress_is_the_derivative_of_the_energy():
    F = drawn_gradients()
    parameters, S = inputs(F)
    p = {"mu": parameters[:, 0], "lam": parameters[:, 1]}
    expected = reference.stiffened_stress(LAW, F, p, S).detach()
    found = launch(F, parameters, S)
    assert len(F) > 100
    # eigenvectors of stretches 1e-3 apart carry 1e-16/1e-3 of rounding, divided by the gap once more in the derivative
    assert (found - expected).abs().max() < 1e-9 * expected.abs().max()


@pytest.mark.parametrize("name", SPECIAL)
def test_equal_and_nearly_equal_stretches_are_exact(name):
    F = SPECIAL[name][None]
    parameters, S = inputs(F)
    found = launch(F, parameters, S) - launch(F, parameters, torch.zeros_like(S))
    expected = exact_added_stress(F[0], float(parameters[0, 0]), S[0])
    # rounding of stretches and of products of six matrices, of numbers of size one
    assert (found[0] - expected).abs().max() < 2e-14
    assert (
        name in ("identity", "1e-12 apart", "1e-6 apart", "1e-3 apart")
        or expected.abs().max() > 1e-3
    )


def test_an_isotropic_dilation_in_closed_form():
    """F = a Q: E = (a^2 - 1)/2 I and tau = a^2 Q T Q^T with T = 2 mu S : E."""
    a, Q = 1.4, turned([1.0, 1.0, 1.0])
    F = (a * Q)[None]
    parameters, S = inputs(F)
    one = torch.tensor([[1.0, 1, 1, 0, 0, 0]], dtype=torch.float64)
    T = parameters[0, 0] * (a * a - 1) * (S @ one[..., None])[..., 0]
    plain = T / torch.tensor([1, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64)
    expected = a * a * Q @ reference.unvech(plain)[0] @ Q.T
    found = (launch(F, parameters, S) - launch(F, parameters, 0 * S))[0]
    assert (found - expected).abs().max() < 1e-14


def test_the_adjoint_is_that_of_differences():
    """F, mu, lam and S along drawn directions, for drawn F and those with equal stretches."""
    F = torch.cat([drawn_gradients(), torch.stack(list(SPECIAL.values()))])
    parameters, S = inputs(F)
    generator = torch.Generator().manual_seed(7)
    seed, dF, dS = (
        torch.randn(t.shape, generator=generator, dtype=torch.float64) for t in (F, F, S)
    )
    dp = torch.zeros_like(parameters)
    dp[:, :2] = torch.randn(len(F), 2, generator=generator, dtype=torch.float64)

    for direction in ((dF, 0, 0), (0, dp, 0), (0, 0, dS)):

        def at(t, d=direction):
            return (launch(F + t * d[0], parameters + t * d[1], S + t * d[2]) * seed).sum((1, 2))

        h = 2e-4
        difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        gradients = launch(F, parameters, S, seed=seed)
        slope = sum(
            (g * d).flatten(1).sum(1)
            for g, d in zip(gradients, direction)
            if isinstance(d, torch.Tensor)
        )
        # fourth order: h^4 times a fifth derivative that the smallest stretch s makes of size s^-6; rounding 1e-16/h
        smallest = torch.linalg.svdvals(F)[:, -1].clamp(max=1.0)
        allowed = 1e-10 + 50 * h**4 * smallest**-6
        assert ((slope - difference).abs() < allowed * (1 + difference.abs())).all()
        assert difference.abs().median() > 0.1


def test_objectivity(rotations):
    """tau(Q F) = Q tau(F) Q^T, and a material turned with its stiffness answers alike."""
    F = drawn_gradients()[: len(rotations)]
    Q = rotations[: len(F)]
    parameters, S = inputs(F)
    tau = launch(F, parameters, S)
    assert (launch(Q @ F, parameters, S) - Q @ tau @ Q.mT).abs().max() < 1e-12 * tau.abs().max()
    frame = mandel_rotation(Q)
    inward = launch(F @ Q.mT, parameters, frame @ S @ frame.mT)
    assert (inward - tau).abs().max() < 1e-12 * tau.abs().max()
    assert (launch(F @ Q.mT, parameters, S) - tau).abs().max() > 0.1 * tau.abs().max()


def mandel_rotation(Q):
    """(N, 6, 6) with mandel(Q A Q^T) = M mandel(A)."""
    scale = torch.tensor([1, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64)
    units = reference.unvech(torch.eye(6).double() / scale)
    turned_units = Q[:, None] @ units @ Q[:, None].mT
    return torch.stack([reference.vech(turned_units[:, k]) * scale for k in range(6)], -1)


def loop_work(energetic, G, size, points=400):
    """Largest |work of a closed loop of F| over the prior's peak energy in it, of 40 drawn loops of strains up to about `size`.

    F(t) = I + size (A cos t + B sin t)/norm. The sum over a whole period converges faster than any power of the step."""
    generator = torch.Generator().manual_seed(4)
    A, B = (torch.randn(40, 3, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    norm = torch.linalg.matrix_norm(torch.cat([A, B], -1), 2)[:, None, None]
    A, B = size * A / norm, size * B / norm
    t = 2 * torch.pi * torch.arange(points, dtype=torch.float64)[:, None, None, None] / points
    F = torch.eye(3).double() + A * torch.cos(t) + B * torch.sin(t)
    rate = (B * torch.cos(t) - A * torch.sin(t)) * 2 * torch.pi / points
    flat = F.reshape(-1, 3, 3)
    mu, lam = torch.tensor([1.0, 2 * NU / (1 - 2 * NU)], dtype=torch.float64)
    parameters = torch.zeros(len(flat), SLOTS, dtype=torch.float64)
    parameters[:, 0], parameters[:, 1] = mu, lam
    tau = launch(flat, parameters, G.expand(len(flat), 6, 6), energetic)
    P = (tau @ torch.linalg.inv(flat).mT).reshape(F.shape)
    peak = ENERGIES[LAW](F, mu, lam).amax(0)
    return float(((P * rate).sum((0, 2, 3)).abs() / peak).max())


@pytest.mark.parametrize("size", [0.02, 0.1, 0.3])
def test_a_closed_loop_of_strain_does_no_work(size):
    generator = torch.Generator().manual_seed(2)
    adapter = HyperelasticAdapter().double()
    adapter.switch_on(1.0, NU)
    with torch.no_grad():
        adapter.numbers.copy_(0.3 * torch.randn(19, generator=generator))
        S = adapter.correction()
    assert S.abs().max() > 0.2
    assert loop_work(True, S, size) < 1e-6


def test_a_linear_operator_on_the_prior_s_stress_gains_work():
    """The control: entries of 0.1 with major symmetry, at the same loops. It has an energy to first order in the strain only."""
    torch.manual_seed(0)
    adapter = StressAdapter(
        alpha=0.2, state_dependence="constant", major_symmetry=True, no_pre=True, no_post=True
    ).double()
    adapter.switch_on(1.0, NU)
    with torch.no_grad():
        adapter.operator.free.copy_(
            torch.where(torch.rand(4, 12) < 0.5, -1.0, 1.0) * torch.atanh(torch.tensor(0.5)) / 10
        )
        w = torch.zeros(1, 6).double()
        G = adapter(MaterialState(w, w)).G[0]
    works = [loop_work(False, G, size) for size in (0.02, 0.1, 0.3)]
    assert works[0] > 1e-4 and works[1] > 1e-3 and works[2] > 0.02, (
        works
    )  # 1e-6 is what a law with an energy is allowed


def simulator(law, **options):
    return Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=torch.float64, **options)


def test_laws_without_a_shear_modulus_are_refused():
    with pytest.raises(
        ConfigError, match="shear modulus mu, found 'newtonian'"
    ):  # whose mu is a viscosity
        simulator("newtonian", energetic=True)
    with pytest.raises(ConfigError, match=r"shear modulus mu, found .corotated\+newtonian."):
        simulator("corotated+newtonian", energetic=True)
    register_law("without shear", law_named(LAW).stress, ("kappa", "lam"), uses_rotation=True)
    with pytest.raises(ConfigError, match="shear modulus mu, found 'without shear'"):
        simulator("without shear", energetic=True)
    assert simulator(LAW, energetic=True).numerics.energetic
