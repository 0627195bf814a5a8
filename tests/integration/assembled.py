"""A fit of the tiny scene, assembled as train.py does and not begun."""

from collections.abc import Collection
from pathlib import Path
from unittest.mock import patch

from hydra import compose, initialize_config_dir

from mosa import assembly
from mosa.modules.body import Body, Start
from mosa.reconstruction.starts import sequence_start
from mosa.types import Appearance, Scene

ROOT = Path(__file__).parents[2]
KNOWN: dict[tuple, Start] = {}
"""By sequence, body and appearance: a start takes a second, and what is assembled here differs in what comes after it."""


def start_once(body: Body, seen: Appearance, scene: Scene, **named: bool) -> Start:
    means, colors = (getattr(seen.splats, name).numpy().tobytes() for name in ("means", "colors"))
    key = (scene.sequence, scene.fingerprint, body.rest.numpy().tobytes(), means, colors, *named.items())
    if key not in KNOWN:
        KNOWN[key] = sequence_start(body, seen, scene, **named)
    return KNOWN[key]


def assembled(cache: Path, *overrides: str, taught: Collection[str] = ()) -> tuple:
    """(cfg, training scene, module). cache: folder of the scene and its reconstruction; taught: further sequences."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        names = f"scene.also_train=[{','.join(taught)}]"
        cfg = compose("train", overrides=["debug=default", f"scene.cache={cache}", names, *overrides])
    with patch.object(assembly, "sequence_start", start_once):
        run = assembly.assemble(cfg, held_out=False)
    return cfg, run.scene, run.module
