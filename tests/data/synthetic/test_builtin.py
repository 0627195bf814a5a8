"""Built-in scenes: repeatable, cached, true to their physics, and filmed where the truth is."""

import math
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mosa.data.images.reading import composite, resize
from mosa.data.scene import held_out_sequences, load_scene
from mosa.data.synthetic import films as takes
from mosa.data.synthetic import sequences
from mosa.data.synthetic.bodies.objects import NAMES, OBJECTS, RING, Meeting
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.bodies.standin_shapes import STANDIN_SHAPES
from mosa.data.synthetic.drop import COURANT, place, simulate
from mosa.data.synthetic.materials.hidden_material import FORMS
from mosa.data.synthetic.renderer import render_surface, ring_of_cameras
from mosa.data.synthetic.surface import Surface, bind, extract_surface, fill
from mosa.errors import ConfigError
from mosa.evaluation.floor import floor_rollout
from mosa.modules.body.body import World
from mosa.modules.body.contact import ContactOffset
from mosa.physics.contact.colliders import Collider, HalfSpace
from mosa.physics.contact.motion import Motion
from mosa.physics.contact.planes import Plane
from mosa.rendering.cameras import project


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def tiny(cache, **keys):
    return load_scene(format="builtin", name="tiny", cache=str(cache), **keys)


@pytest.fixture(scope="module")
def training(cache):
    return tiny(cache)


@pytest.fixture(scope="module")
def held_out(cache):
    return held_out_sequences(format="builtin", name="tiny", cache=str(cache))


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_have_their_height_and_closed_surfaces(name):
    height = next(o.height for o in OBJECTS.values() if o.shape == name)
    size = 1.0 if height > 0.1 else 0.2  # the toothpaste is smaller than a hand
    if name in STANDIN_SHAPES:
        size *= 1.5
    surface = extract_surface(SHAPES[name], 0.005 * size, np.random.default_rng(0))
    assert np.ptp(surface.vertices[:, 1]) == pytest.approx(height, abs=1.5e-3 * size)
    assert np.abs(SHAPES[name].distance(surface.vertices)).max() < 5e-4 * size
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), -1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    corner = surface.vertices[surface.triangles]
    volume = (np.cross(corner[:, 0], corner[:, 1]) * corner[:, 2]).sum() / 6
    assert volume == pytest.approx(
        len(fill(SHAPES[name], 0.004 * size, np.random.default_rng(0))) * (0.004 * size) ** 3,
        rel=0.01,
    )


SECOND_FIVE = ("gorilla", "calf", "chick2", "rainbowball", "ring")


@pytest.mark.parametrize("name", SECOND_FIVE)
def test_limbs_are_two_cells_of_the_truth_s_grid_thick(name):
    """Opened by a ball of one cell, a body loses nothing but the creases of its joints."""
    body = OBJECTS[name]
    pitch, radius = 0.004, 2 * body.spacing
    points = fill(SHAPES[body.shape], pitch, np.random.default_rng(0))
    deep = points[SHAPES[body.shape].distance(points) < -radius]
    lost = (
        cKDTree(deep).query(points)[0] > radius + pitch
    )  # a lattice point may lie a pitch off the ball's centre
    assert lost.mean() < 2e-3


def test_the_ring_is_a_torus_of_a_material_without_directions():
    """Pappus: 2 pi^2 R r^2; lattice points inside of it are that volume to the surface's share of a half cell, averaged out."""
    volume = len(fill(SHAPES["ring"], 0.003, np.random.default_rng(0))) * 0.003**3
    assert volume == pytest.approx(2 * math.pi**2 * 0.088 * 0.023**2, rel=0.01)
    material = OBJECTS["ring"].material
    assert material.summary()["E_along"] == pytest.approx(material.summary()["E_across"])
    assert material.parameters(torch.rand(5, 3))["mu"].std() == 0


