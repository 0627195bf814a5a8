"""A twin in motion, step by step: one body, or the same one in many worlds, among colliders that actions drive.

twin.reset(height=0.2, colliders=[{"type": "box", "name": "paddle", "size": [0.1, 0.1, 0.1], "position": [-0.2, 0.1, 0]}])
for _ in range(50):
    state, reactions = twin.step({"paddle": {"velocity": (0.3, 0, 0)}})"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError, DataError
from mosa.modules.body.body import Body, Ready, Start, World
from mosa.modules.fitting.parameters import each_law
from mosa.physics.contact.colliders import Collider, reach
from mosa.physics.contact.driven import stack_held
from mosa.physics.contact.motion import (
    Poses,
    Trajectory,
    exponential,
    rotation_matrices,
    rotation_vector,
    turning,
)
from mosa.physics.contact.overlap import check_clear
from mosa.physics.engine.axes import entered
from mosa.physics.engine.inputs import numbers
from mosa.physics.engine.numerics import State, flat
from mosa.physics.time.clock import Moment
from mosa.settings import shown
from mosa.twin.start import Crossings, check_wants_no_gradients
from mosa.types import ParticleState, Rollout, dense, in_brief

TWISTS, TARGETS = ("velocity", "angular_velocity"), ("position", "rotation")


@dataclass(frozen=True)
class TwinState:
    """All that a motion goes on from, as plain tensors; of B worlds with a leading dimension.

    x, v: (N, 3) [m], [m/s]; C_affine: (N, 3, 3) [1/s]; F, F_tot: (N, 3, 3): particles, in the simulation's type; lift: (3,), the
    contact's offset, by which x is above where the body is seen; collider_position, collider_rotation: (K, 3) [m], (K, 3, 3) now;
    driven: (K,) bool, whether an action has moved a collider yet; frames, substeps: () steps and substeps since the start; time: ()
    [s]; lag: () [s], length of the last substep."""

    __repr__ = in_brief

    x: Tensor
    v: Tensor
    C_affine: Tensor
    F: Tensor
    F_tot: Tensor
    lift: Tensor
    collider_position: Tensor
    collider_rotation: Tensor
    driven: Tensor
    frames: Tensor
    substeps: Tensor
    time: Tensor
    lag: Tensor

    @property
    def positions(self) -> Tensor:
        """(N, 3) [m] where the body is seen, as in a `Rollout`."""
        lift = self.lift if self.lift.ndim == 1 else self.lift[:, None]
        return self.x.to(lift.dtype) - lift

    def world(self, number: int) -> TwinState:
        """Of one of B worlds, as `Twin.export` and `Twin.render` take it. Errors: ConfigError."""
        if self.x.ndim != 3 or not 0 <= number < len(self.x):
            raise ConfigError(f"world: expected one of x {tuple(self.x.shape)}, found {number}")
        alike = ("driven", "frames", "substeps", "time", "lag", *(["lift"] * (self.lift.ndim == 1)))
        whole = {f.name: getattr(self, f.name) for f in fields(self)}
        own = {k: value if k in alike else value[number] for k, value in whole.items()}
        return OneWorld(**own)

    def tensors(self) -> dict[str, Tensor]:
        """By name, detached: what `torch.save` writes and `read` reads."""
        return {f.name: getattr(self, f.name).detach() for f in fields(self)}

    @classmethod
    def read(cls, tensors: Mapping[str, Tensor]) -> TwinState:
        """Errors: DataError naming what is missing or unknown."""
        names = {f.name for f in fields(cls)}
        if not isinstance(tensors, Mapping) or set(tensors) != names:
            found = ", ".join(map(str, tensors)) if isinstance(tensors, Mapping) else shown(tensors)
            raise DataError(f"state: expected {', '.join(sorted(names))}, found {found}")
        return cls(**tensors)


class OneWorld(TwinState):
    """Of one of many worlds, whose solids the twin itself does not know."""


def in_order(states: Sequence[TwinState]) -> bool:
    """Whether they are states of one body and world, in the order of time, equally far apart."""
    times = torch.tensor([float(each.time) for each in states], dtype=torch.float64)
    apart = times.diff()
    alike = all(each.x.ndim == 2 and each.x.shape == states[0].x.shape for each in states)
    even = (apart > 0).all() and ((apart - apart[:1]).abs() < 1e-6 * apart).all()
    return len(states) > 0 and alike and bool(even)


def rollout_of(states: Sequence[TwinState]) -> Rollout:
    """The motion through T states as a rollout without reactions, whose times begin at 0 s."""
    names = "positions", "v", "F", "F_tot", "time"
    parts = ([getattr(each, name).detach() for each in states] for name in names)
    x, v, F, F_tot, times = map(torch.stack, parts)
    last = ParticleState(*(getattr(states[-1], name).detach() for name in State._fields))
    counts = torch.stack([each.substeps for each in states]).diff().tolist()
    return Rollout(x.to(v), v, F, F_tot, (times - times[0]).to(v), last, counts=tuple(counts))


def placed_as(states: Sequence[TwinState], solids: Sequence[Collider]) -> tuple[Collider, ...]:
    """K solids where they are in the states."""
    names = "collider_position", "collider_rotation"
    x, R = (torch.stack([getattr(state, n).detach() for state in states]) for n in names)
    ways = (Trajectory(a, turned, 0 * a, 0 * a) for a, turned in zip(x.unbind(1), R.unbind(1)))
    return tuple(replace(solid, motion=way) for solid, way in zip(solids, ways))


class Stepped(NamedTuple):
    """What a step returns. reactions: (substeps, K, 6) force [N] and torque about the collider's origin [N m] that the body exerts
    on each collider, (substeps, B, K, 6) of B worlds, None without colliders; `.mean(0)` is the step's."""

    state: TwinState
    reactions: Tensor | None

    __repr__ = in_brief


