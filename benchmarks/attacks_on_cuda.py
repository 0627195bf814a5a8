"""Attacks of robustness.py that a GPU answers otherwise: no such device, no memory left, sums in no order. Whole processes, three
minutes on an H200; nothing where there is no GPU.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from attacks import ROOT, Attack, cube, refuse, stored

from mosa.environments.arena import simulator_named
from mosa.twin import Twin

LEFT = 0.7e9
"""Bytes of the GPU that are left for a run which needs more: CUDA's own context takes half of a gigabyte."""
SAME = 1e-4
"""[m] by which two equal rollouts may differ on a GPU, of a body of 0.1 m: sums over particles have no order there."""
RUN = ("debug=default", "trainer=gpu", "evaluation.video=false", "logger=none")


def program(folder: Path, *arguments: str, code: int = 2) -> None:
    """A run of train.py that ends with this code and without a traceback."""
    found = subprocess.run([sys.executable, "train.py", f"hydra.run.dir={folder}", *RUN, *arguments], cwd=ROOT, capture_output=True,
                           text=True)  # fmt: skip
    if found.returncode != code or "Traceback" in found.stderr:
        raise AssertionError(f"{found.returncode}: {found.stderr[-600:]}")


def without_memory(folder: Path) -> None:
    """A run while another program holds nearly all of the GPU."""
    free, _ = torch.cuda.mem_get_info()
    held = torch.empty(int(free - LEFT), dtype=torch.uint8, device="cuda")
    try:
        program(folder / "full", "simulation.particles=20000", "scene.scale=1")
    finally:
        del held
        torch.cuda.empty_cache()
    refuse("one message")


def equal_runs(folder: Path) -> None:
    """With deterministic=true two runs have the same figures to the bit, but for times and memory."""
    figures = []
    for name in ("a", "b"):
        program(folder / name, "deterministic=true", code=0)
        found = json.loads((folder / name / "metrics.json").read_text())
        figures.append({key: value for key, value in found.items() if not key.startswith("time/")})
    if different := sorted(key for key in figures[0] if figures[0][key] != figures[1].get(key)):
        raise AssertionError(f"{len(different)} of {len(figures[0])} figures differ: {', '.join(different[:5])}")
    refuse("the same figures")


def near(a: torch.Tensor, b: torch.Tensor) -> None:
    far = float((a.cpu() - b.cpu()).abs().max())
    if not far <= SAME:
        raise AssertionError(f"{far:.3g} m apart")
    refuse(f"{far:.3g} m apart")


def cuda(folder: Path) -> Iterator[Attack]:
    """Nothing without a GPU."""
    if not torch.cuda.is_available():
        return
    torch.save(stored(), folder / "good.ckpt")
    file, start = folder / "good.ckpt", {"height": 0.02, "velocity": (0, -2, 0), "frames": 20}
    for device in ("cuda:99", "cuda:-1", "cuda:a", "cuda:0:0", "CUDA"):
        yield f"device={device}", lambda d=device: Twin.load(file, d)
        yield f"truth device={device}", lambda d=device: simulator_named("truth", scene="tiny", spacing=0.05, device=d)
    yield "a twin on the GPU and on the CPU", lambda: near(Twin.load(file, "cuda").simulate(**start).x, cube().simulate(**start).x)
    yield "two twins on the GPU", lambda: near(*(Twin.load(file, "cuda").simulate(**start).x for _ in range(2)))
    for number, override in enumerate(("trainer.devices=99", "trainer.devices=[0,0]", "trainer.devices=[-1]",
                                       "simulation.particles=100000000")):  # fmt: skip
        yield override, lambda o=override, n=number: (program(folder / f"wrong_{n}", o), refuse("one message"))
    yield "no memory left", lambda: without_memory(folder)
    if "deterministic:" in (ROOT / "conf" / "train.yaml").read_text():
        yield "two runs with deterministic=true", lambda: equal_runs(folder)
