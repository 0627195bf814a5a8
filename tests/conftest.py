"""Shared fixtures: the reference data's place, one thread, CUDA gate, Triton's interpreter."""

import gc
import os
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch
import warp as wp
from compiled_sooner import compile_sooner
from composed_once import compose_once

torch.set_num_threads(1)
if not torch.cuda.is_available():
    os.environ.setdefault(
        "TRITON_INTERPRET", "1"
    )  # before Triton is imported: its kernels then run on CPU tensors


LONG = ("integration", "experiments", "physics_verification", "analysis")
"""Folders of whole runs and whole studies, whose files have few tests that take long."""


FIRST = ("test_main_job.py", "test_closed_systems.py")
"""The first run of the one makes the scene and the reconstruction that others find in the cache; the other needs none of it."""

LAST = ("test_rollout_gradients.py", "test_stress.py")
"""By then their kernels are in the cache, compiled for other files: beside those, both processes would compile them."""

UNOPTIMISED = ("constitutive", "export")
"""Folders and files whose tests launch each of their many kernels a few times. Clang's -O0 gives the same bits
and compiles in a third of the time of -O2. They come last: a process keeps a kernel as compiled."""


def unoptimised(path: Path) -> bool:
    return not {path.name, path.parent.name}.isdisjoint(UNOPTIMISED)


def pytest_configure(config):
    compose_once()
    compile_sooner()
    gc.disable()  # until all is imported and collected, of which little is garbage
    # xdist would begin with the files of most tests: the last ones, of one long test each, would keep one process alone
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items):
    """The order in which processes take the files: whole runs, those marked slow, then by tests."""
    tests = Counter(item.path for item in items)
    slow = {item.path for item in items if "slow" in item.keywords}
    items.sort(
        key=lambda item: (
            item.path.name not in FIRST[:1],
            item.path.name not in FIRST,
            unoptimised(item.path) or item.path.name in LAST,
            item.path.parent.name not in LONG,
            item.path not in slow,
            -tests[item.path],
            str(item.path),
        )
    )
    if not torch.cuda.is_available():
        skip = pytest.mark.skip(reason="needs a CUDA device")
        for item in items:
            if "gpu" in item.keywords:
                item.add_marker(skip)


def pytest_collection_finish():
    """What was imported stays: one of the collector's full passes over it took 0.3 s, every few seconds."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_sessionfinish():
    """So that what is in cycles is freed: libraries count what is left at the end, and complain."""
    gc.unfreeze()


@pytest.fixture(autouse=True, scope="module")
def optimisation(request):
    """How Warp compiles for a CPU: as in the program, or without optimisation (`UNOPTIMISED`)."""
    if unoptimised(request.path) and not torch.cuda.is_available():
        wp.config.optimization_level = 0
    yield
    wp.config.optimization_level = None


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Folder of the reference data (MOSA_DATA, default ../shared/data); tests that need it skip without it."""
    root = Path(os.environ.get("MOSA_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no reference data at {root}; set MOSA_DATA")
    return root


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of the tiny scene and its reconstruction, for tests that do not care where these come from.

    Of all processes that share the tests: two may make the same reconstruction at once, as two runs may."""
    alone = "PYTEST_XDIST_WORKER" not in os.environ
    shared = tmp_path_factory.getbasetemp() if alone else tmp_path_factory.getbasetemp().parent
    for folder in (found := shared / "cache", starts := shared / "starts"):
        folder.mkdir(exist_ok=True)
    os.environ["TESTS_STARTS"] = str(starts)  # tests/helpers/starts_once.py
    return found
