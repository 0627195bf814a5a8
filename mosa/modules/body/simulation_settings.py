"""How a body is simulated: grid, time step, precision."""

from __future__ import annotations

from dataclasses import MISSING, dataclass

from mosa.schema import FLAG, POSITIVE, Kind, check_knobs, is_number, knob, number, whole

PRECISION = Kind("32 or 64 (16 bits cannot carry an MPM)", lambda v: is_number(v) and v in (32, 64))


@dataclass(frozen=True)
class SimulationSettings:
    """dx [m]; `stride`: substeps between evaluations of the networks; `max_substeps` per frame; `precision`: 32 | 64;
    `adaptive`: choose the substeps of each frame from the state at its start, at least `min_substeps` (`adaptive_steps.py`)."""

    dx: float = knob(MISSING, POSITIVE)
    stride: int = knob(8, whole(1, 10**6))
    max_substeps: int = knob(400, whole(1, 10**6))
    courant: float = knob(0.6, number(0, 1, above=True))  # beyond, an explicit step is unstable
    precision: int = knob(32, PRECISION)
    contact_offset: bool = knob(True, FLAG)
    adaptive: bool = knob(False, FLAG)
    min_substeps: int = knob(1, whole(1, 10**6))

    def strides(self, least: int) -> int:
        """Substeps of the fewest whole strides that are at least `least`."""
        return self.stride * -(-least // self.stride)

    def __post_init__(self) -> None:
        check_knobs(self, "simulation")
