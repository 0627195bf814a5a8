"""One reconstruction of the tiny scene for the tests that do not care where it comes from."""

import pytest


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")
