"""Splatting on Warp, for CPU and CUDA: projection and compositing kernels behind one torch autograd function.

Gradients to means, covariances, opacities and features, by hand-written adjoints. Kept for the backward pass: the projected
Gaussians (records.py), the final transmittance and the place in its list where a pixel ended; on CUDA the tile lists too,
one entry per (tile, Gaussian) pair that is visible. Nothing grows with Gaussians times pixels.
"""

import contextlib
import functools
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.physics.exact_sums import COLUMNS, needed, sum_functions
from mosa.rendering.covariance import CLAMP_MARGIN
from mosa.rendering.projection_kernels import projection_kernels
from mosa.rendering.raster_kernels import raster_kernels
from mosa.rendering.tile_kernels import tile_kernels, tile_threads
from mosa.rendering.tile_lists import tile_lists

NEAR, EXTENT, ALPHA_MAX = 0.01, 3.33, 0.999
"""Nearest depth [m], extent of a Gaussian in standard deviations, cap of alpha: gsplat's."""

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


@functools.cache
def _vector(length: int, scalar: type) -> type:
    return wp.types.vector(length=length, dtype=scalar)


@functools.cache
def _matrix(rows: int, columns: int, scalar: type) -> type:
    return wp.types.matrix(shape=(rows, columns), dtype=scalar)


@functools.cache
def _warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    return wp.stream_from_torch(stream)


def torch_stream(device: torch.device):
    """Context in which Warp launches where torch does: in order with its work, without waiting at every change between them."""
    if device.type == "cpu":
        return contextlib.nullcontext()
    return wp.ScopedStream(_warp_stream(torch.cuda.current_stream(device)), sync_enter=False)


@dataclass(frozen=True)
class Geometry:
    """What a call fixes besides its differentiable inputs. state_index: (B,) int32; scan: gaussian | tile."""

    state_index: Tensor
    width: int
    height: int
    scan: str


class _Arrays:
    """Flat Warp descriptors of contiguous torch tensors of one scalar type."""

    def __init__(self, dtype: torch.dtype):
        self.scalar = SCALARS[dtype]

    def scalars(self, x: Tensor):
        return wp.from_torch(x.view(-1), dtype=self.scalar, return_ctype=True)

    def vectors(self, x: Tensor):
        return wp.from_torch(
            x.view(-1, x.shape[-1]), dtype=_vector(x.shape[-1], self.scalar), return_ctype=True
        )

    def matrices(self, x: Tensor):
        return wp.from_torch(
            x.view(-1, *x.shape[-2:]), dtype=_matrix(*x.shape[-2:], self.scalar), return_ctype=True
        )


def _integers(x: Tensor):
    return wp.from_torch(x.view(-1), dtype=wp.int32, return_ctype=True)


class Splat(torch.autograd.Function):
    """(means, covariances, opacities, features, K (B, 3, 3), w2c (B, 4, 4), geometry) -> image (B, H, W, C), alpha (B, H, W).

    Shapes as in `mosa.rendering.rasterizer.rasterize`, which checks them.
    """

    @staticmethod
    def forward(ctx, means, covariances, opacities, features, K, w2c, geometry: Geometry):
        means, covariances, opacities, features, K, w2c = (
            x.detach().contiguous() for x in (means, covariances, opacities, features, K, w2c)
        )
        with torch_stream(means.device):
            records, depths = project(means, covariances, opacities, K, w2c, geometry)
            lists = depth_lists(depths, records, geometry)
            image, transmittance, ends = composite(lists, records, features, geometry)
        ctx.save_for_backward(
            means, covariances, opacities, features, K, w2c, records, transmittance, ends, *lists
        )
        ctx.geometry = geometry
        return image, 1 - transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image: Tensor, grad_alpha: Tensor):
        means, covariances, opacities, features, K, w2c, records, transmittance, ends, *lists = (
            ctx.saved_tensors
        )
        with torch_stream(means.device):
            moments, grad_features = composite_backward(
                lists,
                records,
                features,
                ends,
                transmittance,
                grad_image.contiguous(),
                grad_alpha.contiguous(),
                ctx.geometry,
            )
            projected = (means, covariances, opacities, K, w2c, records, moments, ctx.geometry)
            gradients = project_backward(*projected)
        return *gradients, grad_features, None, None, None


def project(
    means: Tensor, covariances: Tensor, opacities: Tensor, K: Tensor, w2c: Tensor, g: Geometry
) -> tuple[Tensor, Tensor]:
    """Records (B, N, 8) and depths (2 B N,), infinite where nothing is seen; the second half is room to sort them."""
    images, count = len(g.state_index), means.shape[1]
    arrays = _Arrays(means.dtype)
    records, depths = means.new_empty(images, count, 8), means.new_empty(2 * images * count)
    kernel, _ = projection_kernels(arrays.scalar)
    wp.launch(
        kernel,
        dim=(images, count),
        inputs=[
            arrays.vectors(means),
            arrays.matrices(covariances),
            arrays.scalars(opacities),
            count if opacities.dim() == 2 else 0,
            *_projection(arrays, K, w2c, count, g),
        ],
        outputs=[arrays.vectors(records), arrays.scalars(depths)],
        device=wp.device_from_torch(means.device),
    )
    return records, depths


