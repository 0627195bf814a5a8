"""Which chains a motion is cut into, by the memory there is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from mosa.errors import SimulationDiverged
from mosa.physics.adapters.chain import Chain, Learned, advance_chain
from mosa.physics.engine.budget import substep_bytes
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.numerics import Numerics, State, Steps
from mosa.physics.engine.solver import LeftWindow

SEGMENT = 32
"""Most substeps of a chain: what the backward pass stores at once."""
WITHOUT_GRADIENT = 192
"""The same where no gradient is wanted: whole frames."""
MAX_CHAINS = 8


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

    def limit(self, state: State, substeps: int, wanted: bool) -> int:
        """Most substeps of a chain in a motion of `substeps` from `state`. wanted: whether a gradient is."""
        if self.numerics.device.type != "cuda" or (wanted and self.lanes.room):
            return SEGMENT
        if not wanted:
            return WITHOUT_GRADIENT
        start = sum(t.nbytes for t in state[: 5 if self.numerics.law.plastic else 4])
        return chain_length(substeps, start, substep_bytes(self.numerics, len(self.packed)))

    def frame(
        self, state: State, lengths: Sequence[int], first: int, poses: tuple[Tensor, ...], steps: Steps | None, limit: int,
        learned: Learned,
    ) -> tuple[State, Tensor | None, list]:  # fmt: skip
        """(as `Prepared.frame`, statistics of the evaluations). A chain that fails is cut. limit: as above; learned: of the
        adapter as it is now."""
        groups, done, forces, collected = grouped(lengths, limit), 0, [], []
        while groups:
            count = sum(groups[0])
            along = tuple(part[done : done + count] for part in poses)
            try:
                chain = self.chain(groups[0], state, learned)
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

    def chain(self, lengths: tuple[int, ...], state: State, learned: Learned) -> Chain:
        chains, n, worlds = self.lanes.buffers.chains, len(self.packed), self.lanes.worlds
        key = (self.adapter, n, worlds, lengths, self.collects, learned.names)
        chain = chains.pop(key, None)
        if chain is None:
            while len(chains) >= MAX_CHAINS:
                chains.pop(next(iter(chains)))
            with torch.no_grad():  # whether the adapter corrects the yield function
                answer = self.ask(self.adapter, state.F, state.C_affine, self.packed)
            chain = Chain(
                self.numerics, self.adapter, self.ask, n, worlds, lengths, learned=learned, collects=self.collects,
                plastic_adapted=answer["plastic_G"] is not None,
            )  # fmt: skip
        chains[key] = chain  # last: the first is the one that was not used for longest
        return chain


def chain_length(substeps: int, start: int, each: int) -> int:
    """Substeps of a chain, at most SEGMENT, with which a rollout takes least memory. start: bytes kept of every chain; each: of
    every substep of the one whose adjoint runs."""
    return max(1, min(SEGMENT, round(math.sqrt(substeps * start / each))))


def grouped(lengths: Sequence[int], limit: int) -> list[tuple[int, ...]]:
    """The segments of a frame in chains of at most `limit` substeps, nearly equally many segments each."""
    per_chain = max(1, limit // max(lengths))
    chains = -(-len(lengths) // per_chain)
    size, longer = divmod(len(lengths), chains)
    sizes = [size + (index < longer) for index in range(chains)]
    ends = [0, *accumulate(sizes)]
    return [tuple(lengths[a:b]) for a, b in pairwise(ends)]
