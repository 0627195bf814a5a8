"""What the attacks of robustness.py share: a configuration, a checkpoint and a twin that are attacked."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from mosa.config.build import build_body
from mosa.config.record import RunRecord
from mosa.errors import MosaError
from mosa.modules.body.body import Start
from mosa.twin.twin import Twin

ROOT = Path(__file__).parents[1]
Attack = tuple[str, Callable[[], object]]
WORLD = {
    "gravity": [0, -9.8, 0],
    "box": [[-0.7, -0.1, -0.7], [0.7, 1.0, 0.7]],
    "ground": {"height": 0.0},
}


def put(tree, path: str, value):
    """A copy of nested containers with a value at a dotted path; deleted where the value is ..."""
    result = copy.deepcopy(tree)
    *above, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    part = result
    for key in above:
        part = part[key]
    if value is ...:
        del part[last]
    else:
        part[last] = value
    return result


@cache
def composed(*overrides: str) -> dict:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return OmegaConf.to_container(
            compose("train", overrides=["debug=default", *overrides]), resolve=True
        )


@cache
def stored() -> dict:
    """A checkpoint's content, of a cube of 27 particles."""
    cfg, axis, n = composed(), torch.tensor([0.0, 0.05, 0.1]), 27
    tensors = {"rest": torch.cartesian_prod(axis, axis + 0.3, axis), "volume": torch.full((n,), 1.25e-4),
               "colors": torch.full((n, 3), 0.25), "opacities": torch.full((n,), 0.9),
               "covariances": 1e-4 * torch.eye(3).expand(n, 3, 3).clone()}  # fmt: skip
    world = {
        "ground": {"height": 0.0},
        "gravity": [0, -9.8, 0],
        "up": [0, 1, 0],
        "box": [[-1, -0.1, -1], [1, 1, 1]],
    }
    start = Start(
        torch.eye(3), torch.tensor([0.05, 0.35, 0.05]), torch.zeros(3), torch.zeros(3)
    ).written()
    fit = {"stage": 3, "losses": [], "steps_done": 1, "particles": n, "misfit": 0.01}
    record = RunRecord(
        settings=cfg, ground=world.pop("ground"), world=world, density=1000.0, dx=0.1, frame_dt=1 / 60, starts={"train": start},
        start=start, fit=fit,
    )  # fmt: skip
    state = {f"body.{k}": v for k, v in build_body(record, tensors).state_dict().items()}
    return {"state_dict": state, "mosa": record.plain()}


@cache
def cube() -> Twin:
    with tempfile.TemporaryDirectory() as folder:
        torch.save(stored(), Path(folder) / "good.ckpt")
        return Twin.load(Path(folder) / "good.ckpt")


def refuse(message: str):
    raise MosaError(message)
