"""What a run will cost in time and memory, estimated before it is spent.

Seconds come from a small calibration on this machine (a frame of a rollout with as many particles as the run will have, a picture
of as many Gaussians in a window as large as the object's) and from counts. What is not rolled out or rendered is scaled from
measurements on one machine by how fast this one renders. Memory comes from counts alone.
"""

from __future__ import annotations

import math
import os
import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from mosa.config.build import build_body, measured
from mosa.config.command_settings import TrainSettings
from mosa.data.checks.cameras import lines_of_sight, misses
from mosa.errors import ConfigError, MosaError
from mosa.evaluation.uncertainty import DRAWS
from mosa.modules.body.body import Body, Start, World
from mosa.modules.body.material import RIVALS
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.search.backbone import rollouts_of_search
from mosa.modules.fitting.search.ground import ASKED, FRICTIONS, RIVAL_ITERATIONS, TRIED
from mosa.modules.fitting.stages import Stage
from mosa.physics.engine.budget import KEPT_ON_CPU
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.motion.response import MODES
from mosa.reconstruction.resolution import grid_spacing
from mosa.rendering.rasterizer import rasterize
from mosa.system.limits import machine_memory
from mosa.training.lit_mosa import LitMosa
from mosa.types import RUBBING, Cameras, Scene

BASE = 1.15e9
"""Bytes of a process on a CPU with its libraries and kernels, without data."""
PAIR_BYTES = 61.0
"""Bytes of a particle over its neighbours squared, while the deformation modes are found; most that a particle takes."""
MODE_BYTES, FRAME_BYTES = 32.0, 96.0
"""Of a particle: for each deformation mode; for each frame of a rollout."""
BACKWARD = 2.5
"""Cost of a step with gradients over one without, measured on the rabbit."""
ADAPTER_COST, ADAPTER_BYTES = 1.8, 4.8e3
"""Of a step with networks over one without; per particle and evaluation of theirs."""
STIFFNESS_COST = 1.5
"""Of a rollout with an adapter that is a stiffness over one without."""
SIDE_BY_SIDE = 10
"""Worlds that take a GPU as long as one rollout, rounded down: 32 of 4040 particles take 2.4 times as long as one, 2.9 times with
gradients (docs/performance.md)."""
KERNELS = 3.0
"""Seconds of a fit that no step takes: the trainer, and kernels that its last stage is the first to need."""
MEASURED = 20_000
"""Particles and Gaussians of the calibration at most: from there on the time is proportional to their number."""
REFERENCE_PICTURE = 7.5e-3
"""Seconds that `speed_of_pictures` found on the machine that the constants of `seconds_of_parts` were measured on."""


@dataclass(frozen=True)
class Size:
    """particles; cameras, frames: of a sequence; pixels: of a picture; sequences: in all; taught: that are learned from."""

    particles: int
    cameras: int
    frames: int
    pixels: int
    sequences: int
    taught: int


@dataclass(frozen=True)
class Speeds:
    """frame: seconds of a frame of a rollout of the run's body; picture: seconds of one window, forward and backward; relative:
    seconds that this machine takes over those of the one the constants were measured on."""

    frame: float
    picture: float
    relative: float


def duration(seconds: float) -> str:
    """In words."""
    if not math.isfinite(seconds):
        return "not known yet"
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5940 else f"{seconds / 3600:.1f} h"


