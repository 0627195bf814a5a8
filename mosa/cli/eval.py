"""Figures, rollouts and video of a trained run from its checkpoint:  mosa-eval ckpt_path=outputs/.../last.ckpt

With any of simulate.velocity, simulate.rotation, simulate.position, simulate.height, simulate.angular_velocity it rolls the
learned law out from a new start instead."""

from mosa.cli.configured import command

main = command(__name__, "mosa.training.workflow:evaluate_checkpoint")
