"""Gauss-Newton as an optimiser of torch, so that Lightning drives it like any other."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from mosa.modules.fitting.identification import Identification


class GaussNewtonOptimizer(torch.optim.Optimizer):
    """A step is one iteration of the identification of a body's few numbers (`identification.py`).

    The closure evaluates the residuals at the numbers as they stand and returns the cost; no gradient is asked for, as the
    iteration finds its Jacobian by differences. `lr` is 1: a whole step, which the iteration itself shortens where it must."""

    def __init__(
        self, parameters: Iterable[Tensor], identification: Callable[[], Identification]
    ) -> None:
        """identification: the running one, asked in every step: a stage makes it in its first closure."""
        super().__init__([{"params": list(parameters), "name": "numbers"}], {"lr": 1.0})
        self.identification = identification

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:  # type: ignore[override]  # torch declares floats
        loss = None if closure is None else closure()
        self.identification().iterate()
        return loss
