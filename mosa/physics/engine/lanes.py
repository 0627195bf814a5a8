"""The worlds of one rollout, shared among solvers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from mosa.physics.engine.buffers import Buffers
from mosa.physics.engine.numerics import State
from mosa.physics.engine.solver import SegmentSolver
from mosa.system.threads import threaded


class Lanes:
    """The worlds of one rollout, shared among solvers in equal parts: one solver on a CUDA device, where all worlds go through the
    same launches, and one for each world on a CPU, where as many of them as there are cores advance at a time, each on a grid of
    its own.

    buffers: of the simulator, whose workspaces a solver uses while it runs."""

    def __init__(self, solvers: Sequence[SegmentSolver], buffers: Buffers) -> None:
        self.solvers, self.buffers = list(solvers), buffers
        self.numerics = self.solvers[0].numerics

    @property
    def worlds(self) -> int:
        return sum(solver.worlds for solver in self.solvers)

    @property
    def room(self) -> float:
        """[bytes] left, see `give`."""
        return sum(solver.room for solver in self.solvers)

    def give(self, room: float) -> None:
        """Memory [bytes] for the states of all substeps of all worlds."""
        for solver in self.solvers:
            solver.room = room / len(self.solvers)

    def piece(self, state: State, left: int, most: int, dt: float) -> int:
        """As `SegmentSolver.piece`, the fewest of any."""
        parts = self.split(state)
        each = zip(self.solvers, parts, strict=True)
        return min(solver.piece(part, left, most, dt) for solver, part in each)

    def split(self, tensors: Iterable[Tensor | None], dim: int = 0) -> list[tuple]:
        """The solvers' parts of tensors of all particles, or of all worlds' colliders."""
        count = len(self.solvers)
        if count == 1:
            return [tuple(tensors)]
        each = [(None,) * count if t is None else t.chunk(count, dim) for t in tensors]
        return list(zip(*each)) if each else [()] * count

    def join(self, parts: Sequence[Sequence[Tensor | None]], dim: int = 0) -> list[Tensor | None]:
        """The tensors of all from the solvers' parts."""
        if len(parts) == 1:
            return list(parts[0])
        return [
            None if each[0] is None else torch.cat(each, dim) for each in zip(*parts, strict=True)
        ]

    def each(self, kind: tuple, function: Callable, *arguments: Sequence) -> list:
        """function(solver, pool of workspaces, its arguments) of every solver, in their order."""

        def run(index: int):
            solver = self.solvers[index]
            pool = self.buffers.take()
            try:
                with torch.no_grad():  # which a thread knows nothing of
                    return function(solver, pool, *(argument[index] for argument in arguments))
            finally:
                self.buffers.give_back(pool)

        count = len(self.solvers)
        # in turns: while one captures a graph no other may touch the stream
        if count == 1 or self.solvers[0].volume.is_cuda:
            return [run(index) for index in range(count)]
        if kind in self.buffers.ran:
            return list(threaded(run, range(count)))
        first = run(0)
        self.buffers.ran.add(kind)
        return [first, *threaded(run, range(1, count))]
