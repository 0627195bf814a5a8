"""Figures, rollouts and video of a trained run from its checkpoint:  mosa-eval ckpt_path=outputs/.../last.ckpt

With any of simulate.velocity, simulate.rotation, simulate.position, simulate.height, simulate.angular_velocity it rolls the
learned law out from a new start instead.
"""

import hydra
from omegaconf import DictConfig

from mosa.commands import begin_log, configuration
from mosa.jobs import attempt, command


@hydra.main(version_base="1.3", config_path=configuration(), config_name="eval")
def run(cfg: DictConfig) -> float | None:
    def job(cfg: DictConfig) -> float | None:
        from mosa.pipeline import evaluate_checkpoint

        return evaluate_checkpoint(cfg)

    begin_log()
    return attempt(job, cfg)


def main() -> None:
    command(run, configuration())