def test_the_second_five_differ_in_material_and_start_above_the_ground_in_every_drop():
    fibres = [np.asarray(OBJECTS[n].material.fibre) for n in SECOND_FIVE if n != "ring"]
    fibres = [f / np.linalg.norm(f) for f in fibres]
    for i, a in enumerate(fibres):
        for b in fibres[:i]:
            assert abs(a @ b) < math.cos(math.radians(20))
    for name in SECOND_FIVE:
        body, points = (
            OBJECTS[name],
            fill(SHAPES[OBJECTS[name].shape], 0.012, np.random.default_rng(0)),
        )
        assert len(body.drops) == 3
        for drop in body.drops.values():
            start, _ = place(points, points.mean(0) * [0, 1, 0], drop, points)
            # two whole frames of free flight
            assert start[:, 1].min() > drop.speed * 0.04 + 0.5 * 9.8 * 0.04**2


@pytest.mark.parametrize("name", ["rabbit", "gorilla", "calf", "chick2", "rainbowball"])
def test_colours_do_not_repeat_under_mirroring_so_that_a_pose_can_be_told(name):
    surface = extract_surface(SHAPES[name], 0.006, np.random.default_rng(0))
    mirrored = surface.vertices * [1, 1, -1]
    nearest = np.linalg.norm(surface.vertices[None, ::7] - mirrored[::7, None], axis=-1).argmin(1)
    assert np.abs(surface.colors[::7] - surface.colors[::7][nearest]).mean() > 0.1


def test_a_skin_reproduces_affine_motion():
    shape = SHAPES["rabbit"]
    particles = fill(shape, 0.012, np.random.default_rng(0))
    points = extract_surface(shape, 0.01, np.random.default_rng(0)).vertices
    skin = bind(points, particles, 0.012)
    A = np.array([[1.1, 0.3, -0.2], [0.1, 0.7, 0.2], [0.0, -0.4, 1.2]])
    moved = skin.follow(particles @ A.T + [0.2, -0.1, 0.3])
    assert np.abs(moved - (points @ A.T + [0.2, -0.1, 0.3])).max() < 1e-6


def test_rays_hit_a_sphere_where_it_is():
    """Coverage of a sphere seen from far is its silhouette's ellipse: area pi r^2 f^2/(d^2 - r^2) to first order."""
    angle = np.linspace(0, np.pi, 65)[:, None], np.linspace(0, 2 * np.pi, 129)[None, :-1]
    ball = 0.1 * np.stack(
        [
            np.sin(angle[0]) * np.cos(angle[1]),
            np.cos(angle[0]) + 0 * angle[1],
            np.sin(angle[0]) * np.sin(angle[1]),
        ],
        -1,
    )
    index = np.arange(65 * 128).reshape(65, 128)
    a, b = index[:-1], index[1:]
    quads = [
        np.stack([a, np.roll(a, -1, 1), b], -1),
        np.stack([np.roll(a, -1, 1), np.roll(b, -1, 1), b], -1),
    ]
    triangles = np.concatenate([q.reshape(-1, 3) for q in quads]).astype(np.int32)
    vertices = ball.reshape(-1, 3) + np.array([0.02, 0.01, 0.0])
    surface = Surface(vertices, triangles, np.full_like(vertices, 0.5))
    cameras = ring_of_cameras(
        2, 96, target=(0, 0, 0), distance=2.0, elevations=(0.0,), field=0.3, turn=0.3
    )
    pictures = render_surface(surface, vertices, cameras)
    matte = torch.from_numpy(pictures[..., 3] / 255.0)
    grid = torch.arange(96) + 0.5
    for v in range(2):
        f, d = (
            float(cameras.K[v, 0, 0]),
            float(
                (cameras.w2c[v, :3, :3] @ torch.tensor([0.02, 0.01, 0.0]) + cameras.w2c[v, :3, 3])[
                    2
                ]
            ),
        )
        assert float(matte[v].sum()) == pytest.approx(
            np.pi * 0.01 * f * f / (d * d - 0.01), rel=0.01
        )
        center = (
            torch.stack([(matte[v] * grid).sum(), (matte[v] * grid[:, None]).sum()])
            / matte[v].sum()
        )
        pixel, _ = project(torch.tensor([[0.02, 0.01, 0.0]]), cameras.select([v]))
        assert (center - pixel[0, 0]).abs().max() < 0.1


