"""A block of neo-Hookean material in Taichi, the scheme of `mosa.physics`, for comparison.

MLS-MPM, APIC, quadratic B-splines. Tuned as Taichi programs are: dense fields, one array for each
component of the particles, stencils unrolled, many substeps in one kernel call where no gradient is
wanted, and the grid cleared by the kernel that reads it. Gradients are Taichi's own, by reverse
differentiation of three kernels; all states are kept and the grid is made again for each substep
(as DiffTaichi does it, Hu et al. 2020).
"""

# no `from __future__ import annotations` here: Taichi reads the annotations of kernels

from dataclasses import dataclass

import numpy as np
import taichi as ti

UNROLLED = 4
"""Substeps of one kernel call without gradients: even, as states alternate between two places."""
PER_STATE = 96
"""Bytes of a particle's state: x, v, C, F; as many of its gradient."""


@dataclass(frozen=True)
class Scheme:
    """dx [m], dt [s], gravity along y [m/s^2], height of a sticky ground [m], mass [kg] and volume
    [m^3] of a particle, lam [Pa]."""

    dx: float
    dt: float
    gravity: float
    ground: float
    mass: float
    volume: float
    lam: float


@ti.data_oriented
class TaichiBody:
    """low, dims: (3,) lowest node and nodes per axis; states: kept at once, 2 without gradients."""

    def __init__(
        self, scheme: Scheme, particles: int, low, dims, states: int = 2, gradients: bool = False
    ) -> None:
        self.scheme, self.count, self.states = scheme, particles, states
        self.low, self.dims = tuple(map(int, low)), tuple(map(int, dims))
        kept = {"shape": (states, particles), "needs_grad": gradients, "layout": ti.Layout.SOA}
        self.x, self.v = (ti.Vector.field(3, ti.f32, **kept) for _ in range(2))
        self.C, self.F = (ti.Matrix.field(3, 3, ti.f32, **kept) for _ in range(2))
        self.mu = ti.field(ti.f32, shape=particles, needs_grad=gradients)
        nodes = {"shape": self.dims, "needs_grad": gradients}
        self.grid = ti.Vector.field(4, ti.f32, **nodes)
        self.velocity = ti.Vector.field(3, ti.f32, **nodes)

    def load(self, x, v, C, F, mu: float) -> None:
        """(N, 3) and (N, 3, 3) arrays as state 0."""
        self._load(*(np.ascontiguousarray(a, dtype=np.float32) for a in (x, v, C, F)))
        self.mu.fill(mu)
        self.grid.fill(0.0)

    @ti.kernel
    def _load(
        self,
        x: ti.types.ndarray(),  # type: ignore[valid-type]
        v: ti.types.ndarray(),  # type: ignore[valid-type]
        C: ti.types.ndarray(),  # type: ignore[valid-type]
        F: ti.types.ndarray(),  # type: ignore[valid-type]
    ):
        for p in range(self.count):
            for i in ti.static(range(3)):
                self.x[0, p][i] = x[p, i]
                self.v[0, p][i] = v[p, i]
                for j in ti.static(range(3)):
                    self.C[0, p][i, j] = C[p, i, j]
                    self.F[0, p][i, j] = F[p, i, j]

    @ti.func
    def around(self, x):
        """(lowest node of the stencil, as an index; distances from it; weights)."""
        cells = x * (1.0 / self.scheme.dx)
        base = ti.cast(ti.floor(cells - 0.5), ti.i32)
        f = cells - ti.cast(base, ti.f32)
        w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
        return base - ti.Vector(self.low), f, w

    @ti.func
    def scatter(self, s, p):
        base, f, w = self.around(self.x[s, p])
        F = self.F[s, p]
        one = ti.Matrix.identity(ti.f32, 3)
        tau = (
            self.mu[p] * (F @ F.transpose() - one) + self.scheme.lam * ti.log(F.determinant()) * one
        )
        stiffness = self.scheme.dt * self.scheme.volume * 4.0 / self.scheme.dx**2
        B = self.scheme.dx * (self.scheme.mass * self.C[s, p] - stiffness * tau)
        # affine in the node: columns of B are its increments along the axes
        bx, by, bz = self.columns(B)
        q0 = self.scheme.mass * self.v[s, p] - f[0] * bx - f[1] * by - f[2] * bz
        for i, j in ti.static(ti.ndrange(3, 3)):
            qij, wij = q0 + i * bx + j * by, w[i][0] * w[j][1]
            for k in ti.static(range(3)):
                weight = wij * w[k][2]
                q = weight * (qij + k * bz)
                self.grid[base + ti.Vector([i, j, k])] += ti.Vector(
                    [q[0], q[1], q[2], weight * self.scheme.mass]
                )

    @ti.func
    def columns(self, A):
        return (
            ti.Vector([A[0, 0], A[1, 0], A[2, 0]]),
            ti.Vector([A[0, 1], A[1, 1], A[2, 1]]),
            ti.Vector([A[0, 2], A[1, 2], A[2, 2]]),
        )

    @ti.func
    def node(self, i, j, k):
        g = self.grid[i, j, k]
        u = ti.Vector([0.0, 0.0, 0.0])
        if g[3] > 0.0 and (j + self.low[1]) * self.scheme.dx > self.scheme.ground + 1e-6:
            u = ti.Vector([g[0], g[1], g[2]]) / g[3] + ti.Vector(
                [0.0, self.scheme.dt * self.scheme.gravity, 0.0]
            )
        self.velocity[i, j, k] = u

    @ti.func
    def gather(self, s, t, p):
        x = self.x[s, p]
        base, f, w = self.around(x)
        v, cx, cy, cz = (
            ti.Vector([0.0, 0.0, 0.0]),
            ti.Vector([0.0, 0.0, 0.0]),
            ti.Vector([0.0, 0.0, 0.0]),
            ti.Vector([0.0, 0.0, 0.0]),
        )
        for i, j in ti.static(ti.ndrange(3, 3)):
            wij = w[i][0] * w[j][1]
            a = w[0][2] * self.velocity[base + ti.Vector([i, j, 0])]
            b = w[1][2] * self.velocity[base + ti.Vector([i, j, 1])]
            c = w[2][2] * self.velocity[base + ti.Vector([i, j, 2])]
            line = wij * (a + b + c)
            v += line
            cz += wij * (b + 2.0 * c)
            if ti.static(i > 0):
                cx += i * line
            if ti.static(j > 0):
                cy += j * line
        scale = 4.0 / self.scheme.dx
        cx, cy, cz = scale * (cx - f[0] * v), scale * (cy - f[1] * v), scale * (cz - f[2] * v)
        C = ti.Matrix([[cx[0], cy[0], cz[0]], [cx[1], cy[1], cz[1]], [cx[2], cy[2], cz[2]]])
        F = self.F[s, p]
        self.x[t, p] = x + self.scheme.dt * v
        self.v[t, p] = v
        self.C[t, p] = C
        self.F[t, p] = F + self.scheme.dt * (C @ F)

    @ti.kernel
    def advance(self):
        """`UNROLLED` substeps between states 0 and 1."""
        for s in ti.static(range(UNROLLED)):
            for p in range(self.count):
                self.scatter(s % 2, p)
            for i, j, k in self.grid:
                self.node(i, j, k)
                self.grid[i, j, k] = ti.Vector([0.0, 0.0, 0.0, 0.0])
            for p in range(self.count):
                self.gather(s % 2, (s + 1) % 2, p)

    @ti.kernel
    def p2g(self, s: ti.i32):
        for p in range(self.count):
            self.scatter(s, p)

    @ti.kernel
    def update(self):
        for i, j, k in self.grid:
            self.node(i, j, k)

    @ti.kernel
    def g2p(self, s: ti.i32):
        for p in range(self.count):
            self.gather(s, s + 1, p)

    @ti.kernel
    def made_again(self, s: ti.i32):
        """The grid of substep s and its velocities, gradients of both cleared."""
        for i, j, k in self.grid:
            self.grid[i, j, k] = ti.Vector([0.0, 0.0, 0.0, 0.0])
            self.grid.grad[i, j, k] = ti.Vector([0.0, 0.0, 0.0, 0.0])
            self.velocity.grad[i, j, k] = ti.Vector([0.0, 0.0, 0.0])
        for p in range(self.count):
            self.scatter(s, p)
        for i, j, k in self.grid:
            self.node(i, j, k)

    @ti.kernel
    def kept(self, s: ti.i32):
        """A substep from state s to state s + 1."""
        for p in range(self.count):
            self.scatter(s, p)
        for i, j, k in self.grid:
            self.node(i, j, k)
            self.grid[i, j, k] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for p in range(self.count):
            self.gather(s, s + 1, p)

    @ti.kernel
    def seed(self, s: ti.i32):
        """The gradient of sum |x|^2 at state s, all others 0."""
        for t, p in self.x:
            self.x.grad[t, p] = ti.select(t == s, 2.0, 0.0) * self.x[t, p]
            self.v.grad[t, p] = ti.Vector([0.0, 0.0, 0.0])
            self.C.grad[t, p] = ti.Matrix.zero(ti.f32, 3, 3)
            self.F.grad[t, p] = ti.Matrix.zero(ti.f32, 3, 3)
        for p in self.mu:
            self.mu.grad[p] = 0.0

    def forward(self, substeps: int) -> None:
        """From state 0; the last one is there again, as the count is even."""
        for _ in range(substeps // UNROLLED):
            self.advance()

    def both(self) -> None:
        """All states from state 0 on, and gradients of the last one's sum |x|^2 with respect to the first and to mu."""
        last = self.states - 1
        self.grid.fill(0.0)
        for s in range(last):
            self.kept(s)
        self.seed(last)
        for s in reversed(range(last)):
            self.made_again(s)
            self.g2p.grad(s)
            self.update.grad()
            self.p2g.grad(s)
