"""Learn a simulator of a deforming object from multi-view video:  python train.py scene=rabbit prior=corotated"""

import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # on small tensors and shared machines a second thread was measured 30x slower

import hydra
from omegaconf import DictConfig


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> float | None:
    from mosa.errors import MosaError
    from mosa.pipeline import train

    try:
        return train(cfg)
    except MosaError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("\nstopped; resume with ckpt_path=<run folder>/checkpoints/last.ckpt", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
