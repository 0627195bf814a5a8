"""Planes: what each mode does to a node velocity, and its adjoint; errors."""

import pytest
import torch
import warp as wp

from mosa.errors import ConfigError
from mosa.physics.contact.grid_update import update_kernels
from mosa.physics.contact.planes import (
    MODES,
    SLOW,
    THICKNESS,
    Plane,
    ground_plane,
    make_plane_functions,
    pack_planes,
)
from mosa.physics.contact.touch import planes_struct
from mosa.physics.grid.stencil import stencil_functions
from mosa.physics.launching import filled
from mosa.types import Ground

collide, adj_collide = make_plane_functions(wp.float64)


@wp.kernel(module="unique", enable_backward=False)
def both(u: wp.array(dtype=wp.vec3d), normal: wp.vec3d, mode: int, friction: wp.float64, a: wp.array(dtype=wp.vec3d),
         r: wp.array(dtype=wp.vec3d), adjoint: wp.array(dtype=wp.vec3d)):  # fmt: skip
    i = wp.tid()
    r[i] = collide(u[i], normal, mode, friction)
    adjoint[i] = adj_collide(u[i], normal, mode, friction, a[i])


def run(u, normal, mode, friction, a=None):
    a = torch.zeros_like(u) if a is None else a
    r, adjoint = torch.zeros_like(u), torch.zeros_like(u)
    arrays = [wp.from_torch(t, dtype=wp.vec3d) for t in (u, a, r, adjoint)]
    wp.launch(
        both,
        len(u),
        inputs=[arrays[0], wp.vec3d(*normal), MODES[mode], friction, *arrays[1:]],
        device="cpu",
    )
    return r, adjoint


UP = (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    "mode, friction, u, expected",
    [
        ("sticky", 0.0, (1, -2, 3), (0, 0, 0)),
        ("slip", 0.0, (1, -2, 3), (1, 0, 3)),
        ("slip", 0.0, (1, 2, 3), (1, 0, 3)),
        ("separate", 0.0, (1, -2, 3), (1, 0, 3)),
        ("separate", 0.0, (1, 2, 3), (1, 2, 3)),
        ("separate", 0.5, (3, -2, 4), (2.4, 0, 3.2)),
        ("separate", 2.5, (3, -2, 4), (0, 0, 0)),
        ("separate", 0.5, (3, 2, 4), (3, 2, 4)),
    ],
)
def test_modes(mode, friction, u, expected):
    r, _ = run(torch.tensor([u], dtype=torch.float64), UP, mode, friction)
    torch.testing.assert_close(r, torch.tensor([expected], dtype=torch.float64), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    "mode, friction", [("sticky", 0.0), ("slip", 0.0), ("separate", 0.0), ("separate", 0.3)]
)
def test_adjoint(mode, friction):
    generator = torch.Generator().manual_seed(0)
    u, a, du = (torch.randn(200, 3, generator=generator, dtype=torch.float64) for _ in range(3))
    normal = torch.tensor([0.6, 0.8, 0.0]).tolist()
    _, adjoint = run(u, normal, mode, friction, a)
    h = 1e-6
    plus, minus = (
        run(u + h * du, normal, mode, friction)[0],
        run(u - h * du, normal, mode, friction)[0],
    )
    difference = (a * (plus - minus)).sum(1) / (2 * h)
    # a velocity within a step of leaving or of sticking has no derivative there
    un = u @ torch.tensor(normal).double()
    slide = (u - un[:, None] * torch.tensor(normal).double()).norm(dim=1) + friction * un
    smooth = (un.abs() > 1e-4) & (slide.abs() > 1e-2)
    assert smooth.sum() > 150
    torch.testing.assert_close(
        (adjoint * du).sum(1)[smooth], difference[smooth], rtol=1e-6, atol=1e-7
    )


