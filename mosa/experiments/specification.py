"""What an experiment is: axes of overrides whose combinations are jobs of train.py, and how their figures become a table."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from mosa.errors import ConfigError, DataError
from mosa.settings import call
from mosa.training.sweep_table import seconds

SPECIFICATIONS = Path(__file__).with_name("specifications")  # files of all experiments
SHARED = "_shared"  # file of axes that several experiments name
MINUTES = "minutes.txt"  # file of a job's folder with the wall time of its process
COMMIT = "commit.txt"  # commit that a job's run was last begun with
FAILED = "failed.txt"  # file of a job's folder with the reason why its run failed
PRESSED = "pressed.json"  # file of a job's folder with what `specimens` has measured of its laws

Analysis = Literal["long_term", "directions", "heterogeneity", "compression", "parameters"]
"""The keys of `analyses.ANALYSES`, which imports more than a specification needs."""


@dataclass(frozen=True)
class Option:
    """A place on an axis. overrides: of train.py; prefix: of the figures to read (`prior/`: the calibrated prior of the same run);
    cost: of a job over the experiment's minutes, where it differs {cpu: , gpu: }; value: of a numeric axis."""

    name: str
    overrides: tuple[str, ...] = ()
    prefix: str = ""
    cost: float | Mapping[str, float] = 1.0
    value: float | None = None

    def cost_on(self, device: str) -> float:
        """device: cpu | gpu."""
        if isinstance(self.cost, Mapping):
            return float(self.cost.get(device, 1.0))
        return float(self.cost)


@dataclass(frozen=True)
class Figure:
    """A figure of metrics.json in a table. scale: from its unit to the one shown; best: most | least | None; decimals."""

    label: str
    figure: str
    scale: float = 1.0
    decimals: int = 2
    best: str | None = None


@dataclass(frozen=True)
class Claim:
    """What the paper or an issue says of a figure (by its label), for the page of results. Either row is ahead of `against`: in one
    column, with `each` in every one of them, else in the mean over those that both have; of one seed by more than `spread`. Or
    every row, or every one that `most` names, is at most that; there `unless` names the figure with the posterior's standard
    deviation, which excuses what it covers twice."""

    text: str
    figure: str
    row: str | None = None
    against: tuple[str, ...] = ()
    column: str | None = None
    each: bool = False
    spread: float = 0.0
    most: float | Mapping[str, float] | None = None
    unless: str | None = None

    def limit(self, row: str) -> float | None:
        """What the figure of a row is at most; None where the claim says nothing of it."""
        return self.most.get(row) if isinstance(self.most, Mapping) else self.most


@dataclass(frozen=True)
class Experiment:
    """rows, columns: axes of the table (every other one but the seed is a table of its own); printed: entry of printed.yaml; note:
    how the data differ from the paper's; minutes: of a job that runs alone, on cpu and gpu; analysis: a function of `analyses`, or
    None; alone: its jobs have runs of their own, each with nothing beside it on its device; claims: for the page."""

    name: str
    title: str
    axes: dict[str, tuple[Option, ...]]
    rows: str
    columns: str
    figures: tuple[Figure, ...]
    seeds: tuple[int, ...] = (0,)
    common: tuple[str, ...] = ()
    printed: str | None = None
    note: str = ""
    minutes: dict[str, float] = field(default_factory=lambda: {"cpu": 10.0, "gpu": 2.0})
    plot: Literal["bars", "lines", "map"] | None = "bars"
    analysis: Analysis | None = None
    mean: bool = True
    alone: bool = False
    claims: tuple[Claim, ...] = ()
    quick: bool = False


@dataclass(frozen=True)
class Job:
    """One run of train.py. places: option by axis, of each cell that reads it; film: what it shares its films with; first: a
    reconstruction; alone: with nothing beside it on its device; turn: those with a lower one begin before it."""

    folder: Path
    overrides: tuple[str, ...]
    seed: int
    places: tuple[dict[str, Option], ...]
    minutes: dict[str, float]
    film: str
    first: str
    alone: bool = False
    turn: int = 0

    @property
    def finished(self) -> bool:
        return (self.folder / "metrics.json").is_file()

    @property
    def failed(self) -> str | None:
        """Why it failed when it was last run; None where it is complete, or was not run."""
        said = self.folder / FAILED
        if self.finished or not said.is_file():
            return None
        return said.read_text(errors="replace").strip()


def experiment_names(folder: Path) -> list[str]:
    return sorted(file.stem for file in folder.glob("*.yaml") if not file.stem.startswith("_"))


