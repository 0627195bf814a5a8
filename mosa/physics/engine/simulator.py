"""The simulator: frames of MLS-MPM from a start, a law and its parameters, with or without an adapter.

State convention: after n substeps a state holds (x^n, v^n, C_affine^n, F^{n+1}, F_tot^{n+1}); F is advanced right after its
C_affine is known, so that F belongs to x and is known when a substep starts. One substep is then stress(F) -> P2G -> grid ->
G2P -> x += dt v -> F <- map((I + dt C_affine) F), and a rollout starts with one advance of F by the initial C_affine. This is
the usual order, F first in a substep, cut at another place (docs/decisions.md, "Order of a substep").
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from annotated_types import Ge, Le
from pydantic import InstanceOf
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.adapters.interface import AdapterOperator, MaterialState, Several, ask
from mosa.physics.constitutive.laws import law_named
from mosa.physics.constitutive.plasticity import YIELD_CONVENTIONS
from mosa.physics.contact.colliders import Collider, Particles, pack_colliders, reach
from mosa.physics.contact.driven import Held, hold, stack_held
from mosa.physics.contact.motion import Points
from mosa.physics.contact.planes import Plane, ground_plane, pack_planes
from mosa.physics.engine import inputs
from mosa.physics.engine.axes import Axes, shift_to, turn_along
from mosa.physics.engine.buffers import Buffers
from mosa.physics.engine.lanes import Lanes
from mosa.physics.engine.law_options import AS_USUAL, LawOptions
from mosa.physics.engine.material_operations import material_state
from mosa.physics.engine.numerics import Numerics, flat
from mosa.physics.engine.solver import SegmentSolver
from mosa.physics.engine.stepping import Prepared, Stepper
from mosa.physics.grid.window import extent
from mosa.physics.launching import SCALARS
from mosa.physics.time.clock import Adaptive, Clock, Moment
from mosa.physics.time.time_step import MOST_SUBSTEPS
from mosa.settings import Count, Expected, Number, Positive, Text, shown, such, typed
from mosa.system.limits import counted, named_device
from mosa.types import Ground, ParticleState, Rollout, dense

Substeps = Annotated[int, Ge(1), Le(MOST_SUBSTEPS)]
Planes = Annotated[Sequence[InstanceOf[Plane]], Expected("a list of Planes")]
Colliders = Annotated[Sequence[InstanceOf[Collider]], Expected("a list of Colliders")]
Motions = Annotated[Sequence[Any], Expected("a motion for each collider, or such a list a world")]
State = Annotated[ParticleState, InstanceOf, Expected("a ParticleState of dense tensors"),
                  such(lambda state: all(map(dense, vars(state).values())))]  # fmt: skip
Values = Annotated[dict[str, Any], Expected("values of a law by their names")]
Array = Annotated[Tensor, InstanceOf, such(dense), Expected("a dense tensor")]
Asked = Annotated[Callable[[MaterialState], AdapterOperator] | Sequence[Callable[..., Any]],
                  Expected("a function of a MaterialState, or one for each world")]  # fmt: skip
Timing = Annotated[Adaptive, InstanceOf, Expected("an Adaptive")]
Scalar = Annotated[torch.dtype, InstanceOf, such(lambda t: t in SCALARS),
                   Expected("torch.float32 or torch.float64")]  # fmt: skip
Handed = Annotated[Held, InstanceOf, Expected("a Held")]
NEAR = 8
"""Cells from the origin within which driven particles of float32 may move before the origin follows
them, with new buffers."""


class _Asked(NamedTuple):
    """Arguments that `Simulator.rollout` and `Simulator.stepper` share, which say what they are. frames: None for any number."""

    parameters: dict[str, Any]
    volume: Tensor
    density: float | Tensor
    adapter: Any
    stride: int | None
    motions: Sequence | None
    gravity: Tensor | Sequence | None
    together: int | None
    timing: Adaptive | None
    started: bool
    held: Held | None
    frames: int | None = None
    collect: Callable[[Any], None] | None = None
    start_time: float = 0.0


class Simulator:
    """MLS-MPM of one law on one grid and time step. Rollouts are differentiable in state, parameters and adapter outputs.

    dx: grid spacing [m]; substeps per frame of frame_dt [s]; gravity (3,) [m/s^2]; ground: plane below `up` ((3,), against
    gravity by default), then `planes` in order, then the moving `colliders`; box: (2, 3) [m] corners a particle may not leave,
    None for no limit. It computes in axes of its own (`axes`): planes that nodes meet have to be at right angles.
    energetic: what adapters answer is a stiffness G in units of 2 mu, of the energy mu E : G : E of Green's strain that is added to
    1 + h[0] times the prior's; else an operator on the prior's stress. options: how the law is taken.
    Errors: ConfigError naming the argument. Not safe for use by two threads: buffers are shared between rollouts."""

    @typed
    def __init__(
        self, law: Text, *, dx: Positive, substeps: Substeps, frame_dt: Positive,
        gravity: Sequence[float] | Tensor = (0.0, -9.8, 0.0),
        ground: Annotated[Ground, InstanceOf, Expected("a Ground")] | None = None,
        up: Sequence[float] | Tensor | None = None, planes: Planes = (), colliders: Colliders = (),
        box: Tensor | None = None, dtype: Scalar = torch.float32,
        device: torch.device | str = "cpu", energetic: bool = False,
        options: Annotated[LawOptions, InstanceOf, Expected("LawOptions")] = AS_USUAL,
    ) -> None:  # fmt: skip
        self.law = law_named(law)
        inputs.vector("gravity", gravity)
        if up is not None and not inputs.vector("up", up).any():
            raise ConfigError(f"up: expected a direction (x, y, z), found {up}")
        if energetic and not self.law.sheared:
            raise ConfigError(
                f"energetic: expected a law with a shear modulus mu, found {law!r}: stiffness is in units of 2 mu"
            )
        self.substeps, self.frame_dt = int(substeps), float(frame_dt)
        self.dt = self.frame_dt / self.substeps
        self.dtype, self.device = dtype, torch.device(named_device(device))
        self.options = options
        gravity = torch.as_tensor(gravity, dtype=torch.float64).cpu()
        if up is None:
            up = -gravity / gravity.norm() if gravity.norm() > 0 else torch.tensor([0.0, 1.0, 0.0])
        all_planes = ([ground_plane(ground, up)] if ground is not None else []) + list(planes)
        axes = self._axes = Axes(turn_along(all_planes))
        values, modes = pack_planes(all_planes, torch.float64, torch.device("cpu"), float(dx))
        self.colliders = tuple(colliders)
        packed_colliders = (
            pack_colliders(self.colliders, dtype, self.device) if self.colliders else None
        )
        sets = [c for c in self.colliders if isinstance(c.shape, Particles)]
        if list(self.colliders[len(self.colliders) - len(sets) :]) != sets:
            raise ConfigError("colliders: expected sets of driven particles after all solids")
        touching = any(plane.mode == "touch" for plane in all_planes)
        # a ground that particles meet yields a little, and the box may end at it
        box = inputs.corners(box, float(dx) if touching else 0.0)
        # one askew is looked at by `Stepper.through`
        low, high = box if axes.turn is None else inputs.corners(None)
        self.numerics = Numerics(
            law=self.law, dtype=dtype, device=self.device, dx=float(dx), dt=self.dt,
            gravity=tuple(axes.vectors(gravity).tolist()), planes=values, modes=modes.to(self.device), plane_count=len(all_planes),
            touching=touching, low=low, high=high, box=box, norm_eps=float(options.norm_eps), rebuild=options.rebuild,
            check_J=self.law.needs_positive_J or options.on_inversion == "error",
            colliders=packed_colliders, energetic=energetic, driven=len(sets),
            moduli=self.law.moduli_slots if options.mean_volume else None,
            points=sum(c.motion.points.shape[1] for c in sets if isinstance(c.motion, Points)),
        )  # fmt: skip
        values[:, :3] = axes.vectors(values[:, :3])
        self._planes, self._limits = values, torch.tensor((low, high), dtype=torch.float64)
        self._move(None)
        # each stretch of motion costs a look at the host, and on CUDA waits for it; a CPU gains nothing
        self.gathers = self.device.type == "cuda"
        # no method: the cycle would keep a dropped simulator's buffers until the garbage collector looks
        self._ask = partial(ask, self.law, dtype)

    @typed
    def pack(
        self,
        parameters: Values,
        particles: Count,
        rotation: Tensor | None = None,
        worlds: Count | None = None,
    ) -> Tensor:
        """(N, SLOTS) parameters in the law's order. Values: numbers, (N,), () or, for vectors of k numbers, (N, k) or (k,).

        rotation: (N, 3, 3), fills the law's reference rotation. worlds: (W N, SLOTS), one world's after the other's; values may
        then also be (W, N) or (W, 1), vectors (W, N, k) or (W, 1, k). Errors: ConfigError naming a missing, unknown or misshapen
        one."""
        return self._packed(parameters, particles, rotation, worlds)

    def _packed(
        self, parameters: dict, particles: int, rotation: Tensor | None, worlds: int | None
    ) -> Tensor:
        """`pack`, of arguments that were looked at already."""
        shape = (particles,) if worlds is None else (worlds, particles)
        like = self.numerics.planes  # of its type and on its device
        factor = YIELD_CONVENTIONS[self.options.yield_convention]
        return inputs.pack_parameters(
            self.law, parameters, shape, like, rotation=rotation, yield_factor=factor
        )

    @typed
    def rollout(
        self, state: State, parameters: Values, volume: Array, density: float | Tensor,
        frames: Count, adapter: Asked | None = None, stride: Count | None = 1,
        progress: Callable[[int], None] | None = None, started: bool = False,
        motions: Motions | None = None, start_time: Number = 0.0, timing: Timing | None = None,
        collect: Callable[[Any], None] | None = None, gravity: Tensor | Sequence | None = None,
        together: int | None = None, held: Handed | None = None,
        after: Callable[[ParticleState, int], ParticleState] | None = None,
    ) -> Rollout:  # fmt: skip
        """`frames` frames, the start being frame 0 (so frames - 1 intervals are simulated), of a body, or of B worlds at once.

        state: particles at frame 0, x (N, 3) and so on, their F and F_tot not yet advanced by C_affine, unless `started` (the
        `final` of an earlier rollout). Far from the origin (1024 cells) x of the result is float64, and x of the state should be:
        float32 has a resolution of 1 mm at 10 km. parameters: physical values the law names, per particle (N,) or scalar; volume:
        (N,) [m^3]; density [kg/m^3]: number, (N,), or (B, N).
        adapter: asked every `stride` substeps from the start of each frame; None: once, at the start of the rollout (an operator
        that does not depend on the state). collect: called with `adapter.statistics()`, a named tuple of tensors, of every
        evaluation. progress: called with the number of each frame. Before an adapter that has `flow` is asked, F becomes
        flow(F (N, 3, 3), time until it is asked again [s]): plastic flow that a network has learned. On CUDA gradients reach the
        parameters of an adapter that is a torch module, not other tensors that it may use.
        motions: of the colliders, instead of their own; start_time [s]: time of frame 0 in these motions.
        timing: substeps that are chosen for each frame, instead of `substeps` in all (see `clock`).
        held: particles that the last colliders, sets of `Particles`, drive; None: their own
        indices, from where they are in `state`.
        after: called with the state after each frame but the last, (N, 3) or (B, N, 3) and so on, and the frame's number; the
        next frame begins from the state that it returns, and the result keeps the one that it was given.
        Frame 0 of the result holds the state as given. Errors: SimulationDiverged naming substep and particle; ConfigError.

        Worlds: copies of the body that never meet, with the fixed time step. state: x (B, N, 3) and so on; parameters: the same in
        all worlds, or (B, 1) or (B, N), vectors (B, 1, k) or (B, N, k). adapter: one for all worlds, which is asked for all
        particles, (B N, ...), or one for each. motions: of the colliders in every world, B sequences, or one of K for all.
        gravity: (B, 3) [m/s^2], where it is not the simulator's in all worlds. together: worlds that go through the same launches:
        all of them on a CUDA device, where they fill it, and one on a CPU, where as many worlds as there are cores advance at a
        time; it divides B. The result has x (T, B, N, 3) and so on, reactions (T - 1, substeps, B, K, 6): `Rollout.worlds` parts
        it. On a CPU each world has the bits of its own rollout, where gradients of what worlds share are summed over them.
        SimulationDiverged names the world: none of the others is returned."""
        asked = _Asked(parameters, volume, density, adapter, stride, motions, gravity, together, timing, started, held,
                       frames, collect, start_time)  # fmt: skip
        stepper, start = self._stepper(state, asked)
        poses, all_known = stepper.poses_of(frames, start_time)
        prepared, moment, varies = stepper.prepared, start, stepper.clock.varies
        current, frame = stepper.enter(start, not started)
        recorded = [flat(start.state)]
        count = (frames - 1) * self.substeps
        pace = prepared.begin(current, all_known, count, varies, gives=True)
        reactions, counts = [], []
        for number in range(1, frames):
            if number > 1:
                current, frame = stepper.enter(moment, False)
            alone = varies or self.colliders or after is not None
            alike = 0 if alone else frames - 1 - number
            moment, forces, count = stepper.through(
                moment, current, frame, poses(number - 1, frame), pace, alike
            )
            counts.append(count)
            if forces is not None:
                reactions.append(forces)
            recorded.append(moment.state)
            if after is not None and number < frames - 1:
                moment = stepper.replaced(moment, partial(after, number=number))
            if progress is not None:
                progress(number)
        names = ("x", "v", "F", "F_tot") if self.law.plastic else ("x", "v", "F")
        columns = stepper.apart(
            (torch.stack([getattr(each, name) for each in recorded]) for name in names), 1
        )
        inverted = int((_determinant(columns[2].detach()) <= 0).sum())
        world = stepper.axes.world
        x, v, *F = columns
        columns = [world.points(x), world.vectors(v), *map(world.gradients, F)]
        if inverted and self.options.on_inversion == "warn":
            found = f"{inverted} particle states with det F <= 0 in {frames} frames"
            warnings.warn(found, stacklevel=2)
        (forces,) = stepper.apart([torch.stack(reactions) if reactions else None], 2)
        return Rollout(
            *columns[:3], columns[-1], times=self.frame_dt * torch.arange(frames, dtype=self.dtype, device=self.device),
            final=world.state(ParticleState(*stepper.apart(moment.state if frames > 1 else current))), inverted=inverted,
            reactions=world.vectors(forces), counts=tuple(counts),
        )  # fmt: skip

    @typed
    def stepper(
        self, state: State, parameters: Values, volume: Array, density: float | Tensor,
        adapter: Asked | None = None, stride: Count | None = 1, *, started: bool = False,
        motions: Motions | None = None, gravity: Tensor | Sequence | None = None,
        together: int | None = None, timing: Timing | None = None, steps: Count = 30,
        held: Handed | None = None,
    ) -> tuple[Stepper, Moment]:  # fmt: skip
        """(what advances a body, or B of them, frame by frame, the moment to start from); arguments as `rollout`.

        timing: choose the substeps of every frame. steps: for which there shall be memory to keep all states, where a gradient is
        wanted; there may be more. Every step gives the bits of the same frame of a rollout. Errors: ConfigError."""
        asked = _Asked(parameters, volume, density, adapter, stride, motions, gravity, together, timing, started, held)  # fmt: skip
        stepper, moment = self._stepper(state, asked)
        stepper.prepared.give_memory(steps * self.substeps, torch.is_grad_enabled())
        return stepper, moment._replace(substeps=self.substeps if started else 0)

    def _stepper(self, state: ParticleState, asked: _Asked) -> tuple[Stepper, Moment]:
        """Errors: ConfigError."""
        gravity, timing, held = asked.gravity, asked.timing, asked.held
        worlds = None if state.x.ndim == 2 else inputs.count_of_worlds(state, asked.together)
        if worlds is not None and timing is not None:
            raise ConfigError(
                "timing: expected None with many worlds, which take the same substeps"
            )
        if worlds is None and (gravity is not None or asked.together is not None):
            raise ConfigError(
                "gravity and together: expected None without worlds; gravity is the simulator's"
            )
        if None not in (asked.collect, asked.adapter) and not hasattr(asked.adapter, "statistics"):
            raise ConfigError(
                f"collect: expected one adapter that has statistics(), found {shown(asked.adapter)}"
            )
        inputs.check_state(self.numerics, state, asked.volume)
        each = inputs.motions_of_worlds(asked.motions, self.colliders, worlds)
        if self.numerics.driven:
            held = self._held(held, state.x, each, asked.start_time)
        known = extent(state.x, state.v).double().numpy(force=True)
        if (shift := self._origin(state.x, known[..., :6], held)) != self._axes.shift:
            self._move(shift)
        axes, given = self._axes, state
        state = axes.state(state, self.dtype)
        if not asked.started:
            own = known[..., :6] if axes == Axes() else extent(state.x).numpy(force=True)
            inputs.check_above(self._walls, own, state.x)
        gravities = None
        if worlds is not None:
            gravities = inputs.gravity_of_worlds(gravity, worlds, self.numerics.gravity)
        if gravity is not None:
            turned = axes.vectors(torch.tensor(gravities, dtype=torch.float64))
            gravities = tuple(map(tuple, turned.tolist()))
        prepared = self._prepare(state, asked, worlds, gravities, held)
        if worlds is None:
            # where the axes differ the particles are in other memory, and it looks again
            prepared.lanes.solvers[0].know((given.x, given.v), known[None])
        choose = None
        if timing is not None:
            solids = max(
                (m.max_speed(reach(c.shape)) for m, c in zip(each[0], self.colliders)), default=0.0
            )
            density = asked.density
            density = density if isinstance(density, Tensor) and density.ndim else float(density)
            choose = timing.chooser(
                self.numerics, asked.parameters, prepared.packed, density, self.frame_dt, solids
            )
        clock = Clock(self.frame_dt, self.substeps, None if asked.frames == 1 else choose)
        moment = Moment(
            self._begun(state, asked.started), lag=0.0 if timing is None else timing.lag
        )
        return Stepper(prepared, worlds, clock, each, axes, self.colliders), moment

    def _move(self, shift: tuple[float, ...] | None) -> None:
        """The origin of its axes. A stepper that was made before goes on with its own numerics and buffers."""
        offset = torch.tensor(shift or (0.0, 0.0, 0.0), dtype=torch.float64)
        planes = self._planes.clone()
        planes[:, 3] -= planes[:, :3] @ offset
        self._walls = planes[: self.numerics.plane_count, :4].numpy()
        low, high = map(tuple, (self._limits - offset).tolist())
        self.numerics = replace(
            self.numerics, planes=planes.to(self.device, self.dtype), low=low, high=high
        )
        self._axes, self.buffers = replace(self._axes, shift=shift), Buffers()

    def _prepare(
        self, state: ParticleState, asked: _Asked, worlds: int | None, gravities: Sequence[tuple] | None, held: Held | None
    ) -> Prepared:  # fmt: skip
        """What a rollout needs besides its state. Errors: ConfigError."""
        every, each = (asked.frames or 1, *state.x.shape[:-1]), 4 * (3 + 3 + 9 + 9)
        counted("particles of all frames", every, "take fewer", each=each)
        volume = inputs.without_gradients("volume", asked.volume).contiguous()
        adapter, stride = asked.adapter, asked.stride
        F = state.F if worlds is None else state.F.flatten(0, 1)
        rotation = inputs.polar_rotation(F) if self.law.reference is not None else None
        packed = self._packed(asked.parameters, len(volume), rotation, worlds)
        density, mean_mass = inputs.checked_density(asked.density, volume, self.law, packed, worlds)
        cutoff = self.options.mass_cutoff
        if cutoff is None:
            cutoff = 0.0 if self.dtype == torch.float64 else 1e-12 * mean_mass
        if worlds is None:
            solvers = [SegmentSolver(self.numerics, volume, density, cutoff, None, None, held)]
        else:
            size = asked.together or (worlds if self.device.type == "cuda" else 1)
            volume = volume.repeat(size)
            own = density.expand(worlds, -1) if isinstance(density, Tensor) else None
            solvers = [
                SegmentSolver(self.numerics, volume, density if own is None else own[i : i + size].flatten(), cutoff,
                              gravities[i : i + size], i, held and Held(*(t[i : i + size].flatten(0, 1) for t in held)))
                for i in range(0, worlds, size)
            ]  # fmt: skip
        if isinstance(adapter, Sequence):
            adapter = Several(adapter, worlds or 1)
        if adapter is not None and stride is not None and self.numerics.moduli is not None:
            raise ConfigError(
                "prior.options.mean_volume: expected an adapter whose operator does not depend on the state "
                f"(adapter=operator), found {type(adapter).__name__}, which would read each particle's own volume"
            )
        lanes = Lanes(solvers, self.buffers)
        return Prepared(
            self.numerics, self._ask, lanes, packed, adapter, stride, asked.collect, self.gathers
        )

    def _origin(self, x: Tensor, bounds: np.ndarray, held: Held | None) -> tuple[float, ...] | None:
        """Of the axes for particles at x. In float32 it is near driven particles: what they give
        way by under load is little more than the last digit of a place far away, and what is
        rounded off would let them creep."""
        axes, dx = self._axes, self.numerics.dx
        if held is None or not self.numerics.driven or self.dtype == torch.float64:
            return shift_to(bounds, x.dtype, axes.turn, dx)
        center = Axes(axes.turn).vectors(x.detach()[held.sets >= 0].double().mean(0).cpu())
        now = torch.tensor(axes.shift or (0.0, 0.0, 0.0), dtype=torch.float64)
        if float((center - now).abs().max()) <= NEAR * dx:
            return axes.shift
        return tuple((dx * torch.round(center / dx)).tolist())

    def _held(self, held: Held | None, x: Tensor, motions: Sequence, start: float) -> Held:
        """Of all particles, in the simulator's type and on its device. Errors: ConfigError."""
        solids = len(self.colliders) - self.numerics.driven
        if held is None:
            indices = [collider.shape.indices for collider in self.colliders[solids:]]
            if any(each is None for each in indices):
                raise ConfigError("held: expected the particles of the driven sets, found None")
            places = [x] if x.ndim == 2 else list(x)
            own = motions if len(motions) == len(places) else list(motions) * len(places)
            pairs = zip(own, places, strict=True)
            found = [hold(indices, each[solids:], place, solids, start) for each, place in pairs]
            held = found[0] if x.ndim == 2 else stack_held(found)
        shapes = [x.shape[:-1], x.shape, x.shape[:-1]]
        if not all(map(dense, held)) or [part.shape for part in held] != shapes:
            raise ConfigError(
                f"held: expected dense tensors, of places of shape {tuple(x.shape)}, found "
                f"{', '.join(map(shown, held))}"
            )
        places = (held.sets, solids, len(self.colliders)), (held.points, 0, self.numerics.points)
        for found, low, high in places:
            if len(odd := found[(found != -1) & ((found < low) | (found >= high))]):
                raise ConfigError(
                    f"held: expected driven sets and points from {low} below {high}, or -1, found "
                    f"{int(odd[0])}"
                )
        kinds = torch.int32, self.dtype, torch.int32
        return Held(*(t.to(self.device, kind) for t, kind in zip(held, kinds)))

    def _begun(self, state: ParticleState, started: bool) -> ParticleState:
        """The state that is advanced: F_tot is F itself where the law does not yield."""
        spins = started or self.options.init_affine == "spin"
        C_affine = state.C_affine if spins else torch.zeros_like(state.C_affine)
        return replace(state, C_affine=C_affine, F_tot=state.F_tot if self.law.plastic else state.F)

    def material_state(
        self, F: Tensor, C_affine: Tensor, parameters: dict[str, Tensor]
    ) -> MaterialState:
        """Material state that adapters read at deformation gradients F (N, 3, 3); differentiable. For analysis and tests."""
        rotation = torch.eye(3, dtype=self.dtype, device=self.device).expand(len(F), 3, 3)
        return MaterialState(
            *material_state(self.law, F, C_affine, self.pack(parameters, len(F), rotation))
        )


def _determinant(F: Tensor) -> Tensor:
    """Of (..., 3, 3), as a triple product: a factorisation of each matrix takes CUDA longer than a substep."""
    return (F[..., 0, :] * torch.linalg.cross(F[..., 1, :], F[..., 2, :])).sum(-1)
