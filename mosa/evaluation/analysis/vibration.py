"""Does a learned law make energy? A bounded operator without major symmetry has none of its own, and a free body may then grow."""

from __future__ import annotations

import itertools
import math

import torch

from mosa.errors import SimulationDiverged
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN
from mosa.modules.body.material import Material
from mosa.physics.engine.law_options import AS_USUAL, LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import step_rate
from mosa.types import ParticleState

GROWTH_LIMIT = 1.05  # of kinetic maxima in a period: above, a law makes energy
FRAMES = 40  # per period: a kinetic maximum between two samples is then missed by at most 2.5 %
NEGLIGIBLE = 1e-3  # share of the first period's kinetic maximum below which a vibration has ended


def longitudinal_modulus(material: Material) -> float:
    """E [Pa] of the small-strain response, kappa of a fluid: what a block swings with along its length."""
    p = {name: float(value.detach()) for name, value in material.physical().items()}
    if "E" in p:
        return p["E"]
    if float(material.max_viscosity()) > 0:
        return p["kappa"]
    return 9 * p["kappa"] * p["mu"] / (3 * p["kappa"] + p["mu"])


@torch.no_grad()
def vibration_growth(
    material: Material,
    adapter: Adapter | None,
    *,
    density: float,
    stride: int,
    law_options: LawOptions = AS_USUAL,
    periods: int = 10,
    cells: int = 4,
    amplitude: float = 0.02,
) -> float:
    """Largest ratio of the kinetic maxima of two periods in a row, of a block of a law that vibrates freely, the start counting as
    the first maximum; for a law with an energy (the prior, adapter=operator) that of a maximum to the largest before it.

    The block, 2 cells x 1 x 1 times `cells`, is given the velocity of its first longitudinal mode, at most `amplitude` times the
    speed of sound in a bar, about the strain; float64 on the CPU. adapter: switched on, or None for the prior; stride: substeps
    between its evaluations; density [kg/m^3]. At most 1 where the law has an energy, infinite where the block bursts."""
    E = longitudinal_modulus(material)
    dx, spacing = 1.0, 0.5
    axes = [
        torch.arange(n, dtype=torch.float64) * spacing + spacing / 2
        for n in (4 * cells, 2 * cells, 2 * cells)
    ]
    x = torch.cartesian_prod(*axes)
    n, length, speed = len(x), 2.0 * cells * dx, math.sqrt(E / density)
    k = math.pi / length
    v, C = torch.zeros(n, 3).double(), torch.zeros(n, 3, 3).double()
    v[:, 0] = -amplitude * speed * torch.cos(k * x[:, 0])
    C[:, 0, 0] = amplitude * speed * k * torch.sin(k * x[:, 0])
    F = torch.eye(3).double().expand(n, 3, 3).contiguous()
    frame_dt = 2 * length / speed / FRAMES
    margin = ADAPTER_MARGIN if adapter is None else adapter.stiffening(material.poisson())
    rate = step_rate(
        math.sqrt(margin * float(material.max_modulus()) / density),
        float(material.max_viscosity()),
        density,
        dx,
        amplitude * speed,
        0.5,
    )
    needed = math.ceil(frame_dt * rate)
    steady = adapter is None or adapter.steady
    substeps = needed if steady else -(-needed // stride) * stride
    simulator = Simulator(
        material.law,
        dx=dx,
        substeps=substeps,
        frame_dt=frame_dt,
        gravity=(0, 0, 0),
        dtype=torch.float64,
        energetic=adapter is not None and adapter.energetic,
        options=law_options,
    )
    parameters = {
        name: value.detach().double().cpu() for name, value in material.per_particle().items()
    }
    held = None if adapter is None else adapter.in_double()
    if held is not None:
        held.follow(material.poisson().double().cpu())  # whatever it followed last
    try:
        rollout = simulator.rollout(
            ParticleState(x, v, C, F, F), parameters, torch.full((n,), spacing**3).double(), density, periods * FRAMES + 1,
            adapter=held, stride=None if steady else stride,
        )  # fmt: skip
    except SimulationDiverged:
        return math.inf
    energy = rollout.v.square().sum((1, 2))
    maxima = [float(energy[0]), *energy[1:].reshape(periods, FRAMES).amax(1).tolist()]
    if adapter is None or adapter.energetic:
        # modes that meet lend kinetic energy to strain for a period and give it back: that is no growth where the law has an
        # energy. What it had before, the start's, is a bound. A law without one has to be caught while it grows from little
        return max(
            later / before for before, later in zip(itertools.accumulate(maxima, max), maxima[1:])
        )
    pairs = (pair for pair in itertools.pairwise(maxima) if pair[0] > NEGLIGIBLE * maxima[0])
    ratios = [later / earlier for earlier, later in pairs]
    return max(ratios, default=0.0)
