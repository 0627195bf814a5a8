"""From the keys of conf/scene to a validated Scene, whatever the format (docs/data.md)."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import torch

from mosa.data.footage import Footage
from mosa.data.particles import read_clouds
from mosa.data.validation import fingerprint, validate
from mosa.errors import ConfigError
from mosa.schema import is_number
from mosa.types import Ground, Scene, Truth

FORMATS = {
    "pacnerf": "mosa.data.pacnerf:load_pacnerf",
    "transforms": "mosa.data.transforms:load_transforms",
    "builtin": "mosa.data.builtin:load_builtin",
}
"""Format -> module:function. A new format is one function (path=..., the keys it needs) -> Scene and one line here."""


DENSITIES = 0.1, 1e5
"""[kg/m^3]: aerogel has 1, osmium 22,590."""
WIDEST = 1e5
"""[m] of scene.box: with gravity and seconds, nothing that cameras film is larger."""


def load_scene(
    *, format: str | None = None, root: str | None = None, path: str | None = None, ground=None, cache=None, **keys
) -> Scene:
    """The scene that the keys of conf/scene describe, validated.

    root is put before a relative path; `particles` is looked for beside the images first; ground: {height [m], mode, friction} or
    None; cache: folder for made scenes.
    Errors: ConfigError for keys (unknown, missing, out of range), DataError for files.
    """
    if not isinstance(format, str) or format not in FORMATS:
        raise ConfigError(f"scene.format: expected one of {', '.join(sorted(FORMATS))}, found {format!r}")
    module, function = FORMATS[format].split(":")
    loader = getattr(importlib.import_module(module), function)
    if format == "builtin":
        if given := [key for key, value in (("path", path), ("ground", ground)) if value is not None]:
            raise ConfigError(f"scene.{given[0]}: not a key of built-in scenes, which have their own; scene=transforms reads one")
        return validate(call(loader, {"cache": cache, **{k: v for k, v in keys.items() if v is not None}}))
    if keys.get("fps") is not None:
        check_fps(keys["fps"])
    check_names(name=keys.get("name"), sequence=keys.get("sequence"))
    for key, text in (("root", root), ("path", path), ("cache", cache), ("particles", keys.get("particles"))):
        if text is not None and (not isinstance(text, (str, Path)) or "\0" in str(text)):
            raise ConfigError(f"scene.{key}: expected a folder, found {text!r}")
    if path is None:
        raise ConfigError(
            f"scene.path: expected the folder of a scene in format {format}, found nothing; scene.path=<folder>"
        )
    arguments = {k: v for k, v in keys.items() if v is not None}
    arguments["ground"] = ground_from(ground)
    place = under(root, path)
    if keys.get("particles") is not None:
        found = beside(place, keys["particles"])
        arguments["particles"] = under(root, keys["particles"]) if found is None else found
    return validate(call(loader, {"path": place, **arguments}))


def check_names(**names) -> None:
    """They become parts of file names. Errors: ConfigError naming the key."""
    for key, name in names.items():
        if name is not None and (not isinstance(name, str) or re.fullmatch(r"[\w][\w .+-]{0,99}", name) is None):
            raise ConfigError(f"scene.{key}: expected a name of at most 100 letters, digits and - _ . +, found {str(name)[:120]!r}")


def held_out_sequences(**keys) -> list[Scene]:
    """The held-out sequences that a built-in scene brings: all besides its training sequence. Those of folders are named by the
    user (`mosa.data.sequences`)."""
    if keys.get("format") != "builtin" or keys.get("sequence", "train") != "train":
        return []
    from mosa.data.builtin import held_out_names

    return [
        load_scene(**{**keys, "sequence": s, "holdout_frames": None, "last_free_frame": None})
        for s in held_out_names(keys.get("name"))
    ]


def under(root: str | None, path: str) -> Path:
    """`path` below `root` where it is relative and a root is given."""
    path = Path(path).expanduser()
    return path if path.is_absolute() or root is None else Path(root).expanduser() / path


def beside(path: Path, name: str) -> Path | None:
    """The folder `name` beside the images of a scene (its folder, or the file in it), None where there is none."""
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    return folder / name if (folder / name).is_dir() else None


def call(loader: Callable, arguments: dict) -> Scene:
    """loader(**arguments). Errors: ConfigError where it does not know a key that is set."""
    known = set(inspect.signature(loader).parameters)
    if "world" in known:
        known |= set(inspect.signature(assemble).parameters)
    for key, parameter in inspect.signature(loader).parameters.items():
        if parameter.default is parameter.empty and parameter.kind is parameter.KEYWORD_ONLY and key not in arguments:
            raise ConfigError(f"scene.{key}: expected a value, found none")
    for key in arguments:
        if key not in known:
            raise ConfigError(
                f"scene.{key}: not a key of this format; it takes {', '.join(sorted(known - {'world', 'footage'}))}"
            )
    return loader(**arguments)


def ground_from(keys) -> Ground | None:
    """Ground of {height, mode, friction}, None for none. Errors: ConfigError naming the key."""
    if keys is None or isinstance(keys, Ground):
        return keys
    if not isinstance(keys, Mapping):
        raise ConfigError(f"scene.ground: expected the keys height, mode and friction, or null, found {keys!r}")
    unknown = set(keys) - {"height", "mode", "friction"}
    if unknown:
        raise ConfigError(f"scene.ground.{min(unknown)}: expected the keys height, mode and friction only")
    mode, friction = keys.get("mode", "sticky"), keys.get("friction") or 0.0
    if not isinstance(mode, str) or mode not in ("sticky", "slip", "separate"):
        raise ConfigError(f"scene.ground.mode: expected sticky, slip or separate, found {mode!r}")
    if not is_number(keys.get("height")):
        raise ConfigError(f"scene.ground.height: expected a height in metres, found {keys.get('height')!r}")
    if not is_number(friction) or friction < 0:
        raise ConfigError(f"scene.ground.friction: expected a finite number >= 0, found {friction!r}")
    if friction > 0 and mode != "separate":
        raise ConfigError(f"scene.ground.friction: acts with mode separate only, found {friction} with mode {mode!r}")
    return Ground(float(keys["height"]), mode, float(friction))


def vector(value, key: str) -> torch.Tensor:
    """(3,) float32. Errors: ConfigError naming the key."""
    if isinstance(value, (str, Mapping)) or (isinstance(value, (list, tuple)) and any(isinstance(v, (bool, str)) for v in value)):
        raise ConfigError(f"scene.{key}: expected three numbers, found {value!r}")
    try:
        result = torch.tensor([float(v) for v in value], dtype=torch.float32)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"scene.{key}: expected three numbers, found {value!r}") from error
    if result.shape != (3,) or not bool(torch.isfinite(result).all()):
        raise ConfigError(f"scene.{key}: expected three finite numbers, found {value!r}")
    return result


def check_fps(fps) -> None:
    """Errors: ConfigError where frames per second are none."""
    if not is_number(fps) or not fps > 0:
        raise ConfigError(f"scene.fps: expected a positive number, found {fps!r}")


def held_out_cameras(names, footage_names: tuple[str, ...]) -> tuple[int, ...]:
    """Indices of the cameras that are named. Errors: ConfigError for an unknown name, or where under two are left."""
    if names is not None and not isinstance(names, (list, tuple)):
        raise ConfigError(f"scene.holdout_cameras: expected a list of cameras like [3], found {names!r}")
    indices = []
    for name in names or ():
        if str(name) not in footage_names:
            raise ConfigError(f"scene.holdout_cameras: no camera {name!r}; the scene has {', '.join(footage_names)}")
        indices.append(footage_names.index(str(name)))
    if len(footage_names) < 2:
        raise ConfigError(f"scene: expected at least two cameras, found {len(footage_names)}")
    if len(footage_names) - len(set(indices)) < 2:
        raise ConfigError(
            f"scene.holdout_cameras: {len(set(indices))} of {len(footage_names)} held out; two must be left to learn from"
        )
    return tuple(sorted(set(indices)))


def held_out_frames(numbers, frames: tuple[int, ...]) -> tuple[int, ...]:
    """Indices of held-out frames: a list of frame numbers, or a count of last frames. They have to be the last ones.

    Errors: ConfigError where a number is unknown, where they are not the end of the sequence, or under three are left.
    """
    if isinstance(numbers, bool) or not isinstance(numbers, (int, list, tuple, type(None))):
        raise ConfigError(f"scene.holdout_frames: expected a list of frame numbers or how many are held out, found {numbers!r}")
    if isinstance(numbers, int):
        if numbers < 0:
            raise ConfigError(f"scene.holdout_frames: expected a number >= 0, found {numbers}")
        numbers = frames[len(frames) - numbers :] if 0 <= numbers <= len(frames) else frames
    indices = set()
    for number in numbers or ():
        if number not in frames:
            raise ConfigError(f"scene.holdout_frames: no frame {number}; the scene has {frames[0]} to {frames[-1]}")
        indices.add(frames.index(number))
    if indices and sorted(indices) != list(range(len(frames) - len(indices), len(frames))):
        raise ConfigError(
            f"scene.holdout_frames: expected the last frames of {frames[0]} to {frames[-1]}, found {sorted(numbers)}; "
            "what comes after a gap cannot be learned from"
        )
    if len(frames) < 3:
        raise ConfigError(f"scene.frames: expected at least three frames to learn from, found {len(frames)}")
    if len(frames) - len(indices) < 3:
        raise ConfigError(
            f"scene.holdout_frames: {len(indices)} of {len(frames)} frames held out; three must be left to learn from"
        )
    return tuple(sorted(indices))


def assemble(
    footage: Footage,
    *,
    name: str,
    gravity,
    box,
    ground: Ground | None,
    up=(0.0, 1.0, 0.0),
    density: float = 1000.0,
    sequence: str = "train",
    fps: float | None = None,
    last_free_frame: int | None = None,
    holdout_cameras=(),
    holdout_frames=(),
    particles: Path | None = None,
    known_parameters: dict[str, float] | None = None,
    truth: Truth | None = None,
    synthetic: bool = False,
) -> Scene:
    """Scene from footage and the keys that say what world it shows.

    gravity [m/s^2], up, box ((min), (max)) [m]: three numbers each; density [kg/m^3]; last_free_frame and holdout_frames: frame
    numbers as in the files; holdout_cameras: names; particles: folder of PLY files, one per frame; fps overrides times.
    Errors: ConfigError naming the key, DataError for particle files.
    """
    up = vector(up, "up")
    if not up.norm() > 0:
        raise ConfigError("scene.up: expected a direction, found zero")
    pull = vector(gravity, "gravity")
    if ground is not None and bool(pull.norm() > 0) and not float(pull @ up) < 0:
        raise ConfigError(
            f"scene.gravity: expected a pull towards the ground, against scene.up = {up.tolist()}, found {pull.tolist()}; set both"
        )
    try:
        low, high = box
    except (TypeError, ValueError) as error:
        raise ConfigError(f"scene.box: expected [[x, y, z] min, [x, y, z] max], found {box!r}") from error
    box = torch.stack([vector(low, "box"), vector(high, "box")])
    if not bool((box[1] > box[0]).all()):
        raise ConfigError(f"scene.box: expected min < max on every axis, found {box.tolist()}")
    if float(box.abs().max()) > WIDEST:
        raise ConfigError(f"scene.box: expected metres within {WIDEST:g}, found {box.tolist()}")
    if not is_number(density) or not DENSITIES[0] <= density <= DENSITIES[1]:
        raise ConfigError(f"scene.density: expected a positive number of {DENSITIES[0]:g} to {DENSITIES[1]:g} kg/m^3, "
                          f"found {density!r}")
    times = footage.times
    if fps is not None:
        check_fps(fps)
        times = torch.tensor([(f - footage.frames[0]) / fps for f in footage.frames], dtype=torch.float32)
    if last_free_frame is not None:
        if last_free_frame not in footage.frames:
            raise ConfigError(
                f"scene.last_free_frame: no frame {last_free_frame}; the scene has {footage.frames[0]} to {footage.frames[-1]}"
            )
        last_free_frame = footage.frames.index(last_free_frame)
    scene = Scene(
        name=name, sequence=sequence, images=footage.images, mattes=footage.mattes, cameras=footage.cameras, times=times,
        gravity=pull, up=up / up.norm(), ground=ground, box=box, density=float(density),
        background=footage.background, synthetic=synthetic, last_free_frame=last_free_frame,
        holdout_cameras=held_out_cameras(holdout_cameras, footage.cameras.names),
        holdout_frames=held_out_frames(holdout_frames, footage.frames), truth=truth,
        particles=read_clouds(particles, len(footage.frames)) if particles is not None else None,
        known_parameters=dict(known_parameters or {}),
    )  # fmt: skip
    return replace(scene, fingerprint=fingerprint(scene))
