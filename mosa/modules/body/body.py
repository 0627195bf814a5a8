"""The learned body: rest particles with appearance, a prior law with its parameters, heterogeneity, and the stress adapter.

One module for fitting, evaluation and later use, so that what is learned is what is simulated."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.modules.body.contact import ContactOffset
from mosa.modules.body.heterogeneity import StiffnessField
from mosa.modules.body.material import Material, material_states
from mosa.modules.body.model import Model
from mosa.modules.body.ready import Ready
from mosa.modules.body.simulation_settings import SimulationSettings
from mosa.physics.contact.driven import driven_from_config, held_in, loads
from mosa.physics.engine.axes import PERIOD
from mosa.physics.engine.law_options import AS_USUAL, LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.rotations import skew
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive
from mosa.physics.time.time_step import required_substeps
from mosa.physics.world import Start, World
from mosa.rendering.appearance.carried_splats import CarriedSplats
from mosa.types import ParticleState, Rollout

VARIANTS = ("prior", "prior_eta", "adapted")


EVEN = 4
"""Substeps of a frame are a multiple of this at least: each count has buffers and captured graphs of its own, and one that followed
every change of the modulus would need new ones in nearly every step of a fit."""


class Body(nn.Module):
    """N particles with a law. Buffers: rest (N, 3) [m], volume (N,) [m^3], colors (N, 3), opacities (N,), covariances (N, 3, 3).
    splats: what its images show, None where that is the particles; a fit to images looks at the particles."""

    rest: Tensor
    volume: Tensor
    colors: Tensor
    opacities: Tensor
    covariances: Tensor
    _made: tuple[World, tuple, Simulator] | None = None
    """The last simulator, and for what it was made."""

    def __init__(
        self, *, rest: Tensor, volume: Tensor, colors: Tensor, opacities: Tensor,
        covariances: Tensor, density: float, material: Material,
        heterogeneity: StiffnessField | None, adapter: Adapter | None,
        settings: SimulationSettings, law_options: LawOptions = AS_USUAL,
    ) -> None:  # fmt: skip
        super().__init__()
        for name, value in (
            ("rest", rest), ("volume", volume), ("colors", colors), ("opacities", opacities),
            ("covariances", covariances),
        ):  # fmt: skip
            self.register_buffer(name, value.detach().clone())
        self.splats: CarriedSplats | None = None
        self.density, self.settings, self.law_options = float(density), settings, law_options
        self.material, self.heterogeneity, self.adapter = material, heterogeneity, adapter
        if heterogeneity is not None:
            heterogeneity.settle(self.rest)
        if adapter is not None:
            adapter.settle(self.rest, self.volume)
        # the calibrated backbones that every later figure is compared with; filled when their stage ends
        self.contact = ContactOffset(settings.contact_offset)
        backbone = nn.ModuleDict({"material": material, "contact": self.contact})
        self.frozen = nn.ModuleDict(
            {"prior": copy.deepcopy(backbone), "prior_eta": copy.deepcopy(backbone)}
        )
        # the prior's is what a stage that starts from it goes back to; it is never simulated
        if heterogeneity is not None:
            for variant in self.frozen.values():
                variant["heterogeneity"] = copy.deepcopy(heterogeneity)
        self.frozen.requires_grad_(False)

    def __repr__(self) -> str:
        parts = (self.heterogeneity, self.adapter)
        more = "".join(f", {type(part).__name__}" for part in parts if part is not None)
        return f"Body({len(self.rest)} particles, {self.size:.4g} m, {self.material.law}{more})"

    def __getstate__(self) -> dict[str, Any]:
        """Without the simulator, whose buffers are no part of a body: a copy makes its own."""
        return self.__dict__ | {"_made": None}

    @property
    def variants(self) -> list[str]:
        """Those of VARIANTS that are laws of their own: without a heterogeneity, `prior_eta` is the prior once more."""
        return [v for v in VARIANTS if v != "prior_eta" or self.heterogeneity is not None]

    @property
    def center(self) -> Tensor:
        """(3,) centre of mass of the rest shape [m]."""
        return (self.rest * self.volume[:, None]).sum(0) / self.volume.sum()

    @property
    def size(self) -> float:
        """Largest extent of the rest shape [m]."""
        return float((self.rest.amax(0) - self.rest.amin(0)).max())

    @property
    def spacing(self) -> float:
        """Distance of neighbouring particles [m]. Solids are met at half of it from their surface."""
        return float(self.volume.mean()) ** (1 / 3)

    def factor(self, heterogeneity: StiffnessField | None) -> Tensor:
        """(N,) stiffness factor 1 + amplitude tanh eta(X)."""
        if heterogeneity is None:
            return torch.ones_like(self.volume)
        return heterogeneity.factor(self.rest)

    def model(self, variant: str = "adapted") -> Model:
        """What is simulated as `variant`: the live modules (adapted), or those of an ended stage. An adapter that was not switched
        on yet is no part of it: before its stage it is the prior."""
        if variant == "adapted":
            adapter = self.adapter if self.adapter is not None and self.adapter.is_on else None
            return Model(self.material, self.contact, self.heterogeneity, adapter)
        if variant not in self.frozen:
            raise ConfigError(f"variant: expected one of {', '.join(VARIANTS)}, found {variant!r}")
        frozen = self.frozen[variant]
        varies = variant == "prior_eta" and "heterogeneity" in frozen
        heterogeneity = frozen["heterogeneity"] if varies else None
        return Model(frozen["material"], frozen["contact"], heterogeneity)

    def choose(self, law: str) -> None:
        """Settle on a candidate for the backbone, here and in what was kept of it."""
        for material in (self.material, *(kept["material"] for kept in self.frozen.values())):
            material.choose(law)

    def switch_on(self) -> None:
        """The adapter acts from now on, beginning at the prior as it stands."""
        material = self.material
        self.adapter.switch_on(material.reference_modulus(), material.poisson())
        parameters = {k: v.detach() for k, v in material.per_particle(1.0).items()}
        self.adapter.prepare(
            material.law, material_states(material.law, parameters, self.law_options)
        )

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

        The velocity is taken half a substep of gravity early: symplectic Euler then follows the parabola exactly at any dt."""
        Q = start.rotation.to(self.rest)
        arm = (self.rest - self.center) @ Q.T
        velocity = start.velocity - 0.5 * dt * gravity
        v = velocity + torch.linalg.cross(start.angular_velocity.expand_as(arm), arm)
        n = len(arm)
        F = Q.expand(n, 3, 3).contiguous()
        # where float32 has few digits for a particle
        far = float(start.center.detach().abs().max()) > PERIOD * self.settings.dx
        center = start.center.double() if far else start.center
        return ParticleState(
            arm + center, v, skew(start.angular_velocity).expand(n, 3, 3).contiguous(), F, F
        )

    def stiffening(self, adapted: bool) -> float:
        """Modulus over the prior's that the time step allows for."""
        return self.adapter.stiffening(self.material.poisson()) if adapted else 1.0

    def substeps(
        self, parameters_modulus: float, frame_dt: float, speed: float, adapted: bool,
        viscosity: float = 0.0, given: int | None = None,
    ) -> int:  # fmt: skip
        """Substeps per frame that the time step bound asks for, rounded up to whole strides of the adapter and to `EVEN`; those
        that are given, where they are enough. Errors: ConfigError naming how many are needed."""
        settings = self.settings
        count = required_substeps(
            modulus_max=parameters_modulus, density=self.density, frame_dt=frame_dt,
            dx=settings.dx, v_max=speed, factor=self.stiffening(adapted), courant=settings.courant,
            limit=settings.max_substeps if given is None else given, viscosity=viscosity,
            limited_by="simulation.max_substeps" if given is None else "substeps",
        )  # fmt: skip
        if given is not None:
            return given
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
        self, start: Start, world: World, frames: int, frame_dt: float, *,
        model: Model | None = None, collect: Callable | None = None,
        progress: Callable[[int], None] | None = None,
        observed: Tensor | None = None, gain: float = 0.0,
        unseen: Callable[[Tensor, int], Tensor] | None = None, substeps: int | None = None,
    ) -> Rollout:  # fmt: skip
        """Roll `frames` frames out (frame 0 is the start). Differentiable in every parameter and in `start`.

        model: what is simulated, None for all that was learned. collect: called with the statistics of every evaluation of the
        adapter (penalties, mean |C|). observed, gain: (T, N, 3) [m] and a number; at every frame the velocities are corrected
        towards what was seen, but for what was `unseen` of the positions in a frame (`ready.corrected_rollout`). substeps: of every
        frame, where differences hold them fixed; None: as many as the time step bound asks for. Errors: SimulationDiverged,
        ConfigError (time step)."""
        ready = self.ready(start, world, frames, frame_dt, model=model, substeps=substeps)
        return ready.simulate(
            frames, world.solids, collect=collect, progress=progress, observed=observed, gain=gain,
            unseen=unseen,
        )  # fmt: skip

    def ready(
        self, start: Start, world: World, frames: int, frame_dt: float, *, model: Model | None = None,
        substeps: int | None = None, enough: bool = False,
    ) -> Ready:  # fmt: skip
        """The body at `start`, ready to be simulated; arguments and errors as `simulate`.
        enough: check that `substeps`, which a user gave, are as many as the bound asks for."""
        model = self.model() if model is None else model
        material, adapter = model.material, model.adapter
        if adapter is not None:
            adapter.follow(material.poisson(live=True))
        dtype = torch.float64 if self.settings.precision == 64 else torch.float32
        factor = self.factor(model.heterogeneity)
        parameters = material.per_particle(factor)
        gravity, up = world.gravity.to(self.rest), world.up.to(self.rest)
        timing = None
        if self.settings.adaptive:
            # every variant takes the substeps its own states ask for; velocities at frame 0 itself: the rollout starts with half a
            # kick, whatever its first substep
            timing = Adaptive(self.step_control(self.adapter is not None), lag=0.0)
            substeps = self.settings.max_substeps
            state = self.initial_state(start, 0.0, gravity)
        elif substeps is not None and not enough:
            state = self.initial_state(start, frame_dt / substeps, gravity)
        else:
            # of given substeps, the speed of colliders has a message of its own
            met = world if substeps is None else replace(world, colliders=())
            speed = met.fastest(start, self.size, frames * frame_dt)
            # one time step for all variants of a body: their difference is then the law's, not the integrator's
            substeps = self.substeps(
                float(material.max_modulus(factor.detach())), frame_dt, speed, self.adapter is not None,
                float(material.max_viscosity(factor.detach())), substeps,
            )  # fmt: skip
            state = self.initial_state(start, frame_dt / substeps, gravity)
        lift = model.contact.lift(world.ground, self.settings.dx) * up
        simulator = None if adapter is None else adapter.simulator(self.density, world, frame_dt)
        if simulator is not None:  # no law on a grid: the adapter brings its dynamics
            lift, timing = torch.zeros_like(lift), None
            state = self.initial_state(start, frame_dt / simulator.substeps, gravity)
        else:
            simulator = self.simulator(
                material.law, substeps, frame_dt, world, adapter is not None and adapter.energetic
            )
        state = replace(state, x=state.x + lift)
        state = state.to(dtype)
        arguments = {
            "parameters": {k: p.to(dtype) for k, p in parameters.items()}, "volume": self.volume.to(dtype),
            "density": self.density, "adapter": adapter,
            "stride": None if adapter is not None and adapter.steady else self.settings.stride,
        }  # fmt: skip
        if world.driven or start.loads:
            arguments |= self.driven(world, state.x - lift, start)
        return Ready(simulator, state, lift, arguments, timing)

    def driven(self, world: World, x: Tensor, start: Start) -> dict[str, Any]:
        """What `Simulator.rollout` takes for the driven sets of a world and the loads of a start,
        of the body's particles that start at x (N, 3) [m]."""
        held = held_in(world.driven, x, len(world.colliders))
        own = driven_from_config(start.loads, "scene.loads")
        added = loads((*world.driven, *own), x, self.volume)
        given = {} if held is None else {"held": held}
        return given if added is None else given | {"density": self.density + added}

    def simulator(
        self, law: str, substeps: int, frame_dt: float, world: World, energetic: bool = False
    ) -> Simulator:
        """The simulator of `law` in `world`, one per time step (kernels are compiled once per law and precision).

        energetic: as `Simulator`."""
        device, settings, options = self.rest.device, self.settings, self.law_options
        key = (law, substeps, frame_dt, str(device), energetic, settings, options)
        if self._made is None or self._made[0] is not world or self._made[1] != key:
            dtype = torch.float64 if settings.precision == 64 else torch.float32
            simulator = Simulator(
                law, dx=settings.dx, substeps=substeps, frame_dt=frame_dt, gravity=world.gravity,
                up=world.up, ground=self.contact.at_nodes(world.ground, settings.dx),
                planes=world.planes, colliders=world.solids, box=world.box, dtype=dtype,
                device=device, energetic=energetic, options=options,
            )  # fmt: skip
            self._made = world, key, simulator
        return self._made[2]