def depth_lists(depths: Tensor, records: Tensor, g: Geometry) -> tuple[Tensor, ...]:
    """What compositing walks: the Gaussians of each image by depth, (B, N), or those of each tile, `tile_lists`."""
    if g.scan == "tile":
        return tile_lists(depths, records, g.width, g.height)
    images, count, _ = records.shape
    return (
        depths[: images * count].view(images, count).argsort(dim=1, stable=True).to(torch.int32),
    )


def composite(
    lists: tuple[Tensor, ...], records: Tensor, features: Tensor, g: Geometry
) -> tuple[Tensor, Tensor, Tensor]:
    """Image (B, H, W, C), final transmittance (B, H, W) and the place in its list where each pixel ended (B, H, W)."""
    images, count, _ = records.shape
    arrays, shape = _Arrays(records.dtype), (images, g.height, g.width)
    if g.scan == "tile":
        kernel, _ = tile_kernels(arrays.scalar, features.shape[-1])
        threads = tile_threads(images, g.width, g.height)
        transmittance, image = (
            records.new_empty(shape),
            records.new_empty(*shape, features.shape[-1]),
        )
        ends = torch.empty(shape, dtype=torch.int32, device=records.device)
    else:
        kernel, _ = raster_kernels(arrays.scalar, features.shape[-1])
        threads = images
        transmittance, image = (
            records.new_ones(shape),
            records.new_zeros(*shape, features.shape[-1]),
        )
        ends = torch.full(shape, count, dtype=torch.int32, device=records.device)
    wp.launch(
        kernel,
        dim=threads,
        inputs=[*map(_integers, lists), *_splats(arrays, records, features, g)],
        outputs=[arrays.scalars(transmittance), arrays.vectors(image), _integers(ends)],
        device=wp.device_from_torch(records.device),
    )
    return image, transmittance, ends


def composite_backward(
    lists: tuple[Tensor, ...],
    records: Tensor,
    features: Tensor,
    ends: Tensor,
    transmittance: Tensor,
    grad_image: Tensor,
    grad_alpha: Tensor,
    g: Geometry,
) -> tuple[Tensor, Tensor]:
    """Moments (B, N, 8) of the records (records.py) and the gradient of the features."""
    arrays = _Arrays(records.dtype)
    moments, grad_features = torch.zeros_like(records), torch.zeros_like(features)
    found, exact = (moments, grad_features), g.scan == "tile" and needed(records.device)
    if g.scan == "tile":
        _, kernel = tile_kernels(arrays.scalar, features.shape[-1], exact)
        threads, state = tile_threads(len(records), g.width, g.height), (transmittance, grad_alpha)
    else:
        _, kernel = raster_kernels(arrays.scalar, features.shape[-1])
        threads, state = len(records), (transmittance.clone(), -grad_alpha * transmittance)
    sums = (
        [torch.zeros(t.numel(), COLUMNS, dtype=torch.int64, device=t.device) for t in found]
        if exact
        else []
    )
    wp.launch(
        kernel,
        dim=threads,
        inputs=[
            *map(_integers, lists),
            *_splats(arrays, records, features, g),
            _integers(ends),
            arrays.vectors(grad_image),
            *map(arrays.scalars, state),
        ],
        outputs=[wp.from_torch(t) for t in sums] if exact else [arrays.vectors(t) for t in found],
        device=wp.device_from_torch(records.device),
    )
    for target, added in zip(found, sums):
        given = [wp.from_torch(added), arrays.scalars(target)]
        wp.launch(
            sum_functions(arrays.scalar).settle,
            target.numel(),
            given,
            device=wp.device_from_torch(records.device),
        )
    return found


def project_backward(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    K: Tensor,
    w2c: Tensor,
    records: Tensor,
    moments: Tensor,
    g: Geometry,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of means, covariances and opacities."""
    arrays, count = _Arrays(means.dtype), means.shape[1]
    grad_means, grad_covariances, grad_opacities = (
        torch.zeros_like(x) for x in (means, covariances, opacities)
    )
    _, kernel = projection_kernels(arrays.scalar)
    wp.launch(
        kernel,
        dim=count,
        inputs=[
            arrays.vectors(means),
            arrays.matrices(covariances),
            count if opacities.dim() == 2 else 0,
            *_projection(arrays, K, w2c, count, g),
            len(records),
            arrays.vectors(records),
            arrays.vectors(moments),
        ],
        outputs=[
            arrays.vectors(grad_means),
            arrays.matrices(grad_covariances),
            arrays.scalars(grad_opacities),
        ],
        device=wp.device_from_torch(means.device),
    )
    return grad_means, grad_covariances, grad_opacities


def _splats(arrays: _Arrays, records: Tensor, features: Tensor, g: Geometry) -> list:
    """What all compositing kernels take after their lists."""
    count = records.shape[1]
    stride = count if features.shape[0] > 1 else 0
    cap = arrays.scalar(ALPHA_MAX)
    return [
        arrays.vectors(records),
        arrays.vectors(features),
        stride,
        cap,
        count,
        g.width,
        g.height,
    ]


def _projection(arrays: _Arrays, K: Tensor, w2c: Tensor, count: int, g: Geometry) -> list:
    """What all projection kernels take after the Gaussians."""
    settings = _vector(3, arrays.scalar)(NEAR, CLAMP_MARGIN, EXTENT)
    return [
        arrays.matrices(K),
        arrays.matrices(w2c),
        _integers(g.state_index),
        settings,
        count,
        g.width,
        g.height,
    ]
