"""Segments with an adapter's evaluations between them, as one stretch of motion and, on CUDA, one captured graph per pass.

An adapter of the state is asked every few substeps. Done one by one, each answer costs some sixty launches and two transfers to
the host, which on CUDA take longer than the arithmetic of 100 000 particles. A chain of K segments looks at the host once. On a
CPU there is nothing to save: the adapter is asked between the segments, and autograd adds the gradients up, in another order.

The backward pass goes back through the states of all substeps, kept where there is memory for them, else made again from the
chain's start: the adapter is asked at the start of a segment with a graph, through which what the segment's adjoint leaves on its
answer goes to the state and to the adapter's weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from mosa.physics.adapters.interface import ANSWER
from mosa.physics.adapters.network_evaluation import at_hand
from mosa.physics.engine.buffers import Pool
from mosa.physics.engine.capture import ATTEMPTS, Graphs, TorchCapture
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.numerics import Numerics, State, Steps
from mosa.physics.engine.operation import Stretch, advance
from mosa.physics.engine.solver import WIDENED, SegmentSolver
from mosa.physics.engine.workspace import Workspace
from mosa.physics.grid.transfer_kernels import NO_EVENT
from mosa.physics.launching import same_memory, warp_stream

MOST_GRAPHS = 24
"""Of a chain, whose graphs have memory of their own for an evaluation: two or three for each time step."""


class Learned(NamedTuple):
    """Of an adapter: names and tensors of the weights that are learned, and all its parameters and buffers.

    Looking for them takes as long as a substep: once a rollout, and once for each chain of the backward pass."""

    names: tuple[str, ...]
    weights: tuple[Tensor, ...]
    tensors: tuple[Tensor, ...]


def tensors_of(adapter: nn.Module) -> tuple[Tensor, ...]:
    return (*adapter.parameters(), *adapter.buffers())


def learned_of(adapter: nn.Module) -> Learned:
    wanted = {name: p for name, p in adapter.named_parameters() if p.requires_grad}
    return Learned(tuple(wanted), tuple(wanted.values()), tensors_of(adapter))


class Chain:
    """Buffers and captured graphs of K segments of `lengths` substeps for N particles of `worlds` worlds and one adapter.

    ask: (adapter, F, C_affine, packed parameters, into=None) -> its answer by name (`ANSWER`, None where it has none),
    differentiable; into: as `material_state`.
    collects: also return `adapter.statistics()`, a named tuple of tensors, of every evaluation.
    An adapter that looks at the host cannot be captured: it is run uncaptured, with a warning."""

    def __init__(
        self, numerics: Numerics, adapter: nn.Module, ask: Callable[..., dict[str, Tensor | None]], particles: int, worlds: int,
        lengths: Sequence[int], *, learned: Learned, plastic_adapted: bool, collects: bool,
    ) -> None:  # fmt: skip
        self.numerics = numerics
        self.adapter = adapter
        self.ask = ask
        self.lengths = tuple(lengths)
        self.collects = collects
        self.substeps = sum(lengths)
        self.learned = learned
        self._shape = {
            "particles": particles, "substeps": self.substeps, "adapted": True, "plastic_adapted": plastic_adapted,
            "pointed": True, "worlds": worlds,
        }  # fmt: skip
        self.light: Workspace | None = None
        self.full: Workspace | None = None
        # in light and in full buffers: each graph has its own
        self.statistics: dict[bool, tuple[Tensor, ...]] = {}
        self.statistics_seeds: tuple[Tensor, ...] = ()
        self._kind: type | None = None
        failing = f"{type(adapter).__name__} cannot be captured as a CUDA graph and runs uncaptured"
        self._graphs = Graphs(
            TorchCapture(), failing, ATTEMPTS if numerics.device.type == "cuda" else 0, MOST_GRAPHS
        )
        self._held: tuple = ()  # what graphs have by value,
        self._read: Sequence[Tensor] = ()  # and by address

    def workspace(self, full: bool) -> Workspace:
        """full: of the backward pass, which are made when they are first needed."""
        if not full:
            self.light = self.light or Workspace(self.numerics, **self._shape, with_adjoint=False)
        elif self.full is None:
            self.full = Workspace(self.numerics, **self._shape, with_adjoint=True)
            self.adj_weights = [torch.zeros_like(w) for w in self.learned.weights]
        return self.full if full else self.light

    def named(self, statistics: Sequence[Tensor]) -> list:
        """One named tuple per evaluation, of tensors (K, ...)."""
        if self._kind is None:
            return []
        return [self._kind(*parts) for parts in zip(*statistics, strict=True)]

    def _ask(
        self, F: Tensor, C: Tensor, packed: Tensor, collects: bool, weights: Sequence[Tensor] | None = None,
        into: tuple[Tensor, Tensor, Tensor] | None = None,
    ) -> tuple[dict[str, Tensor | None], tuple[Tensor, ...]]:  # fmt: skip
        """weights: in place of the adapter's own."""
        adapter = self.adapter
        if weights is not None:
            named = dict(zip(self.learned.names, weights, strict=True))

            def adapter(state):
                return functional_call(self.adapter, named, (state,))

        answer = self.ask(adapter, F, C, packed, into=into)
        if not collects:
            return answer, ()
        statistics = self.adapter.statistics()
        self._kind = type(statistics)
        return answer, tuple(statistics)

    def _evaluate(self, step: int, collects: bool) -> tuple[list[Tensor], dict, tuple[Tensor, ...]]:
        """(F, C, parameters and weights as the ends of a graph, the adapter's answer to the state in slot `step`, its statistics);
        the graph adds the state's gradient to the segment's adjoint."""
        work, slot = self.full, step % 2
        into = (work.adj_F[slot], work.adj_C_affine[slot], work.adj_held["parameters"])
        with torch.enable_grad(), at_hand():
            inputs = (
                work.F[step],
                work.C_affine[step],
                work.held["parameters"],
                *self.learned.weights,
            )
            # aliases: autograd ties a leaf to the stream it was first used on, which a capture on another one may not touch
            leaves = [t.detach().requires_grad_() for t in inputs]
            return leaves, *self._ask(*leaves[:3], collects, leaves[3:], into)

    def _forward(self, full: bool) -> None:
        collected = self._segments(self.workspace(full), self.collects)
        self.statistics[full] = tuple(torch.stack(parts) for parts in zip(*collected))

    @torch.no_grad()
    def _segments(self, work: Workspace, collects: bool) -> list[tuple[Tensor, ...]]:
        """Launches all segments, one after each answer to the state at its start; the statistics of the answers."""
        work.flags.fill_(NO_EVENT)
        step, found = 0, []
        for length in self.lengths:
            slot = step % len(work.x)
            state = work.F[slot], work.C_affine[slot], work.held["parameters"]
            answer, statistics = self._ask(*state, collects)
            work.point(answer)
            with warp_stream(self.numerics.device):
                work.advance_steps(step, length)
            step += length
            found.append(statistics)
        return found

    def _adjoint(self, again: bool, penalised: bool) -> None:
        """again: the states are made again, else they are loaded."""
        work, step = self.full, self.substeps
        if again:
            self._segments(work, False)
        work.adj_held["parameters"].zero_()
        if self.adj_weights:
            torch._foreach_zero_(self.adj_weights)
        for index in reversed(range(len(self.lengths))):
            step -= self.lengths[index]
            leaves, answer, statistics = self._evaluate(step, penalised)
            work.point(answer)
            with warp_stream(self.numerics.device):
                work.adjoint_steps(step, self.lengths[index], more=True)
            pairs = [(answer[k], work.adj_held[k]) for k in ANSWER if answer[k] is not None]
            pairs += [(t, each[index]) for t, each in zip(statistics, self.statistics_seeds)]
            pairs = [(output, seed) for output, seed in pairs if output.requires_grad]
            if not pairs:
                continue
            outputs, seeds = zip(*pairs)
            # the first three leaves get theirs in place, see `_evaluate`
            found = torch.autograd.grad(outputs, leaves, seeds, allow_unused=True)[3:]
            pairs = zip(self.adj_weights, found, strict=True)
            sums = [(total, part) for total, part in pairs if part is not None]
            if sums:
                torch._foreach_add_(*zip(*sums))

    def follow(self, work: Workspace, learned: Learned) -> None:
        """Before passes in `work`, which is loaded. Forget captured graphs where what they have by value or address is another one.

        learned: of the adapter as it is now."""
        for each in (self.light, self.full):
            # this pass uses one, the other may have had those of an earlier one
            if each is not None:
                each.cutoff, each.steps = work.cutoff, work.steps
        self.learned = learned
        # not their sizes: buffers may come back to an earlier one
        buffers = tuple(
            each.allocations if each is not None else 0 for each in (self.light, self.full)
        )
        held, read = (buffers, work.cutoff), (*learned.tensors, *learned.weights)
        if held != self._held or not same_memory(self._read, read):
            # aliases, which belong to no graph
            self._held, self._read = (held, [t.detach() for t in read])
            self._graphs.drop()

    def play(self, steps: Steps, name: str, *arguments) -> None:
        """One of the passes, whose graphs have the times of their substeps by value."""
        self._graphs.play((steps, name, *arguments), self._pass(name, arguments))

    def capture(self, steps: Steps) -> None:
        """Capture every pass that has run once. Before the forward pass for both: the backward pass runs in a thread of autograd's
        own."""
        for key in self._graphs.waiting():
            if key[0] == steps and not self._graphs.capture(key, self._pass(key[1], key[2:])):
                torch.cuda.synchronize()
                return

    def _pass(self, name: str, arguments: Sequence) -> Callable[[], None]:
        return partial({"forward": self._forward, "adjoint": self._adjoint}[name], *arguments)


