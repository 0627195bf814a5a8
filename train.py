"""Learn a simulator of a deforming object from multi-view video:  python train.py scene=rabbit prior=corotated"""

import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # on small tensors and shared machines a second thread was measured 30x slower

if os.environ.get("LOCAL_RANK", "0") != "0":  # a further process of a fit on several devices: the first speaks for all
    os.environ["TQDM_DISABLE"] = "1"
    sys.stdout = open(os.devnull, "w")  # until the process ends

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

failed: list[str] = []
"""What went wrong in the jobs of a sweep that run in this process."""


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> float | None:
    from mosa.errors import MosaError
    from mosa.pipeline import train

    try:
        return train(cfg)
    except MosaError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            failed.append(str(error))
            return float("inf")  # the sweep's other jobs go on
        sys.exit(2)
    except KeyboardInterrupt:
        if os.environ.get("LOCAL_RANK", "0") == "0":
            print("\nstopped; resume with ckpt_path=<run folder>/checkpoints/last.ckpt", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
    if failed:
        sys.exit(f"\n{len(failed)} jobs of the sweep failed; the first: {failed[0]}")
