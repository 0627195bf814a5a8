"""Differentiable rasterisation of 3D Gaussians on CPU and CUDA: Warp kernels behind one torch autograd function.

Conventions of rendering.md (gsplat by default, INRIA by `preset`); gradients to means, covariances, opacities and
features by hand-written adjoints, none to cameras. Nothing but the projected Gaussians, final transmittance and the
rank at which a pixel ended is kept for the backward pass.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.errors import ConfigError, DataError
from mosa.rendering.covariance import CLAMP_MARGIN
from mosa.rendering.projection_kernels import projection_kernels
from mosa.rendering.raster_kernels import raster_kernels
from mosa.rendering.tile_kernels import tile_kernels, tile_lists
from mosa.types import Cameras


@dataclass(frozen=True)
class Preset:
    """near: nearest depth [m]; extent: standard deviations; square: INRIA's square extent, whole tiles; alpha_max:
    cap of alpha."""

    near: float
    extent: float
    square: bool
    alpha_max: float


PRESETS = {"gsplat": Preset(0.01, 3.33, False, 0.999), "inria": Preset(0.2, 3.0, True, 0.99)}

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


@functools.cache
def _vector(length: int, scalar: type) -> type:
    return wp.types.vector(length=length, dtype=scalar)


@functools.cache
def _matrix(rows: int, scalar: type) -> type:
    return wp.types.matrix(shape=(rows, rows), dtype=scalar)


@functools.cache
def _start_warp() -> None:
    wp.config.quiet = True
    wp.init()


@dataclass(frozen=True)
class _Geometry:
    """What a call fixes besides its differentiable inputs."""

    K: Tensor
    w2c: Tensor
    state_index: Tensor
    width: int
    height: int
    preset: Preset
    scan: str


class _Arrays:
    """Flat Warp views of torch tensors of one scalar type."""

    def __init__(self, dtype: torch.dtype):
        self.scalar = _SCALARS[dtype]

    def scalars(self, x: Tensor) -> wp.array:
        return wp.from_torch(x.view(-1), dtype=self.scalar)

    def vectors(self, x: Tensor) -> wp.array:
        return wp.from_torch(x.view(-1, x.shape[-1]), dtype=_vector(x.shape[-1], self.scalar))

    def matrices(self, x: Tensor) -> wp.array:
        return wp.from_torch(x.view(-1, *x.shape[-2:]), dtype=_matrix(x.shape[-1], self.scalar))


def _integers(x: Tensor) -> wp.array:
    return wp.from_torch(x.view(-1), dtype=wp.int32)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor, geometry: _Geometry):
        g, preset = geometry, geometry.preset
        means, covariances, opacities, features = (x.detach().contiguous() for x in (means, covariances, opacities, features))
        images, count, channels = len(g.state_index), means.shape[1], features.shape[-1]
        arrays, device = _Arrays(means.dtype), wp.device_from_torch(means.device)
        centers, conics = means.new_zeros(images, count, 2), means.new_zeros(images, count, 3)
        weights, depths = means.new_empty(images, count), means.new_empty(images, count)
        rects = torch.empty(images, count, 4, dtype=torch.int32, device=means.device)
        rects_wp = wp.from_torch(rects.view(-1, 4), dtype=wp.vec4i)
        settings = _vector(4, arrays.scalar)(preset.near, CLAMP_MARGIN, preset.extent, float(preset.square))
        opacity_stride = count if opacities.dim() == 2 else 0
        project, _ = projection_kernels(arrays.scalar)
        wp.launch(
            project,
            dim=(images, count),
            inputs=[
                arrays.vectors(means),
                arrays.matrices(covariances),
                arrays.scalars(opacities),
                opacity_stride,
                arrays.matrices(g.K),
                arrays.matrices(g.w2c),
                _integers(g.state_index),
                settings,
                count,
                g.width,
                g.height,
            ],
            outputs=[
                arrays.vectors(centers),
                arrays.vectors(conics),
                arrays.scalars(weights),
                arrays.scalars(depths),
                rects_wp,
            ],
            device=device,
        )
        order = depths.argsort(dim=1, stable=True).to(torch.int32)
        transmittance = means.new_ones(images, g.height, g.width)
        image = means.new_zeros(images, g.height, g.width, channels)
        ends = torch.full((images, g.height, g.width), count, dtype=torch.int32, device=means.device)
        feature_stride = count if features.shape[0] > 1 else 0
        shared = [arrays.vectors(centers), arrays.vectors(conics), arrays.scalars(weights)]
        tail = [arrays.vectors(features), feature_stride, arrays.scalar(preset.alpha_max), count, g.width, g.height]
        outputs = [arrays.scalars(transmittance), arrays.vectors(image), _integers(ends)]
        if g.scan == "gaussian":
            lists = ()
            kernel, _ = raster_kernels(arrays.scalar, channels)
            wp.launch(kernel, dim=images, inputs=[_integers(order), *shared, rects_wp, *tail], outputs=outputs, device=device)
        else:
            lists = tile_lists(order, rects, g.width, g.height)
            kernel, _ = tile_kernels(arrays.scalar, channels)
            wp.launch(
                kernel,
                dim=(images, g.height, g.width),
                inputs=[*map(_integers, lists), *shared, rects_wp, *tail],
                outputs=outputs,
                device=device,
            )
        ctx.save_for_backward(
            means, covariances, opacities, features, centers, conics, weights, rects, order, transmittance, ends, *lists
        )
        ctx.geometry = geometry
        return image, 1 - transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image: Tensor, grad_alpha: Tensor):
        means, covariances, opacities, features, centers, conics, weights, rects, order, final, ends, *lists = ctx.saved_tensors
        g, preset = ctx.geometry, ctx.geometry.preset
        images, count, channels = len(g.state_index), means.shape[1], features.shape[-1]
        arrays, device = _Arrays(means.dtype), wp.device_from_torch(means.device)
        rects_wp = wp.from_torch(rects.view(-1, 4), dtype=wp.vec4i)
        transmittance, behind = final.clone(), -grad_alpha * final
        grad_image = grad_image.contiguous()
        grad_centers, grad_conics = torch.zeros_like(centers), torch.zeros_like(conics)
        grad_weights, grad_features = torch.zeros_like(weights), torch.zeros_like(features)
        feature_stride = count if features.shape[0] > 1 else 0
        shared = [
            arrays.vectors(centers),
            arrays.vectors(conics),
            arrays.scalars(weights),
            rects_wp,
            arrays.vectors(features),
            feature_stride,
            arrays.scalar(preset.alpha_max),
            count,
            g.width,
            g.height,
            _integers(ends),
            arrays.vectors(grad_image),
            arrays.scalars(transmittance),
            arrays.scalars(behind),
        ]
        outputs = [
            arrays.vectors(grad_centers),
            arrays.vectors(grad_conics),
            arrays.scalars(grad_weights),
            arrays.vectors(grad_features),
        ]
        if g.scan == "gaussian":
            _, kernel = raster_kernels(arrays.scalar, channels)
            wp.launch(kernel, dim=images, inputs=[_integers(order), *shared], outputs=outputs, device=device)
        else:
            _, kernel = tile_kernels(arrays.scalar, channels)
            wp.launch(
                kernel,
                dim=(images, g.height, g.width),
                inputs=[*map(_integers, lists), *shared],
                outputs=outputs,
                device=device,
            )
        grad_means, grad_covariances = torch.zeros_like(means), torch.zeros_like(covariances)
        grad_opacities = torch.zeros_like(opacities)
        settings = _vector(4, arrays.scalar)(preset.near, CLAMP_MARGIN, preset.extent, float(preset.square))
        _, kernel = projection_kernels(arrays.scalar)
        wp.launch(
            kernel,
            dim=count,
            inputs=[
                arrays.vectors(means),
                arrays.matrices(covariances),
                count if opacities.dim() == 2 else 0,
                arrays.matrices(g.K),
                arrays.matrices(g.w2c),
                _integers(g.state_index),
                settings,
                count,
                g.width,
                g.height,
                images,
                arrays.vectors(conics),
                rects_wp,
                *outputs[:3],
            ],
            outputs=[arrays.vectors(grad_means), arrays.matrices(grad_covariances), arrays.scalars(grad_opacities)],
            device=device,
        )
        return grad_means, grad_covariances, grad_opacities, grad_features, None


def _check(
    means: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor, cameras: Cameras, state_index: Tensor
) -> None:
    """Shapes, types and devices of `rasterize`; ConfigError names the first that is off."""
    states, count = (means.shape[0], means.shape[1]) if means.dim() == 3 else (-1, -1)
    images = len(cameras)
    wanted = {
        "means": (means, [(states, count, 3)]),
        "covariances": (covariances, [(states, count, 3, 3)]),
        "opacities": (opacities, [(count,), (states, count)]),
        "features": (features, [(images, count, features.shape[-1]), (1, count, features.shape[-1])]),
        "state_index": (state_index, [(images,)]),
    }
    for name, (value, shapes) in wanted.items():
        if tuple(value.shape) not in shapes or 0 in value.shape:
            raise ConfigError(f"rasterize: {name} has shape {tuple(value.shape)}, expected one of {shapes}, none empty")
        if value.device != means.device:
            raise ConfigError(f"rasterize: {name} is on {value.device}, means on {means.device}; move all to one device")
        if name != "state_index" and (value.dtype != means.dtype or value.dtype not in _SCALARS):
            raise ConfigError(f"rasterize: {name} is {value.dtype}, means {means.dtype}; use one of float32, float64 for all")
    for name, value in (("means", means), ("covariances", covariances), ("opacities", opacities), ("features", features)):
        if not bool(value.detach().isfinite().all()):
            where = (~value.detach().isfinite()).nonzero()[0].tolist()
            raise DataError(f"rasterize: {name}{where} is not finite; it would silently vanish from the image")
    if not means.is_cuda and (int(state_index.min()) < 0 or int(state_index.max()) >= states):
        raise ConfigError(f"rasterize: state_index reaches outside the {states} states")


def rasterize(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    cameras: Cameras,
    state_index: Tensor,
    background: Tensor | None = None,
    preset: str = "gsplat",
    *,
    scan: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Composite N Gaussians in S states into B images of any number C of channels.

    means: (S, N, 3) [m]; covariances: (S, N, 3, 3) [m^2], only the symmetric part counts; opacities: (N,) or (S, N)
    in [0, 1]; features: (B, N, C) or (1, N, C) shared by all images; cameras: B of them; state_index: (B,) state
    that image b shows; background: (C,) or None for zeros; preset: gsplat | inria (rendering.md); scan: gaussian
    (default on CPU) | tile (default on CUDA, and what a CPU test compares with). The dtype of the inputs, float32
    or float64, is that of the computation.

    Returns image (B, H, W, C) = sum_i w_i c_i + (1 - alpha) background and alpha (B, H, W), with gradients to the
    first four. Errors: ConfigError naming the argument of wrong shape, dtype, device, and for an unknown preset.
    Source: Kerbl et al. 2023; conventions of gsplat (Ye et al. 2024).
    """
    if preset not in PRESETS:
        raise ConfigError(f"rasterize: unknown preset '{preset}', expected one of {sorted(PRESETS)}")
    scan = scan or ("tile" if means.is_cuda else "gaussian")
    if scan not in ("gaussian", "tile"):
        raise ConfigError(f"rasterize: unknown scan '{scan}', expected gaussian or tile")
    _check(means, covariances, opacities, features, cameras, state_index)
    _start_warp()
    geometry = _Geometry(
        cameras.K.detach().to(means).contiguous(),
        cameras.w2c.detach().to(means).contiguous(),
        state_index.to(torch.int32).contiguous(),
        cameras.width,
        cameras.height,
        PRESETS[preset],
        scan,
    )
    image, alpha = _Rasterize.apply(means, covariances, opacities, features, geometry)
    if background is not None:
        image = image + (1 - alpha)[..., None] * background.to(image)
    return image, alpha


@torch.no_grad()
def expected_depth(
    means: Tensor, covariances: Tensor, opacities: Tensor, cameras: Cameras, state_index: Tensor, preset: str = "gsplat"
) -> tuple[Tensor, Tensor]:
    """Mean depth sum_i w_i z_i / alpha [m] per pixel, infinite where nothing is seen, and alpha; both (B, H, W). No
    gradient."""
    w2c = cameras.w2c.to(means)
    depth = (means[state_index] * w2c[:, None, 2, :3]).sum(-1, keepdim=True) + w2c[:, None, 2, 3:]
    image, alpha = rasterize(means, covariances, opacities, depth.contiguous(), cameras, state_index, preset=preset)
    return torch.where(alpha > 0, image[..., 0] / alpha.clamp(min=1e-12), torch.inf), alpha
