"""One reconstruction of the tiny scene for the tests that do not care where it comes from."""

import os

import pytest


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Of all processes that share the tests: two may make the same reconstruction at once, as two runs may."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return tmp_path_factory.mktemp("cache")
    folder = tmp_path_factory.getbasetemp().parent / "cache"
    folder.mkdir(exist_ok=True)
    return folder
