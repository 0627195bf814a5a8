"""A fit of the tiny scene, assembled as train.py does and not begun."""

from collections.abc import Collection
from functools import cached_property
from pathlib import Path
from unittest.mock import patch

import lightning as L
from omegaconf import DictConfig
from starts_once import start_once

from mosa import compose
from mosa.config.build import plain
from mosa.data.batches import SequenceBatch
from mosa.training import datamodule
from mosa.training.datamodule import SceneDataModule
from mosa.training.lit_mosa import LitMosa

ROOT = Path(__file__).parents[2]
ROUGHLY = ["reconstruction.resolution=40", "reconstruction.static.iterations=30", "reconstruction.appearance.iterations=30",
           "reconstruction.dynamic.iterations=20", "reconstruction.carried.iterations=10",
           "reconstruction.informed.iterations=1", "reconstruction.dynamic.track_iterations=5",
           "reconstruction.geometry.source=hull"]  # fmt: skip
"""Overrides of a reconstruction in a third of the time, for tests that ask nothing of its accuracy."""


class Run:
    """Data and module of a configuration, put together as train.py does it."""

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg, self.data = cfg, SceneDataModule(cfg, device="cpu", held_out=False)

    @cached_property
    def module(self) -> LitMosa:
        module = LitMosa(plain(self.cfg))
        module.attach(self.data)
        return module


def made(cache: Path, *overrides: str, taught: Collection[str] = ()) -> Run:
    """cache: folder of the scene and its reconstruction; taught: further sequences."""
    names = f"scene.also_train=[{','.join(taught)}]"
    run = Run(compose("debug=default", f"scene.cache={cache}", names, *overrides))
    with patch.object(datamodule, "sequence_start", start_once):
        _ = run.data.starts
    return run


def assembled(cache: Path, *overrides: str, taught: Collection[str] = ()) -> tuple:
    """(cfg, training scene, module)."""
    run = made(cache, *overrides, taught=taught)
    return run.cfg, run.data.scene, run.module


def whole(take) -> SequenceBatch:
    """All that is seen of a take, as its part of a batch."""
    views = list(range(len(take.observations.cameras)))
    return SequenceBatch(observations=take.observations, views=views, extra={})


def trainer(**options) -> L.Trainer:
    """One that says and writes nothing."""
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False,
             "accelerator": "cpu", "max_epochs": -1}  # fmt: skip
    return L.Trainer(**(quiet | options))