def peak_memory() -> float:
    """Bytes that this process held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# ------------------------------------------------------------------------------------------------ memory
def particle_bytes(cfg: Mapping[str, Any], size: Size) -> float:
    """Bytes of a particle in that part of the run that takes most."""
    settings = cfg["reconstruction"]
    modes = settings["dynamic"]["modes"]
    found = (
        PAIR_BYTES * settings["neighbours"] ** 2 + MODE_BYTES * modes + FRAME_BYTES * size.frames
    )
    kept = (
        FRAME_BYTES * 3 * size.sequences * size.frames
        + 12 * (DRAWS + len(RIVALS)) * size.sequences * size.frames
    )
    return 1500 + max(found, cores() * FRAME_BYTES * size.frames + 1500, kept)


def memory_of(cfg: Mapping[str, Any], size: Size) -> float:
    """Bytes that the run takes at most, without what the networks of an adapter keep."""
    pictures = 2 * 16 * size.cameras * size.frames * size.pixels * size.sequences
    return BASE + pictures + particle_bytes(cfg, size) * size.particles


def check_memory(cfg: Mapping[str, Any], size: Size) -> float:
    """`memory_of`. Errors: ConfigError with the largest number of particles that fits, where this machine does not hold the run."""
    wanted, there = memory_of(cfg, size), machine_memory()
    if wanted <= there:
        return wanted
    empty = memory_of(cfg, replace(size, particles=0))
    most = int((there - empty) / particle_bytes(cfg, size))
    if most < 8 and empty < 0.5 * there:
        settings = cfg["reconstruction"]
        raise ConfigError(
            f"reconstruction.neighbours: {settings['neighbours']}, with reconstruction.dynamic.modes of "
            f"{settings['dynamic']['modes']}, take {particle_bytes(cfg, size) / 1e9:.2g} GB for each particle, of "
            f"this machine's {there / 1e9:.1f} GB; lower them"
        )
    if most < 8:
        raise ConfigError(
            f"scene.scale: {size.sequences} x {size.cameras} x {size.frames} pictures of {size.pixels} px take "
            f"{empty / 1e9:.1f} GB, which this machine's {there / 1e9:.1f} GB do not hold; lower scene.scale, or "
            "restrict scene.frames"
        )
    if cfg["simulation"]["dx"] is not None:
        dx = cfg["simulation"]["dx"]
        raise ConfigError(
            f"simulation.dx: {dx} m make about {size.particles} particles and take {wanted / 1e9:.1f} GB; this "
            f"machine has {there / 1e9:.1f} GB; expected at most {most} particles, a spacing of "
            f"{dx * (size.particles / most) ** (1 / 3):.3g} m"
        )
    raise ConfigError(
        f"simulation.particles: {size.particles} take about {wanted / 1e9:.1f} GB, this machine has "
        f"{there / 1e9:.1f} GB; expected at most {most}"
    )


# ------------------------------------------------------------------------------------------------ calibration
def size_of(
    cfg: Mapping[str, Any], scene: Scene, others: int, taught: int, most: int
) -> tuple[Size, float]:
    """The run's size, and the radius [m] of the object as frame 0 shows it. most: particles where their number is left open."""
    chosen, origins, directions, tangents = lines_of_sight(scene, 0)
    radius = float((scene.box[1] - scene.box[0]).min()) / 6
    if len(chosen) >= 2:
        place, _ = misses(origins, directions, tangents)
        radius = float((tangents * ((place - origins) * directions).sum(1)).mean())
    dx = cfg["simulation"]["dx"]
    particles = particles_of(cfg, most)
    if dx is not None:
        particles = round(
            4.2 * min(radius / dx, 1e30) ** 3 * cfg["simulation"]["particles_per_cell"]
        )
    cameras, frames, height, width = scene.images.shape[:4]
    return Size(int(particles), cameras, frames, height * width, 1 + others, taught), radius


def ball(count: int, radius: float) -> torch.Tensor:
    """(about count, 3) lattice points in a ball about the origin, and as evenly spread as a filling's."""
    spacing = radius * (4.19 / max(count, 8)) ** (1 / 3)
    along = spacing * (
        torch.arange(2 * math.ceil(radius / spacing)) + 0.5 - math.ceil(radius / spacing)
    )
    points = torch.cartesian_prod(along, along, along)
    inside = points[points.norm(dim=1) < radius]
    return inside if len(inside) >= 8 else points[:8]


