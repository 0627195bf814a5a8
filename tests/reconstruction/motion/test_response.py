"""What a motion seen about a prediction keeps of it: the algebra, the number that is measured, and real images of a block."""

from __future__ import annotations

import pytest
import torch

from mosa.errors import ConfigError
from mosa.reconstruction.motion.dynamic import Target
from mosa.reconstruction.motion.informed import informed_motion
from mosa.reconstruction.motion.modes import Modes
from mosa.reconstruction.motion.moved import SecondLook
from mosa.reconstruction.motion.response import (
    BENT,
    Response,
    image_matrices,
    measured,
    response_of,
    responses,
)
from mosa.reconstruction.settings import DynamicSettings, InformedSettings
from tests.reconstruction.motion.test_informed import EVERY, OFFSETS, away, bent, scaffold  # noqa: F401

K, N, T = 5, 40, 4


@pytest.fixture(scope="module")
def known():
    """(matrices (T - 1, D, D), energies (K,), modes) of which the last two patterns of motion are hardly seen."""
    generator = torch.Generator().manual_seed(2)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    roots = drawn(T - 1, 3 * K, 3 * K - 2)
    energies = torch.tensor([0.0, 0, 0.5, 2, 8]).double()
    values, _ = torch.linalg.qr(drawn(N, K))
    return 1e3 * roots @ roots.mT, energies, Modes(values * N**0.5, drawn(N, 3, K), energies)


def test_what_stays_is_the_share_of_what_holds_in_all_there_is(known):
    """(H + a Q) U = a Q; what no image tells stays whole, and frame 0 is known."""
    H, energies, _ = known
    share, unit = responses(H, energies)
    Q = torch.diag((1 + BENT * energies).repeat_interleave(3))
    for a in (1e-3 * unit, unit):
        U = share(a)
        assert not U[0].any()
        assert torch.allclose(
            (H + a * Q) @ U[1:], (a * Q).expand_as(H), rtol=1e-9, atol=1e-9 * unit
        )
    blind = torch.linalg.eigh(H).eigenvectors[..., :2]  # seen by no camera
    assert torch.allclose(share(unit)[1:] @ blind, blind, atol=1e-6)


def test_the_number_is_found_from_how_far_what_was_seen_moved_along(known):
    H, energies, _ = known
    share, unit = responses(H, energies)
    generator = torch.Generator().manual_seed(0)
    moved = torch.randn(T - 1, 3 * K, generator=generator, dtype=torch.float64)
    for over in (0.01, 0.1):
        followed = torch.einsum("tij,tj->ti", share(over * unit)[1:], moved)
        found, left = measured(share, unit, moved, followed)
        assert found == pytest.approx(over * unit, rel=0.1) and left < 1e-2
    # what has nothing to do with it is not explained
    noise = torch.randn(T - 1, 3 * K, generator=generator, dtype=torch.float64)
    assert measured(share, unit, moved, noise)[1] > 0.9


def test_a_motion_is_compared_as_it_would_have_been_found(known):
    """The bias of what was found cancels: seen(truth) is what was found, whatever the prediction."""
    H, energies, modes = known
    generator = torch.Generator().manual_seed(1)
    rest = torch.randn(N, 3, generator=generator, dtype=torch.float64)
    share, unit = responses(H, energies)
    U = share(0.1 * unit)

    def moved(c):
        """Positions and deformation gradients under coefficients (T, K, 3)."""
        return rest + torch.einsum("nk,tkd->tnd", modes.values, c), torch.eye(
            3
        ).double() + torch.einsum("tki,njk->tnij", c, modes.gradient)

    truth, predicted = (
        0.1 * torch.randn(T, K, 3, generator=generator, dtype=torch.float64) for _ in range(2)
    )
    found = truth + torch.einsum("tij,tj->ti", U, (predicted - truth).flatten(1)).unflatten(
        1, (K, 3)
    )
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0, 0.3, 0], [-0.3, 0, 0.2], [0, -0.2, 0]]).double()
    )
    response = Response(moved(predicted)[0], U, modes.values, modes.gradient)
    x, F = moved(truth)
    as_found, gradient = response.seen(x, F @ turn, turn)
    assert torch.allclose(as_found, moved(found)[0], atol=1e-12) and torch.allclose(
        gradient, moved(found)[1] @ turn, atol=1e-12
    )
    for t in range(T):  # of the observer, frame by frame and of several worlds at once
        assert torch.allclose(x[t] - response.unseen(x[t], t), as_found[t], atol=1e-12)
    worlds = torch.stack([x[1], moved(predicted)[0][1]])
    assert torch.allclose(response.unseen(worlds, 1)[0], x[1] - as_found[1], atol=1e-12)
    assert response.unseen(worlds, 1)[1].abs().max() < 1e-12  # a prediction is found where it is


