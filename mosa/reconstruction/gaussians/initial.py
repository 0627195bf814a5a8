"""Where the static stage starts: Gaussians on the visual hull's surface, coloured by the images."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.data.hull import Volume
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.cameras import centers, project, sample_images
from mosa.types import Splats


def surface_points(volume: Volume, *, count: int, seed: int) -> tuple[Tensor, Tensor, float]:
    """About `count` points on the 0.5 level, outward normals, and their mean spacing [m]; drawn without replacement."""
    values = volume.values.cpu().numpy()
    inside = values > 0.5
    shell = inside & ~ndimage.binary_erosion(inside)
    index = np.argwhere(shell)
    smooth = ndimage.gaussian_filter(inside.astype(np.float32), 1.5)
    normal = -np.stack([g[shell] for g in np.gradient(smooth)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-6)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(index))[:count]
    points = torch.as_tensor(index[order], dtype=torch.float32) * volume.pitch + volume.origin.cpu()
    spacing = volume.pitch * math.sqrt(len(index) / len(order))
    return points, torch.as_tensor(normal[order], dtype=torch.float32), spacing


def sampled_windows(points: Tensor, windows: Windows) -> Tensor:
    """Colour times matte, and matte, (V, N, 4) at the projections of points (N, 3) [m]."""
    pixels, _ = project(points, windows.cameras)
    return sample_images(windows.masked(), pixels).transpose(1, 2)


def projected_colors(points: Tensor, normals: Tensor, windows: Windows) -> Tensor:
    """Colours (N, 3) of surface points: mean over the views that face them, weighted by the cosine to the fourth power.

    Occlusion by other parts is not looked at; the fit corrects it."""
    sampled, centre = sampled_windows(points, windows), centers(windows.cameras)
    cosine = (F.normalize(centre[:, None] - points, dim=-1) * normals).sum(-1).clamp(min=0)
    weight = (cosine + 0.02) ** 4
    total = (weight[..., None] * sampled).sum(0)
    # the floor lies below the weight of points that every view sees from behind (0.02^4): they get a colour too
    return (total[:, :3] / total[:, 3:].clamp(min=1e-9)).clamp(0.02, 0.98)


def initial_splats(volume: Volume, windows: Windows, *, count: int, seed: int) -> Splats:
    """Isotropic Gaussians on the surface of an occupancy volume, coloured by the images that face them."""
    points, normals, spacing = surface_points(volume, count=count, seed=seed)
    device = windows.images.device
    points, normals = points.to(device), normals.to(device)
    colors = projected_colors(points, normals, windows)
    return isotropic_splats(points, 0.6 * spacing, 0.7, colors)


def isotropic_splats(means: Tensor, scale: float, opacity: float, colors: Tensor) -> Splats:
    """Balls of one standard deviation [m] and opacity at means (N, 3) [m], in colours (N, 3)."""
    turns = means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1)
    opacities = torch.full_like(means[:, 0], opacity)
    return Splats(means, torch.full_like(means, scale), turns, opacities, colors)


def inherited_colors(points: Tensor, splats: Splats, *, neighbours: int = 4) -> Tensor:
    """Colours (N, 3) of points from the nearest opaque Gaussians, inverse-distance mean."""
    opaque = (splats.opacities > 0.3).cpu().numpy()
    opaque = opaque if opaque.sum() >= neighbours else np.ones(len(opaque), bool)
    means = splats.means.detach().cpu().numpy()[opaque]
    distance, index = cKDTree(means).query(points.cpu().numpy(), k=neighbours)
    weight = torch.as_tensor(1 / (distance + 1e-6), dtype=torch.float32)
    colors = splats.colors.detach().cpu()[opaque][torch.as_tensor(index)]
    return ((weight[..., None] * colors).sum(1) / weight.sum(1, keepdim=True)).to(points.device)