def read_yaml(path: Path) -> dict[str, Any]:
    """Errors: ConfigError naming the file."""
    try:
        found = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: no readable YAML ({error})") from error
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: expected keys, found {type(found).__name__}")
    return found


def shared_axes(folder: Path) -> dict[str, Any]:
    """Axes by name: those of the package, and of a folder's own file. Errors: ConfigError."""
    found: dict[str, Any] = {}
    for file in dict.fromkeys(each / f"{SHARED}.yaml" for each in (SPECIFICATIONS, folder)):
        found |= read_yaml(file) if file.is_file() else {}
    return found


def load_experiment(folder: Path, name: str, quick: bool = False) -> Experiment:
    """folder/<name>.yaml; quick: with its section `quick` in place of other keys. Errors: ConfigError naming the key."""
    if name not in experiment_names(folder):
        known = ", ".join(experiment_names(folder))
        raise ConfigError(f"experiment: expected one of {known} or all, found {name!r}")
    keys, shared = read_yaml(folder / f"{name}.yaml"), shared_axes(folder)
    small = keys.pop("quick", None)
    if quick:
        if not small:
            raise ConfigError(f"{name}: expected a section quick, found none")
        keys |= small
    for key in ("axes", "figures"):
        if key not in keys:
            raise ConfigError(f"{name}.{key}: expected this key, found none")
    kinds = {"seeds": int, "common": str, "figures": Mapping, "claims": Mapping}
    for key in kinds.keys() & keys.keys():
        check_list(f"{name}.{key}", keys[key], kinds[key])
    if not isinstance(keys["axes"], Mapping):
        raise ConfigError(f"{name}.axes: expected a section, found {str(keys['axes'])[:80]}")
    minutes = keys.get("minutes", {"cpu": 0, "gpu": 0})
    if not isinstance(minutes, Mapping) or not {"cpu", "gpu"} <= minutes.keys():
        raise ConfigError(f"{name}.minutes: expected keys cpu and gpu, found {str(minutes)[:80]}")
    axes, claims = keys["axes"].items(), enumerate(keys.get("claims", ()))
    keys["axes"] = {axis: options_of(f"{name}: axes.{axis}", each, shared) for axis, each in axes}
    keys["figures"] = figures = tuple(call(f"{name}.figures", Figure, f) for f in keys["figures"])
    keys["claims"] = tuple(claim_of(f"{name}: claims[{i}]", each, figures) for i, each in claims)
    keys |= {key: tuple(keys[key]) for key in ("seeds", "common") if key in keys}
    found = call(name, Experiment, keys, name=name, quick=quick)
    for place in (found.rows, found.columns):
        if place not in found.axes:
            known = ", ".join(found.axes)
            raise ConfigError(f"{name}: rows, columns: expected two of {known}, found {place!r}")
    return found


def check_list(where: str, found: Any, kind: type) -> None:
    """Errors: ConfigError where it is no list of these: a text would be one of letters."""
    if not isinstance(found, (list, tuple)) or not all(isinstance(each, kind) for each in found):
        said = {int: "whole numbers", str: "texts", Mapping: "sections"}[kind]
        raise ConfigError(f"{where}: expected a list of {said}, found {str(found)[:80]!r}")


def claim_of(where: str, found: Any, figures: Sequence[Figure]) -> Claim:
    """Errors: ConfigError naming the key."""
    check_list(f"{where}.against", found.get("against", ()), str)
    claim = call(where, Claim, {**found, "against": tuple(found.get("against", ()))})
    labels = [figure.label for figure in figures]
    for key in ("figure", "unless"):
        if (label := getattr(claim, key)) is not None and label not in labels:
            raise ConfigError(
                f"{where}.{key}: expected one of {', '.join(labels)}, found {label!r}"
            )
    if (claim.most is None) == (claim.row is None) or (claim.row is not None and not claim.against):
        raise ConfigError(f"{where}: expected row with against, or most")
    return claim


def options_of(where: str, found: Any, shared: Mapping[str, Any]) -> tuple[Option, ...]:
    """The options of an axis: a mapping of name to overrides (a list, or a section with the fields of `Option`), the name of a
    shared axis, or {of: <shared axis>, only: [names]}."""
    only = None
    if isinstance(found, Mapping) and set(found) <= {"of", "only"} and "of" in found:
        found, only = found["of"], found.get("only")
    if isinstance(found, str):
        if found not in shared:
            raise ConfigError(f"{where}: expected one of {', '.join(shared)}, found {found!r}")
        found = shared[found]
    if not isinstance(found, Mapping):
        raise ConfigError(f"{where}: expected a section of options, found {found!r}")
    options = []
    for name, content in found.items():
        keys = dict(content) if isinstance(content, Mapping) else {"overrides": content}
        check_list(f"{where}.{name}", keys.get("overrides") or (), str)
        keys["overrides"] = tuple(keys.get("overrides") or ())
        options.append(call(f"{where}.{name}", Option, keys, name=str(name)))
    return chosen(where, options, only)


