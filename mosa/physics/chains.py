"""Which chains a rollout is cut into, by the memory there is, and the chains of a simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mosa.physics.activations import at_hand
from mosa.physics.chain import Chain
from mosa.physics.memory import free_memory, room
from mosa.physics.mpm import substep_bytes, wants_gradient
from mosa.physics.workspace import Numerics

SEGMENT = 32
"""Most substeps of a chain: what the backward pass stores at once."""
WITHOUT_GRADIENT = 96
"""The same where no gradient is wanted."""
CHAIN_SHARE = 0.08
"""Of a GPU's free memory, for the starts of all chains and what the backward pass of one stores, where that holds graphs."""
MAX_CHAINS = 8


class Plan(NamedTuple):
    """Most substeps of a chain; kept: all states stay between the passes; graphs: if not, keep those of a chain's evaluations."""

    limit: int
    kept: bool
    graphs: bool = False


class Chains:
    """The chains of one simulator. ask: as `Chain`."""

    def __init__(self, numerics: Numerics, ask: Callable[..., dict[str, Tensor | None]]) -> None:
        self.numerics, self.ask = numerics, ask
        self.chains: dict[tuple, Chain] = {}
        self._probes: dict[tuple, tuple[nn.Module, bool, int]] = {}

    def plan(self, adapter: nn.Module, state: tuple[Tensor, ...], packed: Tensor, substeps: int, stride: int) -> Plan:
        """How to run a rollout of `substeps` substeps, by memory."""
        device = self.numerics.device
        if device.type != "cuda":
            return Plan(SEGMENT, kept=True)
        if not wants_gradient((*state, packed, *adapter.parameters())):
            return Plan(WITHOUT_GRADIENT, kept=False)
        each = substep_bytes(self.numerics, len(packed))
        if room(device, substeps * each) > 0:
            return Plan(SEGMENT, kept=True)
        start = sum(t.numel() * t.element_size() for t in state[: 5 if self.numerics.law.plastic else 4])
        graph = self._probe(adapter, state, packed)[2] // stride
        limit, needed = chain_length(substeps, start, each + graph)
        graphs = needed <= CHAIN_SHARE * free_memory(device)
        return Plan(limit if graphs else chain_length(substeps, start, each)[0], kept=False, graphs=graphs)

    def chain(
        self, adapter: nn.Module, lengths: tuple[int, ...], state: tuple[Tensor, ...], packed: Tensor, collects: bool,
        graphs: bool = False,
    ) -> Chain:  # fmt: skip
        learned = tuple(p.requires_grad for p in adapter.parameters())
        key = (id(adapter), len(packed), lengths, collects, graphs, learned)  # the chain holds the adapter: its id stays its own
        if key not in self.chains:
            if len(self.chains) >= MAX_CHAINS:
                self.chains.clear()
            self.chains[key] = Chain(
                self.numerics, adapter, self.ask, len(packed), lengths, collects=collects, graphs=graphs,
                plastic_adapted=self._probe(adapter, state, packed)[1],
            )  # fmt: skip
        return self.chains[key]

    def _probe(self, adapter: nn.Module, state: tuple[Tensor, ...], packed: Tensor) -> tuple[nn.Module, bool, int]:
        """(the adapter, whether it corrects the yield function, bytes that an evaluation's graph holds), from one evaluation."""
        device = self.numerics.device
        key = (id(adapter), len(packed))
        if key not in self._probes:
            if len(self._probes) >= MAX_CHAINS:
                self._probes.clear()
            with torch.enable_grad(), at_hand():
                leaves = [t.detach().requires_grad_() for t in (state[3], state[2], packed)]
                answer, held = self.ask(adapter, *leaves), 0
                if device.type == "cuda":  # the second one's: an adapter may hold its last graph, and frees it with the next
                    held = torch.cuda.memory_allocated(device)
                    second = self.ask(adapter, *leaves)
                    held = torch.cuda.memory_allocated(device) - held
                    del second
            self._probes[key] = adapter, answer["plastic_G"] is not None, held
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
