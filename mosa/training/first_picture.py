"""The first picture of a run, before its fit: the reconstruction beside the prior, of which nothing has been learned yet."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from lightning.pytorch.loggers import Logger

from mosa.config.build import body_of, measured, plain, world_of
from mosa.errors import MosaError
from mosa.evaluation.analysis.comparison import View
from mosa.evaluation.analysis.figures import write_strip
from mosa.reconstruction.rest_shape import RestShape
from mosa.rendering.appearance.carried_splats import seen
from mosa.training.datamodule import SceneDataModule
from mosa.training.loggers import add_picture

log = logging.getLogger(__name__)


@torch.no_grad()
def write_first_picture(folder: Path, data: SceneDataModule, loggers: Sequence[Logger]) -> None:
    """first.png in the run folder and in the loggers that show pictures: the training film, its reconstruction, and the prior with
    the numbers that the configuration gives, as the first camera sees them."""
    scene, found = data.scene, data.reconstruction
    frames, frame_dt = len(scene.training_frames), scene.frame_dt
    shape = RestShape.of(found, data.device or "cpu")
    record = measured(plain(data.cfg), scene, data.dx, {"train": data.start})
    body = body_of(shape, record)
    view = View.of(scene, body.size)
    motions = {"reconstruction": found.cues.positions[:frames].to(body.rest)}
    try:
        rollout = body.simulate(data.start, world_of(record), frames, frame_dt)
        motions["prior, before its calibration"] = rollout.x
    except MosaError as error:
        log.info("the prior cannot be simulated before its calibration (%s)", error)
    F = torch.eye(3).to(body.rest).expand(frames, len(body.rest), 3, 3)
    rows = {"film": view.finished(view.real[:frames])} | {
        name: view.finished(view.drawn(seen(body, x, F))) for name, x in motions.items()
    }
    path = folder / "first.png"
    picture = write_strip(path, rows, notes={"film": view.moments})
    log.info("first picture, the reconstruction beside the prior: %s", path)
    shown = torch.from_numpy(picture).movedim(-1, 0) / 255
    add_picture(loggers, "film_reconstruction_prior", shown, 0)
