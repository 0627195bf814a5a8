"""Rigid solids and the ground in a twin's pictures and files."""

import math

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from mosa.errors import ConfigError
from mosa.evaluation.analysis import comparison
from mosa.evaluation.analysis.comparison import ground_shadow, outline
from mosa.physics.contact.colliders import Box, Capsule, Cylinder, Sphere, colliders_from_config
from mosa.physics.contact.mesh import field_of_triangles
from mosa.rendering.appearance.carried_splats import Seen
from mosa.rendering.appearance.spherical_harmonics import constant_coefficients
from mosa.rendering.cameras import look_at
from mosa.twin.shown_solids import SOLID, surface, with_solids
from mosa.twin.twin import viewed_from
from mosa.types import Cameras
from mosa.viewer.clips import read_run
from tests.modules.body.test_world import PLATE, twin

UP = torch.tensor([0.0, 1.0, 0.0])


def outside(shape, q):
    """(K,) [m] signed distance of points (K, 3) from a solid."""
    if isinstance(shape, Box):
        d = q.abs() - 0.5 * torch.tensor(shape.size)
        return d.clamp_min(0).norm(dim=1) + d.amax(1).clamp_max(0)
    if isinstance(shape, Cylinder):
        d = torch.stack(
            [q[:, :2].norm(dim=1) - shape.radius, q[:, 2].abs() - 0.5 * shape.length], 1
        )
        return d.clamp_min(0).norm(dim=1) + d.amax(1).clamp_max(0)
    half = 0.5 * getattr(shape, "length", 0.0)
    return (q - torch.stack([0 * q[:, 2], 0 * q[:, 2], q[:, 2].clamp(-half, half)], 1)).norm(
        dim=1
    ) - shape.radius


@pytest.mark.parametrize("shape, area", [
    (Box((0.2, 0.1, 0.3)), 2 * (0.02 + 0.03 + 0.06)), (Sphere(0.1), 4 * math.pi * 0.01),
    (Capsule(0.05, 0.2), 4 * math.pi * 0.0025 + 2 * math.pi * 0.05 * 0.2),
    (Cylinder(0.05, 0.2), 2 * math.pi * 0.0025 + 2 * math.pi * 0.05 * 0.2),
])  # fmt: skip
def test_points_lie_on_the_solid_and_leave_no_hole(shape, area):
    pitch = 0.01
    points = surface(shape, pitch)
    assert outside(shape, points).abs().max() < 1e-6
    # points drawn around it and moved onto the surface: none is farther than a pitch from the nearest one
    drawn = 0.4 * torch.rand(60000, 3, generator=torch.Generator().manual_seed(0)) - 0.2
    near = drawn[outside(shape, drawn).abs() < 1e-3]
    assert len(near) > 50 and torch.cdist(near, points).amin(1).max() < pitch
    assert 0.8 < len(points) * pitch**2 / area < 1.6


