"""Attacks by files that a program like this one may have written: checkpoints, npz files, caches, states of a fit."""

from __future__ import annotations

import math
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from attacks import Attack, put, refuse, stored

from mosa.config.checkpoints import RESUMED, check_resumed, read_checkpoint
from mosa.reconstruction.cache import StageCache
from mosa.system.npz import read_npz, write_npz
from mosa.twin.twin import Twin


class Touch:
    """What a pickle would run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def same(found, wanted) -> None:
    """Errors: AssertionError where nested containers hold something else."""
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys()
        for key in wanted:
            same(found[key], wanted[key])
    elif isinstance(wanted, torch.Tensor):
        assert found.numpy().tobytes() == wanted.numpy().tobytes()  # some are not numbers yet
    else:
        assert str(found) == str(wanted)


def checkpoints(folder: Path) -> Iterator[Attack]:
    target, config = folder / "touched", "mosa"

    def load(content: dict):
        torch.save(content, folder / "a.ckpt")
        Twin.load(folder / "a.ckpt").simulate(frames=2)

    bad = {"subprocess.Popen", "os.system", "builtins.eval", "mosa.twin.rollout_file.save_parts", "mosa.modules.body.body.Body",
           5, ("a",)}  # fmt: skip
    changes = [
        (
            f"{config}.settings.adapter",
            {"name": "direct", "_target_": name, "args": ["touch", str(target)]},
        )
        for name in bad
    ]
    changes += [
        (f"{config}.settings.{key}", "${oc.env:HOME}/x")
        for key in ("scene.cache", "scene.path", "prior.law", "seed")
    ]
    changes += [
        (f"{config}.{key}", ...)
        for key in (
            "settings",
            "world",
            "density",
            "dx",
            "frame_dt",
            "settings.prior",
            "settings.adapter",
            "settings.simulation",
            "settings.heterogeneity",
            "world.gravity",
            "world.box",
        )
    ]
    changes += [(key, ...) for key in ("mosa", "state_dict", "mosa.start", "mosa.start.rotation")]
    changes += [
        (f"{config}.{key}", value)
        for key in ("density", "dx", "frame_dt", "ground.height")
        for value in (math.nan, math.inf, "a", True, [1])
    ]
    changes += [
        ("mosa.fit.losses", Touch(target)),
        ("mosa.fit.losses", bytearray(9)),
        ("mosa.fit.losses", {1, 2}),
    ]
    for key, value in changes:
        yield (
            f"{key}={value if value is not ... else 'deleted'}",
            lambda k=key, v=value: load(put(stored(), k, v)),
        )
    for name in [key for key in stored()["state_dict"] if key.count(".") == 1]:
        for kind, change in {
            "gone": None,
            "NaN": lambda x: x * math.nan,
            "short": lambda x: x[:5],
            "a list": lambda x: [1],
            "expanded": lambda x: x.flatten()[:1].expand(10**10),
        }.items():

            def attack(name=name, change=change):
                state = dict(stored()["state_dict"])
                state.pop(name) if change is None else state.update({name: change(state[name])})
                load({**stored(), "state_dict": state})

            yield f"{name} {kind}", attack
    torch.save(stored(), folder / "good.ckpt")
    content = (folder / "good.ckpt").read_bytes()
    for share in np.linspace(0, 0.999, 20):

        def cut(share=share):
            (folder / "cut.ckpt").write_bytes(content[: int(share * len(content))])
            Twin.load(folder / "cut.ckpt")

        yield f"cut at {share:.0%}", cut
    for place in np.random.default_rng(0).integers(0, len(content), 20).tolist():

        def flipped(place=place):
            (folder / "flipped.ckpt").write_bytes(
                content[:place] + bytes([content[place] ^ 16]) + content[place + 1 :]
            )
            same(read_checkpoint(folder / "flipped.ckpt"), read_checkpoint(folder / "good.ckpt"))
            refuse("a byte that holds nothing")

        yield f"bit flipped in byte {place}", flipped
    yield (
        "what was named has run",
        lambda: None if target.exists() else refuse("nothing was executed or written"),
    )


def npz(folder: Path) -> Iterator[Attack]:
    file = folder / "a.npz"
    write_npz(file, {"train/x": np.random.default_rng(0).random((2, 50, 3))})
    content = file.read_bytes()

    def read(changed: bytes):
        file.write_bytes(changed)
        read_npz(file)

    for share in np.linspace(0, 0.99, 15):
        yield f"cut at {share:.0%}", lambda s=share: read(content[: int(s * len(content))])
    for shape in ("(10**9, 3)", "(-1, 3)", "(2, 50, 4)", "(99999999999,)"):

        def misshapen(shape=shape):
            with tempfile.TemporaryFile() as plain:
                np.lib.format.write_array(plain, np.zeros((2, 50, 3)))
                plain.seek(0)
                bytes_ = plain.read().replace(b"(2, 50, 3)", shape.encode())
            with zipfile.ZipFile(file, "w") as archive:
                archive.writestr("x.npy", bytes_)
            read_npz(file)

        yield f"header {shape}", misshapen
    yield (
        "objects",
        lambda: (
            np.savez(file, x=np.array([Touch(folder / "touched")], dtype=object)),
            read_npz(file),
        ),
    )


def caches(folder: Path) -> Iterator[Attack]:
    good = {"means": torch.zeros(9, 3), "scales": torch.ones(9, 3), "rotations": torch.ones(9, 4), "opacities": torch.ones(9),
            "colors": torch.ones(9, 3)}  # fmt: skip

    def remade(stored: object):
        cache = StageCache(folder, {"scene": "a"})
        torch.save(stored, cache.folder / "static.pt")
        found = cache.stage("static", lambda: good)
        if not all(torch.equal(found[key], good[key]) for key in good):
            raise AssertionError("a wrong cache was used")
        refuse("made again")

    for name, stored_ in {
        "no keys": {},
        "a list": [1],
        "short": {**good, "means": torch.zeros(3, 3)},
        "one gone": {k: v for k, v in good.items() if k != "scales"},
        "NaN": {**good, "means": torch.full((9, 3), math.nan)},
    }.items():
        yield name, lambda s=stored_: remade(s)


def resumed(_: Path) -> Iterator[Attack]:
    """Parts of a checkpoint that a fit goes on from."""
    whole = {name: {} for name in RESUMED} | {"state_dict": {}}
    own = {"stage": 2, "losses": [1.0], "steps_done": 3, "particles": 7}
    state = {"iteration": 1, "factors": [1.0], "multiple": 0.0, "noise": None}
    nan = torch.full((5, 7, 3), math.nan)
    wrong = {"cues": (5, "a", {}, {"a": 1}, [5], ["a"], [nan], [nan[0]], [nan.long()]), "misfit": ("a", 0, -1, math.nan, None),
             "stage": (-1, "a", None, True), "losses": (5, ["a"], [None], [math.nan], {}), "particles": (0, "a", None),
             "steps_done": (-1, "a"), "compared": (5, ["a"], {"corotated": "a"}, {"corotated": 1.0}),
             "identification": (5, {}, {"iteration": 1}, *(state | change for change in (
                 {"iteration": "a"}, {"factors": ["a"]}, {"factors": [0.0]}, {"multiple": math.nan}, {"noise": 5}, {"noise": [5]},
                 {"noise": [[5] * 3]}, {"grid": [[nan] * 3]})))}  # fmt: skip
    for key, values in wrong.items():
        for value in values:
            yield (
                f"{key}={value}",
                lambda k=key, v=value: check_resumed(whole | {"mosa": own | {k: v}}, "a.ckpt"),
            )
