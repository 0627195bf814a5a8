"""Small fully connected networks whose backward pass keeps the pre-activations only.

A rollout evaluates the adapter a hundred times and keeps every graph: storing half as much per evaluation halves its memory.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import silu


class _TwoHidden(torch.autograd.Function):
    """y = W3 silu(W2 silu(W1 x + b1) + b2) + b3; the activations are recomputed in the backward pass."""

    @staticmethod
    def forward(ctx, x, W1, b1, W2, b2, W3, b3):
        z1 = torch.addmm(b1, x, W1.T)
        z2 = torch.addmm(b2, silu(z1), W2.T)
        ctx.save_for_backward(x, z1, z2, W1, W2, W3)
        return torch.addmm(b3, silu(z2), W3.T)

    @staticmethod
    @once_differentiable
    def backward(ctx, seed):
        x, z1, z2, W1, W2, W3 = ctx.saved_tensors
        needs = ctx.needs_input_grad
        seed = seed.contiguous()
        weights = any(needs[1:])
        inner = torch.ops.aten.silu_backward(seed @ W3, z2)
        outer = torch.ops.aten.silu_backward(inner @ W2, z1)
        grads = [outer @ W1 if needs[0] else None] + [None] * 6
        if weights:
            grads[1:] = [
                outer.T @ x,
                outer.sum(0),
                inner.T @ silu(z1),
                inner.sum(0),
                seed.T @ silu(z2),
                seed.sum(0),
            ]
        return tuple(g if need else None for g, need in zip(grads, needs))


class TwoHiddenLayers(nn.Sequential):
    """MLP with two hidden layers of SiLU: (N, inputs) to (N, outputs)."""

    def __init__(self, inputs: int, outputs: int, hidden: int) -> None:
        super().__init__(
            nn.Linear(inputs, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, outputs),
        )

    def forward(self, x: Tensor) -> Tensor:
        first, second, last = self[0], self[2], self[4]
        return _TwoHidden.apply(
            x, first.weight, first.bias, second.weight, second.bias, last.weight, last.bias
        )

    def features(self, x: Tensor) -> Tensor:
        """(N, hidden) what the last layer reads."""
        return silu(self[2](silu(self[0](x))))


def zero_outputs(layer: nn.Linear, rows: int | None = None) -> None:
    """Zero the first `rows` outputs of a layer (None: all of them)."""
    with torch.no_grad():
        layer.weight[:rows].zero_()
        layer.bias[:rows].zero_()
