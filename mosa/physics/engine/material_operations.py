"""Operations on each particle alone, around the segments: the state that an adapter reads, the first advance of F under a return
mapping, and the stress of the law."""

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from mosa.physics.constitutive.laws import Law
from mosa.physics.constitutive.material_kernels import (
    field_types,
    return_kernel,
    state_kernel,
    stress_kernel,
)
from mosa.physics.engine.numerics import Numerics
from mosa.physics.launching import SCALARS, aligned, launch, warp_stream, zeros_in_one


def _arrays(tensors: list[Tensor | None], kinds: list) -> list:
    return [
        None if t is None else wp.from_torch(aligned(t.detach()), dtype=kind)
        for t, kind in zip(tensors, kinds, strict=True)
    ]


def _targets(tensors: Sequence[Tensor], kinds: list) -> list:
    """What adjoints add to: never a copy, which nobody would read. Matrices of 3 x 3 are moved one number at a time and may begin
    anywhere; the others begin at a multiple of 16 bytes where they are made."""
    if not all(t.is_contiguous() for t in tensors):
        raise ValueError(
            f"gradients: expected contiguous tensors, found strides {[t.stride() for t in tensors]}"
        )
    return [wp.from_torch(t.detach(), dtype=kind) for t, kind in zip(tensors, kinds)]


def _zeros(tensors: list[Tensor]) -> list[Tensor]:
    """Of the tensors' shapes: what adjoints add gradients to."""
    return zeros_in_one([t.shape for t in tensors], tensors[0].dtype, tensors[0].device)[1]


@torch.no_grad()
def kirchhoff_stress(law: Law, F: Tensor, C_affine: Tensor, parameters: Tensor) -> Tensor:
    """tau (N, 3, 3) [Pa] of the law alone, without an adapter. No gradient."""
    scalar = SCALARS[F.dtype]
    mat33, vec6, mat66, vecp = field_types(scalar)
    kernel = stress_kernel(law.stress, law.uses_rotation, scalar, False)
    blank, tau = F.new_zeros(1, 6, 6), torch.empty_like(F, memory_format=torch.contiguous_format)
    with warp_stream(F.device):
        arrays = _arrays(
            [F, C_affine, parameters, blank, blank[0, :1], tau],
            [mat33, mat33, vecp, mat66, vec6, mat33],
        )
        launch(kernel, len(F), arrays, arrays[0].device)
    return tau


class _MaterialState(torch.autograd.Function):
    @staticmethod
    def forward(ctx, law: Law, into, F, C, parameters):
        scalar = SCALARS[F.dtype]
        mat33, vec6, _, vecp = field_types(scalar)
        ctx.kernel = state_kernel(law.stress, law.uses_rotation, scalar, law.plastic)
        ctx.kinds = [mat33, mat33, vecp, vec6, vec6, vec6]
        ctx.plastic, ctx.into = law.plastic, into
        ctx.set_materialize_grads(False)
        # the kernel writes all of them; a law that does not yield has no e
        w, s, e = (F.new_empty(rows, 6) for rows in (len(F), len(F), len(F) if law.plastic else 1))
        ctx.save_for_backward(F, C, parameters)
        with warp_stream(F.device):
            arrays = _arrays([F, C, parameters, w, s, e], ctx.kinds)
            launch(ctx.kernel, len(F), arrays, arrays[0].device)
        return (w, s, e) if law.plastic else (w, s)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        # the adjoint leaves the outputs alone and only reads the seeds: Warp clears only those that are the grad of an array
        inputs, seeds = list(ctx.saved_tensors), [*seeds] + [None] * (not ctx.plastic)
        gradients = _zeros(inputs) if ctx.into is None else ctx.into
        blank = inputs[0].new_empty(1, 6)
        with warp_stream(blank.device):
            arrays = _arrays([*inputs, blank, blank, blank], ctx.kinds)
            adjoints = [*_targets(gradients, ctx.kinds), *_arrays(seeds, ctx.kinds[3:])]
            launch(ctx.kernel, len(inputs[0]), arrays, arrays[0].device, adjoints)
        return None, None, *(gradients if ctx.into is None else (None, None, None))


def material_state(
    law: Law,
    F: Tensor,
    C_affine: Tensor,
    parameters: Tensor,
    into: tuple[Tensor, Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """(w, s, e) that an adapter reads, differentiable.

    w: (N, 6) vech(W - I); s: (N, 6) vech(R^T tau R) [Pa] of the prior; e: (N, 6) vech(dev log W), None for elastic laws.
    into: add the gradients of F, C_affine and parameters to these contiguous tensors, and give autograd none. That of the
    parameters begins at a multiple of 16 bytes.
    """
    result = _MaterialState.apply(law, into, F, C_affine, parameters)
    return result if law.plastic else (*result, None)


class _Return(torch.autograd.Function):
    @staticmethod
    def forward(ctx, numerics: Numerics, F, C, parameters, G, h):
        scalar = SCALARS[F.dtype]
        mat33, vec6, mat66, vecp = field_types(scalar)
        adapted = G is not None
        ctx.kernel = return_kernel(numerics.law.return_map, scalar, adapted)
        ctx.kinds, ctx.adapted = [mat33, mat33, vecp, mat66, vec6], adapted
        ctx.constants = [numerics.dt, numerics.norm_eps, int(numerics.rebuild)]
        if not adapted:
            G, h = F.new_zeros(1, 6, 6), F.new_zeros(1, 6)
        ctx.save_for_backward(F, C, parameters, G, h)
        mapped = torch.empty_like(F, memory_format=torch.contiguous_format)
        with warp_stream(F.device):
            arrays = _arrays([F, C, parameters, G, h], ctx.kinds)
            launch(
                ctx.kernel,
                len(F),
                [*arrays, *ctx.constants, *_arrays([mapped], [mat33])],
                arrays[0].device,
            )
        return mapped

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, seed):
        inputs = list(ctx.saved_tensors)
        gradients = _zeros(inputs)
        with warp_stream(seed.device):
            arrays = _arrays(inputs, ctx.kinds)
            blank, seeds = _arrays([seed.new_empty(1, 3, 3), seed], ctx.kinds[:1] * 2)
            adjoints = [*_targets(gradients, ctx.kinds), 0.0, 0.0, 0, seeds]
            launch(
                ctx.kernel, len(seed), [*arrays, *ctx.constants, blank], arrays[0].device, adjoints
            )
        return None, *gradients[:3], *(gradients[3:] if ctx.adapted else (None, None))


def first_advance(numerics: Numerics, F: Tensor, C_affine: Tensor, parameters: Tensor, G: Tensor | None = None,
                  h: Tensor | None = None) -> Tensor:  # fmt: skip
    """map((I + dt C_affine) F), (N, 3, 3): the advance of F with which a rollout starts. Differentiable."""
    if not numerics.law.plastic:
        return advanced(F, C_affine, numerics.dt)
    return _Return.apply(numerics, F, C_affine, parameters, G, h)


def advanced(F: Tensor, C_affine: Tensor, dt: float) -> Tensor:
    """(I + dt C_affine) F of matrices (N, 3, 3), dt in s. Differentiable.

    The product is a sum of three outer products: cuBLAS takes small matrices in batches of 65535, longer than a substep."""
    first, second, third = (c * r for c, r in zip(C_affine.split(1, -1), F.split(1, -2)))
    return F + dt * (first + second + third)
