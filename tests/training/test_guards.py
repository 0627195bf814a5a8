"""What is refused before anything long runs, or made again, with the message that says so."""

import errno
import math
import os
import struct
import sys
import warnings
import zlib
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from small_bodies import small_body
from strangers import checkpoint, saved

from mosa.config.build import rehearse
from mosa.config.checkpoints import check_resumed, check_same, read_checkpoint
from mosa.data.formats.particles import read_ply
from mosa.data.images.reading import check_amount, read_image
from mosa.data.io.gaussian_ply import load_ply
from mosa.errors import ConfigError, DataError
from mosa.physics.contact.mesh import field_of_mesh
from mosa.physics.world import World
from mosa.reconstruction.cache import StageCache
from mosa.system.limits import machine_memory
from mosa.training.preflight import (
    check_begin,
    check_configuration,
    check_curves,
    check_evaluation,
    check_held,
    check_particles,
    check_seen,
)
from mosa.training.run_folder import read_figures
from mosa.types import Ground
from tests.config.test_command_settings import composed


def test_more_particles_than_memory_holds_are_refused_with_the_most_that_fit():
    most = machine_memory() / 5e3
    check_particles("simulation.particles", 0.9 * most)
    with pytest.raises(
        ConfigError, match=rf"simulation\.particles: expected at most {int(most)}, found"
    ):
        check_particles("simulation.particles", 1.1 * most)


def test_walls_beside_a_ground_that_slopes_are_refused_before_the_reconstruction():
    up = torch.tensor([0.5, 0.75**0.5, 0.0])
    scene = SimpleNamespace(
        ground=Ground(0.0, "sticky"),
        gravity=-9.8 * up,
        up=up,
        box=torch.tensor([[-1.0] * 3, [1.0] * 3]),
        driven=(),
    )
    cfg = OmegaConf.create(composed("debug=default", "world.walls={mode: separate}"))
    with pytest.raises(
        ConfigError, match=r"plane 0 .*mode sticky.*right angles.*scene\.ground\.mode=touch"
    ):
        check_seen(cfg, scene)


def test_a_body_that_nothing_touches_is_refused_before_its_fit():
    body = small_body(adapter=False, E=1e4)
    free = World(
        None, torch.tensor([0.0, -9.8, 0.0]), torch.tensor([0.0, 1.0, 0.0]), torch.zeros(2, 3)
    )
    with pytest.raises(ConfigError, match=r"world\.driven: .*clamp.*found nothing: in free flight"):
        check_held(free, body)
    held = replace(free, ground=Ground(0.0, "sticky"))
    check_held(held, body)
    with torch.no_grad():
        body.material.raw["E"].fill_(math.log(0.2))
    weight = 9.8 * body.density * body.size
    with pytest.raises(ConfigError, match=rf"E: expected Pa .*found 0\.2: .* of {weight:.3g} Pa"):
        check_held(held, body)


@pytest.mark.parametrize("recording", [None, "again"])
def test_a_force_beside_the_film_is_refused_before_the_reconstruction(tmp_path, recording):
    """As one whose times are milliseconds."""
    (tmp_path / "cell.csv").write_text("time,fy\n20,1\n560,2\n")
    entry = {"of": "plate", "file": str(tmp_path / "cell.csv"), "recording": recording}
    films = [SimpleNamespace(sequence=name, training_frames=range(14), frame_dt=0.04)
             for name in ("press", "again")]  # fmt: skip
    cfg = OmegaConf.create({"world": {"forces": [entry]}})
    with pytest.raises(ConfigError, match=r"'plate' that covers .*0 to 0\.52 s.*found 20 to 560 s"):
        check_curves(cfg, films)
    (tmp_path / "cell.csv").write_text("time,fy\n0.02,1\n0.56,2\n")
    check_curves(cfg, films)


def test_a_fit_goes_on_from_its_own_checkpoint_alone(tmp_path):
    cut, whole = tmp_path / "cut.ckpt", checkpoint(tmp_path / "whole.ckpt")
    cut.write_bytes(whole.read_bytes()[:3000])
    for path, message in (
        (cut, "cut.ckpt: not a readable"),
        (whole, "expected the parts epoch, global_step"),
    ):
        with pytest.raises(DataError, match=message) as caught:
            check_begin(OmegaConf.create({"ckpt_path": str(path), "resume": "auto"}))
        assert "remove the file, and resume=auto begins the fit anew" in str(caught.value)
    check_begin(OmegaConf.create({"ckpt_path": None, "resume": None}))


