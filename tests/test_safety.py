"""A checkpoint from a stranger is data: whatever it names, nothing of it is executed, resolved or written to."""

import io
import os
import zipfile

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf
from strangers import checkpoint

from mosa.config.checkpoints import read_checkpoint
from mosa.data.formats.transforms import read_transforms
from mosa.errors import DataError
from mosa.system.npz import read_npz, write_npz
from mosa.training.preflight import evaluated_scene
from mosa.twin.twin import Twin


def set_adapter(value):
    def change(stored):
        stored["mosa"]["settings"]["adapter"] = value

    return change


def test_the_checkpoint_of_these_tests_is_a_good_one(tmp_path):
    """The negative control: without it every refusal below could have another reason."""
    twin = Twin.load(checkpoint(tmp_path / "good.ckpt"))
    assert type(twin.body.adapter).__name__ and len(twin.simulate(frames=2).x) == 2


@pytest.mark.parametrize(
    "target",
    [
        "subprocess.Popen",
        "subprocess.run",
        "os.system",
        "builtins.exec",
        "mosa.twin.Twin.load",
        "mosa.modules.body.body.Body",
        "strangers.checkpoint",
    ],
)
def test_what_a_checkpoint_names_is_not_called(tmp_path, target):
    touched = tmp_path / "touched"
    malicious = {
        "name": "direct",
        "_target_": target,
        "args": ["touch", str(touched)],
        "command": f"touch {touched}",
    }
    with pytest.raises(DataError, match=r"adapter\._target_: unknown key"):
        Twin.load(checkpoint(tmp_path / "bad.ckpt", change=set_adapter(malicious)))
    assert not touched.exists()


