"""Folders of compiled code: never relative to where a command is started, and never a traceback."""

import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import mosa
from mosa.system.caches import FOLDERS, cache_home, default_cache, settle_caches
from mosa.system.machine_errors import disk_message

ROOT = Path(mosa.__file__).parents[1]
ELSEWHERE = ("CUDA_CACHE_PATH", "TRITON_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR")
"""Of code that would not be below XDG_CACHE_HOME."""


@pytest.fixture
def environment(monkeypatch):
    """All that settling changes is put back."""
    for name in FOLDERS:
        monkeypatch.setenv(name, os.environ.get(name, ""))
    return monkeypatch


@pytest.mark.parametrize("value", ["", ".", "warp", "./a", "../a", "~/.cache", "$HOME/a", " /tmp"])
def test_empty_and_relative_folders_count_as_unset(environment, tmp_path, value):
    for name in FOLDERS:
        environment.setenv(name, value)
    environment.chdir(tmp_path)
    settle_caches()
    assert {name for name in FOLDERS if name in os.environ} == set(ELSEWHERE)
    assert all(os.path.isabs(os.environ[name]) for name in ELSEWHERE) and os.path.isabs(
        cache_home()
    )
    assert (
        cache_home() == os.path.expanduser("~/.cache")
        and default_cache() == Path(cache_home()) / "mosa"
    )
    assert not list(tmp_path.iterdir())


def test_folders_that_can_be_used_stay(environment, tmp_path, capsys):
    for name in FOLDERS:
        environment.setenv(name, str(tmp_path / name))
    settle_caches()
    assert not capsys.readouterr().err
    assert all(
        os.environ[name] == str(tmp_path / name) for name in FOLDERS
    ) and cache_home() == str(tmp_path / "XDG_CACHE_HOME")


@pytest.mark.parametrize("name", ["XDG_CACHE_HOME", "WARP_CACHE_PATH"])
@pytest.mark.parametrize(
    "place", ["/proc/nope", "/dev/null", "/dev/null/below", "{file}", "{link}"]
)
def test_where_nothing_can_be_kept_a_temporary_folder_is_used(
    environment, tmp_path, capsys, name, place
):
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to("/proc/nowhere")
    environment.delenv("WARP_CACHE_PATH")
    environment.setenv(name, place.format(file=tmp_path / "file", link=tmp_path / "link"))
    settle_caches()
    said = capsys.readouterr().err
    assert (
        "cannot be made" in said
        and "into a temporary folder" in said
        and f"set {name} to a folder that can be written" in said
    )
    folder = Path(os.environ[name])
    assert (
        folder.is_dir()
        and folder.parent == Path(tempfile.gettempdir())
        and folder.stat().st_mode & 0o077 == 0
    )


def test_a_full_cache_names_the_variable_that_helps(environment, tmp_path):
    environment.setenv("XDG_CACHE_HOME", str(tmp_path))
    refused = [
        disk_message(OSError(errno.EROFS, "Read-only file system", str(path)))
        for path in (tmp_path / "warp/a", "/else/a")
    ]
    assert (
        "choose other folders with XDG_CACHE_HOME" in refused[0] and "scene.cache" not in refused[0]
    )
    assert refused[1].endswith("hydra.sweep.dir=) and scene.cache= (eval.py: cache=)")


def test_a_program_keeps_no_kernels_where_it_is_started(tmp_path):
    """As a whole, in a process: empty variables, and one that names no place."""
    program = "import mosa, warp; warp.config.log_level = warp.LOG_ERROR; warp.init(); print(warp.config.kernel_cache_dir)"
    environment = {name: value for name, value in os.environ.items() if name not in FOLDERS} | {
        "PYTHONPATH": str(ROOT)
    }
    options = {"cwd": tmp_path, "capture_output": True, "text": True, "check": False}
    given = environment | {
        "XDG_CACHE_HOME": "",
        "WARP_CACHE_PATH": "",
        "HOME": str(tmp_path / "home"),
    }
    result = subprocess.run([sys.executable, "-c", program], env=given, **options)
    assert result.stdout.startswith(str(tmp_path / "home" / ".cache" / "warp")), result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    result = subprocess.run(
        [sys.executable, "-c", program],
        env=environment | {"XDG_CACHE_HOME": "/proc/nope"},
        **options,
    )
    used = Path(result.stdout.strip())
    assert result.returncode == 0 and "set XDG_CACHE_HOME to" in result.stderr and not used.exists()
