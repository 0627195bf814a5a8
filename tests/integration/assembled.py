"""A fit of the tiny scene, assembled as train.py does and not begun."""

from collections.abc import Collection
from pathlib import Path

from hydra import compose, initialize_config_dir

from mosa.assembly import assemble

ROOT = Path(__file__).parents[2]


def assembled(cache: Path, *overrides: str, taught: Collection[str] = ()) -> tuple:
    """(cfg, training scene, module). cache: folder of the scene and its reconstruction; taught: further sequences."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        names = f"scene.also_train=[{','.join(taught)}]"
        cfg = compose("train", overrides=["debug=default", f"scene.cache={cache}", names, *overrides])
    run = assemble(cfg, held_out=False)
    return cfg, run.scene, run.module
