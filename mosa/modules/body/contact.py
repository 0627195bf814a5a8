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
    UNKNOWN, LIMITS = 0.4, (-0.5, 1.0)
    """Cells: standard deviation and bounds where nobody says how well the height of the ground is known. Another simulator's contact,
    or a ground that is 10 mm off, lies outside of what a grid alone does."""
    NARROW, WITHIN = 0.05, (0.15, 0.55)
    """The same where only free rollouts or images are compared: beyond, E has a second valley there, and the number absorbs what the
    law gets wrong."""

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

    def prior(self, ground: Ground | None, free: bool) -> tuple[float, tuple[float, float]]:
        """(standard deviation about `START`, bounds) [cells]. ground: whose accuracy counts where it is known; free: whether only
        free rollouts are compared."""
        if ground is not None and ground.accuracy is not None:
            return math.hypot(self.GRID, ground.accuracy / self.dx), self.LIMITS
        return (self.NARROW, self.WITHIN) if free else (self.UNKNOWN, self.LIMITS)

    @torch.no_grad()
    def project(self) -> None:
        """Back within `WITHIN`, after a step of Adam."""
        if self.enabled:
            self.cells.clamp_(*self.WITHIN)
