"""Further attacks of robustness.py: what is well formed and means something else, and the newest parts. Same pairs, by group.

An error and a warning both count as a message here: what may be meant is said, and not refused.
"""

from __future__ import annotations

import contextlib
import copy
import io
import itertools
import json
import math
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from attacks import ROOT, WORLD, Attack, composed, cube, put, refuse, stored
from attacks_on_calls import configured
from attacks_on_data import capture
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from mosa.cli.experiment import arguments, run
from mosa.config.build import rehearse
from mosa.config.commands import TrainSettings
from mosa.config.effects import sentences
from mosa.config.leaf_commands import COMMANDS
from mosa.data.formats.export import export_pacnerf, export_particles
from mosa.data.scene import load_scene
from mosa.data.sequences import load_sequences
from mosa.environments.arena import simulator_named
from mosa.environments.tasks import TASKS, task_named
from mosa.training.preflight import (
    check_capture,
    check_environments,
    check_evaluation,
    check_splats,
)
from mosa.twin.batch import TwinWorlds
from mosa.twin.twin import Twin
from mosa.viewer.clips import read_run
from mosa.viewer.pages import open_server
from mosa.viewer.recorded import options

NAN, INF = math.nan, math.inf


def said(attack: Callable[[], object]) -> Callable[[], object]:
    """The attack, of which a warning is a message as an error is. A film's holes of a pixel are no attack."""

    def told():
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            warnings.filterwarnings("ignore", message=".*small enclosed holes.*")
            try:
                attack()
            except UserWarning as warning:
                refuse(str(warning))

    return told


# ---------------------------------------------------------------- films