def test_of_a_body_that_is_filmed(bent):  # noqa: F811
    """Two wrong predictions of a block that bends. What was found about one, compared with the truth as that would have been found,
    is less than half as far off as from the truth itself; and a wrong motion is not excused."""
    windows, body, true = bent
    still = body.splats.means + OFFSETS[:, None]
    found, half = [], still + 0.5 * (true - still)
    for share in (0.5, 0.8):
        motion, about = informed_motion(
            Target(body, body, windows, OFFSETS, torch.ones(3), 0.1), still + share * (true - still), half,
            InformedSettings(iterations=40, lr=0.01), DynamicSettings(carriers="particles"), seed=0)  # fmt: skip
        with torch.no_grad():
            found.append((motion(EVERY, body.splats, body.modes, body.around).positions, about))
    H = image_matrices(
        Target(body, body, windows, OFFSETS, torch.ones(3), 0.1), found[0][0], views=6
    )
    assert H.shape == (2, 72, 72) and torch.allclose(H, H.mT, atol=1e-5 * float(H.max()))
    assert float(torch.linalg.eigvalsh(H).min()) > -1e-5 * float(H.max())
    response, _, left = response_of(
        body.modes, H, found[0][1], found[0][0], found[1][1], found[1][0], 1
    )
    flat = torch.eye(3).expand(*true.shape, 3)
    seen = response.seen(true, flat, torch.eye(3))[0]
    assert left < 0.2 and away(found[0][0], seen) < 0.4 * away(found[0][0], true)
    straight = response.seen(still, flat, torch.eye(3))[0]
    assert away(found[0][0], straight) > 3 * away(found[0][0], seen)


def test_the_response_of_another_sequence_is_refused(known):
    class Body:
        scene = type("", (), {"training_frames": list(range(T))})
        reconstruction = type(
            "", (), {"moving": type("", (), {"scaffold": type("", (), {"modes": known[2]})})}
        )

    H, energies, modes = known
    good = Response(
        torch.zeros(T, N, 3).double(), responses(H, energies)[0](1.0), modes.values, modes.gradient
    )
    again = SecondLook.response(Body, good.written())
    assert torch.equal(again.share, good.share) and torch.equal(again.values, good.values)
    assert SecondLook.response(Body, None) is None
    with pytest.raises(ConfigError, match=r"mosa\.responses.*another sequence"):
        SecondLook.response(Body, good.written() | {"about": torch.zeros(T + 1, N, 3)})


def test_a_part_of_large_pictures_tells_what_all_of_them_do(bent, monkeypatch):  # noqa: F811
    windows, body, true = bent
    whole = image_matrices(Target(body, body, windows, OFFSETS, torch.ones(3), 0.1), true, views=6)
    monkeypatch.setattr(
        "mosa.reconstruction.motion.response.VALUES", windows.images[0].numel() // 5
    )
    part = image_matrices(Target(body, body, windows, OFFSETS, torch.ones(3), 0.1), true, views=6)
    assert not torch.equal(part, whole) and float((part - whole).norm() / whole.norm()) < 0.2
