"""The body of a recording of tracked points: particles that fill a given shape, and how the points
move with them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mosa.data.formats.markers import extent, pose_of
from mosa.errors import DataError
from mosa.physics.contact.colliders import Box
from mosa.physics.contact.reference import signed_distance
from mosa.physics.world import Start
from mosa.reconstruction.gaussians.initial import isotropic_splats
from mosa.types import MarkerCues, Markers, Reconstruction, Scene

NEIGHBOURS = 32
"""Particles that tell where a tracked point is."""
USUAL = 4000
"""Particles of a body where nobody says how many."""
FARTHEST = 0.5
"""Of the body's size: a point that is farther from every particle belongs to something else."""
GREY = 0.6


def filled(solid, spacing: float) -> tuple[Tensor, Tensor]:
    """(places (N, 3), volumes (N,)) [m], [m^3] of particles on a lattice of about `spacing` [m]
    that fills a box or a mesh; its layers divide the extent evenly."""
    low, high = extent(solid)
    counts = ((high - low) / spacing).round().clamp_min(1).long()
    pitch = (high - low) / counts
    axes = [low[i] + (torch.arange(int(counts[i])).double() + 0.5) * pitch[i] for i in range(3)]
    local = torch.cartesian_prod(*axes)
    if not isinstance(solid.shape, Box):
        local = local[signed_distance(solid.shape, local) < 0]
    position, rotation = pose_of(solid)
    if len(local) < 8:
        raise DataError(f"scene.body: expected at least 8 particles, {1e3 * spacing:.3g} mm apart")
    volume = torch.full((len(local),), float(pitch.prod()))
    return (local @ rotation.T + position).float(), volume


def in_own_axes(scene: Scene, places: Tensor) -> Tensor:
    """Places (N, 3) at rest in the axes of the given shape, along which `filled` lays its lattice; the origin is as it was."""
    return places @ pose_of(points_of(scene).body)[1].to(places)


def points_of(scene: Scene) -> Markers:
    """Of a scene that has tracked points."""
    assert scene.markers is not None
    return scene.markers


def marker_spacing(scene: Scene, particles: int | None) -> float:
    """Of about so many particles [m]."""
    solid = points_of(scene).body
    low, high = extent(solid)
    rough = float((high - low).prod() / (particles or USUAL)) ** (1 / 3)
    share = len(filled(solid, rough)[0]) / (particles or USUAL)
    return rough * share ** (1 / 3)


def cues_of_markers(scene: Scene, rest: Tensor) -> MarkerCues:
    """How the tracked points of a recording move with particles at rest (N, 3) [m].

    A point is a fixed sum over its `NEIGHBOURS` nearest particles, the value there of the affine
    field nearest to their positions (weights fall off as a Gaussian): exact for every affine
    motion, and for points beside the body, which go with its surface. Errors: DataError."""
    markers, x = points_of(scene), rest.detach().double().cpu()
    apart, count = torch.cdist(markers.rest.double(), x), min(NEIGHBOURS, len(x))
    distance, index = apart.topk(count, largest=False)
    size = float((x.amax(0) - x.amin(0)).max())
    if bool((far := distance[:, 0] > FARTHEST * size).any()):
        worst = int(far.nonzero()[0])
        raise DataError(
            f"{scene.name}/{scene.sequence}: {markers.names[worst]!r} is at rest "
            f"{distance[worst, 0]:.3g} m from the body: expected points on it; align the recording "
            "by scene.points, or leave it out of scene.tracked"
        )
    near = (-0.5 * (distance / distance[:, -1:] * 2) ** 2).exp()
    arm = (x[index] - markers.rest.double()[:, None]) / size
    basis = torch.cat([torch.ones_like(arm[..., :1]), arm], -1) * near.sqrt()[..., None]
    weights = torch.linalg.pinv(basis)[:, 0] * near.sqrt()
    return MarkerCues(markers.positions.to(rest), index.to(rest.device), weights.to(rest))


def reconstruction_of_markers(scene: Scene, spacing: float) -> Reconstruction:
    """Particles of the given shape, in grey, with the training recording as cues."""
    x, volume = filled(points_of(scene).body, spacing)
    splats = isotropic_splats(x, 0.35 * spacing, 0.9, torch.full_like(x, GREY))
    return Reconstruction(splats, spacing, volume, cues_of_markers(scene, x))


def followed_by_markers(scene: Scene, first: Reconstruction) -> Reconstruction:
    """The same particles with the cues of another recording."""
    return replace(first, cues=cues_of_markers(scene, first.splats.means))


def start_at_rest(scene: Scene, center: Tensor) -> Start:
    """Undeformed and at rest, with the loads of the recording. center: (3,) of the body [m]."""
    zero = torch.zeros_like(center)
    return Start(torch.eye(3).to(center), center, zero, zero.clone(), points_of(scene).loads)
