"""From the keys of conf/scene to a validated Scene, whatever the format (docs/data.md)."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from mosa.data.checks.validation import validate
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.errors import ConfigError, DataError
from mosa.physics.contact.planes import check_rubbing
from mosa.settings import Number, Positive, Settings, Weight, check, imported
from mosa.types import Ground, Scene

FORMATS = {
    "pacnerf": "mosa.data.formats.pacnerf:load_pacnerf",
    "spring_gaus": "mosa.data.formats.spring_gaus:load_spring_gaus",
    "spring_gaus_real": "mosa.data.formats.spring_gaus_real:load_spring_gaus_real",
    "phystwin": "mosa.data.formats.phystwin:load_phystwin",
    "transforms": "mosa.data.formats.transforms:load_transforms",
    "markers": "mosa.data.formats.markers:load_markers",
    "builtin": "mosa.data.synthetic:load_builtin",
}
"""Format -> module:function. A new format is one function (path=..., the keys it needs) -> Scene and one line here, or a call of
`register_format` from another package."""


MADE = ("name", "footage", "truth", "synthetic", "known_parameters", "driven")
"""Arguments of `scene_from_footage` that a loader knows itself and no key says."""


def register_format(name: str, place: str) -> None:
    """Make a data format known by the name in scene.format. place: module:function, imported when a configuration asks for it.

    Errors: ConfigError if another format has the name."""
    if not all(place.partition(":")):
        raise ConfigError(f"scene.format: {name}: expected module:function, found {place!r}")
    if FORMATS.setdefault(name, place) != place:
        raise ConfigError(f"scene.format: there is a format {name!r} already; choose another name")


def load_scene(
    *,
    format: str | None = None,
    root: str | None = None,
    path: str | None = None,
    ground=None,
    cache=None,
    **keys,
) -> Scene:
    """The scene that the keys of conf/scene describe, validated.

    root is put before a relative path; `particles` is looked for beside the images first; ground: {height [m], mode, friction} or
    None; cache: folder for made scenes.
    Errors: ConfigError for keys (unknown, missing, out of range), DataError for files."""
    if not isinstance(format, str) or format not in FORMATS:
        raise ConfigError(
            f"scene.format: expected one of {', '.join(sorted(FORMATS))}, found {format!r}; one of another package is known "
            "once that is imported (extensions, or register_format before)"
        )
    loader = imported(f"scene.format: {format!r}", FORMATS[format])
    if format == "builtin":
        for key, value in (("path", path), ("ground", ground)):
            if value is not None:
                raise ConfigError(
                    f"scene.{key}: not a key of built-in scenes, which have their own; scene=transforms reads one"
                )
        own = {key: value for key, value in keys.items() if value is not None}
        return validate(call(loader, {"cache": cache, **own}))
    check("scene.fps", keys.get("fps"), Positive | None)
    check_names(name=keys.get("name"), sequence=keys.get("sequence"))
    places = {"root": root, "path": path, "cache": cache, "particles": keys.get("particles")}
    for key, text in places.items():
        if text is not None and (not isinstance(text, (str, Path)) or "\0" in str(text)):
            raise ConfigError(f"scene.{key}: expected a folder, found {text!r}")
    if path is None:
        raise ConfigError(
            f"scene.path: expected the folder of a scene in format {format}, found nothing; scene.path=<folder>"
        )
    arguments = {k: v for k, v in keys.items() if v is not None}
    arguments["ground"] = ground_from(ground)
    if "cache" in inspect.signature(loader).parameters:
        arguments["cache"] = cache
    place = under(root, path)
    if keys.get("particles") is not None:
        found = beside(place, keys["particles"])
        arguments["particles"] = under(root, keys["particles"]) if found is None else found
    body = arguments.get("body")
    if format != "markers" and isinstance(body, Mapping) and isinstance(body.get("shape"), str):
        near = (place if place.is_dir() else place.parent) / body["shape"]
        shape = near if os.path.isfile(near) else under(root, body["shape"])
        arguments["body"] = {**body, "shape": str(shape)}
    found = call(loader, {"path": place, **arguments})
    if not isinstance(found, Scene):
        raise DataError(
            f"scene.format: expected a Scene (scene_from_footage makes it) from {FORMATS[format]}, found "
            f"{type(found).__name__}"
        )
    return validate(found)


def check_names(**names) -> None:
    """They become parts of file names. Errors: ConfigError naming the key."""
    for key, name in names.items():
        if name is not None and (
            not isinstance(name, str) or re.fullmatch(r"[\w][\w .+-]{0,99}", name) is None
        ):
            raise ConfigError(
                f"scene.{key}: expected a name of at most 100 letters, digits and - _ . +, found {str(name)[:120]!r}"
            )


def held_out_of(keys: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the held-out sequences that a built-in scene brings: all besides its training sequence. Those of folders are named
    by the user (`mosa.data.sequences`)."""
    if keys.get("format") != "builtin" or keys.get("sequence", "train") != "train":
        return ()
    from mosa.data.synthetic import held_out_names

    return held_out_names(keys["name"])


def held_out_sequences(**keys) -> list[Scene]:
    """Those of `held_out_of`."""
    return [
        load_scene(**{**keys, "sequence": s, "holdout_frames": None, "last_free_frame": None})
        for s in held_out_of(keys)
    ]


def under(root: str | None, path: str) -> Path:
    """`path` below `root` where it is relative and a root is given."""
    try:
        path = Path(path).expanduser()
        whole = path if path.is_absolute() or root is None else Path(root).expanduser() / path
        whole.exists()  # of a name that no file system takes it is an error
    except (RuntimeError, OSError, ValueError) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"scene.path: expected a folder that can be, found {ascii(str(path))[:100]} ({said})"
        ) from error
    return whole


def beside(path: Path, name: str) -> Path | None:
    """The folder `name` beside the images of a scene (its folder, or the file in it), None where there is none."""
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    return folder / name if (folder / name).is_dir() else None


def call(loader: Callable, arguments: dict) -> Scene:
    """loader(**arguments). Errors: ConfigError where it does not know a key that is set."""
    takes = dict(inspect.signature(loader).parameters)
    if "world" in takes:
        further = inspect.signature(scene_from_footage).parameters
        takes |= {key: p for key, p in further.items() if key not in MADE}
    for key, p in takes.items():
        needed = p.default is p.empty and p.kind is p.KEYWORD_ONLY
        if needed and key not in arguments:
            raise ConfigError(f"scene.{key}: expected a value, found none")
    for key in arguments:
        if key not in takes:
            listed = ", ".join(sorted(set(takes) - {"world", "footage"}))
            raise ConfigError(f"scene.{key}: not a key of this format; it takes {listed}")
    return loader(**arguments)


class GroundSettings(Settings):
    """The ground of a scene or of a run, as `Ground`."""

    where = "scene.ground"
    height: Number
    mode: Literal["sticky", "slip", "separate", "touch", "auto"] = "sticky"
    friction: Weight = 0.0
    accuracy: Weight | None = None


def ground_from(keys) -> Ground | None:
    """Ground of {height, mode, friction}, None for none. Errors: ConfigError naming the key."""
    if keys is None or isinstance(keys, Ground):
        return keys
    given = keys.items() if isinstance(keys, Mapping) else ()
    found = GroundSettings.read({k: v for k, v in given if v is not None} if given else keys)
    check_rubbing("scene.ground.", found.mode, found.friction)
    return Ground(**dict(found))
