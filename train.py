"""Learn a simulator of a deforming object from multi-view video:  python train.py scene=rabbit prior=corotated"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # on small tensors and shared machines a second thread was measured 30x slower

if os.environ.get("LOCAL_RANK", "0") != "0":  # a further process of a fit on several devices: the first speaks for all
    os.environ["TQDM_DISABLE"] = "1"
    sys.stdout = open(os.devnull, "w")  # until the process ends

import hydra
from omegaconf import DictConfig

from mosa.jobs import Failures, attempt, check_arguments


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> float | None:
    def job(cfg: DictConfig) -> float | None:
        from mosa.pipeline import train  # what takes seconds to import, where a mistake in an override has been said

        return train(cfg)

    return attempt(job, cfg)


if __name__ == "__main__":
    check_arguments(sys.argv[1:], Path(__file__).parent / "conf")
    main()
    sys.exit(1 if Failures.count else 0)
