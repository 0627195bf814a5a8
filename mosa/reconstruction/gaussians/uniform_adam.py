"""Torch's Adam, and one with a single step size per group of numbers: noise in one of many amplitudes does not make it move as fast
as the others."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def adam(groups: list[dict[str, Any]]) -> torch.optim.Adam:
    """Torch's, of groups of tensors of one device; on a GPU each group in one launch."""
    fused = groups[0]["params"][0].is_cuda
    return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=fused)


class UniformAdam(torch.optim.Optimizer):
    """Adam whose second moment is the sum over all axes but the first (one per frame).

    Source: Nicolet et al. 2021, "Large steps in inverse rendering of geometry", where one serves all numbers.
    Directions keep the proportions that the gradient gives them, so a preconditioned parametrisation (smooth modes with units
    that fall with their wave number) stays preconditioned; plain Adam would equalise all of them."""

    def __init__(self, params, lr: float, betas: tuple[float, float] = (0.9, 0.99)) -> None:
        super().__init__(params, {"lr": lr, "betas": betas})

    @torch.no_grad()
    def step(self, closure=None) -> None:
        for group in self.param_groups:
            first, second = group["betas"]
            for p in group["params"]:
                if p.grad is not None:
                    self._update(p, group["lr"], first, second)

    def _update(self, p: Tensor, lr: float, first: float, second: float) -> None:
        state = self.state[p]
        axes = tuple(range(1, p.dim()))
        if not state:
            state["step"], state["mean"] = 0, torch.zeros_like(p)
            state["square"] = p.new_zeros([len(p)] + [1] * len(axes))
        state["step"] += 1
        state["mean"].lerp_(p.grad, 1 - first)
        state["square"].lerp_(
            (p.grad**2).sum(axes, keepdim=True) if axes else p.grad**2, 1 - second
        )
        scale = (state["square"] / (1 - second ** state["step"])).sqrt()
        # a frame without any gradient (all its views look away) stays where it is
        tiny = torch.finfo(p.dtype).tiny
        move = torch.where(scale > 0, state["mean"] / scale.clamp(min=tiny), 0.0)
        p.add_(move, alpha=-lr / (1 - first ** state["step"]))
