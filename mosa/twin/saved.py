"""A twin that nothing was fitted for, as a checkpoint."""

from __future__ import annotations

from pathlib import Path

import torch

from mosa.config.checkpoints import VERSION
from mosa.twin.twin import Twin


def save_twin(twin: Twin, path: str | Path) -> Path:
    """A checkpoint that `Twin.load` reads: nothing was fitted, so that no fit can go on from it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    written = twin.training_start.written()
    splats = twin.body.splats
    torch.save({
        "state_dict": {f"body.{k}": v.cpu() for k, v in twin.body.state_dict().items()},
        "mosa": {"version": VERSION, "config": {**twin.config, "starts": {"train": written}}, "stage": 0, "losses": [],
                 "steps_done": 0, "particles": len(twin.body.rest), "start": written,
                 "splats": None if splats is None else splats.written()},
    }, path)  # fmt: skip
    return path
