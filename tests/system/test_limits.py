"""Sizes that follow from data: they do not wrap, and are refused before memory is asked for."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mosa.data.hull import Volume
from mosa.environments.task import Task
from mosa.errors import ConfigError, DataError, MosaError, SimulationDiverged
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.physics.contact.mesh import field_of_triangles
from mosa.physics.contact.motion import Motion, sample_poses
from mosa.physics.engine.simulator import Simulator
from mosa.physics.grid.window import extent, grid_window
from mosa.physics.time.time_step import required_substeps
from mosa.reconstruction.geometry.filling import fill
from mosa.reconstruction.geometry.shell import solid_of
from mosa.rendering.rasterizer import rasterize
from mosa.rendering.tile_lists import tile_lists
from mosa.system.limits import counted
from mosa.types import Cameras, Splats

TETRAHEDRON = np.eye(4)[:, :3], np.array([[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]])
LAW = {"modulus_max": 1e5, "density": 1e3, "frame_dt": 0.01, "dx": 0.01, "v_max": 1.0}


@pytest.mark.parametrize("sizes", [
    (2**22, 2**21, 2**21), (2**32, 2**32), (2**63, 2), (1e9, 1e9, 1e9), (1e200, 1e200), (10**400,), (math.inf, 1), (math.nan, 1),
    (math.inf, 0), np.full(3, 3e9), torch.full((3,), 1e38),
])  # fmt: skip
def test_sizes_are_compared_before_they_can_wrap(sizes):
    """In int64 the first three products are 0."""
    with pytest.raises(DataError, match=r"^lattice: expected at most .* found .*: use fewer$"):
        counted("lattice", sizes, "use fewer", error=DataError)


def test_sizes_that_fit_are_whole_numbers():
    assert counted("lattice", torch.tensor([3.0, 4.0, 5.0]), "") == (3, 4, 5) and counted(
        "all", (6, 7), "", most=42
    ) == (6, 7)
    with pytest.raises(ConfigError, match="expected at most 41, found 6 x 7"):
        counted("all", (6, 7), "", most=41)


def tetrahedron(**options):
    return field_of_triangles(*TETRAHEDRON, **options)


def cube() -> Volume:
    return Volume(torch.ones(3, 3, 3), torch.zeros(3), 0.1)


def pictures(side: int, images: int):
    K = torch.eye(3).expand(images, 3, 3)
    cameras = Cameras(K, torch.eye(4).expand(images, 4, 4), side, side, ("a",) * images)
    one = torch.ones(1, 1, 3)
    return rasterize(
        one,
        torch.eye(3)[None, None],
        one[0, :, 0],
        one,
        cameras,
        torch.zeros(images, dtype=torch.long),
    )


def far_apart(size: float) -> Splats:
    means = size * torch.linspace(-1, 1, 300).view(100, 3)
    return Splats(
        means,
        torch.ones(100, 3),
        torch.tensor([[1.0, 0, 0, 0]]).expand(100, 4),
        torch.ones(100),
        torch.ones(100, 3),
    )


@pytest.mark.parametrize("ask, message", [
    (lambda: tetrahedron(spacing=1e-9), "nodes at spacing 1e-09 m"),
    (lambda: tetrahedron(spacing=1e-300), "nodes at spacing 1e-300 m"),
    (lambda: tetrahedron(margin=1e300), "nodes at spacing"),
    (lambda: fill(cube(), spacing=1e-7), "voxels of the object"),
    (lambda: fill(cube(), spacing=1e-25), "voxels of the object"),
    (lambda: solid_of(far_apart(3e38)), "extent inf"),
    (lambda: solid_of(far_apart(1e-30)), "expected Gaussians that enclose something"),  # each of them reaches over 1e32 voxels
    (lambda: pictures(60_000, 100), "rasterize: numbers"),
    (lambda: tile_lists(torch.zeros(2), torch.zeros(1, 1, 8), 2**20, 2**20), "tiles, of all images"),
    (lambda: Posterior([""], torch.zeros(1), torch.eye(1), torch.ones(1), 0.0).draws(10**12), "draws: expected at most"),
    (lambda: Task.draw(SimpleNamespace(drawn=((1, 2),)), 10**12, None), "trials: expected at most"),
    (lambda: sample_poses([Motion()], 10**9, 10**6, 1e-3, 0.0), "substeps of all frames"),
    (lambda: Simulator("corotated", dx=0.1, substeps=10**12, frame_dt=0.1), "substeps: .*at most 1000000,"),
    (lambda: required_substeps(**LAW | {"v_max": 1e300, "frame_dt": 1e300}), "substeps per frame needed"),
    (lambda: required_substeps(**LAW | {"dx": 1e-200}, viscosity=1.0), "substeps per frame needed"),
])  # fmt: skip
def test_more_than_the_machine_holds_is_refused(ask, message):
    with pytest.raises(MosaError, match=message):
        ask()


@pytest.mark.parametrize("speed", [1e8, 1e9, 2e18, 1e100, 1e300])
@pytest.mark.parametrize("first", [1, 4])
def test_a_window_of_any_speed_is_refused_by_its_nodes(speed, first):
    """At 1e9 m/s the number of nodes is 0 in int64. first: particles that are as fast."""
    x = torch.rand(4, 3, generator=torch.Generator().manual_seed(0)).double()
    v = torch.zeros_like(x)
    v[:first] = speed
    with pytest.raises(
        SimulationDiverged,
        match=r"particles spread over .* grid nodes of 0\.01 m, to .* \(speeds to",
    ):
        grid_window(x, v, 0.01, 1.0, 2)
    with pytest.raises(SimulationDiverged, match=r"from the origin|spread over"):
        grid_window(x * speed, 0 * v, 0.01, 1.0, 2, bounds=extent(x * speed, 0 * v).numpy())
