"""Factorisations and their closed differentials, on states that include rest, equal and inverted singular values."""

import functools

import pytest
import torch
import warp as wp

from mosa.physics.constitutive.kinematics import (
    contract,
    hencky_material,
    hencky_spatial,
    rotation,
    rotation_of,
    svd,
)

FUNCTIONS = ["rotation", "stretch", "hencky_spatial", "hencky_material", "contract"]


@functools.cache
def kernel(name):
    @wp.func
    def value(F: wp.mat33d, c: wp.float64):
        A = F
        if wp.static(name == "rotation"):
            A = rotation(F, rotation_of(F))
        if wp.static(name == "stretch"):
            A = wp.transpose(rotation(F, rotation_of(F))) * F
        if wp.static(name in ("hencky_spatial", "hencky_material", "contract")):
            U, S, V = svd(F)
            if wp.static(name == "hencky_spatial"):
                A = hencky_spatial(F, U, S, V)
            if wp.static(name == "hencky_material"):
                A = hencky_material(F, U, S, V)
            if wp.static(name == "contract"):
                A = contract(F, U, S, V, c)
        return A

    @wp.kernel(module="unique")
    def apply(
        F: wp.array(dtype=wp.mat33d), c: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.mat33d)
    ):
        i = wp.tid()
        out[i] = value(F[i], c[i])

    return apply


def run(name, F, c):
    out = torch.zeros_like(F)
    wp.launch(kernel(name), len(F), inputs=[to_warp(F), to_warp(c), to_warp(out)], device="cpu")
    return out


def to_warp(t):
    return wp.from_torch(t.contiguous(), dtype=wp.mat33d if t.ndim == 3 else wp.float64)


def run_adjoint(name, F, c, seed):
    adj_F, adj_c = torch.zeros_like(F), torch.zeros_like(c)
    arrays = [to_warp(t) for t in (F, c, torch.zeros_like(F))]
    wp.launch(kernel(name), len(F), inputs=arrays, device="cpu", adjoint=True,
              adj_inputs=[to_warp(t) for t in (adj_F, adj_c, seed.clone())])  # fmt: skip
    return adj_F, adj_c


