"""Which chains a rollout is cut into, by the memory there is, and the chains of a simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mosa.errors import SimulationDiverged
from mosa.physics.engine.adapter_chain import MARGIN, Chain, Learned, advance_chain, learned_of
from mosa.physics.engine.budget import free_memory, room, substep_bytes
from mosa.physics.engine.buffers import Buffers
from mosa.physics.engine.network_evaluation import at_hand
from mosa.physics.engine.numerics import Numerics, State
from mosa.physics.engine.operation import wants_gradient
from mosa.physics.engine.solver import LeftWindow, SegmentSolver
from mosa.physics.grid.window import MAX_NODES, SMALL, fallen, window_of

SEGMENT = 32
"""Most substeps of a chain: what the backward pass stores at once."""
WITHOUT_GRADIENT = 192
"""The same where no gradient is wanted: whole frames, several where they fit, as each chain costs a look at the host."""
CHAIN_SHARE = 0.08
"""Of a GPU's free memory, for the starts of all chains and what the backward pass of one stores, where that holds graphs."""
MAX_CHAINS = 8


class Plan(NamedTuple):
    """Most substeps of a chain; kept: all states stay between the passes; graphs: if not, keep those of a chain's evaluations;
    several: a chain may go over several frames, without a gradient."""

    limit: int
    kept: bool
    graphs: bool = False
    several: bool = False