def test_a_take_is_repeatable_and_comes_from_the_cache(training, cache, tmp_path, monkeypatch):
    again = tiny(tmp_path)
    assert again.fingerprint == training.fingerprint
    assert torch.equal(again.truth.positions, training.truth.positions)
    monkeypatch.setattr(takes, "film_drop", lambda *a: pytest.fail("made again although cached"))
    assert tiny(cache).fingerprint == training.fingerprint


def test_a_damaged_cache_is_made_again(training, cache, tmp_path, caplog):
    shutil.copytree(cache / "builtin", tmp_path / "builtin")
    file = next((tmp_path / "builtin").glob("tiny-train-anisotropic-0-*"))
    file.write_bytes(file.read_bytes()[:5000])
    assert tiny(tmp_path).fingerprint == training.fingerprint
    assert "damaged cache file" in caplog.text
    assert tiny(tmp_path).fingerprint == training.fingerprint
    assert not list((tmp_path / "builtin").glob("tmp*"))


def test_seed_changes_the_footage_and_material_changes_the_motion_alone(training, cache, tmp_path):
    other = tiny(tmp_path, seed=1)
    assert other.fingerprint != training.fingerprint
    assert not torch.allclose(other.cameras.w2c, training.cameras.w2c)
    twin = tiny(cache, material="isotropic")
    assert torch.equal(twin.cameras.w2c, training.cameras.w2c)
    assert torch.equal(twin.truth.rest, training.truth.rest)
    assert torch.equal(twin.images[:, 0], training.images[:, 0])
    assert torch.allclose(twin.truth.positions[1], training.truth.positions[1], atol=2e-6)
    difference = (twin.truth.positions[-1] - training.truth.positions[-1]).norm(dim=-1)
    assert difference.mean() > 2e-3


def test_rest_is_frame_0_of_training_and_held_out_starts_are_turned_copies_of_it(
    training, held_out
):
    truth = training.truth
    assert torch.allclose(truth.rest, truth.positions[0], atol=1e-6)
    assert torch.equal(truth.rotation, torch.eye(3))
    assert [s.sequence for s in held_out] == ["test_60", "test_40"]
    for scene, degrees in zip(held_out, (60.0, 40.0)):
        assert torch.equal(scene.truth.rest, truth.rest)
        Q = scene.truth.rotation
        assert torch.rad2deg(torch.acos((Q.trace() - 1) / 2)).item() == pytest.approx(
            degrees, abs=1e-3
        )
        arms = truth.rest - truth.rest.mean(0)
        start = scene.truth.positions[0] - scene.truth.positions[0].mean(0)
        assert torch.allclose(start, arms @ Q.T, atol=2e-6)
    assert held_out_sequences(format="builtin", name="tiny", sequence="test_60") == []


def test_free_flight_follows_the_parabola_until_contact_and_then_does_not(training, held_out):
    for scene in (training, *held_out):
        truth = scene.truth
        t = scene.times[:, None]
        parabola = truth.positions[0].mean(0) + truth.velocity * t + 0.5 * scene.gravity * t**2
        center = truth.positions.mean(1)
        assert torch.allclose(center[1], parabola[1], atol=2e-6)
        assert (center[-1] - parabola[-1]).norm() > 0.05
        # nothing sinks into the ground by more than the grid's reach, and something comes near it
        lowest = truth.positions[..., 1].amin()
        assert -0.01 < lowest < 0.01


def test_the_pictures_show_the_truth_and_nothing_is_cut_off(training, held_out):
    for scene in (training, *held_out):
        m = scene.mattes
        border = torch.stack(
            [m[..., 0, :].amax(), m[..., -1, :].amax(), m[..., 0].amax(), m[..., -1].amax()]
        )
        assert border.amax() == 0
        for t in (0, scene.frames - 1):
            pixel, depth = project(scene.truth.positions[t], scene.cameras)
            assert depth.min() > 0
            index = pixel.long()
            inside = torch.stack([m[v, t, index[v, :, 1], index[v, :, 0]] for v in range(len(m))])
            assert (inside > 0).float().mean() > 0.995
            covered = torch.zeros_like(m[:, t], dtype=torch.bool)
            for v in range(len(m)):
                covered[v, index[v, :, 1], index[v, :, 0]] = True
            grown = torch.nn.functional.max_pool2d(covered.float()[:, None], 5, 1, 2)[:, 0] > 0
            assert (m[:, t] * ~grown).sum() / m[:, t].sum() < 0.03


