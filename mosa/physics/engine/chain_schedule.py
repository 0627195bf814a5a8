"""Which chains a motion is cut into, by the memory there is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mosa.errors import SimulationDiverged
from mosa.physics.engine.adapter_chain import Chain, ChainOfSegments, advance_chain, learned_of
from mosa.physics.engine.budget import free_memory, room, substep_bytes
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.network_evaluation import at_hand
from mosa.physics.engine.numerics import State, Steps
from mosa.physics.engine.solver import LeftWindow
from mosa.physics.grid.window import MAX_NODES, SMALL, fallen, window_of

SEGMENT = 32
"""Most substeps of a chain: what the backward pass stores at once."""
WITHOUT_GRADIENT = 192
"""The same where no gradient is wanted: whole frames, several where they fit, as each chain costs a look at the host."""
CHAIN_SHARE = 0.08
"""Of a GPU's free memory, for the starts of all chains and what the backward pass of one stores, where that holds graphs."""
MAX_CHAINS = 8


class Plan(NamedTuple):
    """Most substeps of a chain; graphs: where its states are made again, keep the graphs of its evaluations; several: a chain may
    go over several frames, without a gradient."""

    limit: int
    graphs: bool = False
    several: bool = False


class Chains:
    """What asks an adapter inside of the stretches of one motion. The chains are its simulator's, among the buffers.

    ask: as `Chain`; collect: as `Simulator.rollout`."""

    def __init__(
        self, lanes: Lanes, adapter: nn.Module, ask: Callable[..., dict[str, Tensor | None]], packed: Tensor,
        collect: Callable[[Any], None] | None,
    ) -> None:  # fmt: skip
        self.lanes, self.adapter, self.ask, self.packed, self.collect = lanes, adapter, ask, packed, collect
        self.numerics, self._ahead = lanes.numerics, []

    def look(self) -> tuple[Tensor, ...]:
        """The adapter's weights that are learned, as they are from now on."""
        self.learned = learned_of(self.adapter)
        return self.learned.weights

    def begin(self, state: State, substeps: int, stride: int, wanted: bool) -> None:
        """Before a motion of `substeps` substeps from `state`, after `look`. wanted: whether a gradient is."""
        self._plan = self.plan(state, substeps, stride, wanted)
        self._most = self._plan.limit if self._plan.several else 1

    def plan(self, state: State, substeps: int, stride: int, wanted: bool) -> Plan:
        """How to run a motion, by memory."""
        device = self.numerics.device
        if device.type != "cuda":
            return Plan(SEGMENT)
        if not wanted:
            return Plan(WITHOUT_GRADIENT, several=True)
        if self.lanes.room:
            return Plan(SEGMENT)
        each = substep_bytes(self.numerics, len(self.packed))
        start = sum(t.nbytes for t in state[: 5 if self.numerics.law.plastic else 4])
        graph = self._probe(state)[1] // stride
        limit, needed = chain_length(substeps, start, each + graph)
        graphs = needed <= CHAIN_SHARE * free_memory(device)
        return Plan(limit if graphs else chain_length(substeps, start, each)[0], graphs)

    def frame(
        self, state: State, lengths: Sequence[int], first: int, poses: tuple[Tensor, ...], steps: Steps | None, alike: int
    ) -> tuple[State, Tensor | None]:
        """As `Prepared.frame`. Where a chain goes over several frames, the others are at hand when they are asked for; if it fails,
        what can be had one by one still is, and a frame's chain that fails is cut."""
        while not self._ahead:
            count = self._together(state, min(self._most, 1 + alike), sum(lengths))
            if count == 1:
                return self._one(state, lengths, first, poses, steps)
            try:
                marks = tuple(len(lengths) * k for k in range(1, count))
                self._ahead, _ = self._advanced(tuple(lengths) * count, state, first, (), steps, marks)
            except (LeftWindow, SimulationDiverged) as error:
                self._most = count // 2 if isinstance(error, LeftWindow) else 1
        return self._ahead.pop(0), None

    def _one(
        self, state: State, lengths: Sequence[int], first: int, poses: tuple[Tensor, ...], steps: Steps | None
    ) -> tuple[State, Tensor | None]:
        groups, done, forces = grouped(lengths, self._plan.limit), 0, []
        while groups:
            count = sum(groups[0])
            along = tuple(part[done : done + count] for part in poses)
            try:
                (state,), reaction = self._advanced(groups[0], state, first + done, along, steps)
            except (LeftWindow, SimulationDiverged):
                shorter = grouped(groups[0], SEGMENT)
                if len(shorter) == 1:
                    raise
                groups[:1] = shorter
                continue
            forces += [torch.cat(reaction, -1)] if reaction else []
            steps = None if steps is None else Steps(steps.dt, steps.dt)
            done += count
            del groups[0]
        return state, torch.cat(forces) if forces else None

    def _advanced(
        self, group: tuple[int, ...], state: State, first: int, poses: tuple[Tensor, ...], steps: Steps | None,
        marks: tuple[int, ...] = (),
    ) -> tuple[list[State], tuple[Tensor, ...]]:  # fmt: skip
        chain = self.chain(group, state, marks)
        states, reaction, statistics = advance_chain(self.lanes, chain, self.learned, state, self.packed, first, poses, steps)
        for each in statistics:
            self.collect(each)
        return states, reaction

    def _together(self, state: State, count: int, substeps: int) -> int:
        """How many frames, `count` at most, the next chain goes over: as many as the plan allows, as keep its window not much
        larger than one frame's, and as there is room for the states of."""
        count = min(count, max(1, self._plan.limit // substeps))
        if count == 1:
            return 1
        (solver,), size = self.lanes.solvers, sum(t.nbytes for t in state)
        bounds = solver.bounds(state)
        if not np.isfinite(bounds).all():
            return 1

        def nodes(count: int) -> int:
            time = count * substeps * self.numerics.dt
            reach = fallen(bounds, solver.gravities, time)
            return int(window_of(reach, self.numerics.dx, time, ChainOfSegments.margin)[1].prod(-1).sum())

        # a state is in the graph and in the answer
        while count > 1 and (nodes(count) > min(nodes(1) + SMALL, MAX_NODES) or not room(self.numerics.device, 2 * count * size)):
            count //= 2
        return count

    def chain(self, lengths: tuple[int, ...], state: State, marks: tuple[int, ...] = ()) -> Chain:
        chains, n, worlds, collects = self.lanes.buffers.chains, len(self.packed), self.lanes.worlds, self.collect is not None
        key = (self.adapter, n, worlds, lengths, marks, collects, self._plan.graphs, self.learned.names)
        chain = chains.pop(key, None)
        if chain is None:
            while len(chains) >= MAX_CHAINS:
                chains.pop(next(iter(chains)))
            chain = Chain(
                self.numerics, self.adapter, self.ask, n, worlds, lengths, learned=self.learned, marks=marks, collects=collects,
                graphs=self._plan.graphs, plastic_adapted=self._probe(state)[0],
            )  # fmt: skip
        chains[key] = chain  # last: the first is the one that was not used for longest
        return chain

    def _probe(self, state: State) -> tuple[bool, int]:
        """(whether the adapter corrects the yield function, bytes that an evaluation's graph holds), from one evaluation."""
        device, probes = self.numerics.device, self.lanes.buffers.probes
        key = (self.adapter, len(self.packed))
        if key not in probes:
            if len(probes) >= MAX_CHAINS:
                probes.clear()
            with torch.enable_grad(), at_hand():
                leaves = [t.detach().requires_grad_() for t in (state.F, state.C_affine, self.packed)]
                answer, held = self.ask(self.adapter, *leaves), 0
                if device.type == "cuda":  # the second one's: an adapter may hold its last graph, and frees it with the next
                    held = torch.cuda.memory_allocated(device)
                    second = self.ask(self.adapter, *leaves)
                    held = torch.cuda.memory_allocated(device) - held
                    del second
            probes[key] = answer["plastic_G"] is not None, held
        return probes[key]


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
