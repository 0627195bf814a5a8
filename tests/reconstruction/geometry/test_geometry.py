"""The body that is filled: emptied where colours show air, whole where they say nothing, with its surface where it truly is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import squashed_body
import torch
from written_scenes import seen_by

from mosa.data.hull import Volume, visual_hull
from mosa.data.synthetic.bodies.parts import Shape, coat, ellipsoid
from mosa.data.synthetic.films import pictures_to_footage
from mosa.data.synthetic.renderer import render_surface, ring_of_cameras
from mosa.data.synthetic.surface import extract_surface
from mosa.errors import ConfigError, DataError
from mosa.reconstruction.geometry.body import FIRST, THEN, Geometry, find_geometry, surface_of
from mosa.reconstruction.geometry.carving import carve, keep_silhouettes
from mosa.reconstruction.geometry.field import first_crossing, sample, scatter, smooth
from mosa.reconstruction.geometry.refinement import refine, signed_distance, surface_information
from mosa.reconstruction.motion.observed import Windows, object_windows
from mosa.reconstruction.pose.flight import Motion, free_motions
from mosa.reconstruction.settings import GeometrySection
from mosa.types import Ground, Scene

SIZE, PITCH = 80, 0.006
HEIGHT = 0.2
"""Of the bowl above the ground [m]: all of its frames are free."""


def bowl_distance(points: np.ndarray) -> np.ndarray:
    """A bowl, 0.2 m wide and 0.115 m high, its hollow 0.075 m deep: no outline shows any of it."""
    outer = ellipsoid(points, (0.0, 0.075, 0.0), (0.105, 0.075, 0.1))
    hollow = ellipsoid(points, (0.01, 0.115, 0.0), (0.075, 0.075, 0.068))
    return np.maximum(np.maximum(outer, -hollow), points[:, 1] - 0.115)


def textured(points, rng):
    return np.clip(
        coat(
            points,
            rng,
            [(0.85, 0.7, 0.5), (0.3, 0.5, 0.7), (0.6, 0.25, 0.2)],
            patch=0.08,
            grain=0.026,
        ),
        0.02,
        1,
    )


def scene_of(color, frames: int = 2) -> Scene:
    """The bowl, filmed by 12 cameras as it falls at 2 m/s."""
    shape = Shape(bowl_distance, color, np.array([[-0.12, -0.01, -0.12], [0.12, 0.13, 0.12]]))
    surface = extract_surface(shape, 0.0035, np.random.default_rng(0))
    rig = ring_of_cameras(
        12,
        SIZE,
        target=(0, HEIGHT + 0.06, 0),
        distance=1.6,
        elevations=(0.16, 0.55, 0.95),
        field=0.16,
        turn=0.2,
    )
    times = 0.02 * np.arange(frames)
    pictures = [
        render_surface(
            surface, surface.vertices + np.array([0, HEIGHT - 2.0 * t - 4.9 * t * t, 0]), rig
        )
        for t in times
    ]
    images, mattes = pictures_to_footage(np.stack(pictures, 1), (SIZE, SIZE))
    up = torch.tensor([0.0, 1.0, 0.0])
    return Scene(
        "bowl", "train", images, mattes, rig, torch.tensor(times).float(), -9.8 * up, up, Ground(0.0),
        torch.tensor([[-0.3, 0.0, -0.3], [0.3, 0.5, 0.3]]), 1000.0, torch.ones(3), True,
    )  # fmt: skip


def found(scene: Scene, **settings) -> tuple[Volume, Geometry]:
    hull = visual_hull(scene.mattes[:, 0], scene.cameras, scene.box, pitch=PITCH)
    return hull, find_geometry(
        scene,
        hull,
        GeometrySection(**settings),
        ridge_passes=24,
        sigma=1.2,
        margin=6,
        device="cpu",
    )


def compared(body: Volume) -> tuple[float, float]:
    """Air in the body farther than a voxel from matter, and matter deeper than a voxel outside the body, over the true volume."""
    points = body.points().double().numpy().reshape(-1, 3) - [0, HEIGHT, 0]
    distance = torch.from_numpy(bowl_distance(points)).reshape(body.values.shape)
    inside, true = body.values > 0.5, float((distance < 0).sum())
    return float((inside & (distance > PITCH)).sum()) / true, float(
        (~inside & (distance < -PITCH)).sum()
    ) / true


@pytest.fixture(scope="module")
def bowl() -> Scene:
    return scene_of(textured)


def test_a_hollow_that_no_outline_shows_is_emptied_and_nothing_else(bowl):
    hull, geometry = found(bowl)
    air, lost = compared(replace(hull, values=(hull.values > 0.5).float()))
    assert air > 0.3 and lost == 0
    air, lost = compared(geometry.body)
    assert air < 0.02
    assert lost < 0.002
    figures = geometry.figures(spacing=0.01)
    assert figures["geometry/free_frames"] == 2
    assert figures["geometry/carved_share"] > 0.2
    assert figures["geometry/uncertain_share"] < 0.03


EVERY_SECOND = range(0, 12, 2)
"""Of the bowl's cameras."""


