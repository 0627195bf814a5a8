"""A job of train.py or eval.py from outside: its exit code, its one message, and what a sweep says about the jobs that failed.

Imported by every process of a sweep, whatever its launcher, through `hydra.callbacks`; it imports nothing heavy."""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import re
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from mosa.config.composition import configuration, said_of
from mosa.errors import ConfigError, MosaError
from mosa.system.console import fail, say_version
from mosa.system.machine_errors import explained, free_gpu_cache
from mosa.system.screen import tolerant_output
from mosa.system.threads import settle_threads
from mosa.training.sweep_table import FAILED, text_of, write_table

log = logging.getLogger(__name__)

LONGEST = 120  # bytes of a job's folder name from its overrides; a file system takes 255


def folder_name(overrides: str) -> str:
    """A job's overrides as one folder's name, of letters that overrides of Hydra take without
    quotes. A long one is cut and ends in its digest, which keeps names apart."""
    name = re.sub(r"[^\w.+-]", "_", overrides.replace("=", "-"))
    if len(name.encode()) <= LONGEST:
        return name
    digest = hashlib.sha256(overrides.encode()).hexdigest()[:8]
    return f"{name.encode()[:LONGEST].decode(errors='ignore')}_{digest}"


OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)


def own_groups(command: str) -> str:
    """The groups that conf/<command>.yaml chooses from, with their options: lines of --help."""
    conf = Path(configuration())
    chosen = OmegaConf.load(conf / f"{command}.yaml").defaults
    names = sorted(name for each in chosen if not isinstance(each, str) for name in each)
    options = {n: sorted(f.stem for f in (conf / n).glob("*.yaml")) for n in names if n != "hydra"}
    return "\n".join(f"{name}: {', '.join(found)}" for name, found in options.items())


OmegaConf.register_new_resolver("own_groups", own_groups, replace=True)


WITH_VALUE = "--config-dir -cd --config-path -cp --config-name -cn --package -p".split()
"""Options of Hydra whose next word is no override."""


def options_first(words: Sequence[str]) -> list[str]:
    """A command line whose overrides stand together at its end: argparse, by which Hydra reads it, refuses those after an option
    where others stand before."""

    def is_override(place: int) -> bool:
        word, before = words[place], words[place - 1] if place else ""
        looks = "=" in word or word[:1] in ("", "~")  # "": a script's empty variable
        return looks and not word.startswith("-") and before not in WITH_VALUE

    return [words[k] for k in sorted(range(len(words)), key=is_override)]


def quoted(argument: str) -> str:
    """An override as Hydra's grammar reads it: a value with letters beyond ASCII, or ~, &, = and the like, as paths have them, gets
    quotes. As it is where it can be read, and where it has a list, quotes or an escape, unless it begins as a path does."""
    key, mark, value = argument.partition("=")
    path = value.startswith(("/", "./", "../", "~/")) and "\\" not in value
    if not mark or argument.startswith("-") or (set(value) & set(",[]{}'\"\\") and not path):
        return argument
    try:
        OverridesParser.create().parse_overrides([argument])
    except HydraException:
        return f"{key}='{value.replace(chr(39), chr(92) + chr(39))}'"
    return argument


def check_folders(arguments: Sequence[str]) -> None:
    """Errors: ConfigError where runs would lie among other files, or those of a sweep in one folder."""
    try:
        os.getcwd()
    except OSError as error:
        raise ConfigError("the folder that this was started in is no more") from error
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key in ("hydra.run.dir", "hydra.sweep.dir") and not value.strip("'\" "):
            raise ConfigError(f"{key}: expected a folder, found nothing; . is the current one")
        many = {"-m", "--multirun"} & set(arguments)
        if key == "hydra.sweep.subdir" and many and "$" not in value:
            raise ConfigError(
                f"{key}: expected a name that is another one for each job, as ${{hydra.job.num}} "
                f"is, found {value}"
            )


def run_command(run: Callable[[], None]) -> None:
    """Run Hydra's `run` with what stands on the command line. What goes wrong before any job begins is a mistake of the user like
    all others: one message and exit code 2."""
    say_version()
    settle_threads()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach this function
    with tolerant_output():
        try:
            sys.argv[1:] = map(quoted, options_first(sys.argv[1:]))
            check_folders(sys.argv[1:])
            run()
        except KeyboardInterrupt:  # between jobs, or before the first
            leave("stopped", 130)
        except Exception as error:
            if (message := explained(error)) is None:
                if begun and not isinstance(error, HydraException):
                    raise
                given = sys.argv[1:]
                message = f"ConfigError: {said_of(error, given)}\n(in: {' '.join(given)[:300]})\n"
                message += "a decimal is written with a point" if "Ambiguous" in message else (
                    "`+` adds keys that no file of conf/ has, as a law's parameters; all keys: "
                    "python -m mosa.config.reference <command> [KEY]"
                )  # fmt: skip
            print(f"\n{message}", file=sys.stderr)
            sys.exit(2)


begun: list[bool] = []  # whether this process has begun a job or a sweep


