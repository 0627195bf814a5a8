"""A fit of the tiny scene, assembled as train.py does and not begun."""

from collections.abc import Collection
from pathlib import Path

import lightning as L

from mosa import compose
from mosa.assembly import Run, assemble

ROOT = Path(__file__).parents[2]


def made(cache: Path, *overrides: str, taught: Collection[str] = ()) -> Run:
    """cache: folder of the scene and its reconstruction; taught: further sequences."""
    names = f"scene.also_train=[{','.join(taught)}]"
    return assemble(compose("debug=default", f"scene.cache={cache}", names, *overrides), held_out=False)


def assembled(cache: Path, *overrides: str, taught: Collection[str] = ()) -> tuple:
    """(cfg, training scene, module)."""
    run = made(cache, *overrides, taught=taught)
    return run.cfg, run.scene, run.module


def trainer(**options) -> L.Trainer:
    """One that says and writes nothing."""
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False,
             "accelerator": "cpu", "max_epochs": -1}  # fmt: skip
    return L.Trainer(**(quiet | options))
