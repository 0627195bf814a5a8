"""All sequences of one body that a configuration names: the training one, further ones to learn from, and held-out ones.

A built-in scene brings its sequences, of which scene.also_train names some. Of other formats each sequence is a folder: scene.path,
those in scene.also_train, and those in scene.test. An entry of these lists is a folder, or a section with `path` and keys of `OWN`
that hold for this sequence only, such as {path: drop_2, frames: [3, 20]}."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from mosa.data.scene import beside, held_out_of, held_out_sequences, load_scene, under
from mosa.errors import ConfigError, DataError
from mosa.types import Scene

OWN = (
    "path", "name", "frames", "fps", "start", "last_free_frame", "holdout_cameras", "particles", "scale", "fill_holes",
    "duration", "loads",
)  # fmt: skip
"""What a sequence may have otherwise than the training one: not the world, of which there is one for all."""
FILES = (".json", ".c3d", ".csv")  # endings of a sequence that is one file
DEPTH = 3  # folders that a name is made of at most; what is then still called the same is numbered
SHARED = 0.05  # of a recording's pictures that may be another's to the bit
NAME = re.compile(r"[\w.-]*\w[\w.-]*")


def load_sequences(keys: Mapping[str, Any]) -> tuple[Scene, list[Scene]]:
    """The training sequence and the others of the same object, those of scene.also_train first where they are folders.

    keys: plain, of conf/scene. Errors: ConfigError naming the key, DataError naming the file.
    """
    scene, others = load_first(keys)
    return scene, others()


def load_first(keys: Mapping[str, Any]) -> tuple[Scene, Callable[[], list[Scene]]]:
    """The training sequence, and what gives the others: of a built-in scene it makes their films when it is called, which takes as
    long; those of folders have been read and checked. Arguments and errors as of `load_sequences`."""
    keys = dict(keys)
    also_train, test = keys.pop("also_train", None) or [], keys.pop("test", None) or []
    if keys.get("format") == "builtin":
        if test:
            raise ConfigError(
                "scene.test: a built-in scene brings its held-out sequences itself; expected no list"
            )
        scene, known = load_scene(**keys), held_out_of(keys)
        if unknown := [name for name in also_train if name not in known]:
            found = f"has {', '.join(known)}" if known else "has none"
            wanted = "other sequences of the scene"
            raise ConfigError(
                f"scene.also_train: expected {wanted}, found {unknown[0]!r}; it {found}"
            )
        return scene, partial(held_out_sequences, **keys)
    entries = [("also_train", entry) for entry in also_train] + [("test", entry) for entry in test]
    names = sequence_names(keys, entries)
    scene = load_scene(**keys)
    named = zip(names, (keys_of(keys, *entry) for entry in entries))
    others = [load_scene(**own, name=scene.name, sequence=name) for name, own in named]
    if other := next((o for o in others if o.driven != scene.driven), None):
        raise ConfigError(
            f"scene.also_train, scene.test: expected recordings in one world, found driven sets in {other.sequence} that "
            "move otherwise than those of scene.path; learn from each alone"
        )
    check_distinct([scene, *others], ["scene.path", *(f"scene.{where}" for where, _ in entries)])
    return scene, partial(list, others)


def check_distinct(scenes: Sequence[Scene], where: Sequence[str]) -> None:
    """No recording is another's copy: what is learned from says nothing as a held-out sequence. Errors: DataError."""
    pictures: dict[bytes, int] = {}
    for k, scene in enumerate(scenes):
        both = zip(scene.images.flatten(0, 1), scene.mattes.flatten(0, 1))
        own = {hashlib.sha256(picture.numpy().tobytes()).digest()
               for picture, matte in both if bool(matte.any())}  # fmt: skip
        same = [pictures[each] for each in own if each in pictures]
        if len(same) > SHARED * len(own):
            raise DataError(
                f"{where[k]}: {len(same)} of the {len(own)} pictures of {scene.name}/{scene.sequence} are those of "
                f"{where[same[0]]} too: expected every recording once; what is learned from says nothing as a held-out "
                "sequence"
            )
        pictures |= {each: k for each in own if each not in pictures}


def taught_names(keys: Mapping[str, Any]) -> list[str]:
    """`Scene.sequence` of the sequences in scene.also_train. Errors: ConfigError."""
    return further_names(keys)[: len(keys.get("also_train") or [])]


def further_names(keys: Mapping[str, Any]) -> list[str]:
    """The same of those in scene.test too, which follow."""
    also_train = keys.get("also_train") or []
    if keys.get("format") == "builtin":
        return list(also_train)
    entries = [("also_train", each) for each in also_train]
    return sequence_names(keys, entries + [("test", each) for each in keys.get("test") or []])


