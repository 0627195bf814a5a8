"""The plastic rabbit: it dents, elastic ones do not; its twin yields alike in all directions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mosa.data.scene import load_scene
from mosa.data.synthetic import held_out_names
from mosa.data.synthetic.bodies.objects import CLAY, OBJECTS, RABBIT
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.drop import simulate
from mosa.data.synthetic.materials.hill import COEFFICIENTS
from mosa.data.synthetic.surface import fill
from mosa.errors import ConfigError
from mosa.evaluation import floor
from mosa.modules.body.body import World
from mosa.modules.body.contact import ContactOffset

SMALL = replace(OBJECTS["tiny"], footage=replace(OBJECTS["tiny"].footage, frames=9))


@pytest.fixture(scope="module")
def falls():
    """Positions (9, N, 3) of coarse rabbits that fall: of clay, of its twin, elastic."""
    particles = fill(SHAPES["rabbit"], SMALL.spacing, np.random.default_rng(0))
    drop = SMALL.drops["train"]
    found = {}
    for name, material in {
        "clay": CLAY,
        "twin": CLAY.variant("isotropic"),
        "elastic": RABBIT,
    }.items():
        body = replace(SMALL, material=material)
        found[name] = simulate(body, material, particles, particles, drop, drop).positions
    return found


def test_clay_stays_where_it_falls_and_keeps_its_dent(falls):
    height = {name: np.ptp(x[-1, :, 1]) / np.ptp(x[0, :, 1]) for name, x in falls.items()}
    rise = {name: x[-1, :, 1].mean() - x[:, :, 1].mean(1).min() for name, x in falls.items()}
    assert height["clay"] < 0.93 and height["elastic"] > 0.96
    assert rise["clay"] < 0.02 < 0.05 < rise["elastic"]


def test_it_yields_in_directions_and_its_twin_does_not(falls):
    assert np.sqrt(np.square(falls["clay"][-1] - falls["twin"][-1]).sum(-1).mean()) > 2e-3
    rest = torch.rand(40, 3, dtype=torch.float64)
    values, alike = CLAY.parameters(rest), CLAY.variant("isotropic").parameters(rest)
    assert all((alike[name] == 1).all() for name in COEFFICIENTS) and alike[
        "yield_stress"
    ].unique().tolist() == [1.5e4]
    assert float(values["yield_stress"].max() / values["yield_stress"].min()) > 1.2
    assert values["axes"].shape == (40, 3) and float(values["axes"].abs().max()) > 0.1
    with pytest.raises(ConfigError, match=r"scene\.material: expected anisotropic or isotropic"):
        CLAY.variant("wood")


def test_it_is_a_scene_with_a_floor(tmp_path, monkeypatch):
    """In the small: film, truth, held-out drops, and the true law on another's particles, which meets itself."""
    monkeypatch.setitem(OBJECTS, "rabbit_plastic", replace(OBJECTS["tiny"], material=CLAY))
    for kind in ("anisotropic", "isotropic"):
        scene = load_scene(
            format="builtin", name="rabbit_plastic", cache=str(tmp_path), material=kind
        )
        assert scene.known_parameters == {"E": 2e5, "nu": 0.3} | (
            {"yield_stress": 1.5e4} if kind == "isotropic" else {}
        )
        world, truth = World(scene.ground, scene.gravity, scene.up, scene.box), scene.truth
        settings = SimpleNamespace(dx=2 * SMALL.spacing, courant=0.3)
        contact = ContactOffset()
        torch.nn.init.constant_(contact.cells, 0.4)
        volume = torch.full((len(truth.rest),), SMALL.spacing**3)
        body = SimpleNamespace(rest=truth.rest, volume=volume, settings=settings, contact=contact)
        found = floor.floor_rollout(body, scene, world)
        assert float((found - truth.positions).norm(dim=-1).max()) < 1e-3
    assert held_out_names("rabbit_plastic") == ("test_60", "test_40")