def body_like(cfg: Mapping[str, Any], scene: Scene, count: int, radius: float) -> Body:
    """A ball of `count` particles of the object's size, with the run's law, adapter and settings."""
    points = ball(count, radius)
    n, spacing = len(points), (4.19 * radius**3 / len(points)) ** (1 / 3)
    covariances = (torch.eye(3) * (0.35 * spacing) ** 2).expand(n, 3, 3)
    tensors = {
        "rest": points,
        "volume": torch.full((n,), spacing**3),
        "colors": torch.full((n, 3), 0.5),
        "opacities": torch.full((n,), 0.8),
        "covariances": covariances,
    }
    dx = grid_spacing(spacing, cfg["simulation"]["particles_per_cell"])
    return build_body(measured(cfg, scene, dx), tensors)


def speed_of_rollouts(
    body: Body, frame_dt: float, gravity: torch.Tensor, up: torch.Tensor
) -> float:
    """Seconds of a frame of frame_dt [s]: of two in free flight, corrected as the fit's are, after some that load the kernels."""
    world = World(None, gravity, up, torch.tensor([[-1e5] * 3, [1e5] * 3]))
    zero = torch.zeros_like(body.rest[0])
    start = Start(torch.eye(3).to(zero), body.center, zero, zero)
    seen = None if body.settings.adaptive else body.rest.expand(3, -1, 3)
    took = math.inf
    with torch.no_grad():
        for _ in range(2):
            began = time.perf_counter()
            body.simulate(
                start,
                world,
                3,
                frame_dt,
                model=body.model().only(adapter=False),
                observed=seen,
                gain=0.1,
            )
            if body.rest.is_cuda:
                torch.cuda.synchronize()
            took = (time.perf_counter() - began) / 2
    return took


def speed_of_pictures(count: int, side: int, device: str) -> float:
    """Seconds of a picture of side x side px that a ball of `count` Gaussians nearly fills, forward and backward."""
    side = max(side, 16)
    K = torch.tensor(
        [[2.5 * side, 0.0, 0.5 * side], [0.0, 2.5 * side, 0.5 * side], [0.0, 0.0, 1.0]]
    )
    w2c = torch.eye(4)
    w2c[2, 3] = 6.0
    pair = torch.stack([K, K]), torch.stack([w2c, w2c])
    cameras = Cameras(*pair, side, side, ("a", "b")).to(device)
    points = ball(min(count, MEASURED), 1.0).to(device)
    n, background = len(points), torch.ones(3, device=device)
    covariance = torch.eye(3, device=device) * (0.35 * (4.19 / n) ** (1 / 3)) ** 2
    covariances = covariance.expand(n, 3, 3).contiguous()
    state = torch.zeros(2, dtype=torch.long, device=device)
    took = []
    for _ in range(3):
        means = points.clone().requires_grad_(True)
        opacities = torch.full((n,), 0.8, device=device)
        colors = torch.full((1, n, 3), 0.5, device=device).requires_grad_(True)
        began = time.perf_counter()
        image, alpha = rasterize(
            means[None], covariances[None], opacities, colors, cameras, state, background
        )
        (image.sum() + alpha.sum()).backward()
        if means.is_cuda:
            torch.cuda.synchronize()
        took.append((time.perf_counter() - began) / 2)
    return min(took[1:]) * max(1.0, count / MEASURED)


# ------------------------------------------------------------------------------------------------ time
def particles_of(cfg: Mapping[str, Any], most: int) -> int:
    """Of the configuration, where it gives their number."""
    particles = cfg["simulation"]["particles"]
    return most if particles == "auto" else int(particles)