def films(folder: Path) -> Iterator[Attack]:
    """Cameras, worlds, particles and recordings that are plausible one by one and do not belong together."""
    good = capture()
    document = json.loads((good / "transforms.json").read_text())
    entries = document["frames"]
    cameras, times = sorted({e["camera"] for e in entries}), sorted({e["time"] for e in entries})
    files = {(e["camera"], e["time"]): e["file_path"] for e in entries}

    def listing(change: Callable[[dict], object]) -> Path:
        place = folder / "listed"
        place.mkdir(exist_ok=True)
        changed = copy.deepcopy(document)
        change(changed)
        for entry in changed["frames"]:
            entry["file_path"] = str(good / entry["file_path"])
        (place / "transforms.json").write_text(json.dumps(changed))
        return place

    def load(change: Callable[[dict], object] = lambda _: None, **keys):
        return said(
            lambda: load_scene(format="transforms", path=str(listing(change)), **WORLD | keys)
        )

    def each(change: Callable[[dict], object], *chosen: str):
        return lambda d: [change(e) for e in d["frames"] if not chosen or e["camera"] in chosen]

    def times_(keys: Sequence[str], factor: float, *chosen: str):
        return each(lambda e: e.update({key: e[key] * factor for key in keys}), *chosen)

    def poses(change: Callable[[np.ndarray], np.ndarray]):
        return each(
            lambda e: e.update(transform_matrix=change(np.array(e["transform_matrix"])).tolist())
        )

    for factor in (0.3, 0.5, 0.7, 0.85, 1.5, 2, 4):
        yield f"all focal lengths x {factor}", load(times_(("fl_x", "fl_y"), factor))
    for factor in (0.2, 0.5, 0.8, 1.2, 2, 5):
        yield f"fl_x x {factor}", load(times_(("fl_x",), factor))
    for factor in (0.5, 0.8, 1.2, 2):
        yield (
            f"one camera's focal lengths x {factor}",
            load(times_(("fl_x", "fl_y"), factor, cameras[2])),
        )
    for a, b in itertools.islice(itertools.combinations(range(len(cameras)), 2), 0, 66, 4):
        other = {cameras[a]: cameras[b], cameras[b]: cameras[a]}
        yield (
            f"pictures of cameras {a} and {b} exchanged",
            load(
                each(
                    lambda e, o=other: e.update(
                        file_path=files[o.get(e["camera"], e["camera"]), e["time"]]
                    )
                )
            ),
        )
    for late in (1, 2, 3):
        yield (
            f"one camera late by {late}",
            load(
                each(
                    lambda e, n=late: e.update(
                        file_path=files[e["camera"], times[max(0, times.index(e["time"]) - n)]]
                    ),
                    cameras[3],
                )
            ),
        )
    for shift in (2, 4, 8):
        yield (
            f"principal points off by {shift} px",
            load(each(lambda e, s=shift: e.update(cx=e["cx"] + s))),
        )
    for shift in (4, 8):
        yield (
            f"one principal point off by {shift} px",
            load(each(lambda e, s=shift: e.update(cx=e["cx"] + s), cameras[3])),
        )
    for axis in range(3):
        flip = np.eye(4)
        flip[axis, axis] = -1
        yield f"mirrored along {'xyz'[axis]}", load(poses(lambda m, f=flip: f @ m @ f))
    for turned in (
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    ):
        matrix = np.eye(4)
        matrix[:3, :3] = turned
        yield f"another axis is up {turned}", load(poses(lambda m, T=matrix: T @ m))
    for angle in (20, 30, 45, 60):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        matrix = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        yield f"world tilted by {angle} degrees", load(poses(lambda m, T=matrix: T @ m))
    for height in (-0.3, -0.2, -0.1, -0.05, 0.08, 0.1, 0.2, 0.3):
        shift = np.zeros((4, 4))
        shift[1, 3] = height
        yield f"world higher by {height} m", load(poses(lambda m, S=shift: m + S))
    for name in ("k5", "k6", "s1"):
        yield f"{name} of another lens model", load(lambda d, n=name: d.update({n: 0.1}))
    yield "camera with a line break", load(each(lambda e: e.update(camera=f"{e['camera']}\nx")))
    yield "camera of 3000 letters", load(each(lambda e: e.update(camera="x" * 3000 + e["camera"])))
    yield "fourth row of a pose", load(each(lambda e: e["transform_matrix"][3].__setitem__(3, 3.0)))
    for keys in (
        {"gravity": [0, -19.6, 0]},
        {"gravity": [0, -1.62, 0]},
        {"gravity": [0, 0, 0]},
        {"gravity": [9, -0.01, 0]},
        {"gravity": [5, -8, 0]},
        {"up": [0.3, 1, 0]},
        {"up": [0, 0, 1]},
        {"ground": {"height": 0.2}},
        {"ground": {"height": 0.3}},
        {"ground": {"height": -0.09}},
        {"ground": {"height": 1e9}},
        {"ground": {"height": 0, "friction": 0.3}},
        {"box": [[-0.7, 0.05, -0.7], [0.7, 1, 0.7]]},
        {"box": [[-0.02, -0.1, -0.7], [0.7, 1, 0.7]]},
        {"density": 1},
        {"density": 7.8},
        {"last_free_frame": True},
        {"truth": 5},
        {"synthetic": True},
        {"known_parameters": {"E": 1}},
    ):
        yield f"{keys}", load(**keys)
    for path in ("~nobody_here/x", "x" * 5000, "a\0b", "\ud800", ""):
        yield (
            f"path {ascii(path)[:20]}",
            said(lambda p=path: load_scene(format="transforms", path=p, **WORLD)),
        )
    yield from particles(folder, load)
    yield from recordings(folder, good, listing)
    yield from pacnerf(folder)


def particles(folder: Path, load: Callable) -> Iterator[Attack]:
    """True particles in other units, axes, orders."""
    positions = load_scene(format="builtin", name="rabbit", scale=0.2).truth.positions
    wrong = {
        "millimetres": lambda x: 1e3 * x,
        "z up": lambda x: x[..., [0, 2, 1]],
        "late": lambda x: x.roll(2, 0),
        "backwards": lambda x: x.flip(0),
        "beside": lambda x: x + torch.tensor([0.05, 0, 0]),
        "one": lambda x: x[:, :1],
        "at rest": lambda x: x[:1].expand_as(x),
        "a point": lambda x: x.mean(1, keepdim=True).expand(-1, 9, -1),
        "half as large": lambda x: x.mean(1, keepdim=True) + 0.1 * (x - x.mean(1, keepdim=True)),
        "of nine frames": lambda x: x[:9],
    }
    for name, change in wrong.items():

        def attack(change=change):
            shutil.rmtree(folder / "ply", ignore_errors=True)
            export_particles(change(positions), folder / "ply")
            load(particles=str(folder / "ply"))()

        yield f"particles {name}", attack