def test_equal_images_give_equal_bits(bowl, monkeypatch):
    monkeypatch.setattr("mosa.reconstruction.geometry.body.FIRST", ((1, 1.0),))
    monkeypatch.setattr("mosa.reconstruction.geometry.body.THEN", ((2, 0.6),))
    one, other = (found(seen_by(bowl, EVERY_SECOND))[1] for _ in range(2))
    assert torch.equal(one.body.values, other.body.values) and torch.equal(
        one.deviation, other.deviation
    )


@pytest.mark.parametrize("kind", ["white", "glossy"])
def test_where_colours_say_nothing_no_matter_is_carved(bowl, kind):
    """White as the background, or as different in every camera as a mirror: the hull stays, to its smoothing."""
    if kind == "glossy":
        gain = 0.4 + 0.6 * torch.rand(12, 1, 1, 1, 3, generator=torch.Generator().manual_seed(0))
        scene = replace(bowl, images=1 - (1 - bowl.images * gain) * bowl.mattes[..., None])
    else:
        scene = replace(bowl, images=torch.ones_like(bowl.images))
    _, geometry = found(seen_by(scene, EVERY_SECOND))
    _, lost = compared(geometry.body)
    assert lost < 0.002
    assert geometry.body.occupied_volume() > 0.92 * geometry.hull_volume
    # and it is said, if not for as much as is wrong: the lid that no outline touches begins some voxels from the rim
    assert geometry.figures(0.01)["geometry/uncertain_share"] > 0.04


def test_a_part_that_is_carved_by_mistake_is_given_back():
    """A ball on a stalk: without its stalk the mattes are uncovered; a hole in the ball's front leaves them covered."""
    axis = torch.arange(-0.08, 0.08, 0.004)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    ball, stalk = (
        points.norm(dim=-1) < 0.05,
        (points[..., :2].norm(dim=-1) < 0.012) & (points[..., 2] > 0),
    )
    body = Volume((ball | stalk).float(), axis[0].repeat(3), 0.004)
    rig = ring_of_cameras(
        6, 64, target=(0, 0, 0), distance=1.0, elevations=(0.1, 0.6), field=0.12, turn=0.1
    )
    views = Windows(
        torch.zeros(6, 64, 64, 3),
        torch.ones(6, 64, 64),
        rig,
        torch.arange(6),
        torch.zeros(6, dtype=torch.long),
    )
    without = keep_silhouettes(ball, body, views)
    lost = stalk & ~ball & ~without
    assert (
        lost.sum() < 0.5 * (stalk & ~ball).sum()
    )  # its root, within a bin of the ball in every picture
    tip = stalk & (points[..., 2] > 0.066)
    assert (without & tip).sum() == tip.sum()
    hole = ball & ~((points - torch.tensor([0.04, 0.0, 0.0])).norm(dim=-1) < 0.02) | stalk
    assert (keep_silhouettes(hole, body, views) & ~hole).sum() < 0.2 * (
        body.values.bool() & ~hole
    ).sum()
    matte_of_nothing = replace(views, mattes=torch.zeros(6, 64, 64))
    assert torch.equal(keep_silhouettes(ball, body, matte_of_nothing), ball)


