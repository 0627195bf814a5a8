"""The film of blocks, written out in the layouts that are read."""

import pytest
from blocks_film import block_scene
from written_scenes import export_pacnerf, export_transforms

from mosa.types import Scene


@pytest.fixture(scope="session")
def blocks() -> Scene:
    return block_scene()


@pytest.fixture
def pacnerf_folder(blocks, tmp_path):
    return export_pacnerf(blocks, tmp_path / "blocks")


@pytest.fixture
def transforms_folder(blocks, tmp_path):
    return export_transforms(blocks, tmp_path / "capture")