def recordings(folder: Path, good: Path, listing: Callable) -> Iterator[Attack]:
    """Held-out recordings that are not."""

    def sequences(test: list, also: Sequence = (), **keys):
        return said(
            lambda: load_sequences(
                {
                    "format": "transforms",
                    "path": str(good),
                    **WORLD,
                    "test": test,
                    "also_train": list(also),
                    **keys,
                }
            )
        )

    shutil.rmtree(folder / "copy", ignore_errors=True)
    shutil.copytree(good, folder / "copy")
    copied = str(folder / "copy")
    yield "test is a copy", sequences([copied])
    yield (
        "test is a listing of the same pictures",
        sequences([str(listing(lambda d: d["frames"].reverse()))]),
    )
    yield "test shares frames", sequences([{"path": copied, "frames": [3, 12]}], frames=[0, 10])
    yield "also_train is a copy", sequences([], [copied])
    yield "test is also_train", sequences([copied], [copied])
    for entry in (
        5,
        {"path": 5},
        {"path": copied, "name": "../x"},
        {"path": copied, "ground": None},
    ):
        yield f"test {str(entry)[-30:]}", sequences([entry])


def pacnerf(folder: Path) -> Iterator[Attack]:
    """The same mistakes in PAC-NeRF's layout."""
    good = export_pacnerf(
        load_scene(format="transforms", path=str(capture()), **WORLD), folder / "pacnerf"
    )
    entries = json.loads((good / "all_data.json").read_text())

    def changed(change: Callable[[dict], object], **keys):
        def attack():
            place = folder / "pacnerf_changed"
            place.mkdir(exist_ok=True)
            if not (place / "data").exists():
                (place / "data").symlink_to(good / "data")
            listed = copy.deepcopy(entries)
            for entry in listed:
                change(entry)
            (place / "all_data.json").write_text(json.dumps(listed))
            load_scene(format="pacnerf", path=str(place), **WORLD | keys)

        return said(attack)

    for i, j, value in (
        (0, 1, 30.0),
        (2, 2, 2.0),
        (2, 0, 0.5),
        (0, 0, 100.0),
        (1, 0, 9.0),
        (0, 0, -200.0),
        (0, 2, 500.0),
    ):
        yield (
            f"intrinsic[{i}][{j}]={value}",
            changed(lambda e, i=i, j=j, v=value: e["intrinsic"][i].__setitem__(j, v)),
        )
    yield (
        "intrinsics transposed",
        changed(lambda e: e.update(intrinsic=np.array(e["intrinsic"]).T.tolist())),
    )
    yield "fourth row of a pose", changed(lambda e: e.update(c2w=[*e["c2w"], [0, 0, 0, 2]]))
    yield "poses scaled", changed(lambda e: e.update(c2w=(2 * np.array(e["c2w"])).tolist()))
    yield (
        "OpenCV's axes",
        changed(lambda e: e.update(c2w=(np.array(e["c2w"]) * [1, -1, -1, 1]).tolist())),
    )
    for factor in (0.25, 0.5, 2, 4):
        yield f"times x {factor}", changed(lambda e, f=factor: e.update(time=f * e["time"]))
    for key, value in (
        ("time", "0"),
        ("time", None),
        ("file_path", 5),
        ("file_path", "x.png"),
        ("c2w", None),
        ("intrinsic", [1]),
    ):
        yield f"{key}={value}", changed(lambda e, k=key, v=value: e.update({k: v}))


# ---------------------------------------------------------------- checkpoints that make no sense, and environments


