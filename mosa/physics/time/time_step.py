"""How many substeps a frame needs: the bound of elastic waves and particle speed, and that of explicit viscosity."""

import math

from mosa.errors import ConfigError

MOST_SUBSTEPS = 10**6
"""Of a frame or a step: it would take hours."""
VISCOUS_NUMBER = 0.4
"""Bound of mu dt/(rho dx^2) for a stress mu sym(C_affine). Measured: without elasticity, noise on a cube of fluid decays up to 0.6
with 2 or 3 particles per cell and axis and up to 0.5 with 1, and grows without limit at 0.8 and 0.6. With elasticity (mu 1 to 3000
Pa s, kappa 1e4 and 1e5 Pa, dx 0.04 m) it decays at the bound and at steps a quarter larger, everywhere."""


def wave_speed(modulus_max: float, density: float, factor: float = 1.0) -> float:
    """Speed bound c = sqrt(factor M / rho) [m/s]. modulus_max: M = lam + 2 mu [Pa]; density [kg/m^3].

    factor: what the adapter (1.85 at alpha 0.1, 2.45 at 0.15) and heterogeneity (1.2) may stiffen the body by."""
    return math.sqrt(factor * modulus_max / density)


def step_rate(
    speed: float, viscosity: float, density: float, dx: float, v_max: float, courant: float
) -> float:
    """1/dt [1/s] of the largest stable step. speed: wave speed c [m/s]; viscosity [Pa s] of a stress mu sym(C_affine).

    max(c/(courant dx) + viscosity/(VISCOUS_NUMBER rho dx^2), v_max/(dx/2)). The first two add up: with the damping of the last
    substep the limit of an oscillator is (2/omega)(sqrt(1 + zeta^2) - zeta) >= (2/omega)/(1 + 2 zeta)."""
    rate = speed / (courant * dx) + viscosity / (VISCOUS_NUMBER * density * dx) / dx
    return max(rate, v_max / (0.5 * dx))


def required_substeps(
    modulus_max: float, density: float, frame_dt: float, dx: float, v_max: float, factor: float = 1.0,
    courant: float = 0.6, limit: int = 10_000, viscosity: float = 0.0,
    limited_by: str = "simulation.max_substeps",
) -> int:  # fmt: skip
    """Fewest substeps per frame with c dt/dx <= courant and v_max dt <= dx/2 (SI units), less where a stress is viscous.

    viscosity [Pa s]: physical value of the largest one that acts explicitly (`Law.viscosity`), see `step_rate`.
    limited_by: the argument that sets `limit`.
    Errors: ConfigError when an argument is not positive, or when more than `limit` substeps would be needed."""
    values = {"modulus_max": modulus_max, "density": density, "frame_dt": frame_dt, "dx": dx}
    values |= {"factor": factor, "courant": courant}
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ConfigError(f"time step: {name}: expected a positive number, found {value}")
    for name, value in (("v_max", v_max), ("viscosity", viscosity)):
        if not (math.isfinite(value) and value >= 0):
            raise ConfigError(f"time step: {name}: expected a number >= 0, found {value}")
    speed = wave_speed(modulus_max, density, factor)
    count = max(
        1, math.ceil(min(1e9, frame_dt * step_rate(speed, viscosity, density, dx, v_max, courant)))
    )
    if count > limit:
        fast = v_max / 0.5 > speed / courant + viscosity / (VISCOUS_NUMBER * density * dx)
        way = ("a slower start or slower solids, fewer frames where no ground ends the fall" if fast
               else "a softer or denser body")  # fmt: skip
        viscous = f", viscosity {viscosity:.3g} Pa s" if viscosity else ""
        raise ConfigError(
            f"time step: {count} substeps per frame needed (wave speed {speed:.3g} m/s, modulus {modulus_max:.3g} Pa, density "
            f"{density:.4g} kg/m^3, dx {dx:.3g} m, frame {frame_dt:.3g} s, speed {v_max:.3g} m/s{viscous}), the limit is {limit}: "
            f"use a coarser grid (dx), {way}, or raise {limited_by}"
        )
    return count
