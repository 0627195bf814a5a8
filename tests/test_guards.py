"""What is refused before anything long runs, or made again, with the message that says so."""

import math
import struct
import zlib

import pytest
import torch
from omegaconf import OmegaConf
from strangers import checkpoint, saved
from test_known import composed

from mosa.checkpoints import check_same, read_checkpoint
from mosa.config import rehearse
from mosa.data.images import check_amount, read_image
from mosa.data.particles import read_ply
from mosa.errors import ConfigError, DataError
from mosa.guards import check_begin, check_particles
from mosa.limits import machine_memory
from mosa.physics.contact.mesh import field_of_mesh
from mosa.reconstruction.cache import StageCache
from mosa.run import read_figures


def test_more_particles_than_memory_holds_are_refused_with_the_most_that_fit():
    most = machine_memory() / 5e3
    check_particles("simulation.particles", 0.9 * most)
    with pytest.raises(ConfigError, match=rf"simulation\.particles: expected at most {int(most)} particles"):
        check_particles("simulation.particles", 1.1 * most)


def test_a_fit_goes_on_from_its_own_checkpoint_alone(tmp_path):
    cut, whole = tmp_path / "cut.ckpt", checkpoint(tmp_path / "whole.ckpt")
    cut.write_bytes(whole.read_bytes()[:3000])
    for path, message in ((cut, "cut.ckpt is not a readable"), (whole, "expected the parts epoch, global_step")):
        with pytest.raises(DataError, match=message) as caught:
            check_begin(OmegaConf.create({"ckpt_path": str(path), "resume": "auto"}))
        assert "remove the file, and resume=auto begins the fit anew" in str(caught.value)
    check_begin(OmegaConf.create({"ckpt_path": None, "resume": None}))


class Model:
    def __init__(self, *overrides):
        self.stored = saved(*overrides)["state_dict"]

    def state_dict(self):
        return self.stored


def test_a_checkpoint_of_another_model_is_named(tmp_path):
    stored = read_checkpoint(checkpoint(tmp_path / "a.ckpt"))
    check_same(stored, Model(), "a.ckpt")
    with pytest.raises(DataError, match=r"body\.adapter.*belongs to another configuration"):
        check_same(stored, Model("adapter=direct"), "a.ckpt")
    with pytest.raises(DataError, match="expected a body of 27 particles, found 28"):
        check_same({**stored, "mosa": stored["mosa"] | {"particles": 28}}, Model(), "a.ckpt")


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


def test_a_scene_cannot_name_a_folder_outside_of_the_cache(tmp_path):
    assert StageCache(tmp_path / "cache", {"scene": "../../evil"}).folder.parent == tmp_path / "cache" / "reconstruction"


def test_a_giant_picture_is_refused_from_its_header(tmp_path):
    header = struct.pack(">IIBBBBB", 13_000, 13_000, 8, 6, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 100) + b"IDAT" + bytes(100))
    with pytest.raises(DataError, match=r"a\.png: expected at most 67 million pixels, found 13000x13000"):
        read_image(tmp_path / "a.png")
    check_amount(100, 100, 100)
    with pytest.raises(ConfigError, match=r"scene\.scale: 1000000 pictures"):
        check_amount(10**6, 2000, 2000)


@pytest.mark.parametrize("count", ["4000000000000", "-1", "x", "1" * 400])
def test_a_ply_that_claims_more_than_it_has_is_named(tmp_path, count):
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex {count}\n{axes}end_header\n0 0 0\n")
    with pytest.raises(DataError, match=r"a\.ply: expected a PLY file whose elements fit into its"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(ConfigError, match=r"a\.ply: expected a PLY file"):
        field_of_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("overrides, message", [
    (["+prior.parameters.mu=5"], r"prior\.parameters: expected each of lam, mu once, found mu twice"),
    (["simulation.stride=1000"], r"simulation\.stride: expected at most simulation\.max_substeps=400"),
    ([f"losses.{name}=0" for name in ("image", "mask", "flow", "rotation", "stretch", "position")], "losses: expected a weight"),
    (["world.colliders=[{type: box, size: [1, 1]}]"], r"world\.colliders\[0\]\.size: expected three lengths"),
    (["world.walls={}"], r"world\.walls: expected null, or keys"),
])  # fmt: skip
def test_a_mistake_costs_no_reconstruction(overrides, message):
    with pytest.raises(ConfigError, match=message):
        rehearse(composed(*overrides))
