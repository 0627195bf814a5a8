"""The height at which a grid's contact begins, as a number that is learned."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mosa.types import Ground


class ContactOffset(nn.Module):
    """Height [m] by which the grid's contact lies above the ground, learned in units of dx.

    A B-spline grid stops a body a fraction of dx before it touches a wall, by an amount that depends on dx and on the stencil's
    place; without this one number the stiffness absorbs it, differently on every grid.
    """

    START = 0.3
    """Cells the fit starts from; seen on balls, the bird and the rabbit: 0.2 to 0.5. From 0 the fit ends in another valley."""
    LIMITS = (0.15, 0.55)
    """What a grid can do; beyond, the number would absorb what the law gets wrong, and so end in that other valley."""

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

    @torch.no_grad()
    def project(self) -> None:
        """Back within `LIMITS`, after an optimiser's step."""
        if self.enabled:
            self.cells.clamp_(*self.LIMITS)
