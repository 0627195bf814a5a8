"""Memory of a run, from counts alone: a run that this machine cannot hold is refused before it is begun."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from mosa.data.checks.cameras import lines_of_sight, misses
from mosa.errors import ConfigError
from mosa.evaluation.uncertainty import DRAWS
from mosa.modules.body.material import RIVALS
from mosa.system.limits import machine_memory
from mosa.system.threads import cores
from mosa.types import Scene

BASE = 1.15e9  # bytes of a process on a CPU with its libraries and kernels, without data
PAIR_BYTES = 61.0  # of a particle, over its neighbours squared, while modes are found
MODE_BYTES, FRAME_BYTES = 32.0, 96.0  # of a particle: per deformation mode, per frame


@dataclass(frozen=True)
class Size:
    """particles; cameras, frames: of a sequence; pixels: of a picture; sequences: in all."""

    particles: int
    cameras: int
    frames: int
    pixels: int
    sequences: int


def particle_bytes(cfg: Mapping[str, Any], size: Size) -> float:
    """Bytes of a particle in that part of the run that takes most."""
    settings = cfg["reconstruction"]
    modes = settings["dynamic"]["modes"]
    moving = FRAME_BYTES * size.frames
    found = PAIR_BYTES * settings["neighbours"] ** 2 + MODE_BYTES * modes + moving
    kept = (3 * FRAME_BYTES + 12 * (DRAWS + len(RIVALS))) * size.sequences * size.frames
    return 1500 + max(found, cores() * moving + 1500, kept)


def memory_of(cfg: Mapping[str, Any], size: Size) -> float:
    """Bytes that the run takes at most, without what the networks of an adapter keep."""
    pictures = 2 * 16 * size.cameras * size.frames * size.pixels * size.sequences
    return BASE + pictures + particle_bytes(cfg, size) * size.particles


def check_memory(cfg: Mapping[str, Any], size: Size) -> None:
    """Errors: ConfigError with the largest number of particles that fits, where this machine does not hold the run."""
    wanted, there = memory_of(cfg, size), machine_memory()
    if wanted <= there:
        return
    empty = memory_of(cfg, replace(size, particles=0))
    most = int((there - empty) / particle_bytes(cfg, size))
    if most < 8 and empty < 0.5 * there:
        settings = cfg["reconstruction"]
        raise ConfigError(
            f"reconstruction.neighbours: {settings['neighbours']}, with "
            f"reconstruction.dynamic.modes: {settings['dynamic']['modes']}, take "
            f"{particle_bytes(cfg, size) / 1e9:.2g} GB for each particle, of this machine's "
            f"{there / 1e9:.1f} GB"
        )
    if most < 8:
        raise ConfigError(
            f"scene.scale: {size.sequences} x {size.cameras} x {size.frames} pictures of "
            f"{size.pixels} px take {empty / 1e9:.1f} GB, of this machine's {there / 1e9:.1f} GB; "
            "lower it or scene.frames"
        )
    key, above, dx = "particles", "", cfg["simulation"]["dx"]
    if dx is not None:
        coarser = dx * (size.particles / most) ** (1 / 3)
        key, above = f"dx: {dx} m", f" particles, a spacing of {coarser:.3g} m"
    raise ConfigError(
        f"simulation.{key}: {size.particles} take about {wanted / 1e9:.1f} GB, this machine has "
        f"{there / 1e9:.1f} GB; expected at most {most}{above}"
    )


def check_before_data(cfg: Mapping[str, Any], most: int) -> None:
    """`check_memory` of a built-in scene before its films are made, from the configuration alone. most: particles where their
    number is left open. Errors: ConfigError."""
    keys = cfg["scene"]
    if keys.get("format") != "builtin" or cfg["simulation"]["dx"] is not None:
        return
    from mosa.data.synthetic import sequences
    from mosa.data.synthetic.bodies.objects import object_named

    film, count = object_named(keys["name"]).footage, len(sequences(keys["name"]))
    if keys.get("sequence", "train") != "train":
        count = 1
    pixels = round((film.size * keys["scale"]) ** 2)
    check_memory(cfg, Size(particles_of(cfg, most), film.cameras, film.frames, pixels, count))


def check_with_data(cfg: Mapping[str, Any], scene: Scene, others: int, most: int) -> None:
    """`check_memory` of films that were read, with `others` further sequences. most: particles where their number is left open.
    Errors: ConfigError."""
    seen = ball_of(scene)
    radius = float((scene.box[1] - scene.box[0]).min()) / 6 if seen is None else seen[1]
    particles, dx = particles_of(cfg, most), cfg["simulation"]["dx"]
    if dx is not None:
        cells = 4.2 * min(radius / dx, 1e30) ** 3
        particles = round(cells * cfg["simulation"]["particles_per_cell"])
    cameras, frames, height, width = scene.images.shape[:4]
    check_memory(cfg, Size(particles, cameras, frames, height * width, 1 + others))


def ball_of(scene: Scene) -> tuple[Tensor, float] | None:
    """(centre (3,), radius) [m] of the object as frame 0 shows it; None where fewer than two mattes are whole."""
    chosen, origins, directions, tangents = lines_of_sight(scene, 0)
    if len(chosen) < 2:
        return None
    place, _ = misses(origins, directions, tangents)
    return place, float((tangents * ((place - origins) * directions).sum(1)).mean())


def particles_of(cfg: Mapping[str, Any], most: int) -> int:
    """Of the configuration, where it gives their number."""
    particles = cfg["simulation"]["particles"]
    return most if particles == "auto" else int(particles)
