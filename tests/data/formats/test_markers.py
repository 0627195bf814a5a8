"""Tracked points: files, release, alignment, how they go with the body, and a law learned from
them alone."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml
from omegaconf import OmegaConf
from small_bodies import FREE, NU, E, small_body

from mosa import compose
from mosa.data.io.markers import Recording, alignment, read_markers, released, swung
from mosa.data.scene import load_scene
from mosa.errors import ConfigError, DataError
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.stages import Stage
from mosa.modules.fitting.training_sequences import Take
from mosa.physics.contact.driven import driven_from_config
from mosa.physics.world import Start
from mosa.reconstruction.marker_body import cues_of_markers, filled, in_own_axes, marker_spacing
from mosa.reconstruction.resolution import resolution
from mosa.types import MarkerCues, Markers

BEAMS = Path(os.environ.get("MOSA_DATA", "")) / "real" / "beams"
BOX = {"type": "box", "size": [0.4, 0.1, 0.2]}


def write(path, times, names, positions):
    rows = ["time,name,x,y,z"]
    for time, frame in zip(times, positions):
        rows += [f"{time:.4f},{name},{','.join('' if np.isnan(v) else f'{v:.6f}' for v in p)}"
                 for name, p in zip(names, frame)]  # fmt: skip
    path.write_text("\n".join(rows) + "\n")
    return path


def let_go(at=0.3037, rate=100.0):
    """(times, positions (n, 4, 3)) of points of a block that falls from rest from `at` [s] on."""
    times = np.arange(80) / rate
    places = np.array([[0.2, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.1], [-0.2, 0.05, 0.1]])
    positions = np.repeat(places[None], len(times), 0)
    positions[..., 1] -= 0.5 * 9.8 * np.clip(times - at, 0, None)[:, None] ** 2
    return times, positions


def test_a_scene_of_a_csv_file(tmp_path):
    times, positions = let_go()
    angle = 0.7
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    seen = positions @ R.T + [1.0, 2.0, 3.0]
    seen[45, 1] = np.nan
    path = write(tmp_path / "fall.csv", times, "abcd", seen)
    known = dict(zip("abcd", positions[0].tolist()))
    scene = load_scene(format="markers", path=str(path), body=BOX, density=900.0, points=known,
                       tracked=["a", "b"], fps=50, duration=0.2, holdout_frames=2)  # fmt: skip
    assert scene.frames == 11 and scene.training_frames == list(range(9))
    assert len(scene.cameras) == 0 and scene.markers.names == ("a", "b")
    expected = positions[0, :2, 1] - 0.5 * 9.8 * scene.times.numpy()[:, None] ** 2
    found = scene.markers.positions.numpy()
    assert (
        np.nanmax(np.abs(found[..., 1] - expected)) < 4e-4
    )  # where the release falls between samples
    torch.testing.assert_close(scene.markers.rest.double(), torch.tensor(positions[0, :2]), atol=1e-5, rtol=0)  # fmt: skip
    x, volume = filled(scene.markers.body, marker_spacing(scene, 500))
    assert 400 < len(x) < 600 and float(volume.sum()) == pytest.approx(8e-3, rel=1e-5)


def test_the_release_is_found_to_a_part_of_a_sample():
    times, positions = let_go()
    assert released(times, positions, "here") == pytest.approx(0.3037, abs=2e-4)
    with pytest.raises(DataError, match="set scene"):
        released(times, positions[::-1], "here")


def test_a_drift_before_the_release_is_not_read_as_its_beginning():
    """A swing of 13 mm at 5.3 Hz, released at 0.5 s from hands that sink by 4 mm/s until then: a line through the root of the
    displacement ends 0.2 s too early. Without the drift the release is found."""
    times = np.arange(0, 2.0, 0.01)
    t = np.clip(times - 0.5, 0, None)
    swing = 13e-3 * (1 - np.exp(-2 * t) * np.cos(2 * np.pi * 5.3 * t))
    places = np.array([[0.1, 0.02, 0.0], [0.1, 0.0, 0.02]])
    found = np.tile(places, (len(times), 1, 1))
    found[..., 1] -= swing[:, None]
    assert released(times, found, "here") == pytest.approx(0.5, abs=0.01)
    found[..., 1] -= 4e-3 * np.minimum(times, 0.5)[:, None]
    with pytest.raises(DataError, match=r"here: expected points at rest .* Set scene\.start"):
        released(times, found, "here")


def test_a_swing_begins_at_its_turning_point():
    """Of a body that hands let go over 20 ms: the oscillation is that of a release in one moment, and
    of 13 samples a period a resampled one keeps its amplitude."""
    times = np.arange(0, 2.0, 0.01)
    begin, omega, ratio = 0.3137, 2 * np.pi * 7.7, 0.05
    t = np.clip(times - begin, 0, None)
    swing = 6e-3 * (
        np.exp(-ratio * omega * t) * (np.cos(omega * t) + ratio * np.sin(omega * t)) - 1
    )
    early = (times > begin - 0.012) & (times < begin + 0.012)
    swing[early] = -1.2e-3 * ((times[early] - begin + 0.012) / 0.024) ** 2
    places = np.array([[0.1, 0.02, 0.0], [0.1, 0.0, 0.02]])
    positions = np.tile(places, (len(times), 1, 1))
    positions[..., 1] += swing[:, None]
    assert released(times, positions, "here") < begin - 4e-3
    assert swung(times, positions, "here") == pytest.approx(begin, abs=2e-4)
    later = begin + np.arange(5, 60) / 100
    t = later - begin
    expected = 6e-3 * (np.exp(-ratio * omega * t) * (np.cos(omega * t) + ratio * np.sin(omega * t)) - 1)  # fmt: skip
    found = Recording(("a", "b"), times, positions).at(later)[:, 0, 1] - places[0, 1]
    assert np.abs(found - expected).max() < 3e-5
    with pytest.raises(DataError, match="two periods and more of an oscillation"):
        swung(*let_go(), "here")


def test_a_gap_stays_one(tmp_path):
    times, positions = let_go()
    positions[20:26, 2] = np.nan
    found = read_markers(write(tmp_path / "gap.csv", times, "abcd", positions))
    resampled = found.at(np.array([0.1, 0.225, 0.4]))
    assert np.isnan(resampled[1, 2]).all() and np.isfinite(resampled[[0, 2]]).all()


@pytest.mark.parametrize(
    "first, last, points", [(60, 62, slice(None)), (60, 61, slice(None)), (50, 79, 2), (55, 60, 1)]
)
def test_a_recording_that_freezes_is_named(tmp_path, first, last, points):
    """In free fall, for a while or to its end: all points for a sample, or one of them for longer."""
    times, positions = let_go()
    positions[first : last + 1, points] = positions[first, points]
    with pytest.raises(
        DataError, match=rf"at one place from {times[first]:g} to {times[last]:g} s"
    ):
        read_markers(write(tmp_path / "frozen.csv", times, "abcd", positions))


@pytest.mark.parametrize("change", ["jump", "exchanged"])
def test_a_point_that_leaves_the_others_within_a_sample_is_named(tmp_path, change):
    times, positions = let_go()
    if change == "jump":
        positions[60, 1] += 0.3
    else:
        positions[60:] = positions[60:, [1, 0, 2, 3]]
    with pytest.raises(
        DataError, match=r"move with the others, found .* within one sample at 0\.6 s"
    ):
        read_markers(write(tmp_path / "odd.csv", times, "abcd", positions))


def test_a_rounded_oscillation_stands_still_at_its_turning_points(tmp_path):
    times = np.arange(120) / 100
    moved = np.round(
        0.01 * np.cos(2 * np.pi * 4 * (times + 0.005)), 4
    )  # samples on both sides of each
    positions = np.stack([0 * times, moved, 0 * times], -1)[:, None].repeat(4, 1)
    assert (np.diff(positions, axis=0) == 0).all((1, 2)).any()
    read_markers(write(tmp_path / "swing.csv", times, "abcd", positions))


def test_a_mirrored_axis_of_a_flat_body_is_said():
    """The points lie in a plane to a fortieth of their extent, which another unit is not told by."""
    known = np.array([[0.2, 0, 0], [0, 0.2, 0.005], [-0.2, 0, 0], [0, -0.2, 0], [0.1, 0.1, 0.01]])
    named = dict(zip("abcde", known.tolist()))
    noise = 2e-4 * np.random.default_rng(0).normal(size=known.shape)
    assert alignment(known + noise, named, "scene.points")[2] < 1e-3
    for axis in range(3):
        mirrored = known * np.where(np.arange(3) == axis, -1, 1)
        with pytest.raises(
            ConfigError,
            match=r"scene\.points: .*right-handed axes, found .* with one axis mirrored",
        ):
            alignment(mirrored + noise, named, "scene.points")


def test_points_in_line_align_nothing():
    line = np.arange(3)[:, None] * np.ones(3)
    with pytest.raises(ConfigError, match="one line"):
        alignment(line, dict(zip("abc", line.tolist())), "scene.points")


@pytest.mark.parametrize("body", [
    "{type: mesh, path: a.obj, scale: 0.001, rotation: [0,1,0,20]}", "{type: box, size: [1,2,3], rotation: [0,1,0,20]}",
])  # fmt: skip
def test_a_body_has_exactly_the_keys_that_were_given(body):
    section = compose("scene=markers", f"scene.body={body}").scene.body
    assert OmegaConf.to_container(section) == yaml.safe_load(body)


@pytest.mark.parametrize(
    "keys, said",
    [({"body": None}, "scene.body: expected .type: box"),
     ({"tracked": ["e"]}, "scene.tracked"), ({"start": 9.0}, "scene.start"), ({"body": {"type": "ball"}}, "scene.body"),
     ({"body": BOX | {"motion": {"velocity": [1, 0, 0]}}}, "scene.body"),
     ({"body": BOX | {"size": [400, 100, 200]}}, "scene.body: .*another unit"),
     ({"holdout_frames": 99}, "scene.holdout_frames"), ({"loads": [BOX]}, "scene.loads"),
     *(({key: wrong}, f"^scene.{key}: expected") for key, wrong in (
         ("start", [0.5]), ("duration", "a"), ("duration", math.nan), ("holdout_frames", 1.5), ("tracked", "a"),
         ("tracked", []), ("points", {"a": "abc"}), ("points", [1]), ("up", "abc"), ("up", [0, 0, 0]),
         ("gravity", [0, 1]))),
     ({"fps": 1e9}, "2 frames or more, and 100000 at most"), ({"up": [0, math.nan, 0]}, "scene.up"),
     ({"points": dict(zip("abcd", (1000 * let_go()[1][0]).tolist()))}, "scene.points: .*another unit")],
)  # fmt: skip
def test_a_mistake_names_its_key(tmp_path, keys, said):
    path = write(tmp_path / "fall.csv", let_go()[0], "abcd", let_go()[1])
    with pytest.raises(ConfigError, match=said):
        load_scene(**{"format": "markers", "path": str(path), "body": BOX, "density": 900.0} | keys)


def test_up_has_unit_length(tmp_path):
    path = write(tmp_path / "fall.csv", let_go()[0], "abcd", let_go()[1])
    scene = load_scene(format="markers", path=str(path), body=BOX, density=900.0, up=[0, 2, 0])
    assert scene.up.tolist() == [0.0, 1.0, 0.0]


def test_a_table_as_spreadsheets_write_it_is_read(tmp_path):
    """Of two columns x the second was taken without a word; rows of empty cells, and remarks, were refused."""
    path, rows = tmp_path / "a.csv", "0, a, 1, 2, 3\n0.1, a, 1, 2, 4\n,,,,\n0.2, a\n"
    path.write_text(f"# camera 3\ntime, name, x, y, z\n{rows}")
    found = read_markers(path)
    assert found.names == ("a",) and found.times.tolist() == [0, 0.1, 0.2]
    assert found.positions[1, 0].tolist() == [1, 2, 4] and np.isnan(found.positions[2]).all()
    path.write_text(f"time,name,x,y,z,x\n{rows}")
    with pytest.raises(DataError, match="each once, found time, name, x, y, z, x"):
        read_markers(path)
    for text, said in (
        (
            "time,name,x,y,z\n0.0,a,1,5,2,5,3,5\n",
            "8 cells below 5 names in row 1: .* decimal point",
        ),
        (
            "time,name,x,y,z\n0,a,1,2,3\n0.1,a,1,lost,3\n",
            "row 2: y: expected a number or an empty cell, found 'lost'",
        ),
        (
            "time,name,x,y,z\n0,a,1,2,3\n0,a,1,2,3\n",
            "row 2: 'a' at 0.0 s for a second time",
        ),
        ("time;name;x;y;z\n0,0;a;1,5;2,5;3,5\n", "one column 'time;name;x;y;z': .* by commas"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=said):
            read_markers(path)


def test_a_clock_of_milliseconds_and_a_start_in_motion_are_said(tmp_path):
    times, positions = let_go()
    with pytest.raises(DataError, match="expected times in seconds, found samples 10 s apart"):
        read_markers(write(tmp_path / "fall.csv", 1e3 * times, "abcd", positions))
    times = np.arange(300) / 100
    with pytest.raises(DataError, match="expected rest at first, found points moving"):
        released(times, positions[:1] + [0.0, 0.1, 0.0] * times[:, None, None], "here")


def test_a_body_and_a_recording_in_millimetres_are_asked_about(tmp_path):
    """They fit each other, and no ground and no free fall tells their unit: a beam of 120 m was learned."""
    times, positions = let_go()
    path = write(tmp_path / "fall.csv", times, "abcd", 1e3 * positions)
    large = {"type": "box", "size": [1e3 * side for side in BOX["size"]]}
    with pytest.warns(UserWarning, match="expected metres, found a body of .* in millimetres"):
        load_scene(format="markers", path=str(path), body=large, density=900.0)


@pytest.fixture(scope="module")
def swinging(tmp_path_factory):
    """A block of known law that hangs from one end, and a recording of three of its points."""
    body = small_body(adapter=False, E=E, law="neo_hookean", counts=(8, 3, 3))
    world = replace(FREE, gravity=torch.tensor([0, -9.8, 0]).double(), driven=driven_from_config(
        [{"type": "plane", "normal": [1, 0, 0], "position": [float(body.rest[:, 0].min()) + 0.03, 0, 0]}]))  # fmt: skip
    begin = Start(torch.eye(3).double(), body.center, *torch.zeros(2, 3).double())
    with torch.no_grad():
        x = body.simulate(begin, world, 12, 1 / 60).x
    places = torch.tensor([[0.07, 0.03, 0.0], [0.07, -0.01, 0.01], [0.02, 0.0, -0.01]])
    markers = Markers(tuple("abc"), places, places.expand(12, 3, 3), None)
    scene = load_scene(format="markers", path=str(write(tmp_path_factory.mktemp("a") / "a.csv", *(
        let_go()[0], "abcd", let_go()[1]))), body=BOX, density=900.0)  # fmt: skip
    cues = cues_of_markers(replace(scene, markers=markers), body.rest)
    seen = cues.seen(x)
    seen[5, 1] = torch.nan
    return body, world, begin, replace(cues, positions=seen)


def test_how_far_points_are_from_the_surface_is_said(tmp_path, caplog):
    path = write(tmp_path / "fall.csv", let_go()[0], "abcd", let_go()[1])
    caplog.set_level("INFO")
    load_scene(format="markers", path=str(path), body=BOX | {"position": [0, 0.02, 0]}, density=1e3)
    assert "at rest the points are -20.0 to 0.0 mm from the body's surface" in caplog.text
    # a mesh has distances on a lattice around it alone
    trimesh.creation.box(BOX["size"]).export(tmp_path / "a.obj")
    for height, said in ((0.02, "to 0.0 mm"), (-0.2, "to more than 67 mm")):
        mesh = {"type": "mesh", "path": "a.obj", "position": [0, height, 0]}
        load_scene(format="markers", path=str(path), body=mesh, density=1e3)
        assert said in caplog.text.rpartition("at rest the points are")[2]


def test_a_turned_body_is_as_thick_as_it_is_upright(tmp_path):
    path, found = write(tmp_path / "fall.csv", let_go()[0], "abcd", let_go()[1]), []
    for turn in ([0, 1, 0, 0], [0.3, 0.2, 1, 25]):
        body = BOX | {"rotation": turn}
        scene = load_scene(format="markers", path=str(path), body=body, density=900.0)
        x, _ = filled(scene.markers.body, spacing := marker_spacing(scene, 700))
        found.append(resolution(in_own_axes(scene, x), spacing, 1.6 * spacing))
    assert found[0] == found[1] and found[0].cells > 2 and found[0].pieces == 1


def test_points_go_with_every_affine_motion(swinging):
    body, _, _, cues = swinging
    A = torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double()
    x = body.rest @ A.T + 1.0
    rest = MarkerCues(cues.positions, cues.particles, cues.weights).seen(body.rest[None])[0]
    torch.testing.assert_close(cues.seen(x[None])[0], rest @ A.T + 1.0, atol=1e-9, rtol=0)
    expected = torch.tensor([[0.07, 0.03, 0.0], [0.07, -0.01, 0.01], [0.02, 0.0, -0.01]])
    torch.testing.assert_close(rest, expected.double(), atol=1e-7, rtol=0)


@torch.no_grad()
def test_a_law_from_points_alone(swinging):
    """From 0.8 of the true E, in six iterations, with a sample that was not seen."""
    _, world, begin, cues = swinging
    body = small_body(adapter=False, E=0.8 * E, law="neo_hookean", counts=(8, 3, 3))
    body.material.raw["nu"].copy_(small_body(E=E, adapter=False).material.raw["nu"])
    body.material.raw["nu"].requires_grad_(False)
    stage = Stage(name="prior", iterations=6, lr=0.1)
    fit = Identification(body, [Take(begin, None, cues, 1 / 60, 1)], world, stage, Criterion(name="corrected"),
                         IdentificationSettings(), seats=1)  # fmt: skip
    for _ in range(6):
        fit.iterate()
    assert float(body.material.physical()["E"]) == pytest.approx(E, rel=0.02)
    assert float(body.material.physical()["nu"]) == pytest.approx(NU, abs=1e-3)


@torch.no_grad()
def test_what_another_experiment_said_outweighs_a_film_that_says_less(swinging):
    """E is known to 1e-4, as correlated with nu as it may be; nu, which is not learned, is left out."""
    _, world, begin, cues = swinging
    body = small_body(adapter=False, E=E, law="neo_hookean", counts=(8, 3, 3))
    body.material.raw["nu"].requires_grad_(False)
    ones = torch.ones(2).double()
    said = Posterior(["E", "nu"], torch.tensor([math.log(1.1 * E), 0.0]).double(),
                     1e-8 * (0.5 * torch.eye(2).double() + 0.5), ones)  # fmt: skip
    fit = Identification(body, [Take(begin, None, cues, 1 / 60, 1)], world, Stage(name="prior", iterations=2, lr=0.1),
                         Criterion(name="corrected"), IdentificationSettings(), seats=1, known=said)  # fmt: skip
    for _ in range(2):
        fit.iterate()
    assert float(body.material.physical()["E"]) == pytest.approx(1.1 * E, rel=2e-3)
    assert fit.newton.known.names == ["E"] and fit.posterior().covariance[0, 0] < 1.01e-8


@torch.no_grad()
def test_a_load_of_one_recording_sags_more(swinging):
    body, world, begin, _ = swinging
    load = {"type": "plane", "normal": [-1, 0, 0], "position": [0.06, 0, 0], "mass": 0.3, "held": False}  # fmt: skip
    loaded = Start.read(replace(begin, loads=(load,)).written(), body.rest)
    assert loaded.loads == (load,)
    low, without = (body.simulate(each, world, 8, 1 / 60).x[-1, :, 1].min() for each in (loaded, begin))  # fmt: skip
    assert float(low) < float(without) - 1e-3


@pytest.mark.skipif(not BEAMS.is_dir(), reason="the recordings are no part of the project")
def test_a_measured_beam():
    pytest.importorskip("c3d")
    box = {"type": "box", "size": [0.112, 0.03, 0.03]}
    scene = load_scene(format="markers", path=str(BEAMS / "beam_gravity_V2_a.c3d"), body=box,
                       density=1070.0, duration=3.0)  # fmt: skip
    moved = (scene.markers.positions - scene.markers.rest)[-50:].mean(0) * 1e3
    assert float(moved[0, 0]) == pytest.approx(-6.64, abs=0.05)  # the sag of the first marker


def test_a_stretch_that_was_cut_out_is_said(tmp_path, recwarn):
    """All points are elsewhere within a sample, in the middle of a motion; what is moved step by step is not."""
    times, positions = let_go()
    cut = np.delete(positions, slice(45, 60), 0)
    path = write(tmp_path / "cut.csv", times[: len(cut)], "abcd", cut)
    with pytest.warns(UserWarning, match=r"within one sample at 0\.45 s, .* was a stretch cut out"):
        read_markers(path)
    recwarn.clear()
    stepped = np.repeat(positions[:1], len(times), 0)
    stepped[40:, :, 1] += 0.01
    for k, still in enumerate((positions, stepped)):
        read_markers(write(tmp_path / f"{k}.csv", times, "abcd", still))
    assert not recwarn.list
