"""Static stage: isotropic Gaussians fitted to one frame by rendering, from the visual hull's surface (paper, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.reconstruction.hull import Volume
from mosa.reconstruction.observed import Windows
from mosa.rendering.rasterizer import rasterize
from mosa.types import Splats

SSIM_SIGMA = 1.5


@dataclass(frozen=True)
class FitSettings:
    """iterations; views: images per step; lr_*: Adam steps, of positions in units of the mean scale, of the others per
    unconstrained number; ssim: weight of 1 - SSIM against L1; matte: weight of the alpha term; keep: what a Gaussian's first colour
    counts for, in pixels of an image; largest: bound of a scale in units of its start; relocate_every: steps between moves of
    vanished Gaussians to where opaque ones are (0: never)."""

    iterations: int = 400
    views: int = 2
    lr_positions: float = 0.03
    lr_scales: float = 0.02
    lr_opacities: float = 0.05
    lr_colors: float = 0.02
    ssim: float = 0.2
    matte: float = 1.0
    keep: float = 0.0
    largest: float = 2.0
    relocate_every: int = 100


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of images (B, H, W, C) in [0, 1]: 11 x 11 Gaussian window, sigma 1.5 (Wang et al. 2004)."""
    window = get_gaussian_kernel1d(11, SSIM_SIGMA, device=a.device, dtype=a.dtype)
    x, y = a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2)
    products = torch.cat([x, y, x * x, y * y, x * y], 1)
    moments = filter2d_separable(products, window, window, padding="valid").split(a.shape[-1], 1)
    mx, my, xx, yy, xy = moments
    vx, vy, vxy = xx - mx * mx, yy - my * my, xy - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (((2 * mx * my + c1) * (2 * vxy + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))).mean()


