"""The anisotropic stiffness with an energy: positive for all numbers, nothing at zero, never isotropic, and what moduli it has."""

import copy
import math

import pytest
import substep_reference as reference
import torch
import warp as wp
from energies import ENERGIES
from small_bodies import FRAME_DT, FREE, STICKY, WORLD, small_body, start

from mosa.errors import ConfigError
from mosa.evaluation.analysis.stiffness import directional_moduli
from mosa.modules.adapters.hyperelastic import (
    NUMBERS,
    HyperelasticAdapter,
    anisotropic_basis,
    root_stiffness,
)
from mosa.modules.adapters.microplane import isotropic_stiffness
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN
from mosa.physics.adapters.interface import MaterialState
from mosa.physics.constitutive.laws import SLOTS, law_named
from mosa.physics.constitutive.material_kernels import field_types, stress_kernel

SCALE = torch.tensor([1, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64)


def adapter_of(numbers, nu=0.3, modulus=1.0) -> HyperelasticAdapter:
    adapter = HyperelasticAdapter().double()
    adapter.switch_on(modulus, nu)
    with torch.no_grad():
        adapter.numbers.copy_(torch.as_tensor(numbers))
    return adapter


def drawn(count, seed=0):
    """(count, 19) numbers of sizes from 0.01 to 3: their exponentials span up to 11 orders of magnitude."""
    generator = torch.Generator().manual_seed(seed)
    size = 10 ** (-2 + 2.477 * torch.rand(count, 1, generator=generator, dtype=torch.float64))
    return size * torch.randn(count, NUMBERS, generator=generator, dtype=torch.float64)


def extreme():
    """+-15 of each number alone, and +-2 of all at once."""
    alone = 15 * torch.eye(NUMBERS).double()
    together = 2 * torch.sign(
        torch.randn(30, NUMBERS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    return torch.cat([alone, -alone, together])


def mandel_rotation(Q):
    """(6, 6) with mandel(Q A Q^T) = M mandel(A)."""
    units = reference.unvech(torch.eye(6).double() / SCALE)
    return torch.stack([reference.vech((Q @ u @ Q.T)[None])[0] * SCALE for u in units], -1)


def rotation(seed):
    Q = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    ).Q
    return Q * torch.linalg.det(Q)


@torch.no_grad()
def test_stiffness_is_positive_for_all_numbers_and_keeps_its_determinant():
    """det(C0 + S) = det C0 exp(tr A) = det C0 = (1 + nu)/(1 - 2 nu): A is orthogonal to the unit matrix."""
    numbers = torch.cat([drawn(10_000), extreme()])
    adapters = {nu: adapter_of(numbers[0], nu) for nu in (0.2, 0.3, 0.4, 0.48)}
    found, poisson = [], []
    for i, row in enumerate(numbers):
        nu = (0.2, 0.3, 0.4, 0.48)[i % 4]
        adapters[nu].numbers.copy_(row)
        found.append(adapters[nu].stiffness())
        poisson.append(nu)
    found, nu = torch.stack(found), torch.tensor(poisson, dtype=torch.float64)
    assert torch.allclose(found, found.mT, rtol=0, atol=1e-9 * float(found.abs().max()))
    values = torch.linalg.eigvalsh(found)
    condition = values[:, -1] / values[:, 0]
    assert (values[:, 0] > 0).all() and condition.max() > 1e9
    # the smallest value is rounded by eps times the condition; torch's exponential is off by 2e-11 where it takes twelve terms
    expected = torch.log((1 + nu) / (1 - 2 * nu))
    assert ((values.log().sum(1) - expected).abs() < 1e-10 + 20 * 2.2e-16 * condition).all()


@torch.no_grad()
def test_stiffness_stays_positive_where_the_prior_moved_after_the_stage_began():
    """C0 is that of the law in use. The control: S of the Poisson number at the start, on a law of another one."""
    stale = 0
    for row in drawn(300, seed=4):
        adapter = adapter_of(row, 0.45)
        held = adapter.correction()
        for nu in (0.2, 0.35, 0.48):
            live = torch.tensor(nu, dtype=torch.float64)
            adapter.follow(live)
            C0 = isotropic_stiffness(live)
            values = torch.linalg.eigvalsh(adapter.stiffness())
            assert values[0] > 0
            assert torch.allclose(
                adapter.stiffness(),
                C0 + adapter.correction(),
                rtol=1e-12,
                atol=1e-12 * float(values[-1]),
            )
            stale += int(torch.linalg.eigvalsh(C0 + held)[0] < -1e-9)
    assert stale > 100


@torch.no_grad()
def test_the_numbers_leave_the_isotropic_part_to_the_prior():
    """log(C0^-1/2 (C0 + S) C0^-1/2) has no isotropic part, whatever the numbers are, to what torch.matrix_exp is exact to: 1e-11 of
    matrices of size 0.01, more than of any others, and not the same on all processors."""
    nu = torch.tensor(0.3, dtype=torch.float64)
    inner = torch.linalg.inv(root_stiffness(nu))
    assert torch.allclose(
        root_stiffness(nu) @ root_stiffness(nu), isotropic_stiffness(nu), rtol=0, atol=1e-15
    )
    one = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    for row in drawn(50, seed=2).clamp(-0.5, 0.5):
        M = inner @ adapter_of(row).stiffness() @ inner
        values, V = torch.linalg.eigh(0.5 * (M + M.T))
        A = V @ torch.diag(values.log()) @ V.T
        assert abs(float(A.trace())) < 1e-10 and abs(float(one @ A @ one)) < 1e-10


@pytest.mark.parametrize("nu", [0.2, 0.3, 0.4, 0.48])
def test_zero_numbers_are_exactly_no_correction(nu):
    assert (adapter_of(torch.zeros(NUMBERS), nu).correction() == 0).all()
    assert (adapter_of(torch.zeros(NUMBERS), nu).relative() == 0).all()


def test_the_basis_is_the_same_on_every_processor():
    """A checkpoint holds coordinates in it. What a decomposition gives among matrices of one singular value is left to the
    processor's library; written out, squares of the entries are these fractions, and the order and the signs are kept."""
    basis = anisotropic_basis(torch.float64, torch.device("cpu"))
    fractions = torch.tensor(
        [0, 1, 1 / 2, 1 / 4, 1 / 6, 2 / 3, 1 / 12, 1 / 3, 2 / 15, 1 / 30], dtype=torch.float64
    )
    assert ((basis.square()[..., None] - fractions).abs().amin(-1) < 1e-15).all()
    kept = {0: {(0, 0): 0.5**0.5, (1, 1): -(0.5**0.5)}, 3: {(3, 3): (1 / 6) ** 0.5, (5, 5): -((2 / 3) ** 0.5)},
            4: {(1, 2): 0.5, (0, 2): -0.5}, 6: {(0, 0): (2 / 15) ** 0.5, (3, 3): -((2 / 15) ** 0.5), (0, 1): -((1 / 30) ** 0.5)},
            7: {(0, 3): 0.5**0.5}, 18: {(4, 5): 0.5**0.5}}  # fmt: skip
    for number, entries in kept.items():
        for place, value in entries.items():
            assert abs(float(basis[number][place]) - value) < 1e-15, (number, place)


def test_nothing_but_zero_is_isotropic():
    """The change under three rotations is of full rank on the 19 matrices, of rank 19 on all 21 symmetric ones."""
    basis = anisotropic_basis(torch.float64, torch.device("cpu"))
    gram = torch.einsum("aij,bij->ab", basis, basis)
    assert torch.allclose(gram, torch.eye(NUMBERS).double(), rtol=0, atol=1e-14)
    assert torch.allclose(basis, basis.mT, rtol=0, atol=1e-15)

    def change(matrices):
        parts = [
            torch.stack([M @ B @ M.T - B for B in matrices]).flatten(1)
            for M in map(mandel_rotation, map(rotation, range(3)))
        ]
        return torch.linalg.svdvals(torch.cat(parts, 1))

    assert change(basis)[-1] > 0.1
    one = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    control = change(torch.cat([basis, torch.eye(6).double()[None], torch.outer(one, one)[None]]))
    assert control[NUMBERS - 1] > 0.1 and control[NUMBERS] < 1e-14


def stress(F, mu, lam, S):
    """tau (N, 3, 3) of corotated with the stiffness S (6, 6), by the kernel that the simulator runs."""
    law, n = law_named("corotated"), len(F)
    mat33, vec6, mat66, vecp = field_types(wp.float64)
    kernel = stress_kernel(law.stress, law.uses_rotation, wp.float64, True, True, 0)
    parameters = F.new_zeros(n, SLOTS)
    parameters[:, 0], parameters[:, 1] = mu, lam
    tensors = [
        F,
        torch.zeros_like(F),
        parameters,
        S.expand(n, 6, 6),
        F.new_zeros(n, 6),
        torch.empty_like(F),
    ]
    arrays = [
        wp.from_torch(t.contiguous(), dtype=k)
        for t, k in zip(tensors, (mat33, mat33, vecp, mat66, vec6, mat33))
    ]
    wp.launch(kernel, n, inputs=[*arrays, None], device="cpu")
    return wp.to_torch(arrays[-1])


@torch.no_grad()
def test_moduli_of_the_stiffness_are_those_of_a_uniaxial_test():
    """A bar along n is pulled by 1e-6: Newton's method on the strain until nothing but the axial stress is left."""
    young, nu = 2.0, 0.35
    mu, lam = young / (2 * (1 + nu)), young * nu / ((1 + nu) * (1 - 2 * nu))
    adapter = adapter_of(0.4 * torch.randn(NUMBERS, generator=torch.Generator().manual_seed(3)), nu)
    S = adapter.correction()
    n = torch.nn.functional.normalize(
        torch.randn(20, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    )
    N = n[:, :, None] * n[:, None, :]
    axis = reference.vech(N) * SCALE

    def response(e):
        return (
            reference.vech(stress(torch.eye(3).double() + reference.unvech(e / SCALE), mu, lam, S))
            * SCALE
        )

    h = 1e-5
    units = h * torch.eye(6).double()
    tangent = ((response(units) - response(-units)) / (2 * h)).T
    pulled, e = 1e-6, 1e-6 * axis
    axial = torch.zeros(len(n), dtype=torch.float64)
    for _ in range(
        8
    ):  # unknown: strain and axial stress; wanted: stress = axial n n, n n : e = pulled
        compliance = torch.linalg.inv(tangent)
        left = response(e)
        free = e - left @ compliance.T
        axial = (pulled - (free * axis).sum(1)) / ((axis @ compliance.T) * axis).sum(1)
        e = free + axial[:, None] * (axis @ compliance.T)
    left = response(e) - axial[:, None] * axis
    assert left.abs().max() < 1e-6 * axial.abs().max()  # a bar: no stress from the sides
    expected = directional_moduli(2 * mu * adapter.stiffness(), n)
    # second order of the strain: 1e-6 times a number of size one
    assert torch.allclose(axial / pulled, expected, rtol=2e-5)
    assert expected.max() / expected.min() > 1.5
    plain = directional_moduli(2 * mu * isotropic_stiffness(torch.tensor(nu).double()), n)
    assert torch.allclose(plain, torch.full_like(plain, young), rtol=1e-7)


@torch.no_grad()
@pytest.mark.parametrize("precision", [32, 64])
def test_a_body_with_zero_numbers_moves_as_the_prior_does_bit_for_bit(precision):
    body = small_body(precision=precision)
    begins = start(turn=0.4, dtype=torch.float64 if precision == 64 else torch.float32)
    prior, adapted = (
        body.simulate(begins, WORLD, 8, FRAME_DT, model=body.model().only(adapter=on))
        for on in (False, True)
    )
    assert torch.equal(prior.x, adapted.x) and torch.equal(prior.F, adapted.F)
    body.adapter.numbers.fill_(0.1)
    moved = body.simulate(begins, WORLD, 8, FRAME_DT)
    assert (moved.x - prior.x).abs().max() > 1e-4


def test_gradients_of_a_rollout_in_numbers_and_poisson_number():
    """Through a bounce on sticky ground, at a held number of substeps, along one direction each."""
    numbers = 0.2 * torch.randn(
        NUMBERS, generator=torch.Generator().manual_seed(8), dtype=torch.float64
    )
    body = small_body(numbers=numbers)
    begins = start(height=0.05, speed=-1.0, turn=0.5, spin=(3.0, 0.0, 5.0))
    probe = torch.randn(
        len(body.rest), 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64
    )
    raw = body.material.raw["nu"]

    def value():
        rollout = body.simulate(begins, STICKY, 6, FRAME_DT, substeps=16)
        return (probe * rollout.x[-1]).sum() + rollout.F[-1].square().sum()

    slopes = torch.autograd.grad(value(), [body.adapter.numbers, raw])
    along = torch.randn(NUMBERS, generator=torch.Generator().manual_seed(10), dtype=torch.float64)
    for tensor, slope, direction in (
        (body.adapter.numbers, slopes[0], along),
        (raw, slopes[1], torch.ones(()).double()),
    ):

        def at(t, tensor=tensor, direction=direction):
            with torch.no_grad():
                tensor.add_(t * direction)
                found = float(value())
                tensor.sub_(t * direction)
            return found

        h = 1e-4
        difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        assert abs(difference) > 1e-3
        assert float((slope * direction).sum()) == pytest.approx(difference, rel=1e-6)


@torch.no_grad()
def test_the_time_step_follows_the_poisson_number_that_is_asked_for():
    """Not the one that a rollout before has followed."""
    adapter = adapter_of(0.6 * torch.ones(NUMBERS), 0.3)
    first = [adapter.stiffening(nu) for nu in (0.2, 0.3, 0.45)]
    adapter.follow(torch.tensor(0.45))
    assert [adapter.stiffening(nu) for nu in (0.2, 0.3, 0.45)] == first
    assert min(first) > ADAPTER_MARGIN and len(set(first)) == 3
    # exact along an axis: the acoustic modulus n m : (C0 + S) : n m is at least that of n = m = x, over lam + 2 mu
    adapter = adapter_of(0.6 * torch.ones(NUMBERS), 0.3)
    ratio = (
        adapter.stiffness()[:3, :3].diagonal()
        / isotropic_stiffness(torch.tensor(0.3).double())[0, 0]
    )
    assert adapter.stiffening(0.3) >= 0.995 * float(ratio.max())
    assert HyperelasticAdapter().stiffening(0.3) == ADAPTER_MARGIN


def free_energy(body, rollout):
    """Kinetic and stored energy [J] (T,) of a rollout; the affine velocities' is not counted."""
    law, p = body.material.law, {k: v.detach() for k, v in body.material.per_particle().items()}
    F = rollout.F.reshape(-1, 3, 3)
    share = body.adapter.share().detach()
    added = body.adapter.correction().detach() + (1 - share) * isotropic_stiffness(
        body.material.poisson().double()
    )
    stored = share * ENERGIES[law](F, p["mu"], p["lam"])
    stored = stored + reference.stiffness_energy(F, p["mu"], added.expand(len(F), 6, 6))
    kinetic = 0.5 * body.density * rollout.v.square().sum(-1)
    return ((kinetic + stored.reshape(kinetic.shape)) * body.volume).sum(1)


@torch.no_grad()
@pytest.mark.parametrize("size", [0.3, 1.0])
def test_a_free_block_never_gains_energy(size):
    """Spinning without gravity or contact: the sum of kinetic and stored energy. Numbers are up to ten times what a fit expects."""
    generator = torch.Generator().manual_seed(12)
    for _ in range(4):
        signs = torch.sign(torch.randn(NUMBERS, generator=generator, dtype=torch.float64))
        body = small_body(numbers=size * signs, nu=0.4)
        body.adapter.follow(body.material.poisson())
        rollout = body.simulate(start(spin=(8.0, 3.0, -5.0), speed=0.0), FREE, 41, FRAME_DT)
        energy = free_energy(body, rollout)
        # the affine velocities, which are not counted, hold some of the kinetic energy at the start and give it back
        assert float(energy.max() / energy[0]) < 1.05
    assert math.isfinite(float(energy[-1]))


@pytest.mark.parametrize("nu", [0.2, 0.35, 0.48])
def test_what_is_added_to_the_share_of_the_prior_is_positive(nu):
    """beta C0 + added = C0 + S, and added >= -0.03 beta C0: fibres in a softer matrix. 1000 drawn sizes up to 1.5."""
    generator = torch.Generator().manual_seed(5)
    C0 = isotropic_stiffness(torch.tensor(nu, dtype=torch.float64))
    inverse = torch.linalg.inv(torch.linalg.cholesky(C0))
    state = MaterialState(
        torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 6, dtype=torch.float64)
    )
    lowest = []
    for size in torch.linspace(0, 1.5, 1000):
        adapter = adapter_of(
            float(size) * torch.randn(NUMBERS, generator=generator) / NUMBERS**0.5, nu
        )
        answer = adapter(state)
        beta = 1 + float(answer.h[0, 0].detach())
        assert 0 < beta <= 1 and not bool(answer.h[0, 1:].any())
        assert torch.allclose(
            answer.G[0] + beta * C0, adapter.stiffness(), rtol=0, atol=1e-6 * float(C0.abs().max())
        )
        lowest.append(float(torch.linalg.eigvalsh(inverse @ answer.G[0] @ inverse.T).min()) / beta)
    assert min(lowest) > -math.expm1(math.log(6) / 60) - 1e-6
    # the control: with the whole prior kept, the soft directions are taken from it
    assert (
        float(torch.linalg.eigvalsh(inverse @ adapter.correction().detach() @ inverse.T).min())
        < -0.2
    )


def test_what_it_refuses_and_what_a_copy_holds():
    with pytest.raises(ConfigError, match="switch_on"):
        small_body(on=False).adapter(None)
    adapter = adapter_of(0.1 * torch.ones(NUMBERS), 0.3)
    adapter.follow(torch.tensor(0.4, requires_grad=True) * 1.0)
    copied, same = copy.deepcopy(adapter), adapter_of(0.1 * torch.ones(NUMBERS), 0.3)
    same.follow(torch.tensor(0.4))
    assert torch.equal(
        copied.stiffness(), same.stiffness()
    )  # the same law; the graph of the prior's number is no part of it
    assert (
        not copied.requires_grad_(False).stiffness().requires_grad
        and adapter.stiffness().requires_grad
    )
