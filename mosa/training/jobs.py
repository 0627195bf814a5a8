"""A job of train.py or eval.py from outside: its exit code, its one message, and what a sweep says about the jobs that failed.

Imported by every process of a sweep, whatever its launcher, through `hydra.callbacks`; it imports nothing heavy.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import NoneType
from typing import NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from mosa.config.composition import configuration
from mosa.errors import ConfigError, MosaError
from mosa.settings import shown
from mosa.system.console import fail, say_version
from mosa.system.refused import explained, let_go
from mosa.system.screen import tolerant_output
from mosa.system.threads import settle_threads
from mosa.training.sweep_table import FAILED, text_of, write_table

log = logging.getLogger(__name__)

WRITTEN = (".json", ".log", ".md", ".npz", ".ply", ".png", ".mp4")
"""Endings of the files that a run writes into its folder."""
LONGEST = 120
"""Bytes of a job's folder name that its overrides may have: a file system takes 255 for the whole of it."""


def folder_name(overrides: str) -> str:
    """A job's overrides as one folder's name, of letters that overrides of Hydra take without
    quotes. A long one is cut and ends in its digest, which keeps names apart."""
    name = re.sub(r"[^\w.+-]", "_", overrides.replace("=", "-"))
    if len(name.encode()) <= LONGEST:
        return name
    return (
        name.encode()[:LONGEST].decode(errors="ignore")
        + "_"
        + hashlib.sha256(overrides.encode()).hexdigest()[:8]
    )


OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)


def own_groups(command: str, conf: Path | None = None) -> str:
    """The groups that conf/<command>.yaml chooses from, with their options: lines of --help."""
    conf = Path(configuration()) if conf is None else conf
    chosen = OmegaConf.load(conf / f"{command}.yaml").defaults
    names = sorted(name for each in chosen if not isinstance(each, str) for name in each)
    options = {n: sorted(f.stem for f in (conf / n).glob("*.yaml")) for n in names if n != "hydra"}
    return "\n".join(f"{name}: {', '.join(found)}" for name, found in options.items())


OmegaConf.register_new_resolver("own_groups", own_groups, replace=True)


def check_arguments(arguments: Sequence[str], conf: Path) -> None:
    """Exit with 2 and a message for what Hydra answers with a traceback, or with thousands of digits: a group (a folder in conf)
    that is given no name, and numbers that no float holds."""
    for argument in arguments:
        group, mark, value = argument.lstrip("+").partition("=")
        expected = None
        if re.search(r"\d{310}", value):
            expected = "numbers within 1e308"
        elif mark and "." not in group and group and (conf / group).is_dir() and unnamed(argument):
            expected = "one of " + ", ".join(sorted(f.stem for f in (conf / group).glob("*.yaml")))
        if expected is not None:
            print(
                f"\nConfigError: {group}: expected {expected}, found {shown(argument)}",
                file=sys.stderr,
            )
            sys.exit(2)


def unnamed(argument: str) -> bool:
    """Whether an override has a number, a flag, a mapping or nothing as its value."""
    try:
        value = OverridesParser.create().parse_override(argument).value()
    except HydraException:  # said by Hydra
        return False
    return value in ("", "~") or isinstance(value, (NoneType, int, float, dict))


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
    """Exit with 2 and a message for a run folder that cannot be made, or a working one that is gone, to which Hydra answers with a
    traceback."""
    try:
        os.getcwd()
    except OSError:
        print(
            "\nConfigError: the folder that this was started in is no more; change to another one",
            file=sys.stderr,
        )
        sys.exit(2)
    for argument in arguments:
        key, _, value = argument.partition("=")
        if (
            key == "hydra.sweep.subdir"
            and "$" not in value
            and {"-m", "--multirun"} & set(arguments)
        ):
            print(f"\nConfigError: {key}: expected a name that is another one for each job, as ${{hydra.job.num}} is: {value}: "
                  "each would take the place of the one before", file=sys.stderr)  # fmt: skip
            sys.exit(2)
        if key not in ("hydra.run.dir", "hydra.sweep.dir") or "$" in value:
            continue
        if not value.strip("'\" "):
            print(
                f"\nConfigError: {key}: expected a folder, found nothing; . is the one that this was started in",
                file=sys.stderr,
            )
            sys.exit(2)
        place = Path(value.strip("'\"")).absolute()
        there = next(folder for folder in (place, *place.parents) if os.path.lexists(folder))
        if reason := no_place(there, there != place):
            print(
                f"\nConfigError: {key}: expected a folder that can be made, found {value}: {there}: {reason}",
                file=sys.stderr,
            )
            sys.exit(2)
        if key == "hydra.run.dir" and (foreign := no_file_of_a_run(place)) is not None:
            print(f"\nConfigError: {key}: {foreign}: expected what a run has there, a file (of checkpoints and .hydra: a folder), "
                  "found something else (a folder, a pipe, a device, a link to nothing); remove it", file=sys.stderr)  # fmt: skip
            sys.exit(2)


def no_place(folder: Path, new: bool) -> str | None:
    """Why a run's files cannot be in a folder, or, new, a folder in it; None where they can."""
    if not folder.is_dir():
        return "it is none"
    if not os.access(folder, os.W_OK):
        return "it cannot be written to"
    try:
        if new:  # some file systems let nothing be made, whatever the rights say
            os.rmdir(tempfile.mkdtemp(dir=folder))
    except OSError as error:
        return f"nothing can be made in it ({error.strerror})"
    return None


