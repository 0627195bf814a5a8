"""One fit on several devices: who does which part of a step, and the exchange after it. With one process all of it does nothing."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import contextmanager

import torch
import torch.distributed as dist
from lightning.pytorch.overrides.distributed import _sync_module_states
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.strategies.launchers.subprocess_script import _SubprocessScriptLauncher
from torch import Tensor, nn

from mosa.errors import ConfigError, MosaError

LOST = "{}, and the fit cannot go on without it; resume with ckpt_path=<run folder>/checkpoints/last.ckpt"
GRACE = 10.0  # [s] that a rank has to end by itself, with a message of its own, after another one has ended


class RankLost(MosaError):
    """Another process of the fit ended before the fit did."""


def devices(accelerator: str, wanted: int | Sequence[int]) -> list[str]:
    """torch devices of the ranks. wanted: how many, or indices of GPUs. Errors: ConfigError naming the key."""
    if accelerator not in ("cpu", "gpu", "cuda"):
        raise ConfigError(f"trainer.accelerator: expected cpu or gpu, found {accelerator!r}")
    counted = isinstance(wanted, int) and not isinstance(wanted, bool)
    indices = list(range(wanted)) if counted else list(wanted) if isinstance(wanted, Sequence) else []
    valid = indices and len(set(indices)) == len(indices) and all(isinstance(i, int) and i >= 0 for i in indices)
    if not valid or (accelerator == "cpu" and not counted):
        also = "" if accelerator == "cpu" else " or a list of indices of GPUs"
        raise ConfigError(f"trainer.devices: expected a whole number of at least 1{also}, found {wanted!r}")
    if accelerator == "cpu":
        return ["cpu"] * wanted
    available = torch.cuda.device_count()
    if max(indices) >= available:
        limit = f"at most {available}" if counted else f"indices below {available}"
        raise ConfigError(f"trainer.devices: expected {limit}, the GPUs that torch finds on this machine, found {wanted!r}; "
                          "trainer.accelerator=cpu runs without")
    return [f"cuda:{i}" for i in indices]


def launched_rank() -> int:
    """Rank of this process among those of the fit, also before they are connected: 0 for the one the user started."""
    return int(os.environ.get("LOCAL_RANK", 0))


def rank() -> int:
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    return dist.get_world_size() if dist.is_initialized() else 1


def share(takes: int, views: list[int]) -> list[tuple[int, list[int], float]]:
    """This rank's part of a step: (take, views to render, weight). Over all ranks the weights add up to 1.

    With at least as many takes as ranks each rank has whole takes; with fewer, ranks of a take split its views. Terms that do not
    depend on views are then computed by each of these, and counted as often as their views are.
    """
    world, own = world_size(), rank()
    if takes >= world:
        return [(take, views, 1 / takes) for take in range(own, takes, world)]
    take, place = own % takes, own // takes
    part = views[place :: len(range(take, world, takes))]
    return [(take, part, len(part) / len(views) / takes)]


def check_share(world: int, takes: int, views: int) -> None:
    """Errors: ConfigError where a rank would have nothing to do."""
    if -(-world // takes) > views:
        raise ConfigError(f"trainer.devices: expected at most {takes * views} (sequences to learn from x fit.views), found {world}")


@contextmanager
def peers():
    """Errors: RankLost where another process ended during a collective call."""
    try:
        yield
    except RuntimeError as error:  # what gloo and NCCL raise when a connection breaks
        raise RankLost(LOST.format(f"the connection to another process of the fit was lost ({error})")) from error


def agree(failure: MosaError | None) -> None:
    """Raise the failure of the first rank that has one, on every rank: none is left waiting for another."""
    if world_size() == 1:
        if failure is not None:
            raise failure
        return
    with peers():
        failed = torch.tensor(float(failure is not None), device=collective_device())
        dist.all_reduce(failed, dist.ReduceOp.MAX)
        if not failed:
            return
        found: list[MosaError | None] = [None] * world_size()
        dist.all_gather_object(found, failure)
    raise next(error for error in found if error is not None)


def exchange(parameters: Iterable[nn.Parameter], figures: dict[str, Tensor]) -> dict[str, Tensor]:
    """Sum gradients (in place) and figures (the same names on each rank) over the ranks.

    A gradient that some ranks do not have counts as zero there; one that none has stays None.
    """
    if world_size() == 1:
        return figures
    parameters = list(parameters)
    device = collective_device()
    flat = [(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters]
    present = torch.tensor([float(p.grad is not None) for p in parameters], device=device)
    names = sorted(figures)
    values = [torch.as_tensor(figures[name], device=device).reshape(1) for name in names]
    total = torch.cat([*flat, present, *values])
    with peers():
        dist.all_reduce(total)
    parts = total.split([p.numel() for p in parameters] + [len(parameters), len(names)])
    for parameter, gradient, owners in zip(parameters, parts, parts[-2].tolist()):
        parameter.grad = gradient.view_as(parameter).to(parameter.dtype) if owners else None
    return dict(zip(names, parts[-1]))


def mean(value: float) -> float:
    """Of a number that each rank has."""
    if world_size() == 1:
        return value
    return float(exchange((), {"value": torch.tensor(value / world_size(), dtype=torch.float64)})["value"])


def synchronise(module: nn.Module) -> None:
    """Parameters and buffers of rank 0, on every rank."""
    if world_size() > 1:
        with peers():
            _sync_module_states(module)


def disconnect() -> None:
    """The ranks part, also after an error: a process that ends with open connections of gloo aborts now and then (2 of 12)."""
    if dist.is_initialized():
        dist.destroy_process_group()


def collective_device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device()) if dist.get_backend() == "nccl" else torch.device("cpu")


class SharedSteps(DDPStrategy):
    """Lightning's processes and process group, without `DistributedDataParallel`.

    Its reducer expects one backward pass per step that reaches every parameter; here a step has one backward pass per take, and
    which parameters it reaches depends on the stage. The module exchanges its gradients itself (`exchange`).
    """

    def configure_ddp(self) -> None:
        synchronise(self.model)

    def _configure_launcher(self) -> None:
        self._launcher = Launcher(self.cluster_environment, self.num_processes, self.num_nodes)

    def barrier(self, *args, **kwargs) -> None:
        with peers():
            super().barrier(*args, **kwargs)

    def reduce(self, *args, **kwargs):
        with peers():
            return super().reduce(*args, **kwargs)


class Launcher(_SubprocessScriptLauncher):
    """Lightning's launcher, with an end that says what happened: Lightning's own kills rank 0 without a word."""

    def launch(self, function: Callable, *args, trainer=None, **kwargs):
        over = threading.Event()
        if self.cluster_environment.creates_processes_externally:
            parent = os.getppid()
            watch(over, lambda: "rank 0 ended" if os.getppid() != parent else None)
        else:
            self._call_children_scripts()
            watch(over, self.ended, last=lambda: self.kill(signal.SIGKILL))
        result = function(*args, **kwargs)
        over.set()  # what ranks do after the fit does not concern each other
        return result

    def ended(self) -> str | None:
        """The first rank that ended with an error."""
        codes = [process.poll() for process in self.procs]
        return next((f"rank {i} ended with code {code}" for i, code in enumerate(codes, 1) if code), None)

    def wait_ended(self) -> str | None:
        """The same, where a connection has just been lost: the process may still be ending."""
        for _ in range(20):
            if (reason := self.ended()) is not None:
                return reason
            time.sleep(0.1)
        return None


def watch(over: threading.Event, ended: Callable[[], str | None], last: Callable[[], None] = lambda: None) -> None:
    """End this process `GRACE` seconds after `ended` first gives a reason: it may hang in a collective call of NCCL."""

    def run() -> None:
        while (reason := ended()) is None:
            if over.wait(1.0):
                return
        if over.wait(GRACE):
            return
        last()
        print(f"\nRankLost: {LOST.format(reason)}", file=sys.stderr, flush=True)
        os._exit(2)

    threading.Thread(target=run, daemon=True, name="watch-ranks").start()
