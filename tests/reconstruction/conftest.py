"""One scene with a known motion, shared by the tests of the reconstruction."""

from __future__ import annotations

import pytest
from squashed_body import make_scene

from mosa.data.hull import visual_hull
from mosa.reconstruction.motion.observed import object_windows
from mosa.types import Scene


@pytest.fixture(scope="session")
def squashed() -> Scene:
    """8 views, 5 frames of 96 px: free fall, then a squash with a bend."""
    return make_scene(views=8, frames=5, size=96, frame_dt=0.02)


@pytest.fixture(scope="session")
def hull(squashed):
    return visual_hull(squashed.mattes[:, 0], squashed.cameras, squashed.box, pitch=0.0032)


@pytest.fixture(scope="session")
def still(squashed):
    return object_windows(squashed, list(range(8)), [0, 1]).of_frame(0)
