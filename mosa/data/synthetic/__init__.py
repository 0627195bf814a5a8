"""Built-in scenes: synthetic stand-ins for captures, made on first use. Named as synthetic wherever they appear."""

from __future__ import annotations

from pathlib import Path

import torch

from mosa.data.formats.footage import Footage, frame_range
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.images.reading import scaled_size
from mosa.data.synthetic.bodies.objects import object_named
from mosa.data.synthetic.drop import GRAVITY
from mosa.data.synthetic.films import cameras_of, make, pictures_to_footage
from mosa.errors import ConfigError
from mosa.rendering.cameras import scale_cameras
from mosa.settings import Whole, check
from mosa.types import Ground, Scene, Truth

BOX = ((-0.7, -0.1, -0.7), (0.7, 1.0, 0.7))


def sequences(name: str) -> tuple[str, ...]:
    """Names of the sequences of a built-in scene, the training one first."""
    return tuple(object_named(name).drops)


def held_out_names(name: str) -> tuple[str, ...]:
    """Names of the sequences that are not for training."""
    return tuple(s for s in sequences(name) if s != "train")


def load_builtin(
    *,
    name: str,
    sequence: str = "train",
    material: str = "anisotropic",
    seed: int = 0,
    scale: float = 0.5,
    frames=None,
    last_free_frame: int | None = None,
    holdout_cameras=(),
    holdout_frames=(),
    cache: str | Path | None = None,
) -> Scene:
    """Scene of a built-in sequence, made and cached on first use. material: anisotropic | isotropic (its twin).

    Errors: ConfigError naming the key."""
    check("scene.seed", seed, Whole)
    body = object_named(name)
    film, hidden = body.footage, body.material.variant(material)
    size = scaled_size(film.size, film.size, scale)
    take = make(name, sequence, material=material, seed=seed, cache=cache)
    chosen = frame_range(list(range(film.frames)), frames, f"{name}/{sequence}")
    images, mattes = pictures_to_footage(take.pictures[:, chosen], size)
    if chosen[0] != 0:
        raise ConfigError(
            f"scene.frames: built-in sequences start at frame 0, where their pose is known; found {list(frames)}"
        )
    cameras, times = scale_cameras(cameras_of(body, seed), scale), torch.tensor(chosen) / film.fps
    footage = Footage(cameras, tuple(chosen), times, images, mattes, torch.ones(3))
    known = take.rest, take.positions[chosen], take.rotation, take.velocity
    rest, positions, rotation, velocity = (torch.tensor(a, dtype=torch.float32) for a in known)
    truth = Truth(rest, positions, rotation, velocity, hidden.summary())
    reach, box = body.reach, BOX
    if reach is not None:
        box = ((-reach, BOX[0][1], -reach), (reach, BOX[1][1], reach))
    meeting = body.meeting
    ground = Ground(meeting.stated, meeting.mode, meeting.friction)
    return scene_from_footage(
        footage, name=name, gravity=GRAVITY, box=box, ground=ground, density=hidden.density, sequence=sequence,
        last_free_frame=last_free_frame, holdout_cameras=holdout_cameras, holdout_frames=holdout_frames, truth=truth,
        known_parameters=hidden.known, synthetic=True,
    )  # fmt: skip
