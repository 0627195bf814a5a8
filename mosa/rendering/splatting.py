"""Splatting on Warp, for CPU and CUDA: projection and compositing kernels behind one torch autograd function.

Gradients to means, covariances, opacities and features, by hand-written adjoints. Kept for the backward pass: the projected
Gaussians (records.py), the final transmittance and the place in its list where a pixel ended; on CUDA the tile lists too,
one entry per (tile, Gaussian) pair that is visible. Nothing grows with Gaussians times pixels.
"""

import functools
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.physics.exact_sums import COLUMNS, needed, sum_functions
from mosa.physics.launching import SCALARS, turn, warp_stream
from mosa.rendering.covariance import CLAMP_MARGIN
from mosa.rendering.projection_kernels import projection_kernels
from mosa.rendering.raster_kernels import raster_kernels
from mosa.rendering.tile_kernels import tile_kernels, tile_threads
from mosa.rendering.tile_lists import tile_lists
from mosa.system.threads import cores, threaded

NEAR, EXTENT, ALPHA_MAX = 0.01, 3.33, 0.999
"""Nearest depth [m], extent of a Gaussian in standard deviations, cap of alpha: gsplat's."""


@functools.cache
def _kind(scalar: type, *shape: int) -> type:
    if len(shape) == 2:
        return wp.types.matrix(shape=shape, dtype=scalar)
    return wp.types.vector(length=shape[0], dtype=scalar) if shape else scalar


def _flat(x: Tensor, axes: int = 0):
    """Warp descriptor of a contiguous tensor, flat but for its last 0 to 2 `axes`, those of numbers, vectors or matrices."""
    shape = x.shape[x.dim() - axes :]
    return wp.from_torch(
        x.view(-1, *shape), dtype=_kind(wp.dtype_from_torch(x.dtype), *shape), return_ctype=True
    )


@dataclass(frozen=True)
class Geometry:
    """What a call fixes besides its differentiable inputs. state_index: (B,) int32; scan: gaussian | tile."""

    state_index: Tensor
    width: int
    height: int
    scan: str


class Splat(torch.autograd.Function):
    """(means, covariances, opacities, features, K (B, 3, 3), w2c (B, 4, 4), geometry) -> image (B, H, W, C), alpha (B, H, W).

    Shapes as in `mosa.rendering.rasterizer.rasterize`, which checks them."""

    @staticmethod
    def forward(ctx, means, covariances, opacities, features, K, w2c, geometry: Geometry):
        means, covariances, opacities, features, K, w2c = (
            x.detach().contiguous() for x in (means, covariances, opacities, features, K, w2c)
        )

        def seen(some: slice) -> tuple[Tensor, ...]:
            own = replace(geometry, state_index=geometry.state_index[some])
            records, depths = project(means, covariances, opacities, K[some], w2c[some], own)
            lists = depth_lists(depths, records, own)
            return *composite(lists, records, _of(features, some), own), records, *lists

        with warp_stream(means.device), turn(means.device):
            image, transmittance, ends, records, *lists = _in_parts(seen, features, geometry)
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
        g = ctx.geometry
        incoming, outgoing = grad_image.contiguous(), grad_alpha.contiguous()

        def moved(some: slice) -> tuple[Tensor, ...]:
            return composite_backward(
                tuple(t[some] for t in lists), records[some], _of(features, some), ends[some],
                transmittance[some], incoming[some], outgoing[some], g,
            )  # fmt: skip

        with warp_stream(features.device), turn(features.device):
            moments, grad_features = _in_parts(moved, features, g)
            gradients = project_backward(means, covariances, opacities, K, w2c, records, moments, g)
        if len(grad_features) > len(features):  # image after image, whatever the parts were
            grad_features = functools.reduce(torch.add, grad_features)[None]
        return *gradients, grad_features, None, None, None


_compiled = set[tuple]()
"""What `_in_parts` has run: each of its threads would compile the kernels."""