def section(where: str, entry: str | Mapping[str, Any]) -> dict[str, Any]:
    """An entry of scene.also_train or scene.test as a section. Errors: ConfigError naming its key."""
    if isinstance(entry, str):
        return {"path": entry}
    if not isinstance(entry, Mapping) or not isinstance(entry.get("path"), str):
        raise ConfigError(
            f"scene.{where}: expected folders, or sections like {{path: <folder>, frames: [0, 9]}}, found {entry!r}"
        )
    if unknown := [key for key in entry if key not in OWN]:
        wanted = ", ".join(OWN)
        raise ConfigError(
            f"scene.{where}: {unknown[0]}: not a key of a single sequence; expected {wanted}"
        )
    return dict(entry)


def keys_of(keys: Mapping[str, Any], where: str, entry: str | Mapping[str, Any]) -> dict[str, Any]:
    """Keys of `load_scene`, without name and sequence, of an entry: the training sequence's where it has none of its own.

    `last_free_frame` and `holdout_frames` are about the training sequence alone. Its particles are not another sequence's: a
    relative scene.particles counts where such a folder lies beside the images."""
    own = section(where, entry)
    apart = ("name", "sequence", "last_free_frame", "holdout_frames", "particles")
    inherited = {k: v for k, v in keys.items() if k not in apart}
    shared, place = keys.get("particles"), under(keys.get("root"), own["path"])
    if shared and not Path(shared).is_absolute() and beside(place, shared):
        inherited["particles"] = shared
    return inherited | {k: v for k, v in own.items() if k != "name"}


def sequence_names(keys: Mapping[str, Any], entries: Sequence[tuple[str, Any]]) -> list[str]:
    """One name per entry, unique, of letters, digits, `_`, `-` and `.`: its own, or what its folder is called, with the folders
    above where two are called the same. entries: (list it is in, entry). Errors: ConfigError for material that is named twice."""
    sections = [section(*each) for each in entries]
    root, first = keys.get("root"), keys.get("path")
    places = [("scene.path", first, keys.get("frames"))] if isinstance(first, str) else []
    for (where, _), own in zip(entries, sections):
        places.append((f"scene.{where}", own["path"], own.get("frames", keys.get("frames"))))
    for k, (where, path, frames) in enumerate(places):
        for before, other, others in places[:k]:
            if place(root, path) == place(root, other) and overlap(frames, others):
                raise ConfigError(
                    f"{where}: {path} is named in {before} as well: expected every sequence once, or parts of one with `frames` "
                    "that do not overlap; what is learned from says nothing as a held-out sequence"
                )
    parts = []
    for (where, _), own in zip(entries, sections):
        name = own.get("name")
        if name is not None and (not isinstance(name, str) or not NAME.fullmatch(name)):
            raise ConfigError(
                f"scene.{where}: name: expected letters, digits, _, -, ., found {name!r}"
            )
        parts.append([name] if name is not None else pieces(place(root, own["path"])))
    depth = [1] * len(parts)
    while True:
        names = ["_".join(each[-d:]) for each, d in zip(parts, depth)]
        folded = [name.casefold() for name in names]
        twice = {k for k, name in enumerate(folded) if folded.count(name) > 1}
        if not (deeper := [k for k in twice if depth[k] < min(len(parts[k]), DEPTH)]):
            break
        for k in deeper:
            depth[k] += 1
    if named := [names[k] for k in twice if "name" in sections[k]]:
        where = f"scene.{entries[0][0]}"
        raise ConfigError(f"{where}: name: expected a name once, found {named[0]!r} again")
    for number, k in enumerate(sorted(twice), 1):
        names[k] = f"{names[k]}_{number}"
    return names


def place(root: str | None, path: str) -> Path:
    """Where a sequence lies; its folder where it is that folder's transforms.json."""
    whole = under(root, path).resolve()
    return whole.parent if whole.name == "transforms.json" else whole


def pieces(path: Path) -> list[str]:
    """The parts of a path that a name can be made of, without the ending of a file."""
    *above, last = path.parts
    parts = [*above, Path(last).stem if last.endswith(FILES) else last]
    safe = [re.sub(r"[^\w.-]+", "_", part).strip("._") for part in parts]
    return [part for part in safe if part] or ["sequence"]


def overlap(a, b) -> bool:
    """Whether two ranges [first, last] of frames share one; anything else stands for all frames."""
    is_range = lambda r: isinstance(r, (list, tuple)) and [type(f) for f in r] == [int, int]  # noqa: E731
    ranges = [r for r in (a, b) if is_range(r)]
    return len(ranges) < 2 or (ranges[0][0] <= ranges[1][1] and ranges[1][0] <= ranges[0][1])
