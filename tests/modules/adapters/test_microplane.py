"""The 6x6 operator of four LU-parametrised matrices: layout, bounds, and the same result as the paper's steps."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from stepwise import stepwise_planes

from mosa.modules.adapters import microplane

MANDEL = torch.tensor(microplane.MANDEL, dtype=torch.float64)


def drawn(*shape: int, seed: int = 0, size: float = 0.1) -> torch.Tensor:
    return size * torch.randn(
        *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def by_hand(s: np.ndarray, planes: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The paper's eq. 5 and 7, one component after the other; planes, normal: I + C."""
    xx, yy, zz, yz, zx, xy = s
    t_x, t_y, t_z = planes[0] @ [xx, xy, zx], planes[1] @ [yy, yz, xy], planes[2] @ [zz, zx, yz]
    n = normal @ [t_x[0], t_y[0], t_z[0]]
    return np.array([*n, (t_y[1] + t_z[2]) / 2, (t_x[2] + t_z[1]) / 2, (t_x[1] + t_y[2]) / 2])


def test_twelve_numbers_fill_upper_then_lower_triangle_row_by_row():
    numbers = torch.arange(1.0, 13.0)
    L, U = microplane.lu_factors(numbers)
    assert U.tolist() == [[1, 2, 3], [0, 4, 5], [0, 0, 6]]
    assert L.tolist() == [[7, 0, 0], [8, 9, 0], [10, 11, 12]]
    eye = torch.eye(3)
    torch.testing.assert_close(
        microplane.correction(numbers), (eye + L) @ (eye + U) - eye, rtol=0, atol=0
    )


def test_no_numbers_are_no_correction_bit_for_bit():
    C = microplane.correction(torch.zeros(5, 4, 12))
    assert torch.equal(C, torch.zeros(5, 4, 3, 3))
    assert torch.equal(microplane.redistribution(C[:, :3], C[:, 3]), torch.zeros(5, 6, 6))


def test_assembled_operator_is_the_steps_written_out():
    C, s = drawn(7, 4, 3, 3, seed=1), drawn(7, 6, seed=2, size=1.0)
    A = torch.eye(6).double() + microplane.redistribution(C[:, :3], C[:, 3])
    expected = np.stack(
        [
            by_hand(s[i].numpy(), np.eye(3) + C[i, :3].numpy(), np.eye(3) + C[i, 3].numpy())
            for i in range(7)
        ]
    )
    np.testing.assert_allclose((A @ s[..., None])[..., 0].numpy(), expected, rtol=0, atol=1e-14)
    n, shears = stepwise_planes(s, C[:, :3])
    n = n + (C[:, 3] @ n[..., None])[..., 0]
    np.testing.assert_allclose(torch.cat([n, shears], 1).numpy(), expected, rtol=0, atol=1e-14)


def test_shears_do_not_feel_the_normal_matrix():
    planes = drawn(3, 3, 3, 3)
    normals = (drawn(3, 3, 3, seed=3), torch.zeros(3, 3, 3).double())
    with_, without = (microplane.redistribution(planes, normal) for normal in normals)
    assert torch.equal(with_[:, 3:], without[:, 3:])
    assert not torch.equal(with_[:, :3], without[:, :3])


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12),
    st.floats(1e-3, 0.9),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_factors_are_bounded_and_invertible_for_any_output_of_a_network(raw, alpha, dtype):
    """Check 9 of docs/verification.md."""
    numbers = alpha * torch.tanh(torch.tensor(raw, dtype=dtype))
    L, U = microplane.lu_factors(numbers)
    slack = 4 * torch.finfo(dtype).eps
    assert max(L.abs().max(), U.abs().max()) <= alpha * (1 + slack)
    eye = torch.eye(3, dtype=torch.float64)
    det = torch.linalg.det(eye + L.double()) * torch.linalg.det(eye + U.double())
    assert det >= (1 - alpha) ** 6 * (1 - 1e3 * slack) > 0
    product = torch.linalg.det(eye + microplane.correction(numbers).double())
    assert abs(product - det) <= 1e3 * slack  # entries up to 4


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.48])
def test_major_symmetry_makes_the_stiffness_symmetric_and_is_a_projection(poisson):
    nu = torch.tensor(poisson, dtype=torch.float64)
    G = microplane.redistribution(drawn(5, 3, 3, 3), drawn(5, 3, 3, seed=4))
    C0 = microplane.isotropic_stiffness(nu)

    def asymmetry(G: torch.Tensor) -> float:
        stiffness = (torch.eye(6).double() + MANDEL[:, None] * G / MANDEL) @ C0
        return float((stiffness - stiffness.mT).abs().max())

    projected = microplane.major_symmetric(G, nu)
    assert asymmetry(G) > 1e-2  # the paper's operator has no energy
    assert asymmetry(projected) < 1e-13 * float(C0.max())
    torch.testing.assert_close(
        microplane.major_symmetric(projected, nu), projected, rtol=0, atol=1e-13
    )
    A = MANDEL[:, None] * G / MANDEL
    expected = 0.5 * (A + C0 @ A.mT @ torch.linalg.inv(C0)) / MANDEL[:, None] * MANDEL
    torch.testing.assert_close(projected, expected, rtol=0, atol=1e-13)
    assert torch.equal(microplane.major_symmetric(torch.zeros(2, 6, 6), nu), torch.zeros(2, 6, 6))


def test_isotropic_stiffness_is_hooke_in_mandel_scaling():
    E, nu = 3.0, 0.25
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    C0 = 2 * mu * microplane.isotropic_stiffness(torch.tensor(nu, dtype=torch.float64))
    strain = drawn(3, 3, seed=5)
    strain = 0.5 * (strain + strain.mT)
    stress = 2 * mu * strain + lam * torch.trace(strain) * torch.eye(3).double()

    def mandel(A: torch.Tensor) -> torch.Tensor:
        return MANDEL * torch.stack([A[0, 0], A[1, 1], A[2, 2], A[1, 2], A[2, 0], A[0, 1]])

    torch.testing.assert_close(C0 @ mandel(strain), mandel(stress), rtol=1e-12, atol=1e-14)


def test_the_printed_factors_are_a_product_with_an_offset():
    """C = (L + e I)(U + e I): invertible, e^2 I of no numbers, entries of at most about 3 alpha^2."""
    e, eye = microplane.OFFSET, torch.eye(3, dtype=torch.float64)
    numbers = 0.1 * torch.tanh(drawn(50, 12, seed=3, size=3.0))
    L, U = microplane.lu_factors(numbers)
    C = microplane.printed_correction(numbers)
    torch.testing.assert_close(C, L @ U + e * (L + U) + e**2 * eye, rtol=0, atol=1e-15)
    assert float(C.abs().max()) <= 3 * 0.1**2 + 2 * e * 0.1 + e**2
    nothing = microplane.printed_correction(torch.zeros(12, dtype=torch.float64))
    torch.testing.assert_close(nothing, e**2 * eye, rtol=0, atol=1e-18)
    assert float(torch.linalg.det(nothing)) > 0