def updated(momentum, planes, seed=None, dx=0.1):
    """Velocities (M, 3) of a row of nodes along y after contact, or the adjoint of `seed` (M, 3) with respect to their momenta;
    mass 1."""
    kernels, count = update_kernels(wp.float64), len(momentum)
    values, modes = pack_planes(planes, torch.float64, torch.device("cpu"), dx)
    grid = torch.cat([momentum, torch.ones(count, 1).double()], 1)
    windows = torch.tensor([[0, 0, 0], [1, count, 1], [0, 0, 0]], dtype=torch.int32)
    out = torch.zeros_like(grid)
    vec4 = wp.types.vector(4, wp.float64)
    grids = filled(
        stencil_functions(wp.float64).Grids,
        wp.from_torch(windows, dtype=wp.vec3i),
        count,
        dx,
        1 / dx,
    )
    met = filled(
        planes_struct(wp.float64), wp.from_torch(values), wp.from_torch(modes), len(planes)
    )
    still = wp.from_torch(torch.zeros(1, 3).double(), dtype=wp.vec3d)
    given = [grids, 1, wp.from_torch(grid, dtype=vec4), still, 0.0, met]
    if seed is None:
        wp.launch(
            kernels.grid_update, 1, [*given, wp.from_torch(out, dtype=vec4), None], device="cpu"
        )
    else:
        seeds = torch.cat([seed, torch.zeros(count, 1).double()], 1)
        fields = [wp.from_torch(t, dtype=vec4) for t in (seeds, out)]
        wp.launch(kernels.adj_grid, 1, [*given, *fields, None], device="cpu")
    return out[:, :3]


FLOORS = [
    Plane((0, 0.52, 0), (0, 1, 0), "separate", 0.3),
    Plane((0, 0.4, 0), (0.2, 1, 0), "separate", 0.1, 0.25),
]


def test_contact_above_a_plane_is_with_what_is_slow():
    """A node at rest but for gravity is held as one inside is; an impact is not felt above the plane."""
    speeds = torch.tensor([1e-4 * SLOW, SLOW, 100 * SLOW]).double()
    for speed in speeds:
        after = (
            updated(-speed * torch.tensor([[0.0, 1.0, 0.0]]).double().expand(8, 3), FLOORS[:1])[
                :, 1
            ]
            / -speed
        )
        assert (
            torch.equal(after[:6], torch.zeros(6).double()) and after[7] == 1
        )  # inside; 1.8 cells above
        share = 1 / (1 + float(speed / SLOW) ** 2)
        assert float(after[6]) == pytest.approx(
            1 - share * 0.8753, abs=1e-4
        )  # 0.8 cells above, where the fade is 0.8753


def test_adjoint_of_contact_that_fades():
    generator = torch.Generator().manual_seed(2)
    for scale in (0.3 * SLOW, SLOW, 10 * SLOW):
        u, a, du = (torch.randn(12, 3, generator=generator, dtype=torch.float64) for _ in range(3))
        u, h = scale * u, 1e-6 * scale
        difference = (a * (updated(u + h * du, FLOORS) - updated(u - h * du, FLOORS))).sum(1) / (
            2 * h
        )
        torch.testing.assert_close(
            (updated(u, FLOORS, a) * du).sum(1), difference, rtol=1e-5, atol=1e-6
        )


def test_ground_is_below_its_height_along_up():
    plane = ground_plane(Ground(0.3, "separate", 0.2), torch.tensor([0.0, 0.0, 2.0]))
    assert plane.point == pytest.approx((0, 0, 0.3)) and plane.normal == pytest.approx((0, 0, 1))
    values, modes = pack_planes([plane], torch.float64, torch.device("cpu"), 0.1)
    torch.testing.assert_close(
        values, torch.tensor([[0, 0, 1, 0.3, 0.2, THICKNESS * 0.1]]).double()
    )
    assert modes.tolist() == [2]


@pytest.mark.parametrize(
    "given, match",
    [
        (((0, 0, 0), UP, "bouncy"), r"plane\.mode.*'bouncy'"),
        (((0, 0, 0), UP, ["slip"]), r"plane\.mode: expected a text"),
        (((0, 0, 0), UP, "separate", -1.0), r"plane\.friction"),
        (((0, 0, 0), UP, "slip", 0.5), "separate and touch only"),
        (((0, 0, 0), (0, 0, 0)), r"plane\.normal: expected a non-zero vector"),
        (((0, 0, 0, 0), UP), r"plane\.point: expected a tuple of three finite numbers"),
        (((0, 0, 0), "up"), r"plane\.normal: expected a tuple of three finite numbers"),
        (((0, 0, 0), (0, float("inf"), 0)), r"plane\.normal: expected a tuple"),
        (((0, 0, 0), UP, "separate", 0.1, -1.0), r"plane\.thickness"),
    ],
)
def test_errors(given, match):
    with pytest.raises(ConfigError, match=match):
        Plane(*given)