def chosen(where: str, options: Sequence[Option], only: Sequence[str] | None) -> tuple[Option, ...]:
    """Those that are named, in the order they are named. Errors: ConfigError naming the axis."""
    if only is None:
        return tuple(options)
    known = {option.name: option for option in options}
    if unknown := [name for name in only if str(name) not in known]:
        raise ConfigError(f"{where}: expected some of {', '.join(known)}, found {unknown[0]!r}")
    return tuple(known[str(name)] for name in only)


def pairs(words: Sequence[str], experiments: Sequence[Experiment]) -> dict[str, list[str]]:
    """{axis: names} of words AXIS=NAME,NAME. Errors: ConfigError."""
    axes = dict.fromkeys(axis for each in experiments for axis in each.axes)
    found = {}
    for word in words:
        axis, mark, names = word.partition("=")
        if not mark or axis not in axes:
            known = ", ".join(axes)
            raise ConfigError(
                f"--only: expected AXIS=NAME,NAME with an axis of {known}, found {word!r}"
            )
        found[axis] = names.split(",")
    return found


def narrowed(
    experiment: Experiment, only: Mapping[str, Sequence[str]], seeds: tuple[int, ...] | None
) -> Experiment:
    """With these options (of `pairs`) and seeds alone."""
    every = experiment.axes.items()
    axes = {axis: chosen(f"--only {axis}", options, only.get(axis)) for axis, options in every}
    return replace(experiment, axes=axes, seeds=experiment.seeds if seeds is None else seeds)


def jobs_of(experiment: Experiment, runs: Path, more: Sequence[str] = ()) -> list[Job]:
    """The jobs of all combinations of options and seeds, each once: cells that need the same run share it.

    A run's folder is named after its overrides, so that other experiments share it too."""
    for axis, each in experiment.axes.items():
        told = {w.partition("=")[0] for option in each for w in option.overrides}
        for key, _, value in (word.lstrip("+").partition("=") for word in more):
            # a mapping sets the keys below it too
            if key in told or any(k.startswith(f"{key}.") and value.startswith("{") for k in told):
                raise ConfigError(
                    f"--set {key}: expected a key that no option of an axis sets, found one of {axis}, whose rows would not be "
                    "what they are called: --only chooses some of them, --specifications adds one (docs/reproduce.md)"
                )
    found: dict[Path, Job] = {}
    for options in itertools.product(*experiment.axes.values()):
        place = dict(zip(experiment.axes, options))
        check_apart(place)
        own = [each for option in options for each in option.overrides]
        for seed in experiment.seeds:
            overrides = (*experiment.common, *own, *more, f"seed={seed}")
            folder = runs / (ALONE * experiment.alone + folder_name(overrides))
            known = found.get(folder)
            if known is not None:
                found[folder] = replace(known, places=(*known.places, place))
                continue
            parts = {each: each.split("=")[0].split(".") for each in overrides}
            uses = ("scene", "experiment")
            film = [each for each, key in parts.items() if key[0] in uses and key[1:] not in USES]
            rest = [each for each, key in parts.items() if each not in film and key[0] in SHARED_BY]
            shared = " ".join(film), " ".join([*film, *rest])
            costs = {d: math.prod(o.cost_on(d) for o in options) for d in experiment.minutes}
            minutes = {d: value * costs[d] for d, value in experiment.minutes.items()}
            alone = experiment.alone
            found[folder] = Job(folder, overrides, seed, (place,), minutes, *shared, alone)
    return list(found.values())


def check_apart(place: Mapping[str, Option]) -> None:
    """Errors: ConfigError where two axes give one key different values, of which only the last would count."""
    settled: dict[str, tuple[str, str]] = {}
    for axis, option in place.items():
        for key, _, value in (each.partition("=") for each in option.overrides):
            other, given = settled.setdefault(key, (axis, value))
            if other != axis and given != value:
                raise ConfigError(
                    f"axes: expected one value of {key}, found {given} on {other} and {value} on {axis}: leave it out of one "
                    "axis, as in {rabbit: [scene=rabbit]} in place of {of: objects}"
                )


