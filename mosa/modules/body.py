"""The learned body: rest particles with appearance, a prior law with its parameters, heterogeneity, and the stress adapter.

One module for fitting, evaluation and later use, so that what is learned is what is simulated.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.carried_splats import CarriedSplats
from mosa.modules.criteria import corrected_rollout
from mosa.modules.heterogeneity import HeterogeneityField
from mosa.modules.material import Material
from mosa.modules.stiffness_modes import StiffnessModes
from mosa.physics.contact.colliders import Collider, reach
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.adapter_interface import AdapterOperator
from mosa.physics.engine.adaptive_steps import StepControl
from mosa.physics.engine.clock import Adaptive, Replay
from mosa.physics.engine.simulator import Simulator
from mosa.physics.engine.time_step import required_substeps
from mosa.rotations import skew
from mosa.types import Ground, ParticleState, Rollout

VARIANTS = ("prior", "prior_eta", "adapted")


@dataclass(frozen=True)
class Start:
    """Initial state of a sequence. rotation: (3, 3) pose Q relative to the rest shape; center: (3,) position of the rest
    centre [m]; velocity: (3,) [m/s]; angular_velocity: (3,) [rad/s]."""

    rotation: Tensor
    center: Tensor
    velocity: Tensor
    angular_velocity: Tensor

    def written(self) -> dict[str, list]:
        """Plain containers, fit for a checkpoint; `read` gives the same numbers."""
        return {f.name: getattr(self, f.name).tolist() for f in fields(self)}

    @classmethod
    def read(cls, written: Mapping[str, list], like: Tensor | None = None) -> Start:
        """like: tensor of the device and type wanted, None for the CPU's float32."""
        found = {name: torch.tensor(value) for name, value in written.items()}
        return cls(**{name: value if like is None else value.to(like) for name, value in found.items()})


@dataclass(frozen=True)
class World:
    """What a body falls in. gravity, up: (3,); box: (2, 3) [m]; planes: walls beside the ground; colliders: moving rigid solids."""

    ground: Ground | None
    gravity: Tensor
    up: Tensor
    box: Tensor
    planes: tuple[Plane, ...] = ()
    colliders: tuple[Collider, ...] = ()


