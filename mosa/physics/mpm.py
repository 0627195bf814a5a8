"""The differentiable segment: some substeps of MLS-MPM as one torch operation.

Between the passes the states of all substeps are kept where there is room for them, else only a segment's inputs.
"""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from mosa.errors import SimulationDiverged
from mosa.physics.asking import ANSWER
from mosa.physics.mpm_kernels import INVERTED, NO_EVENT, NONFINITE, OUTSIDE, WINDOW
from mosa.physics.window import MAX_NODES, SMALL, extent, fallen, grid_window, window_of
from mosa.physics.workspace import Numerics, Steps, Workspace, copies

HELD = ("parameters", *ANSWER)
LONGEST = 256
"""Most substeps of a segment of which no gradient is wanted, on CUDA: each segment costs a look at the host."""
LONGEST_KEPT = 96
"""The same where a gradient is wanted and all states are kept; its buffers hold those of a segment once more."""
WIDENED = 32
"""Most substeps of a segment whose window may be widened for particles of any speed; longer ones are cut instead."""


def substep_bytes(numerics: Numerics, particles: int) -> int:
    """What the backward pass reads of a substep: 33 numbers a particle (42 where the law yields) and 8 a node, of which there is
    about one a particle."""
    return particles * (50 if numerics.law.plastic else 41) * torch.finfo(numerics.dtype).bits // 8


class LeftWindow(Exception):
    """A particle left the window of many substeps: of fewer, it has room for any speed."""


def _identity(state: tuple[Tensor, ...]) -> tuple[int, int]:
    """Tells x and v from others that are alive; detached aliases have the same."""
    return state[0].data_ptr(), state[1].data_ptr()