class Chains:
    """The chains of one simulator, among its buffers. ask: as `Chain`."""

    def __init__(self, numerics: Numerics, ask: Callable[..., dict[str, Tensor | None]], buffers: Buffers) -> None:
        self.numerics, self.ask, self.chains = numerics, ask, buffers.chains
        self._probes: dict[tuple[nn.Module, int], tuple[bool, int]] = {}

    def plan(
        self, adapter: nn.Module, learned: Learned, state: State, packed: Tensor, substeps: int, stride: int
    ) -> Plan:
        """How to run a rollout of `substeps` substeps, by memory."""
        device = self.numerics.device
        if device.type != "cuda":
            return Plan(SEGMENT, kept=True)
        if not wants_gradient((*state, packed, *learned.weights)):
            return Plan(WITHOUT_GRADIENT, kept=False, several=True)
        each = substep_bytes(self.numerics, len(packed))
        if room(device, substeps * each) > 0:
            return Plan(SEGMENT, kept=True)
        start = sum(t.numel() * t.element_size() for t in state[: 5 if self.numerics.law.plastic else 4])
        graph = self._probe(adapter, state, packed)[1] // stride
        limit, needed = chain_length(substeps, start, each + graph)
        graphs = needed <= CHAIN_SHARE * free_memory(device)
        return Plan(limit if graphs else chain_length(substeps, start, each)[0], kept=False, graphs=graphs)

    def frames(
        self, solver: SegmentSolver, adapter: nn.Module, state: State, packed: Tensor, frames: int,
        lengths: Sequence[int], collect: Callable | None,
    ) -> Iterator[State]:  # fmt: skip
        """The states after each of `frames` frames, each of segments of `lengths` substeps. collect: as `Simulator.rollout`.

        Where a chain goes over several frames, they arrive together; if it fails, what can be had one by one still does, and a
        frame's chain that fails is cut. Errors: SimulationDiverged."""
        learned, substeps, done = learned_of(adapter), sum(lengths), 0
        plan = self.plan(adapter, learned, state, packed, frames * substeps, max(lengths))
        most = plan.limit // substeps if plan.several else 1

        def advanced(group: tuple[int, ...], first: int, marks: tuple[int, ...] = ()) -> list[State]:
            chain = self.chain(adapter, learned, group, state, packed, collect is not None, plan.graphs, marks)
            states, statistics = advance_chain(chain, solver, learned, state, packed, first, plan.kept)
            for each in statistics:
                collect(each)
            return states

        while done < frames:
            count, first = self._together(solver, state, min(most, frames - done), substeps), done * substeps
            if count > 1:
                try:
                    states = advanced(tuple(lengths) * count, first, tuple(len(lengths) * k for k in range(1, count)))
                except (LeftWindow, SimulationDiverged) as error:
                    most = count // 2 if isinstance(error, LeftWindow) else 1
                    continue
                yield from states
                state = states[-1]
            else:
                groups = grouped(lengths, plan.limit)
                while groups:
                    try:
                        state = advanced(groups[0], first)[-1]
                    except (LeftWindow, SimulationDiverged):
                        shorter = grouped(groups[0], SEGMENT)
                        if len(shorter) == 1:
                            raise
                        groups[:1] = shorter
                        continue
                    first += sum(groups.pop(0))
                yield state
            done += count

    def _together(self, solver: SegmentSolver, state: State, count: int, substeps: int) -> int:
        """How many frames, `count` at most, the next chain goes over: as many as keep its window not much larger than one frame's,
        and as there is room for the states of."""
        bounds, size = solver.bounds(state), sum(t.nbytes for t in state)
        if count <= 1 or not np.isfinite(bounds).all():
            return 1

        def nodes(count: int) -> int:
            time = count * substeps * self.numerics.dt
            reach = fallen(bounds, self.numerics.gravity, time)
            return int(window_of(reach, self.numerics.dx, time, MARGIN)[1].prod())

        # a state is in the graph and in the answer
        while count > 1 and (nodes(count) > min(nodes(1) + SMALL, MAX_NODES) or not room(self.numerics.device, 2 * count * size)):
            count //= 2
        return count

    def chain(
        self, adapter: nn.Module, learned: Learned, lengths: tuple[int, ...], state: State, packed: Tensor,
        collects: bool, graphs: bool = False, marks: tuple[int, ...] = (),
    ) -> Chain:  # fmt: skip
        key = (adapter, len(packed), lengths, marks, collects, graphs, learned.names)
        chain = self.chains.pop(key, None)
        if chain is None:
            while len(self.chains) >= MAX_CHAINS:
                self.chains.pop(next(iter(self.chains)))
            chain = Chain(
                self.numerics, adapter, self.ask, len(packed), lengths, marks=marks, collects=collects, graphs=graphs,
                plastic_adapted=self._probe(adapter, state, packed)[0],
            )  # fmt: skip
        self.chains[key] = chain  # last: the first is the one that was not used for longest
        return chain

    def _probe(self, adapter: nn.Module, state: State, packed: Tensor) -> tuple[bool, int]:
        """(whether the adapter corrects the yield function, bytes that an evaluation's graph holds), from one evaluation."""
        device = self.numerics.device
        key = (adapter, len(packed))
        if key not in self._probes:
            if len(self._probes) >= MAX_CHAINS:
                self._probes.clear()
            with torch.enable_grad(), at_hand():
                leaves = [t.detach().requires_grad_() for t in (state.F, state.C_affine, packed)]
                answer, held = self.ask(adapter, *leaves), 0
                if device.type == "cuda":  # the second one's: an adapter may hold its last graph, and frees it with the next
                    held = torch.cuda.memory_allocated(device)
                    second = self.ask(adapter, *leaves)
                    held = torch.cuda.memory_allocated(device) - held
                    del second
            self._probes[key] = answer["plastic_G"] is not None, held
        return self._probes[key]


def chain_length(substeps: int, start: int, each: int) -> tuple[int, float]:
    """(substeps of a chain, at most SEGMENT, with which a rollout takes least memory; the bytes that it takes then). start: bytes
    kept of every chain; each: of every substep of the one whose adjoint runs."""
    length = max(1, min(SEGMENT, round(math.sqrt(substeps * start / each))))
    return length, math.ceil(substeps / length) * start + length * each


def grouped(lengths: Sequence[int], limit: int) -> list[tuple[int, ...]]:
    """The segments of a frame in chains of at most `limit` substeps, nearly equally many segments each."""
    per_chain = max(1, limit // max(lengths))
    chains = -(-len(lengths) // per_chain)
    size, longer = divmod(len(lengths), chains)
    sizes = [size + (index < longer) for index in range(chains)]
    ends = [0, *accumulate(sizes)]
    return [tuple(lengths[a:b]) for a, b in pairwise(ends)]
