"""Figures, rollouts and video of a trained run from its checkpoint:  python eval.py ckpt_path=outputs/.../last.ckpt

With any of simulate.velocity, simulate.rotation, simulate.height, simulate.angular_velocity it rolls the learned law out from a
new start instead.
"""

import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")

import hydra
from omegaconf import DictConfig


@hydra.main(version_base="1.3", config_path="conf", config_name="eval")
def main(cfg: DictConfig) -> float | None:
    from mosa.errors import MosaError
    from mosa.pipeline import evaluate_checkpoint

    try:
        return evaluate_checkpoint(cfg)
    except MosaError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
