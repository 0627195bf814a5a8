"""Splats bound to particles: exact for affine motions, consistent with the interpolated map, harmonics that turn along."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from mosa.errors import DataError
from mosa.rendering.appearance.carrying import STRETCH_LIMIT, bind
from mosa.rendering.appearance.spherical_harmonics import basis, colors_in, rotated
from mosa.rendering.cameras import look_at
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import rasterize
from mosa.types import Cameras


def lattice(side: int = 7, spacing: float = 0.1) -> torch.Tensor:
    axis = torch.arange(side, dtype=torch.float64) * spacing
    return torch.cartesian_prod(axis, axis, axis)


def drawn_splats(count: int = 60, seed: int = 0) -> torch.Tensor:
    """Inside of the lattice and half a spacing outside of it."""
    return -0.05 + 0.7 * torch.rand(
        count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )


def a_rotation(seed: int = 0) -> torch.Tensor:
    return torch.as_tensor(Rotation.random(random_state=seed).as_matrix())


def twisted(X: torch.Tensor) -> torch.Tensor:
    """A smooth motion with bending, twist and stretch."""
    x, y, z = X.unbind(-1)
    angle = 1.5 * z
    return torch.stack(
        (
            x * angle.cos() - y * angle.sin(),
            x * angle.sin() + y * angle.cos() + 0.4 * x * z,
            1.2 * z + 0.3 * y * y,
        ),
        -1,
    )


def test_an_affine_motion_is_followed_exactly():
    P, X = lattice(), drawn_splats()
    A = torch.eye(3).double() + 0.3 * torch.randn(
        3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    shift = torch.tensor([0.3, -2.0, 1.0]).double()
    carried = bind(X, P).carry((P @ A.T + shift)[None])
    torch.testing.assert_close(carried.means[0], X @ A.T + shift, rtol=0, atol=1e-12)
    torch.testing.assert_close(carried.gradients[0], A.expand(len(X), 3, 3), rtol=0, atol=1e-11)


def test_gradients_are_those_of_the_interpolated_map():
    P, X, h = lattice(), drawn_splats(), 1e-6
    moved = twisted(P)[None]
    found = bind(X, P).carry(moved).gradients[0]
    columns = [
        (bind(X + h * axis, P).carry(moved).means[0] - bind(X - h * axis, P).carry(moved).means[0])
        / (2 * h)
        for axis in torch.eye(3).double()
    ]
    torch.testing.assert_close(found, torch.stack(columns, -1), rtol=0, atol=1e-7)


def test_a_smooth_motion_is_followed_to_second_order():
    """Half the spacing, a quarter of the error, for centres and for carried covariances."""
    X = 0.05 + 0.5 * torch.rand(
        80, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    S = 1e-4 * torch.eye(3).double().expand(len(X), 3, 3)
    true = torch.func.vmap(torch.func.jacrev(twisted))(X)
    errors = []
    for side, spacing in ((7, 0.1), (13, 0.05)):
        P = lattice(side, spacing)
        carried = bind(X, P).carry(twisted(P)[None])
        far = (carried.means[0] - twisted(X)).norm(dim=1).mean()
        off = (carried.covariances(S)[0] - true @ S @ true.mT).flatten(1).norm(dim=1).mean() / 1e-4
        errors.append((float(far), float(off)))
    assert errors[1][0] < 0.35 * errors[0][0] < 0.35 * 3e-3
    assert errors[1][1] < 0.6 * errors[0][1] < 0.6 * 0.08


def test_neighbours_in_a_plane_leave_nothing_undefined():
    P = lattice()[:49]
    carried = bind(drawn_splats(), P).carry((P @ a_rotation().T)[None])
    assert bool(carried.gradients.isfinite().all()) and bool(carried.means.isfinite().all())


def test_a_tearing_body_does_not_draw_its_splats_out():
    P = lattice()
    torn = P.clone()
    torn[P[:, 0] > 0.35] += torch.tensor([5.0, 0, 0]).double()
    X = drawn_splats()
    carried = bind(X, P).carry(torn[None])
    assert float(torch.linalg.svdvals(carried.gradients).max()) < STRETCH_LIMIT * (1 + 1e-9)
    # none is left in the gap
    away = carried.means[0] - X
    away = torch.minimum(away.norm(dim=1), (away - torch.tensor([5.0, 0, 0])).norm(dim=1))
    assert float(away.max()) < 0.01


@pytest.mark.parametrize("radius", [0.1, 0.15, 0.25])
def test_splats_below_a_slab_stay_outside_of_the_ball_that_it_drapes_over(radius):
    """A slab whose columns lie on a ball or far below, its splats half a spacing below the lowest particles: an affine fit over two
    spacings went up to 0.7 spacings deep."""
    spacing = 0.05
    sides = [torch.arange(n, dtype=torch.float64) * spacing for n in (21, 21, 4)]
    P = torch.cartesian_prod(*sides) - torch.tensor([0.5, 0.5, 0.0])
    side = torch.linspace(-0.45, 0.45, 91, dtype=torch.float64)
    X = torch.cartesian_prod(side, side, torch.tensor([-0.5 * spacing], dtype=torch.float64))
    high = radius + 0.5 * spacing  # of the lowest particles' centres, above the ball's
    lift = (high**2 - P[:, :2].square().sum(1)).sqrt().nan_to_num(-2 * high) - high
    draped = torch.cat([P[:, :2], (P[:, 2] + lift)[:, None]], 1)
    center = torch.tensor([0.0, 0.0, -high])
    assert float((draped - center).norm(dim=1).min()) == pytest.approx(high)
    carried = bind(X, P).carry(draped[None]).means[0]
    assert float((carried - center).norm(dim=1).min()) > radius


def test_few_particles_are_refused():
    with pytest.raises(DataError, match="at least 8 particles"):
        bind(drawn_splats(), lattice()[:7])


def test_gradients_reach_the_particles():
    P, X = lattice(4), drawn_splats(5)
    bound = bind(0.5 * X, P)
    moved = twisted(P)[None].requires_grad_(True)
    assert torch.autograd.gradcheck(
        lambda x: (bound.carry(x).means, bound.carry(x).gradients), (moved,), fast_mode=True
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_have_the_colour_of_the_direction_turned_back(degree):
    generator = torch.Generator().manual_seed(degree)
    R = torch.stack(
        [a_rotation(seed) for seed in range(6)]
        + [torch.eye(3).double(), torch.diag(torch.tensor([-1.0, -1, 1])).double()]
    )
    c = torch.randn(8, (degree + 1) ** 2, 3, dtype=torch.float64, generator=generator)
    d = torch.randn(40, 3, dtype=torch.float64, generator=generator)
    found = torch.einsum("dk,nkc->ndc", basis(d, degree), rotated(c, R))
    wanted = torch.einsum("ndk,nkc->ndc", basis(d @ R, degree), c)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-13)


def test_turning_harmonics_keeps_their_size_and_composes():
    c = torch.randn(5, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    A, B = a_rotation(1), a_rotation(2)
    torch.testing.assert_close(
        rotated(c, A).square().sum(1), c.square().sum(1), rtol=1e-12, atol=1e-12
    )
    torch.testing.assert_close(rotated(rotated(c, B), A), rotated(c, A @ B), rtol=0, atol=1e-12)


def test_a_rigid_motion_renders_as_the_moved_camera_sees_the_body_at_rest():
    P, X = lattice(), drawn_splats(80)
    generator = torch.Generator().manual_seed(5)
    scales = 0.01 + 0.04 * torch.rand(80, 3, dtype=torch.float64, generator=generator)
    covariances = covariance_from(
        scales, torch.randn(80, 4, dtype=torch.float64, generator=generator)
    )
    c = 0.3 * torch.randn(80, 16, 3, dtype=torch.float64, generator=generator)
    opacities = torch.rand(80, dtype=torch.float64, generator=generator)
    Q, shift = a_rotation(7), torch.tensor([0.2, 1.0, -0.4]).double()
    up = torch.tensor([0.0, 1, 0]).double()
    w2c = look_at(torch.tensor([1.5, 1, 1.2]).double(), torch.full((3,), 0.3).double(), up)[None]
    K = torch.tensor([[[60.0, 0, 24], [0, 60, 24], [0, 0, 1]]]).double()
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = Q, shift

    def seen(means, covariances, coefficients, w2c):
        eye = -(w2c[0, :3, :3].T @ w2c[0, :3, 3])
        camera = Cameras(K, w2c, 48, 48, ("a",))
        return rasterize(
            means[None],
            covariances[None],
            opacities,
            colors_in(coefficients, means - eye)[None],
            camera,
            torch.zeros(1).long(),
        )[0]

    carried = bind(X, P).carry((P @ Q.T + shift)[None])
    moved = seen(
        carried.means[0], carried.covariances(covariances)[0], rotated(c, carried.rotations[0]), w2c
    )
    still = seen(X, covariances, c, w2c @ motion)
    assert float(still.max()) > 0.3
    torch.testing.assert_close(moved, still, rtol=0, atol=1e-10)
    assert math.isfinite(float(moved.sum()))
