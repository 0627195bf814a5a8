"""Segments with an adapter's evaluations between them, as one torch operation and, on CUDA, one captured graph per pass.

An adapter of the state is asked every few substeps. Done one by one, each answer costs some sixty launches and two transfers to
the host, which take longer than the arithmetic of 100 000 particles. A chain of K segments looks at the host once. Its backward
pass goes back through the states of all substeps: the adapter is asked again at the start of a segment, this time with a graph,
and what the segment's adjoint leaves on its answer goes through that graph to the state and to the adapter's weights. Between the
passes all states are kept where there is memory for them (`kept`), else only the chain's start, from which they are made again.
That asks the adapter too: where there is memory for the graphs of all the chain's evaluations (`graphs`), they are kept beside the
states and nothing is asked a third time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from mosa.physics.engine.adapter_interface import ANSWER
from mosa.physics.engine.capture import ATTEMPTS, Graphs, TorchCapture
from mosa.physics.engine.network_evaluation import at_hand, same_weights
from mosa.physics.engine.numerics import Numerics, State
from mosa.physics.engine.operation import Kept, Stretch, advance
from mosa.physics.engine.solver import WIDENED, SegmentSolver
from mosa.physics.engine.workspace import Workspace
from mosa.physics.grid.transfer_kernels import NO_EVENT
from mosa.physics.launching import copies, same_memory, warp_stream

MARGIN = 4
"""Nodes of a window beyond what the speeds at the start ask for."""


class _Evaluation(NamedTuple):
    """leaves: F, C, parameters and weights as the graph's ends, [] without a graph."""

    leaves: list[Tensor]
    answer: dict[str, Tensor | None]
    statistics: tuple[Tensor, ...]


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
    """Buffers and captured graphs of K segments of `lengths` substeps for N particles and one adapter.

    marks: numbers of segments after which the state is wanted too, besides the last; only without a gradient.
    ask: (adapter, F, C_affine, packed parameters, into=None) -> its answer by name (`ANSWER`, None where it has none),
    differentiable; into: as `material_state`.
    collects: also return `adapter.statistics()`, a named tuple of tensors, of every evaluation.
    graphs: where states are made again, keep the graphs of the evaluations with them.
    An adapter that looks at the host cannot be captured: it is run uncaptured, with a warning.
    """

    def __init__(
        self, numerics: Numerics, adapter: nn.Module, ask: Callable[..., dict[str, Tensor | None]], particles: int,
        lengths: Sequence[int], *, marks: Sequence[int] = (), plastic_adapted: bool, collects: bool, graphs: bool = False,
    ) -> None:  # fmt: skip
        self.numerics, self.adapter, self.ask, self.lengths, self.collects = numerics, adapter, ask, tuple(lengths), collects
        self.marks, self.marked = frozenset(marks), []
        self.substeps = sum(lengths)
        self.learned = learned_of(adapter)
        self._shape = {"particles": particles, "substeps": self.substeps, "adapted": True, "plastic_adapted": plastic_adapted}
        self.light: Workspace | None = None
        self.full: Workspace | None = None
        self.statistics: dict[bool, tuple[Tensor, ...]] = {}  # in light and in full buffers: each graph has its own
        self.statistics_seeds: tuple[Tensor, ...] = ()
        self._kind: type | None = None
        failing = f"{type(adapter).__name__} cannot be captured as a CUDA graph and runs uncaptured"
        self._graphs = Graphs(TorchCapture(), failing, ATTEMPTS if numerics.device.type == "cuda" else 0)
        self._held: tuple = ()  # what graphs have by value,
        self._read: Sequence[Tensor] = ()  # and by address
        self._passes: dict[tuple, Callable[[Chain], None]] = {}  # no methods: see `Simulator`
        self.again = "graphs" if graphs else "states"
        for full in (False, True):
            self._passes["forward", full] = partial(Chain._forward, full=full)
        for source in ("tape", self.again):
            for penalised in (False, True):
                self._passes["adjoint", source, penalised] = partial(Chain._adjoint, source=source, penalised=penalised)

    @torch.no_grad()
    def advance(
        self, solver: SegmentSolver, learned: Learned, state: State, packed: Tensor, first: int, kept: bool = False,
        full: bool = False,
    ) -> tuple[list[State], tuple[Tensor, ...], tuple[tuple, tuple], list[Tensor]]:  # fmt: skip
        """(states at the marks and after the chain, statistics (K, ...) each, grid window used, what `adjoint` takes as `tape`).

        learned: of the adapter as it is now; kept: leave all substeps on the tape, else nothing; full: in the buffers of the
        backward pass, which kept needs and any rollout with one has anyway. Errors: as `SegmentSolver.advance`; LeftWindow of
        chains that can be cut, with marks or of more than `WIDENED` substeps in several segments."""
        dt, total = self.numerics.dt, self.substeps

        def run(window: tuple) -> Workspace:
            work = self._full() if full else self._light()
            self._load(work, window, solver, learned, state, packed)
            self._capture()
            self._play(("forward", full))
            return work

        # shorter chains need less than the widest window, which is larger than any may be
        cut = bool(self.marks) or (total > WIDENED and len(self.lengths) > 1)
        margins = (MARGIN,) if cut else (MARGIN, 3 + total // 2)
        work, final, window = solver.within(run, state, total * dt, margins, True, first, dt)
        states = [*(State.whole(copies(state)) for state in self.marked), final]
        return states, tuple(copies(self.statistics[full])), window, work.tape() if kept else []

    def adjoint(
        self, solver: SegmentSolver, learned: Learned, state: State, packed: Tensor, window: tuple,
        seeds: Sequence[Tensor | None], tape: Sequence[Tensor],
    ) -> tuple[list[Tensor], Tensor, list[Tensor]]:  # fmt: skip
        """Gradients of (state, parameters, weights). learned: with the names and weights of `advance`; seeds: adjoints of what it
        returned: state, then statistics."""
        work = self._full()
        if not self.statistics_seeds:
            self.statistics_seeds = tuple(torch.zeros_like(t) for t in self.statistics[True])
        self._load(work, window, solver, learned, state, packed)  # another rollout may have gone forward since
        if tape:
            work.rewind(tape)
        slots, slot = work.adjoint_slots(), self.substeps % 2
        states = len(slots)
        for target, seed in zip([*(t[slot] for t in slots), *self.statistics_seeds], seeds, strict=True):
            target.zero_() if seed is None else target.copy_(seed)
        penalised = any(seed is not None for seed in seeds[states:])
        self._play(("adjoint", "tape" if tape else self.again, penalised))
        found = copies([*(t[0] for t in slots), work.adj_held["parameters"], *self.adj_weights])
        return found[:states], found[states], found[states + 1 :]

    def named(self, statistics: Sequence[Tensor]) -> list:
        """One named tuple per evaluation, of tensors (K, ...)."""
        return [self._kind(*parts) for parts in zip(*statistics, strict=True)] if self._kind is not None else []

    def _light(self) -> Workspace:
        if self.light is None:
            self.light = Workspace(self.numerics, **self._shape, with_adjoint=False, pointed=True)
        return self.light

    def _full(self) -> Workspace:
        """The buffers of the backward pass, made when they are first needed."""
        if self.full is None:
            self.full = Workspace(self.numerics, **self._shape, with_adjoint=True, pointed=True)
            self.adj_weights = [torch.zeros_like(w) for w in self.learned.weights]
        return self.full

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

    def _evaluate(self, step: int, collects: bool) -> _Evaluation:
        """The adapter's answer to the state in slot `step`; its graph adds the state's gradient to the segment's adjoint."""
        work, slot = self.full, step % 2
        into = (work.adj_F[slot], work.adj_C_affine[slot], work.adj_held["parameters"])
        with torch.enable_grad(), at_hand():
            inputs = (work.F[step], work.C_affine[step], work.held["parameters"], *self.learned.weights)
            # aliases: autograd ties a leaf to the stream it was first used on, which a capture on another one may not touch
            leaves = [t.detach().requires_grad_() for t in inputs]
            return _Evaluation(leaves, *self._ask(*leaves[:3], collects, leaves[3:], into))

    @torch.no_grad()
    def _answer(self, work: Workspace, collects: bool, step: int) -> _Evaluation:
        """The same without a graph, in either workspace."""
        slot = step % len(work.x)
        return _Evaluation([], *self._ask(work.F[slot], work.C_affine[slot], work.held["parameters"], collects))

    @same_weights()
    def _forward(self, full: bool) -> None:
        work, collected, marked = self._full() if full else self._light(), [], []
        for count, evaluation in enumerate(self._segments(work, partial(self._answer, work, self.collects)), 1):
            collected.append(evaluation.statistics)
            if count in self.marks:
                marked.append(work.state(sum(self.lengths[:count])))
        self.statistics[full] = tuple(torch.stack(parts) for parts in zip(*collected))
        self.marked = marked

    def _segments(self, work: Workspace, evaluate: Callable[[int], _Evaluation]) -> Iterator[_Evaluation]:
        """Launches all segments, one after each answer of `evaluate` to the state at its start, and passes the answers on."""
        work.flags.fill_(NO_EVENT)
        step = 0
        for length in self.lengths:
            evaluation = evaluate(step)
            work.point(evaluation.answer)
            with warp_stream(self.numerics.device):
                work.advance_steps(step, length)
            step += length
            yield evaluation

    @same_weights()
    def _adjoint(self, source: str, penalised: bool) -> None:
        """source: of the states, tape | states | graphs: loaded, or made again, without or with the evaluations' graphs."""
        work, step, made = self.full, self.substeps, []
        if source == "graphs":
            made = list(self._segments(work, partial(self._evaluate, collects=penalised)))
        elif source == "states":
            for _ in self._segments(work, partial(self._answer, work, False)):
                pass
        work.adj_held["parameters"].zero_()
        if self.adj_weights:
            torch._foreach_zero_(self.adj_weights)
        for index in reversed(range(len(self.lengths))):
            step -= self.lengths[index]
            leaves, answer, statistics = made.pop() if made else self._evaluate(step, penalised)
            work.point(answer)
            with warp_stream(self.numerics.device):
                work.adjoint_steps(step, self.lengths[index], more=True)
            pairs = [(answer[name], work.adj_held[name]) for name in ANSWER if answer[name] is not None]
            pairs += [(t, all_seeds[index]) for t, all_seeds in zip(statistics, self.statistics_seeds)]
            pairs = [(output, seed) for output, seed in pairs if output.requires_grad]
            if not pairs:
                continue
            outputs, seeds = zip(*pairs)
            # the first three leaves get theirs in place, see `_evaluate`
            found = torch.autograd.grad(outputs, leaves, seeds, allow_unused=True)[3:]
            sums = [(total, part) for total, part in zip(self.adj_weights, found, strict=True) if part is not None]
            if sums:
                torch._foreach_add_(*zip(*sums))

    def _load(
        self, work: Workspace, window: tuple, solver: SegmentSolver, learned: Learned, state: State,
        packed: Tensor,
    ) -> None:  # fmt: skip
        """Place the chain's start in `work`. Forget captured graphs where what they have by value or address is another one."""
        work.set_window(*window)
        for each in (self.light, self.full):
            if each is not None:  # this rollout uses one, the other may have had the cutoff of an earlier one
                each.cutoff = solver.cutoff
        work.load(state, {"parameters": packed}, solver.volume, solver.mass, solver.cutoff)
        self.learned = learned
        # not their sizes: buffers may come back to an earlier one
        buffers = tuple(each.allocations if each is not None else 0 for each in (self.light, self.full))
        held, read = (buffers, solver.cutoff), (*learned.tensors, *learned.weights)
        if held != self._held or not same_memory(self._read, read):
            self._held, self._read, self.marked = held, [t.detach() for t in read], []  # aliases, which belong to no graph
            self._graphs.drop()

    def _play(self, name: tuple) -> None:
        self._graphs.play(name, partial(self._passes[name], self))

    def _capture(self) -> None:
        """Capture every pass that has run once. Here for both: the backward pass runs in a thread of autograd's own."""
        for name in filter(self._graphs.waits, self._passes):
            if not self._graphs.capture(name, partial(self._passes[name], self)):
                torch.cuda.synchronize()
                return


@dataclass
class ChainOfSegments(Stretch):
    """Segments with an adapter's evaluations between them. others: packed parameters, the adapter's weights. It leaves the
    statistics of each evaluation.

    learned: of the adapter as it is now; first: number of the first substep, for messages; kept: keep the states of all substeps
    for the backward pass."""

    chain: Chain
    solver: SegmentSolver
    learned: Learned
    first: int
    kept: bool

    @property
    def plastic(self) -> bool:
        return self.solver.numerics.law.plastic

    def forward(self, state: State, others: Sequence[Tensor], differentiated: bool) -> tuple[State, Sequence[Tensor], Kept]:
        packed, kept = others[0].detach(), differentiated and self.kept
        (final,), statistics, window, tape = self.chain.advance(
            self.solver, self.learned, state, packed, self.first, kept, full=differentiated
        )
        return final, statistics, Kept(window, tape)

    def backward(
        self, state: State, others: Sequence[Tensor], kept: Kept, seeds: Sequence[Tensor | None],
        other_seeds: Sequence[Tensor | None],
    ) -> tuple[list[Tensor], list[Tensor]]:  # fmt: skip
        packed, *weights = others
        learned = Learned(self.learned.names, tuple(weights), tensors_of(self.chain.adapter))
        found, adj_packed, adj_weights = self.chain.adjoint(
            self.solver, learned, state, packed, kept.windows, (*seeds, *other_seeds), kept.take()
        )
        return found, [adj_packed, *adj_weights]


def advance_chain(
    chain: Chain, solver: SegmentSolver, learned: Learned, state: State, packed: Tensor, first: int, kept: bool = False
) -> tuple[list[State], list]:
    """([the states at the chain's marks and after it], statistics of each evaluation), differentiable in state, parameters and the
    adapter's weights, where there are no marks. Arguments: as `ChainOfSegments`. Errors: SimulationDiverged; LeftWindow."""
    if chain.marks:
        state = State(*(t.detach().contiguous() for t in state))
        states, statistics, *_ = chain.advance(solver, learned, state, packed.detach(), first)
        return states, chain.named(statistics)
    stretch = ChainOfSegments(chain, solver, learned, first, kept)
    final, statistics = advance(stretch, state, (packed, *learned.weights))
    return [final], chain.named(statistics)