class Episode:
    """The motion of a body from a start, or from one in each of B worlds.

    starts: one, or B of them; laws: (B, numbers) of the body as `identification.read_numbers` gives them, None for the body's own
    in all worlds; gravity: (B, 3) [m/s^2], None for the world's. frames: whose fall the time step allows for, as `Body.simulate`;
    differentiable: whether gradients go through; other arguments as `Body.simulate`. Errors: ConfigError.
    """

    def __init__(
        self, body: Body, world: World, frame_dt: float, starts: Start | Sequence[Start], *, variant: str = "adapted",
        frames: int = 30, substeps: int | None = None, laws: Tensor | None = None, gravity: Tensor | None = None,
        differentiable: bool = False, together: int | None = None,
    ) -> None:  # fmt: skip
        self.world, self.colliders = world, world.solids
        self.frame_dt, self.differentiable = frame_dt, differentiable
        self.worlds = None if isinstance(starts, Start) else len(starts)
        self.names = [collider.name or str(i) for i, collider in enumerate(world.solids)]
        if twice := sorted({name for name in self.names if self.names.count(name) > 1}):
            raise ConfigError(
                f"colliders: expected names of their own, found {', '.join(twice)} more than once"
            )
        options = {"frames": frames, "frame_dt": frame_dt, "substeps": substeps, "enough": True}
        options["model"] = body.model(variant)
        with self._gradients():
            if self.worlds is None:
                ready = body.ready(starts, world, **options)
                more = {"timing": ready.timing}
            else:
                ready, self._begin = _worlds(body, world, starts, laws, gravity, options)
                more = {"gravity": gravity, "together": together}
            self._lifts, motions = ready.lift, ready.motions(self.colliders)
            # once: a step shall not wait for a GPU to say it
            self._raised = ready.lift.double().cpu()
            self._motions = motions if ready.lift.ndim > 1 else [motions]
            self._stepper, moment = ready.simulator.stepper(
                ready.state, **ready.arguments, motions=motions, steps=frames, **more
            )
            self._driven = torch.zeros(len(self.colliders), dtype=torch.bool)
            self._moment, self._poses = moment, self._placed(moment, 0)
            self._starts, self._first = starts, self._poses
            self._crossings = None if self.worlds is not None else Crossings(self.colliders)
            self._look()
            self._said: dict[int, Tensor] = {}  # rotation vectors of the last actions

    @property
    def substeps(self) -> int | None:
        """Of every step, None where they are chosen."""
        return None if self._stepper.clock.varies else self._stepper.clock.count

    @property
    def state(self) -> TwinState:
        """Where the motion is now. Setting it goes on from another moment of this motion, or of one with the same body, colliders
        and time step. Errors: ConfigError naming the tensor that does not fit."""
        moment = self._moment
        numbers = {"frames": moment.frames, "substeps": moment.substeps}
        times = {"time": moment.frames * self.frame_dt, "lag": moment.lag}
        return TwinState(
            *State.of(self._stepper.axes.world.state(moment.state)), self._lifts, *self._poses, self._driven,
            **{k: torch.tensor(v) for k, v in numbers.items()},
            **{k: torch.tensor(v, dtype=torch.float64) for k, v in times.items()},
        )  # fmt: skip

    @state.setter
    def state(self, state: TwinState) -> None:
        if not isinstance(state, TwinState):
            raise ConfigError(
                f"state: expected a TwinState (TwinState.read makes one of tensors), found {type(state).__name__}"
            )
        now = self.state
        for f in fields(TwinState):
            found, known = getattr(state, f.name), getattr(now, f.name)
            if not dense(found) or found.shape != known.shape or found.dtype != known.dtype:
                raise ConfigError(
                    f"state.{f.name}: expected a dense tensor {known.dtype} {tuple(known.shape)}, "
                    f"found {shown(found)}"
                )
            if not bool(torch.isfinite(found.detach()).all()):
                raise ConfigError(
                    f"state.{f.name}: expected finite numbers, found {found[~torch.isfinite(found)][0]}"
                )
        if self._stepper.prepared.numerics.check_J and float(torch.linalg.det(state.F).min()) <= 0:
            raise ConfigError("state.F: expected det F > 0, which the law needs, found less")
        if self.colliders:
            turned = state.collider_rotation
            rotation_matrices(turned, turned.ndim - 2)
        for name in ("frames", "substeps"):
            # as far as times have them exactly
            if not 0 <= int(found := getattr(state, name)) <= 2**53:
                raise ConfigError(
                    f"state.{name}: expected a whole number of at least 0 and at most 2^53, found {int(found)}"
                )
        frames, time = int(state.frames), float(state.time)
        if not math.isclose(time, frames * self.frame_dt, abs_tol=1e-9 * self.frame_dt):
            raise ConfigError(
                f"state.time: expected {frames} steps of {self.frame_dt:g} s, found {time:g} s: reset with the control_dt "
                "that the state was made with"
            )
        particles = ParticleState(
            *(getattr(state, name).to(now.x.device) for name in State._fields)
        )
        particles = entered(
            particles, self._stepper.axes, particles.v.dtype, self._stepper.prepared.numerics.dx
        )
        # own motions go by time, and the other reset may have had other substeps
        done = int(state.substeps) if self.substeps is None else frames * self.substeps
        self._moment = Moment(particles, done, frames, float(state.lag))
        self._driven = state.driven.cpu()
        self._poses = state.collider_position.cpu(), state.collider_rotation.cpu()

    def step(self, action: Mapping[str, Any] | None = None) -> Stepped:
        """One step on. action: by the names of colliders, see `Twin.step`. Errors: ConfigError naming the collider, before anything
        moves; SimulationDiverged."""
        if not self.differentiable:
            check_wants_no_gradients(action=action)
        with self._gradients():
            commands = self._checked({} if action is None else action)
            driven = self._driven.clone()
            driven[list(commands)] = True
            speed = None if not bool(driven.any()) else self._speed(commands, driven)
            after = []

            def poses(count: int, dt: float) -> Poses:
                found, ends = self._along(commands, driven, count, dt)
                after.append(ends)
                return found

            wanted = poses if self.colliders else None
            moment, reactions, _ = self._stepper.step(self._moment, wanted, speed)
            self._moment, self._driven = moment, driven
            self._poses = after[0] if after else self._poses
            self._look()
            return Stepped(self.state, reactions)

    def restart(self, which: Sequence[int], starts: Sequence[Start] | None = None) -> TwinState:
        """Put some worlds back to a start, each to its own of `starts`, None for those it had; the others stay as they are. Time
        is one for all and goes on: driven colliders are back where they began, others follow their motion. Errors: ConfigError.
        """
        assert self.worlds is not None
        if not all(0 <= b < self.worlds for b in which):
            raise ConfigError(
                f"restart: expected numbers of worlds below {self.worlds}, found {list(which)}"
            )
        holding = [each for each in self.world.driven if each.held]
        for each, moved in zip(holding, self._driven[len(self.world.colliders) :]):
            if self._moment.frames and not moved and each.motion.max_speed(1.0) > 0:
                raise ConfigError(
                    f"restart: expected driven sets at rest or moved by actions, found {each.name} on a motion of its own, "
                    "which does not begin again: reset all worlds"
                )
        moment, chosen = self._moment, torch.zeros(self.worlds, dtype=torch.bool)
        chosen[list(which)] = True
        starts = [self._starts[b] for b in which] if starts is None else starts
        again = dict(zip(which, starts, strict=True))
        with self._gradients():
            moved = chosen[:, None] & self._driven  # solids that are back
            poses = tuple(torch.where(moved.view(*moved.shape, *(1,) * (first.ndim - 2)), first, now)
                          for first, now in zip(self._first, self._poses))  # fmt: skip
            now = moment.state.worlds()
            spacing = float(self._stepper.prepared.lanes.solvers[0].volume.mean()) ** (1 / 3)
            for b in again:
                begun, lift = self._begin(b, again[b], True), self._raised.expand(self.worlds, 3)[b]
                check_clear(self.colliders, begun.x.detach().cpu() - lift, f"the body of world {b}", "colliders", spacing,
                            tuple(part[b] for part in poses))  # fmt: skip
                if self.world.driven and not begun.x.equal(self._begin(b, self._starts[b]).x):
                    raise ConfigError(
                        f"starts[{b}]: expected the pose of the reset, where the driven sets chose their particles, found "
                        "another: reset all worlds"
                    )
                dx = self._stepper.prepared.numerics.dx
                now[b] = entered(begun, self._stepper.axes, now[b].x.dtype, dx)
            fresh = ParticleState.stack(now)
            if moment.substeps:  # F goes before its velocities by one advance
                parts = self._stepper.prepared.first_advance(flat(fresh), self._stepper.clock.dt)
                fresh = ParticleState(*(t.unflatten(0, (self.worlds, -1)) for t in parts))
            pairs = ((getattr(fresh, n), getattr(moment.state, n)) for n in State._fields)
            state = ParticleState(*(_where(chosen, *pair) for pair in pairs))
            self._poses, self._moment = poses, moment._replace(state=state)
            return self.state

    def _look(self) -> None:
        """Of one world alone."""
        if self._crossings is not None:
            self._crossings.look(*self._poses)

    def _gradients(self):
        return torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled())

    def _leading(self) -> tuple[int, ...]:
        return () if self.worlds is None else (self.worlds,)

    def _placed(self, moment: Moment, after: int, dt: float | None = None) -> tuple[Tensor, Tensor]:
        """(position, rotation) of all colliders on their own motions, `after` substeps after `moment`, where they are seen."""
        if not self.colliders:
            none = torch.zeros(*self._leading(), 0, 3, 3).double()
            return none[..., 0], none
        found = self._own(moment, 1, self._stepper.clock.dt if dt is None else dt, after)
        return found.position[0] - self._raised.unsqueeze(-2), found.rotation[0]

    def _own(self, moment: Moment, count: int, dt: float, after: int = 0) -> Poses:
        """(S, [B,] K, ...) of the colliders' own motions, where the simulation sees them."""
        sample = self._stepper.sample
        each = [sample(moment, count, dt, motions, after) for motions in self._motions]
        if self.worlds is None:
            return each[0]
        if len(each) == 1:
            shape = self.worlds
            return Poses(*(part[:, None].expand(-1, shape, *part.shape[1:]) for part in each[0]))
        return Poses(*(torch.stack(parts, 1) for parts in zip(*each)))

    def _along(
        self, commands: dict[int, dict], driven: Tensor, count: int, dt: float
    ) -> tuple[Poses, tuple[Tensor, Tensor]]:
        """(poses at the step's substeps, (position, rotation) after it)."""
        own, ends = None, None
        if not bool(driven.all()):
            own, ends = self._own(self._moment, count, dt), self._placed(self._moment, count, dt)
        columns, last = [], []
        rest = (1,) * (1 + len(self._leading()))
        times = dt * torch.arange(count, dtype=torch.float64).view(-1, *rest)
        for k in range(len(self.colliders)):
            if not driven[k]:
                columns.append([part.select(1 + len(self._leading()), k) for part in own])
                last.append([part.select(len(self._leading()), k) for part in ends])
                continue
            x, R = (part.select(len(self._leading()), k) for part in self._poses)
            v, w, end = self._twist(commands.get(k, {}), x, R)
            turns = w.requires_grad or bool((w != 0).any())
            turned = exponential(times * w) @ R if turns else R.expand(count, *R.shape)
            speeds = v.expand(count, *x.shape), w.expand(count, *x.shape)
            columns.append([x + times * v + self._raised, turned, *speeds])
            after = exponential(self.frame_dt * w) @ R if turns else R
            last.append([end.get("position", x + self.frame_dt * v), end.get("rotation", after)])
        axis = 1 + len(self._leading())
        # of one collider without a copy: what is the same at all substeps stays one row
        poses = Poses(
            *(torch.stack(p, axis) if len(p) > 1 else p[0].unsqueeze(axis) for p in zip(*columns))
        )
        return poses, tuple(torch.stack(parts, axis - 1) for parts in zip(*last))

    def _twist(
        self, command: dict[str, Tensor], x: Tensor, R: Tensor
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """(velocity, angular velocity, pose after the step where it was said) of a driven collider at x (3,), R (3, 3)."""
        zero = torch.zeros_like(x)
        v, w, end = command.get("velocity", zero), command.get("angular_velocity", zero), {}
        if "position" in command:
            end["position"] = command["position"].expand_as(x)
            v = (end["position"] - x) / self.frame_dt
        if "rotation" in command:
            end["rotation"] = command["rotation"].expand_as(R)
            known = command.get("turn")
            w = (
                rotation_vector(end["rotation"] @ R.mT) if known is None else known
            ) / self.frame_dt
        return v.expand_as(x), w.expand_as(x), end

    def _speed(self, commands: dict[int, dict], driven: Tensor) -> float:
        """Bound of the colliders' speeds in this step [m/s]."""
        fastest = 0.0
        for k, collider in enumerate(self.colliders):
            far = reach(collider.shape)
            if not driven[k]:
                fastest = max(fastest, collider.motion.max_speed(far))
            elif k in commands:
                pose = (part.select(len(self._leading()), k).detach() for part in self._poses)
                v, w = (each.detach() for each in self._twist(commands[k], *pose)[:2])
                fastest = max(fastest, float((v.norm(dim=-1) + far * w.norm(dim=-1)).max()))
        return fastest

    def _checked(self, action: Mapping[str, Any]) -> dict[int, dict[str, Tensor]]:
        """By the collider's number: float64 tensors on the CPU. Errors: ConfigError."""
        if not isinstance(action, Mapping):
            raise ConfigError(
                f"action: expected commands by the names of colliders, found {action!r}"
            )
        commands = {}
        for name, command in action.items():
            if name not in self.names:
                known = ", ".join(self.names) or "none, as there are no colliders"
                raise ConfigError(f"action: expected names of colliders ({known}), found {name!r}")
            where = f"action[{name!r}]"
            if not isinstance(command, Mapping):
                command = {"velocity": command}
            if not command or not (set(command) <= set(TWISTS) or set(command) <= set(TARGETS)):
                found = ", ".join(map(str, command)) or "nothing"
                raise ConfigError(
                    f"{where}: expected {' and '.join(TWISTS)}, or {' and '.join(TARGETS)} after "
                    f"the step, or one of them, found {found}"
                )
            k, given = self.names.index(name), command.get("rotation")
            commands[k] = {kind: self._vector(f"{where}.{kind}", v) for kind, v in command.items()}
            said = None if given is None else torch.as_tensor(given, dtype=torch.float64).cpu()
            if said is None or said.shape[-2:] == (3, 3):
                continue
            if bool((said.detach().norm(dim=-1) > math.pi - 1e-6).any()):
                # half a turn or more, from what was said last where that is where the solid is
                R, last = self._poses[1].select(len(self._leading()), k), self._said.get(k)
                if last is None or not torch.allclose(exponential(last).expand_as(R), R):
                    last = rotation_vector(R)
                commands[k]["turn"] = turning(last, said)
            self._said[k] = said
        return commands

    def _vector(self, where: str, value: Any) -> Tensor:
        """(3,) or (B, 3), rotations as matrices."""
        batches = [(), *([] if self.worlds is None else [(self.worlds,)])]
        kinds = [(3,), (3, 3)] if where.endswith(".rotation") else [(3,)]
        shapes = [(*batch, *kind) for batch in batches for kind in kinds]
        expected = f"finite numbers {' or '.join(map(str, shapes))}"
        found = numbers(where, value, expected, *shapes, dtype=torch.float64).cpu()
        if not where.endswith(".rotation"):
            return found
        # (3, 3) is a matrix also where there are three worlds
        leading = found.ndim - (2 if found.ndim > 1 and found.shape[-2:] == (3, 3) else 1)
        try:
            return rotation_matrices(found, leading)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error


class InMotion:
    """What `Twin` and `TwinWorlds` share: the motion that `reset` began, step by step."""

    _episode: Episode | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the motion, whose buffers cannot be copied: a copy is reset, and may be given the `state`."""
        return self.__dict__ | {"_episode": None}

    def step(self, action: Mapping[str, Any] | None = None) -> Stepped:
        """Go one step on: (state, reactions), see `mosa.twin.episode`.

        action: for colliders by name (their number as a text where they have none), either `velocity` (3,) [m/s] and
        `angular_velocity` (3,) [rad/s] in world axes, about the collider's origin, for this step, or the `position` (3,) [m] and
        `rotation` ((3,) vector [rad] or (3, 3)) where it shall be after it; three numbers alone are a velocity. A collider that
        was never in an action follows its own motion; one that was, but is not in this one, stands still.
        Errors: ConfigError naming the collider, what was expected and found; SimulationDiverged."""
        return self.episode.step(action)

    @property
    def episode(self) -> Episode:
        """The motion that `reset` began. Errors: ConfigError before that."""
        if self._episode is None:
            raise ConfigError("twin: expected reset(...) before step and state, found no motion")
        return self._episode

    @property
    def state(self) -> TwinState:
        """Of the motion now; set it to go back to an earlier one, or to branch. `state.tensors()` are plain tensors to save, and
        `TwinState.read` makes them a state again, after a reset with the same arguments."""
        return self.episode.state

    @state.setter
    def state(self, state: TwinState) -> None:
        self.episode.state = state


def _where(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """new in the worlds that are chosen (B,), old in the others."""
    return torch.where(chosen.to(old.device).view(-1, *(1,) * (old.ndim - 1)), new, old)


def _worlds(
    body: Body,
    world: World,
    starts: Sequence[Start],
    laws: Tensor | None,
    gravity: Tensor | None,
    options: dict,
) -> tuple[Ready, Callable[..., ParticleState]]:
    """(all worlds, with a lift (3,) [m] where it is the same in all; the state of a world at a start)."""
    if body.settings.adaptive:
        raise ConfigError(
            "simulation.adaptive: expected false with many worlds, which take the same substeps"
        )
    if (adapter := options["model"].adapter) is not None and adapter.own_dynamics:
        raise ConfigError(
            "worlds: expected a law, found an adapter that moves the particles itself, in whole rollouts (Twin.simulate)"
        )
    if laws is not None and options["model"] != body.model():
        raise ConfigError("laws: expected those of variant adapted, found another variant")
    if gravity is None:
        pulls = [world.gravity.to(body.rest)] * len(starts)
    else:
        pulls = list(gravity.to(body.rest))
    time = options["frames"] * options["frame_dt"]
    pairs = ((start, replace(world, gravity=pull)) for start, pull in zip(starts, pulls))
    # the time step is one for all
    quick = max(pairs, key=lambda each: each[1].fastest(each[0], body.size, time))
    ready_with = partial(body.ready, *quick)
    if laws is None:
        found = [ready_with(**options)]
    else:
        counts = [ready_with(**options).simulator.substeps for _ in each_law(body, laws)]
        fixed = options | {"substeps": max(counts)}
        if max(counts) >= 2 * min(counts):
            told = f"laws: all worlds take {max(counts)} substeps, as the stiffest; alone, world {counts.index(min(counts))} takes "
            warnings.warn(f"{told}{min(counts)} and bounces higher (docs/twin.md)", stacklevel=5)
        found = [ready_with(**fixed).answered() for _ in each_law(body, laws)]
    first = found[0].simulator
    own = first.law.name, first.substeps, first.frame_dt, world, first.numerics.energetic
    simulator = body.simulator(*own)

    most = 0.5 * first.numerics.dx / first.dt

    def begin(b: int, start: Start, again: bool = False) -> ParticleState:
        if again:  # the substeps were chosen for the speeds of the reset
            falls = replace(world, gravity=pulls[b], colliders=())
            if (speed := falls.fastest(start, body.size, time)) > (1 + 1e-6) * most:
                raise ConfigError(
                    f"starts[{b}]: expected one from which the body gets no faster than {most:.3g} m/s, half a cell per "
                    f"substep, found up to {speed:.3g}: reset all worlds, with it or with more substeps"
                )
        state = body.initial_state(start, simulator.dt, pulls[b])
        state = replace(state, x=state.x + found[b % len(found)].lift)
        return state.to(simulator.dtype)

    ready = found[0] if laws is None else Ready.stack(found)
    states = [begin(b, start) for b, start in enumerate(starts)]
    arguments = ready.arguments
    if world.driven:  # particles of its own in each world, which may start elsewhere
        places = [state.x - found[b % len(found)].lift for b, state in enumerate(states)]
        each = [body.driven(world, x, start) for x, start in zip(places, starts)]
        join: dict[str, Callable] = {"held": stack_held, "density": torch.stack}
        own = {name: join[name]([given[name] for given in each]) for name in each[0]}
        arguments = {**arguments, **own}
    state = ParticleState.stack(states)
    return replace(ready, simulator=simulator, state=state, arguments=arguments), begin
