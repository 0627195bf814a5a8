"""A Scene from footage and the keys of conf/scene that say what world it shows: what every format's loader ends with."""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import Field
from torch import Tensor

from mosa.data.checks.validation import check_types, fingerprint
from mosa.data.formats.footage import Footage
from mosa.data.formats.particles import read_clouds
from mosa.errors import ConfigError, DataError
from mosa.settings import Positive, Settings, Text, Three, Whole, check
from mosa.types import FALLING, REST, Ground, KnownBody, Scene, Truth, metres

DENSITIES = 0.1, 1e5  # [kg/m^3]: aerogel has 1, osmium 22,590
LIGHT = 10.0  # [kg/m^3] below which a density is asked about: foams of polystyrene have 15
STEEP = 3.0  # [degrees] of an incline that is said
SHAPES = (".ply", ".obj", ".stl")  # endings of files of a body's rest shape
WIDEST = 1e5  # [m] of scene.box: with gravity and seconds, nothing that cameras film is larger


def check_density(key: str, density: float) -> None:
    """density [kg/m^3] of the setting `key`; one that is unusually small is a warning. Errors:
    ConfigError."""
    check(key, density, Annotated[float, Interval(ge=DENSITIES[0], le=DENSITIES[1])])
    if density < LIGHT:
        warnings.warn(
            f"{key}: {density:g} kg/m^3 is lighter than nearly all solids; was it meant in g/cm^3? Moduli scale "
            "with it",
            stacklevel=5,
        )


class BodySettings(Settings):
    """The rest shape of a body that is known from elsewhere (docs/few_cameras.md)."""

    where = "scene.body"

    shape: Text | None = Field(
        None, description="file .ply, .obj or .stl of a closed mesh, a cloud or Gaussians"
    )
    scale: Positive | None = Field(
        None, description="m of the file's unit; null: the mattes tell it, of one camera the fall"
    )


def known_body(keys: Mapping[str, Any] | None) -> KnownBody | None:
    """None where no shape is named. Errors: ConfigError naming the key, DataError where there is no such file."""
    settings = BodySettings.read({} if keys is None else keys)
    if settings.shape is None:
        if settings.scale is not None:
            raise ConfigError("scene.body.scale: expected scene.body.shape beside it, found none")
        return None
    path = Path(settings.shape)
    if not os.path.isfile(path) or path.suffix.lower() not in SHAPES:
        raise DataError(
            f"scene.body.shape: expected a file {', '.join(SHAPES)} beside the images or below "
            f"scene.root, found {path}"
        )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    return KnownBody(str(path), settings.scale, digest)


def scene_from_footage(
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
    start: str = FALLING,
    last_free_frame: int | None = None,
    holdout_cameras=(),
    holdout_frames=(),
    particles: Path | None = None,
    body: Mapping[str, Any] | None = None,
    driven: tuple[dict[str, Any], ...] = (),
    known_parameters: dict[str, float] | None = None,
    truth: Truth | None = None,
    synthetic: bool = False,
) -> Scene:
    """Scene from footage and the keys that say what world it shows.

    gravity [m/s^2], up, box ((min), (max)) [m]: three numbers each; density [kg/m^3]; start: falling | rest;
    last_free_frame and holdout_frames: frame numbers as in the files; holdout_cameras: names; particles: folder of PLY files, one
    per frame; body: {shape: file, scale} of a known rest shape; driven: as of
    `Scene`; fps overrides times.
    Errors: ConfigError naming the key, DataError for particle files."""
    check_types(footage, f"scene {name} ({sequence})")
    up, pull = directions(up, gravity, ground)
    if not isinstance(box, (list, tuple, Tensor)) or len(box) != 2:
        raise ConfigError(f"scene.box: expected [[x, y, z] min, [x, y, z] max], found {box!r}")
    box = torch.stack([vector(corner, "box") for corner in box])
    if not bool((box[1] > box[0]).all()) or float(box.abs().max()) > WIDEST:
        raise ConfigError(
            f"scene.box: expected min < max on every axis, within {WIDEST:g} m, found {box.tolist()}"
        )
    check_density("scene.density", density)
    times = footage.times
    if fps is not None:
        check("scene.fps", fps, Positive)
        moments = [(f - footage.frames[0]) / fps for f in footage.frames]
        times = torch.tensor(moments, dtype=torch.float32)
    if start not in (FALLING, REST):
        raise ConfigError(f"scene.start: expected {FALLING} or {REST}, found {start!r}")
    if start == REST:
        if last_free_frame is not None:
            wanted = f"null with scene.start={REST}, where no frame is one of free flight"
            raise ConfigError(
                f"scene.last_free_frame: expected {wanted}, found {last_free_frame!r}"
            )
        last_free_frame = footage.frames[0]
    if last_free_frame is not None:
        if isinstance(last_free_frame, bool) or last_free_frame not in footage.frames:
            there = f"{footage.frames[0]} to {footage.frames[-1]}"
            raise ConfigError(
                f"scene.last_free_frame: no frame {last_free_frame}; the scene has {there}"
            )
        last_free_frame = footage.frames.index(last_free_frame)
    check_ground(ground, up, pull, box)
    known = known_body(body)
    fewest = 2 if known is None else 1
    scene = Scene(
        name=name, sequence=sequence, images=footage.images, mattes=footage.mattes, cameras=footage.cameras, times=times,
        gravity=pull, up=up, ground=ground, box=box, density=float(density),
        background=footage.background, synthetic=synthetic, start=start, last_free_frame=last_free_frame,
        holdout_cameras=held_out_cameras(holdout_cameras, footage.cameras.names, fewest),
        holdout_frames=held_out_frames(holdout_frames, footage.frames), truth=truth,
        particles=read_clouds(particles, footage.frames) if particles is not None else None,
        known_parameters=dict(known_parameters or {}), body=known, driven=driven,
    )  # fmt: skip
    return replace(scene, fingerprint=fingerprint(scene))