def senseless(folder: Path) -> Iterator[Attack]:
    """Finite numbers of a stranger that no run would have written."""

    def load(content: dict):
        torch.save(content, folder / "a.ckpt")
        Twin.load(folder / "a.ckpt").simulate(frames=2)

    config = "mosa.config."
    for key, values in {
        "world.gravity": ([0, 9.8, 0], [0, -1e6, 0], [9.8, 0, 0]),
        "world.up": ([0, 0, 1], [0, -1, 0]),
        "world.box": ([[-1e9] * 3, [1e9] * 3], [[1, 1, 1], [-1, -1, -1]], [[5, 5, 5], [6, 6, 6]]),
        "frame_dt": (1e-9, 1e9, -1, 0),
        "density": (1e-9, 1e30, -5),
        "dx": (1e-9, 1e9, -1),
        "world.ground.height": (1e9, -1e9),
        "world.ground.friction": (-1, INF),
        "world.ground.mode": ("x",),
        "cfg.simulation.courant": (1e-9, 50),
        "cfg.simulation.stride": (10**9,),
        "cfg.simulation.precision": (16,),
        "cfg.prior.parameters.E": (1e30, -1),
        "starts.train.center": ([1e9, 0],),
    }.items():
        for value in values:
            yield f"{key}={value}", lambda k=config + key, v=value: load(put(stored(), k, v))
    state = stored()["state_dict"]
    changes = {
        "x 1e6": lambda x: 1e6 * x,
        "negative": lambda x: -x - 0.1,
        "+ 1e30": lambda x: x + 1e30,
        "complex": lambda x: x + 0j,
        "whole": lambda x: x.long(),
        "half": lambda x: x.half(),
        "flags": lambda x: x.bool(),
    }
    for name in ("volume", "opacities", "covariances"):
        for kind, change in changes.items():
            yield (
                f"{name} {kind}",
                lambda n=f"body.{name}", c=change: load(
                    {**stored(), "state_dict": {**state, n: c(state[n].clone())}}
                ),
            )
    for name in [name for name in state if state[name].is_floating_point() and name.count(".") > 1][
        :20
    ]:
        for kind in ("complex", "whole", "half", "flags"):
            yield (
                f"{name} {kind}",
                lambda n=name, c=changes[kind]: load(
                    {**stored(), "state_dict": {**state, n: c(state[n].clone())}}
                ),
            )
    yield (
        "colours of 1e6",
        lambda: load(
            {**stored(), "state_dict": {**state, "body.colors": 1e6 * state["body.colors"]}}
        ),
    )
    torch.save(stored(), folder / "good.ckpt")
    for device in ("nope", "meta", "cpu:7", "cuda:99", 5, None, ""):
        yield f"device={device}", lambda d=device: Twin.load(folder / "good.ckpt", d)


def environments(folder: Path) -> Iterator[Attack]:
    """Truths, tasks and their configuration."""

    def truth(content: dict, **keys):
        torch.save(content, folder / "a.ckpt")
        simulator_named("truth", folder / "a.ckpt", **{"spacing": 0.05} | keys)

    built = {"format": "builtin", "name": "tiny"}
    for scene in (
        ...,
        5,
        None,
        {},
        [],
        "tiny",
        {"format": "builtin"},
        built | {"name": 5},
        built | {"name": "../x"},
        built | {"material": 5},
        built | {"seed": "a"},
        built | {"seed": -1},
        built | {"seed": 1e300},
        {"format": ["builtin"]},
        {"format": "transforms", "path": "/etc"},
    ):
        yield (
            f"stored scene {scene}",
            lambda s=scene: truth(put(stored(), "mosa.config.cfg.scene", s)),
        )
    for key, values in {
        "spacing": (0, -1, NAN, "a", 1e9, True, 0.5, 1e-9),
        "scene": ("nope", 5, "../x"),
        "device": ("nope", 5, "meta"),
    }.items():
        for value in values:
            yield (
                f"truth {key}={value}",
                lambda k=key, v=value: simulator_named(
                    "truth", **{"scene": "tiny", "spacing": 0.05} | {k: v}
                ),
            )
    for name in (5, None, ["learned"], "Learned", ""):
        yield f"simulator {name}", lambda n=name: simulator_named(n, "a.ckpt")
    for file in (5, "", "nope.ckpt", folder):
        yield f"checkpoint {str(file)[-9:]}", lambda f=file: simulator_named("learned", f)
    rest = torch.rand(50, 3) * 0.2
    for name, task in TASKS.items():
        for field in task.__dataclass_fields__.values():
            if "ClassVar" in str(field.type) or field.name == "extents":
                continue
            for value in (-1, NAN, 1e9, "a", None, [1]):
                yield (
                    f"{name}.{field.name}={value}",
                    lambda n=name, f=field.name, v=value: task_named(n, rest, **{f: v}),
                )
        yield f"{name}.foo", lambda n=name: task_named(n, rest, foo=1)
    yield "low above high", lambda: task_named("hanging", rest, low=0.5, high=0.2)
    yield "close above far", lambda: task_named("hanging", rest, close=0.5, far=0.2)


# ---------------------------------------------------------------- a twin's other calls