def test_the_surface_moves_to_where_colours_and_outlines_put_it(squashed):
    """From the hull of eight views to the true ellipsoid, within a fifth of a pixel (5 mm)."""
    still = object_windows(squashed, list(range(8)), [0]).of_frame(0)
    hull = visual_hull(squashed.mattes[:, 0], squashed.cameras, squashed.box, pitch=0.0036)
    hull = replace(hull, values=(hull.values > 0.5).float())
    centre = torch.tensor(squashed_body.forward(np.zeros((1, 3)), 0.0, 1.0)[0], dtype=torch.float32)
    rest = squashed.truth.positions[0][::7]
    start = signed_distance(hull)
    distance = refine(start, start, [still], FIRST + THEN)
    information = surface_information(distance, [still], 0.4)
    directions = torch.nn.functional.normalize(rest - centre, dim=1)
    radii = torch.tensor(squashed_body.RADII, dtype=torch.float32)
    surface = centre + directions / (directions / radii).norm(dim=1, keepdim=True)
    errors = [
        sample(d.values[None], (surface - d.origin) / d.pitch)[:, 0] / 5e-3
        for d in (start, distance)
    ]  # in pixels
    assert errors[1].square().mean().sqrt() < 0.2
    assert errors[1].square().mean().sqrt() < 0.5 * errors[0].square().mean().sqrt()
    assert errors[1].mean().abs() < errors[0].mean().abs()
    known = sample(information[None], (surface - distance.origin) / distance.pitch)[:, 0]
    assert (known > 0).float().mean() > 0.8


def test_a_body_of_which_images_leave_nothing_is_its_hull_and_an_empty_hull_is_named(
    bowl, monkeypatch
):
    monkeypatch.setattr(
        "mosa.reconstruction.geometry.body.carve",
        lambda body, *_: replace(body, values=torch.zeros_like(body.values)),
    )
    with pytest.warns(
        UserWarning,
        match=r"scene bowl: carving and refinement left nothing of a visual hull of \d+ voxels of 6 mm",
    ):
        hull, geometry = found(bowl)
    assert (
        torch.equal(geometry.body.values, found(bowl, source="hull")[1].body.values)
        and geometry.free_frames == 1
    )
    assert geometry.body.occupied_volume() > 0.8 * geometry.hull_volume
    flat = replace(hull, values=torch.zeros_like(hull.values))
    flat.values[5, 5, 5] = 1.0
    with pytest.raises(
        DataError,
        match=r"scene bowl: expected a visual hull with an inside, found 1 voxels of 6 mm: .*resolution",
    ):
        find_geometry(
            bowl, flat, GeometrySection(), ridge_passes=0, sigma=1.2, margin=6, device="cpu"
        )


def test_free_flight_is_followed_and_ends_where_the_body_deforms(squashed):
    """Rigid for 0.4 of the time: of five frames the first two. With all frames called free there are four motions."""
    frames = [
        object_windows(squashed, list(range(8)), list(range(5))).of_frame(t) for t in range(5)
    ]
    hull = visual_hull(squashed.mattes[:, 0], squashed.cameras, squashed.box, pitch=0.0036)
    distance = signed_distance(replace(hull, values=(hull.values > 0.5).float()))
    motions = free_motions(squashed, distance, frames)
    moved = motions[0].points(squashed.truth.positions[0])
    assert (moved - squashed.truth.positions[1]).norm(
        dim=1
    ).max() < 1.5e-3  # 0.3 px of a way of 36 mm and 7 degrees
    assert len(motions) <= 2
    assert len(free_motions(replace(squashed, last_free_frame=4), distance, frames)) == 4
    assert len(free_motions(replace(squashed, ground=Ground(0.25)), distance, frames)) == 0
    assert len(free_motions(squashed, distance, frames[:1])) == 0


