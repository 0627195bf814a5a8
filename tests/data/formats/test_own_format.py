"""What a loader of one's own hands over is checked once, with messages that say what to change."""

import warnings
from dataclasses import replace

import pytest
import torch
from blocks_film import block_scene

from mosa.data import scene as formats
from mosa.data.checks.validation import validate
from mosa.data.formats.footage import Footage
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.scene import load_scene, register_format
from mosa.errors import ConfigError, DataError

KNOWN = block_scene()


def loaded(change=lambda footage: footage):
    """The film of blocks as a loader would hand it over, changed."""
    frames = tuple(range(KNOWN.frames))
    parts = KNOWN.cameras, frames, KNOWN.times, KNOWN.images, KNOWN.mattes, KNOWN.background
    footage = change(Footage(*parts))
    return validate(scene_from_footage(
        footage, name="own", gravity=KNOWN.gravity, box=KNOWN.box, ground=KNOWN.ground, up=KNOWN.up
    ))  # fmt: skip


def filmed(**of_cameras):
    return lambda film: replace(
        film, cameras=replace(film.cameras, **{k: f(film) for k, f in of_cameras.items()})
    )


def test_a_film_as_footage_says_it_passes():
    assert loaded().name == "own"


@pytest.mark.parametrize("change, said", [
    (lambda f: replace(f, images=f.images.numpy()), r"images: .* dense .*ndarray \(float32"),
    (lambda f: replace(f, times=f.times.tolist()), r"times: expected a dense .*found \[0\.0, "),
    (lambda f: replace(f, images=(255 * f.images).byte()), r"images: .*found Tensor \(torch\.uint8"),
    (lambda f: replace(f, mattes=f.mattes.double()), r"mattes: expected .*Tensor \(torch\.float64"),
    (lambda f: replace(f, images=255 * f.images), r"images: expected numbers in \[0, 1\], found .* to 255; divide"),
    (lambda f: replace(f, mattes=2 * f.mattes - 1), r"mattes: expected numbers in \[0, 1\], found -1 to 1"),
    (lambda f: replace(f, images=f.images * f.mattes[..., None]), r"images: .*expected the background \[1\.0, "),
    (lambda f: replace(f, background=torch.zeros(3)), r"images: .*background \[0\.0, .* 1\.00 away"),
    (lambda f: replace(f, frames=f.frames[1:]), r"times: expected shape"),
    (filmed(w2c=lambda f: f.cameras.w2c[:, :3]), r"cameras\.w2c: expected shape \(\d+, 4, 4\), found \(\d+, 3, 4\)"),
    (filmed(K=lambda f: f.cameras.K.double()), r"cameras: expected Cameras of dense tensors"),
    (filmed(names=lambda f: tuple(range(len(f.cameras)))), r"cameras: .* texts .*found .*\(0, 1, 2\)"),
])  # fmt: skip
def test_what_is_no_film_is_refused(change, said):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(DataError, match=rf"scene own \(train\)[.:] ?{said}"):
            loaded(change)


@pytest.mark.parametrize("part, value, said", [
    ("images", None, "dense .*found None"), ("mattes", KNOWN.mattes.to_sparse(), "dense .*coo"),
    ("times", KNOWN.times.clone().requires_grad_(), "without gradients"),
    ("background", torch.ones(3, device="meta"), "dense .*meta"), ("gravity", None, "dense "),
    ("up", [0, 1, 0], "dense "), ("box", KNOWN.box.double(), "float64"),
    ("cameras", None, "Cameras "), ("particles", (None,), "dense tensors"),
    ("ground", "sticky", "a Ground"), ("density", None, "number above 0"),
    ("holdout_cameras", (3,), r"below 3.*\(3,\)"), ("holdout_frames", (0,), r"last ones.*\(0,\)"),
    ("holdout_frames", (5,), "last ones"), ("last_free_frame", 5, "below 5"),
    ("truth", 3, "a Truth"), ("markers", 4, "Markers"),
])  # fmt: skip
def test_a_scene_made_by_hand_is_checked_in_every_part(part, value, said):
    with pytest.raises(DataError, match=rf"scene blocks \(train\).*: expected .*{said}"):
        validate(replace(KNOWN, **{part: value}))


@pytest.mark.parametrize("place, error, said", [
    ("no_such_rig:load", ConfigError, "registered as no_such_rig:load, which cannot be imported"),
    ("math:load", ConfigError, "registered as math:load, which cannot be imported"),
    ("own_rig:nothing", DataError, "expected a Scene .* from own_rig:nothing, found NoneType"),
])  # fmt: skip
def test_a_loader_that_is_none_is_named(tmp_path, monkeypatch, place, error, said):
    (tmp_path / "own_rig.py").write_text("def nothing(path, ground): return None\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS))
    register_format("rig", place)
    with pytest.raises(error, match=rf"scene\.format: .*{said}"):
        load_scene(format="rig", path=str(tmp_path))


def test_a_format_that_nobody_registered_says_how():
    with pytest.raises(ConfigError, match=r"found 'rig'; one of another package .*extensions"):
        load_scene(format="rig", path="x")
    for place in ("rig", "rig:", ":load"):
        with pytest.raises(ConfigError, match=r"rig: expected module:function, found"):
            register_format("rig", place)