def going_on(**changes):
    """A checkpoint's content that a fit can go on from, with parts of its fit in the place of its own."""
    stored = {"epoch": 0, "global_step": 0, "pytorch-lightning_version": "2", "loops": {}, "callbacks": {}, "optimizer_states": [],
              "lr_schedulers": [], "state_dict": {}}  # fmt: skip
    known = saved()["mosa"]
    fit = {"stage": 2, "losses": [1.0], "steps_done": 3, "particles": 7, "misfit": 0.01} | changes
    return stored | {"mosa": known | {"fit": fit}}


def test_a_body_of_another_size_is_refused_before_the_reconstruction(tmp_path):
    torch.save(going_on(), path := tmp_path / "last.ckpt")
    for override, said in (("simulation.particles=100", "particles"), ("simulation.dx=0.05", "dx")):
        cfg = OmegaConf.create(composed("debug=default", override) | {"ckpt_path": str(path)})
        with pytest.raises(ConfigError, match=rf"of other particles \(simulation\.{said}: "):
            check_begin(cfg)


def test_a_checkpoint_of_an_older_version_is_refused_before_the_reconstruction(tmp_path):
    """train.py went on from it; eval.py refused it and said nothing of its age."""
    stored = going_on()
    stored["mosa"]["settings"]["adapter"]["strain"] = "log"
    torch.save(stored, path := tmp_path / "last.ckpt")
    cfg = OmegaConf.create(composed("debug=default") | {"ckpt_path": str(path)})
    with pytest.raises(DataError, match=r"adapter\.strain: unknown key.*this version of mosa"):
        check_begin(cfg)


RUNNING = {
    "iteration": 1,
    "factors": [1.0],
    "multiple": 0.0,
    "noise": [[torch.ones(4)] * 3],
    "grid": None,
}
CUES = torch.zeros(5, 7, 3)


def test_what_a_fit_goes_on_from_is_checked_whole():
    check_resumed(going_on(), "a.ckpt")
    check_resumed(
        going_on(cues=[CUES], identification=RUNNING, compared={}, grounds={"slip": math.inf}),
        "a.ckpt",
    )


@pytest.mark.parametrize("changes, message", [
    *((dict(cues=value), r"mosa\.fit\.cues: expected null, or for each sequence finite positions of shape") for value in (
        5, "a", {"train": CUES}, [5], ["a"], [CUES[0]], [CUES.long()], [CUES * math.nan], [CUES[..., :2]])),
    (dict(identification=5), r"mosa\.fit\.identification: expected a section of keys, or null"),
    (dict(identification={}), r"mosa\.fit\.identification\.iteration: expected this key, found none"),
    (dict(identification=RUNNING | {"iteration": "a"}), r"mosa\.fit\.identification\.iteration: expected a whole number"),
    (dict(identification=RUNNING | {"factors": [math.nan]}), r"mosa\.fit\.identification\.factors: expected numbers above 0"),
    (dict(identification=RUNNING | {"multiple": math.inf}), r"mosa\.fit\.identification\.multiple: expected a number"),
    (dict(identification=RUNNING | {"noise": [[5]]}), r"mosa\.fit\.identification\.noise: expected null, or for each rollout"),
    (dict(identification=RUNNING | {"grid": [[CUES * math.nan] * 3]}), r"mosa\.fit\.identification\.grid: expected null, or"),
    (dict(misfit="a"), r"mosa\.fit\.misfit: expected a number"), 
    (dict(losses=[math.nan]), r"mosa\.fit\.losses: expected numbers"),
    (dict(stage=None), r"mosa\.fit\.stage: expected a whole number"),
    (dict(compared=5), r"mosa\.fit\.compared: expected numbers by name"),
    (dict(compared={"corotated": 1.0}), r"mosa\.law: expected the law that was chosen"),
])  # fmt: skip
def test_a_damaged_state_of_a_fit_is_named(changes, message):
    with pytest.raises(DataError, match=message):
        check_resumed(going_on(**changes), "a.ckpt")


