"""How a body is simulated: grid, time step, precision."""

from __future__ import annotations

from dataclasses import dataclass

from mosa.errors import ConfigError


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
