"""A program that runs every command once, with a GPU whose memory ends in one place after the other; prints a line of JSON each:
place, exit code, what was on the screen, whether the run kept a checkpoint. Arguments: the cache, a folder for the runs."""

import contextlib
import importlib
import io
import json
import logging
import sys
from pathlib import Path
from unittest.mock import patch

import torch

from mosa.system import machine_errors

TORCH = torch.OutOfMemoryError(
    "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 139.80 GiB"
)
WARP = RuntimeError("Failed to allocate 4000 bytes on device 'cuda:0'")
MODULE = Exception("Failed to load CUDA module 'transfer' (out of resources)")
"""Of Warp, which raises no other type there."""
HANDLE = RuntimeError(
    "CUDA error: CUBLAS_STATUS_NOT_INITIALIZED when calling `cublasCreate(handle)`"
)
ALLOC = RuntimeError(
    "cusolver error: CUSOLVER_STATUS_ALLOC_FAILED, when calling `cusolverDnCreate(handle)`"
)

cache, folder = Path(sys.argv[1]), Path(sys.argv[2])
SMALL = ["debug=default", f"scene.cache={cache}", "adapter=none", "heterogeneity.enabled=false", "fit.prior.looks=0",
         "evaluation.video=false", "evaluation.floor=false", "logger=none"]  # fmt: skip
"""A fit of one stage and two steps."""
RUN, CHECKPOINT = folder / "run", folder / "run" / "checkpoints" / "last.ckpt"
FIRST, AGAIN = [*SMALL, f"hydra.run.dir={RUN}"], [*SMALL, f"hydra.run.dir={RUN}", "resume=auto"]


def other(name: str, *words: str) -> list[str]:
    return [*words, f"hydra.run.dir={folder / name}"]


class Later:
    """Calls through, and raises from its second call on."""

    def __init__(self, call, error: Exception) -> None:
        self.call, self.error, self.calls = call, error, 0

    def __get__(self, instance, _owner):
        return lambda *given, **named: self(instance, *given, **named)

    def __call__(self, *given, **named):
        self.calls += 1
        if self.calls > 1:
            raise self.error
        return self.call(*given, **named)


PLACES = [  # command, its words, where memory ends, what is raised there
    ("train", FIRST, "mosa.training.workflow:check_with_data", MODULE),
    ("train", FIRST, "mosa.training.datamodule:reconstruct", TORCH),
    ("train", FIRST, "mosa.training.datamodule:sequence_start", HANDLE),
    ("train", FIRST, "mosa.training.lit_mosa:LitMosa.training_step", WARP),
    ("train", AGAIN, "mosa.training.lit_mosa:LitMosa.on_load_checkpoint", TORCH),
    ("train", AGAIN, "mosa.training.lit_mosa:LitMosa.end", ALLOC), ("train", AGAIN, "mosa.evaluation.evaluate:rollouts", WARP),
    ("eval", other("eval", f"ckpt_path={CHECKPOINT}", f"cache={cache}"), "mosa.training.workflow:figures_of", HANDLE),
    ("eval", other("sim", f"ckpt_path={CHECKPOINT}", "simulate.height=0.1"), "mosa.twin.twin:Twin.simulate", MODULE),
    ("eval", other("device", f"ckpt_path={CHECKPOINT}"), "mosa.system.limits:torch.empty", TORCH),
    ("splats", other("splats", f"ply={folder}/none.ply"), "mosa.splats.objects:check_splats", ALLOC),
    ("capture", other("capture", f"videos={folder}", f"poses={folder}", f"output={folder}/o"),
     "mosa.capture.making:CaptureSettings.read",
     WARP),
    ("environments", other("environments", "task=placement"), "mosa.environments.command:named_device", TORCH),
    ("view", [f"run={folder}"], "mosa.viewer.recorded:opened", HANDLE),
    ("experiment", ["table_time"], "mosa.cli.experiment:run", MODULE),
]  # fmt: skip


def tried(command: str, words: list[str], place: str, error: Exception) -> None:
    module, _, path = place.partition(":")
    target = importlib.import_module(module)
    *above, name = path.split(".")
    for part in above:
        target = getattr(target, part)
    broken = (
        Later(target.training_step, error)
        if name == "training_step"
        else (lambda *_, **__: raised(error))
    )
    sys.argv = [command, *words]
    screen, code = io.StringIO(), None
    with patch.object(target, name, broken), contextlib.redirect_stderr(screen):
        try:
            importlib.import_module(f"mosa.cli.{command}").main()
        except SystemExit as ended:
            code = ended.code
        except Exception as escaped:  # a traceback, of a program that is not in a loop
            screen.write(f"Traceback: {type(escaped).__name__}: {escaped}")
    logging.getLogger().handlers.clear()
    said = screen.getvalue().strip().splitlines()[-1:]
    print("TRIED " + json.dumps([command, place, code, *said, CHECKPOINT.is_file()]), flush=True)


def raised(error: Exception):
    raise error


if __name__ == "__main__":
    with patch.object(machine_errors, "gpu_memory", lambda: (0.1e9, 150e9)):
        for one in PLACES:
            tried(*one)
