"""A stretch of motion as one differentiable torch operation, whatever it consists of.

Between the passes a stretch keeps what its backward pass reads, where there is room for it, and else only its inputs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from mosa.physics.engine.numerics import State

STATES = len(State._fields)


class Kept:
    """What a forward pass leaves for the backward pass. windows: of the grid that it used; tape: `Workspace.tape`, [] where the
    states are to be made again."""

    def __init__(self, windows: tuple, tape: list[Tensor]) -> None:
        self.windows, self.tape = windows, tape

    def take(self) -> list[Tensor]:
        """The tape, which is freed as soon as it is used: another pass makes the states again."""
        tape, self.tape = self.tape, []
        return tape


class Stretch(ABC):
    """Some substeps that are advanced, and differentiated, as a whole. plastic: whether the law yields, so that F_tot is a state of
    its own.

    Besides the state a stretch depends on other tensors (an operator that is held, poses, weights; None for one there is not), and
    besides the state it leaves others (reactions, statistics)."""

    plastic: bool

    @abstractmethod
    def forward(
        self, state: State, others: Sequence[Tensor | None], differentiated: bool
    ) -> tuple[State, Sequence[Tensor], Any]:
        """(the state after it, what else it leaves, what `backward` gets as `kept`). differentiated: whether that follows."""

    @abstractmethod
    def backward(
        self, state: State, others: Sequence[Tensor | None], kept: Any, seeds: Sequence[Tensor | None],
        other_seeds: Sequence[Tensor | None],
    ) -> tuple[Sequence[Tensor], Sequence[Tensor | None]]:  # fmt: skip
        """Gradients of (state, others), of as many states as there are seeds: without F_tot where the law does not yield."""


class _Advance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, stretch: Stretch, *inputs):
        ctx.set_materialize_grads(False)
        state, others = _detached(inputs[:STATES]), inputs[STATES:]
        final, more, ctx.kept = stretch.forward(state, others, True)
        ctx.stretch, ctx.own = stretch, STATES if stretch.plastic else STATES - 1
        ctx.save_for_backward(*state, *others)  # weights too: autograd tells if one is changed before the backward pass
        return *final[: ctx.own], *more

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        state, others = State(*ctx.saved_tensors[:STATES]), ctx.saved_tensors[STATES:]
        found, of_others = ctx.stretch.backward(state, others, ctx.kept, seeds[: ctx.own], seeds[ctx.own :])
        return None, *found, *[None] * (STATES - ctx.own), *of_others


def _detached(state: Iterable[Tensor]) -> State:
    return State(*(t.detach().contiguous() for t in state))


def wants_gradient(tensors: Iterable[Tensor | None]) -> bool:
    """Whether torch would differentiate with respect to one of them."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def advance(stretch: Stretch, state: State, others: Sequence[Tensor | None]) -> tuple[State, tuple[Tensor, ...]]:
    """(the state after the stretch, what else it leaves), differentiable in state and others."""
    if not wants_gradient((*state, *others)):
        final, more, _ = stretch.forward(_detached(state), others, False)
        return final, tuple(more)
    result = _Advance.apply(stretch, *state, *others)
    own = STATES if stretch.plastic else STATES - 1
    return State.whole(result[:own]), tuple(result[own:])
