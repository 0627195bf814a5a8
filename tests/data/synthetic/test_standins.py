"""Stand-ins for PAC-NeRF's scenes: published laws and parameters, films of what flows."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mosa.data.formats.pacnerf import PUBLISHED
from mosa.data.synthetic import load_builtin
from mosa.data.synthetic.bodies.objects import OBJECTS
from mosa.data.synthetic.bodies.standin_shapes import STANDIN_SHAPES
from mosa.data.synthetic.surface import flowing_surface
from mosa.modules.body.material import Material


@pytest.mark.parametrize("name", STANDIN_SHAPES)
def test_a_stand_in_has_the_published_parameters_cameras_and_frames(name):
    body = OBJECTS[name]
    assert body.material.known == PUBLISHED[name]
    assert body.footage.cameras == 11 and body.footage.fps == (
        50.0 if name == "toothpaste" else 24.0
    )
    taken = body.material.parameters(torch.zeros(3, 3))
    law = Material(body.material.law, dict(body.material.values)).per_particle()
    assert taken.keys() == law.keys() and all(
        torch.equal(taken[k], law[k].detach().expand(3)) for k in law
    )
    assert body.material.variant("isotropic") is body.material


def test_the_surface_of_particles_is_that_of_the_body_they_fill():
    spacing = 0.02
    axes = [np.arange(-0.2, 0.2 + spacing, spacing)] * 3
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    ball = points[np.linalg.norm(points, axis=-1) < 0.15]
    colors = np.where(ball[:, :1] > 0, [1.0, 0, 0], [0, 0, 1.0])
    found = flowing_surface(ball, colors, spacing, 0.01)
    radius = np.linalg.norm(found.vertices, axis=-1)
    assert radius.mean() == pytest.approx(0.15, abs=0.5 * spacing) and radius.std() < 0.3 * spacing
    red = found.vertices[:, 0] > spacing
    assert (found.colors[red, 0] > 0.7).all() and (
        found.colors[found.vertices[:, 0] < -spacing, 2] > 0.7
    ).all()


@pytest.fixture
def coarse(monkeypatch):
    """Stand-ins with few large particles, two cameras and small pictures."""
    for name in ("droplet", "trophy"):
        body = OBJECTS[name]
        film = replace(body.footage, cameras=2, size=64, frames=10)
        monkeypatch.setitem(OBJECTS, name, replace(body, spacing=0.03, pitch=0.02, footage=film))


@pytest.mark.parametrize("name", ["droplet", "trophy"])
def test_what_flows_falls_spreads_and_stays_in_sight(coarse, tmp_path, name):
    scene = load_builtin(name=name, scale=1.0, cache=tmp_path)
    assert scene.synthetic and scene.known_parameters == PUBLISHED[name] and len(scene.cameras) == 2
    x = scene.truth.positions
    width = x[..., 0].amax(1) - x[..., 0].amin(1)
    assert width[-1] > 1.2 * width[0] and x[-1, :, 1].mean() < 0.5 * x[0, :, 1].mean()
    seen = scene.mattes.sum((2, 3))
    assert (seen > 20).all() and (scene.mattes[:, :, 0].max() == 0)  # none at the upper edge
    assert (x[..., [0, 2]].abs() < scene.box[1, 0]).all()