USES = (["holdout_frames"], ["holdout_cameras"], ["also_train"])  # keys of use, no film
SHARED_BY = ("scene", "reconstruction", "seed", "simulation")  # what a reconstruction needs
ALONE = "alone-"  # before the folder's name of a run that had its device to itself
QUIET = "hydra.searchpath logger evaluation.video evaluation.assignment evaluation.floor".split()
"""Overrides that the name of a folder leaves to its digest."""


def folder_name(overrides: Sequence[str]) -> str:
    """Values of the overrides, and a digest of all of them, whatever the order of different keys is."""
    ordered = sorted(overrides, key=lambda each: each.split("=")[0])
    said = [each.split("=", 1)[-1] for each in ordered if each.split("=")[0] not in QUIET]
    readable = "-".join("".join(c if c.isalnum() else "_" for c in value) for value in said)
    return f"{readable[:80]}-{hashlib.sha256(chr(10).join(ordered).encode()).hexdigest()[:10]}"


def figures_of(job: Job) -> dict[str, float | str]:
    """metrics.json of a complete job. Errors: DataError for a damaged one."""
    # which imports the simulator: a list of jobs does not wait for it
    from mosa.training.run_folder import read_figures

    return read_figures(job.folder / "metrics.json")


def minutes_taken(job: Job) -> float | None:
    """Wall time of a complete job [min], without its start where that was not measured; None where it is not complete."""
    if not job.finished:
        return None
    measured = job.folder / MINUTES
    if measured.is_file():
        try:
            return float(measured.read_text())
        except ValueError:  # killed while it was written
            pass
    return seconds(figures_of(job)) / 60


def commit_of(job: Job) -> str | None:
    """Which state of the program made a complete job; None where that was not written."""
    said = job.folder / COMMIT
    return said.read_text(errors="replace").strip() if job.finished and said.is_file() else None


def in_turn(jobs: Sequence[Job], devices: Sequence[int | None]) -> list[Job]:
    """In the order in which they run: that of their turns, of one turn the longest first, so that none of them is waited for in the
    end; then what runs alone."""
    device = device_kind(devices)
    return sorted(jobs, key=lambda job: (job.alone, job.turn, -job.minutes[device]))


def device_kind(devices: Sequence[int | None]) -> str:
    """cpu | gpu."""
    return "cpu" if list(devices) == [None] else "gpu"


def pace(jobs: Sequence[Job], device: str) -> float | None:
    """Measured time of the complete jobs over their minutes in the experiments' files; None where none is complete."""
    complete = [(minutes_taken(job) or 0.0, job.minutes[device]) for job in jobs if job.finished]
    planned = sum(minutes for _, minutes in complete)
    return sum(taken for taken, _ in complete) / planned if planned else None


def minutes_left(left: Sequence[float], slots: int) -> float:
    """Until jobs of these minutes are complete, which share all places evenly."""
    return max(sum(left) / slots, max(left, default=0.0))


def estimate(
    jobs: Sequence[Job], devices: Sequence[int | None], side_by_side: int, more: Sequence[str] = ()
) -> list[str]:
    """A line for each job, in the order in which they run, and one for all of them with the minutes until they are complete: those
    of the experiments' files times the `pace` of the complete jobs. more: overrides of --set, with which the files' minutes say
    nothing before a job is complete."""
    device, slots = device_kind(devices), len(devices) * side_by_side
    measured = pace(jobs, device)
    lines, left = [], []
    for job in in_turn(jobs, devices):
        taken = minutes_taken(job)
        if taken is None:
            left.append(job.minutes[device] * (measured or 1.0))
            state = f"about {left[-1]:.1f} min" if measured or not more else "not measured yet"
        else:
            state = f"complete, {taken:.1f} min"
        lines.append(f"{job.folder.name}: {state}: {' '.join(job.overrides)}")
    about = f"about {minutes_left(left, slots):.1f} minutes with {slots} side by side"
    if more and not measured:
        about += f" without --set {' '.join(more)}; with it the time is known after the first job"
    return [*lines, f"{len(jobs)} jobs, {len(left)} to run, {about}"]


def read_job(job: Job) -> dict[str, float | str] | None:
    """metrics.json of a complete job. Errors: DataError for a damaged one."""
    if not job.finished:
        return None
    try:
        return figures_of(job)
    except DataError as error:
        raise DataError(f"{error}; it belongs to the job {' '.join(job.overrides)}") from error