def stepping(folder: Path) -> Iterator[Attack]:
    """Reset, step, state, worlds and export."""
    twin = copy.copy(cube())
    pad = {"type": "box", "name": "pad", "size": [0.05, 0.2, 0.2], "position": [-0.3, 0.1, 0]}

    def step(action, **keys):
        twin.reset(**{"height": 0.05, "colliders": [pad], "control_dt": 0.02} | keys)
        twin.step(action)

    for position in (
        (0, -0.05, 0),
        (0, 0, 0),
        (0, 0.02, 0),
        (0, -1, 0),
        (NAN, 0, 0),
        (1e9, 0, 0),
        (0, 1),
        "abc",
        5,
        {},
    ):
        yield f"position={position}", lambda p=position: twin.simulate(frames=2, position=p)
    for key, values in {
        "control_dt": (0, -1, NAN, INF, "a", 1e9, True),
        "substeps": (0, -1, NAN, "a", 10**9, True, 1.5),
        "frames": (0, "a", None),
        "differentiable": ("a", 5, None),
        "colliders": (5, [{"type": "sphere"}]),
    }.items():
        for value in values:
            yield f"reset {key}={value}", lambda k=key, v=value: step(None, **{k: v})
    for command in (
        5,
        "abc",
        (1, 2),
        (NAN, 0, 0),
        (INF, 0, 0),
        (1e9, 0, 0),
        {},
        {"velocity": None},
        {"foo": 1},
        {"position": (0, 0)},
        {"position": (NAN, 0, 0)},
        {"rotation": (2 * np.eye(3)).tolist()},
        {"angular_velocity": (0, 0, 1e9)},
        None,
        {"velocity": (1, 0, 0), "position": (0, 0, 0)},
    ):
        yield f"step {command}", lambda c=command: step({"pad": c})
    for action in (5, "a", {"nope": (0, 0, 0)}, {5: (0, 0, 0)}):
        yield f"action {action}", lambda a=action: step(a)
    for state in (5, None, {}):

        def set_state(state=state):
            twin.reset(height=0.05)
            twin.state = state

        yield f"state={state}", set_state
    for count in (0, -1, 1.5, "a", True, None):
        yield f"worlds({count})", lambda n=count: twin.worlds(n)
    for laws in (5, "a", torch.zeros(3, 1), torch.zeros(2)):
        yield f"laws {laws}", lambda v=laws: twin.worlds(2, laws=v)
    for starts in (5, "a", [5, 5], [{}] * 3, [{"foo": 1}, {}], [{"height": -1}, {}]):
        yield (
            f"worlds' starts {starts}",
            lambda s=starts: TwinWorlds(
                twin.body, twin.world, twin.frame_dt, twin.training_start, 2
            ).reset(s),
        )
    for which in (5, [5], [-1], ["a"]):

        def restart(which=which):
            worlds = twin.worlds(2)
            worlds.reset([{"height": 0.05}] * 2)
            worlds.restart(which)

        yield f"restart {which}", restart
    rollout = twin.simulate(frames=2)
    (folder / "file").write_text("")
    for where, formats in (
        (folder / "x", ["nope"]),
        (folder / "x", "ply"),
        (folder / "x", 5),
        (folder / "x", [None]),
        (folder / "file", ["ply"]),
        ("/proc/x", ["ply"]),
        (5, ["ply"]),
    ):
        yield (
            f"export {str(where)[-5:]} {formats}",
            lambda w=where, f=formats: twin.export(rollout, w, video=False, formats=f),
        )


# ---------------------------------------------------------------- folders and arguments of the viewer


@cache
def exported() -> Path:
    twin = cube()
    return twin.export(twin.simulate(frames=3), Path(tempfile.mkdtemp()) / "falling", video=False)


