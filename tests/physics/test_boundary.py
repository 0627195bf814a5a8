"""Planes: what each mode does to a node velocity, and its adjoint; errors."""

import pytest
import torch
import warp as wp

from mosa.errors import ConfigError
from mosa.physics.contact.planes import MODES, THICKNESS, Plane, ground_plane, make_plane_functions, pack_planes
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
    wp.launch(both, len(u), inputs=[arrays[0], wp.vec3d(*normal), MODES[mode], friction, *arrays[1:]], device="cpu")
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


@pytest.mark.parametrize("mode, friction", [("sticky", 0.0), ("slip", 0.0), ("separate", 0.0), ("separate", 0.3)])
def test_adjoint(mode, friction):
    generator = torch.Generator().manual_seed(0)
    u, a, du = (torch.randn(200, 3, generator=generator, dtype=torch.float64) for _ in range(3))
    normal = torch.tensor([0.6, 0.8, 0.0]).tolist()
    _, adjoint = run(u, normal, mode, friction, a)
    h = 1e-6
    plus, minus = run(u + h * du, normal, mode, friction)[0], run(u - h * du, normal, mode, friction)[0]
    difference = (a * (plus - minus)).sum(1) / (2 * h)
    # a velocity within a step of leaving or of sticking has no derivative there
    un = u @ torch.tensor(normal).double()
    slide = (u - un[:, None] * torch.tensor(normal).double()).norm(dim=1) + friction * un
    smooth = (un.abs() > 1e-4) & (slide.abs() > 1e-2)
    assert smooth.sum() > 150
    torch.testing.assert_close((adjoint * du).sum(1)[smooth], difference[smooth], rtol=1e-6, atol=1e-7)


def test_ground_is_below_its_height_along_up():
    plane = ground_plane(Ground(0.3, "separate", 0.2), torch.tensor([0.0, 0.0, 2.0]))
    assert plane.point == pytest.approx((0, 0, 0.3)) and plane.normal == pytest.approx((0, 0, 1))
    values, modes = pack_planes([plane], torch.float64, torch.device("cpu"), 0.1)
    torch.testing.assert_close(values, torch.tensor([[0, 0, 1, 0.3, 0.2, THICKNESS * 0.1]]).double())
    assert modes.tolist() == [2]


@pytest.mark.parametrize(
    "plane, match",
    [
        (Plane((0, 0, 0), UP, "bouncy"), "plane 0: mode.*'bouncy'"),
        (Plane((0, 0, 0), UP, "separate", -1.0), "friction"),
        (Plane((0, 0, 0), UP, "slip", 0.5), "separate only"),
        (Plane((0, 0, 0), (0, 0, 0)), "normal"),
        (Plane((0, 0, 0), UP, "separate", 0.1, -1.0), "thickness"),
    ],
)
def test_errors(plane, match):
    with pytest.raises(ConfigError, match=match):
        pack_planes([plane], torch.float64, torch.device("cpu"), 0.1)
