"""Steps of Adam after which the body cannot be simulated are taken back, and the ones that follow are half as long.

Networks that stand in for a law can be moved by one step to where an element turns inside out. A line search would ask for a
rollout more in each step; taking back the rare one that fails asks for none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from mosa.errors import DataError

MOST_HALVINGS = 10
"""Halvings of a stage's steps: after a thousandth of the configured ones it is not their length that fails."""


class Retreat:
    """Of one stage. halvings: of its steps so far; before: the numbers before the last step, None where there was none."""

    def __init__(self) -> None:
        self.halvings = 0
        self.before: list[Tensor] | None = None

    @property
    def share(self) -> float:
        """Of the configured length that a step has."""
        return 0.5**self.halvings

    def note(self, parameters: Sequence[Tensor]) -> None:
        """Keep these: a step follows, from numbers that could be simulated."""
        self.before = [p.detach().clone() for p in parameters]

    @torch.no_grad()
    def back(self, optimizer: torch.optim.Optimizer, parameters: Sequence[Tensor]) -> bool:
        """Undo the last step, with what the optimiser learned of the way there; False where there is none to undo, or too many
        were."""
        if self.before is None or self.halvings == MOST_HALVINGS:
            return False
        for parameter, kept in zip(parameters, self.before, strict=True):
            parameter.copy_(kept)
            if "exp_avg" in (state := optimizer.state.get(parameter, {})):
                state["exp_avg"].zero_()
        self.halvings += 1
        return True

    def written(self) -> dict[str, Any]:
        before = None if self.before is None else [t.cpu() for t in self.before]
        return {"halvings": self.halvings, "before": before}

    def read(self, saved: Mapping[str, Any] | None, parameters: Sequence[Tensor]) -> None:
        """As it was written, for these parameters. Errors: DataError where it is another stage's."""
        saved = saved or {"halvings": 0, "before": None}
        before = saved["before"]
        if before is not None and [tuple(t.shape) for t in before] != [
            tuple(p.shape) for p in parameters
        ]:
            raise DataError(
                f"ckpt_path: mosa.retreat.before: expected tensors of shapes {[tuple(p.shape) for p in parameters]}, "
                f"found {[tuple(t.shape) for t in before]}: the checkpoint belongs to another configuration"
            )
        self.halvings = int(saved["halvings"])
        self.before = None if before is None else [t.to(p) for t, p in zip(before, parameters)]
