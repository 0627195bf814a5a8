"""What a run is said to cost: refused where memory does not hold it, estimated before it is spent."""

import math
import re

import pytest
import torch
from hydra import compose, initialize_config_dir

from mosa.config.build import plain
from mosa.data.scene import load_scene
from mosa.errors import ConfigError
from mosa.reconstruction.settings import build_settings
from mosa.training import costs
from tests.config.test_command_settings import CONF

TINY = ["debug=default"]


def configuration(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return plain(compose("train", overrides=[*TINY, *overrides]))


SIZE = costs.Size(particles=4000, cameras=6, frames=15, pixels=25600, sequences=3, taught=1)


def test_memory_that_is_not_there_is_refused_with_the_most_particles_that_fit(monkeypatch):
    cfg = configuration()
    wanted = costs.memory_of(cfg, SIZE)
    monkeypatch.setattr(costs, "machine_memory", lambda: wanted)
    assert costs.check_memory(cfg, SIZE) == wanted
    monkeypatch.setattr(costs, "machine_memory", lambda: wanted - 1e7)
    with pytest.raises(
        ConfigError, match=r"^simulation\.particles: 4000 take about .* GB.*expected at most (\d+)$"
    ) as caught:
        costs.check_memory(cfg, SIZE)
    most = int(re.search(r"most (\d+)", str(caught.value))[1])
    assert 3000 < most < 4000
    costs.check_memory(cfg, costs.replace(SIZE, particles=most))
    with pytest.raises(ConfigError):
        costs.check_memory(cfg, costs.replace(SIZE, particles=most + 1))
    cfg["simulation"]["dx"] = 0.01
    with pytest.raises(
        ConfigError, match=r"^simulation\.dx: .*expected at most \d+ particles, a spacing of 0\.01"
    ):
        costs.check_memory(cfg, SIZE)


def test_pictures_that_alone_are_too_many_are_named(monkeypatch):
    monkeypatch.setattr(costs, "machine_memory", lambda: costs.BASE + 1e8)
    with pytest.raises(ConfigError, match=r"^scene\.scale: 3 x 6 x 15 pictures of 25600 px"):
        costs.check_memory(configuration(), SIZE)


def test_memory_of_each_particle_is_named_by_what_takes_it(monkeypatch):
    """It was scene.scale's fault, whatever took the memory."""
    cfg = configuration()
    cfg["reconstruction"]["neighbours"] = 100_000
    monkeypatch.setattr(costs, "machine_memory", lambda: 25e9)
    with pytest.raises(
        ConfigError,
        match=r"^reconstruction\.neighbours: 100000, .*for each particle, of this machine's 25\.0 GB",
    ):
        costs.check_memory(cfg, SIZE)


@pytest.mark.parametrize(
    ("key", "value"), [("neighbours", 10**5), ("margin", 10**6), ("ridge_passes", 10**9)]
)
def test_what_no_machine_computes_is_refused_by_its_key(key, value):
    with pytest.raises(
        ConfigError, match=rf"^reconstruction\.{key}: expected a whole number of .* at most"
    ):
        build_settings(**{key: value})


def test_a_built_in_scene_is_refused_before_it_is_made(monkeypatch, tmp_path):
    monkeypatch.setattr(costs, "machine_memory", lambda: 2e9)
    cfg = configuration(f"scene.cache={tmp_path}", "simulation.particles=100000")
    with pytest.raises(ConfigError, match=r"simulation\.particles: 100000 take"):
        costs.before_data(cfg, 4000)
    cfg["simulation"]["particles"] = 200
    assert "3 sequences, 3 of them to be made" in costs.before_data(cfg, 4000) and not list(
        tmp_path.iterdir()
    )


def test_an_estimate_has_every_part_and_leaves_the_random_state_alone(tmp_path, monkeypatch):
    cfg = configuration(f"scene.cache={tmp_path}")
    scene = load_scene(**{k: v for k, v in cfg["scene"].items() if k != "also_train"})
    torch.manual_seed(3)
    before = torch.get_rng_state()
    parts, memory = costs.estimate(cfg, scene, 2, 1, "cpu")
    assert torch.equal(torch.get_rng_state(), before)
    assert list(parts) == ["reconstruction", "starts", "fit", "evaluation"]
    assert all(0 < seconds < 1000 for seconds in parts.values()) and 1e9 < memory < 2e9
    monkeypatch.setattr(costs, "speed_of_rollouts", lambda *_: 0.05)
    monkeypatch.setattr(costs, "speed_of_pictures", lambda *_: 0.01)
    found, _ = costs.estimate(cfg, scene, 2, 1, "cpu")
    twice = configuration(
        f"scene.cache={tmp_path}",
        "fit.joint.newton_iterations=40",
        "fit.joint.iterations=40",
        "reconstruction.dynamic.iterations=3000",
    )
    more, _ = costs.estimate(twice, scene, 2, 1, "cpu")
    assert more["fit"] > 2 * found["fit"] - 2 * costs.KERNELS
    assert more["reconstruction"] > 2 * found["reconstruction"]
    stored, _ = costs.estimate(cfg, scene, 2, 1, "cpu", stored=True)
    assert stored["reconstruction"] < 0.2 * found["reconstruction"]


def test_the_estimate_is_one_line():
    parts = {"reconstruction": 10.0, "fit": 100.0, "evaluation": math.inf}
    text = costs.estimate_text(parts, 1.2e9)
    assert text == (
        "this run takes about not known yet: reconstruction 10 s, fit 2 min, evaluation not known yet; "
        "1.2 GB"
    )
    assert costs.duration(7200.0) == "2.0 h"
