"""What one simulator holds on its device from one rollout to the next."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mosa.physics.engine.workspace import Workspace


class Buffers:
    """Workspaces and chains, with the graphs that are captured on them: scratch only, nothing in them
    outlives a stretch of motion. They go when this object goes, and nothing else holds them.

    chains: those of `Chains`; ran: kinds of passes that have run; the first of its kind compiles and
    loads kernels, which threads must not do at once."""

    def __init__(self) -> None:
        self.ran: set[tuple] = set()
        self.chains: dict[tuple, Any] = {}
        self._pools: list[dict[tuple, Workspace]] = [{}]

    def take(self) -> dict[tuple, Workspace]:
        """Workspaces by shape, for one thread alone until it gives them back."""
        try:
            return self._pools.pop()
        except IndexError:  # more threads than ever before
            return {}

    def give_back(self, workspaces: dict[tuple, Workspace]) -> None:
        self._pools.append(workspaces)

    def __iter__(self) -> Iterator[Workspace]:
        """All workspaces, of the chains too."""
        for pool in self._pools:
            yield from pool.values()
        for chain in self.chains.values():
            yield from (work for work in (chain.light, chain.full) if work is not None)
