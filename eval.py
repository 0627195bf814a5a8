"""Figures, rollouts and video of a trained run from its checkpoint:  python eval.py ckpt_path=outputs/.../last.ckpt

With any of simulate.velocity, simulate.rotation, simulate.position, simulate.height, simulate.angular_velocity it rolls the
learned law out from a new start instead. Where the package is installed, `mosa-eval` is the same command.
"""

from mosa.cli.eval import main

if __name__ == "__main__":
    main()
