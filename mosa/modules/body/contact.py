"""The height at which a grid's contact begins, as a number that is learned."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from mosa.types import Ground


class ContactOffset(nn.Module):
    """Height [m] by which the grid's contact lies above the ground, learned in units of dx.

    A B-spline grid stops a body a fraction of dx before it touches a wall, by an amount that depends on dx and on the stencil's
    place; without this one number the stiffness absorbs it, differently on every grid.
    """

    START, GRID = 0.3, 0.15
    """Cells: what a grid does to balls, the bird and the rabbit, and the standard deviation of that."""
    LIMITS = (-0.5, 1.0)
    """Cells. Where the ground is 10 mm off, or another simulator made the motion, it is outside of what a grid alone does."""
    UNKNOWN = 0.4
    """Standard deviation [cells] of the height of contact where nobody says how well the ground's height is known."""

    def __init__(self, dx: float, enabled: bool = True) -> None:
        super().__init__()
        self.dx, self.enabled = dx, enabled
        self.cells = nn.Parameter(
            torch.tensor(self.START if enabled else 0.0), requires_grad=enabled
        )

    def forward(self) -> Tensor:
        return self.dx * self.cells

    def lift(self, ground: Ground | None) -> Tensor:
        """Height [m] by which a body is simulated above where it is. Particles that meet the ground themselves need none: there the
        number, from its start on, is what is not known of the ground's height."""
        touched = ground is not None and ground.mode == "touch" and self.enabled
        return self.dx * (self.cells - self.START) if touched else self()

    def deviation(self, ground: Ground | None) -> float:
        """Standard deviation [cells] of the prior about `START`, from how well the ground's height is known."""
        if ground is None or ground.accuracy is None:
            return self.UNKNOWN
        return math.hypot(self.GRID, ground.accuracy / self.dx)

    @torch.no_grad()
    def project(self) -> None:
        """Back within `LIMITS`, after an optimiser's step."""
        if self.enabled:
            self.cells.clamp_(*self.LIMITS)
