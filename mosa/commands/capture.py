"""From phone videos to a scene that trains:  mosa-capture videos=<folder> poses=<COLMAP model> output=<folder>"""

import hydra
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration
from mosa.jobs import attempt, command


@hydra.main(version_base="1.3", config_path=configuration(), config_name="capture")
def run(cfg: DictConfig) -> None:
    def job(cfg: DictConfig) -> None:
        from mosa.capture.making import make

        make(cfg)

    begin_log()
    return attempt(job, cfg)


def main() -> None:
    command(run, configuration())
