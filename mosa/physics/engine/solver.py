"""Runs segments of substeps, in windows of the grid that hold the body, and says where a motion fails."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from mosa.errors import SimulationDiverged
from mosa.physics.contact.driven import Held
from mosa.physics.engine.budget import substep_bytes
from mosa.physics.engine.buffers import Pool
from mosa.physics.engine.numerics import Numerics, State
from mosa.physics.engine.workspace import Workspace
from mosa.physics.grid.transfer_kernels import INVERTED, NO_EVENT, NONFINITE, OUTSIDE, WINDOW
from mosa.physics.grid.window import MAX_NODES, SMALL, extent, fallen, grid_window, window_of
from mosa.physics.launching import same_memory

WIDENED = 32
"""Most substeps of a segment whose window may be widened for particles of any speed; longer ones are cut instead."""


Windows = tuple[np.ndarray, np.ndarray]
"""Lowest node and nodes per axis of the grids of the worlds, (W, 3) each."""


class LeftWindow(Exception):
    """A particle left the window of many substeps: of fewer, it has room for any speed."""


class _Shared:
    """Windows of several stretches of motion that are looked at together. flags: copies of each stretch's; final: state after the
    last one."""

    def __init__(self, windows: Windows) -> None:
        self.windows, self.flags, self.final = windows, [], None


class SegmentSolver:
    """Runs the segments of one rollout, of one world or of several in the same launches. volume:
    (N,) [m^3]; density: number or (N,) [kg/m^3]; cutoff: node mass [kg].

    room: bytes for the states of all substeps, between the passes; segments that do not fit are run
    again in the backward pass. gravities: of every world [m/s^2], among which the particles are shared in equal parts;
    None: one world with the numerics' own. first_world: number of the first one, for messages, None
    where there is but one. driven: particles of all worlds, None for none."""

    def __init__(
        self, numerics: Numerics, volume: Tensor, density: float | Tensor, cutoff: float,
        gravities: Sequence[tuple[float, float, float]] | None = None, first_world: int | None = None,
        driven: Held | None = None,
    ) -> None:  # fmt: skip
        self.numerics, self.volume, self.cutoff = numerics, volume, cutoff
        self.mass, self.driven = density * volume, driven
        self.room = 0.0
        self.gravities = tuple(gravities) if gravities is not None else (numerics.gravity,)
        self._pull = np.array(self.gravities)
        self._first_world = first_world
        self._known: tuple | None = None
        self._shared: _Shared | None = None

    @property
    def worlds(self) -> int:
        return len(self.gravities)

    def workspace(
        self, pool: Pool, substeps: int, adapted: bool, plastic_adapted: bool,
        with_adjoint: bool, shared: bool = False,
    ) -> Workspace:  # fmt: skip
        """Of a pool that is this thread's alone (`Buffers.take`)."""
        n = len(self.volume)
        key = n, substeps, adapted, plastic_adapted, with_adjoint, self.worlds, shared
        if not pool.get(key):
            work = Workspace(
                self.numerics, n, substeps, adapted=adapted, plastic_adapted=plastic_adapted,
                with_adjoint=with_adjoint, worlds=self.worlds, shared=shared,
            )  # fmt: skip
            work.key = key
            if work.stays:  # those of other lengths, of which there are many, would wait for a rollout that may never come
                for other, idle in pool.items():
                    pool[other] = [each for each in idle if not each.stays]
            pool[key] = [work]
        return pool[key][-1]

    @contextmanager
    def one_look(self, state: State, time: float, margin: int) -> Iterator[None]:
        """The stretches inside begin at `state` and take `time` seconds in all; they have the same windows, and the host looks at
        them once, afterwards: until then it launches one after the other and waits for none. Errors: LeftWindow for any event;
        the stretches one by one say which."""
        room, self._shared = self.room, _Shared(self.windows(state, time, margin, True))
        try:
            yield
            with torch.no_grad():
                flags = torch.stack(self._shared.flags).amin(0)
                fine = min(self.look(flags, self._shared.final)) == NO_EVENT
        finally:
            self._shared = None
        if not fine:
            self.room = room
            raise LeftWindow

    def piece(self, state: State, left: int, most: int, dt: float) -> int:
        """How many of the `left` substeps the next window is to serve: at most `most`, and so few that it is not much larger than
        the window of `WIDENED` substeps; all of them where a window is shared."""
        if self._shared is not None:
            return left
        bounds, pieces = self.bounds(state), -(-left // most)
        if not np.isfinite(bounds).all():
            return min(left, WIDENED)
        while (count := -(-left // pieces)) > WIDENED and not self._serves(
            bounds, count * dt, WIDENED * dt, 2
        ):
            pieces *= 2
        return count

    def together(self, state: State, frames: int, frame_dt: float, dt: float, margin: int) -> int:
        """How many of `frames` frames the next window is to serve: so few that it is not much larger than one frame's, or than
        that of `WIDENED` substeps."""
        bounds = self.bounds(state)
        if not np.isfinite(bounds).all():
            return 1
        least = min(frame_dt, WIDENED * dt)
        while frames > 1 and not self._serves(bounds, frames * frame_dt, least, margin):
            frames //= 2
        return frames

    def _serves(self, bounds: np.ndarray, time: float, least: float, margin: int) -> bool:
        """Whether the windows for `time` [s] are about as small as those for the time `least`."""
        reach, times = fallen(bounds, self._pull, time), np.array([time, least])[:, None, None]
        long, short = window_of(reach, self.numerics.dx, times, margin)[1].prod(-1)
        return bool(long.sum() <= short.sum() + SMALL and long.max() <= MAX_NODES)

    def windows(self, state: State, time: float, margin: int, falls: bool) -> Windows:
        """The windows of the worlds, (W, 3) each, for `time` [s], with room for `margin` nodes more. falls: also for what gravity
        adds to the speeds at the start. Inside of `one_look` they are what its stretches share. Errors: SimulationDiverged as
        `grid_window`."""
        if self._shared is not None:
            return self._shared.windows
        bounds = self.bounds(state)
        bounds = fallen(bounds, self._pull, time) if falls else bounds
        x, v = (self._apart(t) for t in state[:2])
        return grid_window(x, v, self.numerics.dx, time, margin, bounds=bounds, name=self._named)

    def _named(self, world: int) -> str:
        return "" if self._first_world is None else f"world {self._first_world + world}: "

    def look(self, flags: Tensor, final: State) -> list[int]:
        """The events of a segment; the same transfer tells the host where the next one starts."""
        bounds = extent(*(self._apart(t) for t in final[:2]))
        # float64 holds the flags exactly
        numbers = torch.cat([flags.double(), bounds.double().flatten()]).numpy(force=True)
        self.know(final, numbers[4:].reshape(-1, 12))
        return [int(n) for n in numbers[:4]]

    def _apart(self, t: Tensor) -> Tensor:
        """(worlds, particles of each, ...)."""
        return t.view(self.worlds, -1, *t.shape[1:])

    def has_room(self, substeps: int) -> bool:
        """Whether the states of so many substeps may be kept."""
        return substeps * substep_bytes(self.numerics, len(self.volume)) <= self.room

    def keep(self, work: Workspace, pool: Pool) -> list[Tensor] | Workspace:
        """The states that a forward pass left, where there is room for them: its tape, or the workspace itself, which leaves the
        pool. Else []: windows of more nodes than `substep_bytes` knows of."""
        if work.kept_bytes > self.room:
            return []
        self.room -= work.kept_bytes
        if not work.stays:
            return work.tape()
        pool[work.key].remove(work)
        return work

    def take_back(self, work: Workspace, pool: Pool) -> None:
        """A workspace that `keep` let go, for a backward pass and for the next stretch."""
        self.room += work.kept_bytes
        pool.setdefault(work.key, []).append(work)

    def bounds(self, state: State) -> np.ndarray:
        """`extent` (W, 12) of every world's x and v, without a transfer where `look` has told it."""
        if self._known is None or not same_memory(self._known[0], state[:2]):
            bounds = extent(*(self._apart(t) for t in state[:2]))
            self.know(state, bounds.double().numpy(force=True))
        return self._known[1]

    def know(self, state: Sequence[Tensor], bounds: np.ndarray) -> None:
        """`bounds` of a state (x, v, ...) that the host has already."""
        # aliases hold the memory, so that it does not become another tensor's, but not the graph, which holds the solver
        self._known = [t.detach() for t in state[:2]], bounds

    def left_window(self, flags: Tensor, final: State, first: int, dt: float) -> bool:
        """Whether a particle left the grid's window in a stretch that ended with these flags and this
        state; any other event raises.
        Inside of `one_look` that is asked afterwards. first, dt: of the substeps, for messages."""
        if self._shared is not None:
            self._shared.flags.append(flags.clone())
            self._shared.final = final
            return False
        events = self.look(flags, final)
        if min(events) == NO_EVENT:
            return False
        n = len(self.volume)
        event = min(range(4), key=lambda i: (events[i] // n, i != INVERTED, i == WINDOW, events[i]))
        if event == WINDOW:
            return True
        raise self.error(event, events[event], first, dt)

    def error(self, event: int, flag: int, first: int, dt: float) -> SimulationDiverged:
        """flag: number of the particle plus len(volume) for every substep after `first`."""
        substep, particle = first + flag // len(self.volume), flag % len(self.volume)
        world, particle = divmod(particle, len(self.volume) // self.worlds)
        law, numerics = self.numerics.law, self.numerics
        inverted = "on_inversion=error forbids"
        if law.needs_positive_J:
            inverted = f"law {law.name} has no value for"
        what = {
            WINDOW: "moved by more than half a cell per substep",
            NONFINITE: "position, velocity or deformation is no longer finite",
            OUTSIDE: f"position is outside the box {list(numerics.box[0])} to {list(numerics.box[1])} m",
            INVERTED: f"det F <= 0, which {inverted}",
        }[event]
        more = "use more substeps (a smaller simulation.courant of a run, or substeps= of a twin)"
        remedy = f"{more}, or parameters nearer to the calibrated ones"
        if event == OUTSIDE:
            remedy = (
                f"if the body flew apart, {more}; if it left whole, a larger box (scene.box of a run, box= of a twin), or "
                "another start: a velocity that is not given is the training's"
            )
        return SimulationDiverged(
            f"{self._named(world)}substep {substep}, particle {particle}: {what} (dt {dt:.3g} s, dx {numerics.dx:.3g} m); {remedy}"
        )
