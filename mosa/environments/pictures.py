"""What a camera sees of a task: the body's Gaussians among its solids and on the ground, which are drawn as Gaussians too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mosa.environments.arena import Arena
from mosa.evaluation.analysis.figures import side_by_side, to_uint8, write_strip, write_video
from mosa.physics.contact.colliders import Collider, colliders_from_config
from mosa.rendering.appearance.carried_splats import Seen, seen
from mosa.rendering.appearance.spherical_harmonics import constant_coefficients
from mosa.rendering.cameras import look_at
from mosa.twin.rollout_file import pose
from mosa.twin.shown_solids import OPACITY, WIDTH, lattice, shaded, surface
from mosa.types import Cameras

PITCH = 0.011  # [m] between the Gaussians of a solid
GROUND, TILE = 0.6, 0.03  # half width of the ground that is drawn [m], and its pitch
COLORS = {"box": (0.96, 0.96, 0.95), "jaw left": (0.25, 0.45, 0.75), "jaw right": (0.25, 0.45, 0.75),
          "column": (0.45, 0.47, 0.52)}  # fmt: skip
SKY = (0.80, 0.86, 0.92)
MARK, THIN = (0.85, 0.20, 0.20), 0.004  # colour of the target, and the pitch of its Gaussians [m]


def solid_surface(collider: Collider, place: Tensor | None) -> Tensor:
    """(K, 3) [m], where the solid is described, or at the pose `place` (3, 4)."""
    at, turned = pose(collider.motion, 1, 1.0)
    at, turned = (at[0], turned[0]) if place is None else (place[:, 3], place[:, :3])
    return surface(collider.shape, PITCH) @ turned.float().T + at.float()


def mark(target: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """As `scenery`, of a disc of radius `near` [m] at target (3,) on what lies there."""
    flat = lattice(2 * near, 2 * near, THIN)
    flat = flat[flat.norm(dim=1) <= near]
    points = target.float() + torch.stack([flat[:, 0], 0 * flat[:, 0] + THIN, flat[:, 1]], 1)
    return points, torch.full((len(points),), 0.5 * THIN), torch.tensor(MARK).expand(len(points), 3)


def scenery(
    solids: Sequence[Mapping[str, Any]], places: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """(means (K, 3), standard deviations (K,) [m], colours (K, 3)) of ground and solids. places: (solids, 3, 4) poses, None for
    those that they begin at."""
    flat = lattice(2 * GROUND, 2 * GROUND, TILE)
    ground = torch.stack([flat[:, 0], torch.full((len(flat),), -0.5 * TILE), flat[:, 1]], 1)
    odd = ((flat / 0.12).floor().sum(1) % 2)[:, None]
    tiles = odd * torch.tensor([0.08, 0.08, 0.08]) + torch.tensor([0.66, 0.65, 0.62])
    parts = [(ground, torch.full((len(ground),), 0.5 * TILE), tiles)]
    for k, solid in enumerate(colliders_from_config(solids, "solids")):
        points = solid_surface(solid, None if places is None else places[k])
        color = torch.tensor(COLORS.get(solid.name, (0.5, 0.5, 0.5)))
        wide = torch.full((len(points),), WIDTH * PITCH)
        parts.append((points, wide, shaded(points, torch.tensor([0.0, 1.0, 0.0]), color)))
    return tuple(torch.cat(values) for values in zip(*parts))


def camera_of(arena: Arena, size: int) -> Cameras:
    """One camera that sees what the body falls on."""
    focal = 1.5 * size
    top = arena.task.top
    target = torch.tensor([0.05, top + 0.05 if top > 0 else arena.task.watched_height, 0.0])
    eye = target + torch.tensor([0.55, 0.42, 1.05])
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    device = arena.rest.device
    w2c = look_at(eye, target, torch.tensor([0.0, 1.0, 0.0]))
    return Cameras(K[None].to(device), w2c[None].to(device), size, size, ("view",))


@torch.no_grad()
def picture(
    arena: Arena, x: Tensor, F_tot: Tensor, places: Tensor | None, size: int = 240, world: int = 0
) -> np.ndarray:
    """(size, size, 3) uint8 of a body with particles x (N, 3) [m], F_tot (N, 3, 3), the solids at their poses (K, 3, 4), and the
    target of the trial that is played in `world`."""
    device = arena.rest.device
    body = seen(arena.body, x[None].to(arena.rest), F_tot[None].to(arena.rest))
    parts = [scenery(arena.task.solids(), places)]
    if arena.trials is not None and (targets := arena.task.targets(arena.trials)) is not None:
        parts.append(mark(targets[world], arena.task.near))
    means, widths, colors = (torch.cat(values).to(arena.rest) for values in zip(*parts))
    round_ = widths.square()[:, None, None] * torch.eye(3, device=device)
    everything = Seen(
        torch.cat([body.means[0], means])[None], torch.cat([body.covariances[0], round_])[None],
        torch.cat([body.opacities, torch.full_like(widths, OPACITY)]),
        constant_coefficients(torch.cat([body.colors()[0], colors])),
    )  # fmt: skip
    image = everything.images(camera_of(arena, size), torch.tensor(SKY).to(arena.rest))[0, 0]
    return to_uint8(image.clamp(0, 1).cpu())


def film(
    arena: Arena, states: tuple[Tensor, Tensor, Tensor], world: int, frames: int, size: int = 240
) -> list[np.ndarray]:
    """`frames` pictures, from the first to the last moment, of one recorded world (`Played.states`)."""
    x, F_tot, places = states
    chosen = np.linspace(0, len(x) - 1, min(frames, len(x))).round().astype(int)
    moments = ((x[t, world], F_tot[t, world], places[t, world]) for t in chosen)
    return [picture(arena, *moment, size, world) for moment in moments]


def write_films(folder: Path, films: Mapping[str, list[np.ndarray]], name: str) -> None:
    """`<name>.png`, a row of pictures for each film; `<name>.mp4`, the films beside each other."""
    count = min(len(pictures) for pictures in films.values())
    rows = {title: np.stack(pictures[:count]) for title, pictures in films.items()}
    write_strip(folder / f"{name}.png", rows, frames=6)
    write_video(folder / f"{name}.mp4", side_by_side(rows), fps=12)
