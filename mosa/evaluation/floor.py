"""The floor of the figures: the true law on the learner's own particles and grid, started from the true pose."""

from __future__ import annotations

import torch
from torch import Tensor

from mosa.data.synthetic.bodies.objects import object_named
from mosa.data.synthetic.materials.hidden import Hidden
from mosa.errors import ConfigError
from mosa.physics.contact.driven import held_in, loads
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.physics.world import Start
from mosa.types import ParticleState, Scene


def hidden_of(scene: Scene) -> Hidden:
    """The hidden material of a built-in scene, for figures alone. Errors: ConfigError where the scene is not a built-in one."""
    if scene.truth is None or not scene.synthetic:
        raise ConfigError(f"scene {scene.name}: the true law is known for built-in scenes only")
    return object_named(scene.name).material.variant(
        "anisotropic" if scene.truth.parameters["ratio"] > 1 else "isotropic"
    )


@torch.no_grad()
def floor_rollout(body, scene: Scene, world) -> Tensor:
    """Positions (T, N, 3) [m] of the body's particles under the hidden material of a built-in scene, simulated where the body is,
    returned on the CPU.

    world: `mosa.modules.body.body.World`; its ground, walls and colliders act as in `Body.simulate`. body:
    `mosa.modules.body.body.Body`; its particles, volumes, grid and learned contact height are used, its law is not. What is left
    between this and the truth is the learner's discretisation: differences below it mean nothing. As the contact height is fitted,
    two fits of one body have different floors. Errors: ConfigError where the scene is not a built-in one; SimulationDiverged."""
    truth, hidden = scene.truth, hidden_of(scene)
    settings, frame_dt = body.settings, scene.frame_dt
    rest, device = body.rest.detach().float().cpu(), body.rest.device
    Q = truth.rotation.float()
    start = (rest - truth.rest.mean(0)) @ Q.T + truth.positions[0].mean(0)
    begun = Start(Q, start.mean(0), truth.velocity.float(), torch.zeros(3))
    substeps = required_substeps(
        hidden.wave_modulus(),
        hidden.density,
        frame_dt,
        settings.dx,
        v_max=world.fastest(
            begun, float((rest.amax(0) - rest.amin(0)).max()), frame_dt * scene.frames
        ),
        courant=min(settings.courant, 0.3),
        limit=5000,
        viscosity=hidden.viscosity(),
    )
    simulator = Simulator(
        hidden.law,
        dx=settings.dx,
        substeps=substeps,
        frame_dt=frame_dt,
        gravity=world.gravity,
        up=world.up,
        ground=body.contact.at_nodes(world.ground, settings.dx),
        planes=world.planes,
        colliders=world.solids,
        device=device,
        options=hidden.options,
    )
    n, gravity, up = len(rest), world.gravity.float().cpu(), world.up.float().cpu()
    lift = body.contact.lift(world.ground, settings.dx).detach().float().cpu() * up
    F = Q.expand(n, 3, 3).contiguous()
    velocity = (
        (truth.velocity.float() - 0.5 * frame_dt / substeps * gravity).expand(n, 3).contiguous()
    )
    F = F.to(device)
    state = ParticleState(
        (start + lift).to(device), velocity.to(device), torch.zeros(n, 3, 3, device=device), F, F
    )
    parameters = {name: value.to(device) for name, value in hidden.parameters(rest).items()}
    volume = body.volume.float().to(device)
    added = loads(world.driven, start, volume)
    rollout = simulator.rollout(
        state, parameters, volume, hidden.density if added is None else hidden.density + added, scene.frames,
        held=held_in(world.driven, start, len(world.colliders)),
        motions=[c.motion.shifted(lift) for c in world.solids],  # the lift is the ground's: they keep their place
    )  # fmt: skip
    return rollout.x.cpu() - lift
