"""A twin's body as a mesh: a flex of MuJoCo with E, nu, density and damping, or its surface alone.

The mesh has the resolution of the twin's grid: cells of about its spacing that are at least half
full, each as six tetrahedra around its diagonal (Kuhn 1960). MuJoCo's elasticity is St. Venant and
Kirchhoff's; its damping is a time [s] by which the strain's rate counts with the strain, so that
damping / mu makes the shear viscosities equal. A contact gives within the time in which a pressure
wave crosses a cell: what is faster only shakes the nodes at the surface."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mosa.errors import ConfigError
from mosa.system.whole_files import write_whole
from mosa.twin.start import as_started

COURANT = 0.2  # time step over a pressure wave's time through a cell


def tetrahedra(rest: np.ndarray, volume: np.ndarray, spacing: float) -> tuple[np.ndarray, ...]:
    """Nodes (M, 3) [m] and elements (K, 4), of positive volume, of cells that particles (N, 3) [m]
    fill at least by half. volume: (N,) [m^3]; spacing [m]: of the cells, about.

    Errors: ConfigError where no cell is half full."""
    half = 0.5 * np.cbrt(volume)[:, None]
    low, high = (rest - half).min(0), (rest + half).max(0)
    counts = np.maximum(np.rint((high - low) / spacing), 1).astype(int)
    sides = (high - low) / counts
    filled = np.zeros(counts)
    np.add.at(filled, tuple(np.minimum((rest - low) // sides, counts - 1).astype(int).T), volume)
    cells = np.argwhere(filled >= 0.5 * sides.prod())
    if not len(cells):
        raise ConfigError(
            f"formats: mujoco and obj need a body that fills cells of {spacing:.3g} m at least by "
            "half, found a thinner one"
        )
    paths = []  # from corner 000 to 111 along the three axes, in each order
    for order in itertools.permutations(range(3)):
        steps = np.vstack([np.zeros(3, int), np.cumsum(np.eye(3, dtype=int)[list(order)], 0)])
        paths.append(steps if np.linalg.det(np.eye(3)[list(order)]) > 0 else steps[[0, 2, 1, 3]])
    corners = cells[:, None, None] + np.stack(paths)
    nodes, elements = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return low + nodes * sides, elements.reshape(-1, 4)


def meshed(twin: Any, values: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes (M, 3) [m], velocities (M, 3) [m/s] as the training starts, and tetrahedra (K, 4) of a
    twin with the given `particles`. Errors: ConfigError where no cell is half full."""
    body = twin.body
    rest = body.rest.double().cpu().numpy()
    nodes, elements = tetrahedra(rest, values["volume"], body.settings.dx)
    places = torch.from_numpy(nodes).to(body.rest)
    return *as_started(body, twin.training_start, places), elements


def save_surface(path: Path, twin: Any, values: dict[str, np.ndarray]) -> Path:
    """Write the mesh's closed surface [m] as OBJ, normals outwards, where the training starts."""
    points, _, elements = meshed(twin, values)
    sides = [1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]
    faces = np.concatenate([elements[:, side] for side in sides])
    _, first, count = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    used, faces = np.unique(faces[first[count == 1]], return_inverse=True)
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in points[used]]
    lines += [f"f {a} {b} {c}" for a, b, c in faces.reshape(-1, 3) + 1]
    write_whole(path, "\n".join(lines) + "\n")
    return path


def save_mujoco(path: Path, twin: Any, values: dict[str, np.ndarray]) -> Path:
    """Write the body where its training starts, with its velocities as keyframe 0, the gravity and
    a plane for the ground, in the scene's axes. values: its `particles`; E is the mean of theirs.

    Errors: ConfigError for a law without E, or for a body that is thinner than a cell."""
    material, world, spacing = twin.material, twin.world, twin.body.settings.dx
    E, nu = float(values["E"].mean()), material.nu
    if not E > 0:
        raise ConfigError(f"formats: mujoco needs a law with E and nu, found {material.law}")
    points, velocities, elements = meshed(twin, values)
    shares = np.bincount(elements.ravel(), minlength=len(points)) / elements.size
    masses = shares * values["mass"].sum()
    damping = 2 * (1 + nu) * material.damping / E
    wave = np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / material.density)
    ground, crossing = world.ground, spacing / wave

    def text(numbers: Any) -> str:
        return " ".join(f"{v:.7g}" for v in np.ravel(numbers))

    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    bodies = [
        f'<body name="n{k}" pos="{text(p)}"><inertial pos="0 0 0" mass="{m:.7g}" '
        f'diaginertia="1e-9 1e-9 1e-9"/>{slides}</body>'
        for k, (p, m) in enumerate(zip(points, masses))
    ]
    friction = 0.0
    if ground is not None:
        friction = 1.0 if ground.mode == "sticky" else ground.friction
        up = world.up.double().cpu().numpy()
        bodies.append(
            f'<geom name="ground" type="plane" size="0 0 0.05" pos="{text(ground.height * up)}" '
            f'zaxis="{text(up)}"/>'
        )
    names = " ".join(f"n{k}" for k in range(len(points)))
    lines = [
        '<mujoco model="mosa">',
        f'<option timestep="{COURANT * crossing:.3g}" gravity="{text(world.gravity.tolist())}"/>',
        "<worldbody>",
        *bodies,
        "</worldbody>",
        f'<deformable><flex name="body" dim="3" radius="{0.01 * spacing:.4g}" body="{names}"',
        f'element="{text(elements)}">',
        f'<contact selfcollide="none" priority="1" friction="{friction:.7g} 0 0" '
        f'solref="{crossing:.3g} 1"/>',
        f'<elasticity young="{E:.7g}" poisson="{nu:.7g}" damping="{damping:.7g}"/>',
        "</flex></deformable>",
        f'<keyframe><key name="start" qvel="{text(velocities)}"/></keyframe>',
        "</mujoco>",
    ]
    write_whole(path, "\n".join(lines))
    return path
