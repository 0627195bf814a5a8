"""A stretch of motion as one differentiable torch operation: a segment in which what an adapter
answered is held, or a chain.

Between the passes a stretch keeps what its backward pass reads, where there is room for it, and else only its inputs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from mosa.physics.adapters.interface import ANSWER
from mosa.physics.contact.motion import Poses
from mosa.physics.engine.buffers import Pool
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.numerics import State, Steps
from mosa.physics.engine.solver import WIDENED, LeftWindow, SegmentSolver, Windows
from mosa.physics.engine.workspace import Workspace
from mosa.physics.grid.transfer_kernels import WINDOW
from mosa.physics.launching import copies

STATES = len(State._fields)
HELD = ("parameters", *ANSWER)


@dataclass
class Kept:
    """What a forward pass leaves for the backward pass. windows: of the grid that it used; states: as `SegmentSolver.keep`, []
    where they are to be made again."""

    windows: Windows
    states: list[Tensor] | Workspace

    def take(self) -> list[Tensor] | Workspace:
        """The states, which are let go as soon as they are used: another pass makes them again."""
        states, self.states = self.states, []
        return states


@dataclass
class Stretch:
    """Some substeps that are advanced, and differentiated, as a whole.

    Besides the state a stretch depends on other tensors: what acts, here what is held (`HELD`, None
    for one there is not), then, where there are colliders, their poses at its substeps, as
    `contact.motion.Poses`, and the paths of points that lead driven particles. Besides the state it
    leaves the colliders' force [N] and torque about each collider's origin [N m], (S, W K, 3) each,
    then the `statistics` of its kind.

    first: number of its first substep since the motion began; steps: times of the substeps."""

    lanes: Lanes
    first: int
    steps: Steps
    substeps: int

    margin: ClassVar[int] = 2
    """Nodes of a window beyond what the speeds at the start ask for."""

    @property
    def cut(self) -> bool:
        """Whether the caller makes shorter ones of it where a particle leaves its window; else the
        window is widened."""
        return self.substeps > WIDENED

    @property
    def foresees(self) -> bool:
        """Whether the window has room for what gravity adds to the speeds."""
        # a few substeps that gravity takes out of it are cheaper than nodes for it in every window
        return self.cut

    def buffers(
        self, solver: SegmentSolver, pool: Pool, acting: Sequence[Tensor | None], full: bool
    ) -> tuple[Workspace, dict]:
        """(the workspace, what is copied into it by name). full: with buffers for the adjoint."""
        held = dict(zip(HELD, acting, strict=True))
        operator = [held[name] for name in ("G", "h") if held[name] is not None]
        # views of one row, as `expand` makes them, are read from there by all particles
        shared = bool(operator) and all(part.stride(0) == 0 for part in operator)
        return solver.workspace(
            pool, self.substeps, bool(operator), held["plastic_G"] is not None, full, shared
        ), held

    def advance(self, work: Workspace) -> None:
        """All substeps, in a workspace that is loaded."""
        work.advance()

    def adjoint(
        self, work: Workspace, acting: Sequence[Tensor | None], again: bool, penalised: bool
    ) -> None:
        """Of all substeps, in a workspace that is loaded and seeded. again: the states are not there; penalised: `statistics_seeds`
        are not all zero."""
        if again:
            work.advance()
        work.adjoint()

    def adjoint_of(self, work: Workspace, acting: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Where `adjoint` leaves the gradients of what acts."""
        pairs = zip(HELD, acting, strict=True)
        return [None if value is None else work.adj_held[name] for name, value in pairs]

    def full(self, differentiated: bool, kept: bool) -> bool:
        """Whether the forward pass runs in the buffers of the backward pass, which it has to where its states are kept."""
        return kept

    def statistics(self, work: Workspace) -> Sequence[Tensor]:
        return ()

    def statistics_seeds(self) -> Sequence[Tensor]:
        return ()

    @property
    def plastic(self) -> bool:
        """Whether the law yields, so that F_tot is a state of its own."""
        return self.lanes.numerics.law.plastic

    def _parts(self, state: State, others: Sequence[Tensor | None]) -> tuple[list, list, list]:
        """(states, what acts, poses) of each solver."""
        split, numerics = self.lanes.split, self.lanes.numerics
        posed = len(Poses._fields) if numerics.colliders is not None else 0
        posed += 2 if numerics.points else 0  # paths and rates of driven points
        acting = len(others) - posed
        states = [State(*part) for part in split(state)]
        return states, split(others[:acting]), split(others[acting:], 1)

    def _kind(self, name: str, others: Sequence[Tensor | None]) -> tuple:
        """Of a pass: those of one kind run the same kernels."""
        return (name, type(self), *(t is None for t in others))

    def _loaded(
        self, solver: SegmentSolver, pool: Pool, state: State, acting: Sequence[Tensor | None],
        poses: Sequence[Tensor], windows: Windows, full: bool,
    ) -> Workspace:  # fmt: skip
        work, held = self.buffers(solver, pool, acting, full)
        work.set_window(*windows)
        work.load(
            state, held, solver.volume, solver.mass, solver.cutoff, poses, self.steps,
            solver.gravities, solver.driven,
        )  # fmt: skip
        return work

    def forward(
        self, state: State, others: Sequence[Tensor | None], differentiated: bool
    ) -> tuple[State, list[Tensor], list[Kept]]:
        """(the state after it, what else it leaves, what `backward` gets as `kept`). differentiated: whether that follows.
        Errors: SimulationDiverged naming substep and particle; LeftWindow where it is cut."""
        time, dt = self.substeps * self.steps.dt, self.steps.dt
        # a body that is being accelerated may need the most that the time step bound allows: half
        # a cell per substep
        margins = (self.margin,) if self.cut else (self.margin, 3 + self.substeps // 2)

        def run(solver: SegmentSolver, pool: Pool, state: State, acting: tuple, poses: tuple):
            kept = differentiated and solver.has_room(self.substeps)
            full = self.full(differentiated, kept)

            for margin in margins:
                windows = solver.windows(state, time, margin, self.foresees)
                work = self._loaded(solver, pool, state, acting, poses, windows, full)
                self.advance(work)
                final = work.final()
                if not solver.left_window(work.flags, final, self.first, dt):
                    break
            else:
                fastest = int(work.flags[WINDOW])
                raise LeftWindow if self.cut else solver.error(WINDOW, fastest, self.first, dt)
            left = [] if work.colliders is None else work.colliders.reaction
            left = copies([*left, *self.statistics(work)])
            return final, left, Kept(windows, solver.keep(work, pool) if kept else [])

        finals, left, kept = zip(
            *self.lanes.each(self._kind("advance", others), run, *self._parts(state, others))
        )
        states = [final if self.plastic else final[:-1] for final in finals]
        return State.whole(self.lanes.join(states)), self.lanes.join(left, 1), kept

    def backward(
        self, state: State, others: Sequence[Tensor | None], kept: Sequence[Kept], seeds: Sequence[Tensor | None],
        other_seeds: Sequence[Tensor | None],
    ) -> tuple[list[Tensor], list[Tensor | None]]:  # fmt: skip
        """Gradients of (state, others), of as many states as there are seeds: without F_tot where the law does not yield."""

        def run(solver, pool, kept: Kept, state: State, acting, poses, seeds, other_seeds):
            states = kept.take()
            if isinstance(states, Workspace):  # as the forward pass left it
                work = states
                solver.take_back(work, pool)
            else:
                work = self._loaded(solver, pool, state, acting, poses, kept.windows, True)
                solver.room += sum(t.nbytes for t in states)
                if states:
                    work.rewind(states)
            slots, statistics = work.adj_states, self.statistics_seeds()
            reaction, of_poses = [], []
            if work.colliders is not None:
                reaction, of_poses = work.colliders.adj_reaction, work.colliders.adj_poses
            if work.driven is not None and work.driven.count:
                of_poses = [*of_poses, *work.driven.adj_paths]
            targets = [*(part[self.substeps % 2] for part in slots), *reaction, *statistics]
            seeded = list(zip(targets, (*seeds, *other_seeds), strict=True))
            if unseeded := [target for target, seed in seeded if seed is None]:
                torch._foreach_zero_(unseeded)
            if given := [pair for pair in seeded if pair[1] is not None]:
                torch._foreach_copy_(*map(list, zip(*given)))
            penalised = any(seed is not None for seed in other_seeds[len(reaction) :])
            self.adjoint(work, acting, not states, penalised)
            of_acting = self.adjoint_of(work, acting)
            given = (t for t in of_acting if t is not None)
            found = iter(copies([*(part[0] for part in slots), *given, *of_poses]))
            of_state = [next(found) for _ in slots]
            return of_state, [None if t is None else next(found) for t in of_acting], list(found)

        parts, lanes = self._parts(state, others), self.lanes
        given = lanes.split(seeds), lanes.split(other_seeds, 1)
        found = lanes.each(self._kind("adjoint", others), run, kept, *parts, *given)
        of_state, of_acting, of_poses = zip(*found)
        return lanes.join(of_state), [*lanes.join(of_acting), *lanes.join(of_poses, 1)]


class _Advance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, stretch: Stretch, *inputs):
        ctx.set_materialize_grads(False)
        state, others = _detached(inputs[:STATES]), inputs[STATES:]
        final, more, ctx.kept = stretch.forward(state, others, True)
        ctx.stretch, ctx.own = stretch, STATES if stretch.plastic else STATES - 1
        # weights too: autograd tells if one is changed before the backward pass
        ctx.save_for_backward(*state, *others)
        return *final[: ctx.own], *more

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        saved = ctx.saved_tensors  # once: torch.utils.checkpoint gives them a single time
        state, others = State(*saved[:STATES]), saved[STATES:]
        found, of_others = ctx.stretch.backward(
            state, others, ctx.kept, seeds[: ctx.own], seeds[ctx.own :]
        )
        return None, *found, *[None] * (STATES - ctx.own), *of_others


