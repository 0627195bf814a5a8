"""Run the jobs of a table or figure of the paper and write its results:  mosa-experiment table_generalisation --quick"""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mosa.errors import ConfigError
from mosa.system.console import say_version
from mosa.system.machine_errors import one_message
from mosa.system.screen import tolerant_output
from mosa.system.threads import settle_threads
from mosa.system.whole_files import made_folder

if TYPE_CHECKING:
    from mosa.experiments.specification import Job

RESULTS = Path("docs/results")


OPTIONS: dict[str, dict[str, Any]] = {
    "--quick": {"action": "store_true", "help": "the small variant, minutes on two cores"},
    "--dry-run": {"action": "store_true", "help": "list the jobs with the estimated time, run nothing"},
    "--collect": {"action": "store_true", "help": "run nothing, write the results of complete jobs"},
    "--page": {"action": "store_true", "help": "write the page of all results beside their folder"},
    "--specifications": {"type": Path, "metavar": "FOLDER", "help": "experiments of one's own, in "
                         "place of the paper's (docs/reproduce.md)"},
    "--runs": {"type": Path, "default": Path("experiments"), "help": "folder of the jobs' folders"},
    "--results": {"type": Path, "help": "folder of the tables; default: docs/results, quick: RUNS/results"},
    "--jobs": {"type": int, "default": 1, "help": "jobs side by side, on each device"},
    "--devices": {"help": "GPUs by number, as 0,1; default: the CPU"},
    "--seeds": {"help": "instead of the experiment's, as 0,1,2"},
    "--only": {"action": "append", "metavar": "AXIS=NAME,NAME", "help": "these of an axis alone"},
    "--set": {"action": "append", "metavar": "KEY=VALUE", "dest": "overrides", "help": "override for "
              "every job, as train.py takes it"},
}  # fmt: skip


def arguments(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="mosa-experiment", description=__doc__)
    first = "experiments, in the order to run them, or all; none: list them"
    parser.add_argument("names", nargs="*", metavar="NAME", help=first)
    parser.set_defaults(only=[], overrides=[])
    for name, how in OPTIONS.items():
        parser.add_argument(name, **how)
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> None:
    say_version(words)
    settle_threads()
    # or the jobs would go on without anyone who waits for them
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tolerant_output():  # hours of jobs do not end with whoever read their lines
        try:
            with one_message():
                code = run(arguments(sys.argv[1:] if words is None else words))
        except KeyboardInterrupt:
            said = (
                "stopped; the same command goes on from here, and --collect writes what is complete"
            )
            print(f"\n{said}", file=sys.stderr)
            code = 130
    sys.exit(code)


def run(options: argparse.Namespace) -> int:
    """Exit code: 1 where jobs failed. Errors: ConfigError naming argument or file."""
    from mosa.experiments import specification as spec
    from mosa.experiments.specification import experiment_names, load_experiment

    folder = options.specifications or spec.SPECIFICATIONS
    if not folder.is_dir():
        raise ConfigError(f"--specifications: expected a folder of YAML files, found {folder}")
    if options.page and not options.names:
        print(write_the_page(folder, options))
        return 0
    if not options.names:
        for name in experiment_names(folder):
            print(f"{name:28s} {load_experiment(folder, name).title}")
        return 0
    devices = [None] if options.devices is None else whole_numbers("--devices", options.devices)
    if options.jobs < 1:
        raise ConfigError(f"--jobs: expected at least 1, found {options.jobs}")
    turns: dict[str, int] = {}
    for turn, word in enumerate(options.names):
        for name in experiment_names(folder) if word == "all" else [word]:
            turns.setdefault(name, turn)
    experiments = [load_experiment(folder, name, quick=options.quick) for name in turns]
    seeds = None if options.seeds is None else tuple(whole_numbers("--seeds", options.seeds))
    experiments = [
        spec.narrowed(e, spec.pairs(options.only, experiments), seeds) for e in experiments
    ]
    more = [*options.overrides, *(["trainer=gpu"] if devices != [None] else [])]
    planned = {e.name: spec.jobs_of(e, options.runs, more) for e in experiments}
    wanted: dict[Path, Job] = {}
    for name, found in planned.items():
        for job in found:
            wanted.setdefault(job.folder, replace(job, turn=turns[name]))
    jobs = list(wanted.values())
    check_overrides(options.overrides, list(jobs[0].overrides) if jobs else [])
    for line in spec.estimate(jobs, devices, options.jobs, options.overrides):
        print(line, flush=True)
    results = options.results or (options.runs / "results" if options.quick else RESULTS)
    if options.dry_run:
        return 0
    if options.collect:  # the tables of the others stay
        experiments = [e for e in experiments if any(job.finished for job in planned[e.name])]
        if not experiments:
            raise ConfigError(
                f"--collect: expected a complete job of {', '.join(planned)} in {options.runs}, found none; --runs names the folder"
            )
    made_folder(options.runs, "--runs")
    made_folder(results, "--results")
    command, failed = shown(options), {}
    if not options.collect:
        from mosa.experiments.running import run_jobs

        failed = run_jobs(jobs, devices, options.jobs)
    from mosa.experiments.report.writing import write_results

    for experiment in experiments:
        page = write_results(experiment, planned[experiment.name], results, command)
        taken = sum(spec.minutes_taken(job) or 0.0 for job in planned[experiment.name])
        print(f"{experiment.name}: {page}, {taken:.1f} minutes of jobs", flush=True)
    if options.page:
        print(write_the_page(folder, options))
    for where, reason in failed.items():
        print(f"failed: {where}: {reason}", file=sys.stderr)
    return 1 if failed else 0


def write_the_page(folder: Path, options: argparse.Namespace) -> Path:
    from mosa.experiments.report.page import write_page
    from mosa.experiments.specification import experiment_names

    return write_page(folder, experiment_names(folder), options.results or RESULTS)


def shown(options: argparse.Namespace) -> str:
    """The command as it stands in the results: without folders of this machine."""
    words = ["mosa-experiment", *options.names, *(["--quick"] if options.quick else [])]
    for name in ("seeds", "devices"):
        words += [f"--{name}", getattr(options, name)] if getattr(options, name) is not None else []
    words += ["--jobs", str(options.jobs)] if options.jobs != 1 else []
    words += [word for each in options.only for word in ("--only", each)]
    return shlex.join([*words, *(word for each in options.overrides for word in ("--set", each))])


def whole_numbers(where: str, text: str) -> list[int]:
    try:
        found = [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{where}: expected whole numbers as 0,1, found {text!r}") from None
    if len(set(found)) < len(found) or min(found) < 0 or max(found) >= 2**32:
        raise ConfigError(
            f"{where}: expected different whole numbers from 0 to 2^32 - 1, found {text!r}"
        )
    return found


def check_overrides(words: list[str], overrides: list[str]) -> None:
    """What --set says is known to train.py: each job would end in it, one after the other. overrides: of a job, with it.

    Errors: ConfigError."""
    for word in words:
        key = word.partition("=")[0].lstrip("+~")
        own = key.split(".")[0] == "hydra" and key != "hydra.searchpath"
        if "=" not in word or own or key in ("resume", "seed"):
            raise ConfigError(
                "--set: expected KEY=VALUE of train.py, without hydra's (but hydra.searchpath), resume and seed, "
                f"which are the jobs' own, found {word!r}"
            )
    if not words:
        return
    from mosa.config.build import plain
    from mosa.config.composition import compose
    from mosa.training.preflight import check_configuration

    try:
        values = plain(compose(*overrides))
    except ConfigError as error:
        raise ConfigError(f"--set: {error}") from error
    check_configuration(values)