def directional(f, h):
    """Central difference of fourth order at step h (h may be a tensor, one step per state)."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


def test_svd_has_proper_frames_and_signed_values(drawn):
    _, F = drawn

    @wp.kernel(module="unique")
    def factors(
        F: wp.array(dtype=wp.mat33d), U: wp.array(dtype=wp.mat33d), S: wp.array(dtype=wp.vec3d), V: wp.array(dtype=wp.mat33d)
    ):  # fmt: skip
        i = wp.tid()
        u, s, v = svd(F[i])
        U[i] = u
        S[i] = s
        V[i] = v

    F = torch.cat(
        [F, torch.zeros(1, 3, 3).double(), torch.diag(torch.tensor([1.0, 0.0, 0.0])).double()[None]]
    )
    U, V, S = torch.zeros_like(F), torch.zeros_like(F), torch.zeros(len(F), 3).double()
    wp.launch(
        factors,
        len(F),
        inputs=[to_warp(F), to_warp(U), wp.from_torch(S, dtype=wp.vec3d), to_warp(V)],
        device="cpu",
    )
    eye = torch.eye(3).double().expand_as(F)
    torch.testing.assert_close(U @ torch.diag_embed(S) @ V.mT, F, rtol=0, atol=4e-15)
    torch.testing.assert_close(U.mT @ U, eye, rtol=0, atol=2e-15)
    torch.testing.assert_close(V.mT @ V, eye, rtol=0, atol=2e-15)
    torch.testing.assert_close(torch.linalg.det(U), torch.ones(len(F)).double(), rtol=0, atol=4e-15)
    torch.testing.assert_close(torch.linalg.det(V), torch.ones(len(F)).double(), rtol=0, atol=4e-15)
    torch.testing.assert_close(S.abs(), torch.linalg.svdvals(F), rtol=0, atol=4e-15)
    assert torch.equal(torch.sign(S[:-2, 2]), torch.sign(torch.linalg.det(F[:-2])))


def test_rotation_is_the_polar_one(drawn):
    names, F = drawn
    R = run("rotation", F, torch.ones(len(F)).double())
    torch.testing.assert_close(R.mT @ R, torch.eye(3).double().expand_as(F), rtol=0, atol=5e-15)
    W = R.mT @ F
    torch.testing.assert_close(W, W.mT, rtol=0, atol=1e-13)
    upright = torch.linalg.det(F) > 0
    assert bool((torch.linalg.eigvalsh(0.5 * (W + W.mT))[upright] > 0).all())
    assert names.count("inverted") == 6 and bool((~upright).any())


@pytest.mark.parametrize("stretches, within", [
    ([1, 1, 1e-2], 5e-15), ([1.2, 0.9, 1e-5], 5e-15), ([1.1, 0.9, 1e-17], 5e-15), ([1.2, 0.8, 0], 5e-15), ([1.1, 1, -1e-3], 5e-15),
    ([1.2, 0.8, -0.05], 5e-15), ([0.05, 0.05, 0.05], 5e-15), ([3, 0.3, 1e-3], 5e-15), ([9.7, 1, 1e-9], 5e-15),
    ([1, 0.5, -0.4], 5e-15), ([1, 1e-2, -1e-6], 1e-12), ([1, 1e-3, 1e-6], 1e-12), ([1, 1e-4, 1e-5], 1e-11), ([1, 1e-6, 1e-7], 1e-9),
    ([30, 1, -1e-3], 5e-14),
])  # fmt: skip
def test_rotation_of_a_body_that_lies_flat(stretches, within):
    """Newton's iteration goes through a det F of zero; the SVD does what it cannot."""
    generator = torch.Generator().manual_seed(2)
    U, V = (
        torch.linalg.qr(torch.randn(40, 3, 3, generator=generator).double())[0] for _ in range(2)
    )
    U, V = (Q * torch.linalg.det(Q)[:, None, None] for Q in (U, V))
    F = U @ torch.diag(torch.tensor(stretches).double()) @ V.mT
    torch.testing.assert_close(
        run("rotation", F, torch.ones(40).double()), U @ V.mT, rtol=0, atol=within
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradient_against_differences(name, drawn):
    _, F = drawn
    generator = torch.Generator().manual_seed(1)
    c = 0.2 + 0.7 * torch.rand(len(F), generator=generator, dtype=torch.float64)
    S = torch.linalg.svdvals(F)
    S[:, 2] *= torch.sign(torch.linalg.det(F))
    # a step well inside the distance to the singularity S_i + S_j = 0 and to the clamp at 0.05
    room = torch.minimum(S[:, 1] + S[:, 2], (S - 0.05).abs().amin(1)).clamp(max=1.0)
    h = (3e-3 * room)[:, None, None]
    for _ in range(9):
        seed = torch.randn(F.shape, generator=generator, dtype=torch.float64)
        dF = torch.randn(F.shape, generator=generator, dtype=torch.float64)
        dF = dF / torch.linalg.matrix_norm(dF)[:, None, None]
        adj_F, adj_c = run_adjoint(name, F, c, seed)
        assert bool(torch.isfinite(adj_F).all())
        expected = (seed * directional(lambda s, dF=dF: run(name, F + s * dF, c), h)).sum((1, 2))
        scale = torch.linalg.matrix_norm(adj_F).clamp_min(1.0)
        error = ((adj_F * dF).sum((1, 2)) - expected).abs() / scale
        assert error.max() < 1e-6, (name, int(error.argmax()), float(error.max()))
        if name == "contract":
            step = torch.full_like(c, 1e-3)[:, None, None]
            expected = (seed * directional(lambda s: run(name, F, c + s[:, 0, 0]), step)).sum(
                (1, 2)
            )
            torch.testing.assert_close(adj_c, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradient_is_finite_at_the_true_singularity(name):
    F = torch.diag_embed(
        torch.tensor(
            [[1.0, 0.5, -0.5], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, -1.0]]
        ).double()
    )
    adj_F, adj_c = run_adjoint(
        name, F, torch.full((4,), 0.5).double(), torch.ones(4, 3, 3).double()
    )
    assert bool(torch.isfinite(adj_F).all()) and bool(torch.isfinite(adj_c).all())