def check_ground(ground: Ground | None, up: Tensor, pull: Tensor, box: Tensor) -> None:
    """The ground lies in the box, and what falls falls onto it: a warning where it is an incline. up: (3,) unit vector.

    Errors: ConfigError naming scene.box."""
    if ground is None:
        return
    corners = torch.stack(torch.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3) @ up
    low, high = float(corners.min()), float(corners.max())
    if not low <= ground.height < high:
        raise ConfigError(
            f"scene.box: expected one that the ground at scene.ground.height={ground.height:g} m lies in, found "
            f"{metres(box)}, which reaches from {low:.4g} to {high:.4g} m along scene.up"
        )
    if float(pull.norm()) > 0:
        cosine = float(-(pull.double() @ up.double()) / pull.double().norm())
        angle = math.degrees(math.acos(min(1.0, cosine)))
        if angle > STEEP:
            warnings.warn(f"scene.gravity: pulls at {angle:.3g} degrees from scene.up, so that the ground is an incline: set "
                          "scene.up along -scene.gravity where it is not", stacklevel=5)  # fmt: skip


def directions(up, gravity, ground: Ground | None) -> tuple[Tensor, Tensor]:
    """(scene.up of unit length, scene.gravity [m/s^2]), (3,) each. Errors: ConfigError naming the key."""
    up, pull = vector(up, "up"), vector(gravity, "gravity")
    if not 0 < float(up.norm()) < torch.inf:
        raise ConfigError(f"scene.up: expected a direction, found {up.tolist()}")
    if ground is not None and bool(pull.norm() > 0) and not float(pull @ up) < 0:
        raise ConfigError(
            f"scene.gravity: expected a pull towards the ground, against scene.up = {up.tolist()}, found {pull.tolist()}; set both"
        )
    return up / up.norm(), pull


def vector(value, key: str) -> Tensor:
    """(3,) float32. Errors: ConfigError naming the key."""
    value = list(value) if isinstance(value, tuple) else value
    if isinstance(value, Tensor):
        value = value.tolist()
    check(f"scene.{key}", value, Three)
    return torch.tensor(value, dtype=torch.float32)


def held_out_cameras(names, footage_names: tuple[str, ...], fewest: int = 2) -> tuple[int, ...]:
    """Indices of the cameras that are named. Errors: ConfigError for an unknown name, or where fewer than `fewest` are left."""
    if names is not None and not isinstance(names, (list, tuple)):
        raise ConfigError(
            f"scene.holdout_cameras: expected a list of cameras like [3], found {names!r}"
        )
    indices = set()
    for name in names or ():
        if str(name) not in footage_names:
            known = ", ".join(footage_names)
            raise ConfigError(f"scene.holdout_cameras: no camera {name!r}; the scene has {known}")
        indices.add(footage_names.index(str(name)))
    if len(footage_names) - len(indices) < fewest:
        raise ConfigError(
            f"scene.holdout_cameras: expected at least two cameras to learn from, or one of a body whose rest shape is "
            f"given (scene.body.shape), found {len(footage_names)}, {len(indices)} of them held out"
        )
    return tuple(sorted(indices))


def held_out_frames(numbers, frames: tuple[int, ...]) -> tuple[int, ...]:
    """Indices of held-out frames: a list of frame numbers, or a count of last frames. They have to be the last ones.

    Errors: ConfigError where a number is unknown, where they are not the end of the sequence, or under three are left.
    """
    if isinstance(numbers, bool) or not isinstance(numbers, (int, list, tuple, type(None))):
        wanted = "a list of frame numbers or how many are held out"
        raise ConfigError(f"scene.holdout_frames: expected {wanted}, found {numbers!r}")
    if isinstance(numbers, int):
        check("scene.holdout_frames", numbers, Whole)
        numbers = frames[max(0, len(frames) - numbers) :]
    indices = set()
    for number in numbers or ():
        if number not in frames:
            there = f"{frames[0]} to {frames[-1]}"
            raise ConfigError(f"scene.holdout_frames: no frame {number}; the scene has {there}")
        indices.add(frames.index(number))
    if indices and sorted(indices) != list(range(len(frames) - len(indices), len(frames))):
        raise ConfigError(
            f"scene.holdout_frames: expected the last frames of {frames[0]} to {frames[-1]}, found {sorted(numbers)}; "
            "what comes after a gap cannot be learned from"
        )
    if len(frames) - len(indices) < 3:
        raise ConfigError(
            f"scene.frames, scene.holdout_frames: expected at least three frames to learn from, found {len(frames)}, "
            f"{len(indices)} of them held out"
        )
    return tuple(sorted(indices))
