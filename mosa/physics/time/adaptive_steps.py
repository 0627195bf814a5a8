"""Substeps chosen frame by frame from the state at the frame's start.

The count of a frame is a step function of the state and so of the parameters: between its jumps it is constant, the rollout is one
fixed sequence of substeps, and its gradient is exact for the counts taken. They are decided once, going forward, without gradient;
segments recomputed in the backward pass carry their time step with them. `Rollout.counts` records them. Across a jump of a count
the loss itself jumps by the integrator's error, which no gradient sees.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.errors import ConfigError, SimulationDiverged
from mosa.physics.constitutive.laws import Law
from mosa.physics.engine.material_operations import kirchhoff_stress
from mosa.physics.engine.numerics import Numerics, State
from mosa.physics.time.time_step import VISCOUS_NUMBER, step_rate

STRETCH = 1e-3
"""Relative stretch of the differences that measure the stiffness: exact to 1e-6 of it in float64, 1e-4 in float32."""


@dataclass(frozen=True)
class StepControl:
    """Bounds of the substeps per frame. courant: c dt/dx; factor: by which an adapter may stiffen the body; minimum, maximum:
    `simulation.min_substeps`, `simulation.max_substeps`; multiple: counts are rounded up to it, at most to the maximum, so that the
    segments' buffers come in few sizes and the adapter's strides are whole. Errors: ConfigError for a minimum above the maximum."""

    courant: float = 0.6
    factor: float = 1.0
    minimum: int = 1
    maximum: int = 400
    multiple: int = 8

    def __post_init__(self) -> None:
        if self.minimum > self.maximum:
            raise ConfigError(
                f"simulation.min_substeps: expected at most simulation.max_substeps ({self.maximum}), found {self.minimum}"
            )


@torch.no_grad()
def current_modulus(law: Law, F: Tensor, C_affine: Tensor, parameters: Tensor) -> Tensor:
    """(N,) modulus [Pa] of the longitudinal wave as the material is deformed now, without an adapter: c = sqrt(M/rho_0).

    Largest over the principal axes n of F F^T of d tau_nn/d log(lambda_n) + max(-tau_nn, 0), by central differences of the law's
    stress at fixed C_affine. The first term is the material's, the second that of the moving particles (the acoustic tensor has
    -tau_nn in tension too, where it softens; that is not relied on). F: (N, 3, 3); parameters: packed, (N, SLOTS)."""
    axes = torch.linalg.eigh((F @ F.mT).double()).eigenvectors.to(F.dtype)
    tau = kirchhoff_stress(law, F, C_affine, parameters)
    result = torch.full_like(F[:, 0, 0], -math.inf)
    for i in range(3):
        n = axes[:, :, i]
        stretch = STRETCH * torch.einsum("pi,pj,pjk->pik", n, n, F)
        after, before = (
            kirchhoff_stress(law, F + s * stretch, C_affine, parameters) for s in (1.0, -1.0)
        )
        slope = torch.einsum("pi,pij,pj->p", n, after - before, n) / (2 * STRETCH)
        result = torch.maximum(
            result, slope + (-torch.einsum("pi,pij,pj->p", n, tau, n)).clamp_min(0)
        )
    return result


class StepChooser:
    """Decides the substeps of the frames of one rollout.

    parameters: physical values by name; packed: (N, SLOTS); density: number or (N,) [kg/m^3]; frame_dt [s]; collider_speed [m/s]:
    bound of the speed of any collider's surface."""

    def __init__(
        self, control: StepControl, numerics: Numerics, parameters: dict[str, Tensor], packed: Tensor,
        density: float | Tensor, frame_dt: float, collider_speed: float = 0.0,
    ) -> None:  # fmt: skip
        self.control, self.numerics, self.packed = control, numerics, packed.detach()
        self.density, self.frame_dt = density, float(frame_dt)
        n, law = len(packed), numerics.law
        values = {k: torch.as_tensor(v).detach().to(packed) for k, v in parameters.items()}
        self.rest_modulus = law.wave_modulus(values).expand(n)
        self.viscosity = law.explicit_viscosity(values).expand(n)
        # what the frame itself can add to the speeds at its start
        self.fall = math.hypot(*numerics.gravity) * self.frame_dt
        self.collider_speed = collider_speed

    @torch.no_grad()
    def choose(self, frame: int, state: State, collider_speed: float | None = None) -> int:
        """Substeps from frame - 1 to `frame`. state: at frame - 1; collider_speed [m/s]: in this frame, None for the bound in any.

        A law that softens in compression is not followed below its stiffness at rest: it may be back there within the frame.
        Errors: SimulationDiverged for a state that is not finite; ConfigError where more than the maximum would be needed."""
        control, dx, (_, v, C_affine, F, _) = self.control, self.numerics.dx, state
        finite = torch.isfinite(torch.cat([F, C_affine, v[..., None]], -1)).flatten(1).all(1)
        if not bool(finite.all()):
            bad = int((~finite).nonzero()[0])
            raise SimulationDiverged(f"frame {frame}: particle {bad} is not finite at its start")
        J = torch.linalg.det(F)
        law, rest = self.numerics.law, self.rest_modulus
        modulus = torch.maximum(current_modulus(law, F, C_affine, self.packed), rest)
        # an inverted element has no modulus where the law has no value: the first substep names it
        modulus = torch.where(J > 0, modulus, rest) if law.needs_positive_J else modulus
        speed = (control.factor * modulus / self.density).sqrt()
        # of a fluid per current volume, as the mass is
        viscosity = self.viscosity * (1.0 if law.damped else J.clamp_min(0))
        rate = speed / (control.courant * dx) + viscosity / (
            VISCOUS_NUMBER * self.density * dx * dx
        )
        stiffest, fastest = int(rate.argmax()), float(v.norm(dim=1).max())
        fastest += self.fall + (self.collider_speed if collider_speed is None else collider_speed)
        c, mu = float(speed[stiffest]), float(viscosity[stiffest])
        density = self.density
        density = float(density[stiffest] if isinstance(density, Tensor) else density)
        if not math.isfinite(c):
            raise SimulationDiverged(f"frame {frame}: stress of particle {stiffest} is not finite")
        each = step_rate(c, mu, density, dx, fastest, control.courant)
        needed = max(1, math.ceil(min(1e9, self.frame_dt * each)))
        if needed > control.maximum:
            raise ConfigError(
                f"simulation.max_substeps: expected at least {needed} for frame {frame}, found {control.maximum}: particle "
                f"{stiffest} has wave speed {c:.3g} m/s at det F = {float(J[stiffest]):.3g} (modulus "
                f"{float(modulus[stiffest]):.3g} Pa, at rest {float(self.rest_modulus[stiffest]):.3g}, viscosity {mu:.3g} Pa s), "
                f"speeds reach {fastest:.3g} m/s, dx {dx:.3g} m, frame {self.frame_dt:.3g} s; use a coarser grid "
                "(simulation.dx), a softer start, or raise the limit"
            )
        wanted = max(needed, control.minimum)
        return min(-(-wanted // control.multiple) * control.multiple, control.maximum)
