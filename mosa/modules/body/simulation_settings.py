"""How a body is simulated: grid, time step, precision."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from annotated_types import Interval
from pydantic import Field, model_validator

from mosa.errors import ConfigError
from mosa.settings import Expected, Positive, Settings

Substeps = Annotated[int, Interval(ge=1, le=10**6)]


class TimeStepping(Settings):
    """What the rollouts of a body are made with, whatever its grid."""

    where: ClassVar[str] = "simulation"
    needs: ClassVar[dict[str, str]] = {"min_substeps": "adaptive=true"}

    stride: Substeps = 8
    """substeps between evaluations of the adapter's networks (adapter=mosa, direct); a frame has a multiple of it"""
    max_substeps: Substeps = 400
    """substeps of a frame, at most"""
    courant: float = Field(0.6, gt=0, le=1)
    """Courant number, wave speed times dt/dx; above 1 an explicit step is unstable"""
    adaptive: bool = False
    """choose the substeps of each frame from the state at its start: current stiffness and speed"""
    min_substeps: Substeps = 1
    """substeps of a frame, at least"""
    precision: Annotated[Literal[32, 64], Expected("32 or 64 (16 bits cannot carry an MPM)")] = 32
    """bits of the simulation's numbers"""
    contact_offset: bool = True
    """learn the height [m] above the ground at which the grid stops the body"""

    def strides(self, least: int) -> int:
        """Substeps of the fewest whole strides that are at least `least`."""
        return self.stride * -(-least // self.stride)


class SimulationSettings(TimeStepping):
    """Of a body on its grid. dx [m]: spacing of the grid."""

    dx: Positive


class SimulationSection(TimeStepping):
    """The section `simulation`: how fine the body is, and its time steps."""

    needs: ClassVar[dict[str, str]] = {"particles": "dx=null"}

    particles: Annotated[int, Interval(ge=8, le=10**8)] | Literal["auto"] = "auto"
    """particles of the body; auto: as many as its thin parts need, 4000 to 6000 on a CPU and to 30000 on a GPU"""
    particles_per_cell: float = Field(4, ge=1, le=64)
    """particles per grid cell"""
    dx: Positive | None = None
    """grid spacing [m]; null: from particles and particles_per_cell"""

    @model_validator(mode="after")
    def _whole_strides(self) -> SimulationSection:
        if self.stride > self.max_substeps:
            raise ConfigError(
                f"simulation.stride: expected at most simulation.max_substeps={self.max_substeps}, as a frame has "
                f"whole strides, found {self.stride}"
            )
        return self

    def on_grid(self, dx: float) -> SimulationSettings:
        """Of a body on a grid of spacing dx [m]."""
        return SimulationSettings(
            **{name: getattr(self, name) for name in TimeStepping.model_fields}, dx=dx
        )
