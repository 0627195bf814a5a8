"""Attacks by captures: listings, images, poses, meshes and splats."""

from __future__ import annotations

import copy
import json
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from attacks import WORLD, Attack, cube

from mosa.capture.poses import read_phones, scene_points
from mosa.capture.world import read_world
from mosa.data.formats.export import export_transforms
from mosa.data.io.gaussian_ply import load_ply
from mosa.data.scene import load_scene
from mosa.physics.contact.mesh import field_of_mesh


@cache
def capture() -> Path:
    """The built-in rabbit's film as a folder of the layout `transforms`."""
    folder = Path(tempfile.mkdtemp()) / "capture"
    return export_transforms(load_scene(format="builtin", name="rabbit", scale=0.2), folder)


def data(folder: Path) -> Iterator[Attack]:
    good = capture()
    document = json.loads((good / "transforms.json").read_text())
    load = lambda path=good, **keys: load_scene(format="transforms", path=str(path), **WORLD | keys)  # noqa: E731
    cameras = sorted({entry["camera"] for entry in document["frames"]})
    times = sorted({entry["time"] for entry in document["frames"]})

    def listing(change: Callable[[dict], object], raw: str | None = None):
        def attack():
            copied = folder / "capture"
            shutil.rmtree(copied, ignore_errors=True)
            shutil.copytree(good, copied)
            changed = copy.deepcopy(document)
            change(changed)
            (copied / "transforms.json").write_text(json.dumps(changed) if raw is None else raw)
            load(copied)

        return attack

    def retimed(order: dict[float, float]):
        return listing(
            lambda d: [e.update(time=order.get(e["time"], e["time"])) for e in d["frames"]]
        )

    def painted(change: Callable[[np.ndarray], np.ndarray], *chosen: tuple[str, float]):
        def attack():
            copied = folder / "capture"
            shutil.rmtree(copied, ignore_errors=True)
            shutil.copytree(good, copied)
            for entry in document["frames"]:
                if not chosen or (entry["camera"], entry["time"]) in chosen:
                    file = next(
                        (copied / Path(entry["file_path"]).parent).glob(
                            Path(entry["file_path"]).name + "*"
                        )
                    )
                    cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))
            load(copied)

        return attack

    opaque = lambda p: np.concatenate([p[..., :3], np.full_like(p[..., 3:], 255)], -1)  # noqa: E731
    yield "film backwards", retimed(dict(zip(times, times[::-1])))
    yield "times negated", listing(lambda d: [e.update(time=-e["time"]) for e in d["frames"]])
    for i, j in ((2, 3), (1, 4), (3, 9)):
        yield f"frames {i} and {j} swapped", retimed({times[i]: times[j], times[j]: times[i]})
    for fps in (5, 12, 200, 500, 1e9):
        yield f"fps={fps:g}", lambda f=fps: load(fps=f)
    for unit in (1e-6, 1e-3, 0.1, 10, 1e3, 1e6):

        def scaled(d, unit=unit):
            for entry in d["frames"]:
                for row in entry["transform_matrix"][:3]:
                    row[3] *= unit

        yield f"poses x {unit:g}", listing(scaled)
        whole = listing(scaled)
        yield f"world x {unit:g}", lambda s=whole, u=unit: at_scale(s, u)
    yield "one opaque matte", painted(opaque, (cameras[1], times[3]))
    yield "one opaque matte in frame 0", painted(opaque, (cameras[1], times[0]))
    yield "all opaque", painted(opaque)
    yield (
        "cut by the border",
        painted(lambda p: np.roll(p, p.shape[0] // 2 + 8, 0)[: p.shape[0]] * 0 + np.roll(p, 40, 1)),
    )
    for value in ("1.0", True, None, [1], {}, math.nan, 1e300):
        yield (
            f"pose {value}",
            listing(lambda d, v=value: d["frames"][3]["transform_matrix"][0].__setitem__(1, v)),
        )
    for key in ("file_path", "transform_matrix", "time"):
        for value in (5, "x" * 5000, "a\0b", [], None, True, "../../../etc/passwd"):
            yield (
                f"{key}={str(value)[:20]}",
                listing(lambda d, k=key, v=value: d["frames"][2].__setitem__(k, v)),
            )
    for raw in ("[" * 100_000, "{}", "", "null", '{"frames": 5}', '{"frames": [5]}', "1" * 10_000):
        yield f"listing {raw[:12]}", listing(lambda d: None, raw)
    for key, value in (("density", 1e30), ("density", True), ("density", "a"), ("box", [[-1e6] * 3, [1e6] * 3]), ("box", 5),
                       ("gravity", [0, "a", 0]), ("gravity", [True, -9, 0]), ("ground", {"height": math.nan}), ("scale", 1e-9),
                       ("ground", {"height": True}), ("ground", {"height": 0, "mode": "separate", "friction": math.inf}),
                       ("path", 5), ("name", "../../evil"), ("name", "a/b"), ("holdout_cameras", 5), ("frames", "all"),
                       ("up", [0, 0, 0]), ("fps", "a"), ("fps", True), ("particles", 5)):  # fmt: skip
        keys = {"path": str(good)} | WORLD | {key: value}
        yield f"{key}={value}", lambda k=keys: load_scene(format="transforms", **k)
    yield from more_data(listing, painted, load, document)


def more_data(
    listing: Callable, painted: Callable, load: Callable, document: dict
) -> Iterator[Attack]:
    """Files of pictures, mattes, lenses, poses, times and lists that are wrong in other ways."""
    entries = document["frames"]
    fourth = (entries[3]["camera"], entries[3]["time"])

    def spoiled(change: Callable[[Path], object]):
        """The capture with one picture changed as a file."""

        def attack():
            with tempfile.TemporaryDirectory() as place:
                copied = Path(place) / "capture"
                shutil.copytree(capture(), copied)
                name = Path(entries[3]["file_path"])
                change(next((copied / name.parent).glob(name.name + "*")))
                load(copied)

        return attack

    for share in (0.0, 0.05, 0.3, 0.7, 0.95):
        yield (
            f"picture cut at {share:.0%}",
            spoiled(lambda f, s=share: f.write_bytes(f.read_bytes()[: int(s * f.stat().st_size)])),
        )
    for name, content in (
        ("text", b"hello"),
        ("zeros", bytes(5000)),
        ("gif header", b"GIF89a" + bytes(20)),
        ("svg", b"<svg/>"),
    ):
        yield f"picture is {name}", spoiled(lambda f, c=content: f.write_bytes(c))
    yield "picture is gone", spoiled(Path.unlink)
    yield "picture is a folder", spoiled(lambda f: (f.unlink(), f.mkdir()))
    yield "picture is a link to itself", spoiled(lambda f: (f.unlink(), f.symlink_to(f)))
    for name, change in (("another size", lambda p: p[:-7, :-9]), ("one pixel", lambda p: p[:1, :1]), ("a row", lambda p: p[:1]),
                         ("transposed and cut", lambda p: p.transpose(1, 0, 2)[:50]), ("three channels", lambda p: p[..., :3]),
                         ("gray", lambda p: p[..., 0])):  # fmt: skip
        yield f"a picture of {name}", painted(change, fourth)
    empty = lambda p: np.concatenate([p[..., :3], np.zeros_like(p[..., 3:])], -1)  # noqa: E731

    def dot(p):
        made = empty(p)
        made[40, 40, 3] = 255
        return made

    yield "one empty matte in frame 0", painted(empty, (entries[0]["camera"], 0.0))
    yield "all mattes empty", painted(empty)
    yield "all mattes one pixel", painted(dot)
    yield (
        "all mattes inverted",
        painted(lambda p: np.concatenate([p[..., :3], 255 - p[..., 3:]], -1)),
    )
    yield (
        "frame 0 without the object",
        painted(empty, *[(e["camera"], e["time"]) for e in entries if e["time"] == 0]),
    )
    yield "all pictures upside down", painted(lambda p: p[::-1])
    yield (
        "mattes of noise",
        painted(
            lambda p: np.concatenate(
                [
                    p[..., :3],
                    np.random.default_rng(0).integers(0, 256, p[..., 3:].shape, dtype=np.uint8),
                ],
                -1,
            )
        ),
    )

    def every(key, value):
        return listing(lambda d: [e.update({key: value}) for e in d["frames"]])

    for key in ("fl_x", "fl_y", "cx", "cy"):
        for value in (0, -200.0, math.nan, math.inf, "a", True):
            if (key, value) not in (("cx", 0), ("cy", 0), ("cx", -200.0), ("cy", -200.0)):
                yield f"{key}={value}", every(key, value)
    for key, value in (("w", 0), ("w", 79), ("h", -80), ("h", "a"), ("w", 10**9)):
        yield f"{key}={value}", listing(lambda d, k=key, v=value: d.update({k: v}))
    for name, matrix in (("zeros", np.zeros((4, 4))), ("3 rows", np.eye(4)[:3]), ("2 x 2", np.eye(2)), ("all alike", np.eye(4)),
                         ("mirror", np.diag([1, 1, -1, 1.0])), ("twice as large", np.diag([2.0, 2, 2, 1])),
                         ("empty", np.zeros((0, 0))),
                         ("last row", np.vstack([np.eye(4)[:3], [[0, 0, 1, 1]]]))):  # fmt: skip
        yield f"poses: {name}", every("transform_matrix", matrix.tolist())
    for name, times in (("all alike", lambda t: 0.0), ("squared", lambda t: t**2), ("from 1e9 on", lambda t: t + 1e9),
                        ("infinite", lambda t: math.inf), ("words", str), ("of a microsecond", lambda t: t * 1e-6)):  # fmt: skip
        yield (
            f"times {name}",
            listing(lambda d, f=times: [e.update(time=f(e["time"])) for e in d["frames"]]),
        )
    first = entries[0]["camera"]
    yield (
        "one camera",
        listing(lambda d: d.update(frames=[e for e in d["frames"] if e["camera"] == first])),
    )
    yield (
        "one frame",
        listing(lambda d: d.update(frames=[e for e in d["frames"] if e["time"] == 0])),
    )
    yield "no frame", listing(lambda d: d.update(frames=[]))
    yield "a frame twice", listing(lambda d: d["frames"].append(d["frames"][5]))
    yield "one picture missing in the list", listing(lambda d: d["frames"].pop(17))
    yield "without times", listing(lambda d: [e.pop("time") for e in d["frames"]])
    yield "without cameras", listing(lambda d: [e.pop("camera") for e in d["frames"]])
    yield (
        "all one picture",
        listing(lambda d: [e.update(file_path=d["frames"][0]["file_path"]) for e in d["frames"]]),
    )
    wrong = {"frames": ([5, 2], [0, 10**9], [0.5, 3]), "last_free_frame": (99,), "fill_holes": (-1,), "scale": (2, "a"),
             "holdout_cameras": (list(range(12)), [99]), "holdout_frames": (list(range(15)),), "density": (-1, 0)}  # fmt: skip
    for key, value in ((key, value) for key, values in wrong.items() for value in values):
        yield f"{key}={value}", lambda k=key, v=value: load(**{k: v})


def at_scale(attack: Callable, unit: float):
    """An attack in a world of which everything is in another unit."""
    saved = copy.deepcopy(WORLD)
    WORLD.update(box=(np.array(saved["box"]) * unit).tolist())
    try:
        attack()
    finally:
        WORLD.update(saved)


def meshes(folder: Path) -> Iterator[Attack]:
    head = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    texts = {
        "empty": "",
        "no face": "v 0 0 0\n",
        "open": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "NaN": "v nan 0 0\nf 1 1 1\n",
        "index": "v 0 0 0\nf 1 2 9\n",
        "text": "v a b c\n",
        "huge": "v 1e300 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 3 2 1\n",
    }
    for name, text in texts.items():
        yield (
            f"obj {name}",
            lambda t=text: ((folder / "m.obj").write_text(t), field_of_mesh(folder / "m.obj")),
        )
    yield from more_meshes(folder)
    for name, text in {
        "empty": "",
        "text": "hello",
        "4e12 vertices": head.format(n=4 * 10**12) + "0 0 0\n",
        "-1": head.format(n=-1),
        "cut": head.format(n=9) + "0 0 0\n",
    }.items():
        yield (
            f"ply {name}",
            lambda t=text: ((folder / "m.ply").write_text(t), field_of_mesh(folder / "m.ply")),
        )
        yield (
            f"splats {name}",
            lambda t=text: ((folder / "s.ply").write_text(t), load_ply(folder / "s.ply")),
        )


CUBE = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def cube_obj(vertices=CUBE, faces=SIDES, offset: int = 1) -> str:
    lines = ["v " + " ".join(map(str, v)) for v in vertices]
    return "\n".join(lines + ["f " + " ".join(str(i + offset) for i in f) for f in faces]) + "\n"


def more_meshes(folder: Path) -> Iterator[Attack]:
    """Cubes that are no solids, keys that make no lattice, and PLY files that lie about themselves."""
    scaled = lambda s: [tuple(s * c for c in v) for v in CUBE]  # noqa: E731
    texts = {
        "inwards": cube_obj(faces=[f[::-1] for f in SIDES]), "one side missing": cube_obj(faces=SIDES[1:]),
        "one side turned": cube_obj(faces=[SIDES[0][::-1], *SIDES[1:]]), "one side twice": cube_obj(faces=[*SIDES, SIDES[0]]),
        "flat": cube_obj([(x, y, 0) for x, y, _ in CUBE]), "a point": cube_obj([(0, 0, 0)] * 8), "zero based": cube_obj(offset=0),
        "infinite": cube_obj([(math.inf, 0, 0), *CUBE[1:]]), "1e30 wide": cube_obj(scaled(1e30)),
        "1e-30 wide": cube_obj(scaled(1e-30)),
        "two numbers": "v 0 0\nf 1 1 1\n", "faces of two": cube_obj(faces=[f[:2] for f in SIDES]), "no vertices": "f 1 2 3\n",
        "index 1e18": cube_obj() + "f 1 2 1000000000000000000\n", "index 0.5": cube_obj() + "f 1 2 0.5\n", "bytes": "\0" * 3000,
        "one line of 1e6": "v " + "1 " * 10**6,
    }  # fmt: skip
    for name, text in texts.items():
        yield (
            f"obj {name}",
            lambda t=text: ((folder / "m.obj").write_text(t), field_of_mesh(folder / "m.obj")),
        )
    (folder / "good.obj").write_text(cube_obj())
    for key, values in {
        "spacing": (0, -1, math.nan, 1e-9, "a"),
        "scale": (0, -1, math.nan, 1e30, "a"),
        "margin": (math.inf, 1e9, "a"),
    }.items():
        for value in values:
            yield (
                f"mesh {key}={value}",
                lambda k=key, v=value: cube().simulate(
                    frames=2, colliders=[{"type": "mesh", "path": str(folder / "good.obj"), k: v}]
                ),
            )
    yield "mesh path is a folder", lambda: field_of_mesh(folder)
    yield (
        "mesh of another ending",
        lambda: ((folder / "m.stl").write_text("solid"), field_of_mesh(folder / "m.stl")),
    )
    yield "mesh is gone", lambda: field_of_mesh(folder / "nothing.obj")
    head = "ply\nformat {form} 1.0\nelement vertex {n}\nproperty {kind} x\nproperty float y\nproperty float z\n{more}end_header\n"
    faces = "element face {m}\nproperty list uchar int vertex_indices\n"
    whole = {"form": "ascii", "n": 1, "kind": "float", "more": ""}
    lies = {
        "of no format": {"form": "morse"}, "of words": {"kind": "string"}, "of half a vertex": {"n": 0.5},
        "of NaN vertices": {"n": "nan"},
        "binary that is text": {"form": "binary_little_endian", "n": 1000}, "without vertices": {"n": 0},
        "with faces of 1e9": {"more": faces.format(m=10**9)}, "with faces that are gone": {"more": faces.format(m=3)},
    }  # fmt: skip
    for name, fields in lies.items():
        text = head.format(**whole | fields) + "0 0 0\n"
        yield (
            f"ply {name}",
            lambda t=text: ((folder / "m.ply").write_text(t), field_of_mesh(folder / "m.ply")),
        )
        yield (
            f"splats {name}",
            lambda t=text: ((folder / "s.ply").write_text(t), load_ply(folder / "s.ply")),
        )


def poses(folder: Path) -> Iterator[Attack]:
    """Poses of a capture, in COLMAP's text and as transforms.json, and the record of an earlier one."""
    sizes = {f"p{i}.mp4": (160, 120) for i in range(3)}
    lines = {"cameras": ["1 PINHOLE 160 120 228.5 228.5 80.0 60.0"],
             "images": [line for i in range(3) for line in (f"{i} 1 0 0 0 {i}.5 0 4.5 1 p{i}.jpg", "")],
             "points3D": ["1 0.5 0.5 0.5 9 9 9 1"]}  # fmt: skip

    def model(name: str, column: int, value: str):
        words = lines[name][0].split()
        words[column] = value
        for each, rows in lines.items():
            changed = [" ".join(words), *rows[1:]] if each == name else rows
            (folder / f"{each}.txt").write_text("\n".join(changed))
        read_phones(folder, folder, sizes)
        scene_points(folder)

    for name, columns in (("cameras", range(8)), ("images", (1, 5, 8)), ("points3D", (1,))):
        for column in columns:
            for value in ("nan", "inf", "1e400", "abc") if name != "points3D" else ("abc",):
                yield f"{name} {column}={value}", lambda n=name, c=column, v=value: model(n, c, v)
    entry = {
        "transform_matrix": np.eye(4).tolist(),
        "fl_x": 200.0,
        "fl_y": 200.0,
        "cx": 80.0,
        "cy": 60.0,
        "w": 160,
        "h": 120,
    }

    def listing(key: str, value):
        (folder / "t").mkdir(exist_ok=True)
        frames = [
            entry | {"file_path": f"p{i}.jpg"} | ({key: value} if i == 1 else {}) for i in range(3)
        ]
        (folder / "t" / "transforms.json").write_text(json.dumps({"frames": frames}))
        read_phones(folder, folder / "t", sizes)

    for key in ("fl_x", "fl_y", "w", "h", "cx", "transform_matrix"):
        for value in (-1e9, 1e30, math.nan, "a", True, [1]):
            yield f"{key}={value}", lambda k=key, v=value: listing(k, v)
    for key in ("w", "h", "fl_x", "fl_y"):
        yield f"{key}=0", lambda k=key: listing(k, 0)
    good = {"scale": 0.4, "rotation": np.eye(3).tolist(), "origin": [0, 0, 0]}

    def record(key: str, value):
        (folder / "capture.json").write_text(json.dumps({"world": good | {key: value}}))
        read_world(folder)

    for key in good:
        for value in (
            0,
            -1,
            math.nan,
            "a",
            None,
            [1],
            np.diag([1, 1, -1]).tolist(),
            np.diag([2, 1, 1]).tolist(),
        ):
            yield f"like: {key}={value}", lambda k=key, v=value: record(k, v)
