"""The segment as a stretch of motion: some substeps in which what an adapter answered is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.physics.adapters.interface import ANSWER
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.numerics import State, Steps
from mosa.physics.engine.operation import Stretch, advance
from mosa.physics.engine.solver import WIDENED, LeftWindow, SegmentSolver
from mosa.physics.engine.workspace import Workspace

HELD = ("parameters", *ANSWER)


@dataclass
class HeldSegment(Stretch):
    """Substeps in which the parameters and what an adapter answered are held. What acts: these (`HELD`)."""

    substeps: int

    margin = 2

    @property
    def cut(self) -> bool:
        return self.substeps > WIDENED

    @property
    def foresees(self) -> bool:
        # a few substeps that gravity takes out of the window are cheaper than nodes for it in every window
        return self.cut

    def buffers(
        self, solver: SegmentSolver, acting: Sequence[Tensor | None], full: bool
    ) -> tuple[Workspace, dict]:
        held = dict(zip(HELD, acting, strict=True))
        operator = [held[name] for name in ("G", "h") if held[name] is not None]
        # views of one row, as `expand` makes them, are read from there by all particles
        shared = bool(operator) and all(part.stride(0) == 0 for part in operator)
        return solver.workspace(
            self.substeps, bool(operator), held["plastic_G"] is not None, full, shared
        ), held

    def advance(self, work: Workspace, acting: Sequence[Tensor | None]) -> None:
        work.advance()

    def adjoint(
        self, work: Workspace, acting: Sequence[Tensor | None], again: bool, penalised: bool
    ) -> None:
        if again:
            work.advance()
        work.adjoint()

    def adjoint_of(self, work: Workspace, acting: Sequence[Tensor | None]) -> list[Tensor | None]:
        return [
            None if value is None else work.adj_held[name]
            for name, value in zip(HELD, acting, strict=True)
        ]


def advance_segment(
    lanes: Lanes,
    state: State,
    held: dict,
    substeps: int,
    first: int,
    poses: tuple[Tensor, ...] = (),
    steps: Steps | None = None,
) -> tuple[State, tuple[Tensor, ...]]:
    """(state after `substeps`, reactions), differentiable in state, everything in `held`, and poses.

    poses: of K colliders at the segment's S substeps, () where there are none; reactions: as a `Stretch` leaves them. steps: times
    of the substeps, the numerics' dt by default.
    """
    steps = steps or Steps(lanes.numerics.dt, lanes.numerics.dt)
    done, most, reactions = 0, substeps, []
    while done < substeps:
        piece = lanes.piece(state, substeps - done, most, steps.dt)
        others = (*(held[name] for name in HELD), *(part[done : done + piece] for part in poses))
        try:
            state, reaction = advance(HeldSegment(lanes, first + done, steps, piece), state, others)
        except LeftWindow:
            most = WIDENED
            continue
        reactions.append(reaction)
        done, steps = done + piece, Steps(steps.dt, steps.dt)
    return state, reactions[0] if len(reactions) == 1 else tuple(
        torch.cat(parts) for parts in zip(*reactions, strict=True)
    )
