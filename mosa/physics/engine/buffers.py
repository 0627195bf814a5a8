"""What one simulator holds on its device from one rollout to the next."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mosa.physics.engine.workspace import Workspace

Pool = dict[tuple, list[Workspace]]
"""Workspaces at rest, by shape."""


class Buffers:
    """Workspaces and chains, with the graphs that are captured on them: scratch only, nothing in them
    outlives a stretch of motion. They go when this object goes, and nothing else holds them but a
    stretch whose states stay in its workspace until its backward pass.

    chains: those of `Chains`; ran: kinds of passes that have run; the first of its kind compiles and
    loads kernels, which threads must not do at once."""

    def __init__(self) -> None:
        self.ran: set[tuple] = set()
        self.chains: dict[tuple, Any] = {}
        self._pools: list[Pool] = [{}]

    def take(self) -> Pool:
        """For one thread alone until it gives it back."""
        try:
            return self._pools.pop()
        except IndexError:  # more threads than ever before
            return {}

    def give_back(self, pool: Pool) -> None:
        self._pools.append(pool)

    def __iter__(self) -> Iterator[Workspace]:
        """All workspaces at rest, of the chains too."""
        for pool in self._pools:
            for idle in pool.values():
                yield from idle
        for chain in self.chains.values():
            yield from (work for work in (chain.light, chain.full) if work is not None)
