"""Policies trained in a twin and tested in the hidden truth:  mosa-environments task=pushing checkpoint=..."""

import hydra
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration
from mosa.jobs import attempt, command


@hydra.main(version_base="1.3", config_path=configuration(), config_name="environments")
def run(cfg: DictConfig) -> None:
    def job(cfg: DictConfig) -> None:
        from mosa.environments.command import train_and_test

        return train_and_test(cfg)

    begin_log()
    return attempt(job, cfg)


def main() -> None:
    command(run, configuration())