def test_cameras_of_a_moved_body_see_what_the_moved_body_shows(still):
    angle = 0.3
    turn = torch.tensor(
        [
            [math.cos(angle), -math.sin(angle), 0.0],
            [math.sin(angle), math.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    motion = Motion(turn, torch.tensor([0.02, -0.1, 0.03]), torch.tensor([0.0, 0.3, 0.0]))
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(1))
    seen = motion.windows(still).cameras.w2c
    expected = (
        motion.points(points) @ still.cameras.w2c[:, :3, :3].transpose(1, 2)
        + still.cameras.w2c[:, None, :3, 3]
    )
    torch.testing.assert_close(
        points @ seen[:, :3, :3].transpose(1, 2) + seen[:, None, :3, 3],
        expected,
        atol=1e-6,
        rtol=1e-5,
    )


def test_sums_on_the_grid_are_exact_in_any_order_and_keep_their_total():
    generator = torch.Generator().manual_seed(0)
    index, values = (
        7 * torch.rand(5000, 3, generator=generator),
        torch.randn(5000, 2, generator=generator),
    )
    total = scatter((9, 8, 10), index, values)
    order = torch.randperm(5000, generator=generator)
    assert torch.equal(total, scatter((9, 8, 10), index[order], values[order]))
    torch.testing.assert_close(total.sum((1, 2, 3)), values.sum(0), atol=1e-3, rtol=0)
    # the adjoint of reading: <scatter(v), f> = <v, sample(f)>
    field = torch.randn(2, 9, 8, 10, generator=generator)
    torch.testing.assert_close(
        (total * field).sum(), (values * sample(field, index)).sum(), atol=2e-2, rtol=1e-4
    )


def test_a_smoothed_line_is_the_line_and_a_smoothed_point_has_its_variance():
    x = torch.arange(41.0)[:, None, None].expand(41, 5, 5)
    torch.testing.assert_close(smooth(x, 2.0)[10:30], x[10:30], atol=1e-4, rtol=0)
    point = torch.zeros(41, 1, 1)
    point[20] = 1
    spread = smooth(point, 2.0)[:, 0, 0]
    assert float((spread * (torch.arange(41.0) - 20) ** 2).sum()) == pytest.approx(
        4.0, rel=0.03
    )  # cut at three deviations


def test_rays_meet_a_ball_where_they_do():
    axis = torch.arange(-0.12, 0.12, 0.005)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    ball = Volume(points.norm(dim=-1) - 0.08, axis[0].repeat(3), 0.005)
    offset = torch.tensor(
        [[0.0, 0.0, 0.0], [0.03, 0.02, 0.0], [0.06, -0.03, 0.0], [0.09, 0.0, 0.0]]
    )
    start = offset + torch.tensor([0.0, 0.0, -1.0])
    way = first_crossing(ball, start, torch.tensor([0.0, 0.0, 1.0]).expand(4, 3))
    expected = 1 - (0.08**2 - offset[:3].square().sum(1)).sqrt()
    torch.testing.assert_close(
        way[:3], expected, atol=3e-4, rtol=0
    )  # trilinear: pitch^2/(8 radius), over the cosine
    assert way[3].isinf()
    late = first_crossing(
        ball, start, torch.tensor([0.0, 0.0, 1.0]).expand(4, 3), expected.new_full((4,), 0.9)
    )
    torch.testing.assert_close(late[:3], expected, atol=3e-4, rtol=0)


def test_the_surface_of_a_cube_is_its_outer_layer():
    values = torch.zeros(9, 9, 9)
    values[2:7, 2:7, 2:7] = 1
    surface = surface_of(Volume(values, torch.zeros(3), 1.0))
    assert int(surface.sum()) == 5**3 - 3**3


def test_geometry_comes_back_from_what_is_stored_and_the_hull_has_no_uncertainty(bowl):
    _, geometry = found(bowl, source="hull")
    again = Geometry.read(geometry.stored())
    assert torch.equal(again.body.values, geometry.body.values) and again.figures(
        0.01
    ) == geometry.figures(0.01)
    assert "geometry/uncertain_share" not in geometry.figures(0.01)
    with pytest.raises(
        ConfigError,
        match=r"reconstruction\.geometry\.source: expected images or hull or gaussians, found 'depth'",
    ):
        GeometrySection(source="depth")


def test_two_lone_cameras_carve_nothing(bowl):
    hull = visual_hull(bowl.mattes[:, 0], bowl.cameras, bowl.box, pitch=0.008)
    body = replace(hull, values=(hull.values > 0.5).float())
    views = object_windows(bowl, list(range(12)), [0])
    assert torch.equal(carve(body, views.select(torch.tensor([0, 6]))).values, body.values)
