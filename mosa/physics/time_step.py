"""How many substeps a frame needs: the bound of method.md, section 6."""

import math

from mosa.errors import ConfigError


def wave_speed(modulus_max: float, density: float, factor: float = 1.0) -> float:
    """Speed bound c = sqrt(factor M / rho) [m/s]. modulus_max: M = lam + 2 mu [Pa]; density [kg/m^3].

    factor: what the adapter (1.85 at alpha 0.1, 2.45 at 0.15) and heterogeneity (1.2) may stiffen the body by.
    """
    return math.sqrt(factor * modulus_max / density)


def required_substeps(
    modulus_max: float, density: float, frame_dt: float, dx: float, v_max: float, factor: float = 1.0,
    courant: float = 0.6, limit: int = 10_000,
) -> int:  # fmt: skip
    """Fewest substeps per frame with c dt/dx <= courant and v_max dt <= dx/2 (SI units).

    Errors: ConfigError when an argument is not positive, or when more than `limit` substeps would be needed.
    """
    values = {"modulus_max": modulus_max, "density": density, "frame_dt": frame_dt, "dx": dx}
    values |= {"factor": factor, "courant": courant}
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ConfigError(f"time step: {name}: expected a positive number, found {value}")
    if not (math.isfinite(v_max) and v_max >= 0):
        raise ConfigError(f"time step: v_max: expected a number >= 0, found {v_max}")
    speed = wave_speed(modulus_max, density, factor)
    count = max(1, math.ceil(frame_dt * max(speed / (courant * dx), v_max / (0.5 * dx))))
    if count > limit:
        raise ConfigError(
            f"time step: {count} substeps per frame needed (wave speed {speed:.3g} m/s, modulus {modulus_max:.3g} Pa, density "
            f"{density:.4g} kg/m^3, dx {dx:.3g} m, frame {frame_dt:.3g} s, speed {v_max:.3g} m/s), the limit is {limit}: "
            "use a coarser grid (dx), a softer start, or raise simulation.max_substeps"
        )
    return count


def courant_number(modulus_max: float, density: float, dt: float, dx: float, factor: float = 1.0) -> float:
    """c dt/dx of a time step dt [s] on a grid of spacing dx [m]."""
    return wave_speed(modulus_max, density, factor) * dt / dx
