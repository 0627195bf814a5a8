"""A fit of the tiny scene, assembled as train.py does and not begun."""

from collections.abc import Collection
from pathlib import Path
from unittest.mock import patch

import lightning as L
from starts_once import start_once

from mosa import compose
from mosa.data.batches import SequenceBatch
from mosa.training import datamodule
from mosa.training.assembly import Run, assemble

ROOT = Path(__file__).parents[2]
ROUGHLY = ["reconstruction.resolution=40", "reconstruction.static.iterations=30", "reconstruction.appearance.iterations=30",
           "reconstruction.dynamic.iterations=20", "reconstruction.carried.iterations=10"]  # fmt: skip
"""Overrides of a reconstruction in a third of the time, for tests that ask nothing of its accuracy."""


def made(cache: Path, *overrides: str, taught: Collection[str] = ()) -> Run:
    """cache: folder of the scene and its reconstruction; taught: further sequences."""
    names = f"scene.also_train=[{','.join(taught)}]"
    run = assemble(
        compose("debug=default", f"scene.cache={cache}", names, *overrides), held_out=False
    )
    with patch.object(datamodule, "sequence_start", start_once):
        _ = run.data.starts
    return run


def assembled(cache: Path, *overrides: str, taught: Collection[str] = ()) -> tuple:
    """(cfg, training scene, module)."""
    run = made(cache, *overrides, taught=taught)
    return run.cfg, run.scene, run.module


def whole(take) -> SequenceBatch:
    """All that is seen of a take, as its part of a batch."""
    views = list(range(len(take.observations.cameras)))
    return SequenceBatch(observations=take.observations, views=views, extra={})


def trainer(**options) -> L.Trainer:
    """One that says and writes nothing."""
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False,
             "accelerator": "cpu", "max_epochs": -1}  # fmt: skip
    return L.Trainer(**(quiet | options))
