"""A job of train.py or eval.py from outside: its exit code, its one message, and what a sweep says about the jobs that failed.

Imported by every process of a sweep, whatever its launcher, through `hydra.callbacks`; it imports nothing heavy.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from mosa.commands import fail
from mosa.errors import MosaError

FAILED = "failed"
"""Folder in that of a sweep: one file for each job that ended in an error, named after its number, with the message."""
LONGEST = 120
"""Bytes of a job's folder name that its overrides may have: a file system takes 255 for the whole of it."""
DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.EIO, errno.ENOTDIR,
        errno.EISDIR}  # fmt: skip
"""What a disk or a folder's rights refuse, which is no mistake of the program."""


def folder_name(overrides: str) -> str:
    """A job's overrides as one folder's name: a long one is cut and ends in its digest, which keeps names apart."""
    name = overrides.replace("/", "_").replace("\0", "_")
    if len(name.encode()) <= LONGEST:
        return name
    return name.encode()[:LONGEST].decode(errors="ignore") + "_" + hashlib.sha256(overrides.encode()).hexdigest()[:8]


OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)


def check_arguments(arguments: Sequence[str], conf: Path) -> None:
    """Exit with 2 and a message for <group>=null, to which Hydra answers with a traceback; conf: the folder of the groups."""
    for argument in arguments:
        group, mark, value = argument.lstrip("+").partition("=")
        if mark and value in ("", "null", "Null", "NULL", "~") and "." not in group and group and (conf / group).is_dir():
            options = ", ".join(sorted(file.stem for file in (conf / group).glob("*.yaml")))
            print(f"\nConfigError: {group}: expected one of {options}, found {argument!r}", file=sys.stderr)
            sys.exit(2)


class Failures(Callback):
    """Counts a sweep's failed jobs, whichever process each ran in."""

    count = 0
    """Of the sweep that ended last in this process."""

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        shutil.rmtree(Path(config.hydra.sweep.dir) / FAILED, ignore_errors=True)  # of an earlier sweep in this folder
        Failures.count = 0

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        files = sorted((Path(config.hydra.sweep.dir) / FAILED).glob("*.txt"), key=lambda file: int(file.stem))
        Failures.count = len(files)
        if files:
            listed = "\n".join(f"  {file.stem}: {file.read_text().strip()}" for file in files)
            print(f"\n{len(files)} jobs of the sweep failed:\n{listed}", file=sys.stderr)


signals: list[int] = []
"""Received. Lightning turns what stops a fit into an exit of its own, which no longer says which one it was."""


def terminated(number: int, *_) -> None:
    """SIGTERM, as a batch system sends it before it kills, stops what Ctrl-C stops."""
    signals.append(number)
    raise KeyboardInterrupt


def disk_message(error: OSError) -> str | None:
    """One sentence on what the disk refused; None for any other error."""
    if error.errno not in DISK:
        return None
    return (f"{error.filename or 'a file'}: cannot be written or read ({error.strerror}); free space, or choose other folders with "
            "hydra.run.dir= and scene.cache= (eval.py: cache=)")


def gpu_message(error: RuntimeError) -> str | None:
    """One sentence where a GPU has no memory left, as torch and Warp say it; None for any other error."""
    said = str(error).splitlines()[0] if str(error) else ""
    if type(error).__name__ != "OutOfMemoryError" and not ("Failed to allocate" in said and "cuda" in said):
        return None
    return (f"the GPU has no memory left ({said[:200]}); stop what else runs there, lower simulation.particles or scene.scale, or "
            "take trainer=cpu (eval.py and others: device=cpu)")


def attempt(job: Callable[[DictConfig], float | None], cfg: DictConfig) -> float | None:
    """job(cfg) and its result. A mistake of the user ends in one message and exit code 2; in a sweep it is kept for the end, the
    result is infinite, and the other jobs go on. A stop ends in 130 (Ctrl-C) or 143 (SIGTERM)."""
    first = os.environ.get("LOCAL_RANK", "0") == "0"  # of the processes of a fit on several devices: it speaks for all
    if first and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, terminated)
    try:
        return job(cfg)
    except KeyboardInterrupt:
        if first:
            fail("stopped; resume with ckpt_path=<run folder>/checkpoints/last.ckpt, where the fit had begun")
        sys.exit(143 if signal.SIGTERM in signals else 130)
    except MosaError as error:
        message = f"{type(error).__name__}: {error}"
    except MemoryError as error:
        message = f"MemoryError: {error or 'the machine has no more'}; lower the sizes (simulation.particles, scene.scale)"
    except OSError as error:
        if (reason := disk_message(error)) is None:
            raise
        message = f"DataError: {reason}"
    except RuntimeError as error:
        if (reason := gpu_message(error)) is None:
            raise
        message = f"MemoryError: {reason}"
    fail(message)
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        sys.exit(2)
    keep(message)
    return float("inf")


def keep(message: str) -> None:
    """The message where the process that started the sweep finds it."""
    hydra = HydraConfig.get()
    folder = Path(hydra.sweep.dir) / FAILED
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{hydra.job.num}.txt").write_text(message + "\n")
    except OSError as error:  # a full disk: the sweep cannot say it at its end, so that it ends here
        raise SystemExit(f"\n{folder}: cannot be written ({error.strerror})") from error
