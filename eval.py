"""Figures, rollouts and video of a trained run from its checkpoint:  python eval.py ckpt_path=outputs/.../last.ckpt

With any of simulate.velocity, simulate.rotation, simulate.height, simulate.angular_velocity it rolls the learned law out from a
new start instead.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import hydra
from omegaconf import DictConfig

from mosa.jobs import Failures, attempt, check_arguments


@hydra.main(version_base="1.3", config_path="conf", config_name="eval")
def main(cfg: DictConfig) -> float | None:
    def job(cfg: DictConfig) -> float | None:
        from mosa.pipeline import evaluate_checkpoint

        return evaluate_checkpoint(cfg)

    return attempt(job, cfg)


if __name__ == "__main__":
    check_arguments(sys.argv[1:], Path(__file__).parent / "conf")
    main()
    sys.exit(1 if Failures.count else 0)
