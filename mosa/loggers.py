"""Where the curves of a fit go: the loggers that conf/logger names, and the outcome of a run in those that can show it."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from tensorboard.compat.proto.summary_pb2 import DATA_CLASS_SCALAR
from torch import Tensor
from torch.utils.tensorboard.summary import scalar

from mosa.curves import described
from mosa.errors import ConfigError

KINDS = ("tensorboard", "csv", "wandb")
OUTCOME = ("train/rms_m", "test/rms_m", "prior/test/rms_m", "prior_eta/test/rms_m", "train/psnr_crop", "test/psnr_crop",
           "camera/psnr_crop", "test/mean_abs_C")
WANDB = ("project", "entity", "group", "tags", "offline")


def chosen(settings: Mapping[str, Any] | None) -> list[str]:
    """The kinds of logger that conf/logger asks for. Errors: ConfigError for unknown keys, and where wandb is not installed."""
    settings = settings or {}
    if unknown := [key for key in settings if key not in (*KINDS, "images_every")]:
        raise ConfigError(f"logger.{unknown[0]}: unknown key; expected one of {', '.join(KINDS)}, images_every")
    kinds = [kind for kind in KINDS if settings.get(kind) is not None]
    if "wandb" in kinds:
        if unknown := [key for key in settings["wandb"] if key not in WANDB]:
            raise ConfigError(f"logger.wandb.{unknown[0]}: unknown key; expected one of {', '.join(WANDB)}")
        if importlib.util.find_spec("wandb") is None:
            raise ConfigError("logger=wandb: expected the package wandb, found none: pip install wandb, or logger=tensorboard")
    return kinds


def build_loggers(settings: Mapping[str, Any] | None, folder: Path, law: str) -> list[Logger]:
    """Loggers that write into the run folder. settings: conf/logger; law: of the prior, for the units of its parameters.
    Errors: ConfigError (`chosen`)."""
    build = {"tensorboard": lambda folder: tensorboard(folder, law), "csv": csv_table,
             "wandb": lambda folder: wandb_run(settings["wandb"], folder)}  # fmt: skip
    return [build[kind](folder) for kind in chosen(settings)]


class DescribingLogger(TensorBoardLogger):
    """TensorBoard's logger whose scalars carry descriptions (`mosa.curves`), which TensorBoard shows beside their titles."""

    def __init__(self, folder: Path, law: str) -> None:
        super().__init__(folder, name="tensorboard", version="", default_hp_metric=False)
        self.law = law
        self.written: set[str] = set()

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """TensorBoard takes a description from the first point of a file, where torch's writer has no place for one."""
        rest = dict(metrics)
        for tag in [tag for tag in metrics if tag not in self.written]:
            self.written.add(tag)
            if (text := described(tag, self.law)) is not None:
                point = scalar(tag, float(rest.pop(tag)))
                about = point.value[0].metadata
                about.summary_description, about.plugin_data.plugin_name = text, "scalars"
                # without its class TensorBoard's fast reader takes the point for one of old programs and drops what is beside it
                about.data_class = DATA_CLASS_SCALAR
                self.experiment._get_file_writer().add_summary(point, step)
        super().log_metrics(rest, step)


def tensorboard(folder: Path, law: str) -> TensorBoardLogger:
    return DescribingLogger(folder, law)


def csv_table(folder: Path) -> CSVLogger:
    """A run that goes on gets a table of its own (version_1): this logger empties one that is there."""
    return CSVLogger(folder, name="csv", flush_logs_every_n_steps=10)


def wandb_run(settings: Mapping[str, Any], folder: Path) -> WandbLogger:
    """A run that is called like its folder; asked for again, the same one."""
    return WandbLogger(save_dir=folder, name=folder.name, log_model=False, **{k: v for k, v in settings.items() if v is not None})


def add_picture(loggers: list[Logger], name: str, picture: Tensor, step: int) -> None:
    """A picture (3, H, W) in [0, 1] in those loggers that show pictures."""
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, picture, step)
        elif isinstance(logger, WandbLogger):
            logger.log_image(name, [np.asarray(picture.movedim(0, -1))], step=step)


def log_outcome(
    settings: Mapping[str, Any] | None, folder: Path, cfg: dict, figures: Mapping[str, float | str], law: str
) -> None:
    """The run's configuration beside its final figures, as `final/...`: TensorBoard's table of hyper-parameters, the summary of
    wandb's run, which ends here. A table of steps has no place for them; metrics.json has them all. law: of
    the prior."""
    final = {f"final/{k}": v for k, v in figures.items() if k in OUTCOME or k.startswith(("id/", "id_prior/"))}
    parameters = {k: v for k, v in cfg.items() if k not in ("evaluation", "logger", "hydra")}
    kinds = chosen(settings)
    if "tensorboard" in kinds:
        logger = tensorboard(folder, law)
        (Path(logger.log_dir) / "hparams.yaml").unlink(missing_ok=True)  # the fit's logger left an empty one, which would be kept
        logger.log_hyperparams(parameters, final)
        logger.finalize("success")
    if "wandb" in kinds:
        experiment = wandb_run(settings["wandb"], folder).experiment
        experiment.config.update(parameters)
        experiment.summary.update(final)
        experiment.finish()
