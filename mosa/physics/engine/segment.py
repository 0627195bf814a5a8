"""The segment as a stretch of motion: some substeps in which what an adapter answered is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.physics.engine.adapter_interface import ANSWER
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.numerics import State, Steps
from mosa.physics.engine.operation import Kept, Stretch, advance
from mosa.physics.engine.solver import WIDENED, LeftWindow, SegmentSolver
from mosa.physics.launching import copies

HELD = ("parameters", *ANSWER)


@dataclass
class HeldSegment(Stretch):
    """Substeps in which the parameters and what an adapter answered are held. others: these (`HELD`), then, where there are
    colliders, their poses at the substeps. It leaves the colliders' reactions.

    first: number of its first substep, for messages."""

    lanes: Lanes
    substeps: int
    first: int
    steps: Steps

    @property
    def plastic(self) -> bool:
        return self.lanes.numerics.law.plastic

    def _parts(self, state: State, others: Sequence[Tensor | None]) -> tuple[list, list, list]:
        """(states, held, poses) of each solver."""
        split, held, poses = self.lanes.split, others[: len(HELD)], others[len(HELD) :]
        each = [dict(zip(HELD, part, strict=True)) for part in split(held)]
        return [State(*part) for part in split(state)], each, split(poses, 1)

    def forward(self, state: State, others: Sequence[Tensor | None], differentiated: bool) -> tuple[State, list, list[Kept]]:
        def run(solver: SegmentSolver, state: State, held: dict, poses: tuple):
            kept = differentiated and solver.has_room(self.substeps)
            final, reaction, windows, tape = solver.advance(
                state, held, poses or None, self.substeps, self.first, self.steps, kept
            )
            return final, reaction, Kept(windows, solver.budget.keep(tape))

        finals, reactions, kept = zip(*self.lanes.each(_kind("advance", others), run, *self._parts(state, others)))
        states = [final if self.plastic else final[:-1] for final in finals]
        return State.whole(self.lanes.join(states)), self.lanes.join(reactions, 1), kept

    def backward(
        self, state: State, others: Sequence[Tensor | None], kept: Sequence[Kept], seeds: Sequence[Tensor | None],
        other_seeds: Sequence[Tensor | None],
    ) -> tuple[list[Tensor], list[Tensor | None]]:  # fmt: skip
        def run(solver: SegmentSolver, kept: Kept, state: State, held: dict, poses: tuple, seeds: tuple, forces: tuple):
            poses = poses or None
            work = solver.prepare(state, held, poses, self.substeps, kept.windows, with_adjoint=True, steps=self.steps)
            tape = kept.take()
            solver.budget.used(tape)
            if tape:
                work.rewind(tape)
            else:
                work.advance()
            slot = self.substeps % 2
            targets = work.adjoint_slots()
            filled = [target[slot] for target in targets] + ([] if poses is None else work.colliders.adj_reaction)
            for target, seed in zip(filled, (*seeds, *forces), strict=True):
                target.zero_() if seed is None else target.copy_(seed)
            work.adjoint()
            found = iter(copies([*(target[0] for target in targets), *(work.adj_held[n] for n in HELD if held[n] is not None)]))
            of_state = [next(found) for _ in targets]
            of_held = [None if held[name] is None else next(found) for name in HELD]
            return of_state, of_held, [] if poses is None else copies(work.colliders.adj_poses)

        parts, lanes = self._parts(state, others), self.lanes
        found = lanes.each(_kind("adjoint", others), run, kept, *parts, lanes.split(seeds), lanes.split(other_seeds, 1))
        of_state, of_held, of_poses = zip(*found)
        return lanes.join(of_state), [*lanes.join(of_held), *lanes.join(of_poses, 1)]


def _kind(name: str, others: Sequence[Tensor | None]) -> tuple:
    """Of a pass: those of one kind run the same kernels. others: as `HeldSegment`."""
    return (name, *(t is None for t in others))


def advance_segment(
    lanes: Lanes, state: State, held: dict, substeps: int, first: int, poses: tuple[Tensor, ...] = (),
    steps: Steps | None = None,
) -> tuple[State, tuple[Tensor, ...]]:
    """(state after `substeps`, reactions), differentiable in state, everything in `held`, and poses.

    poses: of K colliders at the segment's S substeps, as `contact.motion.Poses`, () where there are none; reactions: force [N]
    and torque about each collider's origin [N m], (S, K, 3), or (). steps: times of the substeps, the numerics' dt by default.
    """
    steps = steps or Steps(lanes.numerics.dt, lanes.numerics.dt)
    done, most, reactions = 0, substeps, []
    while done < substeps:
        piece = lanes.piece(state, substeps - done, most, steps.dt)
        others = (*(held[name] for name in HELD), *(part[done : done + piece] for part in poses))
        try:
            state, reaction = advance(HeldSegment(lanes, piece, first + done, steps), state, others)
        except LeftWindow:
            most = WIDENED
            continue
        reactions.append(reaction)
        done, steps = done + piece, Steps(steps.dt, steps.dt)
    return state, reactions[0] if len(reactions) == 1 else tuple(torch.cat(parts) for parts in zip(*reactions, strict=True))
