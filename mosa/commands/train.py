"""Learn a simulator of a deforming object from multi-view video:  mosa-train scene=rabbit prior=corotated"""

import os
import sys

import hydra
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration
from mosa.jobs import Failures, attempt, command


@hydra.main(version_base="1.3", config_path=configuration(), config_name="train")
def run(cfg: DictConfig) -> float | None:
    def job(cfg: DictConfig) -> float | None:
        from mosa.pipeline import train  # what takes seconds to import, where a mistake in an override has been said

        return train(cfg)

    begin_log()
    return attempt(job, cfg)


def main() -> None:
    if os.environ.get("LOCAL_RANK", "0") != "0":  # a further process of a fit on several devices: the first speaks for all
        os.environ["TQDM_DISABLE"] = "1"
        sys.stdout = open(os.devnull, "w")  # until the process ends
    command(run, configuration())
    sys.exit(1 if Failures.count else 0)
