"""A GPU without memory, wherever a command meets it: one message, exit code 2, and the checkpoint kept."""

import json
from pathlib import Path

import forked
import pytest


@pytest.fixture(scope="module")
def outcomes(cache, tmp_path_factory):
    program = Path(__file__).with_name("no_memory_program.py")
    made = forked.call(
        str(program), str(cache), str(tmp_path_factory.mktemp("no_memory")), timeout=600
    )
    found = [
        json.loads(line.removeprefix("TRIED "))
        for line in made.stdout.splitlines()
        if line.startswith("TRIED ")
    ]
    assert made.returncode == 0 and len(found) == 15, made.stdout[-2000:] + made.stderr[-2000:]
    return found


def test_every_command_says_that_the_gpu_is_full_and_exits_with_2(outcomes):
    for command, place, code, said, _ in outcomes:
        assert code == 2, (command, place, code, said)
        assert (
            said.startswith("MemoryError: the GPU has no memory left (")
            and "0.1 of 150.0 GB are free" in said
        ), (place, said)
        assert "simulation.particles" in said and "device=cpu" in said and len(said) < 800, (
            place,
            said,
        )


def test_a_fit_without_memory_keeps_its_checkpoint_and_names_it(outcomes):
    kept = {place.rpartition(":")[2]: (said, there) for _, place, _, said, there in outcomes[:7]}
    for place in ("check_with_data", "reconstruct", "sequence_start"):
        assert not kept[place][1] and "resume=auto" not in kept[place][0]
    for place in ("LitMosa.training_step", "LitMosa.on_load_checkpoint", "LitMosa.end", "rollouts"):
        said, there = kept[place]
        assert there and "last.ckpt: the same command with resume=auto goes on" in said, (
            place,
            said,
        )