class Runs:
    """What `pickle` would run when it reads it."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def at(*path, value):
    """A change of the stored checkpoint at a place; a value of None takes the place out."""

    def change(stored):
        part = stored
        for key in path[:-1]:
            part = part[key]
        if value is None:
            del part[path[-1]]
        else:
            part[path[-1]] = value

    return change


def nested(levels: int, width: int) -> list:
    """A list of `width` times the same list, `levels` deep: few objects, width ** levels entries."""
    found = [0]
    for _ in range(levels):
        found = [found] * width
    return found


CFG = ("mosa", "settings")
DAMAGED = {
    "interpolation": (at(*CFG, "scene", "cache", value="${oc.env:HOME}/x"), r"scene\.cache: expected a value.*not resolved"),
    "interpolation in the world": (at(*CFG, "world", "walls", value={"mode": "${oc.env:HOME}"}), "not resolved"),
    "no state": (at("state_dict", value=None), "expected the part state_dict"),
    "no start": (at("mosa", "start", value=None), "mosa.start: expected this key, found none"),
    "newer": (at("mosa", "version", value=4), "mosa.version: expected 3, found '4': it is of another version of this program"),
    "older": (at("mosa", "version", value=2), "mosa.version: expected 3, found '2': it is of another version of this program"),
    "no version": (at("mosa", "version", value=None), "mosa.version: expected 3, found 'None'"),
    "unknown": (at("mosa", "more", value=1), "mosa.more: unknown key; expected one of settings, law"),
    "older adapter": (at("mosa", "settings", "adapter", "strain", value="log"),
              r"adapter\.strain: unknown key.*of this version of mosa, \d.*another one; learn it again"),
    "simulation": (at("mosa", "settings", "simulation", "speed", value=1), "simulation.speed: unknown key"),
    "courant": (at("mosa", "settings", "simulation", "courant", value=7), "simulation.courant: expected a number above 0"),
    "no world": (at("mosa", "world", value=None), "mosa.world: expected this key, found none"),
    "no prior": (at(*CFG, "prior", value=None), "prior: expected this key, found none"),
    "prior no section": (at(*CFG, "prior", value=[]), "prior: expected a section of keys"),
    "no rest": (at("state_dict", "body.rest", value=None), "found no rest"),
    "no weights": (at("state_dict", "body.material.raw.E", value=None), "no body can be built from it .*material.raw.E"),
    "NaN": (at("state_dict", "body.rest", value=torch.full((27, 3), float("nan"))), "body.rest: expected finite numbers"),
    "shape": (at("state_dict", "body.colors", value=torch.zeros(27, 4)), r"body.colors: expected .* found torch.float32 \(27, 4\)"),
    "whole numbers": (at("state_dict", "body.rest", value=torch.zeros(27, 3, dtype=torch.int64)), "body.rest: expected floating"),
    "no volume": (at("state_dict", "body.volume", value=torch.zeros(27)), "body.volume: expected volumes above 0"),
    "few stored": (at("state_dict", "body.rest", value=torch.zeros(1, 3).expand(10**9, 3)), "as many numbers as are stored"),
    "wide": (at(*CFG, "adapter", value={"name": "direct", "hidden": 10**9}), "adapter.hidden: expected .* at most 4096"),
    "gravity": (at("mosa", "world", "gravity", value=[0, float("nan"), 0]), "world.gravity: expected three numbers"),
    "box": (at("mosa", "world", "box", value=[[1, 1, 1], [0, 0, 0]]), "world.box: expected two corners"),
    "mirror": (at("mosa", "start", "rotation", value=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "rotation: expected a 3x3 rotation"),
    "names": (at("mosa", "starts", value={"../../x": {}}), "expected names like train"),
    "density": (at("mosa", "density", value="heavy"), "density: expected a number of at least 0.1"),
    "law": (at(*CFG, "prior", "law", value="os.system"), "law: expected one of"),
    "laughs": (at("mosa", "fit", "losses", value=nested(30, 10)), "expected at most"),
    "deep": (at("mosa", "fit", "losses", value=nested(100, 1)), "expected at most"),
    "set": (at("mosa", "fit", "losses", value={1, 2}), "refers to|expected numbers"),
    "bytes": (at("mosa", "fit", "losses", value=bytearray(b"12")), "refers to|expected numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_checkpoint_is_named_part_by_part(tmp_path, name):
    change, message = DAMAGED[name]
    with pytest.raises(DataError, match=message) as caught:
        Twin.load(checkpoint(tmp_path / "bad.ckpt", change=change))
    assert "bad.ckpt" in str(caught.value) and "\n" not in str(caught.value)


def test_a_pickle_in_a_checkpoint_runs_nothing(tmp_path):
    touched = tmp_path / "touched"
    with pytest.raises(DataError, match="refers to posix system"):
        Twin.load(
            checkpoint(
                tmp_path / "bad.ckpt", change=at("mosa", "fit", "losses", value=Runs(touched))
            )
        )
    assert not touched.exists()


def test_a_checkpoint_that_unpacks_to_more_than_itself_is_refused(tmp_path):
    good = checkpoint(tmp_path / "good.ckpt")
    with (
        zipfile.ZipFile(good) as source,
        zipfile.ZipFile(tmp_path / "bomb.ckpt", "w", zipfile.ZIP_DEFLATED) as bomb,
    ):
        for name in source.namelist():
            bomb.writestr(name, source.read(name))
        bomb.writestr("archive/data/999", bytes(10**7))
    with pytest.raises(DataError, match="unpacks to more than its"):
        Twin.load(tmp_path / "bomb.ckpt")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_checkpoint_that_was_cut_off_is_named(tmp_path, share):
    good = checkpoint(tmp_path / "good.ckpt").read_bytes()
    (tmp_path / "cut.ckpt").write_bytes(good[: int(share * len(good))])
    with pytest.raises(DataError, match=r"cut\.ckpt: not a readable checkpoint"):
        Twin.load(tmp_path / "cut.ckpt")


@pytest.mark.parametrize("path", [5, None, "no/such.ckpt", __file__, "/dev/zero", "a\0b"])
def test_what_is_no_checkpoint_is_named(path):
    with pytest.raises(DataError, match="ckpt_path"):
        Twin.load(path)


def test_stored_paths_are_not_written_to(tmp_path):
    """eval.py's scene comes from the stored configuration, its cache from eval.py alone."""
    evil = tmp_path / "evil"
    twin = Twin.load(checkpoint(tmp_path / "a.ckpt", f"scene.cache={evil}"))
    assert twin.record.settings["scene"]["cache"] == str(evil)
    cfg = OmegaConf.create({"ckpt_path": "a.ckpt", "cache": str(tmp_path / "mine"), "scene": None})
    keys = evaluated_scene(cfg, twin).scene
    assert keys.name == "tiny" and keys.cache == str(tmp_path / "mine")
    own = OmegaConf.create(
        {
            "ckpt_path": "a.ckpt",
            "cache": None,
            "scene": {"format": "builtin", "name": "tiny", "cache": "own"},
        }
    )
    assert evaluated_scene(own, twin).scene.cache == "own"  # what the user names himself is obeyed


