"""Figures, rollouts and video of a trained run from its checkpoint:  mosa-eval ckpt_path=outputs/.../last.ckpt

With any of simulate.velocity, simulate.rotation, simulate.height, simulate.angular_velocity it rolls the learned law out from a
new start instead.
"""

import os
import sys

import hydra
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration, fail


@hydra.main(version_base="1.3", config_path=configuration(), config_name="eval")
def run(cfg: DictConfig) -> float | None:
    begin_log()
    from mosa.errors import MosaError
    from mosa.pipeline import evaluate_checkpoint

    try:
        return evaluate_checkpoint(cfg)
    except MosaError as error:
        fail(f"{type(error).__name__}: {error}")
        sys.exit(2)


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    run()