def _in_parts(
    function: Callable[[slice], tuple[Tensor, ...]], features: Tensor, g: Geometry
) -> Iterable[Tensor]:
    """function(some images), on a CPU on as many threads as there are cores, and what it returns of all images."""
    images, kind = len(g.state_index), (function.__name__, features.dtype, features.shape[-1])
    count = 1
    if features.is_cpu and g.scan == "gaussian":
        count = min(images, cores()) if kind in _compiled else 1
        _compiled.add(kind)
    ends = [images * i // count for i in range(count + 1)]
    parts = list(threaded(function, [slice(*both) for both in itertools.pairwise(ends)]))
    return parts[0] if count == 1 else map(torch.cat, zip(*parts))


def _of(features: Tensor, some: slice) -> Tensor:
    """Those of some images, which may share them."""
    return features if len(features) == 1 else features[some]


def project(
    means: Tensor, covariances: Tensor, opacities: Tensor, K: Tensor, w2c: Tensor, g: Geometry
) -> tuple[Tensor, Tensor]:
    """Records (B, N, 8) and depths (2 B N,), infinite where nothing is seen; the second half is room to sort them."""
    images, count = len(g.state_index), means.shape[1]
    records, depths = means.new_empty(images, count, 8), means.new_empty(2 * images * count)
    kernel, _ = projection_kernels(SCALARS[means.dtype])
    stride = count if opacities.dim() == 2 else 0
    given = [_flat(means, 1), _flat(covariances, 2), _flat(opacities), stride]
    given += _projection(K, w2c, count, g)
    _launch(kernel, (images, count), given, [_flat(records, 1), _flat(depths)], means)
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
    channels, scalar = features.shape[-1], SCALARS[records.dtype]
    shape = images, g.height, g.width
    transmittance, image = records.new_ones(shape), records.new_zeros(*shape, channels)
    ends = torch.full(shape, count, dtype=torch.int32, device=records.device)
    if g.scan == "tile":
        kernel, threads = tile_kernels(scalar, channels)[0], tile_threads(images, g.width, g.height)
    else:
        kernel, threads = raster_kernels(scalar, channels)[0], images
    given = [*map(_flat, lists), *_splats(records, features, g)]
    _launch(kernel, threads, given, [_flat(transmittance), _flat(image, 1), _flat(ends)], records)
    return image, transmittance, ends


def composite_backward(
    lists: tuple[Tensor, ...], records: Tensor, features: Tensor, ends: Tensor, transmittance: Tensor,
    grad_image: Tensor, grad_alpha: Tensor, g: Geometry,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Moments (B, N, 8) of the records (records.py) and the gradient of the features, on a CPU (B, N, C) if shared too."""
    scalar, channels = SCALARS[records.dtype], features.shape[-1]
    found, exact = (torch.zeros_like(records), torch.zeros_like(features)), False
    if g.scan == "tile":
        exact = needed(records.device)
        _, kernel = tile_kernels(scalar, channels, exact)
        threads, state = tile_threads(len(records), g.width, g.height), (transmittance, grad_alpha)
    else:
        _, kernel = raster_kernels(scalar, channels)
        found = found[0], records.new_zeros(*records.shape[:2], channels)
        threads, state = len(records), (transmittance.clone(), -grad_alpha * transmittance)
    given = [*map(_flat, lists), *_splats(records, features, g), _flat(ends), _flat(grad_image, 1)]
    given += map(_flat, state)
    if not exact:
        _launch(kernel, threads, given, [_flat(t, 1) for t in found], records)
        return found
    sums = [torch.zeros(t.numel(), COLUMNS, dtype=torch.int64, device=t.device) for t in found]
    _launch(kernel, threads, given, [wp.from_torch(t) for t in sums], records)
    for target, added in zip(found, sums):
        settle = sum_functions(scalar).settle
        _launch(settle, target.numel(), [wp.from_torch(added), _flat(target)], [], records)
    return found


def project_backward(
    means: Tensor, covariances: Tensor, opacities: Tensor, K: Tensor, w2c: Tensor, records: Tensor,
    moments: Tensor, g: Geometry,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Gradients of means, covariances and opacities."""
    found = tuple(torch.zeros_like(x) for x in (means, covariances, opacities))
    count = means.shape[1]
    _, kernel = projection_kernels(SCALARS[means.dtype])
    given = [_flat(means, 1), _flat(covariances, 2), count if opacities.dim() == 2 else 0]
    given += [*_projection(K, w2c, count, g), len(records), _flat(records, 1), _flat(moments, 1)]
    _launch(kernel, count, given, [_flat(t, axes) for t, axes in zip(found, (1, 2, 0))], means)
    return found


def _launch(kernel, dim, inputs: list, outputs: list, like: Tensor) -> None:
    device = wp.device_from_torch(like.device)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)


def _splats(records: Tensor, features: Tensor, g: Geometry) -> list:
    """What all compositing kernels take after their lists."""
    count = records.shape[1]
    stride = count if features.shape[0] > 1 else 0
    cap = SCALARS[records.dtype](ALPHA_MAX)
    return [_flat(records, 1), _flat(features, 1), stride, cap, count, g.width, g.height]


def _projection(K: Tensor, w2c: Tensor, count: int, g: Geometry) -> list:
    """What all projection kernels take after the Gaussians."""
    settings = _kind(SCALARS[K.dtype], 3)(NEAR, CLAMP_MARGIN, EXTENT)
    return [_flat(K, 2), _flat(w2c, 2), _flat(g.state_index), settings, count, g.width, g.height]
