"""A 3DGS file of an object becomes a body that falls, without any video:  mosa-splats ply=object.ply prior=corotated"""

import hydra
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration
from mosa.jobs import attempt, command


@hydra.main(version_base="1.3", config_path=configuration(), config_name="splats")
def run(cfg: DictConfig) -> None:
    def job(cfg: DictConfig) -> None:
        from mosa.splats.objects import drop

        return drop(cfg)

    begin_log()
    return attempt(job, cfg)


def main() -> None:
    command(run, configuration())
