"""The differentiable segment: some substeps of MLS-MPM as one torch operation.

Between the passes the states of all substeps are kept where there is room for them, else only a segment's inputs.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from mosa.errors import SimulationDiverged
from mosa.physics.engine.adapter_interface import ANSWER
from mosa.physics.engine.workspace import Numerics, Steps, Workspace, copies
from mosa.physics.grid.transfer_kernels import INVERTED, NO_EVENT, NONFINITE, OUTSIDE, WINDOW
from mosa.physics.grid.window import MAX_NODES, SMALL, extent, fallen, grid_window, window_of
from mosa.threads import threaded

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
    """Runs the segments of one rollout, of one world or of several in the same launches. volume: (N,) [m^3]; density: number or
    (N,) [kg/m^3]; cutoff: node mass [kg].

    workspaces: buffers by shape, shared by the rollouts of one simulator (scratch only, nothing in them outlives a segment).
    room: bytes for the states of all substeps, between the passes; segments that do not fit are run again in the backward pass.
    gravities: of every world [m/s^2], among which the particles are shared in equal parts; None: one world with the numerics' own.
    first_world: number of the first one, for messages, None where there is but one.
    """

    def __init__(
        self, numerics: Numerics, volume: Tensor, density: float | Tensor, cutoff: float, workspaces: dict, room: float = 0.0,
        gravities: Sequence[tuple[float, float, float]] | None = None, first_world: int | None = None,
    ) -> None:  # fmt: skip
        self.numerics, self.volume, self.cutoff = numerics, volume, cutoff
        self.mass = density * volume
        self.workspaces, self.room = workspaces, room
        self.gravities = tuple(gravities) if gravities is not None else (numerics.gravity,)
        self._first_world = first_world
        self._known: tuple | None = None

    @property
    def worlds(self) -> int:
        return len(self.gravities)

    def workspace(self, substeps: int, adapted: bool, plastic_adapted: bool, with_adjoint: bool) -> Workspace:
        key = (len(self.volume), substeps, adapted, plastic_adapted, with_adjoint, self.worlds)
        if key not in self.workspaces:
            self.workspaces[key] = Workspace(
                self.numerics, len(self.volume), substeps, adapted=adapted, plastic_adapted=plastic_adapted,
                with_adjoint=with_adjoint, worlds=self.worlds,
            )  # fmt: skip
        return self.workspaces[key]

    def prepare(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, windows: tuple[np.ndarray, np.ndarray],
        with_adjoint: bool, steps: Steps | None = None,
    ) -> Workspace:  # fmt: skip
        """A workspace loaded with the start of a segment. poses: of the colliders at its substeps, None where there are none;
        windows: of every world."""
        work = self.workspace(substeps, held["G"] is not None, held["plastic_G"] is not None, with_adjoint)
        work.set_window(*windows)
        work.load(state, held, self.volume, self.mass, self.cutoff, poses, steps, self.gravities)
        return work

    def advance(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, first: int, steps: Steps | None = None,
        kept: bool = False,
    ) -> tuple[tuple, tuple, tuple, list[Tensor]]:  # fmt: skip
        """(state after `substeps`, reactions (force, torque) of the colliders or (), grid windows used, `Workspace.tape`).

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
        if not np.isfinite(bounds).all():
            return min(left, WIDENED)
        while (count := -(-left // pieces)) > WIDENED:
            reach = fallen(bounds, self.gravities, count * dt)
            long, short = (window_of(reach, self.numerics.dx, n * dt, 2)[1].prod(-1) for n in (count, WIDENED))
            if long.sum() <= short.sum() + SMALL and long.max() <= MAX_NODES:
                break
            pieces *= 2
        return count

    def windows(self, state: tuple[Tensor, ...], time: float, margin: int, falls: bool) -> tuple[np.ndarray, np.ndarray]:
        """The windows of the worlds, (W, 3) each, for `time` [s], with room for `margin` nodes more. falls: also for what gravity
        adds to the speeds at the start. Errors: SimulationDiverged as `grid_window`."""
        bounds = self.bounds(state)
        bounds = fallen(bounds, self.gravities, time) if falls else bounds
        x, v = (self._apart(t) for t in state[:2])
        return grid_window(x, v, self.numerics.dx, time, margin, bounds=bounds, name=self._named)

    def _named(self, world: int) -> str:
        return "" if self._first_world is None else f"world {self._first_world + world}: "

    def _attempt(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, margin: int, steps: Steps, kept: bool = False
    ) -> tuple[tuple[tuple, tuple, tuple], list[int], Workspace]:
        """((state, reactions, windows), flags, workspace), in windows for the speeds at the start and `margin` nodes more."""
        # a few substeps that gravity takes out of the window are cheaper than nodes for it in every window
        windows = self.windows(state, substeps * steps.dt, margin, falls=substeps > WIDENED)
        work = self.prepare(state, held, poses, substeps, windows, with_adjoint=kept, steps=steps)
        work.advance()
        final = work.final()
        flags = self.look(work.flags, final)
        reaction = () if work.colliders is None else tuple(copies(work.colliders.reaction))
        return (final, reaction, windows), flags, work

    def look(self, flags: Tensor, final: tuple[Tensor, ...]) -> list[int]:
        """The events of a segment; the same transfer tells the host where the next one starts."""
        bounds = extent(*(self._apart(t) for t in final[:2]))
        numbers = torch.cat([flags.double(), bounds.double().flatten()]).numpy(force=True)  # float64 holds the flags exactly
        self._know(final, numbers[4:].reshape(-1, 12))
        return [int(n) for n in numbers[:4]]

    def _apart(self, t: Tensor) -> Tensor:
        """(worlds, particles of each, ...)."""
        return t.unflatten(0, (self.worlds, -1))

    def has_room(self, substeps: int) -> bool:
        """Whether the states of so many substeps may be kept."""
        return substeps * substep_bytes(self.numerics, len(self.volume)) <= self.room

    def bounds(self, state: tuple[Tensor, ...]) -> np.ndarray:
        """`extent` (W, 12) of every world's x and v, without a transfer where `look` has told it."""
        if self._known is None or self._known[:2] != _identity(state):
            self._know(state, extent(*(self._apart(t) for t in state[:2])).double().numpy(force=True))
        return self._known[2]

    def _know(self, state: tuple[Tensor, ...], bounds: np.ndarray) -> None:
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
        world, particle = divmod(particle, len(self.volume) // self.worlds)
        law, numerics = self.numerics.law, self.numerics
        what = {
            WINDOW: "moved by more than half a cell per substep",
            NONFINITE: "position, velocity or deformation is no longer finite",
            OUTSIDE: f"position is outside the box {list(numerics.low)} to {list(numerics.high)} m",
            INVERTED: "det F <= 0, which "
            + (f"law {law.name} has no value for" if law.needs_positive_J else "on_inversion=error forbids"),
        }[event]
        return SimulationDiverged(
            f"{self._named(world)}substep {substep}, particle {particle}: {what} (dt {dt:.3g} s, dx {numerics.dx:.3g} m); "
            "use more substeps, a larger box, or parameters nearer to the calibrated ones"
        )


class Lanes:
    """The worlds of one rollout, shared among solvers in equal parts: one solver on a CUDA device, where all worlds go through the
    same launches, and one for each world on a CPU, where as many of them as there are cores advance at a time, each on a grid of
    its own.

    buffers: of the simulator: the workspaces that a solver takes while it runs. warm: kinds of passes that have run in this
    simulator; the first of its kind compiles and loads kernels, which threads must not do at once.
    """

    def __init__(self, solvers: Sequence[SegmentSolver], buffers: list[dict], warm: set) -> None:
        self.solvers, self._buffers, self._warm = list(solvers), buffers, warm
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

    def piece(self, state: tuple[Tensor, ...], left: int, most: int, dt: float) -> int:
        """As `SegmentSolver.piece`, the fewest of any."""
        parts = self.split(state)
        return min(solver.piece(part, left, most, dt) for solver, part in zip(self.solvers, parts, strict=True))

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
        return [None if each[0] is None else torch.cat(each, dim) for each in zip(*parts, strict=True)]

    def each(self, kind: tuple, function: Callable, *arguments: Sequence) -> list:
        """function(solver, its arguments) of every solver, in their order."""

        def run(index: int):
            solver = self.solvers[index]
            try:
                buffers = self._buffers.pop()
            except IndexError:  # more threads than ever before
                buffers = {}
            solver.workspaces = buffers
            try:
                with torch.no_grad():
                    return function(solver, *(argument[index] for argument in arguments))
            finally:
                self._buffers.append(buffers)

        count = len(self.solvers)
        if self.solvers[0].volume.is_cuda:  # in turns: while one captures a graph no other may touch the stream
            return [run(index) for index in range(count)]
        if kind in self._warm:
            return list(threaded(run, range(count)))
        first = run(0)
        self._warm.add(kind)
        return [first, *threaded(run, range(1, count))]


class _Segment(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lanes: Lanes, substeps: int, first: int, steps: Steps | None, *inputs):
        """inputs: state (5), held (5), and, where there are colliders, their poses at the segment's substeps (4)."""
        state = tuple(t.detach().contiguous() for t in inputs[:5])
        ctx.set_materialize_grads(False)

        def run(solver: SegmentSolver, state: tuple, held: tuple, poses: tuple):
            kept = solver.has_room(substeps)
            found = solver.advance(state, dict(zip(HELD, held, strict=True)), poses or None, substeps, first, steps, kept)
            *found, tape = found
            size = sum(t.nbytes for t in tape)
            if size > solver.room:  # windows of more nodes than `substep_bytes` knows of
                tape, size = [], 0
            solver.room -= size
            return *found, tape

        parts = lanes.split(state), lanes.split(inputs[5:10]), lanes.split(inputs[10:], 1)
        results, reactions, ctx.windows, ctx.tapes = zip(*lanes.each(_kind("advance", inputs[5:]), run, *parts))
        ctx.lanes, ctx.substeps, ctx.steps = lanes, substeps, steps
        ctx.states = 5 if lanes.numerics.law.plastic else 4
        ctx.save_for_backward(*state, *inputs[5:])
        return *lanes.join([result[: ctx.states] for result in results]), *lanes.join(reactions, 1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        saved, lanes, substeps, states = ctx.saved_tensors, ctx.lanes, ctx.substeps, ctx.states
        tapes, ctx.tapes = list(ctx.tapes), []

        def run(solver: SegmentSolver, index: int, state: tuple, held: tuple, poses: tuple, seeds: tuple, forces: tuple):
            held, poses = dict(zip(HELD, held, strict=True)), poses or None
            work = solver.prepare(state, held, poses, substeps, ctx.windows[index], with_adjoint=True, steps=ctx.steps)
            tape, tapes[index] = tapes[index], []  # freed as soon as it is used
            solver.room += sum(t.nbytes for t in tape)
            if tape:
                work.rewind(tape)
            else:
                work.advance()
            slot = substeps % 2
            targets = [work.adj_x, work.adj_v, work.adj_C, work.adj_F, work.adj_A][:states]
            filled = [target[slot] for target in targets] + ([] if poses is None else work.colliders.adj_reaction)
            for target, seed in zip(filled, (*seeds, *forces), strict=True):
                target.zero_() if seed is None else target.copy_(seed)
            work.adjoint()
            found = iter(copies([*(target[0] for target in targets), *(work.adj_held[n] for n in HELD if held[n] is not None)]))
            gradients = [next(found) for _ in targets]
            gradients += [None if held[name] is None else next(found) for name in HELD]
            return gradients, [] if poses is None else copies(work.colliders.adj_poses)

        parts = lanes.split(saved[:5]), lanes.split(saved[5:10]), lanes.split(saved[10:], 1)
        seeds = lanes.split(seeds[:states]), lanes.split(seeds[states:], 1)
        found = lanes.each(_kind("adjoint", saved[5:]), run, range(len(lanes.solvers)), *parts, *seeds)
        gradients = lanes.join([own for own, _ in found])
        gradients[states:states] = [None] * (5 - states)
        return None, None, None, None, *gradients, *lanes.join([of_poses for _, of_poses in found], 1)


def _kind(name: str, inputs: Sequence[Tensor | None]) -> tuple:
    """Of a pass: those of one kind run the same kernels. inputs: held, and poses."""
    return (name, *(t is None for t in inputs))


def wants_gradient(tensors: Iterable[Tensor | None]) -> bool:
    """Whether torch would differentiate with respect to one of them."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def advance_segment(
    lanes: Lanes, state: tuple[Tensor, ...], held: dict, substeps: int, first: int, poses: tuple[Tensor, ...] = (),
    steps: Steps | None = None,
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """((x, v, C_affine, F, F_tot) after `substeps`, reactions), differentiable in state, everything in `held`, and poses.

    poses: of K colliders at the segment's S substeps, as `contact.motion.Poses`, () where there are none; reactions: force [N]
    and torque about each collider's origin [N m], (S, K, 3), or (). steps: times of the substeps, the numerics' dt by default.
    """
    steps = steps or Steps(lanes.numerics.dt, lanes.numerics.dt)
    count, done, most, reactions = 5 if lanes.numerics.law.plastic else 4, 0, substeps, []
    while done < substeps:
        piece = lanes.piece(state, substeps - done, most, steps.dt)
        inputs = (*state, *(held[name] for name in HELD), *(part[done : done + piece] for part in poses))
        try:
            if wants_gradient(inputs):
                result = _Segment.apply(lanes, piece, first + done, steps, *inputs)
            else:
                result = _advance(lanes, piece, first + done, steps, inputs)
        except LeftWindow:
            most = WIDENED
            continue
        final, reaction = tuple(result[:count]), result[count:]
        state = final if count == 5 else (*final, final[3])
        reactions.append(reaction)
        done, steps = done + piece, Steps(steps.dt, steps.dt)
    return state, reactions[0] if len(reactions) == 1 else tuple(torch.cat(parts) for parts in zip(*reactions, strict=True))


def _advance(lanes: Lanes, substeps: int, first: int, steps: Steps, inputs: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """As `_Segment`, without a gradient."""
    count = 5 if lanes.numerics.law.plastic else 4

    def run(solver: SegmentSolver, state: tuple, held: tuple, poses: tuple):
        held = dict(zip(HELD, held, strict=True))
        return solver.advance(state, held, poses or None, substeps, first, steps)[:2]

    state = [t.detach().contiguous() for t in inputs[:5]]
    parts = lanes.split(state), lanes.split(inputs[5:10]), lanes.split(inputs[10:], 1)
    results, reactions = zip(*lanes.each(_kind("advance", inputs[5:]), run, *parts))
    return *lanes.join([result[:count] for result in results]), *lanes.join(reactions, 1)
