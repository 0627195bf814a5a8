"""How long the jobs of a folder took, over the goes that their command was given in."""

from dataclasses import replace

import pytest

from mosa.errors import DataError
from mosa.experiments import goes
from mosa.experiments.goes import Clock, Go, read_goes, said_of

FIRST = Go("2026-01-01 00:00:00", "mosa-experiment all --set 'a=\"b, c\"'", "abc", 2, 14, 10, 60.0)


def test_what_every_go_took_is_kept_beside_that_of_the_ones_before(tmp_path, monkeypatch):
    seconds = iter([0.0, 600.0, 1800.0, 5000.0, 5060.0])
    monkeypatch.setattr(goes.time, "perf_counter", lambda: next(seconds))
    clock = Clock(tmp_path, replace(FIRST))
    clock.ended(failed=False)
    clock.ended(failed=True)  # and is killed here
    later = replace(FIRST, began="2026-01-02 00:00:00", jobs=9, expected=50.0)
    again = Clock(tmp_path, replace(later))
    before, now = replace(FIRST, minutes=30.0, complete=1, failed=1), replace(later, minutes=1.0)
    assert again.write() == [before, now] == read_goes(tmp_path)
    assert said_of(read_goes(tmp_path)) == (
        "1 jobs in 2 goes: 1.03 hours of a device; the first go began with 10 to run and expected 2.00 for them"
    )


def test_two_commands_in_the_same_folder_have_a_row_each(tmp_path):
    one, other = (Clock(tmp_path, replace(FIRST, command=command)) for command in ("one", "other"))
    for clock in (one, other, one):
        clock.ended(failed=False)
    assert sorted((go.command, go.complete) for go in read_goes(tmp_path)) == [
        ("one", 2),
        ("other", 1),
    ]


def test_a_file_that_is_damaged_is_named(tmp_path):
    (tmp_path / "goes.csv").write_text("began,minutes\nyesterday,long\n")
    with pytest.raises(DataError, match=r"goes\.csv: expected a row for each time.*remove it"):
        read_goes(tmp_path)