def test_tensors_by_no_name_are_no_state():
    for wrong in (5, [1], {5: 1}):
        with pytest.raises(DataError, match="state_dict: expected tensors by name"):
            check_resumed(going_on() | {"state_dict": wrong}, "a.ckpt")


class Model:
    stages = (None,) * 3

    def __init__(self, *overrides):
        self.stored = saved(*overrides)["state_dict"]

    def state_dict(self):
        return self.stored


def with_fit(stored, **changes):
    return {**stored, "mosa": stored["mosa"] | {"fit": stored["mosa"]["fit"] | changes}}


def test_a_checkpoint_of_another_model_is_named(tmp_path):
    stored = read_checkpoint(checkpoint(tmp_path / "a.ckpt"))
    check_same(stored, Model(), "a.ckpt")
    with pytest.raises(DataError, match=r"body\.adapter.*belongs to another configuration"):
        check_same(stored, Model("adapter=direct"), "a.ckpt")
    with pytest.raises(DataError, match="expected a body of 27 particles, found 28"):
        check_same(with_fit(stored, particles=28), Model(), "a.ckpt")
    with pytest.raises(
        DataError, match=r"mosa\.fit\.stage: expected at most 3, the stages of this fit, found 4"
    ):
        check_same(with_fit(stored, stage=4), Model(), "a.ckpt")
    rest = stored["state_dict"]["body.rest"]
    for wrong, message in ((rest.long(), "of whole numbers"), (rest * math.nan, "finite")):
        with pytest.raises(DataError, match=rf"body\.rest: .*{message}"):
            check_same(
                {**stored, "state_dict": stored["state_dict"] | {"body.rest": wrong}},
                Model(),
                "a.ckpt",
            )


@pytest.mark.parametrize("text", ["", '{"a":', "[1]", '{"a": [1]}', "null", "[" * 100_000])
def test_damaged_figures_are_named(tmp_path, text):
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(DataError, match=r"metrics\.json: expected the figures of a complete run"):
        read_figures(tmp_path / "metrics.json")


SPLATS = {"means": torch.zeros(9, 3), "scales": torch.ones(9, 3), "rotations": torch.ones(9, 4), "opacities": torch.ones(9),
          "colors": torch.ones(9, 3)}  # fmt: skip


@pytest.mark.parametrize("wrong", [{}, [1], 5, {**SPLATS, "means": torch.zeros(3, 3)},
                                   {**SPLATS, "means": torch.full((9, 3), math.nan)},
                                   {k: v for k, v in SPLATS.items() if k != "scales"}])  # fmt: skip
def test_a_cache_that_holds_something_else_is_made_again(tmp_path, wrong, caplog):
    cache = StageCache(tmp_path, {"scene": "a"})
    torch.save(wrong, cache.folder / "static.pt")
    made = cache.stage("static", lambda: SPLATS)
    assert made is SPLATS and "static.pt: cannot be read" in caplog.text
    again = cache.stage("static", lambda: pytest.fail("it is there"))
    assert all(torch.equal(again[key], SPLATS[key]) for key in SPLATS)


def test_a_video_without_an_ffmpeg_is_refused_before_anything_long(monkeypatch):
    """It was found out after the fit, when the video was to be written."""
    values = composed("debug=default")
    check_configuration(values)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"evaluation\.video: expected false, or an ffmpeg"):
        check_configuration(values)
    check_configuration(values | {"evaluation": values["evaluation"] | {"video": False}})


def test_a_cache_whose_bits_have_changed_is_made_again(tmp_path, caplog):
    """torch reads a flipped bit as another number."""
    cache = StageCache(tmp_path, {"scene": "a"})
    cache.stage("static", lambda: SPLATS)
    content, scales = (
        bytearray((cache.folder / "static.pt").read_bytes()),
        SPLATS["scales"].numpy().tobytes(),
    )
    content[content.index(scales) + 1] ^= 1
    (cache.folder / "static.pt").write_bytes(content)
    assert (
        cache.stage("static", lambda: SPLATS) is SPLATS
        and "static.pt: cannot be read (other bytes" in caplog.text
    )


