"""Splatting on Warp, for CPU and CUDA: projection and compositing kernels behind one torch autograd function.

Gradients to means, covariances, opacities, features and, where they ask for one, to the cameras' K and w2c, by
hand-written adjoints. Kept for the backward pass: the projected Gaussians, the final transmittance and the rank at
which a pixel ended; on CUDA the tile lists too, one entry per (tile, Gaussian) pair that is visible. Nothing grows
with Gaussians times pixels.
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.rendering.covariance import CLAMP_MARGIN
from mosa.rendering.projection_kernels import projection_kernels
from mosa.rendering.raster_kernels import raster_kernels
from mosa.rendering.tile_kernels import tile_kernels, tile_lists, tile_threads

CAMERA_CHUNKS = 1024
"""Threads per image that sum the gradient of its camera."""


@dataclass(frozen=True)
class Preset:
    """near: nearest depth [m]; extent: standard deviations; square: INRIA's square extent, whole tiles; alpha_max:
    cap of alpha."""

    near: float
    extent: float
    square: bool
    alpha_max: float


PRESETS = {"gsplat": Preset(0.01, 3.33, False, 0.999), "inria": Preset(0.2, 3.0, True, 0.99)}

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


@functools.cache
def _vector(length: int, scalar: type) -> type:
    return wp.types.vector(length=length, dtype=scalar)


@functools.cache
def _matrix(rows: int, columns: int, scalar: type) -> type:
    return wp.types.matrix(shape=(rows, columns), dtype=scalar)


@functools.cache
def start_warp() -> None:
    wp.config.log_level = wp.LOG_WARNING
    wp.init()


@dataclass(frozen=True)
class Geometry:
    """What a call fixes besides its differentiable inputs. state_index: (B,) int32; scan: gaussian | tile."""

    state_index: Tensor
    width: int
    height: int
    preset: Preset
    scan: str


class _Arrays:
    """Flat Warp views of torch tensors of one scalar type."""

    def __init__(self, dtype: torch.dtype):
        self.scalar = SCALARS[dtype]

    def scalars(self, x: Tensor) -> wp.array:
        return wp.from_torch(x.view(-1), dtype=self.scalar)

    def vectors(self, x: Tensor) -> wp.array:
        return wp.from_torch(x.view(-1, x.shape[-1]), dtype=_vector(x.shape[-1], self.scalar))

    def matrices(self, x: Tensor) -> wp.array:
        return wp.from_torch(x.view(-1, *x.shape[-2:]), dtype=_matrix(*x.shape[-2:], self.scalar))


def _integers(x: Tensor) -> wp.array:
    return wp.from_torch(x.view(-1), dtype=wp.int32)


class Splat(torch.autograd.Function):
    """(means, covariances, opacities, features, K (B, 3, 3), w2c (B, 4, 4), geometry) -> image (B, H, W, C), alpha (B, H, W).

    Shapes as in `mosa.rendering.rasterizer.rasterize`, which checks them.
    """

    @staticmethod
    def forward(ctx, means, covariances, opacities, features, K, w2c, geometry: Geometry):
        g, preset = geometry, geometry.preset
        means, covariances, opacities, features, K, w2c = (
            x.detach().contiguous() for x in (means, covariances, opacities, features, K, w2c)
        )
        images, count, channels = len(g.state_index), means.shape[1], features.shape[-1]
        arrays, device = _Arrays(means.dtype), wp.device_from_torch(means.device)
        centers, conics = means.new_zeros(images, count, 2), means.new_zeros(images, count, 3)
        weights, depths = means.new_empty(images, count), means.new_empty(images, count)
        rects = torch.empty(images, count, 4, dtype=torch.int32, device=means.device)
        rects_wp = wp.from_torch(rects.view(-1, 4), dtype=wp.vec4i)
        settings = _vector(4, arrays.scalar)(preset.near, CLAMP_MARGIN, preset.extent, float(preset.square))
        opacity_stride = count if opacities.dim() == 2 else 0
        project, *_ = projection_kernels(arrays.scalar)
        wp.launch(
            project,
            dim=(images, count),
            inputs=[
                arrays.vectors(means),
                arrays.matrices(covariances),
                arrays.scalars(opacities),
                opacity_stride,
                arrays.matrices(K),
                arrays.matrices(w2c),
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
                dim=tile_threads(images, g.width, g.height),
                inputs=[*map(_integers, lists), *shared, rects_wp, *tail],
                outputs=outputs,
                device=device,
            )
        ctx.save_for_backward(
            means, covariances, opacities, features, K, w2c, centers, conics, weights, rects, order, transmittance, ends, *lists
        )
        ctx.geometry = geometry
        return image, 1 - transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image: Tensor, grad_alpha: Tensor):
        means, covariances, opacities, features, K, w2c, centers, conics, weights, rects, order, final, ends, *lists = (
            ctx.saved_tensors
        )
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
                dim=tile_threads(images, g.width, g.height),
                inputs=[*map(_integers, lists), *shared],
                outputs=outputs,
                device=device,
            )
        grad_means, grad_covariances = torch.zeros_like(means), torch.zeros_like(covariances)
        grad_opacities = torch.zeros_like(opacities)
        settings = _vector(4, arrays.scalar)(preset.near, CLAMP_MARGIN, preset.extent, float(preset.square))
        _, kernel, camera_kernel = projection_kernels(arrays.scalar)
        wp.launch(
            kernel,
            dim=count,
            inputs=[
                arrays.vectors(means),
                arrays.matrices(covariances),
                count if opacities.dim() == 2 else 0,
                arrays.matrices(K),
                arrays.matrices(w2c),
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
        grad_K = grad_w2c = None
        if any(ctx.needs_input_grad[4:6]):
            chunks = min(count, CAMERA_CHUNKS)
            partial_w2c, partial_K = means.new_empty(images, chunks, 3, 4), means.new_empty(images, chunks, 3, 3)
            wp.launch(
                camera_kernel,
                dim=(images, chunks),
                inputs=[
                    arrays.vectors(means),
                    arrays.matrices(covariances),
                    arrays.matrices(K),
                    arrays.matrices(w2c),
                    _integers(g.state_index),
                    settings,
                    count,
                    g.width,
                    g.height,
                    chunks,
                    arrays.vectors(conics),
                    rects_wp,
                    *outputs[:2],
                ],
                outputs=[arrays.matrices(partial_w2c), arrays.matrices(partial_K)],
                device=device,
            )
            grad_K = partial_K.sum(1)
            grad_w2c = torch.cat((partial_w2c.sum(1), means.new_zeros(images, 1, 4)), 1)
        return grad_means, grad_covariances, grad_opacities, grad_features, grad_K, grad_w2c, None
