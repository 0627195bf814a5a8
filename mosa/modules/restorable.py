"""A fitted module back from its checkpoint, as Lightning's users expect it: `load_from_checkpoint`, then `trainer.test`.

    module = LitMosa.load_from_checkpoint("outputs/train/.../checkpoints/last.ckpt")
    L.Trainer(logger=False).test(module)
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from mosa.checkpoints import read_checkpoint
from mosa.config import build_evaluation
from mosa.evaluation import evaluate, run_sequences
from mosa.twin import Twin


class Restorable:
    """What a LightningModule with `body`, `world` and `config` needs for that, beside the fit."""

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: str | Path, map_location: str | torch.device | None = None, **unused):
        """The module of a checkpoint, in evaluation mode: body, world, configuration, and how far its fit was.

        It has no sequences to learn from: a fit goes on with `ckpt_path=` of the command. A checkpoint holds no arguments of
        `__init__`, and Lightning's others (`strict`, `hparams_file`, ...) change nothing. Errors: DataError naming the file.
        """
        twin = Twin.load(checkpoint_path, "cpu" if map_location is None else map_location)
        module = cls.from_config(twin.config, twin.body, takes=(), background=torch.ones(3))
        module.on_load_checkpoint(read_checkpoint(checkpoint_path))
        return module.to(twin.body.rest.device).eval()

    def test_dataloader(self) -> DataLoader:
        """The sequences that the run was evaluated on, from the configuration in its checkpoint. Errors: DataError, ConfigError."""
        return DataLoader(run_sequences(self.config, self.body), batch_size=None, collate_fn=lambda sequence: sequence)

    def transfer_batch_to_device(self, batch, device, dataloader_idx: int):
        """A sequence stays where it is: what of it is needed on the device is brought there where it is needed."""
        return super().transfer_batch_to_device(batch, device, dataloader_idx) if isinstance(batch, list) else batch

    def test_step(self, sequence, _index: int) -> None:
        """Logs the figures of docs/figures.md of one sequence, of every model."""
        here = replace(sequence, start=type(sequence.start).read(sequence.start.written(), self.body.rest))
        figures, _ = evaluate(self.body, [here], self.world, build_evaluation(self.config["cfg"]))
        figures.pop("time/particle_substeps_per_s")
        self.log_dict(figures, batch_size=1)  # `test/<metric>` of several sequences is averaged
