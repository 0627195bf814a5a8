"""Images of a motion with its ground and its solids, from a camera that sees all of it or follows the body."""

from __future__ import annotations

from collections.abc import Sequence
from warnings import warn

import numpy as np
import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.evaluation.analysis.comparison import (
    DARK,
    ground_lines,
    ground_shadow,
    on_ground,
    outline,
)
from mosa.modules.body.body import Body, World
from mosa.physics.contact.colliders import Collider, reach
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.reference import signed_distance
from mosa.physics.engine.inputs import numbers
from mosa.rendering.appearance.carried_splats import seen
from mosa.rendering.cameras import centers, look_at
from mosa.system.progress import tqdm
from mosa.system.threads import cores
from mosa.twin.rollout_file import poses
from mosa.twin.shown_solids import with_solids
from mosa.types import Cameras, Rollout

LENS = 1.6
"""Of the camera: its focal length over the picture's shorter side."""
Views = Sequence[float] | Sequence[Sequence[float]] | Tensor


def film(
    body: Body,
    world: World,
    rollout: Rollout,
    solids: Sequence[Collider],
    size: int | Sequence[int],
    view: Views | None,
    zoom: float | Sequence[float],
    shadow: bool,
    progress: bool = False,
) -> Tensor:
    """(T, height, width, 3) images, as `Twin.render` has them. Warns of a solid that the camera is inside of."""
    up = world.up.to(body.rest)
    cameras, target = film_cameras(body, up, rollout, solids, size, view, zoom)
    width, height = cameras.width, cameras.height
    shown = seen(body, rollout.x, rollout.F_tot)
    ends, convex = [len(shown.opacities)], [False]
    for k, solid in enumerate(solids):
        at, turned = (part[:, 0] for part in poses([solid], rollout.times))
        q = ((centers(cameras).double() - at)[:, None] @ turned)[:, 0]
        if 0 < reach(solid.shape) and float(signed_distance(solid.shape, q).min()) < 0:
            named = solid.name or f"colliders[{k}]"
            warn(f"{named}: the camera is inside of it: not drawn", stacklevel=4)
            continue
        shown = with_solids(shown, solids[k : k + 1], rollout.times, up, body.size / 30)
        ends.append(len(shown.opacities))
        convex.append(not isinstance(solid.shape, SignedDistanceField))
    white, images, floors = np.full((height, width, 3), 255, np.uint8), [], []
    frames, w2c, K = len(rollout.x), cameras.w2c, cameras.K
    with tqdm(total=frames, desc="film", unit="frame", disable=not progress) as bar:
        for t, points in enumerate(shown.means):
            camera = cameras.select([t])
            # the camera has moved
            if t == 0 or not (w2c[t].equal(w2c[t - 1]) and K[t].equal(K[t - 1])):
                lines = ground_lines(world, camera, body.size, target.cpu())
                floor = on_ground(white, lines, 1, torch.ones(3)) / np.float32(255)
            floors.append(floor.copy())
            if lines and shadow:
                dark = [
                    ground_shadow(part, world, camera, body.size, filled)
                    for part, filled in zip(points.tensor_split(ends[:-1]), convex)
                ]
                # none shines through between the body's splats
                free = 1 - outline(points[: ends[0]], camera, body.size)
                floors[-1] *= (1 - DARK * free * np.max(dark, 0))[..., None]
            if len(floors) == cores() or t == frames - 1:
                some = list(range(t + 1))[-len(floors) :]
                behind = torch.from_numpy(np.stack(floors)).to(body.rest)
                images.append(shown.during(some).film(cameras.select(some), behind))
                bar.update(len(floors))
                floors = []
    return torch.cat(images).clamp(0, 1).cpu()


def film_cameras(
    body: Body,
    up: Tensor,
    rollout: Rollout,
    solids: Sequence[Collider],
    size: int | Sequence[int],
    view: Views | None,
    zoom: float | Sequence[float],
) -> tuple[Cameras, Tensor]:
    """(a camera for each frame, the middle (3,) [m] of what they see)."""
    low, high = rollout.x.amin((0, 1)), rollout.x.amax((0, 1))
    # solids about as large as the body are in the picture as a whole, tables and walls as far as they reach into it
    for at, solid in zip(poses(solids, rollout.times)[0].unbind(1) if solids else (), solids):
        if 0 < (far := reach(solid.shape)) < body.size:
            low = torch.minimum(low, at.amin(0).to(low) - far)
            high = torch.maximum(high, at.amax(0).to(high) + far)
    target = 0.5 * (low + high)
    side = torch.tensor([0.9, 0.0, 1.0]).to(body.rest)
    level = side - (side @ up) * up
    side = level if float(level.norm()) > 1e-3 else torch.roll(up, 1)
    width, height = (size, size) if isinstance(size, int) else size
    frames = len(rollout.x)
    nearer = spread(np.log(np.atleast_1d(zoom)), frames).exp().to(body.rest)
    # the nearer, the more the camera looks at the body, which may be anywhere on its way
    follow = (1 - nearer**-2).clamp_min(0)[:, None]
    aims = target + follow * (rollout.x.mean(1).to(low) - target)
    # without zoom a ball around all places of the particles fills the shorter side, but for a margin
    far = (4 * LENS**2 + 1) ** 0.5 * (0.53 * float((high - low).norm()) + body.spacing)
    toward = viewed_from(side / side.norm() + 0.25 * up if view is None else view, up, frames)
    K = torch.tensor([[0, 0, width / 2], [0, 0, height / 2], [0, 0, 1.0]]).repeat(frames, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = LENS * min(width, height) * nearer.cpu()
    eyes = aims + far * toward
    w2c = look_at(eyes, aims, up).cpu()
    names = tuple(f"frame {t}" for t in range(frames))
    return Cameras(K.to(w2c), w2c, width, height, names), target


def viewed_from(view: Views, up: Tensor, frames: int = 1, name: str = "view") -> Tensor:
    """(frames, 3) unit directions from a body to the camera. view: (3,), the same in all frames, or
    (K, 3), spread evenly over the frames: from one to the next the camera turns about `up` by the
    shorter way, and rises evenly. Errors: ConfigError naming `name`."""
    expected = "a direction (x, y, z), or a list of such"
    given = numbers(name, view, expected).to(up)
    if given.ndim not in (1, 2) or given.shape[-1] != 3 or not len(given):
        raise ConfigError(f"{name}: expected {expected}, found shape {tuple(given.shape)}")
    given, up = given.reshape(-1, 3), up / up.norm()
    level = given - (given @ up)[:, None] * up
    if not bool((level.norm(dim=1) > 1e-3 * given.norm(dim=1)).all()):
        raise ConfigError(f"{name}: expected a direction that is not up or down, found {view}")
    ahead = level[0] / level[0].norm()
    aside = torch.linalg.cross(up, ahead)
    turns = np.unwrap(torch.atan2(level @ aside, level @ ahead).cpu().numpy())
    rises = torch.atan2(given @ up, level.norm(dim=1)).cpu().numpy()
    turn, rise = (spread(v, frames).to(up)[:, None] for v in (turns, rises))
    toward: Tensor = rise.cos() * (turn.cos() * ahead + turn.sin() * aside) + rise.sin() * up
    return toward


def spread(values: np.ndarray, frames: int) -> Tensor:
    """(frames,) of values (K,), evenly from the first to the last."""
    at = np.linspace(0, len(values) - 1, frames)
    return torch.from_numpy(np.interp(at, np.arange(len(values)), values))