def test_a_mesh_is_drawn_on_its_surface():
    """A box as triangles: its points lie on the box, and leave no hole wider than the lattice."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = ConvexHull(corners)
    inwards = (np.cross(*(corners[faces.simplices[:, i]] - corners[faces.simplices[:, 0]]
                          for i in (1, 2))) * faces.equations[:, :3]).sum(1) < 0  # fmt: skip
    faces.simplices[inwards] = faces.simplices[inwards][:, ::-1]
    size = np.array([0.2, 0.1, 0.3])
    mesh = field_of_triangles(0.5 * size * corners, faces.simplices)
    points = surface(mesh, 0.01)
    box = Box(tuple(size))
    assert outside(box, points).abs().max() < 0.5 * mesh.spacing
    assert torch.cdist(surface(box, 0.01), points).amin(1).max() < 1.5 * mesh.spacing


def picture(shown, frame):
    K = torch.tensor([[120.0, 0, 32], [0, 120.0, 32], [0, 0, 1]])
    camera = Cameras(
        K[None], look_at(torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3), UP)[None], 64, 64, ("view",)
    )
    return shown.images(camera, torch.ones(3))[0, frame]


def test_a_solid_hides_what_is_behind_it_and_moves():
    """A red blob at the origin, a plate in front of it that moves away to the right by 0.2 m a second."""
    blob = Seen(torch.zeros(2, 1, 3), (0.02**2 * torch.eye(3)).expand(2, 1, 3, 3), torch.tensor([0.99]),
                constant_coefficients(torch.tensor([[1.0, 0.0, 0.0]])))  # fmt: skip
    plate = {
        "type": "box",
        "size": [0.2, 0.2, 0.02],
        "position": [0, 0, 0.2],
        "motion": {"velocity": [0.2, 0, 0]},
    }
    behind = {**plate, "position": [0, 0, -0.2]}
    times, red = torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])
    shown = with_solids(blob, colliders_from_config([plate]), times, UP, 0.01)
    grey = torch.tensor(SOLID) / 255
    assert (picture(shown, 0)[32, 32] - grey).abs().max() < 0.2 and (
        picture(shown, 1)[32, 32] - red
    ).abs().max() < 0.1
    assert (picture(shown, 1)[32, 55] - grey).abs().max() < 0.2 and (
        picture(shown, 0)[32, 8] == 1
    ).all()
    before = with_solids(blob, colliders_from_config([behind]), times, UP, 0.01)
    assert (picture(before, 0)[32, 32] - red).abs().max() < 0.1
    assert with_solids(blob, (), times, UP, 0.01) is blob


def test_an_exported_motion_has_its_solids_and_the_ground(tmp_path):
    one = twin()
    rollout, alone = one.simulate(frames=4, colliders=[PLATE]), one.simulate(frames=4)
    with pytest.raises(
        ConfigError,
        match=r"colliders and driven: expected the 1 that the rollout was simulated with, .* found 0",
    ):
        one.export(rollout, tmp_path / "no")
    with pytest.raises(
        ConfigError, match=r"expected the 0 that the rollout was simulated with.*found 1"
    ):
        one.export(alone, tmp_path / "no", colliders=[PLATE])
    assert not (tmp_path / "no").exists()
    one.export(rollout, tmp_path / "met", video=False, colliders=[PLATE])
    assert np.load(tmp_path / "met" / "rollout.npz")["simulation/collider_position"].shape == (
        4,
        1,
        3,
    )
    with pytest.raises(ConfigError, match="view: expected a direction that is not up or down"):
        one.render(alone, size=96, view=(0, 2, 0))
    # grey lines on the ground, of which a picture in space has none
    images = one.render(alone, size=96)
    lines = ((images - 120 / 255).abs().amax(-1) < 0.3) & (images.amax(-1) - images.amin(-1) < 0.02)
    assert lines[0].float().mean() > 0.01


def test_the_states_of_steps_are_shown_as_the_rollout_is(tmp_path):
    """With a plate that moves on its own, and where actions have moved it."""
    one, plate = twin(), {**PLATE, "name": "plate"}
    rollout = one.simulate(frames=4, colliders=[plate])
    states = [one.reset(colliders=[plate], frames=4), *(one.step().state for _ in range(3))]
    assert torch.equal(one.render(states, size=64), one.render(rollout, size=64, colliders=[plate]))
    moved = [one.reset(colliders=[plate], control_dt=0.01)]
    moved += [one.step({"plate": {"velocity": (0, 0, 0.5)}}).state for _ in range(3)]
    one.export(moved, tmp_path, video=False)
    saved = np.load(tmp_path / "rollout.npz")
    at = saved["simulation/collider_position"][:, 0] - np.array([0, 0.36, 0])
    assert at == pytest.approx(np.array([[0, 0, 0.005 * k] for k in range(4)]), abs=1e-9)
    assert saved["simulation/times"] == pytest.approx([0, 0.01, 0.02, 0.03])
    assert np.array_equal(saved["simulation/x"][-1], moved[-1].positions)
    (clip,) = read_run(tmp_path)
    assert len(clip.times) == 4 and clip.solids == (Box((0.6, 0.1, 0.6)),)
    with pytest.raises(ConfigError, match="expected the 1 that"):
        one.export(moved, tmp_path, colliders=[])
    worlds = one.worlds(2)
    both = [
        worlds.reset([{}, {"position": (0.02, None, 0)}], colliders=[plate]),
        worlds.step().state,
    ]
    with pytest.raises(
        ConfigError, match=r"^rollout: .* \(of worlds: each.world\(0\)\), found \[Twin"
    ):
        one.export(both, tmp_path)
    with pytest.raises(
        ConfigError, match=r"the 1 that `worlds\(...\).reset` was given, found none"
    ):
        one.export([each.world(1) for each in both], tmp_path, video=False)
    one.export([each.world(1) for each in both], tmp_path, video=False, colliders=[plate])
    saved = np.load(tmp_path / "rollout.npz")
    assert np.array_equal(saved["simulation/x"][1], both[1].positions[1])
    assert saved["simulation/collider_position"][1, 0] == pytest.approx(
        both[1].collider_position[1, 0]
    )
    for state, number in ((both[0], 2), (both[0], -1), (moved[0], 0)):
        with pytest.raises(ConfigError, match=rf"^world: expected one of x .*, found {number}"):
            state.world(number)
    for wrong in (moved[::-1], [moved[0], moved[0]], [], [moved[0], rollout]):
        with pytest.raises(ConfigError, match=r"^rollout: expected a Rollout, or a list of the"):
            one.render(wrong)


def test_a_shadow_lies_below_the_body_and_sharpens_as_it_lands():
    """Seen from above: a ball of 1 m whose shadow is where it is, and wider while it is high."""
    K = torch.tensor([[100.0, 0, 32], [0, 100.0, 32], [0, 0, 1]])
    w2c = look_at(torch.tensor([0.0, 10.0, 0.01]), torch.zeros(3), UP)
    camera = Cameras(K[None], w2c[None], 64, 64, ("view",))
    ball = surface(Sphere(0.5), 0.05) + torch.tensor([1.0, 0.5, 0.0])
    low, high = (ground_shadow(ball + h * UP, twin().world, camera, 1.0) for h in (0.0, 1.0))
    for shade in (low, high):
        assert 0 <= shade.min() and shade.max() <= 1
        at = (shade * np.arange(64)).sum() / shade.sum()
        assert at == pytest.approx(42, abs=1.0)  # px: 1 m at 10 m
    area = np.pi * 5**2
    assert low.max() > 0.9 and area < (low > 0.5).sum() < 1.6 * area
    assert (high > 0.02).sum() > 1.2 * (low > 0.02).sum()
    corners = torch.cartesian_prod(*3 * [torch.tensor([-2.0, 2.0])]) + 2 * UP
    filled = ground_shadow(corners, twin().world, camera, 1.0, convex=True)
    assert filled[16:48, 16:48].min() > 0.9
    buried = ground_shadow(ball - 2 * UP, twin().world, camera, 1.0)
    assert buried.shape == (64, 64) and not buried.any()


def test_shadow_and_outline_of_a_body_wider_than_a_picture_take_no_longer(monkeypatch):
    """Discs that close gaps grow with the body on the picture: at zoom=500 they had 10,000 px and took hours."""
    disc, radii = comparison._disc, []

    def noted(radius):
        radii.append(radius)
        return disc(radius)

    monkeypatch.setattr(comparison, "_disc", noted)
    w2c = look_at(torch.tensor([0.0, 10.0, 0.01]), torch.zeros(3), UP)[None]
    ball = surface(Sphere(0.5), 0.02)

    def seen(focal: float, side: int, *rest):
        K = torch.tensor([[[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]]])
        camera = Cameras(K, w2c, side, side, ("view",))
        return outline(ball, camera, 1.0), ground_shadow(ball + 0.5 * UP, twin().world, camera, 1.0)

    coarse, fine = seen(4000.0, 600), seen(12000.0, 1800)  # px: 400 and 1200 of the ball
    for one, other in zip(coarse, fine):
        assert one.shape == (600, 600) and other.shape == (1800, 1800)
        there = cv2.resize(other, (600, 600), interpolation=cv2.INTER_AREA)
        assert one.max() > 0.9 and np.abs(there - one).mean() < 0.01
    assert all(part.shape == (64, 64) for part in seen(1e6, 64))
    assert max(radii) < 30


def test_a_solid_that_holds_the_camera_is_not_drawn_and_is_named():
    one, view = twin(), (0, 0.3, 1)
    wall = {"type": "box", "size": [3, 3, 3], "position": [0, -5, 0]}
    rollout, alone = (one.simulate(frames=2, height=0.1, colliders=c) for c in ([wall], []))
    around = {**wall, "position": [0, 0, 1.8]}
    with pytest.warns(UserWarning, match=r"^colliders\[0\]: the camera is inside of it: not drawn"):
        held = one.render(rollout, size=48, colliders=[around], view=view)
    assert torch.equal(held, one.render(alone, size=48, view=view))


def test_a_shadow_darkens_the_floor_and_not_the_body():
    """Cream, as near to the white floor as a shadow once took for it, that falls onto the ground."""
    one, cream = twin(), torch.tensor([254.0, 237.0, 229.0]) / 255
    one.body.colors.copy_(cream.expand_as(one.body.colors))
    rollout = one.simulate(frames=10, height=0.1)
    shaded, plain = one.render(rollout, size=96), one.render(rollout, size=96, shadow=False)
    body = (plain - cream).abs().amax(-1) < 2e-3  # opaque to 2 %, as blue is 0.1 off white
    assert 0.1 < body.float().mean() < 0.9
    assert (shaded - plain)[body].abs().max() < 0.01
    assert (plain - shaded)[~body].max() > 0.15


def test_a_film_has_two_sides_and_shows_the_whole_of_a_long_fall():
    one = twin()
    one.body.colors.copy_(torch.tensor([0.8, 0.0, 0.0]).expand_as(one.body.colors))
    rollout = one.simulate(frames=28, height=1.5, velocity=(0, 0, 0), box=[[-9] * 3, [9] * 3])
    for size in ((96, 64), [64, 96], 64):
        images = one.render(rollout, size=size, shadow=False)
        width, height = (size, size) if size == 64 else size
        assert images.shape == (28, height, width, 3)
        red = images[..., 0] - images[..., 1] > 0.3
        rows = red.any(2).nonzero()[:, 1]
        assert red.flatten(1).any(1).all() and 0 < rows.min() and rows.max() < height - 1
        assert rows.max() - rows.min() > 0.6 * min(width, height)


def test_zoom_shows_so_much_less():
    one = twin()
    rollout = one.simulate(frames=2, height=0.1)
    one.body.colors.copy_(torch.tensor([1.0, 0.0, 0.0]))
    far, near = (one.render(rollout, size=64, zoom=zoom, shadow=False) for zoom in (0.5, 1.0))
    whole, part = ((each[..., 0] - each[..., 1] > 0.3)[0].sum() for each in (near, far))
    assert 3 < whole / part < 5
    for wrong in (0, [], [1, -2], "a", [[1, 2]], None, 500, [1, 20.5]):
        with pytest.raises(
            ConfigError, match=r"^zoom: expected a number above 0 and at most 20, or a list of such"
        ):
            one.render(rollout, zoom=wrong)


def test_a_camera_comes_near_a_body_that_has_fallen():
    """By even ratios, and looks at the body then, which is low in the picture of its whole way."""
    one = twin()
    rollout = one.simulate(frames=20, height=0.8, velocity=(0, 0, 0), box=[[-9] * 3, [9] * 3])
    one.body.colors.copy_(torch.tensor([1.0, 0.0, 0.0]))
    far, near = (one.render(rollout, size=96, zoom=z, shadow=False) for z in (1.0, [1, 2, 4]))
    places = []
    for t, times in ((0, 1), (19, 4)):
        (whole, seen) = (each[t, ..., 0] - each[t, ..., 1] > 0.3 for each in (far, near))
        assert (seen.sum() / whole.sum()).sqrt() == pytest.approx(times, rel=0.15)
        places += [float(each.nonzero()[:, 0].double().mean()) - 47.5 for each in (whole, seen)]
    assert places[2] > 12 and abs(places[3]) < 0.4 * places[2] and places[0] == places[1] < -12
    assert (
        one.render(rollout, size=48, zoom=[3])[5] == one.render(rollout, size=48, zoom=3)[5]
    ).all()


def test_a_camera_goes_along_its_views():
    one = twin()
    one.body.colors.copy_(torch.linspace(0, 1, one.body.rest.numel()).view(-1, 3))
    rollout = one.simulate(frames=4, height=0.1)
    views = [[1.0, 0.3, 0.0], [0.2, 0.6, 1.0], [-1.0, -0.5, 0.1], [-1.0, 0.3, -0.8]]
    images = one.render(rollout, size=(48, 32), view=views, shadow=False)
    for t, view in enumerate(views):
        fixed = one.render(rollout, size=(48, 32), view=view, shadow=False)
        assert torch.allclose(images[t], fixed[t], atol=1e-5)
    # 100 degrees to the left and 100 to the right: by the shorter way, through behind
    angle = math.radians(100)
    ends = [[math.cos(angle), 0.0, math.sin(angle)], [math.cos(angle), 1.0, -math.sin(angle)]]
    toward = viewed_from(ends, UP, 3)
    rise = math.radians(22.5)
    assert toward[1].tolist() == pytest.approx([-math.cos(rise), math.sin(rise), 0], abs=1e-6)
    for wrong in ([], [[1, 0]], [[[1, 0, 0]]], "abc", [[1, 0, 0], [0, 1, 0]], [0, 0, 0]):
        with pytest.raises(ConfigError, match=r"^view: expected a direction"):
            one.render(rollout, size=32, view=wrong)


def test_what_cannot_be_exported_is_said_before_anything_is_written(tmp_path, monkeypatch):
    one, folder = twin(), tmp_path / "no"
    rollout = one.simulate(frames=2)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match="sog needs the program splat-transform"):
        one.export(rollout, folder, video=False, formats=("ply", "sog"))
    with pytest.raises(ConfigError, match=r"^view: expected a direction that is not up or down"):
        one.export(rollout, folder, view=(0, 2, 0))
    assert not folder.exists()