def test_keys_of_built_in_scenes(cache, training):
    assert sequences("rabbit") == ("train", "test_60", "test_40")
    scene = tiny(cache, holdout_cameras=[5], holdout_frames=1, scale=0.25)
    assert scene.images.shape == (6, 5, 32, 32, 3)
    assert scene.training_cameras == [0, 1, 2, 3, 4]
    assert scene.training_frames == [0, 1, 2, 3]
    assert scene.synthetic
    assert scene.known_parameters == pytest.approx({"E": 217708, "nu": 0.29766}, rel=1e-4)
    assert scene.truth.parameters["E_along"] / scene.truth.parameters["E_across"] == pytest.approx(
        1.6
    )
    for keys, message in (
        ({"sequence": "test_90"}, "scene.sequence: tiny has train, test_60, test_40, not 'test_90'"),
        ({"material": "wood"}, "scene.material"), ({"seed": -1}, "scene.seed"), ({"seed": 0.5}, "scene.seed"),
        ({"frames": [1, 4]}, r"scene\.frames: built-in sequences start at frame 0"),
        ({"density": 900.0}, "scene.density: not a key"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            tiny(cache, **keys)
    with pytest.raises(ConfigError, match=r"scene\.name: expected one of the built-in"):
        load_scene(format="builtin", name="teapot")


def test_a_cache_folder_that_cannot_be_written_is_named(tmp_path, training, monkeypatch):
    (tmp_path / "file").write_text("")
    take = takes.make(
        "tiny", "train", cache=None if training is None else tmp_path / "ok", progress=False
    )
    monkeypatch.setattr(takes, "film_drop", lambda *a: take)
    with pytest.raises(ConfigError, match=r"scene\.cache: cannot write .*; give it another folder"):
        tiny(tmp_path / "file")


def test_the_floor_is_the_truth_itself_on_the_truth_s_own_particles_and_grid(training, held_out):
    """float32 rounding over about 240 substeps, grown by contact, stays far below the millimetres that a floor measures."""
    spacing = OBJECTS["tiny"].spacing
    scene = held_out[0]
    world = World(scene.ground, scene.gravity, scene.up, scene.box)
    rest = training.truth.rest
    contact = ContactOffset()
    torch.nn.init.constant_(contact.cells, OBJECTS["tiny"].meeting.lift)
    body = SimpleNamespace(
        rest=rest, volume=torch.full((len(rest),), spacing**3), contact=contact,
        settings=SimpleNamespace(dx=2 * spacing, courant=COURANT),
    )  # fmt: skip
    found = floor_rollout(body, scene, world)
    assert (found - scene.truth.positions).norm(dim=-1).max() < 1e-4
    body.settings.dx *= 2
    coarse = floor_rollout(body, scene, world)
    assert (coarse - scene.truth.positions).norm(dim=-1).max() > 1e-3
    # a shelf in the way, and a wall beside the body that its spreading pushes against
    shelf = float(scene.truth.positions[0][:, 1].min()) - 0.02
    plate = Collider(
        HalfSpace(), "sticky", motion=Motion((0.0, shelf, 0.0), (-0.5 * math.pi, 0.0, 0.0))
    )
    held = floor_rollout(body, scene, replace(world, colliders=(plate,)))
    sunk = 0.25 * body.settings.dx  # what an impact presses particles into a grid's contact
    assert held[..., 1].min() > shelf - sunk > coarse[..., 1].min() + sunk
    right = float(scene.truth.positions[0][:, 0].max())
    wall = Plane((right, 0.0, 0.0), (-1.0, 0.0, 0.0), "separate")
    walled = floor_rollout(body, scene, replace(world, planes=(wall,)))
    assert (
        walled[..., 0].max() < right + 0.005 < coarse[..., 0].max() - 0.005
    )  # spreading by 13 mm is held within 2


def test_version_2_meets_the_ground_in_its_own_way_and_version_1_as_before():
    """A sticky grid's nodes stop a body above the plane, `touch` at half a spacing from it."""
    body = OBJECTS["tiny"]
    particles = fill(SHAPES[body.shape], body.spacing, np.random.default_rng([0, 2]))
    drop, lowest = body.drops["train"], {}
    for meeting in (Meeting(), Meeting(lift=0.0), Meeting(lift=0.0, mode="touch", friction=0.5)):
        other = replace(body, meeting=meeting)
        found = simulate(other, RING, particles, particles, drop, drop)
        lowest[meeting] = found.positions[..., 1].min() / body.dx
    filmed, nodes, touching = lowest.values()
    assert filmed == pytest.approx(nodes - 0.4, abs=0.05)
    assert -0.1 < touching < nodes - 0.1
    drawn = [OBJECTS[f"{name}_v2"].meeting for name in NAMES]
    assert len(set(drawn)) == len(NAMES) and {m.mode for m in drawn} == {"sticky", "touch"}
    assert all(abs(m.stated) <= 0.005 and 0 <= m.lift <= 0.6 for m in drawn)
    assert {OBJECTS[f"{name}_v2"].material.law for name in NAMES} == {"hill", *FORMS}


def test_what_is_kept_of_version_1_is_found_as_before(tmp_path):
    """The key of a film is made of its object's repr, in which version 2 has no part."""
    name = takes.film_file("rabbit", "train", "anisotropic", 0, tmp_path).name
    assert name == "rabbit-train-anisotropic-0-9e62727fa106.npz"
    assert takes.film_file("rabbit_v2", "train", "anisotropic", 0, tmp_path).name != name


def test_the_scene_of_version_2_states_a_height_that_is_a_little_wrong(
    training, cache, monkeypatch
):
    """The pictures are version 1's, so that nothing is filmed: what the scene says is asked."""
    take = takes.make("tiny", "train", cache=cache, progress=False)
    monkeypatch.setattr(takes, "film_drop", lambda *a: take)
    meeting = Meeting(lift=0.0, stated=0.003, mode="touch", friction=0.5)
    monkeypatch.setitem(OBJECTS, "tiny", replace(OBJECTS["tiny"], meeting=meeting))
    ground = tiny(cache).ground
    assert (ground.height, ground.mode, ground.friction) == (0.003, "touch", 0.5)


def test_an_object_of_another_spacing_is_filled_anew(monkeypatch):
    """What is kept for the next sequence is of the object, not of its name."""
    counts = []

    def counted(body, material, particles, *args, **kwargs):
        counts.append(len(particles))
        raise InterruptedError

    monkeypatch.setattr(takes, "simulate", counted)
    for factor in (1.0, 1.5):
        coarser = replace(OBJECTS["tiny"], spacing=factor * OBJECTS["tiny"].spacing)
        with monkeypatch.context() as patch, pytest.raises(InterruptedError):
            patch.setitem(OBJECTS, "tiny", coarser)
            takes.film_drop("tiny", "train", "anisotropic", 0, False)
    assert counts[1] < 0.5 * counts[0]


@pytest.mark.parametrize("size", [(24, 24), (12, 12), (17, 17)])
def test_pictures_are_composited_on_white_at_every_size(size):
    """A window around the object is enough: beside it all is white. The last picture is empty."""
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (2, 2, 24, 24, 4)).astype(np.uint8)
    pictures[:, :, :5, :, 3] = pictures[:, :, :, 20:, 3] = pictures[1, 1, ..., 3] = 0
    images, mattes = takes.pictures_to_footage(pictures, size)
    for v, t in np.ndindex(2, 2):
        picture = pictures[v, t].astype(np.float32) / 255
        plain = composite(picture[..., :3], picture[..., 3], np.ones(3, np.float32))
        assert np.array_equal(images[v, t].numpy(), resize(plain, *size))
        assert np.array_equal(
            mattes[v, t].numpy(), resize(np.ascontiguousarray(picture[..., 3]), *size)
        )


def test_a_built_in_scene_without_a_name_is_refused(cache):
    with pytest.raises(ConfigError, match=r"scene\.name: expected a value"):
        load_scene(format="builtin", name=None, cache=cache)
