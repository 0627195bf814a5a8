"""Making a built-in sequence once: simulate, carry the surface along, film it, and keep the result on disk."""

from __future__ import annotations

import functools
import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp as wp

from mosa.data.formats.footage import WHITE
from mosa.data.images.reading import composite, resize
from mosa.data.synthetic import raycast_kernels
from mosa.data.synthetic import surface as surfaces
from mosa.data.synthetic.bodies import objects
from mosa.data.synthetic.bodies.objects import BuiltinObject, drop_named, object_named
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.drop import simulate
from mosa.data.synthetic.renderer import render_surface, ring_of_cameras
from mosa.data.synthetic.surface import Skin, Surface, extract_surface, flowing_surface
from mosa.errors import ConfigError, DataError
from mosa.system.caches import default_cache
from mosa.system.npz import read_npz, write_npz
from mosa.system.progress import tqdm
from mosa.system.threads import threaded
from mosa.types import Cameras

log = logging.getLogger(__name__)

# part of the key of a cached sequence: raise it whenever what is made changes
VERSION = 1
TRUTH_PARTICLES = 8000
Built = tuple[Surface, np.ndarray, Skin]


@dataclass(frozen=True)
class Film:
    """A filmed sequence. pictures: (V, T, H, W, 4) uint8, straight alpha; rest: (M, 3), positions: (T, M, 3) [m] of at most
    8000 of the truth's particles; rotation: (3, 3); velocity: (3,) [m/s]."""

    pictures: np.ndarray
    rest: np.ndarray
    positions: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray


def cameras_of(body: BuiltinObject, seed: int) -> Cameras:
    """The cameras of an object at its native image size; the seed turns the ring."""
    film = body.footage
    turn = float(np.random.default_rng([seed, 7]).uniform(0, 2 * np.pi / film.cameras))
    return ring_of_cameras(
        film.cameras, film.size, target=(0.0, film.target, 0.0), distance=film.distance, elevations=film.elevations,
        field=film.field, turn=turn,
    )  # fmt: skip


def film_file(name: str, sequence: str, material: str, seed: int, cache=None) -> Path:
    """Where a take lies once it has been made."""
    hidden = object_named(name).material.variant(material)
    made_of: tuple = (VERSION, object_named(name), hidden, drop_named(name, sequence), seed)
    if object_named(name).remesh:
        made_of += (surfaces.LEVEL,)
    if object_named(name).meeting != objects.Meeting():
        made_of += (object_named(name).meeting, hidden.law)
    key = hashlib.sha256(repr(made_of).encode()).hexdigest()[:12]
    folder = Path(cache) if cache is not None else default_cache()
    return folder / "builtin" / f"{name}-{sequence}-{material}-{seed}-{key}.npz"


def make(
    name: str,
    sequence: str,
    *,
    material: str = "anisotropic",
    seed: int = 0,
    cache: str | Path | None = None,
    progress: bool = True,
) -> Film:
    """The take of a sequence, from the cache folder where it lies there. Equal arguments give equal bytes.

    Errors: ConfigError for an unknown name, sequence or material, or a cache folder that cannot be written.
    """
    file = film_file(name, sequence, material, seed, cache)
    if (kept := read_film(file)) is not None:
        return kept
    take = film_drop(name, sequence, material, seed, progress)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_npz(file, vars(take))
    except OSError as error:
        way = "set XDG_CACHE_HOME to" if cache is None else "give it"
        found = f"cannot write {file} ({error.strerror}); {way} another folder"
        raise ConfigError(f"scene.cache: {found}") from error
    return take


@functools.lru_cache(maxsize=1)
def built(shape_name: str, pitch: float, spacing: float, seed: int) -> Built:
    """Surface, particles (N, 3) [m] and skin of an object, the same in every sequence and material: not to be changed."""
    shape = SHAPES[shape_name]
    # one generator a purpose: the same texture, lattice and cameras in every sequence and material of a seed
    surface = extract_surface(shape, pitch, np.random.default_rng([seed, 1]))
    particles = surfaces.fill(shape, spacing, np.random.default_rng([seed, 2]))
    return surface, particles, surfaces.bind(surface.vertices, particles, spacing)