class Failures(Callback):
    """Counts a sweep's failed jobs, whichever process each ran in."""

    count = 0
    """Of the sweep that ended last in this process."""

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        # of an earlier sweep in this folder
        shutil.rmtree(Path(config.hydra.sweep.dir) / FAILED, ignore_errors=True)
        Failures.count = 0
        begun.append(True)

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        failed = (Path(config.hydra.sweep.dir) / FAILED).glob("*.txt")
        files = sorted(failed, key=lambda file: int(file.stem))
        Failures.count = len(files)
        summarize(config.hydra.sweep.dir)
        if files:
            listed = "\n".join(f"  {file.stem}: {file.read_text().strip()}" for file in files)
            print(f"\n{len(files)} jobs of the sweep failed:\n{listed}", file=sys.stderr)


def summarize(folder: str | Path) -> None:
    """The table of a sweep's runs on the screen and in its folder; of other commands there is none."""
    if not any(any(Path(folder).glob(each)) for each in ("*/metrics.json", f"{FAILED}/*.txt")):
        return
    try:
        rows, files = write_table(folder)
    except (MosaError, OSError) as error:
        print(f"no table of this sweep: {error}", file=sys.stderr)
        return
    print(f"\n{text_of(rows)}\n\nall figures: {', '.join(map(str, files))}")


signals: list[int] = []  # received; Lightning's own exit does not say which


def terminated(number: int, *_) -> None:
    """SIGTERM, as a batch system sends it before it kills, stops what Ctrl-C stops."""
    signals.append(number)
    raise KeyboardInterrupt


def leave(message: str | None, code: int) -> NoReturn:
    """Say that the process was stopped and end it. A further stop ends it at once: an exception amid the interpreter's own exit was
    a traceback."""
    answered = [number for number in (signal.SIGINT, signal.SIGTERM)
                if threading.current_thread() is threading.main_thread() and callable(signal.getsignal(number))]  # fmt: skip
    for number in answered:
        signal.signal(number, signal.SIG_IGN)
    if message is not None:
        fail(message)
    for number in answered:
        signal.signal(number, signal.SIG_DFL)
    sys.exit(code)


@contextmanager
def held(folder: str | Path, wait: bool = False) -> Iterator[None]:
    """A run's folder as this process's own. The system's lock on it ends with the process, however that ends, and leaves no file.

    wait: until the process that has it has ended, as a worker that outlives the sweep that launched it. Errors: without it,
    ConfigError where another process has it."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except OSError:  # said where the folder is written to
        yield
        return
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                raise ConfigError(
                    f"hydra.run.dir: another process is at work in {folder}; wait, or give this "
                    "run another folder"
                ) from None
            log.info("another process is at work in %s: waiting (resume=auto)", folder)
            fcntl.flock(number, fcntl.LOCK_EX)
        except OSError:  # a file system that knows no locks
            pass
        yield
    finally:
        os.close(number)


@contextmanager
def held_back() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until this is over, a second one does not: an exception amid the imports of some libraries aborts
    the interpreter."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def wait(number: int, frame) -> None:
        waiting.append(number)
        if len(waiting) > 1:
            before[number](number, frame)

    # not what is ignored, or ends at once
    replaced = {number: handler for number, handler in before.items() if callable(handler)}
    for number in replaced:
        signal.signal(number, wait)
    try:
        yield
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)
    if waiting:
        before[waiting[0]](waiting[0], None)


@tolerant_output()  # also in a launcher's worker, and for the message
def attempt(job: Callable[[DictConfig], float | None], cfg: DictConfig) -> float | None:
    """job(cfg) and its result. A mistake of the user ends in one message and exit code 2. In a sweep every error is kept for the
    end, the result is infinite, and the other jobs go on. A stop ends in 130 (Ctrl-C) or 143 (SIGTERM)."""
    begun.append(True)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, terminated)
    hydra = HydraConfig.get() if HydraConfig.initialized() else OmegaConf.create()
    folder = OmegaConf.select(hydra, "runtime.output_dir")
    try:
        with held(folder, (cfg or {}).get("resume") == "auto") if folder else nullcontext():
            return job(cfg)
    except KeyboardInterrupt:
        last = Path(folder or ".", "checkpoints", "last.ckpt")
        again = f"ckpt_path={last}"
        # a checkpoint would begin every job of a sweep
        if OmegaConf.select(hydra, "mode") == RunMode.MULTIRUN:
            again = f"resume=auto hydra.sweep.dir={hydra.sweep.dir}"
        message = "stopped" + f"; resume with {again}" * last.is_file()
        leave(message, 143 if signal.SIGTERM in signals else 130)
    except MosaError as error:
        message = f"{type(error).__name__}: {error}"
    except Exception as error:
        if (message := explained(error, folder)) is None:
            if HydraConfig.get().mode != RunMode.MULTIRUN:
                raise
            traceback.print_exc()  # a mistake of a program costs a sweep its job alone
            message = f"{type(error).__name__}: {error}"
    fail(message)
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        sys.exit(2)
    keep(message)
    free_gpu_cache()
    return float("inf")


def keep(message: str) -> None:
    """The message where the process that started the sweep finds it."""
    hydra = HydraConfig.get()
    folder = Path(hydra.sweep.dir) / FAILED
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{hydra.job.num}.txt").write_text(message + "\n")
    except OSError as error:  # a full disk: the sweep cannot say it at its end
        raise SystemExit(f"\n{folder}: cannot be written ({error.strerror})") from error
