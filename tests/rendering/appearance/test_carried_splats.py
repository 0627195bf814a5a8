"""What a body looks like: splats that its particles carry, in a light that stays, kept by a checkpoint."""

import copy
from dataclasses import fields, replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from strangers import N, checkpoint, cube, saved

from mosa.config.build import build_body
from mosa.config.record import RunRecord
from mosa.errors import DataError
from mosa.rendering.appearance.carried_splats import CarriedSplats, seen
from mosa.rendering.appearance.lighting import LIGHT, shading, surface_normals
from mosa.rendering.cameras import look_at
from mosa.rendering.observer import deformed_covariances, observe
from mosa.twin.twin import Twin
from mosa.types import Appearance, Cameras, Splats

BACKGROUND = torch.ones(3)
CENTER = torch.tensor([0.05, 0.35, 0.05])


def appearance(count: int = 40, degree: int = 1, light: bool = True, seed: int = 0) -> Appearance:
    """Of the cube of `strangers`."""
    g = torch.Generator().manual_seed(seed)
    rotations = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    means = CENTER + 0.14 * (torch.rand(count, 3, generator=g) - 0.5)
    harmonics = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    colors = (0.5 + 0.28209479 * harmonics[:, 0]).clamp(0, 1)
    splats = Splats(
        means,
        0.005 + 0.01 * torch.rand(count, 3, generator=g),
        rotations,
        torch.rand(count, generator=g),
        colors,
    )
    normals = torch.nn.functional.normalize(means - CENTER, dim=1)
    return (
        Appearance(splats, harmonics, normals, 0.3 * torch.randn(LIGHT, generator=g))
        if light
        else Appearance(splats, harmonics)
    )


def body_with(found: Appearance | None):
    body = build_body(RunRecord.read(saved()["mosa"]), cube())
    body.splats = None if found is None else CarriedSplats(found, body.rest)
    return body


def views(size: int = 40) -> Cameras:
    K = torch.tensor([[70.0, 0, size / 2], [0, 70, size / 2], [0, 0, 1]])
    eyes = torch.tensor([[0.3, 0.5, 0.2], [-0.2, 0.45, 0.25]])
    w2c = torch.stack([look_at(eye, CENTER, torch.tensor([0.0, 1, 0])) for eye in eyes])
    return Cameras(K.expand(2, 3, 3), w2c, size, size, ("a", "b"))


def test_without_splats_the_particles_are_seen():
    body = body_with(None)
    F = torch.eye(3).expand(2, N, 3, 3)
    x = torch.stack([body.rest, body.rest + 0.01])
    wanted = observe(
        x,
        deformed_covariances(F, body.covariances),
        body.opacities,
        body.colors,
        views(),
        BACKGROUND,
    ).images
    torch.testing.assert_close(
        seen(body, x, F).images(views(), BACKGROUND), wanted, rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_body_that_turns_with_its_cameras_and_light_looks_the_same(degree):
    body = body_with(appearance(degree=degree, light=False))
    Q = torch.as_tensor(Rotation.from_rotvec([0.4, 1.0, -0.7]).as_matrix()).float()
    moved = (body.rest @ Q.T)[None]
    motion = torch.eye(4)
    motion[:3, :3] = Q.T
    still = seen(body, body.rest[None], None).images(views(), BACKGROUND)
    turned = seen(body, moved, None).images(replace(views(), w2c=views().w2c @ motion), BACKGROUND)
    assert float((still - 1).abs().max()) > 0.2
    torch.testing.assert_close(turned, still, rtol=0, atol=2e-5)


def test_the_light_is_that_of_the_place_where_a_normal_points_to():
    """Turned by R, a splat is as bright as the light makes of its normal there, relative to where it was."""
    normals = torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    normals = normals / normals.norm(dim=1, keepdim=True)
    light = torch.zeros(LIGHT, dtype=torch.float64)
    light[1] = 0.5  # degree 1, along z: Y = 0.488603 z
    R = torch.as_tensor(Rotation.from_rotvec([0.5, 0, 0]).as_matrix()).expand(9, 3, 3)
    wanted = (0.5 * 0.4886025119029199 * ((R[0] @ normals.T).T - normals)[:, 2]).exp()
    torch.testing.assert_close(shading(light, normals, R), wanted)
    assert torch.equal(
        shading(light, normals, torch.eye(3).double().expand(9, 3, 3)), torch.ones(9).double()
    )


def test_normals_of_a_ball_point_outwards():
    axis = torch.linspace(-1, 1, 13)
    grid = torch.cartesian_prod(axis, axis, axis)
    ball = grid[grid.norm(dim=1) < 0.95]
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(3)), dim=1
    )
    cosine = (surface_normals(directions, ball) * directions).sum(1)
    assert float(cosine.min()) > 0.9
    assert torch.isfinite(surface_normals(grid[:1], grid[:1].expand(9, 3))).all()


def test_splats_are_no_part_of_the_state_and_follow_a_copy():
    body = body_with(appearance())
    assert not [name for name in body.state_dict() if "splats" in name]
    again = copy.deepcopy(body)
    torch.testing.assert_close(
        again.splats.carry(body.rest[None]).means[0], body.splats.means, rtol=0, atol=1e-6
    )


def with_splats(change=lambda stored: None):
    def changed(stored):
        stored["mosa"]["splats"] = CarriedSplats(appearance(), cube()["rest"]).written()
        change(stored["mosa"]["splats"])

    return changed


def test_a_checkpoint_gives_them_back(tmp_path):
    twin = Twin.load(checkpoint(tmp_path / "a.ckpt", change=with_splats()))
    wanted, found = appearance(), twin.body.splats.appearance
    for f in fields(Splats):
        assert torch.equal(getattr(found.splats, f.name), getattr(wanted.splats, f.name))
    assert torch.equal(found.harmonics, wanted.harmonics) and torch.equal(found.light, wanted.light)
    assert twin.render(twin.simulate(frames=2), size=32).shape == (2, 32, 32, 3)
    assert Twin.load(checkpoint(tmp_path / "older.ckpt")).body.splats is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("light"), r"mosa\.splats\.light: expected this key, found none"),
        (
            lambda s: s.update(means=s["means"][:0]),
            r"mosa\.splats\.means: expected 1 to \d+ splats",
        ),
        (
            lambda s: s.update(scales=s["scales"][:, :2].clone()),
            r"splats\.scales: expected finite numbers of shape \(40, 3\)",
        ),
        (
            lambda s: s.update(harmonics=s["harmonics"][:, :3].clone()),
            r"harmonics: expected .* \(40, 1, 3\) or \(40, 4, 3\)",
        ),
        (lambda s: s["opacities"].fill_(2.0), r"splats\.opacities: expected numbers from 0 to 1"),
        (lambda s: s["rotations"].zero_(), r"quaternions and normals that are not zero"),
        (lambda s: s["colors"].fill_(float("nan")), r"splats\.colors: expected finite numbers"),
        (lambda s: s.update(means="nothing"), r"mosa\.splats\.means: expected"),
    ],
)
def test_damaged_splats_are_named(tmp_path, change, message):
    with pytest.raises(DataError, match=message):
        Twin.load(checkpoint(tmp_path / "bad.ckpt", change=with_splats(change)))
