"""Files that are complete under their name, beside what others write and what a kill left."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mosa.twin
from mosa.system.whole_files import written_whole
from mosa.twin.twin import write_frames


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a[1].npz"
    with pytest.raises(ZeroDivisionError), written_whole(path) as partial:
        partial.write_text("half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    with written_whole(path) as partial:
        partial.write_text("all of it")
        assert not path.exists()
    assert path.read_text() == "all of it" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path):
    path = tmp_path / "a[1].npz"
    code = f"""
from mosa.system.whole_files import written_whole
import os, signal
with written_whole({str(path)!r}) as partial:
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    assert killed.returncode == -9
    (left,) = tmp_path.iterdir()
    other = left.with_name(left.name.replace("a[1]", "b"))
    other.write_text("another file's")
    alive = left.with_name(f"{left.name.rsplit('.', 2)[0]}.{os.getppid()}.partial")
    alive.write_text("still being written")
    with written_whole(path) as partial:
        partial.write_text("all of it")
    assert sorted(tmp_path.iterdir()) == sorted([path, other, alive])


def test_a_disk_that_fills_up_is_said_with_the_file(tmp_path):
    """Python names no file where a write fails, only where it cannot be opened."""
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*a\.npz'") as caught,
        written_whole(tmp_path / "a.npz"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(tmp_path / "a.npz") and not list(tmp_path.iterdir())


def test_frames_of_an_export_are_whole_and_of_this_motion_alone(tmp_path, monkeypatch):
    """A shorter motion in the folder of a longer one would be played on into that one."""
    x, colors = np.zeros((5, 4, 3)), np.full((4, 3), 0.5)
    (tmp_path / "notes.ply").write_text("mine")
    write_frames(tmp_path, x, colors)
    write_frames(tmp_path, x[:3] + 1, colors)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "000.ply",
        "001.ply",
        "002.ply",
        "notes.ply",
    ]
    before = (tmp_path / "001.ply").read_bytes()

    def full(path, *_):
        Path(path).write_bytes(before[:20])
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(mosa.twin.twin, "write_ply", full)
    with pytest.raises(OSError, match="full"):
        write_frames(tmp_path, x[:3], colors)
    assert (tmp_path / "000.ply").read_bytes() == before and not list(tmp_path.glob("*.partial"))