def before_data(cfg: Mapping[str, Any], most: int) -> str:
    """One line on reading the data, from the configuration alone: seconds of a built-in scene. most: particles where their number
    is left open. Errors: ConfigError where such a run does not fit into this machine's memory."""
    keys = cfg["scene"]
    if keys.get("format") != "builtin":
        return "data: pictures of a folder; what the rest takes is said when they have been read"
    from mosa.data.synthetic import sequences
    from mosa.data.synthetic.bodies.objects import object_named
    from mosa.data.synthetic.films import film_file

    film, names = object_named(keys["name"]).footage, sequences(keys["name"])
    if keys.get("sequence", "train") != "train":
        names = (keys["sequence"],)
    if cfg["simulation"]["dx"] is None:
        pixels = round((film.size * keys["scale"]) ** 2)
        taught = 1 + len(keys.get("also_train") or ())
        check_memory(
            cfg,
            Size(particles_of(cfg, most), film.cameras, film.frames, pixels, len(names), taught),
        )
    made = [
        film_file(keys["name"], s, keys["material"], keys["seed"], keys.get("cache")).is_file()
        for s in names
    ]
    pixels = film.cameras * film.frames * film.size**2
    seconds = (
        1.5
        + 4e-8 * pixels * len(names)
        + 2.3e-7 * pixels * made.count(False)
        + (0 if all(made) else 6)
    )
    return f"data: {len(names)} sequences, {made.count(False)} of them to be made, about {duration(seconds)}"


def newton_rollouts(module: LitMosa, stage: Stage) -> float:
    """About how many rollouts, one after another, a stage of Gauss-Newton takes at most."""
    planned = Identification(
        module.body, module.takes, module.world, stage, module.criterion, module.settings, seats=0
    )
    columns = sum(b.size for b in planned.newton.blocks)
    together = SIDE_BY_SIDE if module.body.rest.is_cuda else planned.threads(columns)
    # the residuals, the noise, one or two steps that are tried, the distance
    each = columns / together + 5
    begun = planned.calibrating and not stage.looks_again
    contacts, sought = 0.0, module.ground_is_sought
    if begun and sought:
        contacts += (3 + len(RUBBING) * len(FRICTIONS)) * (TRIED * each + 3)
    if stage.learns_adapter and sought:
        contacts += ASKED * RIVAL_ITERATIONS * each
    learned = module.body.material.learned
    searched = rollouts_of_search(learned, len(planned.offsets), each) if begun else 0
    return len(planned.pairs) * (stage.iterations * each + contacts + searched)


def seconds_of_fit(module: LitMosa, speeds: Speeds, frames: int) -> float:
    """Of the stages of `module`, at most: rollouts of Gauss-Newton, steps of Adam with their pictures."""
    body = module.body
    settings = TrainSettings.part(module.cfg)
    rollout, views = (frames - 1) * speeds.frame, settings.fit.views
    networks = body.adapter is not None and not body.adapter.steady
    step = (BACKWARD * rollout + views * frames * speeds.picture) * len(module.takes)
    again = settings.reconstruction.informed
    looks = max(1, sum(stage.looks_again for stage in module.stages))
    pictures = len(module.takes) * (frames - 1) * speeds.picture
    each = 0.7 * again.iterations * again.views * pictures
    total = KERNELS + looks * each
    later = any(stage.newton and not stage.calibrates for stage in module.stages)
    if each and again.response and later:
        total += each + 0.15 * 3 * MODES * again.response * pictures
    for stage in module.stages:
        adapted = ADAPTER_COST if stage.learns_adapter and networks else 1.0
        stiff = STIFFNESS_COST if stage.learns_adapter and body.adapter is not None else 1.0
        if stage.newton:
            total += newton_rollouts(module, stage) * rollout * stiff
        else:
            total += stage.iterations * step * adapted
    return total