@dataclass(frozen=True)
class Ready:
    """A body at its start, and what a simulation of it takes; or, by `stack`, the same in B worlds.

    state: in the simulator's type, higher by `lift` (3,) [m], the contact's offset, than where the body is seen; arguments: of
    `Simulator.rollout`; timing: of substeps that vary, None where they are fixed.
    """

    simulator: Simulator
    state: ParticleState
    lift: Tensor
    arguments: dict
    timing: Adaptive | Replay | None

    def simulate(
        self, frames: int, colliders: Sequence[Collider] = (), *, collect: Callable | None = None,
        progress: Callable[[int], None] | None = None, observed: Tensor | None = None, gain: float = 0.0,
    ) -> Rollout:  # fmt: skip
        """As `Body.simulate`, from here on; of a stack, the worlds at once (`Simulator.rollout_worlds`), without `collect`."""
        simulator, stacked = self.simulator, self.state.x.ndim == 3
        if stacked:
            roll = partial(simulator.rollout_worlds, **self.arguments, motions=self.motions(colliders))
        else:
            roll = partial(simulator.rollout, **self.arguments, collect=collect, motions=self.motions(colliders))
        lift = self.lift[:, None] if stacked else self.lift
        if observed is None:
            timing = {} if self.timing is None else {"timing": self.timing}
            rollout = roll(self.state, frames=frames, progress=progress, **timing)
        else:
            if self.timing:
                raise ConfigError("simulation.adaptive: expected false where a criterion corrects the prediction frame by frame")
            seen = (observed[:frames, None] if stacked else observed[:frames]) + lift.detach()
            rollout = corrected_rollout(roll, self.state, seen.to(self.state.x.dtype), gain, simulator.frame_dt)
        fields = {name: getattr(rollout, name).to(self.lift.dtype) for name in ("x", "v", "F", "F_tot")}
        return replace(rollout, **{**fields, "x": fields["x"] - lift})

    def motions(self, colliders: Sequence[Collider]) -> list:
        """Of the colliders, where the simulator sees them: the offset is the ground's, they keep their place. Of a stack, a list
        for each world."""
        if self.lift.ndim > 1:
            return [[collider.motion.shifted(lift) for collider in colliders] for lift in self.lift]
        return [collider.motion.shifted(self.lift) for collider in colliders]

    def answered(self) -> Ready:
        """With the adapter's answer now in place of the adapter, which may become another one. Errors: ConfigError where the
        operator depends on the state."""
        adapter = self.arguments["adapter"]
        if adapter is None:
            return self
        if self.arguments["stride"] is not None:
            raise ConfigError(f"adapter: expected one whose operator is the same in every state, found {type(adapter).__name__}")
        state, parameters = self.state, self.arguments["parameters"]
        held = AdapterOperator(*adapter(self.simulator.material_state(state.F, state.C_affine, parameters)))
        return replace(self, arguments={**self.arguments, "adapter": lambda _: held})

    @classmethod
    def stack(cls, parts: Sequence[Ready]) -> Ready:
        """B bodies of the same particles and law, each with its own numbers, `answered`, and start, as so many worlds: state
        (B, N, ...), lift (B, 3), and arguments of `Simulator.rollout_worlds`. Errors: ConfigError where the time steps differ."""
        first, n = parts[0], len(parts[0].arguments["volume"])
        counts = sorted({part.simulator.substeps for part in parts})
        if len(counts) > 1 or any(part.timing for part in parts):
            raise ConfigError(f"worlds: expected the same fixed substeps in all, found {counts}; give substeps")
        each = [part.arguments for part in parts]
        parameters = {name: torch.stack([own["parameters"][name].expand(n) for own in each]) for name in each[0]["parameters"]}
        adapters = None if each[0]["adapter"] is None else [own["adapter"] for own in each]
        return replace(
            first, state=ParticleState.stack([part.state for part in parts]), lift=torch.stack([part.lift for part in parts]),
            arguments={**each[0], "parameters": parameters, "adapter": adapters},
        )  # fmt: skip


EVEN = 4
"""Substeps of a frame are a multiple of this at least: each count has buffers and captured graphs of its own, and one that followed
every change of the modulus would need new ones in nearly every step of a fit."""


@dataclass(frozen=True)
class SimulationSettings:
    """dx [m]; `stride`: substeps between evaluations of the networks; `max_substeps` per frame; `precision`: 32 | 64;
    `adaptive`: choose the substeps of each frame from the state at its start, at least `min_substeps` (`adaptive_steps.py`)."""

    dx: float
    stride: int = 8
    max_substeps: int = 400
    courant: float = 0.6
    precision: int = 32
    contact_offset: bool = True
    adaptive: bool = False
    min_substeps: int = 1

    def strides(self, least: int) -> int:
        """Substeps of the fewest whole strides that are at least `least`."""
        return self.stride * -(-least // self.stride)

    def __post_init__(self) -> None:
        if self.precision not in (32, 64):
            raise ConfigError(f"simulation.precision: expected 32 or 64, found {self.precision!r}: 16 bits cannot carry an MPM")
        for name, low in (("stride", 1), ("max_substeps", 1), ("min_substeps", 1)):
            value = getattr(self, name)
            if not (isinstance(value, int) and not isinstance(value, bool) and value >= low):
                raise ConfigError(f"simulation.{name}: expected a whole number of at least {low}, found {value!r}")
        for name in ("dx", "courant"):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and value > 0):
                raise ConfigError(f"simulation.{name}: expected a positive number, found {value!r}")