def viewer(folder: Path) -> Iterator[Attack]:
    """Damaged folders of an exported motion, and the page's arguments."""

    def shown(file: str, change: Callable[[dict], object]):
        def attack():
            place = folder / "falling"
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(exported(), place)
            with np.load(place / file) as found:
                parts = dict(found)
            change(parts)
            np.savez(place / file, **parts)
            read_run(place)

        return attack

    changes = {
        "gone": None,
        "NaN": lambda x: x * NAN,
        "short": lambda x: x[:1],
        "flat": lambda x: x.reshape(-1)[:1],
        "texts": lambda x: x.astype(str),
        "whole numbers": lambda x: x.astype(int),
        "huge": lambda x: x * 1e30,
    }
    for file in ("body.npz", "rollout.npz"):
        with np.load(exported() / file) as found:
            parts = {name: value for name, value in found.items() if value.ndim}
        for name in parts:
            optional = name.split("/")[-1] not in (
                "rest",
                "volume",
                "colors",
                "opacities",
                "covariances",
                "factor",
                "up",
                "x",
                "times",
                "F_tot",
            )
            for kind, change in changes.items():
                harmless = (
                    optional
                    or (kind == "gone" and name.endswith("F_tot"))
                    or (
                        kind == "huge"
                        and name.split("/")[-1]
                        in ("up", "factor", "times", "rest", "x", "F_tot", "volume")
                    )
                )
                if not harmless:

                    def changed(p, n=name, c=change):
                        p.pop(n) if c is None else p.update({n: c(p[n])})

                    yield f"{file}: {name} {kind}", shown(file, changed)
    for file, content in (
        ("rollout.npz", b""),
        ("rollout.npz", b"hello"),
        ("body.npz", b""),
        ("body.npz", b"PK"),
    ):

        def spoiled(file=file, content=content):
            place = folder / "spoiled"
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(exported(), place)
            (place / file).write_bytes(content)
            read_run(place)

        yield f"{file} is {content}", spoiled
    for words in (
        ["port=0"],
        ["port=²"],
        ["port=-1"],
        ["port=99999"],
        ["port=a"],
        ["live=maybe"],
        ["foo=1"],
        ["run"],
        [],
        ["--live"],
        ["host=", "port=8080"],
    ):
        yield f"arguments {words}", lambda w=words: options(w)
    for host in ("", "999.1.1.1", "a\0b", "x" * 500, "nowhere.invalid"):
        yield f"host {host[:9]!r}", lambda h=host: open_server(h, 8080)


# ---------------------------------------------------------------- configurations of the other commands


@cache
def other(name: str, *overrides: str) -> dict:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return OmegaConf.to_container(compose(name, overrides=list(overrides)), resolve=False)


def commands(_: Path) -> Iterator[Attack]:
    """Keys of mosa-capture, mosa-environments, mosa-splats and mosa-eval."""
    odd = (-1, NAN, INF, True, "abc", [1], {"a": 1}, 1e300)
    known = {
        "capture": (
            check_capture,
            (
                "fps",
                "readout",
                "max_offset",
                "flight",
                "gravity",
                "scale",
                "up",
                "ground",
                "rate",
                "before",
                "after",
                "interpolation",
                "colours",
                "mattes",
                "scan",
                "phones",
                "plate_seconds",
            ),
        ),
        "environments": (
            check_environments,
            (
                "seed",
                "seeds",
                "trials",
                "worlds",
                "decisions",
                "truth.spacing",
                "search.iterations",
                "search.batch",
                "search.rate",
                "search.clip",
                "search.candidates",
                "search.every",
                "search.validation",
                "search.spread",
                "options",
            ),
        ),
        "splats": (
            check_splats,
            (
                "size",
                "up",
                "box",
                "opacity",
                "open_below",
                "resolution",
                "share",
                "density",
                "gravity",
                "height",
                "rotation",
                "velocity",
                "angular_velocity",
                "frames",
                "rate",
                "formats",
                "video",
            ),
        ),
        "eval": (
            check_evaluation,
            (
                "plan",
                "appearance",
                "simulate.velocity",
                "simulate.rotation",
                "simulate.position",
                "simulate.frames",
                "simulate.variant",
                "simulate.colliders",
                "evaluation.samples",
            ),
        ),
    }
    required = {
        "capture": ("videos=a", "poses=b", "output=c"),
        "splats": ("ply=a",),
        "eval": ("ckpt_path=a",),
        "environments": (),
    }
    for name, (check_it, keys) in known.items():
        for key in keys:
            for value in odd:
                if (value is True and key in ("open_below", "video")) or (key, value) == (
                    "seeds",
                    [1],
                ):
                    continue  # which they may be
                if key in ("phones", "options") and isinstance(value, dict):
                    continue
                yield (
                    f"{name}: {key}={value}",
                    lambda n=name, c=check_it, k=key, v=value: c(put(other(n, *required[n]), k, v)),
                )
    for name in known:
        yield (
            f"{name}: foo",
            lambda n=name: COMMANDS[n].read(other(n, *required[n]) | {"foo": 1}),
        )


