"""A twin that nothing was fitted for, as a checkpoint."""

from __future__ import annotations

from pathlib import Path

import torch

from mosa.config.record import RunRecord
from mosa.twin.twin import Twin


def save_twin(twin: Twin, path: str | Path) -> Path:
    """A checkpoint that `Twin.load` reads: nothing was fitted, so that no fit can go on from it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    written = twin.training_start.written()
    splats = twin.body.splats
    record = RunRecord(
        **dict(twin.record.but(starts={"train": written})),
        start=written,
        splats=None if splats is None else splats.written(),
    )
    state = {f"body.{k}": v.cpu() for k, v in twin.body.state_dict().items()}
    torch.save({"state_dict": state, "mosa": record.plain()}, path)
    return path