def seconds_of_parts(cfg: Mapping[str, Any], size: Size, window: int, module: LitMosa, speeds: Speeds,
                     stored: bool) -> dict[str, float]:  # fmt: skip
    """Seconds of reconstruction, starts, fit and evaluation. window: pixels of the object's; stored: whether the reconstruction
    lies in the cache."""
    settings, slow, picture = cfg["reconstruction"], speeds.relative, speeds.picture
    moving, dynamic = size.frames - 1, settings["dynamic"]
    tracked = dynamic["track_iterations"] * moving * dynamic["track_views"]
    tracked *= dynamic["model"] == "modes"
    motion = 0.7 * picture * (tracked + dynamic["iterations"] * moving)
    motion += 1.2e-3 * slow * size.particles
    pictures = sum(
        settings[part]["iterations"] * settings[part]["views"] for part in ("static", "appearance")
    )
    free = min(settings["geometry"]["frames"], size.frames // 2)
    still = slow * (5 + 4e-5 * size.cameras * free * window) + picture * pictures
    reconstruction = (1.0 if stored else still + motion) + (size.taught - 1) * motion
    poses = (size.sequences - 1) * (0.5 + 3e-4 * size.cameras * window)
    poses += size.sequences * 4e-5 * size.cameras * window
    rollout = moving * speeds.frame
    adapted = any(stage.newton and stage.learns_adapter for stage in module.stages)
    draws = DRAWS + len(RIVALS) if adapted else 0
    count = min(size.particles, cfg["evaluation"]["assignment"])
    distances = 0.6 * size.frames * 0.02 + 4 * 0.4 * (count / 2048) ** 2.4
    shown = 3 * size.sequences * size.cameras * size.frames
    stiff = STIFFNESS_COST if module.body.adapter is not None else 1.0
    evaluation = (3 + cfg["evaluation"]["floor"] + draws) * size.sequences * rollout * stiff
    evaluation += (
        slow * (2 + 4 * size.sequences * distances / min(cores(), 4) + shown * 1e-7 * size.pixels)
        + 0.4 * picture * shown
    )
    fit = seconds_of_fit(module, speeds, size.frames)
    starts = slow * poses
    return dict(reconstruction=reconstruction, starts=starts, fit=fit, evaluation=evaluation)


def estimate(cfg: Mapping[str, Any], scene: Scene, others: int, taught: int, device: str, *, stored: bool = False,
             most: int = MEASURED) -> tuple[dict[str, float], float]:  # fmt: skip
    """(seconds of each part that follows the data, bytes of memory at most). Changes no random state.

    most: particles where their number is left open. Errors: ConfigError where this machine's memory does not hold the run."""
    size, radius = size_of(cfg, scene, others, taught, most)
    memory = check_memory(cfg, size)
    margin, first = cfg["reconstruction"]["margin"], scene.training_frames[:1]
    windows = object_windows(scene, scene.training_cameras, first, margin=margin)
    window = windows.images.shape[1] * windows.images.shape[2]
    with torch.random.fork_rng(devices=[]):
        body = body_like(cfg, scene, min(size.particles, MEASURED), radius)
        record = measured(cfg, scene, body.settings.dx)
        module = LitMosa.from_record(
            record, body, takes=[None] * taught, background=scene.background
        )
        try:
            frame_dt = float(scene.times[1] - scene.times[0])
            frame = speed_of_rollouts(body.to(device), frame_dt, scene.gravity, scene.up) * max(
                1.0, size.particles / MEASURED
            )
        except (
            MosaError
        ):  # a stand-in for the body: what is wrong with the real one is said where it is simulated
            frame = math.inf
        reference = speed_of_pictures(3000, 76, device)
        picture = speed_of_pictures(cfg["reconstruction"]["points"], round(window**0.5), device)
    speeds = Speeds(frame, picture, reference / REFERENCE_PICTURE)
    parts = seconds_of_parts(cfg, size, window, module, speeds, stored)
    if body.adapter is not None and not body.adapter.steady:
        evaluations = (size.frames - 1) * body.settings.max_substeps / body.settings.stride
        memory += min(evaluations, 100) * size.particles * ADAPTER_BYTES
    if any(not stage.newton for stage in module.stages) and device == "cpu":
        memory += KEPT_ON_CPU
    return parts, memory


def estimate_text(parts: Mapping[str, float], memory: float) -> str:
    """One line on what `estimate` found."""
    each = ", ".join(f"{name} {duration(seconds)}" for name, seconds in parts.items())
    return f"this run takes about {duration(sum(parts.values()))}: {each}; {memory / 1e9:.1f} GB"
