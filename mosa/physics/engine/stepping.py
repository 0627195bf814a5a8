"""A body that is ready to be advanced, and the frame, or control step, by which it is: state in, state out.

A rollout is a loop over frames; a `Stepper` leaves the loop to the caller, who may drive the colliders from one step to the next.
Both go through `Prepared.frame`, so that steps give the bits that a rollout gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError, SimulationDiverged
from mosa.physics.adapters.chain import ChainOfSegments, learned_of
from mosa.physics.adapters.chain_schedule import SEGMENT, Chains
from mosa.physics.adapters.interface import ANSWER, AdapterOperator, MaterialState
from mosa.physics.contact.colliders import Collider, reach
from mosa.physics.contact.driven import sample_paths
from mosa.physics.contact.motion import Motion, Poses, Trajectory, sample_frame, sample_poses
from mosa.physics.engine.axes import Axes
from mosa.physics.engine.budget import room, substep_bytes
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.material_operations import advanced, first_advance
from mosa.physics.engine.numerics import Numerics, State, Steps, flat
from mosa.physics.engine.operation import Stretch, advance_segment, wants_gradient
from mosa.physics.engine.solver import LeftWindow
from mosa.physics.grid.transfer_kernels import OUTSIDE
from mosa.physics.time.clock import Clock, Frame, Moment
from mosa.types import ParticleState

AHEAD = 256
"""Most substeps that are launched before the host looks at them, on CUDA: of a segment of which no gradient is wanted, and of whole
frames. What fails is done again."""
LONGEST_KEPT = 96
"""Most of a segment where a gradient is wanted and all states are kept; its buffers hold those of a segment once more."""


@dataclass
class Pace:
    """How one motion is cut into stretches. alone: substeps of a segment, at most, where no adapter
    cuts it; chained: most substeps of a chain and weights of the adapter, () where there are none;
    most_ahead: substeps that are launched before the host looks, fewer once that failed; done:
    states after the next frames, where these were launched already."""

    alone: int
    chained: tuple
    most_ahead: int = field(default_factory=lambda: AHEAD)
    done: list[State] = field(default_factory=list)


@dataclass
class Prepared:
    """The bodies of one rollout: the parameters of their law, packed, and what advances them. held:
    these, and the answer of an adapter that is asked once.

    ask: (adapter, F, C_affine, packed, collect) -> its answer by name. gathers: whether a stretch of motion has as many substeps as
    it can, and is launched before the last one was looked at: segments are long, and an adapter that is a torch module is asked
    inside, in a chain of segments."""

    numerics: Numerics
    ask: Callable[..., dict[str, Tensor | None]]
    lanes: Lanes
    packed: Tensor
    adapter: Callable[[MaterialState], AdapterOperator] | None
    stride: int | None
    collect: Callable[[Any], None] | None
    gathers: bool
    held: dict[str, Tensor | None] = None

    def __post_init__(self) -> None:
        self.held, self.chains = {"parameters": self.packed, **dict.fromkeys(ANSWER)}, None
        flows = getattr(self.adapter, "flow", None) is not None
        alone = len(self.lanes.solvers) == 1 and self.stride is not None and not flows
        if self.gathers and alone and isinstance(self.adapter, nn.Module):
            collects = self.collect is not None
            self.chains = Chains(self.lanes, self.adapter, self.ask, self.packed, collects)

    def first_advance(self, state: State, dt: float) -> State:
        """The advance of F by dt [s] with which a motion begins."""
        C, F, F_tot = state.C_affine, state.F, state.F_tot
        numerics = self.numerics if dt == self.numerics.dt else replace(self.numerics, dt=dt)
        if not numerics.law.plastic:
            F = first_advance(numerics, F, C, self.packed)
            return state._replace(F=F, F_tot=F)
        held = self.held
        if self.adapter is not None:
            held = self.ask(self.adapter, F, C, self.packed, self.collect)
        mapped = first_advance(numerics, F, C, self.packed, held["plastic_G"], held["plastic_h"])
        return state._replace(F=mapped, F_tot=advanced(F_tot, C, dt))

    def reaches(self, columns: int) -> Tensor:
        """(K,) distance [m] of the farthest driven particle from the origin of its pose, 0 of
        solids."""
        far = torch.zeros(columns, dtype=torch.float64)
        for solver in self.lanes.solvers if self.numerics.driven else ():
            on = solver.driven.sets >= 0
            chosen, away = solver.driven.sets[on].long(), solver.driven.local[on].norm(dim=-1)
            far.scatter_reduce_(0, chosen.cpu(), away.double().cpu(), "amax")
        return far

    def settle(self, state: State) -> None:
        """Ask an adapter whose operator is the same in every state, once and for all: nothing cuts segments then."""
        if self.adapter is not None and self.stride is None:
            F, C = state.F, state.C_affine
            self.held.update(self.ask(self.adapter, F, C, self.packed, self.collect))
            self.adapter = None

    def give_memory(self, substeps: int, wanted: bool) -> None:
        """Memory for the states of `substeps` substeps, where a gradient is `wanted` or an adapter may want one."""
        if wanted or (self.adapter is not None and torch.is_grad_enabled()):
            each = substep_bytes(self.numerics, len(self.packed))
            idle = sum(work.kept_bytes for work in self.lanes.buffers if work.stays)
            self.lanes.give(room(self.numerics.device, substeps * each, self.lanes.worlds, idle))

    def begin(
        self, state: State, poses: tuple[Tensor, ...], substeps: int, variable: bool,
        gives: bool = False,
    ) -> Pace:  # fmt: skip
        """Before a motion of `substeps` substeps: how it is cut. gives: also memory, as above."""
        self.settle(state)
        learned = None if self.chains is None else learned_of(self.chains.adapter)
        weights = () if learned is None else learned.weights
        wanted = wants_gradient((*state, *self.held.values(), *poses, *weights))
        if gives:
            self.give_memory(substeps, wanted)
        if learned is not None:
            return Pace(SEGMENT, (self.chains.limit(state, substeps, wanted), learned))
        if self.gathers and not variable and not wanted:
            return Pace(AHEAD, ())
        if self.gathers and not variable and self.lanes.room:
            return Pace(max(SEGMENT, min(LONGEST_KEPT, substeps // 8)), ())
        return Pace(SEGMENT, ())

    def lengths(self, frame: Frame, alone: int) -> list[int]:
        """Of the segments of a frame; where counts vary, sizes that many of them share."""
        if self.adapter is not None:
            return segments(frame.count, self.stride)
        if frame.steps is None:
            return segments(frame.count, None, alone)
        return segments(frame.count, SEGMENT)

    def frame(
        self, state: State, frame: Frame, poses: tuple[Tensor, ...], pace: Pace, alike: int = 0
    ) -> tuple[State, Tensor | None]:
        """(state after a frame, reactions (substeps, W K, 6) or None).

        poses: of W worlds with K colliders at its substeps, () where there are none; pace: of the
        motion, from `begin`; alike: frames that follow and are known to have as many substeps and
        no poses, of which some may be done now. The state is then the one of the frame before."""
        while not pace.done:
            count = self._together(state, frame, min(1 + alike, pace.most_ahead // frame.count))
            if count == 1:
                state, forces, collected = self._one(state, frame, poses, pace)
                self._collect(collected)
                return state, forces
            done, collected = [state], []
            time = count * frame.count * frame.dt
            try:
                with self.lanes.solvers[0].one_look(state, time, self._margin):
                    for k in range(count):
                        next_one = frame._replace(first=frame.first + k * frame.count)
                        after, _, more = self._one(done[-1], next_one, poses, pace)
                        done.append(after)
                        collected += more
            except (LeftWindow, SimulationDiverged) as error:
                # what can be had of these frames still is, and the one that fails says how
                pace.most_ahead = count // 2 * frame.count if isinstance(error, LeftWindow) else 0
                continue
            pace.done = done[1:]
            self._collect(collected)
        return pace.done.pop(0), None

    @property
    def _margin(self) -> int:
        return (Stretch if self.chains is None else ChainOfSegments).margin

    def _together(self, state: State, frame: Frame, frames: int) -> int:
        """How many of `frames` frames alike are launched before the host looks at them."""
        asked_between = self.adapter is not None and self.chains is None
        if frames < 2 or not self.gathers or len(self.lanes.solvers) > 1 or asked_between:
            return 1
        frame_dt = frame.count * frame.dt
        return self.lanes.solvers[0].together(state, frames, frame_dt, frame.dt, self._margin)

    def _collect(self, statistics: list) -> None:
        for each in statistics:
            self.collect(each)

    def _one(
        self, state: State, frame: Frame, poses: tuple[Tensor, ...], pace: Pace
    ) -> tuple[State, Tensor | None, list]:
        """(as `frame`, of this frame alone, statistics of a chain's evaluations)."""
        lengths, first, steps = self.lengths(frame, pace.alone), frame.first, frame.steps
        if self.chains is not None:
            return self.chains.frame(state, lengths, first, poses, steps, *pace.chained)
        forces, done, held = [], 0, self.held
        flow = getattr(self.adapter, "flow", None)
        for length in lengths:
            if flow is not None:
                state = state._replace(F=flow(state.F, length * frame.dt))
            if self.adapter is not None:
                F, C = state.F, state.C_affine
                held = held | self.ask(self.adapter, F, C, self.packed, self.collect)
            along, at = tuple(part[done : done + length] for part in poses), first + done
            state, reaction = advance_segment(self.lanes, state, held, length, at, along, steps)
            forces += [torch.cat(reaction, -1)] if reaction else []
            steps = None if steps is None else Steps(steps.dt, steps.dt)
            done += length
        return state, torch.cat(forces) if forces else None, []


def segments(substeps: int, stride: int | None, most: int = 0) -> list[int]:
    """Lengths of a frame's segments: `stride` each (the last may be shorter), or nearly equal ones of at most `most`."""
    if stride is None:
        count = -(-substeps // most)
        return [substeps // count + (i < substeps % count) for i in range(count)]
    return [min(stride, substeps - i) for i in range(0, substeps, stride)]


def mean_force(forces: Tensor, steps: Steps) -> Tensor:
    """(1, K, 6) of (S, K, 6): the impulse over the time in which it acted, the first substep's being its kick."""
    longer = steps.kick / steps.dt - 1
    return (longer * forces[:1] + forces.sum(0, keepdim=True)) / (len(forces) + longer)


class Step(NamedTuple):
    """moment: after the step; reactions: (substeps, K, 6), (substeps, B, K, 6) of B worlds, as in a `Rollout`, None without
    colliders, (1, ...) where substeps are chosen; count: substeps taken."""

    moment: Moment
    reactions: Tensor | None
    count: int


@dataclass(eq=False)
class Stepper:
    """Advances bodies by one frame at a time, with colliders where the caller puts them. Made by `Simulator.stepper`.

    prepared: with what is the same in all steps; worlds: None for one body without a leading dimension; clock: how many substeps
    the steps take; motions: of the `solids`, of every world; axes: of the moments' states. `axes.world.state` has them in the
    world, as poses and reactions are here."""

    prepared: Prepared
    worlds: int | None
    clock: Clock
    motions: Sequence[Sequence[Motion | Trajectory]]
    axes: Axes
    solids: Sequence[Collider]

    def step(
        self,
        moment: Moment,
        poses: Poses | Callable[[int, float], Poses] | None = None,
        speed: float | None = None,
    ) -> Step:
        """One step on from `moment`, which is left as it is; differentiable in it, in poses, and in what `Simulator.stepper` got.

        poses: of K colliders at the step's S substeps, (S, K, ...) or, of B worlds, (S, B, K, ...), or a function of S and their
        dt [s]; None: of their own motions. speed: bound of the colliders' speeds [m/s] for substeps that are chosen, None for
        that of their own motions. Errors: SimulationDiverged naming substep and particle; ConfigError."""
        state, frame = self.enter(moment, moment.substeps == 0, speed)
        along = self._poses(moment, frame, poses)
        pace = self.prepared.begin(state, along, frame.count, self.clock.varies)
        after, forces, count = self.through(moment, state, frame, along, pace)
        (forces,) = self.apart([self.axes.world.vectors(forces)], 1)
        return Step(after._replace(state=ParticleState(*self.apart(after.state))), forces, count)

    def replaced(self, moment: Moment, by: Callable[[ParticleState], ParticleState]) -> Moment:
        """The moment with the state that `by` makes of its own, both in the world."""
        state = by(self.axes.world.state(ParticleState(*self.apart(moment.state))))
        return moment._replace(state=self.axes.state(state, self.prepared.numerics.dtype))

    def enter(
        self, moment: Moment, begins: bool, speed: float | None = None
    ) -> tuple[State, Frame]:
        """(all particles before the next frame, the frame). begins: whether a motion does, whose F is not advanced yet."""
        state = flat(moment.state)
        if not self.prepared.numerics.law.plastic:
            state = state._replace(F_tot=state.F)
        frame = self.clock.frame(moment, state, speed)
        return self.prepared.first_advance(state, frame.dt) if begins else state, frame

    def through(
        self, moment: Moment, state: State, frame: Frame, poses: tuple[Tensor, ...], pace: Pace,
        alike: int = 0,
    ) -> Step:  # fmt: skip
        """The frame that `enter` found, of all particles one world's after the other's. Other
        arguments: as `Prepared.frame`."""
        state, forces = self.prepared.frame(state, frame, poses, pace, alike)
        if self.axes.turn is not None:
            self._check_box(self.axes.world.points(state.x.detach()), frame)
        if forces is not None and frame.steps is not None:
            forces = mean_force(forces, frame.steps)
        after = Moment(state, moment.substeps + frame.count, moment.frames + 1, frame.dt)
        return Step(after, forces, frame.count)

    def _check_box(self, x: Tensor, frame: Frame) -> None:
        low, high = x.new_tensor(self.prepared.numerics.box)
        if len(outside := ((x < low) | (x > high)).any(1).nonzero()):
            solvers = self.prepared.lanes.solvers
            which, particle = divmod(int(outside[0]), len(solvers[0].volume))
            raise solvers[which].error(OUTSIDE, particle, frame.first + frame.count - 1, frame.dt)

    def apart(self, tensors: Iterable[Tensor | None], dim: int = 0) -> list[Tensor | None]:
        """With a dimension for the worlds in place of `dim`."""
        return [
            t if self.worlds is None or t is None else t.unflatten(dim, (self.worlds, -1))
            for t in tensors
        ]

    def _poses(
        self, moment: Moment, frame: Frame, poses: Poses | Callable | None
    ) -> tuple[Tensor, ...]:
        """(S, W K, ...) each, in the simulator's type."""
        colliders, count = len(self.motions[0]), frame.count
        if not colliders:
            return ()
        if poses is None:
            each = [self.sample(moment, count, frame.dt, motions) for motions in self.motions]
            found = self.taken([torch.cat(parts, 1) for parts in zip(*each)], frame.dt)
            return (*found, *self._paths(moment, frame))
        poses = poses(count, frame.dt) if callable(poses) else poses
        leading = (count, colliders) if self.worlds is None else (count, self.worlds, colliders)
        for name, part, shape in zip(Poses._fields, poses, ((3,), (3, 3), (3,), (3,)), strict=True):
            if tuple(part.shape) != (*leading, *shape):
                raise ConfigError(
                    f"poses: {name}: expected shape {(*leading, *shape)}, found {tuple(part.shape)}"
                )
        poses = self.taken(poses, frame.dt)
        poses = poses if self.worlds is None else tuple(part.flatten(1, 2) for part in poses)
        return (*poses, *self._paths(moment, frame))

    def poses_of(
        self, frames: int, start: float
    ) -> tuple[Callable[[int, Frame], tuple[Tensor, ...]], tuple[Tensor, ...]]:
        """(what tells those of a rollout's frame intervals, all of them where these are known beforehand). start [s]: of the
        motions."""
        clock, each = self.clock, self.motions
        if not self.solids:
            return lambda *_: (), ()
        if clock.varies:

            def chosen(number: int, frame: Frame) -> tuple[Tensor, ...]:
                sampled = sample_frame(
                    each[0], number, frames - 1, frame.count, clock.frame_dt, start
                )
                led = self.led(frame.count, frame.dt, start + number * clock.frame_dt)
                return (*self.taken(sampled, frame.dt), *led)

            return chosen, ()
        sampled = [sample_poses(own, frames - 1, clock.count, clock.dt, start) for own in each]
        joined = tuple(
            torch.cat(parts, 1) if len(each) > 1 else parts[0] for parts in zip(*sampled)
        )
        led = self.led((frames - 1) * clock.count, clock.dt, start)
        found = *self.taken(joined, clock.dt), *led
        return lambda _, frame: tuple(
            t[frame.first : frame.first + frame.count] for t in found
        ), found

    def _paths(self, moment: Moment, frame: Frame) -> tuple[Tensor, ...]:
        """(S, W P, 3) each: paths and rates of the points that lead driven particles, () where
        there are none."""
        first, start = self._times(moment)
        return self.led(frame.count, frame.dt, start, first)

    def led(self, count: int, dt: float, start: float, first: int = 0) -> tuple[Tensor, ...]:
        """As `_paths`, from the `first` substep after time `start` of the motions on."""
        if not self.prepared.numerics.points:
            return ()
        each = [sample_paths(motions, count, dt, start, first) for motions in self.motions]
        if self.worlds is not None and len(each) == 1:
            each *= self.worlds
        return tuple(self._moved(self.axes.vectors(torch.cat(part, 1))) for part in zip(*each))

    def taken(self, poses: Sequence[Tensor], dt: float) -> tuple[Tensor, ...]:
        """Poses (S, ..., K, ...) at substeps of dt [s] in the simulator's axes and type. Errors: ConfigError for a solid that would
        pass the body without being felt."""
        most, K = 0.5 * self.prepared.numerics.dx / dt, len(self.solids)
        worlds = poses[0].shape[1:-1].numel() // K
        # what is the same at all substeps is looked at once: of many worlds this takes milliseconds
        once = [(part[:1] if part.stride(0) == 0 else part).detach() for part in poses]
        x, R, v, w = (
            part.reshape(len(part), worlds, K, size) for part, size in zip(once, (3, 9, 3, 3))
        )
        far = v.new_tensor([reach(solid.shape) for solid in self.solids])
        far = torch.maximum(far, self.prepared.reaches(K).to(far))
        moved = (x.diff(dim=0).norm(dim=-1), far * R.diff(dim=0).norm(dim=-1) / math.sqrt(2))
        fastest = torch.cat(
            [v.norm(dim=-1) + w.norm(dim=-1) * far, *(part / dt for part in moved)]
        ).flatten(0, 1)
        if not bool((fastest <= (1 + 1e-6) * most).all()):
            fastest = fastest.amax(0)
            k = int(fastest.argmax())
            raise ConfigError(
                f"collider {self.solids[k].name or k}: expected a speed of at most {most:.3g} m/s, half a cell per "
                f"substep, found {float(fastest[k]):.3g}, which no body feels: use more substeps "
                "(reset(substeps=)), and radians for the turns of actions"
            )
        (x, R, v, w), axes = poses, self.axes
        turned = axes.points(x), axes.gradients(R), axes.vectors(v), axes.vectors(w)
        return tuple(map(self._moved, turned))

    def _moved(self, part: Tensor) -> Tensor:
        """In the simulator's type and on its device: one row where it is the same in all."""
        numerics, same = self.prepared.numerics, part.stride(0) == 0
        moved = (part[:1] if same else part).to(dtype=numerics.dtype, device=numerics.device)
        return moved.expand_as(part) if same else moved

    def sample(
        self, moment: Moment, count: int, dt: float, motions: Sequence[Motion | Trajectory],
        after: int = 0,
    ) -> Poses:  # fmt: skip
        """Poses (S, K, ...) float64 of colliders with these motions at `count` substeps of dt [s] from `after` substeps after
        `moment`, at the times at which a rollout takes them."""
        frame_dt = self.clock.frame_dt
        motions = [m.timed(None, frame_dt) if isinstance(m, Motion) else m for m in motions]
        first, start = self._times(moment)
        return sample_poses(motions, 1, count, dt, start, first + after)

    def _times(self, moment: Moment) -> tuple[int, float]:
        """(substeps, seconds before them) of the motions until `moment`."""
        varies = self.clock.varies
        return (0, moment.frames * self.clock.frame_dt) if varies else (moment.substeps, 0.0)
