"""Figures of particles against the true shape of a built-in scene."""

import numpy as np
import pytest
import torch

from mosa.data.scene import load_scene
from mosa.data.synthetic.bodies.objects import OBJECTS
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.surface import fill
from mosa.data.synthetic.true_geometry import geometry_figures, origin
from mosa.errors import ConfigError
from mosa.evaluation.analysis.statements import geometry_lines


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(format="builtin", name="tiny", cache=str(tmp_path_factory.mktemp("cache")))


@pytest.fixture(scope="module")
def particles():
    spacing = 0.008
    points = fill(SHAPES["rabbit"], spacing, np.random.default_rng(0)) + origin("tiny")
    return torch.tensor(points), torch.full((len(points),), spacing**3)


def test_the_shape_lies_where_the_truth_of_the_scene_says(scene):
    """The truth's particles fill it: none outside, the lowest and the highest within a spacing of its surface."""
    distance = SHAPES["rabbit"].distance(scene.truth.rest.double().numpy() - origin("tiny"))
    assert distance.max() < 1e-6
    assert distance.max() > -0.1 * OBJECTS["tiny"].spacing


def test_a_lattice_of_the_true_shape_has_no_error(scene, particles):
    found = {k.rsplit("/", 1)[1]: v for k, v in geometry_figures(*particles, scene).items()}
    assert found["outside_share"] == 0 and found["missing_share"] < 1e-3
    assert (
        abs(found["volume_error"]) < 0.01
    )  # a lattice's count: half a layer of cells at random, over 5000 cells
    assert found["center_error_m"] < 2e-4


def test_what_is_wrong_with_a_body_is_counted(scene, particles):
    points, volume = particles
    half = points[:, 0] < points[:, 0].mean()
    figures = geometry_figures(points[half], volume[half], scene)
    assert (
        figures["floor/geometry/missing_share"] > 0.3
        and figures["floor/geometry/outside_share"] == 0
    )
    assert (
        figures["floor/geometry/volume_error"] < -0.4
        and figures["floor/geometry/center_error_m"] > 0.02
    )
    shifted = geometry_figures(points + torch.tensor([0.02, 0, 0]), volume, scene)
    assert shifted["floor/geometry/outside_share"] > 0.05
    assert shifted["floor/geometry/center_error_m"] == pytest.approx(0.02, rel=0.02)
    with pytest.raises(ConfigError, match="the true shape is known for built-in scenes only"):
        geometry_figures(points, volume, type(scene)(**vars(scene) | {"synthetic": False}))


def test_a_person_reads_how_sure_the_body_is(scene, particles):
    figures = {
        "geometry/carved_share": 0.031,
        "geometry/uncertain_share": 0.072,
        "geometry/free_frames": 4.0,
    }
    assert (
        "3.1% of the visual hull is air. 7.2% of the surface is not determined by the images"
        in geometry_lines(figures)
    )
    hidden = figures | {"geometry/uncertain_share": 0.531, "geometry/volume_m3": 7.279e-3}
    said = "Mass and moduli are those of a body of 7279 cm^3, and **are wrong if the real volume"
    assert said in geometry_lines(hidden) and "moduli" not in geometry_lines(figures)
    assert "left out; no refinement by colours" in geometry_lines({"geometry/carved_share": 0.02})
    assert "0.00% of the particles outside" in geometry_lines(geometry_figures(*particles, scene))
    assert geometry_lines({}) == ""