@dataclass
class ChainOfSegments(Stretch):
    """Segments with an adapter's evaluations between them. What acts: packed parameters, the adapter's weights. Its statistics are
    those of each evaluation, (K, ...).

    learned: of the adapter as it is now."""

    chain: Chain
    learned: Learned

    margin = 4
    foresees = True

    @property
    def cut(self) -> bool:
        # shorter chains need less than the widest window, which is larger than any may be
        return self.substeps > WIDENED and len(self.chain.lengths) > 1

    def full(self, differentiated: bool, kept: bool) -> bool:
        return differentiated  # a rollout with a backward pass has these buffers anyway

    def buffers(
        self, solver: SegmentSolver, pool: Pool, acting: Sequence[Tensor], full: bool
    ) -> tuple[Workspace, dict]:
        return self.chain.workspace(full), {"parameters": acting[0].detach()}

    def advance(self, work: Workspace) -> None:
        self.chain.follow(work, self.learned)
        self.chain.capture(work.steps)
        self.chain.play(work.steps, "forward", work.with_adjoint)

    def statistics(self, work: Workspace) -> Sequence[Tensor]:
        return self.chain.statistics[work.with_adjoint]

    def statistics_seeds(self) -> Sequence[Tensor]:
        chain = self.chain
        if not chain.statistics_seeds:
            chain.statistics_seeds = tuple(torch.zeros_like(t) for t in chain.statistics[True])
        return chain.statistics_seeds

    def adjoint(
        self, work: Workspace, acting: Sequence[Tensor], again: bool, penalised: bool
    ) -> None:
        weights, tensors = tuple(acting[1:]), tensors_of(self.chain.adapter)
        # another rollout may have gone forward since
        self.chain.follow(work, Learned(self.learned.names, weights, tensors))
        self.chain.play(work.steps, "adjoint", again, penalised)

    def adjoint_of(self, work: Workspace, acting: Sequence[Tensor]) -> list[Tensor | None]:
        return [work.adj_held["parameters"], *self.chain.adj_weights]


def advance_chain(
    lanes: Lanes, chain: Chain, learned: Learned, state: State, packed: Tensor, first: int, poses: tuple[Tensor, ...] = (),
    steps: Steps | None = None,
) -> tuple[State, tuple[Tensor, ...], list]:  # fmt: skip
    """(the state after the chain, reactions, statistics of each evaluation), differentiable in state, parameters, poses and the
    adapter's weights. Arguments: as `ChainOfSegments` and `advance_segment`. Errors: SimulationDiverged; LeftWindow."""
    steps = steps or Steps(lanes.numerics.dt, lanes.numerics.dt)
    stretch = ChainOfSegments(lanes, first, steps, chain.substeps, chain, learned)
    final, left = advance(stretch, state, (packed, *learned.weights, *poses))
    reactions = 2 if poses else 0
    return final, left[:reactions], chain.named(left[reactions:])