def entry(name: str, array: np.ndarray, shape: tuple[bytes, bytes] = (b"", b"")) -> bytes:
    """An npz with one array, whose header may say another shape (was, is) in as many bytes: its padding is shortened."""
    plain, file = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array(plain, array, allow_pickle=True)
    was, now = shape
    content = plain.getvalue()
    if was:
        longer = len(now) - len(was)
        content = (
            content.replace(was, now).replace(b" " * longer + b"\n", b"\n", 1)
            if longer > 0
            else content.replace(was, now + b" " * -longer)
        )
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def test_an_npz_comes_back_as_it_was_written(tmp_path):
    write_npz(tmp_path / "a.npz", {"train/x": np.arange(6.0).reshape(2, 3)})
    assert np.array_equal(read_npz(tmp_path / "a.npz")["train/x"], np.arange(6.0).reshape(2, 3))
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_an_npz_that_cannot_be_finished_leaves_nothing(tmp_path):
    class Full:
        def __array__(self, *_, **__):
            raise OSError(28, "No space left on device")

    write_npz(tmp_path / "a.npz", {"x": np.zeros(3)})
    with pytest.raises(OSError, match="No space"):
        write_npz(tmp_path / "a.npz", {"x": np.ones(3), "y": Full()})
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"] and not read_npz(
        tmp_path / "a.npz"
    )["x"].any()


def test_a_malicious_npz_runs_nothing_and_takes_no_memory(tmp_path):
    touched, file = tmp_path / "touched", tmp_path / "a.npz"
    file.write_bytes(entry("x", np.array([Runs(touched)], dtype=object)))
    with pytest.raises(DataError, match=r"a\.npz: x\.npy: expected numbers, found object"):
        read_npz(file)
    assert not touched.exists()
    for claimed in (b"(10000000000000,)", b"(-1,)"):
        file.write_bytes(entry("x", np.zeros(100), (b"(100,)", claimed)))
        with pytest.raises(
            DataError, match="expected as many numbers as are stored, found a header of shape"
        ):
            read_npz(file)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_a_cut_npz_is_named(tmp_path, share):
    write_npz(tmp_path / "a.npz", {"x": np.random.default_rng(0).random(1000)})
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=r"a\.npz: expected a readable npz"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "tag",
    ["!!python/object/apply:os.system ['touch {}']", "!!python/object/new:pathlib.Path ['{}']"],
)
def test_a_malicious_yaml_runs_nothing(tmp_path, tag):
    (tmp_path / "prior").mkdir()
    (tmp_path / "prior" / "evil.yaml").write_text("law: " + tag.format(tmp_path / "touched") + "\n")
    with pytest.raises(yaml.constructor.ConstructorError):
        OmegaConf.load(tmp_path / "prior" / "evil.yaml")  # Hydra's reader
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"frames": [' + '{"a":' * 50_000, '{"frames": ' + "9" * 100_000 + "}"]
)
def test_a_malicious_listing_is_one_message(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(DataError, match=r"transforms\.json: expected"):
        read_transforms(tmp_path)


def test_a_flipped_bit_is_seen(tmp_path):
    """torch does not compare the sums of its archive: 58 of 60 flipped bits were other numbers without a word."""
    good, bad = checkpoint(tmp_path / "good.ckpt"), tmp_path / "bad.ckpt"
    content, body = good.read_bytes(), read_checkpoint(good)["state_dict"]["body.rest"]
    place = content.index(body.numpy().tobytes()) + 5
    bad.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
    assert not torch.equal(
        torch.load(bad, weights_only=True)["state_dict"]["body.rest"], body
    )  # what it would have been
    with pytest.raises(DataError, match=r"bad\.ckpt: damaged: its part .* is not what was written"):
        Twin.load(bad)
