"""Which chains a motion is cut into, by the memory there is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mosa.errors import SimulationDiverged
from mosa.physics.adapters.chain import Chain, Learned, advance_chain
from mosa.physics.adapters.network_evaluation import at_hand
from mosa.physics.engine.budget import free_memory, substep_bytes
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.numerics import Numerics, State, Steps
from mosa.physics.engine.solver import LeftWindow

SEGMENT = 32
"""Most substeps of a chain: what the backward pass stores at once."""
WITHOUT_GRADIENT = 192
"""The same where no gradient is wanted: whole frames."""
CHAIN_SHARE = 0.08
"""Of a GPU's free memory, for the starts of all chains and what the backward pass of one stores, where that holds graphs."""
MAX_CHAINS = 8


class Plan(NamedTuple):
    """Most substeps of a chain; graphs: where its states are made again, keep the graphs of its evaluations."""

    limit: int
    graphs: bool = False


@dataclass
class Chains:
    """What asks an adapter inside of the stretches of one motion. The chains are its simulator's, among the buffers.

    ask, collects: as `Chain`."""

    lanes: Lanes
    adapter: nn.Module
    ask: Callable[..., dict[str, Tensor | None]]
    packed: Tensor
    collects: bool

    @property
    def numerics(self) -> Numerics:
        return self.lanes.numerics

    def plan(self, state: State, substeps: int, stride: int, wanted: bool) -> Plan:
        """How to run a motion of `substeps` substeps from `state`, by memory. wanted: whether a
        gradient is."""
        device = self.numerics.device
        if device.type != "cuda":
            return Plan(SEGMENT)
        if not wanted:
            return Plan(WITHOUT_GRADIENT)
        if self.lanes.room:
            return Plan(SEGMENT)
        each = substep_bytes(self.numerics, len(self.packed))
        start = sum(t.nbytes for t in state[: 5 if self.numerics.law.plastic else 4])
        graph = self._probe(state)[1] // stride
        limit, needed = chain_length(substeps, start, each + graph)
        graphs = needed <= CHAIN_SHARE * free_memory(device)
        return Plan(limit if graphs else chain_length(substeps, start, each)[0], graphs)

    def frame(
        self, state: State, lengths: Sequence[int], first: int, poses: tuple[Tensor, ...], steps: Steps | None, plan: Plan,
        learned: Learned,
    ) -> tuple[State, Tensor | None, list]:  # fmt: skip
        """(as `Prepared.frame`, statistics of the evaluations). A chain that fails is cut. learned:
        of the adapter as it is now."""
        groups, done, forces, collected = grouped(lengths, plan.limit), 0, [], []
        while groups:
            count = sum(groups[0])
            along = tuple(part[done : done + count] for part in poses)
            try:
                chain = self.chain(groups[0], state, plan.graphs, learned)
                state, reaction, statistics = advance_chain(
                    self.lanes, chain, learned, state, self.packed, first + done, along, steps
                )
            except (LeftWindow, SimulationDiverged):
                shorter = grouped(groups[0], SEGMENT)
                if len(shorter) == 1:
                    raise
                groups[:1] = shorter
                continue
            collected += statistics
            forces += [torch.cat(reaction, -1)] if reaction else []
            steps = None if steps is None else Steps(steps.dt, steps.dt)
            done += count
            del groups[0]
        return state, torch.cat(forces) if forces else None, collected

    def chain(
        self, lengths: tuple[int, ...], state: State, graphs: bool, learned: Learned
    ) -> Chain:
        chains, n, worlds = self.lanes.buffers.chains, len(self.packed), self.lanes.worlds
        key = (self.adapter, n, worlds, lengths, self.collects, graphs, learned.names)
        chain = chains.pop(key, None)
        if chain is None:
            while len(chains) >= MAX_CHAINS:
                chains.pop(next(iter(chains)))
            chain = Chain(
                self.numerics, self.adapter, self.ask, n, worlds, lengths, learned=learned, collects=self.collects,
                graphs=graphs, plastic_adapted=self._probe(state)[0],
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
                leaves = [
                    t.detach().requires_grad_() for t in (state.F, state.C_affine, self.packed)
                ]
                answer, held = self.ask(self.adapter, *leaves), 0
                # the second one's: an adapter may hold its last graph, and frees it with the next
                if device.type == "cuda":
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