def no_file_of_a_run(folder: Path) -> Path | None:
    """What has the name of a run's file and is none: a pipe would be waited for, a folder ends the run when it is written."""
    found = [path for path in folder.glob("*") if path.suffix in WRITTEN and not path.is_file()]
    found += [path for path in folder.glob("checkpoints/*.ckpt") if not path.is_file()]
    found += [
        path
        for name in ("checkpoints", ".hydra")
        if os.path.lexists(path := folder / name) and not path.is_dir()
    ]
    return min(found, default=None)


def check_files(arguments: Sequence[str], conf: Path) -> None:
    """Exit with 2 and a message for a YAML file among the arguments that cannot be read, to which Hydra answers with a traceback: a
    tab, a key that stands twice, another encoding. conf: the folder of the groups; --config-dir adds one."""
    folders, named = [conf], []
    for word, following in zip(arguments, [*arguments[1:], ""]):
        flag, mark, value = word.partition("=")
        if flag in ("--config-dir", "-cd"):
            folders.append(Path(value if mark else following))
        elif flag in ("--config-name", "-cn"):
            named.append((value if mark else following).removesuffix(".yaml"))
        elif mark and not flag.startswith("-"):
            group = flag.lstrip("+").partition("@")[0]
            named += [
                f"{group}/{each.strip()}"
                for each in value.strip("'\"[]").removesuffix(".yaml").split(",")
            ]
    for file in (
        folder / f"{name}.yaml"
        for folder in folders
        for name in named
        if "\0" not in name and len(name) < LONGEST
    ):
        try:
            if file.is_file():
                OmegaConf.load(file)
        except (YAMLError, UnicodeDecodeError, OSError) as error:
            reason = " ".join(str(error).split())[:300]
            print(
                f"\nConfigError: {file}: expected YAML, found what cannot be read ({reason})",
                file=sys.stderr,
            )
            sys.exit(2)


def run_command(run: Callable[[], None], conf: str | Path) -> None:
    """Run Hydra's `run` with what stands on the command line; conf: the folder of its groups.

    Exit code 2 too for what Hydra refuses before any job begins: a mistake of the user like all others."""
    say_version()
    settle_threads()
    sys.argv[1:] = map(quoted, sys.argv[1:])
    with tolerant_output():
        check_arguments(sys.argv[1:], Path(conf))
        check_folders(sys.argv[1:])
        check_files(sys.argv[1:], Path(conf))
        try:
            run()
        except SystemExit as ended:
            if ended.code == 1 and not begun:
                print(
                    "`+` adds parameters of laws and options of adapters alone; all keys: "
                    "python -m mosa.config.reference <command> [KEY]",
                    file=sys.stderr,
                )
                sys.exit(2)
            raise
        except KeyboardInterrupt:  # between jobs, or before the first
            leave("stopped", 130)


begun: list[bool] = []
"""Whether this process has begun a job or a sweep."""


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
        files = sorted(
            (Path(config.hydra.sweep.dir) / FAILED).glob("*.txt"), key=lambda file: int(file.stem)
        )
        Failures.count = len(files)
        summarize(config.hydra.sweep.dir)
        if files:
            listed = "\n".join(f"  {file.stem}: {file.read_text().strip()}" for file in files)
            print(f"\n{len(files)} jobs of the sweep failed:\n{listed}", file=sys.stderr)


def summarize(folder: str | Path) -> None:
    """The table of a sweep's runs on the screen and in its folder; of other commands there is none."""
    if not any(Path(folder).glob("*/metrics.json")):
        return
    try:
        rows, files = write_table(folder)
    except (MosaError, OSError) as error:
        print(f"no table of this sweep: {error}", file=sys.stderr)
        return
    print(f"\n{text_of(rows)}\n\nall figures: {', '.join(map(str, files))}")


signals: list[int] = []
"""Received. Lightning turns what stops a fit into an exit of its own, which no longer says which one it was."""


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
                    f"hydra.run.dir: another process is at work in {folder}; wait until it has ended, or give this "
                    "run a folder of its own"
                ) from None
            log.info(
                "another process is at work in %s: waiting until it has ended (resume=auto)", folder
            )
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


def attempt(job: Callable[[DictConfig], float | None], cfg: DictConfig) -> float | None:
    """job(cfg) and its result. A mistake of the user ends in one message and exit code 2; in a sweep it is kept for the end, the
    result is infinite, and the other jobs go on. A stop ends in 130 (Ctrl-C) or 143 (SIGTERM)."""
    with tolerant_output():  # also in a launcher's worker, and for the message
        return attempted(job, cfg)


def attempted(job: Callable[[DictConfig], float | None], cfg: DictConfig) -> float | None:
    begun.append(True)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, terminated)
    if HydraConfig.initialized():
        folder = OmegaConf.select(HydraConfig.get(), "runtime.output_dir")
    else:
        folder = None
    try:
        with (
            held(folder, wait=(cfg or {}).get("resume") == "auto")
            if folder is not None
            else nullcontext()
        ):
            return job(cfg)
    except KeyboardInterrupt:
        where = folder or "<run folder>"
        resume = (
            f"stopped; resume with ckpt_path={where}/checkpoints/last.ckpt, where the fit had begun"
        )
        leave(resume, 143 if signal.SIGTERM in signals else 130)
    except MosaError as error:
        message = f"{type(error).__name__}: {error}"
    except Exception as error:
        if (message := explained(error, folder)) is None:
            raise
    fail(message)
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        sys.exit(2)
    keep(message)
    let_go()
    return float("inf")


def keep(message: str) -> None:
    """The message where the process that started the sweep finds it."""
    hydra = HydraConfig.get()
    folder = Path(hydra.sweep.dir) / FAILED
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{hydra.job.num}.txt").write_text(message + "\n")
    except (
        OSError
    ) as error:  # a full disk: the sweep cannot say it at its end, so that it ends here
        raise SystemExit(f"\n{folder}: cannot be written ({error.strerror})") from error
