"""Chebyshev-filtered subspace iteration finds what a dense eigensolver finds."""

import numpy as np
import pytest
import torch

from mosa.reconstruction.motion import modes
from mosa.reconstruction.motion.cues import neighbourhood
from mosa.reconstruction.motion.softest import softest_vectors


@pytest.fixture(scope="module")
def body():
    """900 points of a bent slab, of unequal sides."""
    points = torch.rand(900, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [0.3, 0.2, 0.1]
    )
    points[:, 2] += 2 * points[:, 0] ** 2
    return points, neighbourhood(points)


def test_the_softest_vectors_are_those_of_a_dense_solver(body):
    points, around = body
    matrix = modes.bending_matrix(around)
    known = torch.linalg.qr(torch.cat([torch.ones(len(points), 1), points], 1).double())[0]
    values, vectors = softest_vectors(matrix, points, known, 30)
    wanted, true = np.linalg.eigh(matrix.toarray())
    # an error of e in a vector is one of e^2 in its eigenvalue; the residual bounds e by 1e-4 of the gap to what is suppressed
    assert values.numpy() == pytest.approx(wanted[4:34], rel=1e-6)
    assert torch.allclose(vectors.T @ vectors, torch.eye(30).double(), atol=1e-12)
    assert float((known.T @ vectors).abs().max()) < 1e-10
    # the 34 softest and the 35th lie apart, so that the span of the first is well defined
    span = torch.as_tensor(true[:, :34])
    assert wanted[34] / wanted[33] > 1.01
    assert float((vectors - span @ (span.T @ vectors)).norm(dim=0).max()) < 1e-3


def test_modes_of_large_bodies_are_those_of_small_ones(body, monkeypatch):
    points, around = body
    direct = modes.deformation_modes(points, around, count=24)
    monkeypatch.setattr(modes, "FILTERED_FROM", 100)
    monkeypatch.setattr(modes, "eigsh", lambda *a, **k: pytest.fail("factorised"))
    filtered = modes.deformation_modes(points, around, count=24)
    assert torch.allclose(filtered.energy, direct.energy, rtol=1e-5)
    # the same up to a turn within the span of all
    turn = filtered.values.T @ direct.values / len(points)
    assert torch.allclose(turn @ turn.T, torch.eye(24), atol=1e-4)
    assert torch.allclose(
        torch.einsum("nik,kl->nil", filtered.gradient, turn),
        direct.gradient,
        atol=1e-3 * float(direct.gradient.abs().max()),
    )


def test_more_vectors_than_there_is_room_for_are_refused(body):
    """Beside 596 vectors orthogonal to the four known ones, guards would be found among the known ones."""
    points, around = body[0][:600], neighbourhood(body[0][:600])
    known = torch.linalg.qr(torch.cat([torch.ones(600, 1), points], 1).double())[0]
    assert softest_vectors(modes.bending_matrix(around), points, known, 399) is None


def test_what_does_not_converge_is_factorised(body, monkeypatch):
    points, around = body
    direct = modes.deformation_modes(points, around, count=24)
    monkeypatch.setattr(modes, "FILTERED_FROM", 100)
    monkeypatch.setattr(modes, "softest_vectors", lambda *a: None)
    assert torch.equal(modes.deformation_modes(points, around, count=24).values, direct.values)
