"""Bodies that nothing from outside acts on: conserved quantities (checks 1 to 3) and free vibration (check 26)."""

import math

import torch
import warp as wp
from bodies import (
    DENSITY,
    LAM,
    MU,
    agitated,
    eyes,
    lattice,
    parameters_of,
    random_adapter,
    resting,
    uniform_volume,
)
from torch import Tensor

from mosa.physics.constitutive.laws import LawParameters, register_law
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

DX, SPACING, DT = 0.04, 0.02, 2e-4


def momenta(state: ParticleState, mass: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """(linear [kg m/s], angular [kg m^2/s] about the origin) (3,) float64, with APIC's affine part.

    p = sum m v; L = sum m (x x v + (dx^2/4) sum_j e_j x C e_j): dx^2/4 is the second moment of the quadratic spline.
    """
    x, v, C, m = state.x.double(), state.v.double(), state.C_affine.double(), mass.double()[:, None]
    spin = torch.stack(
        [C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], 1
    )
    return (m * v).sum(0), (m * (torch.linalg.cross(x, v) + dx**2 / 4 * spin)).sum(0)


def conservation(law: str, dtype: torch.dtype, *, adapted: bool = True, intervals: int = 10, substeps: int = 100,
                 parameters: dict | None = None) -> dict[str, float]:  # fmt: skip
    """Largest relative change over intervals * substeps of grid mass, linear and angular momentum; `changed`: of velocity [m/s].

    Momenta are about the origin, relative to sum m |v| and sum m |x||v| of the start. Weights of size 0.1: at 0.2 this draw is no
    longer elliptic, the body tears, and rounding is relative to stresses a hundred times larger.
    """
    n = 4
    state = agitated(
        n,
        SPACING,
        (-0.5 * n * SPACING,) * 3,
        (0.3, -0.2, 0.1),
        dtype=dtype,
        strain=0.01,
        jitter=0.2,
    )
    volume = uniform_volume(state, SPACING)
    mass = DENSITY * volume
    sim = Simulator(law, dx=DX, substeps=substeps, frame_dt=substeps * DT, gravity=(0, 0, 0), dtype=dtype,
                    options=LawOptions(on_inversion="ignore"))  # fmt: skip
    adapter = random_adapter(size=0.1, dtype=dtype, plastic=sim.law.plastic) if adapted else None
    speed, arm = state.v.double().norm(dim=1), state.x.double().norm(dim=1)
    scales = float((mass * speed).sum()), float((mass * speed * arm).sum())
    start, first = momenta(state, mass, DX), state.v.clone()
    worst = {"mass": 0.0, "linear": 0.0, "angular": 0.0}
    with torch.no_grad():
        for i in range(intervals):
            state = sim.rollout(state, parameters or parameters_of(law), volume, DENSITY, 2, adapter=adapter, stride=10,
                                started=i > 0).final  # fmt: skip
            # the grid of the last substep is still in the buffers that the rollout used
            grids = [float(work.grid_slots()[0, -1, :, 3].double().sum()) for work in sim.buffers]
            total = float(mass.double().sum())
            worst["mass"] = max(worst["mass"], *(abs(g - total) / total for g in grids))
            for name, before, now, scale in zip(
                ("linear", "angular"), start, momenta(state, mass, DX), scales
            ):
                worst[name] = max(worst[name], float((now - before).abs().max()) / scale)
    return {**worst, "changed": float((state.v - first).abs().max())}


@wp.func
def asymmetric(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    return p[0] * (F - wp.identity(n=3, dtype=wp.float64))


def asymmetric_control() -> dict[str, float]:
    """`conservation` of tau = mu (F - I), whose skew part is a torque on every particle."""
    register_law("verification_asymmetric", asymmetric, ("mu", "lam"))
    return conservation(
        "verification_asymmetric", torch.float64, adapted=False, parameters={"mu": MU, "lam": LAM}
    )


def vibration(law: str = "corotated", *, periods: int = 20, size: int = 8, amplitude: float = 0.02, dtype=torch.float64,
              **adapter_options) -> list[float]:  # fmt: skip
    """Largest kinetic energy [J] in each period of a block that was given the velocity of its first longitudinal mode.

    The operator is constant, so with major symmetry the body has an energy, and explicit MLS-MPM with APIC only loses it.
    """
    dx = DX
    x = lattice((2 * size, size, size), SPACING)
    length = 2 * size * SPACING
    state = resting(x, dtype=dtype)
    speed = math.sqrt(MU * (3 * LAM + 2 * MU) / (LAM + MU) / DENSITY)
    v = torch.zeros_like(state.x)
    v[:, 0] = -amplitude * speed * torch.cos(math.pi * x[:, 0] / length)
    C = torch.zeros(len(x), 3, 3, dtype=dtype)
    C[:, 0, 0] = amplitude * speed * math.pi / length * torch.sin(math.pi * x[:, 0] / length)
    state = ParticleState(state.x, v, C, eyes(len(x), dtype), eyes(len(x), dtype))
    volume = uniform_volume(state, SPACING)
    adapter = None
    if adapter_options:
        adapter = random_adapter(
            state_dependence="constant", no_pre=True, no_post=True, dtype=dtype, **adapter_options
        )
    period = 2 * length / speed
    frames_per_period = 20
    frame_dt = period / frames_per_period
    substeps = math.ceil(frame_dt * math.sqrt(1.85 * (LAM + 2 * MU) / DENSITY) / (0.5 * dx))
    sim = Simulator(
        law, dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=(0, 0, 0), dtype=dtype
    )
    mass = DENSITY * volume[:, None].double()
    with torch.no_grad():
        rollout = sim.rollout(state, {"mu": MU, "lam": LAM}, volume, DENSITY, periods * frames_per_period + 1, adapter=adapter,
                              stride=substeps)  # fmt: skip
    energy = 0.5 * (mass * rollout.v.double() ** 2).sum((1, 2))
    return energy[1:].reshape(periods, frames_per_period).amax(1).tolist()
