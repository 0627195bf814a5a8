"""What a run is said to cost: refused where memory does not hold it, estimated before it is spent, corrected as it goes."""

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
    found = costs.estimate(cfg, scene, 2, 1, "cpu")
    assert torch.equal(torch.get_rng_state(), before)
    assert list(found.parts) == ["reconstruction", "starts", "fit", "evaluation"]
    assert all(0 < seconds < 1000 for seconds in found.parts.values()) and 1e9 < found.memory < 2e9
    monkeypatch.setattr(costs, "speed_of_rollouts", lambda *_: 0.05)
    monkeypatch.setattr(costs, "speed_of_pictures", lambda *_: 0.01)
    found = costs.estimate(cfg, scene, 2, 1, "cpu")
    twice = configuration(
        f"scene.cache={tmp_path}",
        "fit.joint.newton_iterations=40",
        "fit.joint.iterations=40",
        "reconstruction.dynamic.iterations=3000",
    )
    more = costs.estimate(twice, scene, 2, 1, "cpu")
    assert more.parts["fit"] > 2 * found.parts["fit"] - 2 * costs.KERNELS
    assert more.parts["reconstruction"] > 2 * found.parts["reconstruction"]
    stored = costs.estimate(cfg, scene, 2, 1, "cpu", stored=True)
    assert stored.parts["reconstruction"] < 0.2 * found.parts["reconstruction"]


def test_parts_that_are_done_correct_the_others():
    one = costs.Costs({"reconstruction": 10.0, "fit": 100.0, "evaluation": 50.0}, 1e9)
    assert "fit 2 min, evaluation 50 s" in one.said()
    text = one.done("reconstruction", 20.0)
    assert (
        text.startswith("reconstruction took 20.0 s (expected 10 s)")
        and "fit 3 min, evaluation 2 min" in text
    )
    one.known("fit", 60.0)
    assert one.rest()["fit"] == pytest.approx(60.0) and one.rest()["evaluation"] == pytest.approx(
        100.0
    )
    assert "what is left takes about" in one.done(
        "evaluation", 1.0
    ) and "what is left" not in one.done("fit", 1.0)
    assert costs.duration(math.inf) == "not known yet"


def test_two_parts_far_off_do_not_make_the_rest_absurd():
    one = costs.Costs({"reconstruction": 1.0, "fit": 100.0}, 1e9)
    one.done("reconstruction", 1000.0)
    assert one.rest()["fit"] == pytest.approx(100 * costs.MOST)
