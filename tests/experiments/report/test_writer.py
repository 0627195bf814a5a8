"""Results are written when the last of an experiment's jobs has ended."""

import threading

import pytest

from mosa.errors import DataError
from mosa.experiments.report.writer import Writer
from mosa.experiments.specification import Job


def job(folder, complete=False) -> Job:
    folder.mkdir(exist_ok=True)
    if complete:
        (folder / "metrics.json").write_text("{}")
    return Job(folder, (), 0, (), {}, "", "")


@pytest.fixture
def planned(tmp_path):
    shared = job(tmp_path / "shared")
    old = job(tmp_path / "old", complete=True)
    return {
        "one": [job(tmp_path / "a"), shared],
        "two": [shared, old],
        "three": [job(tmp_path / "b")],
    }


def test_an_experiment_is_written_when_its_last_job_has_ended_and_the_rest_at_the_end(planned):
    written, at_once = [], threading.Event()

    def write(name: str) -> None:
        written.append(name)
        at_once.set()

    with Writer(planned, write) as writer:
        writer.ended(planned["one"][0])
        assert not at_once.wait(0.1)
        writer.ended(planned["two"][0])  # with which both are complete
        assert at_once.wait(10)
        writer.finish()
    assert written == ["one", "two", "three"]


def test_what_is_stopped_has_written_what_was_complete(planned):
    written, stopped = [], threading.Event()

    def write(name: str) -> None:
        stopped.wait(10)
        written.append(name)

    with pytest.raises(KeyboardInterrupt), Writer(planned, write) as writer:
        writer.ended(planned["three"][0])
        while not writer.begun["three"].running():
            pass
        stopped.set()
        raise KeyboardInterrupt
    assert written == ["three"]


def test_what_goes_wrong_in_writing_ends_the_command_after_the_others(planned):
    written = []

    def write(name: str) -> None:
        if name == "one":
            raise DataError(f"{name}: damaged")
        written.append(name)

    with pytest.raises(DataError, match="one: damaged"), Writer(planned, write) as writer:
        writer.finish()
    assert written == ["two", "three"]
