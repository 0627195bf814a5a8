"""Learn a simulator of a deforming object from multi-view video:  python train.py scene=rabbit prior=corotated

Where the package is installed, `mosa-train` is the same command.
"""

from mosa.cli.train import main

if __name__ == "__main__":
    main()
