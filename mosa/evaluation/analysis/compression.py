"""A cylinder of a law pressed between two plates: Young's modulus in any direction of the material, from the plates' force.

The test that would be made on a real specimen: nothing is read from the law but the force. The specimen is always the same, the
material is turned in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.modules.adapters.base import Adapter
from mosa.physics.constitutive.elasticity import wave_modulus
from mosa.physics.contact.colliders import Box, Collider
from mosa.physics.contact.motion import Motion
from mosa.physics.engine.law_options import AS_USUAL, LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.types import ParticleState

HEIGHT, RADIUS, CELLS = 0.2, 0.08, 8  # of the specimen [m]; cells of the grid along its height
STROKE, FRAMES = 0.06, 24  # share of the height that the plates close, frames of it
SWINGS = 6.0  # periods of the specimen's vibration in the stroke, slow enough for 1 %


@dataclass(frozen=True)
class Pressed:
    """strain: (T,) shortening of the specimen's middle half; force: (T,) [N] on a plate; modulus [Pa] at strain 0."""

    strain: Tensor
    force: Tensor
    modulus: float


def rotation_to(direction: Tensor) -> Tensor:
    """(3, 3) float64 rotation Q with Q direction = z; direction: (3,) unit."""
    a, z = direction.double(), torch.tensor([0.0, 0.0, 1.0]).double()
    axis, cosine = torch.linalg.cross(a, z), float(a @ z)
    if cosine < -1 + 1e-12:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    K = torch.zeros(3, 3).double()
    K[2, 1], K[0, 2], K[1, 0] = axis[0], axis[1], axis[2]
    K = K - K.T
    return torch.eye(3).double() + K + K @ K / (1 + cosine)


@torch.no_grad()
def press(
    law: str, parameters: Mapping[str, Tensor], direction: Tensor, *, modulus: float, poisson: float, density: float = 1000.0,
    adapter: Adapter | None = None, stride: int = 8, stiffening: float = 1.85, cells: int = CELLS,
    law_options: LawOptions = AS_USUAL,
) -> Pressed:  # fmt: skip
    """Compress a specimen along a material direction (3,), between frictionless plates, without gravity; float64 on the CPU.

    parameters: numbers by the law's own names; modulus [Pa], poisson: about those of the law, for the time scale and the start;
    adapter: switched on, or None; stiffening: of the P wave modulus, which the time step allows for.
    Errors: SimulationDiverged, ConfigError (time step)."""
    dx = HEIGHT / cells
    axis = (torch.arange(2 * cells).double() + 0.5) * dx / 2 - HEIGHT / 2
    side = torch.arange(-2 * cells, 2 * cells).double() * dx / 2 + dx / 4
    x = torch.cartesian_prod(side, side, axis)
    x = x[x[:, :2].norm(dim=1) < RADIUS]
    n, Q = len(x), rotation_to(direction / direction.norm())
    duration = SWINGS * 2 * HEIGHT / math.sqrt(modulus / density)
    rate = STROKE / duration
    # a start that is pressed already all over, or the plates would send a wave through it
    shear = rate * torch.diag(torch.tensor([poisson, poisson, -1.0]).double())
    motions = [Motion((0, 0, s * HEIGHT), velocity=(0, 0, -s * rate * HEIGHT / 2)) for s in (-1, 1)]
    plates = [
        Collider(Box((4 * HEIGHT, 4 * HEIGHT, HEIGHT)), "slip", motion=motion) for motion in motions
    ]
    numbers = {
        name: torch.as_tensor(value).detach().double().cpu() for name, value in parameters.items()
    }
    stiffest = stiffening * float(wave_modulus(law, numbers))
    substeps = required_substeps(
        stiffest, density, duration / FRAMES, dx, v_max=rate * HEIGHT, courant=0.5
    )
    steady = adapter is None or adapter.steady
    simulator = Simulator(
        law, dx=dx, substeps=substeps if steady else -(-substeps // stride) * stride, frame_dt=duration / FRAMES, gravity=(0, 0, 0),
        colliders=plates, dtype=torch.float64, energetic=adapter is not None and adapter.energetic, options=law_options,
    )  # fmt: skip
    F = Q.expand(n, 3, 3).contiguous()
    state = ParticleState(x, (x @ shear).contiguous(), shear.expand(n, 3, 3).contiguous(), F, F)
    held = None
    if adapter is not None:
        held = adapter.in_double()
        held.follow(torch.tensor(poisson).double())
    volume = torch.full((n,), (dx / 2) ** 3).double()
    found = simulator.rollout(
        state, numbers, volume, density, FRAMES + 1, adapter=held, stride=None if steady else stride
    )
    force = 0.5 * (found.reactions[..., 0, 2] - found.reactions[..., 1, 2]).mean(1).abs()
    middle = x[:, 2].abs() < HEIGHT / 4
    stretch = (found.F_tot[:, middle] @ Q.T)[..., 2, 2].mean(1)
    strain = 1 - 0.5 * (stretch[1:] + stretch[:-1])
    area = float(volume.sum()) / HEIGHT
    # before, the plates have not reached the body: a grid contact is felt half a cell off
    late = slice(FRAMES // 4, None)
    powers = torch.stack([strain, strain**2], 1)[late]
    fitted = torch.linalg.lstsq(powers, (force / area)[late][:, None]).solution
    return Pressed(strain, force, float(fitted[0]))
