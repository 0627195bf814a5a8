"""How far the particles of a reconstruction are from the true body of a built-in scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.data.synthetic.bodies.objects import object_named
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.surface import extract_surface
from mosa.errors import ConfigError
from mosa.types import Scene

LATTICE = 0.004  # [m] of the true body's points, at most the truth's own spacing
OUTSIDE = 0.7  # spacings beyond the true surface from which a particle counts as outside
BOTTOM = 0.2  # of a shape's height, in which its lowest point is
FARTHEST = 1.0  # spacings to every particle beyond which a point is missing


def origin(name: str) -> np.ndarray:
    """Where the shape's own frame lies in the world at frame 0 of the training sequence, (3,) [m] (`drop.place`)."""
    body = object_named(name)
    drop, shape = body.drops["train"], SHAPES[body.shape]
    low, high = shape.bounds
    # of the bottom alone, which is all that is asked for: the same vertices as of the whole
    high = np.array([high[0], low[1] + BOTTOM * (high[1] - low[1]), high[2]])
    bottom = replace(shape, bounds=np.stack([low, high]))
    lowest = extract_surface(bottom, body.pitch, np.random.default_rng(0)).vertices[:, 1].min()
    fallen = drop.speed * drop.contact + 0.5 * 9.8 * drop.contact**2
    return np.array([drop.offset[0], fallen - lowest, drop.offset[1]])


def geometry_figures(rest: Tensor, volume: Tensor, scene: Scene) -> dict[str, float]:
    """`floor/geometry/...` of particles (N, 3) [m] at frame 0 of the training sequence with volumes (N,) [m^3].

    outside_share: farther than 0.7 spacings outside of the true body; missing_share: part of the true body that is farther than one
    spacing from every particle; volume_error: relative; center_error_m: of the centre of mass.
    Errors: ConfigError where the scene is not a built-in one."""
    if scene.truth is None or not scene.synthetic:
        raise ConfigError(f"scene {scene.name}: the true shape is known for built-in scenes only")
    shape = SHAPES[object_named(scene.name).shape]
    shift = origin(scene.name)
    points, held = (t.detach().double().cpu().numpy() for t in (rest, volume))
    points = points - shift
    lattice = min(LATTICE, object_named(scene.name).spacing)
    axes = [np.arange(a, b + lattice, lattice) for a, b in zip(*shape.bounds)]
    true = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    true = true[shape.distance(true) < 0]
    spacing = held.mean() ** (1 / 3)
    away = cKDTree(points).query(true)[0]
    return {
        "floor/geometry/outside_share": float((shape.distance(points) > OUTSIDE * spacing).mean()),
        "floor/geometry/missing_share": float((away > FARTHEST * spacing).mean()),
        "floor/geometry/volume_error": float(held.sum() / (len(true) * lattice**3) - 1),
        "floor/geometry/center_error_m": float(
            np.linalg.norm(held @ points / held.sum() - true.mean(0))
        ),
    }
