"""Attacks of a third look at captures: what a file system, an exporter or a camera can hand over beside the mistakes of the other
groups. Each is to end in one message, or in the same scene ("the same").
"""

from __future__ import annotations

import gzip
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from attacks import WORLD, Attack, refuse
from attacks_on_data import capture
from attacks_on_meaning import said
from PIL import Image

from mosa.data.formats.export import export_transforms
from mosa.data.scene import load_scene


class Copies:
    """Copies of the small capture, each changed and read again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.good, self.count = folder, capture(), 0
        self.scene = load_scene(format="transforms", path=str(self.good), **WORLD)
        self.masked = export_transforms(self.scene, folder / "masked", masks=True)

    def copied(self, source: Path | None = None) -> Path:
        self.count += 1
        return Path(
            shutil.copytree(source or self.good, self.folder / f"c{self.count}", symlinks=True)
        )

    def read(self, path: Path | str, mattes: float = 0.0, colors: float = 0.0, **keys) -> None:
        """Errors: AssertionError for another scene than the unchanged one, beyond so much of a matte and of a colour."""
        found = load_scene(format="transforms", path=str(path), **WORLD | keys)
        for name, allowed in (("mattes", mattes), ("images", colors)):
            ours, theirs = getattr(found, name), getattr(self.scene, name)
            if ours.shape != theirs.shape or float((ours - theirs).abs().max()) > allowed + 1e-6:
                far = (
                    "another shape"
                    if ours.shape != theirs.shape
                    else f"{float((ours - theirs).abs().max()):.3g}"
                )
                raise AssertionError(f"loaded, with other {name}: {far}")
        for name in ("K", "w2c"):
            if (
                float(
                    (getattr(found.cameras, name) - getattr(self.scene.cameras, name)).abs().max()
                )
                > 1e-4
            ):
                raise AssertionError(f"loaded, with other {name}")
        clock = found.times - found.times[0]
        if float((clock - self.scene.times).abs().max()) > 1e-5:
            raise AssertionError("loaded, with other times")
        refuse("the same")

    def changed(
        self, change: Callable[[Path], object], masked: bool = False, **told
    ) -> Callable[[], object]:
        def attack():
            place = self.copied(self.masked if masked else None)
            change(place)
            self.read(place, **told)

        return said(attack)

    def listed(self, change: Callable[[dict], object], **told) -> Callable[[], object]:
        def rewrite(place: Path):
            document = json.loads((place / "transforms.json").read_text())
            change(document)
            (place / "transforms.json").write_text(json.dumps(document))

        return self.changed(rewrite, **told)

    def text(self, change: Callable[[str], str], **told) -> Callable[[], object]:
        return self.changed(
            lambda p: (p / "transforms.json").write_text(
                change((p / "transforms.json").read_text())
            ),
            **told,
        )

    def pictures(
        self, change: Callable[[Path], object], masked: bool = False, one: bool = False, **told
    ) -> Callable[[], object]:
        def every(place: Path):
            files = [
                f for f in sorted((place / "images").iterdir()) if not f.stem.endswith("_mask")
            ]
            for file in files[5:6] if one else files:
                change(file)

        return self.changed(every, masked, **told)


def written(save: Callable[[Image.Image, io.BytesIO], object]) -> Callable[[Path], object]:
    """A picture in another form, under the name that it had."""

    def change(file: Path):
        with Image.open(file) as picture:
            picture.load()
            content = io.BytesIO()
            save(picture, content)
        file.write_bytes(content.getvalue())

    return change


def at_each(change: Callable[[dict], object]) -> Callable[[dict], object]:
    return lambda document: [change(entry) for entry in document["frames"]]


def of_a_camera(change: Callable[[dict], object]) -> Callable[[dict], object]:
    """The entries of the second camera that the list names."""

    def apply(document: dict):
        names = list(dict.fromkeys(entry["camera"] for entry in document["frames"]))
        for entry in document["frames"]:
            if entry["camera"] == names[1]:
                change(entry)

    return apply


def afresh_data(folder: Path) -> Iterator[Attack]:
    c = Copies(folder)
    yield from special_files(c)
    yield from other_exporters(c)
    yield from other_pictures(c)
    yield from other_mattes(c)
    yield from other_times(c)


def special_files(c: Copies) -> Iterator[Attack]:
    """What a file system can put in the place of a file."""

    def pipe(place: Path) -> None:
        place.unlink()
        os.mkfifo(place)

    def linked(place: Path, target: str) -> None:
        place.unlink()
        place.symlink_to(target)

    yield "the listing is a pipe", c.changed(lambda p: pipe(p / "transforms.json"))
    yield "a picture is a pipe", c.pictures(pipe, one=True)
    for target in ("/dev/zero", "/dev/stdin", "/proc/self/mem", "/nonexistent"):
        yield (
            f"the listing is a link to {target}",
            c.changed(lambda p, t=target: linked(p / "transforms.json", t)),
        )
        yield (
            f"a picture is a link to {target}",
            c.pictures(lambda f, t=target: linked(f, t), one=True),
        )
    yield (
        "pictures elsewhere, linked",
        c.changed(
            lambda p: (
                (p / "images").rename(c.folder / "elsewhere"),
                (p / "images").symlink_to(c.folder / "elsewhere"),
            )
        ),
    )
    yield (
        "the folder of pictures links to itself",
        c.changed(lambda p: (shutil.rmtree(p / "images"), (p / "images").symlink_to(p / "images"))),
    )
    for path in ("/dev/zero", "/dev/null", "/proc", "/", ".", "~"):
        yield f"path {path}", said(lambda x=path: c.read(x))

    def zipped() -> None:
        with zipfile.ZipFile(c.folder / "capture.zip", "w") as archive:
            for file in sorted(c.good.rglob("*")):
                archive.write(file, file.relative_to(c.good))
        c.read(c.folder / "capture.zip")

    yield "a zip of the folder", said(zipped)
    yield "path of a picture", said(lambda: c.read(next((c.good / "images").iterdir())))
    yield "path of the folder of pictures", said(lambda: c.read(c.good / "images"))
    yield "path with a blank behind", said(lambda: c.read(f"{c.good} "))
    yield "path of the file", said(lambda: c.read(c.good / "transforms.json"))
    yield (
        "a compressed listing",
        c.changed(
            lambda p: (p / "transforms.json").write_bytes(
                gzip.compress((p / "transforms.json").read_bytes())
            )
        ),
    )


def other_exporters(c: Copies) -> Iterator[Attack]:
    """Listings as other programs write them, and by hand."""
    yield "entries in another order", c.listed(lambda d: d["frames"].sort(key=lambda e: -e["time"]))
    yield "a key twice", c.text(lambda t: t.replace('"fl_x":', '"fl_x": 9.0, "fl_x":', 1))
    yield "frames twice", c.text(lambda t: t.rstrip()[:-1] + ', "frames": []}')
    yield "a trailing comma", c.text(lambda t: t.rstrip()[:-1] + ",}")
    yield "comments", c.text(lambda t: "// by hand\n" + t)
    yield "numbers as words", c.text(lambda t: t.replace('"time": 0.0', '"time": "0.0"'))
    yield "NaN as a time", c.text(lambda t: t.replace('"time": 0.0', '"time": NaN'))
    yield "a decimal comma", c.text(lambda t: t.replace("0.", "0,"))
    yield "a list of one document", c.text(lambda t: f"[{t}]")
    yield "two documents", c.text(lambda t: t + t)
    yield (
        "a camera by number and by word",
        c.listed(at_each(lambda e: e.update(camera=hash_of(e["camera"], e["time"])))),
    )
    yield (
        "a camera with a blank behind",
        c.listed(lambda d: d["frames"][3].update(camera=f"{d['frames'][3]['camera']} ")),
    )
    yield (
        "a camera in capitals",
        c.listed(lambda d: d["frames"][3].update(camera=f"A{d['frames'][3]['camera']}")),
    )
    yield (
        "Nerfstudio's applied_transform",
        c.listed(lambda d: d.update(applied_transform=[[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])),
    )
    yield "Nerfstudio's applied_scale", c.listed(lambda d: d.update(applied_scale=0.25))
    yield (
        "instant-ngp's scale and offset",
        c.listed(lambda d: d.update(scale=0.33, offset=[0.5, 0.5, 0.5])),
    )
    yield "instant-ngp's aabb_scale", c.listed(lambda d: d.update(aabb_scale=16))
    yield (
        "one camera's focal lengths exchanged",
        c.listed(of_a_camera(lambda e: e.update(fl_x=2.2 * e["fl_x"]))),
    )
    yield "cx and cy of the whole sensor", c.listed(at_each(lambda e: e.update(cx=960.0, cy=540.0)))
    yield (
        "camera_angle_x in degrees",
        c.listed(at_each(lambda e: (e.pop("fl_x"), e.pop("fl_y"), e.update(camera_angle_x=22.6)))),
    )
    yield "a lens that folds", c.listed(lambda d: d.update(k1=-5.0))
    yield "a lens of NaN", c.text(lambda t: t.replace("{", '{"k1": NaN, ', 1))
    yield "a lens of another camera", c.listed(lambda d: d.update(k1=3.0))
    yield "a fisheye's flag that is a word", c.listed(lambda d: d.update(is_fisheye="maybe"))
    yield "an equirectangular camera", c.listed(lambda d: d.update(camera_model="EQUIRECTANGULAR"))
    yield "rotations scaled by 1.01", c.listed(at_each(lambda e: scaled_rotation(e, 1.01)))
    yield (
        "rotations rounded to two digits",
        c.listed(
            at_each(
                lambda e: e.update(transform_matrix=np.round(e["transform_matrix"], 2).tolist())
            )
        ),
    )
    yield (
        "a camera inside of the body",
        c.listed(of_a_camera(lambda e: moved_to(e, [0.0, 0.3, 0.0]))),
    )
    yield (
        "a camera that looks away",
        c.listed(
            of_a_camera(
                lambda e: e.update(
                    transform_matrix=(
                        np.array(e["transform_matrix"]) @ np.diag([-1.0, 1, -1, 1])
                    ).tolist()
                )
            )
        ),
    )
    yield "two cameras in one place", c.listed(lambda d: twins(d))
    yield (
        "a camera rolled by 90 degrees",
        c.listed(
            of_a_camera(
                lambda e: e.update(
                    transform_matrix=(
                        np.array(e["transform_matrix"])
                        @ [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
                    ).tolist()
                )
            )
        ),
    )
    yield (
        "a moving camera",
        c.listed(
            of_a_camera(
                lambda e: e["transform_matrix"][0].__setitem__(
                    3, e["transform_matrix"][0][3] + 0.1 * e["time"]
                )
            )
        ),
    )


def hash_of(name: str, time: float):
    """The same camera, by turns as a number and as a word."""
    digits = int("".join(filter(str.isdigit, name)) or 0)
    return digits if time > 0.05 else str(digits)


def scaled_rotation(entry: dict, factor: float) -> None:
    for row in entry["transform_matrix"][:3]:
        row[:3] = [factor * value for value in row[:3]]


def moved_to(entry: dict, place: list[float]) -> None:
    for row, value in zip(entry["transform_matrix"], place):
        row[3] = value


def twins(document: dict) -> None:
    """The second camera's pictures with the first one's pose."""
    names = list(dict.fromkeys(entry["camera"] for entry in document["frames"]))
    first = next(entry for entry in document["frames"] if entry["camera"] == names[0])
    for entry in document["frames"]:
        if entry["camera"] == names[1]:
            entry["transform_matrix"] = first["transform_matrix"]


def other_pictures(c: Copies) -> Iterator[Attack]:
    """Pictures of other kinds, under the names of PNG files."""

    def flat(p, grey):
        return Image.merge("RGBA", [p.split()[3].point(lambda _: grey)] * 3 + [p.split()[3]])

    def rgb(p):
        return Image.alpha_composite(Image.new("RGBA", p.size, "white"), p.convert("RGBA")).convert(
            "RGB"
        )

    yield (
        "an animated PNG",
        c.pictures(
            written(lambda p, f: p.save(f, "PNG", save_all=True, append_images=[p.rotate(90)]))
        ),
    )
    yield (
        "a GIF of two frames",
        c.pictures(
            written(lambda p, f: p.save(f, "GIF", save_all=True, append_images=[p.rotate(90)])),
            one=True,
        ),
    )
    yield (
        "a JPEG in CMYK beside masks",
        c.pictures(
            written(lambda p, f: rgb(p).convert("CMYK").save(f, "JPEG", quality=98)),
            True,
            colors=0.6,
        ),
    )
    yield (
        "grey beside masks",
        c.pictures(written(lambda p, f: rgb(p).convert("L").save(f, "PNG")), True, colors=1.0),
    )
    yield (
        "one in grey beside masks",
        c.pictures(
            written(lambda p, f: rgb(p).convert("L").save(f, "PNG")), True, one=True, colors=1.0
        ),
    )
    yield (
        "one bit",
        c.pictures(
            written(lambda p, f: rgb(p).convert("1").save(f, "PNG")), True, one=True, colors=1.0
        ),
    )
    yield (
        "16 bits of grey",
        c.pictures(
            written(
                lambda p, f: Image.fromarray(
                    np.asarray(rgb(p).convert("L")).astype(np.uint16) * 257
                ).save(f, "PNG")
            ),
            True,
            colors=1.0,
        ),
    )
    yield (
        "32 bits of whole numbers",
        c.pictures(
            written(
                lambda p, f: Image.fromarray(np.asarray(rgb(p).convert("L")).astype(np.int32)).save(
                    f, "TIFF"
                )
            ),
            True,
            one=True,
        ),
    )
    yield "BMP", c.pictures(written(lambda p, f: rgb(p).save(f, "BMP")), True, colors=2 / 255)
    yield "an icon", c.pictures(written(lambda p, f: p.save(f, "ICO", sizes=[(16, 16)])), one=True)
    yield (
        "linear EXR-like floats above 1",
        c.pictures(lambda f: brightened(f), True, one=True, colors=1.0),
    )
    yield "a gamma of 1 in the header", c.pictures(lambda f: gamma_chunk(f, 100_000), colors=0.0)
    yield "premultiplied alpha", c.pictures(lambda f: premultiplied(f), colors=0.3)
    yield (
        "red and blue exchanged",
        c.pictures(
            written(
                lambda p, f: Image.merge("RGBA", [p.split()[i] for i in (2, 1, 0, 3)]).save(
                    f, "PNG"
                )
            ),
            colors=1.0,
        ),
    )
    yield (
        "one half as large",
        c.pictures(
            written(lambda p, f: p.resize((p.width // 2, p.height // 2)).save(f, "PNG")), one=True
        ),
    )
    yield "three quarters transparent", c.pictures(written(lambda p, f: faded(p).save(f, "PNG")))
    yield (
        "one black",
        c.pictures(written(lambda p, f: flat(p, 0).save(f, "PNG")), one=True, colors=1.0),
    )
    yield (
        "all of one colour",
        c.pictures(written(lambda p, f: flat(p, 128).save(f, "PNG")), colors=1.0),
    )


def faded(picture: Image.Image) -> Image.Image:
    picture = picture.convert("RGBA")
    picture.putalpha(picture.split()[3].point(lambda a: 3 * a // 4))
    return picture


def brightened(file: Path) -> None:
    pixels = np.asarray(Image.open(file).convert("RGB")).astype(np.float32) / 64
    cv2.imwrite(str(file.with_suffix(".tiff")), pixels)
    file.with_suffix(".tiff").rename(file)


def gamma_chunk(file: Path, gamma: int) -> None:
    """A PNG with a gAMA chunk behind its header."""
    import zlib

    content = file.read_bytes()
    body = b"gAMA" + gamma.to_bytes(4, "big")
    file.write_bytes(
        content[:33]
        + (4).to_bytes(4, "big")
        + body
        + zlib.crc32(body).to_bytes(4, "big")
        + content[33:]
    )


def premultiplied(file: Path) -> None:
    with Image.open(file) as picture:
        pixels = np.asarray(picture).astype(np.float32)
    pixels[..., :3] *= pixels[..., 3:] / 255
    Image.fromarray(pixels.round().astype(np.uint8)).save(file)


def other_mattes(c: Copies) -> Iterator[Attack]:
    """Mattes that are of an object, and not of this one."""

    def alpha(change: Callable[[np.ndarray], np.ndarray]):
        def apply(file: Path):
            with Image.open(file) as picture:
                pixels = np.array(picture)
            pixels[..., 3] = change(pixels[..., 3])
            Image.fromarray(pixels).save(file)

        return apply

    ring = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    yield "a speck in a corner of all", c.pictures(alpha(lambda a: speck(a)))
    yield (
        "a speck in a corner of one",
        c.pictures(alpha(lambda a: speck(a)), one=True, mattes=1.0, colors=1.0),
    )
    yield "a second object in all", c.pictures(alpha(lambda a: blob(a)))
    yield (
        "grown by three pixels in one camera",
        c.changed(
            lambda p: [
                alpha(lambda a: cv2.dilate(a, ring))(f)
                for f in sorted((p / "images").iterdir())[15:30]
            ]
        ),
    )
    yield (
        "shrunk by three pixels in one camera",
        c.changed(
            lambda p: [
                alpha(lambda a: cv2.erode(a, ring))(f)
                for f in sorted((p / "images").iterdir())[15:30]
            ]
        ),
    )
    yield "half transparent in all", c.pictures(alpha(lambda a: a // 2))
    yield "half transparent in one", c.pictures(alpha(lambda a: a // 2), one=True)
    yield "mattes of the frame before", c.changed(lambda p: late_mattes(p))
    yield "the mattes of one camera in another", c.changed(lambda p: exchanged_mattes(p))
    yield (
        "the upper half gone in one camera",
        c.changed(
            lambda p: [
                alpha(lambda a: halved(a))(f) for f in sorted((p / "images").iterdir())[15:30]
            ]
        ),
    )
    yield (
        "a static stain in one camera",
        c.changed(
            lambda p: [alpha(lambda a: blob(a))(f) for f in sorted((p / "images").iterdir())[15:30]]
        ),
    )


def speck(alpha: np.ndarray) -> np.ndarray:
    alpha = alpha.copy()
    alpha[2:5, 2:5] = 255
    return alpha


def blob(alpha: np.ndarray) -> np.ndarray:
    alpha = alpha.copy()
    alpha[5:17, 5:17] = 255
    return alpha


def halved(alpha: np.ndarray) -> np.ndarray:
    alpha, rows = alpha.copy(), np.flatnonzero((alpha > 0).any(1))
    if len(rows):
        alpha[: int(rows.mean())] = 0
    return alpha


def late_mattes(place: Path) -> None:
    files = sorted((place / "images").iterdir())
    kept = [np.array(Image.open(file)) for file in files]
    for before, file, pixels in zip(kept[:-1], files[1:], kept[1:]):
        pixels[..., 3] = before[..., 3]
        Image.fromarray(pixels).save(file)


def exchanged_mattes(place: Path) -> None:
    files = sorted((place / "images").iterdir())
    first, second = files[:15], files[15:30]
    for a, b in zip(first, second):
        one, other = np.array(Image.open(a)), np.array(Image.open(b))
        one[..., 3], other[..., 3] = other[..., 3].copy(), one[..., 3].copy()
        Image.fromarray(one).save(a)
        Image.fromarray(other).save(b)


def other_times(c: Copies) -> Iterator[Attack]:
    """Clocks of films."""
    for fps in (-60, 0, 1e-3, 50.0, 59.94, 60, 1e6, float("nan"), float("inf"), "60", True, [60]):
        yield f"fps={fps}", said(lambda f=fps: c.read(c.good, fps=f))
    yield "each frame twice", c.listed(lambda d: pulled_down(d))
    yield (
        "every second frame gone in one camera",
        c.listed(
            lambda d: d.update(
                frames=[
                    e for e in d["frames"] if e["camera"] != "3" or round(50 * e["time"]) % 2 == 0
                ]
            )
        ),
    )
    yield (
        "one moment gone in all cameras",
        c.listed(lambda d: d.update(frames=[e for e in d["frames"] if round(50 * e["time"]) != 6])),
    )
    yield (
        "jitter of a hundredth of a frame",
        c.listed(at_each(lambda e: e.update(time=e["time"] + 0.01 / 50 * np.sin(1e4 * e["time"])))),
    )
    yield (
        "one camera late by a tenth of a frame",
        c.listed(of_a_camera(lambda e: e.update(time=e["time"] + 0.1 / 50))),
    )
    yield (
        "one camera's clock faster by a thousandth",
        c.listed(of_a_camera(lambda e: e.update(time=1.001 * e["time"]))),
    )
    yield "times of the Unix clock", c.listed(at_each(lambda e: e.update(time=1.7e9 + e["time"])))
    yield (
        "times as text of a date",
        c.listed(at_each(lambda e: e.update(time="2026-11-23T07:00:00Z"))),
    )
    yield "times from -1 on", c.listed(at_each(lambda e: e.update(time=e["time"] - 1)))
    yield "slow motion, four times", c.listed(at_each(lambda e: e.update(time=4 * e["time"])))


def pulled_down(document: dict) -> None:
    """A film of half the rate whose frames a converter wrote twice."""
    files = {
        (entry["camera"], round(50 * entry["time"])): entry["file_path"]
        for entry in document["frames"]
    }
    for entry in document["frames"]:
        entry["file_path"] = files[entry["camera"], round(50 * entry["time"]) // 2 * 2]
