"""Learn a simulator of a deforming object from multi-view video:  mosa-train scene=rabbit prior=corotated"""

import os
import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration, fail

failed: list[str] = []
"""What went wrong in the jobs of a sweep that run in this process."""


@hydra.main(version_base="1.3", config_path=configuration(), config_name="train")
def run(cfg: DictConfig) -> float | None:
    begin_log()
    from mosa.errors import MosaError
    from mosa.pipeline import train

    try:
        return train(cfg)
    except MosaError as error:
        fail(f"{type(error).__name__}: {error}")
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            failed.append(str(error))
            return float("inf")  # the sweep's other jobs go on
        sys.exit(2)
    except KeyboardInterrupt:
        if os.environ.get("LOCAL_RANK", "0") == "0":
            fail("stopped; resume with ckpt_path=<run folder>/checkpoints/last.ckpt")
        sys.exit(130)


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # on small tensors and shared machines a second thread was measured 30x slower
    if os.environ.get("LOCAL_RANK", "0") != "0":  # a further process of a fit on several devices: the first speaks for all
        os.environ["TQDM_DISABLE"] = "1"
        sys.stdout = open(os.devnull, "w")  # until the process ends
    run()
    if failed:
        sys.exit(f"\n{len(failed)} jobs of the sweep failed; the first: {failed[0]}")