def _detached(state: Iterable[Tensor]) -> State:
    return State(*(t.detach().contiguous() for t in state))


def wants_gradient(tensors: Iterable[Tensor | None]) -> bool:
    """Whether torch would differentiate with respect to one of them."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def advance(
    stretch: Stretch, state: State, others: Sequence[Tensor | None]
) -> tuple[State, tuple[Tensor, ...]]:
    """(the state after the stretch, what else it leaves), differentiable in state and others. Errors: as `Stretch.forward`."""
    if not wants_gradient((*state, *others)):
        final, more, _ = stretch.forward(_detached(state), others, False)
        return final, tuple(more)
    result = _Advance.apply(stretch, *state, *others)
    own = STATES if stretch.plastic else STATES - 1
    return State.whole(result[:own]), tuple(result[own:])


def advance_segment(
    lanes: Lanes, state: State, held: dict, substeps: int, first: int,
    poses: tuple[Tensor, ...] = (), steps: Steps | None = None,
) -> tuple[State, tuple[Tensor, ...]]:  # fmt: skip
    """(state after `substeps`, reactions), differentiable in state, everything in `held`, and poses.

    poses: of K colliders at the segment's S substeps, () where there are none; reactions: as a `Stretch` leaves them. steps: times
    of the substeps, the numerics' dt by default."""
    steps = steps or Steps(lanes.numerics.dt, lanes.numerics.dt)
    done, most, reactions = 0, substeps, []
    while done < substeps:
        piece = lanes.piece(state, substeps - done, most, steps.dt)
        others = (*(held[name] for name in HELD), *(part[done : done + piece] for part in poses))
        try:
            state, reaction = advance(Stretch(lanes, first + done, steps, piece), state, others)
        except LeftWindow:
            most = WIDENED
            continue
        reactions.append(reaction)
        done, steps = done + piece, Steps(steps.dt, steps.dt)
    return state, reactions[0] if len(reactions) == 1 else tuple(
        torch.cat(parts) for parts in zip(*reactions, strict=True)
    )
