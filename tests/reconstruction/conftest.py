"""One scene with a known motion, shared by the tests of the reconstruction."""

from __future__ import annotations

import pytest
from squashed_body import make_scene

from mosa.types import Scene


@pytest.fixture(scope="session")
def squashed() -> Scene:
    """8 views, 5 frames of 96 px: free fall, then a squash with a bend."""
    return make_scene(views=8, frames=5, size=96, frame_dt=0.02)