def test_a_cache_that_has_all_may_be_read_only(tmp_path, monkeypatch):
    """One that several users share, and that only one of them writes."""
    StageCache(tmp_path, {"scene": "a"}).stage("static", lambda: SPLATS)

    def refuse(path):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr("mosa.reconstruction.cache.written_whole", refuse)
    assert (
        StageCache(tmp_path, {"scene": "a"})
        .stage("static", lambda: pytest.fail("it is there"))
        .keys()
        == SPLATS.keys()
    )
    with pytest.raises(OSError, match="Read-only"):
        StageCache(tmp_path, {"scene": "b"})


def test_a_scene_cannot_name_a_folder_outside_of_the_cache(tmp_path):
    assert (
        StageCache(tmp_path / "cache", {"scene": "../../evil"}).folder.parent
        == tmp_path / "cache" / "reconstruction"
    )


def test_a_giant_picture_is_refused_from_its_header(tmp_path):
    header = struct.pack(">IIBBBBB", 13_000, 13_000, 8, 6, 0, 0, 0)
    chunk = (
        struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    )
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 100) + b"IDAT" + bytes(100)
    )
    with pytest.raises(
        DataError, match=r"a\.png: expected at most 67 million pixels, found 13000x13000"
    ):
        read_image(tmp_path / "a.png")
    check_amount(100, 100, 100)
    with pytest.raises(
        ConfigError,
        match=r"scene\.scale: pixels of all pictures: .*found 1e\+06 x 2000 x 2000: lower it",
    ):
        check_amount(10**6, 2000, 2000)


@pytest.mark.parametrize("count", ["4000000000000", "-1", "x", "1" * 400])
def test_a_ply_that_claims_more_than_it_has_is_named(tmp_path, count):
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {count}\n{axes}end_header\n0 0 0\n"
    )
    with pytest.raises(DataError, match=r"a\.ply: expected a PLY file whose elements fit into its"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(ConfigError, match=r"a\.ply: expected a PLY file"):
        field_of_mesh(tmp_path / "a.ply")


def test_a_ply_has_a_byte_for_each_property_of_its_elements(tmp_path):
    many = "".join(f"property double f_{i}\n" for i in range(2000))
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 30000\n{many}end_header\n"
    )
    with pytest.raises(
        DataError,
        match=r"a\.ply: expected a PLY file whose elements fit .* found 'element vertex 30000'",
    ):
        load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("overrides, message", [
    (["prior=neo_hookean", "+prior.parameters.mu=5"], r"prior\.parameters: expected each of lam, mu once, found mu twice"),
    (["simulation.stride=1000"], r"simulation\.stride: expected at most simulation\.max_substeps=400"),
    ([f"losses.{name}=0" for name in ("image", "mask", "flow", "rotation", "stretch", "position")], "losses: expected a weight"),
    (["world.colliders=[{type: box, size: [1, 1]}]"], r"world\.colliders\[0\]\.size: expected three lengths"),
    (["world.walls={}"], r"world\.walls: expected null, or keys"),
])  # fmt: skip
def test_a_mistake_costs_no_reconstruction(overrides, message):
    with pytest.raises(ConfigError, match=message):
        rehearse(composed(*overrides))


@pytest.mark.parametrize(("more", "idle"), [
    ({}, None), ({"simulate": {"frames": 60}}, "simulate.frames"), ({"simulate": {"frames": 60, "height": 0.2}}, None),
    ({"simulate": {"height": 0.2, "variant": "prior"}, "plan": 8}, "simulate.height, simulate.variant"),
    ({"simulate": {"height": 0.2}, "scene": {"name": "tiny"}}, "scene"), ({"scene": {"name": "tiny"}}, None),
])  # fmt: skip
def test_a_key_of_eval_without_an_effect_is_named(more, idle):
    """simulate.frames=60 alone evaluated the run, without a word."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_evaluation({"ckpt_path": "last.ckpt", "evaluation": {"video": False}} | more)
    assert [str(each.message).partition(":")[0] for each in said] == [idle] * (idle is not None)
