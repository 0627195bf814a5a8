"""Loss terms: values by hand, gradients against central differences, what happens at rest."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from mosa.modules.fitting import losses

EYE = torch.eye(3, dtype=torch.float64)
TOLERANCE = {"eps": 1e-6, "rtol": 1e-6, "atol": 1e-7}


def rotations(count: int, seed: int) -> torch.Tensor:
    A = torch.randn(count, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.matrix_exp(1.5 * (A - A.mT))


def deformations(stretches, count: int = 4, seed: int = 0) -> torch.Tensor:
    """(count, 3, 3) with the given signed singular values and drawn axes."""
    return (
        rotations(count, seed)
        @ torch.diag(torch.tensor(stretches, dtype=torch.float64))
        @ rotations(count, seed + 1)
    )


def ordered(stretches) -> torch.Tensor:
    return torch.tensor(stretches, dtype=torch.float64)


def numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


# --- images ---------------------------------------------------------------------------------------------------------


def test_image_terms_by_hand():
    real = torch.full((2, 3, 4, 5, 3), 0.25)
    rendered = real.clone()
    rendered[0, ..., 0] += 0.3  # one of two views, one of three channels
    assert losses.image_loss(rendered, real).item() == pytest.approx(0.3 / 6)
    mattes = torch.zeros(2, 3, 4, 5)
    alpha = mattes.clone()
    alpha[1, 2] = -0.5
    assert losses.mask_loss(alpha, mattes).item() == pytest.approx(0.5 / 6)


def test_flow_does_not_grow_with_resolution():
    flow, seen = numbers(2, 3, 4, 4, 2), numbers(2, 3, 4, 4, 2, seed=1)
    small = losses.flow_loss(flow, seen, 160)
    fine = [x.repeat_interleave(2, 2).repeat_interleave(2, 3) * 2 for x in (flow, seen)]
    assert losses.flow_loss(*fine, 320).item() == pytest.approx(small.item(), rel=1e-12)
    assert small.item() == pytest.approx((flow - seen).abs().mean().item() / 160, rel=1e-12)


def test_weights_select_values():
    values, weight = numbers(2, 5), torch.zeros(2, 5).double()
    weight[1, 3] = 0.7
    assert losses.weighted_mean(values, weight).item() == pytest.approx(
        values[1, 3].item(), rel=1e-12
    )
    assert losses.weighted_mean(values, torch.zeros_like(weight)).item() == 0


def test_image_gradients():
    real, flow = numbers(1, 2, 3, 3, 3, seed=1), numbers(1, 2, 3, 3, 2, seed=1)
    rendered, simulated = (
        numbers(1, 2, 3, 3, 3).requires_grad_(),
        numbers(1, 2, 3, 3, 2).requires_grad_(),
    )
    assert gradcheck(lambda x: losses.image_loss(x, real), rendered, **TOLERANCE)
    assert gradcheck(lambda x: losses.mask_loss(x[..., 0], real[..., 0]), rendered, **TOLERANCE)
    assert gradcheck(lambda x: losses.flow_loss(x, flow, 2), simulated, **TOLERANCE)


# --- rotation -------------------------------------------------------------------------------------------------------

STRETCHES = [
    (1.0, 1.0, 1.0),
    (1.3, 1.0, 0.7),
    (1.2, 1.2, 0.6),
    (2.0, 0.5, 0.5),
    (1 + 1e-7, 1.0, 1 - 1e-7),
    (4.0, 0.5, 0.05),
    (0.3, 0.3, 0.3),
]


@pytest.mark.parametrize("stretches", STRETCHES)
def test_polar_rotation(stretches):
    U, V = rotations(50, 3), rotations(50, 4)
    F = U @ torch.diag(ordered(stretches)) @ V
    torch.testing.assert_close(losses.polar_rotation(F), U @ V, rtol=0, atol=1e-13)
    torch.testing.assert_close(losses.polar_rotation(F.float()).double(), U @ V, rtol=0, atol=2e-5)


@pytest.mark.parametrize("stretches", [(30.0, 1.0, 1e-3), (1.0, 1e-2, 1e-2), (1e3, 1e3, 1e3)])
def test_polar_rotation_of_extreme_stretches(stretches):
    U, V = rotations(50, 3), rotations(50, 4)
    torch.testing.assert_close(
        losses.polar_rotation(U @ torch.diag(ordered(stretches)) @ V), U @ V, rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("stretches", STRETCHES)
def test_rotation_gradient(stretches):
    Q = rotations(1, 9)[0]
    cue = rotations(8, 11).reshape(2, 4, 3, 3)
    F = torch.stack([EYE.expand(4, 3, 3), deformations(stretches)]).requires_grad_()
    weight = numbers(2, 4, seed=5)
    assert gradcheck(lambda F: losses.rotation_loss(F, cue, weight, Q), F, **TOLERANCE)


def test_rotation_gradient_exactly_at_rest():
    cue = rotations(2, 1).reshape(2, 1, 3, 3)
    F = EYE.expand(2, 1, 3, 3).clone().requires_grad_()
    assert gradcheck(
        lambda F: losses.rotation_loss(F, cue, torch.ones(2, 1).double(), EYE), F, **TOLERANCE
    )


def test_rotation_value_is_the_angle_apart_from_the_start():
    angle = 0.4
    spin = torch.matrix_exp(
        torch.tensor([[0, -angle, 0], [angle, 0, 0], [0, 0, 0]], dtype=torch.float64)
    )
    Q = rotations(1, 2)[0]
    W = torch.diag(ordered((1.3, 1.0, 0.8)))
    F = torch.stack([Q, Q @ W])[
        :, None
    ]  # the body stretches and does not turn; the cue says it turned by `angle`
    cue = torch.stack([EYE, spin])[:, None]
    loss = losses.rotation_loss(F, cue, torch.ones(2, 1).double(), Q)
    assert loss.item() == pytest.approx(4 * (1 - math.cos(angle)), rel=1e-12)
    aligned = torch.stack([Q, spin @ Q @ W])[:, None]
    assert losses.rotation_loss(aligned, cue, torch.ones(2, 1).double(), Q).item() < 1e-25
    assert (
        losses.rotation_loss(aligned, cue, torch.ones(2, 1).double(), EYE).item() > 0.1
    )  # the start matters


def test_first_frame_and_inverted_particles_have_no_weight():
    cue = rotations(6, 1).reshape(2, 3, 3, 3)
    F = torch.stack([rotations(3, 5), deformations((1.2, 1.0, 0.9), 3)])
    F[1, 0] = torch.diag(ordered((1.0, 1.0, -0.5)))
    F[1, 1] = 0
    F.requires_grad_()
    weight = torch.ones(2, 3).double()
    loss = losses.rotation_loss(F, cue, weight, EYE)
    alone = losses.rotation_loss(F[:, 2:], cue[:, 2:], weight[:, 2:], EYE)
    assert loss.item() == pytest.approx(alone.item(), rel=1e-12)
    loss.backward()
    assert torch.isfinite(F.grad).all()
    assert (F.grad[0] == 0).all() and (F.grad[1, :2] == 0).all() and (F.grad[1, 2] != 0).any()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_broken_particle_is_not_hidden(value):
    F = EYE.expand(2, 3, 3, 3).clone()
    F[1, 1, 0, 0] = value
    weight = torch.ones(2, 3).double()
    assert not torch.isfinite(losses.rotation_loss(F, EYE.expand(2, 3, 3, 3), weight, EYE))
    assert not torch.isfinite(
        losses.stretch_loss(F, ordered((1.2, 1.0, 0.9)).expand(2, 3, 3), weight)
    )


# --- stretch --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stretches", [*STRETCHES, (1.2, 0.8, -0.3), (0.5, 0.5, -0.5)])
def test_stretches_are_sorted_and_signed(stretches):
    F = deformations(stretches, 30)
    torch.testing.assert_close(
        losses.stretches(F), ordered(stretches).expand(30, 3), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize(
    "stretches", [(1.3, 1.0, 0.7), (1.01, 1.005, 0.99), (3.0, 1.0, 0.1), (1.2, 0.8, -0.3)]
)
def test_stretch_gradient(stretches):
    F = deformations(stretches)
    cue = ordered((1.1, 1.02, 0.9)).expand(2, 4, 3)
    weight = numbers(2, 4, seed=5)
    both = torch.stack([deformations((1.1, 1.0, 0.9), seed=6), F]).requires_grad_()
    assert gradcheck(lambda F: losses.stretch_loss(F, cue, weight), both, **TOLERANCE)


@pytest.mark.parametrize("stretches", [(1.0, 1.0, 1.0), (1.3, 1.3, 0.7), (1.3, 0.7, 0.7)])
def test_gradient_of_a_smooth_function_where_stretches_coincide(stretches):
    """The sum of logarithms is log det F, smooth everywhere: its gradient has to be right where single stretches have none."""
    F = deformations(stretches).requires_grad_()
    assert gradcheck(lambda F: losses.stretches(F).log().sum(-1), F, **TOLERANCE)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_at_rest_does_not_depend_on_arbitrary_axes(dtype):
    """Rollouts start at F = Q: all stretches are equal, and what the gradient says about them has no direction."""
    F = torch.cat([EYE[None], rotations(20, 8)]).to(dtype).requires_grad_()
    losses.stretches(F)[:, 0].sum().backward()
    torch.testing.assert_close(F.grad, F.detach() / 3, rtol=0, atol=20 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_stretch_loss_at_rest_is_finite(dtype):
    F = torch.stack([rotations(50, 1)] * 2).to(dtype).requires_grad_()
    cue = ordered((1.1, 1.0, 0.9)).to(dtype).expand(2, 50, 3)
    loss = losses.stretch_loss(F, cue, torch.ones(2, 50, dtype=dtype))
    loss.backward()
    assert loss.item() == pytest.approx(
        1 / 3, rel=0.02
    )  # an unstrained body has no direction: |unit|^2/3 of the cue is left
    assert torch.isfinite(F.grad).all()


def test_stretch_loss_compares_directions():
    weight = torch.ones(2, 4).double()
    cue = ordered((1.10, 1.0, 0.95)).expand(2, 4, 3)

    def loss(stretches) -> float:
        return losses.stretch_loss(torch.stack([deformations(stretches)] * 2), cue, weight).item()

    assert loss((1.10, 1.0, 0.95)) < 1e-20
    assert loss((1.20, 1.0, 0.90)) < 1e-4  # twice the strain, the same direction
    opposite = loss((1.05, 1.0, 0.90))
    cosine = (0.10 * 0.05 + 0.05 * 0.10) / (0.10**2 + 0.05**2)
    assert opposite == pytest.approx(2 * (1 - cosine) / 3, rel=0.05)


def test_cues_without_strain_have_no_weight():
    F = torch.stack([deformations((1.3, 1.0, 0.7))] * 2)
    cue = ordered((1.1, 1.0, 0.9)).expand(2, 4, 3).clone()
    cue[1, 2] = 1 + ordered((9e-4, 0, -9e-4))
    kept = [0, 1, 3]
    full = losses.stretch_loss(F, cue, torch.ones(2, 4).double())
    part = losses.stretch_loss(F[:, kept], cue[:, kept], torch.ones(2, 3).double())
    assert full.item() == pytest.approx(part.item(), rel=1e-12)
    none = losses.stretch_loss(F, torch.ones(2, 4, 3).double(), torch.ones(2, 4).double())
    assert none.item() == 0


# --- heterogeneity, positions ---------------------------------------------------------------------------------------


def test_heterogeneity_by_hand():
    assert (
        losses.heterogeneity_loss(torch.tensor([0.4, -0.4])).item() == 0
    )  # mean 0, variance 0.16 < 0.25
    assert losses.heterogeneity_loss(torch.tensor([1.0, 3.0])).item() == pytest.approx(4 + 0.75)
    assert losses.heterogeneity_loss(
        torch.tensor([1.0, 3.0]), lambda_mu=0.5, lambda_var=2.0
    ).item() == pytest.approx(2 + 1.5)


def test_heterogeneity_and_position_gradients():
    eta = (3 * numbers(7)).requires_grad_()
    assert losses.heterogeneity_loss(eta).item() > eta.mean().item() ** 2  # the variance takes part
    assert gradcheck(losses.heterogeneity_loss, eta, **TOLERANCE)
    x, seen = numbers(3, 4, 3).requires_grad_(), numbers(3, 4, 3, seed=1)
    assert gradcheck(lambda x: losses.position_loss(x, seen, 0.25), x, **TOLERANCE)
    near = (seen + 1e-5 * x.detach()).requires_grad_()
    assert gradcheck(
        lambda x: losses.position_loss(x, seen, 0.25), near, eps=1e-8, rtol=1e-6, atol=1e-6
    )


def test_position_loss_by_hand():
    seen = numbers(3, 4, 3)
    x = seen + torch.tensor([0.0, 0.03, 0.04]).double()
    x[0] += 1.0  # frame 0 is the start and carries nothing
    assert losses.position_loss(x, seen, 0.5).item() == pytest.approx(0.1, rel=1e-4)
    assert losses.position_loss(x, seen, 1.0).item() == pytest.approx(0.05, rel=1e-4)
