"""A run's place: what its folder already holds, the device of each of its processes, and what they hand on through it."""

from __future__ import annotations

import json
import logging
import math
import platform
import resource
import warnings
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mosa.config.build import plain
from mosa.config.checkpoints import check_same_run, read_checkpoint, record_of
from mosa.errors import ConfigError, DataError
from mosa.system.machine_errors import LAST
from mosa.system.whole_files import written_whole

log = logging.getLogger(__name__)

VALIDATION = "val/"  # begins the names of figures of what is held out of the training sequence
VALIDATED = [
    VALIDATION + part + k for part in ("", "cameras/", "frames/") for k in ("loss", "psnr")
]
MOST_PARTICLES = {"cpu": 6000, "cuda": 30000}
"""Of simulation.particles=auto: what a machine identifies in the time that a user waits for a first result."""
SPECIAL = {"Infinity": math.inf, "-Infinity": -math.inf, "NaN": math.nan}
"""Figures that JSON has no numbers for, as strings that float() and JavaScript's Number() read."""


def run_folder() -> Path:
    """Of the job that Hydra runs."""
    return Path(HydraConfig.get().runtime.output_dir)


def quiet() -> None:
    """Keep library chatter off the screen; errors and our own output stay."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # its table was asked for
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    warnings.filterwarnings("ignore", module="lightning.*")


def write_figures(folder: Path, figures: dict[str, float | str]) -> None:
    """metrics.json, sorted, strict JSON; whole or not at all, as it tells resume=auto that the run is complete."""

    def strict(value: float | str) -> float | str:
        if isinstance(value, float) and not math.isfinite(value):
            return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
        return value

    with written_whole(folder / "metrics.json") as partial:
        partial.write_text(
            json.dumps({k: strict(figures[k]) for k in sorted(figures)}, indent=1, allow_nan=False)
        )


def read_figures(path: Path) -> dict[str, float | str]:
    """What `write_figures` wrote: infinite figures and those that are not numbers are floats again."""
    try:
        found = json.loads(path.read_text())
        if not all(isinstance(v, (int, float, str)) for v in dict(found).values()):
            raise ValueError("no figures by name")
    except (ValueError, TypeError, RecursionError, OSError) as error:
        raise DataError(
            f"{path}: expected the figures of a complete run, found a damaged file ({error}): "
            "remove it"
        ) from error
    return {k: SPECIAL.get(v, v) if isinstance(v, str) else v for k, v in found.items()}


def finished(cfg: DictConfig, folder: Path) -> dict[str, float] | None:
    """The figures of a run that is complete and, with resume=auto, is not made again. Errors: ConfigError where the folder's run is
    one of another configuration."""
    if cfg.resume not in (None, "auto"):
        raise ConfigError(
            f"resume: expected null or auto, found {cfg.resume!r}; a checkpoint's path is ckpt_path"
        )
    if cfg.resume != "auto" or not (path := folder / "metrics.json").is_file():
        return None
    check_own(cfg, folder)
    return read_figures(path)


def check_own(cfg: DictConfig, folder: Path) -> None:
    """The folder's checkpoint, where it has one that can be read, is of this configuration. Errors: ConfigError."""
    try:
        found = record_of(read_checkpoint(folder / LAST), folder / LAST)
    except DataError:  # said where a fit is to go on from it
        return
    check_same_run(found, plain(cfg), folder)


def begins_from(cfg: DictConfig, folder: Path) -> str | None:
    """The checkpoint that the fit goes on from: with resume=auto the run folder's own where it has one. Errors: ConfigError where
    that is of another configuration."""
    last = folder / LAST
    if cfg.resume != "auto" or not last.is_file():
        return cfg.ckpt_path
    check_own(cfg, folder)
    log.info("going on from %s (resume=auto)", last)
    return str(last)


def most_particles(device: torch.device | str) -> int:
    """Of simulation.particles=auto."""
    return MOST_PARTICLES["cpu" if str(device) == "cpu" else "cuda"]


def device_label(name: str) -> str:
    """What a torch device is called on this machine."""
    if name != "cpu":
        return torch.cuda.get_device_name(name)
    listed = Path("/proc/cpuinfo")  # Linux; platform.processor() has no model there
    lines = listed.read_text().splitlines() if listed.is_file() else []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()


def peak_memory() -> float:
    """GB that this process held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def cost(device: str) -> dict[str, float | str]:
    """Device and peak memory of this process: `time/device`, `time/peak_memory_gb`, and of a GPU what torch took."""
    figures = {"time/device": device_label(device), "time/peak_memory_gb": peak_memory()}
    if device != "cpu":
        figures["time/peak_gpu_memory_gb"] = torch.cuda.max_memory_allocated(device) / 1e9
    return figures