def experiments(folder: Path) -> Iterator[Attack]:
    """Arguments of mosa-experiment, of which none begins a job."""
    for words in (
        ["nope"],
        ["../../x"],
        ["table_time", "--seeds", "a"],
        ["table_time", "--seeds", ""],
        ["table_time", "--seeds=-1"],
        ["table_time", "--seeds", "0,0"],
        ["table_time", "--seeds", "9" * 20],
        ["table_time", "--jobs", "0"],
        ["table_time", "--devices", "x"],
        ["table_time", "--devices", "0,0"],
        ["table_time", "--only", "scene"],
        ["table_time", "--only", "scene=nope"],
        ["table_time", "--only", "nope=1"],
        ["table_time", "--set", "foo"],
        ["table_time", "--set", "+foo=1"],
        ["table_time", "--set", "hydra.run.dir=/x"],
        ["table_time", "--set", "seed=3"],
        ["table_time", "--set", "resume=null"],
        ["table_time", "--set", "simulation.stride=-1"],
        ["table_time", "--set", "fit=nope"],
        ["table_time", "--set", "a=b=c"],
    ):
        yield f"{words}", lambda w=words: silently(lambda: run(arguments([*w, "--dry-run"])))
    (folder / "file").write_text("")
    for flag in ("--runs", "--results"):
        for place in ("/proc/x", str(folder / "file" / "x")):
            yield (
                f"{flag} {place[-6:]}",
                lambda f=flag, p=place: silently(
                    lambda: run(arguments(["table_time", "--collect", f, p]))
                ),
            )


def silently(call: Callable[[], object]) -> object:
    """Without what it prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        return call()


def idle_keys(_: Path) -> Iterator[Attack]:
    """Keys that are set and do nothing: each has to be said."""
    for overrides in (
        ["losses.flow=0"],
        ["losses.image=0"],
        ["losses.mask=2"],
        ["losses.operator=1"],
        ["fit.views=3"],
        ["fit.clip=2"],
        ["fit.prior.lr=0.2"],
        ["fit.joint.lr_adapter=0.2"],
        ["ablation=no_flow"],
        ["heterogeneity.hidden=8"],
        ["heterogeneity.frequencies=3"],
        ["fit=adam", "identification.count=5"],
        ["criterion=free", "criterion.gain=0.2"],
        ["simulation.min_substeps=3"],
        ["simulation.dx=0.01", "simulation.particles=500"],
        ["heterogeneity.enabled=false", "heterogeneity.most=9"],
        ["reconstruction.static.max_points=9000"],
        ["reconstruction.geometry.source=hull", "reconstruction.geometry.frames=3"],
        ["reconstruction.carried.iterations=0", "reconstruction.carried.degree=2"],
        ["reconstruction.informed.iterations=0", "reconstruction.informed.elastic=1"],
    ):

        def attack(overrides=tuple(overrides)):
            values = composed(*overrides)
            for sentence in sentences(overrides, TrainSettings.read(values), rehearse(values)):
                refuse(sentence)

        yield " ".join(overrides), attack
    for key in (
        "losses.image",
        "fit.clip",
        "fit.joint.lr",
        "identification.count",
        "identification.operator_sd",
        "simulation.dx",
        "evaluation.samples",
        "reconstruction.static.views",
        "reconstruction.neighbours",
        "prior.parameters.E",
    ):

        def huge(key=key):
            configured(put(composed(), key, 10**30))

        yield f"{key}=1e30", huge


def sections(_: Path) -> Iterator[Attack]:
    """Something else in the place of every section, and every section left out."""

    def below(tree: dict, above: str = "") -> Iterator[str]:
        for key, value in tree.items():
            if isinstance(value, dict) and key != "hydra":
                yield f"{above}{key}"
                yield from below(value, f"{above}{key}.")

    config = composed()
    for path in below({key: value for key, value in config.items() if key != "scene"}):
        for value in (5, "abc", [[{}], 1], True, NAN, {"foo": 1}):
            if path not in (
                "ckpt_path",
                "logger.tensorboard",
                "logger.csv",
                "logger",
            ) or not isinstance(value, dict):
                yield f"{path}={value}", lambda p=path, v=value: configured(put(config, p, v))


MORE = {
    "sections": sections,
    "films": films,
    "senseless": senseless,
    "environments": environments,
    "stepping": stepping,
    "viewer": viewer,
    "commands": commands,
    "experiments": experiments,
    "idle": idle_keys,
}
