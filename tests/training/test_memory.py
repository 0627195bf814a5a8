"""A run that memory does not hold is refused."""

import re

import pytest
from hydra import compose, initialize_config_dir

from mosa.config.build import plain
from mosa.errors import ConfigError
from mosa.reconstruction.settings import build_settings
from mosa.training import memory
from tests.config.test_command_settings import CONF

TINY = ["debug=default"]


def configuration(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return plain(compose("train", overrides=[*TINY, *overrides]))


SIZE = memory.Size(particles=4000, cameras=6, frames=15, pixels=25600, sequences=3)


def test_memory_that_is_not_there_is_refused_with_the_most_particles_that_fit(monkeypatch):
    cfg = configuration()
    wanted = memory.memory_of(cfg, SIZE)
    monkeypatch.setattr(memory, "machine_memory", lambda: wanted)
    memory.check_memory(cfg, SIZE)
    monkeypatch.setattr(memory, "machine_memory", lambda: wanted - 1e7)
    with pytest.raises(
        ConfigError, match=r"^simulation\.particles: 4000 take about .* GB.*expected at most (\d+)$"
    ) as caught:
        memory.check_memory(cfg, SIZE)
    most = int(re.search(r"most (\d+)", str(caught.value))[1])
    assert 3000 < most < 4000
    memory.check_memory(cfg, memory.replace(SIZE, particles=most))
    with pytest.raises(ConfigError):
        memory.check_memory(cfg, memory.replace(SIZE, particles=most + 1))
    cfg["simulation"]["dx"] = 0.01
    with pytest.raises(
        ConfigError, match=r"^simulation\.dx: .*expected at most \d+ particles, a spacing of 0\.01"
    ):
        memory.check_memory(cfg, SIZE)


def test_pictures_that_alone_are_too_many_are_named(monkeypatch):
    monkeypatch.setattr(memory, "machine_memory", lambda: memory.BASE + 1e8)
    with pytest.raises(ConfigError, match=r"^scene\.scale: 3 x 6 x 15 pictures of 25600 px"):
        memory.check_memory(configuration(), SIZE)


def test_memory_of_each_particle_is_named_by_what_takes_it(monkeypatch):
    """It was scene.scale's fault, whatever took the memory."""
    cfg = configuration()
    cfg["reconstruction"]["neighbours"] = 100_000
    monkeypatch.setattr(memory, "machine_memory", lambda: 25e9)
    with pytest.raises(
        ConfigError,
        match=r"^reconstruction\.neighbours: 100000, .*for each particle, of this machine's 25\.0 GB",
    ):
        memory.check_memory(cfg, SIZE)


@pytest.mark.parametrize(
    ("key", "value"), [("neighbours", 10**5), ("margin", 10**6), ("ridge_passes", 10**9)]
)
def test_what_no_machine_computes_is_refused_by_its_key(key, value):
    with pytest.raises(
        ConfigError, match=rf"^reconstruction\.{key}: expected a whole number of .* at most"
    ):
        build_settings(**{key: value})


def test_a_built_in_scene_is_refused_before_it_is_made(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "machine_memory", lambda: 2e9)
    cfg = configuration(f"scene.cache={tmp_path}", "simulation.particles=100000")
    with pytest.raises(ConfigError, match=r"simulation\.particles: 100000 take"):
        memory.check_before_data(cfg, 4000)
    cfg["simulation"]["particles"] = 200
    memory.check_before_data(cfg, 4000)
    assert not list(tmp_path.iterdir())
