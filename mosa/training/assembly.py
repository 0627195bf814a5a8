"""A run put together from its configuration, in one place: what train.py fits, and what tests and benchmarks measure.

run = assemble(cfg)
run.module          # the LightningModule, with its body, what it learns from and its stages
run.data            # the data module that it was made of; nothing is made before it is asked for
"""

from __future__ import annotations

from functools import cached_property

import torch
from omegaconf import DictConfig

from mosa.config.build import plain, world_of
from mosa.data.sequences import load_sequences
from mosa.evaluation.evaluate import Sequence
from mosa.modules.body.body import Body, World
from mosa.training.datamodule import SceneDataModule
from mosa.training.lit_mosa import LitMosa
from mosa.types import Scene


def assemble(cfg: DictConfig, device: torch.device | str = "cpu", *, held_out: bool = True) -> Run:
    """The run that `cfg`, a configuration of conf/train.yaml, describes. held_out: with the sequences nothing is learned from.

    Errors, here or where a part is asked for: ConfigError naming the key, DataError naming the file."""
    return Run(cfg, device, held_out)


class Run:
    """Data module and module of a run, each made when it is first asked for."""

    def __init__(
        self, cfg: DictConfig, device: torch.device | str = "cpu", held_out: bool = True
    ) -> None:
        self.cfg, self.device = cfg, device
        self.data = SceneDataModule(cfg, device=device, held_out=held_out)

    @cached_property
    def module(self) -> LitMosa:
        """With its body and what it learns from."""
        module = LitMosa(plain(self.cfg))
        module.attach(self.data)
        return module

    @property
    def body(self) -> Body:
        return self.module.body

    @property
    def world(self) -> World:
        return world_of(self.data.measured)

    @property
    def scene(self) -> Scene:
        """The training sequence."""
        return self.data.scene

    @property
    def reconstruction(self):
        """Of the training sequence."""
        return self.data.reconstruction

    @property
    def sequences(self) -> list[Sequence]:
        """What the run is evaluated on."""
        return self.data.sequences


def scenes(cfg: DictConfig) -> tuple[Scene, list[Scene]]:
    """The training sequence and the others of the same object. Errors: ConfigError, DataError."""
    return load_sequences(plain(cfg.scene))
