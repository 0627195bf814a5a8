"""Attacks of robustness.py that a GPU answers otherwise: no such device, no memory left, sums in no order. Whole processes, two and
a half minutes (cuda) and two (gpu_memory) on an H200; nothing where there is no GPU.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from attacks import ROOT, Attack, cube, refuse, stored

from mosa.environments.arena import simulator_named
from mosa.twin.twin import Twin

LEFT = (0.6e9, 0.7e9, 1.0e9)
"""Bytes of the GPU that are left for a run which needs more: CUDA's own context takes half of a gigabyte, so that it fails with the
context, with a library's handle or a kernel's module, or with the first large tensor."""
MOMENTS = ("] reconstruction took", "] fit: ")
"""Lines of a run's log; once it has one of them another program takes all that is left of the GPU."""
SAME = 1e-4
"""[m] by which two equal rollouts may differ on a GPU, of a body of 0.1 m: sums over particles have no order there."""
RUN = ("debug=default", "trainer=gpu", "evaluation.video=false", "logger=none")


def ended(code: int, screen: str, *wanted: int) -> None:
    """Errors: AssertionError, with the last line, for another exit code or a traceback; the whole is printed."""
    if code not in wanted or "Traceback" in screen:
        print(screen[-6000:], flush=True)
        raise AssertionError(f"{code}: {(screen.strip().splitlines() or ['nothing said'])[-1]}")


def program(folder: Path, *arguments: str, code: int = 2) -> str:
    """The screen of a run of train.py that ends with this code and without a traceback."""
    found = subprocess.run([sys.executable, "train.py", f"hydra.run.dir={folder}", *RUN, *arguments], cwd=ROOT, capture_output=True,
                           text=True)  # fmt: skip
    ended(found.returncode, found.stderr, code)
    return found.stderr


def taken(left: float) -> torch.Tensor:
    """What holds the GPU's memory but for so many bytes."""
    free, _ = torch.cuda.mem_get_info()
    return torch.empty(max(0, int(free - left)), dtype=torch.uint8, device="cuda")


def without_memory(folder: Path, left: float) -> None:
    """A run while another program holds nearly all of the GPU."""
    held = taken(left)
    try:
        told = program(folder, "simulation.particles=20000", "scene.scale=1")
    finally:
        del held
        torch.cuda.empty_cache()
    if "no memory left" not in told:
        raise AssertionError(f"not said: {told[-300:]}")
    refuse("one message")


def out_of_memory_later(folder: Path, line: str) -> None:
    """Another program takes the GPU once the run's log has the line. What torch holds already may be enough for the run; where it
    is not, one message names the checkpoint that the fit has written, and the same command goes on from there."""
    words = [sys.executable, "train.py", f"hydra.run.dir={folder}", *RUN, "resume=auto"]
    process = subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    log = folder / "train.log"
    while process.poll() is None and not (log.is_file() and line in log.read_text()):
        time.sleep(0.02)
    held = taken(0.05e9)
    try:
        told = process.communicate()[1]
    finally:
        del held
        torch.cuda.empty_cache()
    ended(process.returncode, told, 0, 2)
    if process.returncode:
        kept = (folder / "checkpoints" / "last.ckpt").is_file()
        if "no memory left" not in told or kept != ("resume=auto goes on" in told):
            raise AssertionError(f"not said: {told[-300:]}")
        ended(*ran_again(words), 0)
    refuse("one message, and resumed" if process.returncode else "enough for the run")


def ran_again(words: list[str]) -> tuple[int, str]:
    again = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    return again.returncode, again.stderr


def gpu_memory(folder: Path) -> Iterator[Attack]:
    """Nothing without a GPU."""
    if not torch.cuda.is_available():
        return
    for number, left in enumerate(LEFT):
        yield (
            f"{left / 1e9:g} GB of the GPU left",
            lambda f=left, n=number: without_memory(folder / f"full_{n}", f),
        )
    for number, line in enumerate(MOMENTS):
        yield (
            f"none left after {line!r}",
            lambda x=line, n=number: out_of_memory_later(folder / f"later_{n}", x),
        )


def equal_runs(folder: Path) -> None:
    """With deterministic=true two runs have the same figures to the bit, but for times and memory."""
    figures = []
    for name in ("a", "b"):
        program(folder / name, "deterministic=true", code=0)
        found = json.loads((folder / name / "metrics.json").read_text())
        figures.append({key: value for key, value in found.items() if not key.startswith("time/")})
    if different := sorted(key for key in figures[0] if figures[0][key] != figures[1].get(key)):
        raise AssertionError(
            f"{len(different)} of {len(figures[0])} figures differ: {', '.join(different[:5])}"
        )
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
        yield (
            f"truth device={device}",
            lambda d=device: simulator_named("truth", scene="tiny", spacing=0.05, device=d),
        )
    yield (
        "a twin on the GPU and on the CPU",
        lambda: near(Twin.load(file, "cuda").simulate(**start).x, cube().simulate(**start).x),
    )
    yield (
        "two twins on the GPU",
        lambda: near(*(Twin.load(file, "cuda").simulate(**start).x for _ in range(2))),
    )
    for number, override in enumerate(("trainer.devices=99", "trainer.devices=[0,0]", "trainer.devices=[-1]",
                                       "simulation.particles=100000000")):  # fmt: skip
        yield (
            override,
            lambda o=override, n=number: (program(folder / f"wrong_{n}", o), refuse("one message")),
        )
    if "deterministic:" in (ROOT / "conf" / "train.yaml").read_text():
        yield "two runs with deterministic=true", lambda: equal_runs(folder)
