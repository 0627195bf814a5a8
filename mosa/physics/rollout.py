"""The simulator: frames of MLS-MPM from a start, a law and its parameters, with or without an adapter.

State convention: after n substeps a state holds (x^n, v^n, C_affine^n, F^{n+1}, F_tot^{n+1}); F is advanced right after its
C_affine is known, so that F belongs to x and is known when a substep starts. One substep is then stress(F) -> P2G -> grid ->
G2P -> x += dt v -> F <- map((I + dt C_affine) F), and a rollout starts with one advance of F by the initial C_affine. This is
the usual order, F first in a substep, cut at another place (docs/decisions.md, "Order of a substep").
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.physics.adaptive import StepChooser, StepControl, check_counts
from mosa.physics.asking import AdapterOperator, MaterialState, ask
from mosa.physics.boundary import Plane, ground_plane, pack_planes
from mosa.physics.chains import SEGMENT, Chains
from mosa.physics.collider_motion import Motion, Trajectory, sample_frame, sample_poses
from mosa.physics.colliders import Collider, pack_colliders, reach
from mosa.physics.laws import SLOTS, law_named
from mosa.physics.memory import room
from mosa.physics.mpm import LONGEST, LONGEST_KEPT, SegmentSolver, advance_segment, substep_bytes, wants_gradient
from mosa.physics.particle_operations import first_advance, material_state
from mosa.physics.plasticity import yield_factor
from mosa.physics.strain import STRAINS
from mosa.physics.workspace import SCALARS, Numerics, Steps
from mosa.types import Ground, ParticleState, Rollout

_UNBOUNDED = 1e30


class Simulator:
    """MLS-MPM of one law on one grid and time step. Rollouts are differentiable in state, parameters and adapter outputs.

    dx: grid spacing [m]; substeps per frame of frame_dt [s]; gravity (3,) [m/s^2]; ground: plane below `up` ((3,), against
    gravity by default), then `planes` in order, then the moving `colliders`; box: (2, 3) [m] corners a particle may not leave,
    None for no limit.
    mass_cutoff: node mass [kg] above which a node has a velocity (None: 0 in float64, 1e-12 of a particle's in float32).
    init_affine: `spin` takes the state's C_affine, `zero` replaces it by 0. norm_eps: under the root of yield norms.
    yield_convention: paper | sqrt23. rebuild: write U S V^T back also where nothing yielded (PAC-NeRF does).
    on_inversion: warn | ignore | error for det F <= 0 where the law has a value there; it is an error where it has none.
    chained: whether the evaluations of an adapter that is a torch module and the segments between them run as chains (chain.py);
    None: on CUDA, where a chain is one captured graph. Not with colliders or adaptive substeps, which are cut in segments.
    Gradients through a chain reach the adapter's parameters, not other tensors that it may use.
    strain: hencky | biot | green: what adapters answer is a stiffness G in units of 2 mu, of the energy mu E : G : E that is added
    to 1 + h[0] times the prior's; None: an operator on the prior's stress.
    Errors: ConfigError naming the argument. Not safe for use by two threads: buffers are shared between rollouts.
    """

    def __init__(
        self,
        law: str,
        *,
        dx: float,
        substeps: int,
        frame_dt: float,
        gravity: Sequence[float] | Tensor = (0.0, -9.8, 0.0),
        ground: Ground | None = None,
        up: Sequence[float] | Tensor | None = None,
        planes: Sequence[Plane] = (),
        colliders: Sequence[Collider] = (),
        box: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        mass_cutoff: float | None = None,
        init_affine: str = "spin",
        norm_eps: float = 0.0,
        yield_convention: str = "paper",
        rebuild: bool = False,
        on_inversion: str = "warn",
        chained: bool | None = None,
        strain: str | None = None,
    ) -> None:
        self.law = law_named(law)
        for name, value in (("dx", dx), ("frame_dt", frame_dt), ("substeps", substeps)):
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name}: expected a positive number, found {value}")
        if strain is not None and (strain not in STRAINS or "mu" not in self.law.offsets or self.law.viscosity is not None):
            if strain not in STRAINS:
                raise ConfigError(f"strain: expected one of {', '.join(STRAINS)} or None, found {strain!r}")
            raise ConfigError(f"strain: expected a law with a shear modulus mu, found {law!r}: stiffness is in units of 2 mu")
        if dtype not in SCALARS:
            raise ConfigError(f"dtype: expected torch.float32 or torch.float64, found {dtype}")
        if init_affine not in ("spin", "zero"):
            raise ConfigError(f"init_affine: expected spin or zero, found {init_affine!r}")
        if on_inversion not in ("warn", "ignore", "error"):
            raise ConfigError(f"on_inversion: expected warn, ignore or error, found {on_inversion!r}")
        self.substeps, self.frame_dt, self.dt = int(substeps), float(frame_dt), float(frame_dt) / int(substeps)
        self.dtype, self.device = dtype, torch.device(device)
        self.init_affine, self.on_inversion, self.mass_cutoff = init_affine, on_inversion, mass_cutoff
        self.yield_factor = yield_factor(yield_convention)
        gravity = torch.as_tensor(gravity, dtype=torch.float64).cpu()
        if up is None:
            up = -gravity / gravity.norm() if gravity.norm() > 0 else torch.tensor([0.0, 1.0, 0.0])
        all_planes = ([ground_plane(ground, up)] if ground is not None else []) + list(planes)
        values, modes = pack_planes(all_planes, dtype, self.device)
        self.colliders = tuple(colliders)
        packed_colliders = pack_colliders(self.colliders, dtype, self.device) if self.colliders else None
        if box is None:
            low, high = (-_UNBOUNDED,) * 3, (_UNBOUNDED,) * 3
        else:
            low, high = (tuple(corner) for corner in torch.as_tensor(box).double().tolist())
            if not all(a < b for a, b in zip(low, high)):
                raise ConfigError(f"box: expected min < max on every axis, found {low} and {high}")
        self.numerics = Numerics(
            law=self.law, dtype=dtype, device=self.device, dx=float(dx), dt=self.dt, gravity=tuple(gravity.tolist()),
            planes=values, modes=modes, plane_count=len(all_planes), low=low, high=high, norm_eps=float(norm_eps),
            rebuild=rebuild, check_J=self.law.needs_positive_J or on_inversion == "error",
            colliders=packed_colliders, strain=strain,
        )  # fmt: skip
        self._workspaces: dict = {}
        self._long = self.device.type == "cuda"  # a CPU gains nothing
        self.chained = self.device.type == "cuda" if chained is None else chained
        # no method: the cycle would keep a dropped simulator's buffers until the garbage collector looks
        self._ask = partial(ask, self.law, dtype)
        self._chains = Chains(self.numerics, self._ask)

    def pack(self, parameters: dict[str, Tensor], particles: int, rotation: Tensor | None = None) -> Tensor:
        """(N, SLOTS) parameters in the law's order. Values: numbers, (N,), () or, for vectors of k numbers, (N, k) or (k,).

        rotation: (N, 3, 3), fills the law's reference rotation. Errors: ConfigError naming a missing, unknown or misshapen one.
        """
        expected = [name for name in self.law.parameters if name != self.law.reference]
        if missing := [name for name in expected if name not in parameters]:
            raise ConfigError(f"law {self.law.name!r} needs {', '.join(expected)}; missing: {', '.join(missing)}")
        if unknown := [name for name in parameters if name not in expected]:
            raise ConfigError(f"law {self.law.name!r} takes {', '.join(expected)}; unknown: {', '.join(unknown)}")
        columns = []
        for name, size in self.law.parameters.items():
            if name == self.law.reference:
                columns.append(rotation.detach().reshape(particles, 9))
                continue
            value = parameters[name]
            if isinstance(value, int | float):
                value = torch.full((), value, dtype=self.dtype, device=self.device)  # a copy from the host would wait for CUDA
            value = torch.as_tensor(value, dtype=self.dtype, device=self.device)
            if name == "yield_stress" and "von_mises" in self.law.name.split("+"):
                value = value * self.yield_factor  # the other laws that yield have their radius fixed
            try:
                columns.append((value[..., None] if size == 1 else value).expand(particles, size))
            except RuntimeError:
                raise ConfigError(
                    f"parameter {name!r}: expected shape {'()' if size == 1 else f'({size},)'} or ({particles}"
                    f"{',' if size == 1 else f', {size}'}), found {tuple(value.shape)}"
                ) from None
        used = sum(self.law.parameters.values())
        columns.append(torch.zeros(particles, SLOTS - used, dtype=self.dtype, device=self.device))
        return torch.cat(columns, 1)

    def rollout(
        self,
        state: ParticleState,
        parameters: dict[str, Tensor],
        volume: Tensor,
        density: float | Tensor,
        frames: int,
        adapter: Callable[[MaterialState], AdapterOperator] | None = None,
        stride: int | None = 1,
        progress: Callable[[int], None] | None = None,
        started: bool = False,
        motions: Sequence[Motion | Trajectory] | None = None,
        start_time: float = 0.0,
        control: StepControl | None = None,
        counts: Sequence[int] | None = None,
        lag: float | None = None,
        collect: Callable[[Any], None] | None = None,
    ) -> Rollout:
        """`frames` frames, the start being frame 0 (so frames - 1 intervals are simulated).

        state: particles at frame 0, its F and F_tot not yet advanced by C_affine, unless `started` (the `final` of an earlier
        rollout). parameters: physical values the law names, per particle (N,) or scalar; volume: (N,) [m^3]; density
        [kg/m^3]: number or (N,).
        adapter: asked every `stride` substeps from the start of each frame; None: once, at the start of the rollout (an operator
        that does not depend on the state). collect: called with `adapter.statistics()`, a named tuple of tensors, of every
        evaluation. progress: called with the number of each frame.
        motions: of the colliders, instead of their own; start_time [s]: time of frame 0 in these motions.
        control: choose the substeps of each frame from the state at its start (see `adaptive`) instead of taking `substeps`;
        counts: of the frames - 1 intervals, instead of choosing: a replay, in which differences hold the substeps fixed.
        lag [s]: with either, the start's velocities are those lag/2 before its positions: 0 for velocities at frame 0 itself,
        frame_dt/counts[-1] of an earlier rollout that this one goes on from, None: the first substep's dt, as with a fixed step.
        Frame 0 of the result holds the state as given. Errors: SimulationDiverged naming substep and particle; ConfigError.
        """
        if frames < 1 or (stride is not None and stride < 1):
            raise ConfigError(f"frames and stride: expected at least 1, found {frames} and {stride}")
        n = len(state.x)
        self._check(state, volume)
        volume = volume.detach().contiguous()
        density, mean_mass = self._density(density, volume)
        C = state.C_affine if started or self.init_affine == "spin" else torch.zeros_like(state.C_affine)
        F, F_tot = state.F, state.F_tot if self.law.plastic else state.F
        rotation = _polar(F) if self.law.reference is not None else None
        packed = self.pack(parameters, n, rotation)
        cutoff = self.mass_cutoff
        if cutoff is None:
            cutoff = 0.0 if self.dtype == torch.float64 else 1e-12 * mean_mass
        solver = SegmentSolver(self.numerics, volume, density, cutoff, self._workspaces)
        held = {"parameters": packed, "G": None, "h": None, "plastic_G": None, "plastic_h": None}
        recorded = {"x": [state.x], "v": [state.v], "F": [F], "F_tot": [F_tot]}
        motions = self._motions(motions)
        given, chooser, variable = None, None, control is not None or counts is not None
        if counts is not None:
            given = check_counts(counts, frames)
        elif variable:
            solids = max((m.max_speed(reach(c.shape)) for m, c in zip(motions, self.colliders)), default=0.0)
            chooser = StepChooser(control, self.numerics, parameters, packed, density, self.frame_dt, solids)

        def substeps_of(frame: int, v: Tensor, C: Tensor, F: Tensor) -> int:
            if not variable:
                return self.substeps
            return given[frame - 1] if given is not None else chooser.choose(frame, v, C, F)

        taken = [substeps_of(1, state.v, C, F)] if frames > 1 else []
        if not started:
            numerics = replace(self.numerics, dt=self.frame_dt / taken[0]) if taken else self.numerics
            if self.law.plastic:
                F_tot = F_tot + numerics.dt * (C @ F_tot)
                operator = self._ask(adapter, F, C, packed, collect) if adapter is not None else held
                F = first_advance(numerics, F, C, packed, operator["plastic_G"], operator["plastic_h"])
            else:
                F = F_tot = first_advance(numerics, F, C, packed)
        if adapter is not None and stride is None:
            held.update(self._ask(adapter, F, C, packed, collect))
            adapter = None  # answered: nothing cuts the segments
        chained = self.chained and isinstance(adapter, nn.Module) and not variable and not self.colliders
        current = (state.x, state.v, C, F, F_tot)
        if chained:
            lengths = _segments(self.substeps, stride)
            states = self._chains.frames(solver, adapter, current, packed, frames - 1, lengths, collect)
        poses = () if variable else self._poses(motions, frames, start_time)
        reactions = []
        wanted = wants_gradient((*current, *held.values(), *poses))
        if not chained and (wanted or (adapter is not None and torch.is_grad_enabled())):
            solver.room = room(self.device, (frames - 1) * self.substeps * substep_bytes(self.numerics, n))
        most_alone = SEGMENT
        if self._long and not variable and not wanted:
            most_alone = LONGEST
        elif self._long and not variable and solver.room:
            most_alone = max(SEGMENT, min(LONGEST_KEPT, (frames - 1) * self.substeps // 8))
        for frame in range(1, frames):
            if frame > 1:
                taken.append(substeps_of(frame, current[1], current[2], current[3]))
            count, first = taken[-1], sum(taken[:-1])
            dt = self.frame_dt / count
            if variable:
                steps = Steps(dt if lag is None else 0.5 * (lag + dt), dt)
                along = self._poses_of_frame(motions, frames, taken, start_time, given is not None)
                lengths = _segments(count, SEGMENT if adapter is None else stride)  # sizes that many counts share
            else:
                steps, along = None, tuple(part[first : first + count] for part in poses)
                lengths = _segments(count, None if adapter is None else stride, most_alone)
            if chained:
                current, forces = next(states), None
            else:
                current, forces = self._frame(solver, adapter, packed, current, held, lengths, first, along, steps, collect)
            lag = dt
            if forces is not None:
                reactions.append(_mean_force(forces, steps) if variable else forces)
            for name, value in zip(recorded, (current[0], current[1], current[3], current[4])):
                recorded[name].append(value)
            if progress is not None:
                progress(frame)
        stacked = {name: torch.stack(values) for name, values in recorded.items() if name != "F_tot"}
        stacked["F_tot"] = torch.stack(recorded["F_tot"]) if self.law.plastic else stacked["F"]
        times = self.frame_dt * torch.arange(frames, dtype=self.dtype, device=self.device)
        inverted = int((_determinant(stacked["F"].detach()) <= 0).sum())
        if inverted and self.on_inversion == "warn":
            warnings.warn(f"{inverted} particle states with det F <= 0 in {frames} frames", stacklevel=2)
        per_frame = torch.stack(reactions) if reactions else None
        return Rollout(
            **stacked, times=times, final=ParticleState(*current), inverted=inverted, reactions=per_frame, counts=tuple(taken)
        )

    def _frame(
        self, solver: SegmentSolver, adapter: Callable | None, packed: Tensor, state: tuple[Tensor, ...], held: dict,
        lengths: list[int], first: int, poses: tuple[Tensor, ...], steps: Steps | None, collect: Callable | None,
    ) -> tuple[tuple[Tensor, ...], Tensor | None]:  # fmt: skip
        """(state after the segments of a frame, reactions (substeps, K, 6) or None). first: number of its first substep."""
        forces, done = [], 0
        for length in lengths:
            if adapter is not None:
                held.update(self._ask(adapter, state[3], state[2], packed, collect))
            along = tuple(part[done : done + length] for part in poses)
            state, reaction = advance_segment(solver, state, held, length, first + done, along, steps)
            forces += [torch.cat(reaction, -1)] if reaction else []
            steps = None if steps is None else Steps(steps.dt, steps.dt)
            done += length
        return state, torch.cat(forces) if forces else None

    def _motions(self, motions: Sequence[Motion | Trajectory] | None) -> Sequence[Motion | Trajectory]:
        motions = [collider.motion for collider in self.colliders] if motions is None else motions
        if len(motions) != len(self.colliders):
            raise ConfigError(f"motions: expected one for each of {len(self.colliders)} colliders, found {len(motions)}")
        return motions

    def _poses(self, motions: Sequence[Motion | Trajectory], frames: int, start_time: float) -> tuple[Tensor, ...]:
        if not self.colliders:
            return ()
        return sample_poses(motions, frames - 1, self.substeps, self.dt, start_time, self.dtype, self.device)

    def _poses_of_frame(
        self, motions: Sequence[Motion | Trajectory], frames: int, counts: list[int], start_time: float, replayed: bool
    ) -> tuple[Tensor, ...]:
        if not self.colliders:
            return ()
        last = len(counts) - 1
        return sample_frame(motions, last, frames - 1, counts, self.frame_dt, start_time, self.dtype, self.device, replayed)

    def material_state(self, F: Tensor, C_affine: Tensor, parameters: dict[str, Tensor]) -> MaterialState:
        """What an adapter would read at deformation gradients F (N, 3, 3); differentiable. For analysis and tests."""
        rotation = torch.eye(3, dtype=self.dtype, device=self.device).expand(len(F), 3, 3)
        return MaterialState(*material_state(self.law, F, C_affine, self.pack(parameters, len(F), rotation)))

    def _check(self, state: ParticleState, volume: Tensor) -> None:
        n = len(state.x)
        shapes = {"x": (n, 3), "v": (n, 3), "C_affine": (n, 3, 3), "F": (n, 3, 3), "F_tot": (n, 3, 3)}
        values = {name: (getattr(state, name), shape) for name, shape in shapes.items()} | {"volume": (volume, (n,))}
        for name, (value, shape) in values.items():
            if tuple(value.shape) != shape or value.dtype != self.dtype or value.device.type != self.device.type:
                raise ConfigError(
                    f"{name}: expected shape {shape} of {self.dtype} on {self.device}, found {tuple(value.shape)} of "
                    f"{value.dtype} on {value.device}"
                )

    def _density(self, density: float | Tensor, volume: Tensor) -> tuple[float | Tensor, float]:
        """(density, mean mass of a particle [kg]), also checks the volumes: one look at the host for all.

        A number stays one: arithmetic, and so every bit, is that of a body of one material."""
        if not isinstance(density, Tensor) or density.ndim == 0:
            density = float(density)
            if not (math.isfinite(density) and density > 0):
                raise ConfigError(f"density: expected a positive number [kg/m^3], found {density}")
            valid = torch.ones((), dtype=torch.bool, device=volume.device)
        else:
            if density.shape != volume.shape:
                raise ConfigError(f"density: expected a number or shape {tuple(volume.shape)}, found {tuple(density.shape)}")
            density = density.detach().to(volume)
            valid = (torch.isfinite(density) & (density > 0)).all()
        numbers = [(volume > 0).all(), valid, (density * volume).mean()]
        volumes, densities, mass = torch.stack([n.double() for n in numbers]).tolist()
        if not volumes:
            raise ConfigError("volume: expected positive numbers [m^3] for all particles")
        if not densities:
            raise ConfigError("density: expected positive numbers [kg/m^3] for all particles")
        return density, mass


def _segments(substeps: int, stride: int | None, most: int = 0) -> list[int]:
    """Lengths of a frame's segments: `stride` each (the last may be shorter), or nearly equal ones of at most `most`."""
    if stride is None:
        count = -(-substeps // most)
        return [substeps // count + (i < substeps % count) for i in range(count)]
    return [min(stride, substeps - i) for i in range(0, substeps, stride)]


def _mean_force(forces: Tensor, steps: Steps) -> Tensor:
    """(1, K, 6) of (S, K, 6): the impulse over the time in which it acted, the first substep's being its kick."""
    longer = steps.kick / steps.dt - 1
    return (longer * forces[:1] + forces.sum(0, keepdim=True)) / (len(forces) + longer)


def _determinant(F: Tensor) -> Tensor:
    """Of (..., 3, 3), as a triple product: a factorisation of each matrix takes CUDA longer than a substep."""
    return (F[..., 0, :] * torch.linalg.cross(F[..., 1, :], F[..., 2, :])).sum(-1)


def _polar(F: Tensor) -> Tensor:
    """Polar rotation of F (N, 3, 3), without gradient."""
    U, S, Vh = torch.linalg.svd(F.detach().double())
    sign = torch.ones_like(S)
    sign[..., 2] = torch.linalg.det(U @ Vh)
    return ((U * sign[..., None, :]) @ Vh).to(F.dtype)