class ContactOffset(nn.Module):
    """Height [m] by which the grid's contact lies above the ground, learned in units of dx.

    A B-spline grid stops a body a fraction of dx before it touches a wall, by an amount that depends on dx and on the stencil's
    place; without this one number the stiffness absorbs it, differently on every grid.
    """

    START = 0.3
    """Cells the fit starts from; seen on balls, the bird and the rabbit: 0.2 to 0.5. From 0 the fit ends in another valley."""
    LIMITS = (0.15, 0.55)
    """What a grid can do; beyond, the number would absorb what the law gets wrong, and so end in that other valley."""

    def __init__(self, dx: float, enabled: bool = True) -> None:
        super().__init__()
        self.dx, self.enabled = dx, enabled
        self.cells = nn.Parameter(torch.tensor(self.START if enabled else 0.0), requires_grad=enabled)

    def forward(self) -> Tensor:
        return self.dx * self.cells

    @torch.no_grad()
    def project(self) -> None:
        """Back within `LIMITS`, after an optimiser's step."""
        if self.enabled:
            self.cells.clamp_(*self.LIMITS)


class Body(nn.Module):
    """N particles with a law. Buffers: rest (N, 3) [m], volume (N,) [m^3], colors (N, 3), opacities (N,), covariances (N, 3, 3).
    splats: what its images show, None where that is the particles; a fit to images looks at the particles.
    """

    def __init__(
        self,
        *,
        rest: Tensor,
        volume: Tensor,
        colors: Tensor,
        opacities: Tensor,
        covariances: Tensor,
        density: float,
        material: Material,
        heterogeneity: HeterogeneityField | None,
        adapter: nn.Module | None,
        settings: SimulationSettings,
        law_options: dict | None = None,
    ) -> None:
        super().__init__()
        for name, value in (
            ("rest", rest), ("volume", volume), ("colors", colors), ("opacities", opacities), ("covariances", covariances),
        ):
            self.register_buffer(name, value.detach().clone())
        self.splats: CarriedSplats | None = None
        self.density, self.settings, self.law_options = float(density), settings, law_options or {}
        self.material, self.heterogeneity, self.adapter = material, heterogeneity, adapter
        if isinstance(heterogeneity, StiffnessModes):
            heterogeneity.settle(self.rest)
        if (settle := getattr(adapter, "settle", None)) is not None:
            settle(self.rest, self.volume)
        # the calibrated backbones that every later figure is compared with; filled when their stage ends
        self.contact = ContactOffset(settings.dx, settings.contact_offset)
        backbone = nn.ModuleDict({"material": material, "contact": self.contact})
        self.frozen = nn.ModuleDict({"prior": copy.deepcopy(backbone), "prior_eta": copy.deepcopy(backbone)})
        if heterogeneity is not None:  # the prior's is what a stage that starts from it goes back to; it is never simulated
            for variant in self.frozen.values():
                variant["heterogeneity"] = copy.deepcopy(heterogeneity)
        self.frozen.requires_grad_(False)

    def __getstate__(self) -> dict:
        """Without the simulator, whose buffers are no part of a body: a copy makes its own."""
        return {k: v for k, v in self.__dict__.items() if not k.startswith("_simulator")}

    @property
    def center(self) -> Tensor:
        """(3,) centre of mass of the rest shape [m]."""
        return (self.rest * self.volume[:, None]).sum(0) / self.volume.sum()

    @property
    def size(self) -> float:
        """Largest extent of the rest shape [m]."""
        return float((self.rest.amax(0) - self.rest.amin(0)).max())

    def factor(self, heterogeneity: nn.Module | None) -> Tensor:
        """(N,) stiffness factor 1 + amplitude tanh eta(X)."""
        if heterogeneity is None:
            return torch.ones_like(self.volume)
        return heterogeneity.factor(self.rest)

    def parts(self, variant: str) -> tuple[Material, ContactOffset, nn.Module | None, nn.Module | None]:
        """(material, contact, heterogeneity, adapter) of `variant`: the live modules (adapted), or those of an ended stage."""
        if variant == "adapted":
            return self.material, self.contact, self.heterogeneity, self.adapter
        if variant not in self.frozen:
            raise ConfigError(f"variant: expected one of {', '.join(VARIANTS)}, found {variant!r}")
        frozen = self.frozen[variant]
        heterogeneity = frozen["heterogeneity"] if variant == "prior_eta" and "heterogeneity" in frozen else None
        return frozen["material"], frozen["contact"], heterogeneity, None

    def freeze(self, variant: str) -> None:
        """Keep the live parameters as the calibrated backbone `variant` (prior | prior_eta)."""
        for name, module in self.frozen[variant].items():
            module.load_state_dict(getattr(self, name).state_dict())

    def thaw(self, variant: str) -> None:
        """Set the live parameters back to those of the backbone `variant`."""
        for name, module in self.frozen[variant].items():
            getattr(self, name).load_state_dict(module.state_dict())

    def initial_state(self, start: Start, dt: float, gravity: Tensor) -> ParticleState:
        """Particles at `start`: x = Q (X - X_c) + x_c, F = F_tot = Q, C_affine = [omega]_x.

        The velocity is taken half a substep of gravity early: symplectic Euler then follows the parabola exactly at any dt.
        """
        Q = start.rotation.to(self.rest)
        arm = (self.rest - self.center) @ Q.T
        velocity = start.velocity - 0.5 * dt * gravity
        v = velocity + torch.linalg.cross(start.angular_velocity.expand_as(arm), arm)
        n = len(arm)
        F = Q.expand(n, 3, 3).contiguous()
        return ParticleState(arm + start.center, v, skew(start.angular_velocity).expand(n, 3, 3).contiguous(), F, F)

    def stiffening(self, adapted: bool) -> float:
        """Modulus over the prior's that the time step allows for."""
        return self.adapter.stiffening(self.material.poisson()) if adapted else 1.0

    def substeps(self, parameters_modulus: float, frame_dt: float, speed: float, adapted: bool, viscosity: float = 0.0) -> int:
        """Substeps per frame that the time step bound asks for, rounded up to whole strides of the adapter and to `EVEN`."""
        settings = self.settings
        count = required_substeps(
            modulus_max=parameters_modulus, density=self.density, frame_dt=frame_dt, dx=settings.dx, v_max=speed,
            factor=self.stiffening(adapted), courant=settings.courant, limit=settings.max_substeps,
            viscosity=viscosity,
        )
        multiple = settings.strides(EVEN)
        return -(-count // multiple) * multiple

    def step_control(self, adapted: bool) -> StepControl:
        """Bounds of adaptive substeps. Errors: ConfigError naming the field."""
        settings = self.settings
        return StepControl(
            courant=settings.courant, factor=self.stiffening(adapted), minimum=settings.min_substeps,
            maximum=settings.max_substeps, multiple=settings.strides(8),
        )  # fmt: skip

    def simulate(
        self,
        start: Start,
        world: World,
        frames: int,
        frame_dt: float,
        *,
        variant: str = "adapted",
        with_adapter: bool = True,
        with_heterogeneity: bool = True,
        collect: Callable | None = None,
        progress: Callable[[int], None] | None = None,
        counts: Sequence[int] | None = None,
        observed: Tensor | None = None,
        gain: float = 0.0,
        substeps: int | None = None,
    ) -> Rollout:
        """Roll `frames` frames out (frame 0 is the start). Differentiable in every parameter and in `start`.

        collect: called with the statistics of every evaluation of the adapter (penalties, mean |C|). counts: of substeps, to
        replay those of an adaptive rollout. observed, gain: (T, N, 3) [m] and a number; at every frame the velocities are corrected
        towards what was seen (`criteria.corrected_rollout`). substeps: of every frame, where differences hold them fixed; None: as
        many as the time step bound asks for. Errors: SimulationDiverged, ConfigError (time step).
        """
        ready = self.ready(
            start, world, frames, frame_dt, variant=variant, with_adapter=with_adapter, with_heterogeneity=with_heterogeneity,
            counts=counts, substeps=substeps,
        )  # fmt: skip
        rollout = ready.simulate(frames, world.colliders, collect=collect, progress=progress, observed=observed, gain=gain)
        taken = rollout.counts
        self.last_substeps = -(-sum(taken) // len(taken)) if taken else ready.simulator.substeps
        return rollout

    def ready(
        self, start: Start, world: World, frames: int, frame_dt: float, *, variant: str = "adapted", with_adapter: bool = True,
        with_heterogeneity: bool = True, counts: Sequence[int] | None = None, substeps: int | None = None,
    ) -> Ready:  # fmt: skip
        """The body at `start`, ready to be simulated; arguments and errors as `simulate`."""
        material, contact, heterogeneity, adapter = self.parts(variant)
        if not with_heterogeneity:
            heterogeneity = None
        if not with_adapter or (adapter is not None and not adapter.is_on):  # before its stage an adapter is the prior
            adapter = None
        if adapter is not None:
            adapter.follow(material.poisson(live=True))
        dtype = torch.float64 if self.settings.precision == 64 else torch.float32
        factor = self.factor(heterogeneity)
        parameters = material.per_particle(factor)
        gravity, up = world.gravity.to(self.rest), world.up.to(self.rest)
        timing = None
        if self.settings.adaptive or counts is not None:
            # every variant takes the substeps its own states ask for; velocities at frame 0 itself: the rollout starts with half a
            # kick, whatever its first substep
            control = self.step_control(self.adapter is not None)
            timing = Adaptive(control, lag=0.0) if counts is None else Replay(counts, lag=0.0)
            substeps = self.settings.max_substeps
            state = self.initial_state(start, 0.0, gravity)
        elif substeps is not None:
            state = self.initial_state(start, frame_dt / substeps, gravity)
        else:
            fall = float(gravity.norm()) * frames * frame_dt
            speed = float(start.velocity.detach().norm()) + fall
            speed += float(start.angular_velocity.detach().norm()) * self.size
            speed += max((c.motion.max_speed(reach(c.shape)) for c in world.colliders), default=0.0)
            # one time step for all variants of a body: their difference is then the law's, not the integrator's
            substeps = self.substeps(
                float(material.max_modulus(factor.detach())), frame_dt, speed, self.adapter is not None,
                float(material.max_viscosity(factor.detach())),
            )  # fmt: skip
            state = self.initial_state(start, frame_dt / substeps, gravity)
        lift = contact() * up
        if (own := getattr(adapter, "simulator", None)) is not None:  # no law on a grid: the adapter brings its dynamics
            simulator, lift, timing = own(self.density, world, frame_dt), torch.zeros_like(lift), None
            state = self.initial_state(start, frame_dt / simulator.substeps, gravity)
        else:
            simulator = self.simulator(material.law, substeps, frame_dt, world, getattr(adapter, "strain", None))
        state = replace(state, x=state.x + lift)
        state = ParticleState(*(getattr(state, name).to(dtype) for name in ("x", "v", "C_affine", "F", "F_tot")))
        arguments = {
            "parameters": {k: p.to(dtype) for k, p in parameters.items()}, "volume": self.volume.to(dtype),
            "density": self.density, "adapter": adapter,
            "stride": None if adapter is not None and adapter.steady else self.settings.stride,
        }  # fmt: skip
        return Ready(simulator, state, lift, arguments, timing)

    def simulator(self, law: str, substeps: int, frame_dt: float, world: World, strain: str | None = None) -> Simulator:
        """The simulator of `law` in `world`, one per time step (kernels are compiled once per law and precision).

        strain: of an adapter whose operator is a stiffness (`Simulator`)."""
        key = (law, substeps, frame_dt, str(self.rest.device), strain)
        if getattr(self, "_simulator_key", None) != key or self._simulator_world is not world:
            dtype = torch.float64 if self.settings.precision == 64 else torch.float32
            self._simulator = Simulator(
                law, dx=self.settings.dx, substeps=substeps, frame_dt=frame_dt, gravity=world.gravity, up=world.up,
                ground=world.ground, planes=world.planes, colliders=world.colliders, box=world.box,
                dtype=dtype, device=self.rest.device, strain=strain, **self.law_options,
            )
            self._simulator_key, self._simulator_world = key, world
        return self._simulator

