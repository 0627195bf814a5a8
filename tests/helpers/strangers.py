"""A checkpoint as a run leaves it, of a small cube that nothing was fitted to: where tests of malicious ones start from."""

import copy
import functools
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from mosa.config.build import build_body
from mosa.config.record import RunRecord
from mosa.modules.body.body import Start

ROOT = Path(__file__).parents[2]
N = 27


def cube() -> dict[str, torch.Tensor]:
    """Tensors of a body of N particles, 0.3 m above the ground."""
    axis = torch.tensor([0.0, 0.05, 0.1])
    return {"rest": torch.cartesian_prod(axis, axis + 0.3, axis), "volume": torch.full((N,), 1.25e-4),
            "colors": torch.full((N, 3), 0.25), "opacities": torch.full((N,), 0.9),
            "covariances": 1e-4 * torch.eye(3).expand(N, 3, 3).clone()}  # fmt: skip


def saved(*overrides: str) -> dict:
    """What `torch.save` would be given, a copy of one's own; overrides: of the configuration."""
    return copy.deepcopy(_saved(*overrides))


@functools.cache
def _saved(*overrides: str) -> dict:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = OmegaConf.to_container(
            compose("train", overrides=["debug=default", *overrides]), resolve=True
        )
    world = {"ground": {"height": 0.0, "mode": "sticky", "friction": 0.0}, "gravity": [0, -9.8, 0], "up": [0, 1, 0],
             "box": [[-1, -0.1, -1], [1, 1, 1]]}  # fmt: skip
    start = Start(
        torch.eye(3), torch.tensor([0.05, 0.35, 0.05]), torch.zeros(3), torch.zeros(3)
    ).written()
    fit = {"stage": 3, "losses": [], "steps_done": 5, "particles": N, "misfit": 0.01}
    record = RunRecord(
        settings=cfg, ground=world.pop("ground"), world=world, density=1000.0, dx=0.1, frame_dt=1 / 60, starts={"train": start},
        start=start, fit=fit,
    )  # fmt: skip
    body = build_body(record, cube())
    return {
        "state_dict": {f"body.{k}": v for k, v in body.state_dict().items()},
        "mosa": record.plain(),
    }


def checkpoint(path: Path, *overrides: str, change=lambda stored: None) -> Path:
    """A file with the above, changed in place."""
    stored = saved(*overrides)
    change(stored)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(stored, path)
    return path