class SegmentSolver:
    """Runs the segments of one rollout. volume: (N,) [m^3]; density: number or (N,) [kg/m^3]; cutoff: node
    mass [kg].

    workspaces: buffers by shape, shared by the rollouts of one simulator (scratch only, nothing in them outlives a segment).
    room: bytes for the states of all substeps, between the passes; segments that do not fit are run again in the backward pass.
    """

    def __init__(
        self, numerics: Numerics, volume: Tensor, density: float | Tensor, cutoff: float, workspaces: dict, room: float = 0.0
    ) -> None:
        self.numerics, self.volume, self.cutoff = numerics, volume, cutoff
        self.mass = density * volume
        self._workspaces, self.room = workspaces, room
        self._known: tuple | None = None

    def workspace(self, substeps: int, adapted: bool, plastic_adapted: bool, with_adjoint: bool) -> Workspace:
        key = (len(self.volume), substeps, adapted, plastic_adapted, with_adjoint)
        if key not in self._workspaces:
            self._workspaces[key] = Workspace(
                self.numerics, len(self.volume), substeps, adapted=adapted, plastic_adapted=plastic_adapted,
                with_adjoint=with_adjoint,
            )  # fmt: skip
        return self._workspaces[key]

    def prepare(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, window, with_adjoint: bool,
        steps: Steps | None = None,
    ) -> Workspace:  # fmt: skip
        """A workspace loaded with the start of a segment. poses: of the colliders at its substeps, None where there are none."""
        work = self.workspace(substeps, held["G"] is not None, held["plastic_G"] is not None, with_adjoint)
        work.set_window(*window)
        work.load(state, held, self.volume, self.mass, self.cutoff, poses, steps)
        return work

    def advance(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, first: int, steps: Steps | None = None,
        kept: bool = False,
    ) -> tuple[tuple, tuple, tuple, list[Tensor]]:  # fmt: skip
        """(state after `substeps`, reactions (force, torque) of the colliders or (), grid window used, `Workspace.tape`).

        first: number of the first substep, for messages; steps: their times, the numerics' dt by default; kept: whether to make
        the last, [] otherwise.

        Errors: SimulationDiverged naming substep and particle; LeftWindow of more than `WIDENED` substeps.
        """
        # the speed at the start tells the window; a body that is being accelerated may need the most that the time step bound
        # allows, half a cell per substep
        steps = steps or Steps(self.numerics.dt, self.numerics.dt)
        cut = substeps > WIDENED  # where the first window does not do, not widened
        for margin in (2,) if cut else (2, 3 + substeps // 2):
            found, flags, work = self._attempt(state, held, poses, substeps, margin, steps, kept)
            if not self.left_window(flags, first, steps.dt):
                return *found, work.tape() if kept else []
        raise LeftWindow if cut else self.left_behind(flags, first, steps.dt)

    def piece(self, state: tuple[Tensor, ...], left: int, most: int, dt: float) -> int:
        """How many of the `left` substeps the next window is to serve: at most `most`, and so few that it is not much larger than
        the window of `WIDENED` substeps."""
        bounds, pieces = self.bounds(state), -(-left // most)
        if not all(math.isfinite(b) for b in bounds):
            return min(left, WIDENED)
        while (count := -(-left // pieces)) > WIDENED:
            reach = fallen(bounds, self.numerics.gravity, count * dt)
            long, short = (math.prod(window_of(reach, self.numerics.dx, n * dt, 2)[1]) for n in (count, WIDENED))
            if long <= min(short + SMALL, MAX_NODES):
                break
            pieces *= 2
        return count

    def _attempt(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, margin: int, steps: Steps, kept: bool = False
    ) -> tuple[tuple[tuple, tuple, tuple], list[int], Workspace]:
        """((state, reactions, window), flags, workspace), in a window for the speeds at the start and `margin` nodes more."""
        x, v = state[:2]
        time, bounds = substeps * steps.dt, self.bounds(state)
        # a few substeps that gravity takes out of the window are cheaper than nodes for it in every window
        bounds = fallen(bounds, self.numerics.gravity, time) if substeps > WIDENED else bounds
        window = grid_window(x, v, self.numerics.dx, time, margin, bounds=bounds)
        work = self.prepare(state, held, poses, substeps, window, with_adjoint=kept, steps=steps)
        work.advance()
        final = work.final()
        flags = self.look(work.flags, final)
        reaction = () if work.colliders is None else tuple(copies(work.colliders.reaction))
        return (final, reaction, window), flags, work

    def look(self, flags: Tensor, final: tuple[Tensor, ...]) -> list[int]:
        """The events of a segment; the same transfer tells the host where the next one starts."""
        numbers = torch.cat([flags.double(), extent(*final[:2]).double()]).tolist()  # float64 holds the flags exactly
        self._know(final, numbers[4:])
        return [int(n) for n in numbers[:4]]

    def has_room(self, substeps: int) -> bool:
        """Whether the states of so many substeps may be kept."""
        return substeps * substep_bytes(self.numerics, len(self.volume)) <= self.room

    def bounds(self, state: tuple[Tensor, ...]) -> list[float]:
        """`extent` of x and v, without a transfer where `look` has told it."""
        if self._known is None or self._known[:2] != _identity(state):
            self._know(state, extent(*state[:2]).tolist())
        return self._known[2]

    def _know(self, state: tuple[Tensor, ...], bounds: list[float]) -> None:
        # aliases hold the memory, so that it does not become another tensor's, but not the graph, which holds the solver
        self._known = (*_identity(state), bounds, [t.detach() for t in state[:2]])

    def left_behind(self, flags: list[int], first: int, dt: float) -> SimulationDiverged:
        """The error to raise for a particle that leaves even the widest window."""
        return self._error(WINDOW, flags[WINDOW], first, dt)

    def left_window(self, flags: list[int], first: int, dt: float) -> bool:
        """Whether a particle left the grid's window; any other event raises."""
        if min(flags) == NO_EVENT:
            return False
        n = len(self.volume)
        event = min(range(4), key=lambda i: (flags[i] // n, i != INVERTED, i == WINDOW, flags[i]))
        if event == WINDOW:
            return True
        raise self._error(event, flags[event], first, dt)

    def _error(self, event: int, flag: int, first: int, dt: float) -> SimulationDiverged:
        substep, particle = first + flag // len(self.volume), flag % len(self.volume)
        law, numerics = self.numerics.law, self.numerics
        what = {
            WINDOW: "moved by more than half a cell per substep",
            NONFINITE: "position, velocity or deformation is no longer finite",
            OUTSIDE: f"position is outside the box {list(numerics.low)} to {list(numerics.high)} m",
            INVERTED: "det F <= 0, which "
            + (f"law {law.name} has no value for" if law.needs_positive_J else "on_inversion=error forbids"),
        }[event]
        return SimulationDiverged(
            f"substep {substep}, particle {particle}: {what} (dt {dt:.3g} s, dx {numerics.dx:.3g} m); "
            "use more substeps, a larger box, or parameters nearer to the calibrated ones"
        )


class _Segment(torch.autograd.Function):
    @staticmethod
    def forward(ctx, solver: SegmentSolver, substeps: int, first: int, steps: Steps | None, *inputs):
        """inputs: state (5), held (5), and, where there are colliders, their poses at the segment's substeps (4)."""
        state = tuple(t.detach().contiguous() for t in inputs[:5])
        held, poses = dict(zip(HELD, inputs[5:10], strict=True)), inputs[10:] or None
        ctx.set_materialize_grads(False)
        kept = solver.has_room(substeps)
        result, reaction, window, ctx.tape = solver.advance(state, held, poses, substeps, first, steps, kept)
        size = sum(t.nbytes for t in ctx.tape)
        if size > solver.room:  # a window of more nodes than `substep_bytes` knows of
            ctx.tape, size = [], 0
        solver.room -= size
        ctx.solver, ctx.substeps, ctx.window, ctx.steps = solver, substeps, window, steps
        ctx.states = 5 if solver.numerics.law.plastic else 4
        ctx.save_for_backward(*state, *inputs[5:])
        return *result[: ctx.states], *reaction

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        saved = ctx.saved_tensors
        state, held, poses = saved[:5], dict(zip(HELD, saved[5:10], strict=True)), saved[10:] or None
        work = ctx.solver.prepare(state, held, poses, ctx.substeps, ctx.window, with_adjoint=True, steps=ctx.steps)
        tape, ctx.tape = ctx.tape, []  # freed as soon as it is used
        if tape:
            work.rewind(tape)
        else:
            work.advance()
        slot = ctx.substeps % 2
        targets = [work.adj_x, work.adj_v, work.adj_C, work.adj_F, work.adj_A][: ctx.states]
        filled = [target[slot] for target in targets] + ([] if poses is None else work.colliders.adj_reaction)
        for target, seed in zip(filled, seeds, strict=True):
            target.zero_() if seed is None else target.copy_(seed)
        work.adjoint()
        found = iter(copies([*(target[0] for target in targets), *(work.adj_held[n] for n in HELD if held[n] is not None)]))
        gradients = [next(found) for _ in targets] + [None] * (5 - ctx.states)
        gradients += [None if held[name] is None else next(found) for name in HELD]
        gradients += [] if poses is None else copies(work.colliders.adj_poses)
        return None, None, None, None, *gradients


def wants_gradient(tensors: Iterable[Tensor | None]) -> bool:
    """Whether torch would differentiate with respect to one of them."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def advance_segment(
    solver: SegmentSolver, state: tuple[Tensor, ...], held: dict, substeps: int, first: int, poses: tuple[Tensor, ...] = (),
    steps: Steps | None = None,
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """((x, v, C_affine, F, F_tot) after `substeps`, reactions), differentiable in state, everything in `held`, and poses.

    poses: of K colliders at the segment's S substeps, as `collider_motion.Poses`, () where there are none; reactions: force [N]
    and torque about each collider's origin [N m], (S, K, 3), or (). steps: times of the substeps, the numerics' dt by default.
    """
    steps = steps or Steps(solver.numerics.dt, solver.numerics.dt)
    count, done, most, reactions = 5 if solver.numerics.law.plastic else 4, 0, substeps, []
    while done < substeps:
        piece = solver.piece(state, substeps - done, most, steps.dt)
        along = tuple(part[done : done + piece] for part in poses)
        inputs = (*state, *(held[name] for name in HELD), *along)
        try:
            if wants_gradient(inputs):
                result = _Segment.apply(solver, piece, first + done, steps, *inputs)
                final, reaction = result[:count], result[count:]
                state = final if count == 5 else (*final, final[3])
            else:
                state = tuple(t.detach().contiguous() for t in state)
                state, reaction = solver.advance(state, held, along or None, piece, first + done, steps)[:2]
        except LeftWindow:
            most = WIDENED
            continue
        reactions.append(reaction)
        done, steps = done + piece, Steps(steps.dt, steps.dt)
    return state, reactions[0] if len(reactions) == 1 else tuple(torch.cat(parts) for parts in zip(*reactions, strict=True))
