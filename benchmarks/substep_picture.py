"""The picture of a substep in docs/glossary.md:  python benchmarks/substep_picture.py [docs/images/substep.svg]

A plane body on a coarse grid: quadratic B-spline weights of one particle and the stretch of the others are computed, not drawn.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

CELL, SIDE = 46.0, 5
"""Pixels of a cell; cells of a panel's side."""
INK, PARTICLE, NODE, FAINT = "#222222", "#c2410c", "#1d4ed8", "#cccccc"
PANELS = (
    ("particles", "stress tau(F), adapter"),
    ("P2G", "mass, momentum, pull of tau to nodes"),
    ("grid", "v = p/m, gravity, contact"),
    ("G2P", "v, C, x and F of particles"),
)


def weights(place: float) -> tuple[int, np.ndarray]:
    """(first of three nodes, their quadratic B-spline weights (3,)) along one axis at `place` [cells]."""
    first = int(np.floor(place - 0.5))
    d = place - first
    return first, np.array([0.5 * (1.5 - d) ** 2, 0.75 - (d - 1) ** 2, 0.5 * (d - 0.5) ** 2])


def body() -> tuple[np.ndarray, np.ndarray]:
    """(positions (N, 2) [cells], velocities (N, 2)) of a square that leans and falls."""
    across, up = np.linspace(1.55, 3.45, 5), np.linspace(0.65, 2.55, 5)
    x = np.stack(np.meshgrid(across, up, indexing="ij"), -1).reshape(-1, 2)
    x[:, 0] += 0.15 * (x[:, 1] - 1.6)
    return x, np.stack([0.10 * (x[:, 1] - 1.6), -0.42 + 0.05 * (x[:, 0] - 2.5)], 1)


class Drawing:
    """SVG of panels side by side."""

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.left = 0.0

    def at(self, point) -> tuple[float, float]:
        """Pixels of a point [cells]; y upwards."""
        return self.left + CELL * float(point[0]), 40 + CELL * (SIDE - float(point[1]))

    def line(self, a, b, color: str, width: float = 1.0, arrow: bool = False) -> None:
        (x1, y1), (x2, y2) = self.at(a), self.at(b)
        head = f' marker-end="url(#{"node" if color == NODE else "particle"})"' if arrow else ""
        self.parts.append(
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{color}" '
            f'stroke-width="{width:.2f}"{head}/>'
        )

    def dot(self, point, radius: float, color: str, opacity: float = 1.0) -> None:
        x, y = self.at(point)
        self.parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{color}" fill-opacity="{opacity:.2f}"/>'
        )

    def text(self, x: float, y: float, words: str, size: int, weight: str = "normal") -> None:
        self.parts.append(
            f'<text x="{self.left + x:.1f}" y="{y:.1f}" font-size="{size}" font-weight="{weight}" '
            f'fill="{INK}" text-anchor="middle">{words}</text>'
        )

    def grid(self) -> None:
        for k in range(SIDE + 1):
            self.line((k, 0), (k, SIDE), FAINT)
            self.line((0, k), (SIDE, k), FAINT)

    def written(self) -> str:
        width, height = len(PANELS) * (CELL * SIDE + 30) + 10, CELL * SIDE + 72
        shape = '<path d="M0,0 L6,3 L0,6 z" fill="{1}"/>'
        mark = (
            '<marker id="{0}" viewBox="0 0 6 6" refX="5" refY="3" markerWidth="5" markerHeight="5" orient="auto">'
            + shape
        )
        marks = "".join(
            mark.format(*each) + "</marker>" for each in (("node", NODE), ("particle", PARTICLE))
        )
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif">'
            f'<rect width="100%" height="100%" fill="white"/><defs>{marks}</defs>\n'
            + "\n".join(self.parts)
            + "\n</svg>\n"
        )


def picture() -> str:
    """The four parts of a substep: particles, their sum on the grid, the grid's velocities, particles moved."""
    drawing, (x, v) = Drawing(), body()
    mass, momentum = np.zeros((SIDE + 1, SIDE + 1)), np.zeros((SIDE + 1, SIDE + 1, 2))
    for place, speed in zip(x, v):
        (i, wx), (j, wy) = (weights(p) for p in place)
        mass[i : i + 3, j : j + 3] += np.outer(wx, wy)
        momentum[i : i + 3, j : j + 3] += np.outer(wx, wy)[..., None] * speed
    touched = np.argwhere(mass > 1e-3)
    velocity = np.where(mass[..., None] > 1e-3, momentum / np.maximum(mass, 1e-9)[..., None], 0)
    velocity[..., 1] -= np.where(mass > 1e-3, 0.12, 0)  # gravity
    velocity[:, 0] = 0  # the sticky ground
    chosen = 7
    for k, (name, words) in enumerate(PANELS):
        drawing.left = 20 + k * (CELL * SIDE + 30)
        drawing.grid()
        drawing.text(CELL * SIDE / 2, 20, f"{k + 1}. {name}", 15, "bold")
        drawing.text(CELL * SIDE / 2, CELL * SIDE + 62, words, 12)
        if name == "particles":
            for place, speed in zip(x, v):
                drawing.dot(place, 4, PARTICLE)
                drawing.line(place, place + 0.8 * speed, PARTICLE, 1.2, arrow=True)
        elif name == "P2G":
            (i, wx), (j, wy) = (weights(p) for p in x[chosen])
            for place in x:
                drawing.dot(place, 3, PARTICLE, 0.35)
            for a in range(3):
                for b in range(3):
                    node = np.array([i + a, j + b], float)
                    drawing.line(x[chosen], node, NODE, 0.4 + 7 * wx[a] * wy[b])
                    drawing.dot(node, 2 + 9 * wx[a] * wy[b] ** 0.5, NODE, 0.8)
            drawing.dot(x[chosen], 5, PARTICLE)
        elif name == "grid":
            for node in touched:
                drawing.dot(node, 1.5 + 1.6 * mass[tuple(node)] ** 0.5, NODE, 0.8)
                drawing.line(node, node + 0.9 * velocity[tuple(node)], NODE, 1.4, arrow=True)
        else:
            for place in x:
                (i, wx), (j, wy) = (weights(p) for p in place)
                found = np.einsum("a,b,abd->d", wx, wy, velocity[i : i + 3, j : j + 3])
                drawing.dot(place, 3, PARTICLE, 0.25)
                drawing.line(place, place + 0.9 * found, PARTICLE, 1.0)
                drawing.dot(place + 0.9 * found, 4, PARTICLE)
    return drawing.written()


def main() -> None:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images/substep.svg")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(picture())
    print(path)


if __name__ == "__main__":
    main()