def image_loss(image: Tensor, alpha: Tensor, windows: Windows, *, ssim_weight: float, matte_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of colours, plus L1 of alpha against the mattes."""
    loss = (1 - ssim_weight) * (image - windows.images).abs().mean()
    if ssim_weight > 0:
        loss = loss + ssim_weight * (1 - ssim(image, windows.images))
    return loss + matte_weight * (alpha - windows.mattes).abs().mean()


def isotropic_covariances(scale: Tensor) -> Tensor:
    """(N, 3, 3) [m^2] of standard deviations (N,) [m]."""
    return (scale**2)[:, None, None] * torch.eye(3, dtype=scale.dtype, device=scale.device)


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


def projected_colors(points: Tensor, normals: Tensor, windows: Windows) -> Tensor:
    """Colours (N, 3) of surface points: mean over the views that face them, weighted by the cosine to the fourth power.

    Occlusion by other parts is not looked at; the fit corrects it.
    """
    cameras = windows.cameras
    seen = points @ cameras.w2c[:, :3, :3].transpose(1, 2) + cameras.w2c[:, None, :3, 3]
    pixel = seen @ cameras.K.transpose(1, 2)
    pixel = pixel[..., :2] / pixel[..., 2:].clamp(min=1e-6)
    grid = (2 * pixel / pixel.new_tensor([cameras.width, cameras.height]) - 1)[:, None]
    stacked = torch.cat([windows.images * windows.mattes[..., None], windows.mattes[..., None]], -1).permute(0, 3, 1, 2)
    sampled = F.grid_sample(stacked, grid, align_corners=False)[:, :, 0].transpose(1, 2)
    centre = -(cameras.w2c[:, :3, :3].transpose(1, 2) @ cameras.w2c[:, :3, 3:])[..., 0]
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
    n = len(points)
    rotations = torch.zeros(n, 4, device=device)
    rotations[:, 0] = 1
    return Splats(
        points,
        torch.full((n, 3), 0.6 * spacing, device=device),
        rotations,
        torch.full((n,), 0.7, device=device),
        projected_colors(points, normals, windows),
    )


def inherited_colors(points: Tensor, splats: Splats, *, neighbours: int = 4) -> Tensor:
    """Colours (N, 3) of points from the nearest opaque Gaussians, inverse-distance mean."""
    opaque = (splats.opacities > 0.3).cpu().numpy()
    opaque = opaque if opaque.sum() >= neighbours else np.ones(len(opaque), bool)
    means = splats.means.detach().cpu().numpy()[opaque]
    distance, index = cKDTree(means).query(points.cpu().numpy(), k=neighbours)
    weight = torch.as_tensor(1 / (distance + 1e-6), dtype=torch.float32)
    colors = splats.colors.detach().cpu()[opaque][torch.as_tensor(index)]
    return ((weight[..., None] * colors).sum(1) / weight.sum(1, keepdim=True)).to(points.device)


def _relocate(parameters: dict[str, Tensor], optimizer: torch.optim.Adam, generator: torch.Generator) -> None:
    """Moves Gaussians whose opacity fell below 0.02 onto opaque ones, at half their scale apart, and forgets their momentum."""
    opacity = torch.sigmoid(parameters["opacity"])
    dead = (opacity < 0.02).nonzero()[:, 0]
    if len(dead) == 0 or len(dead) == len(opacity):
        return
    chance = torch.where(opacity < 0.02, torch.zeros_like(opacity), opacity * parameters["log_scale"].exp() ** 2)
    target = torch.multinomial(chance.cpu(), len(dead), replacement=True, generator=generator).to(dead.device)
    for value in parameters.values():
        value.data[dead] = value.data[target]
        for moment in ("exp_avg", "exp_avg_sq"):
            if value in optimizer.state:
                optimizer.state[value][moment][dead] = 0
    noise = torch.randn(len(dead), 3, generator=generator).to(dead.device)
    parameters["means"].data[dead] += noise * 0.5 * parameters["log_scale"].data[dead].exp()[:, None]


def fit_splats(
    splats: Splats,
    windows: Windows,
    background: Tensor,
    settings: FitSettings,
    *,
    move: bool,
    seed: int,
    progress: Callable[[int], None] | None = None,
) -> Splats:
    """Isotropic Gaussians fitted to windows of ONE frame: colours, opacities, scales and, with `move`, positions."""
    generator = torch.Generator().manual_seed(seed)
    scale0 = splats.scales.mean(1)
    unit = float(scale0.mean())
    parameters = {
        "means": splats.means.clone(),
        "log_scale": scale0.log(),
        "opacity": torch.logit(splats.opacities.clamp(0.01, 0.99)),
        "color": torch.logit(splats.colors.clamp(0.01, 0.99)),
    }
    rates = {
        "means": settings.lr_positions * unit,
        "log_scale": settings.lr_scales,
        "opacity": settings.lr_opacities,
        "color": settings.lr_colors * 4,
    }
    learned = {name: p.requires_grad_(True) for name, p in parameters.items() if move or name != "means"}
    optimizer = torch.optim.Adam(
        [{"params": [p], "lr": rates[name], "name": name} for name, p in learned.items()], betas=(0.9, 0.99), eps=1e-12
    )
    start = [group["lr"] for group in optimizer.param_groups]
    order = torch.empty(0, dtype=torch.long)
    lower, upper = (scale0 / 4).log(), (scale0 * settings.largest).log()
    for step in range(settings.iterations):
        while len(order) < settings.views:
            order = torch.cat([order, torch.randperm(len(windows), generator=generator)])
        batch, order = windows.select(order[: settings.views]), order[settings.views :]
        for group, rate in zip(optimizer.param_groups, start):
            group["lr"] = rate * (0.55 + 0.45 * math.cos(math.pi * step / settings.iterations))
        scale = parameters["log_scale"].exp()
        image, alpha = rasterize(
            parameters["means"][None],
            isotropic_covariances(scale)[None],
            torch.sigmoid(parameters["opacity"]),
            torch.sigmoid(parameters["color"])[None],
            batch.cameras,
            torch.zeros(len(batch), dtype=torch.long, device=background.device),
            background,
        )
        loss = image_loss(image, alpha, batch, ssim_weight=settings.ssim, matte_weight=settings.matte)
        if settings.keep > 0:
            # Adam moves a Gaussian of a hundredth of a pixel as fast as one of ten: hardly seen ones drift to any colour, which
            # shows when the object turns
            change = torch.sigmoid(parameters["color"]) - splats.colors
            loss = loss + settings.keep * change.square().mean(1).sum() / alpha.numel()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            parameters["log_scale"].clamp_(lower, upper)
            if (
                move
                and settings.relocate_every
                and step
                and step % settings.relocate_every == 0
                and step < 0.8 * settings.iterations
            ):
                _relocate(parameters, optimizer, generator)
        if progress is not None:
            progress(1)
    with torch.no_grad():
        return Splats(
            parameters["means"].detach(),
            parameters["log_scale"].exp()[:, None].repeat(1, 3),
            splats.rotations,
            torch.sigmoid(parameters["opacity"]),
            torch.sigmoid(parameters["color"]),
        )