def film_drop(name: str, sequence: str, material: str, seed: int, progress: bool) -> Film:
    """Simulate and film, without the cache."""
    body, drop = objects.OBJECTS[name], drop_named(name, sequence)
    film = body.footage
    surface, particles, skin = built(body.shape, body.pitch, body.spacing, seed)
    label = f"{name}/{sequence} (synthetic)"
    how = {"unit": "frame", "disable": not progress, "dynamic_ncols": True}
    with tqdm(total=film.frames - 1, desc=f"{label}: simulate", **how) as bar:
        fall = simulate(
            body, body.material.variant(material), particles, surface.vertices, drop, body.drops["train"],
            progress=lambda frame: bar.update(),
        )  # fmt: skip
    cameras = cameras_of(body, seed)

    def film_at(x: np.ndarray) -> np.ndarray:
        if not body.remesh:
            return render_surface(surface, skin.follow(x), cameras)
        # painted as the surface
        paint = SHAPES[body.shape].color(particles, np.random.default_rng([seed, 1]))
        found = flowing_surface(x, paint, body.spacing, body.pitch)
        return render_surface(found, found.vertices, cameras)

    wp.load_module(raycast_kernels, device="cpu")  # which each of the threads would compile
    films = threaded(film_at, fall.positions)
    pictures = list(tqdm(films, total=film.frames, desc=f"{label}: film", **how))
    chosen = np.sort(np.random.default_rng([seed, 3]).permutation(len(particles))[:TRUTH_PARTICLES])
    return Film(
        np.stack(pictures, 1), fall.rest[chosen].astype(np.float32), fall.positions[:, chosen].astype(np.float32),
        fall.rotation, fall.velocity,
    )  # fmt: skip


def read_film(file: Path) -> Film | None:
    """A cached take, or None where there is none or a damaged one, which is then made again."""
    if not file.is_file():
        return None
    try:
        stored = read_npz(file)
        take = Film(*(stored[n] for n in ("pictures", "rest", "positions", "rotation", "velocity")))
        points = take.pictures.shape[1:2] + take.rest.shape
        found = take.pictures.ndim, take.positions.shape, take.rotation.shape, take.velocity.shape
        if found != (5, points, (3, 3), (3,)):
            raise DataError(f"{file}: not a film of a built-in scene")
        return take
    except (DataError, KeyError) as error:
        log.warning("%s: damaged cache file (%s); making it again", file, error)
        return None


def pictures_to_footage(pictures: np.ndarray, size: tuple[int, int]) -> tuple[torch.Tensor, ...]:
    """Images (V, T, h, w, 3) on white and mattes (V, T, h, w), area averages of RGBA pictures (V, T, H, W, 4)."""
    V, T, H, W = pictures.shape[:4]
    mattes = np.empty((V, T, size[1], size[0]), np.float32)
    images = np.empty((*mattes.shape, 3), np.float32)

    def convert(index: tuple[int, int]) -> None:
        alpha = pictures[*index, ..., 3]
        image, matte = np.ones((H, W, 3), np.float32), np.zeros((H, W), np.float32)
        rows, columns = (np.flatnonzero(alpha.any(axis)) for axis in (1, 0))
        if len(rows):  # around the object there is nothing but white
            window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            part = pictures[*index, *window].astype(np.float32) / 255
            image[window] = composite(part[..., :3], part[..., 3], WHITE)
            matte[window] = part[..., 3]
        images[index], mattes[index] = resize(image, *size), resize(matte, *size)

    for _ in threaded(convert, list(np.ndindex(V, T))):
        pass
    return torch.from_numpy(images), torch.from_numpy(mattes)
