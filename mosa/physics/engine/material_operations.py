"""Operations on each particle alone, around the segments: the state that an adapter reads, the first advance of F under a return
mapping, and the stress of the law."""

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from mosa.physics.constitutive import material_kernels
from mosa.physics.constitutive.laws import Law
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
    mat33, vec6, mat66, vecp = material_kernels.field_types(scalar)
    kernel = material_kernels.stress_kernel(law.stress, law.uses_rotation, scalar, False)
    blank, tau = F.new_zeros(1, 6, 6), torch.empty_like(F, memory_format=torch.contiguous_format)
    with warp_stream(F.device):
        arrays = _arrays(
            [F, C_affine, parameters, blank, blank[0, :1], tau],
            [mat33, mat33, vecp, mat66, vec6, mat33],
        )
        launch(kernel, len(F), [*arrays, None], arrays[0].device)
    return tau


class _OfParticles(torch.autograd.Function):
    """What a kernel makes of each particle: of inputs and constants, into `outputs`; kinds: Warp types of inputs and outputs. into:
    as `material_state`."""

    @staticmethod
    def forward(
        ctx, kernel, kinds: list, constants: list, outputs: list[Tensor], into, *inputs: Tensor
    ):
        ctx.kernel, ctx.kinds, ctx.constants, ctx.into = kernel, kinds, constants, into
        ctx.blanks = [t.new_empty(1, *t.shape[1:]) for t in outputs]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs)
        with warp_stream(inputs[0].device):
            arrays = _arrays([*inputs, *outputs], kinds)
            arrays[len(inputs) : len(inputs)] = constants
            launch(kernel, len(inputs[0]), arrays, arrays[0].device)
        return tuple(outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        # the adjoint leaves the outputs alone and only reads the seeds: Warp clears only those that are the grad of an array
        inputs = list(ctx.saved_tensors)
        count = len(inputs)
        gradients = _zeros(inputs) if ctx.into is None else ctx.into
        with warp_stream(inputs[0].device):
            arrays = _arrays([*inputs, *ctx.blanks], ctx.kinds)
            arrays[count:count] = ctx.constants
            adjoints = [*_targets(gradients, ctx.kinds), *(type(c)(0) for c in ctx.constants)]
            adjoints += _arrays(list(seeds), ctx.kinds[count:])
            launch(ctx.kernel, len(inputs[0]), arrays, arrays[0].device, adjoints)
        return *[None] * 5, *(gradients if ctx.into is None else [None] * count)


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
    parameters begins at a multiple of 16 bytes."""
    scalar = SCALARS[F.dtype]
    mat33, vec6, _, vecp = material_kernels.field_types(scalar)
    kernel = material_kernels.state_kernel(law.stress, law.uses_rotation, scalar, law.plastic)
    # the kernel writes all of them; a law that does not yield has no e
    outputs = [F.new_empty(rows, 6) for rows in (len(F), len(F), len(F) if law.plastic else 1)]
    kinds = [mat33, mat33, vecp, vec6, vec6, vec6]
    w, s, e = _OfParticles.apply(kernel, kinds, [], outputs, into, F, C_affine, parameters)
    return w, s, e if law.plastic else None


def first_advance(numerics: Numerics, F: Tensor, C_affine: Tensor, parameters: Tensor, G: Tensor | None = None,
                  h: Tensor | None = None) -> Tensor:  # fmt: skip
    """map((I + dt C_affine) F), (N, 3, 3): the advance of F with which a rollout starts. Differentiable."""
    if not numerics.law.plastic:
        return advanced(F, C_affine, numerics.dt)
    scalar = SCALARS[F.dtype]
    mat33, vec6, mat66, vecp = material_kernels.field_types(scalar)
    kernel = material_kernels.return_kernel(numerics.law.return_map, scalar, G is not None)
    operator = (F.new_zeros(1, 6, 6), F.new_zeros(1, 6)) if G is None else (G, h)
    constants = [numerics.dt, numerics.norm_eps, int(numerics.rebuild)]
    mapped = torch.empty_like(F, memory_format=torch.contiguous_format)
    kinds = [mat33, mat33, vecp, mat66, vec6, mat33]
    inputs = (F, C_affine, parameters, *operator)
    return _OfParticles.apply(kernel, kinds, constants, [mapped], None, *inputs)[0]


def advanced(F: Tensor, C_affine: Tensor, dt: float) -> Tensor:
    """(I + dt C_affine) F of matrices (N, 3, 3), dt in s. Differentiable.

    The product is a sum of three outer products: cuBLAS takes small matrices in batches of 65535, longer than a substep."""
    first, second, third = (c * r for c, r in zip(C_affine.split(1, -1), F.split(1, -2)))
    return F + dt * (first + second + third)
