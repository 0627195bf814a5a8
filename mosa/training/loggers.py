"""Pictures of a fit and the outcome of a run, in the loggers that can show them.

Which loggers there are is said by conf/logger; any of Lightning's can be named there (`_target_`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from torch import Tensor

OUTCOME = """train/rms_m test/rms_m prior/test/rms_m prior_eta/test/rms_m train/psnr_crop
test/psnr_crop camera/psnr_crop test/mean_abs_C""".split()


PICTURED = (TensorBoardLogger, WandbLogger)  # loggers that show pictures


def add_picture(loggers: Sequence[Logger], name: str, picture: Tensor, step: int) -> None:
    """A picture (3, H, W) in [0, 1] in those loggers that show pictures."""
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, picture, step)
        elif isinstance(logger, WandbLogger):
            logger.log_image(name, [np.asarray(picture.movedim(0, -1))], step=step)


def log_outcome(
    loggers: Sequence[Logger], cfg: Mapping[str, Any], figures: Mapping[str, float | str]
) -> None:
    """The run's configuration beside its final figures, as `final/...`: TensorBoard's table of hyper-parameters, the summary of
    wandb's run, which ends here. A table of steps has no place for them; metrics.json has them all."""
    said = [k for k in figures if k in OUTCOME or k.startswith(("id/", "id_prior/"))]
    final = {f"final/{k}": figures[k] for k in said}
    without = ("evaluation", "logger", "callbacks", "trainer", "hydra")
    parameters = {k: v for k, v in cfg.items() if k not in without}
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            # the fit left an empty one, which would be kept
            (Path(logger.log_dir) / "hparams.yaml").unlink(missing_ok=True)
            logger.log_hyperparams(parameters, final)
            logger.finalize("success")
        elif isinstance(logger, WandbLogger):
            logger.experiment.config.update(parameters)
            logger.experiment.summary.update(final)
            logger.experiment.finish()
