"""A fit of the tiny scene, assembled as train.py does and not begun."""

from collections.abc import Collection
from pathlib import Path

from hydra import compose, initialize_config_dir

from mosa.config import run_config
from mosa.modules.lit_mosa import LitMosa
from mosa.pipeline import assemble_fit, body_of, plain, reconstruct_scene, scenes, starts

ROOT = Path(__file__).parents[2]


def assembled(cache: Path, *overrides: str, taught: Collection[str] = ()) -> tuple:
    """(cfg, training scene, module). cache: folder of the scene and its reconstruction; taught: further sequences."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        names = f"scene.also_train=[{','.join(taught)}]"
        cfg = compose("train", overrides=["debug=default", f"scene.cache={cache}", names, *overrides])
    scene, others = scenes(cfg)
    reconstruction, dx = reconstruct_scene(cfg, scene, "cpu")
    config = run_config(plain(cfg), scene, dx)
    body = body_of(reconstruction, config)
    others = [s for s in others if s.sequence in taught]
    found = starts(body, reconstruction, scene, others, taught)
    more = [(s, found[f"train/{s.sequence}"]) for s in others]
    module: LitMosa = assemble_fit(cfg, scene, reconstruction, body, found["train"], config, "cpu", more)[0]
    return cfg, scene, module
