"""The height at which a grid's contact begins, as a number that is learned."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from mosa.physics.contact.planes import NODE_MODES
from mosa.types import Ground

ROUNDED = 1e-3
"""Cells: a ground so near below a layer of nodes is at it."""
ON_BOUND = 1e-3
"""Cells from a bound within which a fit has ended on it."""


class ContactOffset(nn.Module):
    """Height [m] by which the grid's contact lies above the ground, learned in units of dx.

    A B-spline grid stops a body a fraction of dx before it touches a wall, by an amount that depends on dx and on the stencil's
    place; without this one number the stiffness absorbs it, differently on every grid.

    dx [m] of its methods: spacing of the grid that it is asked for."""

    START, GRID = 0.3, 0.15
    """What a grid does to balls, the bird and the rabbit, and its standard deviation [cells]."""
    UNKNOWN, LIMITS = 0.4, (-0.5, 1.0)
    """Standard deviation and bounds [cells] where the accuracy of the ground's height is unknown.

    The contact of another simulator, or a ground that is 10 mm off, lies outside of what a grid does."""
    NARROW, WITHIN = 0.05, (0.15, 0.55)
    """The same where only free rollouts or images are compared.

    E then has a second valley beyond these bounds, and the number absorbs errors of the law."""

    def __init__(self, enabled: bool = True) -> None:
        super().__init__()
        self.enabled = enabled
        self.cells = nn.Parameter(
            torch.tensor(self.START if enabled else 0.0), requires_grad=enabled
        )

    def height(self, ground: Ground | None, dx: float) -> Tensor:
        """Height [m] above the ground at which the grid stops a body. Particles that meet the ground
        themselves need none: there the change from `START` is the error of the stated height."""
        touched = ground is not None and ground.mode == "touch" and self.enabled
        return dx * (self.cells - self.START if touched else self.cells)

    def lift(self, ground: Ground | None, dx: float) -> Tensor:
        """Height [m] by which a body is simulated above where it is, over the ground `at_nodes`."""
        moved = self.at_nodes(ground, dx)
        gap = 0.0 if moved is None or ground is None else moved.height - ground.height
        return self.height(ground, dx) + gap

    def at_nodes(self, ground: Ground | None, dx: float) -> Ground | None:
        """The ground as it is simulated: at the highest layer of nodes below it, where nodes meet it.

        Otherwise what a body does would depend on where within a cell the ground lies."""
        if ground is None or ground.mode not in NODE_MODES or not self.enabled:
            return ground
        return replace(ground, height=dx * math.floor(ground.height / dx + ROUNDED))

    def prior(
        self, ground: Ground | None, dx: float, free: bool
    ) -> tuple[float, tuple[float, float]]:
        """(standard deviation about `START`, bounds) [cells].

        ground: where its accuracy is known, the bounds are two deviations; free: whether only free rollouts are compared."""
        if ground is not None and ground.accuracy is not None:
            sd = math.hypot(self.GRID, ground.accuracy / dx)
            low, high = self.LIMITS
            return sd, (max(low, self.START - 2 * sd), min(high, self.START + 2 * sd))
        return (self.NARROW, self.WITHIN) if free else (self.UNKNOWN, self.LIMITS)

    def at_limit(self, ground: Ground | None, dx: float) -> bool:
        """Whether a fit ended on a bound: the true contact is beyond it, or other errors look like one that is."""
        if ground is None or not self.enabled:
            return False
        cells = float(self.cells.detach())
        bounds = (each for free in (True, False) for each in self.prior(ground, dx, free)[1])
        return any(abs(cells - each) < ON_BOUND for each in bounds)

    @torch.no_grad()
    def project(self) -> None:
        """Back within `WITHIN`, after a step of Adam."""
        if self.enabled:
            self.cells.clamp_(*self.WITHIN)
