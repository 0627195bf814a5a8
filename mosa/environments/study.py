"""Policies trained in one simulator and tested in another: one policy, or the table over simulators and seeds, to be resumed."""

from __future__ import annotations

import csv
import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mosa.analysis.tables import markdown
from mosa.environments.arena import Arena, Simulator, play, play_all, simulator_named
from mosa.environments.pictures import film, write_films
from mosa.environments.policies import Found, LinearPolicy, Search, by_elites, by_gradient, by_reinforcement
from mosa.environments.task import Task
from mosa.environments.tasks import task_named
from mosa.errors import ConfigError, DataError

log = logging.getLogger(__name__)

UNTRAINED = "none"
"""The policy that a search begins from, which knows no simulator."""
TEST_SEED = 20_000_000
"""Of the tested trials: the same for all policies, and none that a search has drawn."""
FILMED = 3


@dataclass(frozen=True)
class Setting:
    """What a study needs: the bodies, the task, and the sizes. worlds: trials tested at a time; spacing [m]: of the truth's
    particles in tests; train_spacing: where policies are trained in the truth; None: the films' own."""

    task: str
    checkpoint: str | None
    scene: str | None
    device: str
    policy: str
    search: Search
    decisions: int
    trials: int
    worlds: int
    spacing: float | None
    train_spacing: float | None
    options: Mapping[str, Any]


class Bench:
    """The simulators and arenas of a study, each made once."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self._simulators: dict[tuple[str, bool], Simulator] = {}
        self._arenas: dict[tuple[str, bool, int], Arena] = {}
        self._task: Task | None = None

    def simulator(self, name: str, training: bool = False) -> Simulator:
        s = self.setting
        training = training and name == "truth" and s.train_spacing != s.spacing
        key = (name, training)
        if key not in self._simulators:
            spacing = s.train_spacing if training else s.spacing
            self._simulators[key] = simulator_named(name, s.checkpoint, scene=s.scene, device=s.device, spacing=spacing)
        return self._simulators[key]

    def task(self, name: str) -> Task:
        """One for all simulators, from the truth's size where it is known: `name` is the simulator to ask where it is not."""
        if self._task is None:
            try:
                rest = self.simulator("truth").twin.body.rest
            except ConfigError:
                rest = self.simulator(name).twin.body.rest
            self._task = task_named(self.setting.task, rest, **self.setting.options)
        return self._task

    def arena(self, name: str, worlds: int, training: bool = False) -> Arena:
        key = (name, training, worlds)
        if key not in self._arenas:
            self._arenas[key] = Arena(self.simulator(name, training), self.task(name), worlds)
        return self._arenas[key]


def train(bench: Bench, simulator: str, seed: int) -> Found:
    """A policy found in that simulator. Errors: ConfigError."""
    s = bench.setting
    torch.manual_seed(seed)
    worlds = s.search.batch * (s.search.candidates if s.policy == "cem" else 1)
    arena = bench.arena(simulator, worlds, training=True)

    def say(line: str) -> None:
        log.info("%s, %s, seed %d: %s", s.task, simulator, seed, line)

    if s.policy in ("gradient", "cem"):
        check = bench.arena(simulator, min(s.worlds, s.search.validation), training=True)
        search = by_gradient if s.policy == "gradient" else by_elites
        return search(arena, check, s.search, seed, say)
    return by_reinforcement(s.policy, arena, s.decisions, seed)


def test(bench: Bench, simulator: str, policy: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Success and loss of the drawn trials in that simulator, one by one."""
    s = bench.setting
    arena = bench.arena(simulator, min(s.worlds, s.trials))
    trials = arena.task.draw(s.trials, torch.Generator().manual_seed(TEST_SEED))
    loss, success = play_all(arena, trials, policy)
    return {"success": success.tolist(), "loss": [round(v, 5) for v in loss.tolist()]}


def one(bench: Bench, simulator: str, seed: int, folder: Path) -> dict[str, Any]:
    """Train in one simulator, test there and in the truth where it is known; policy.json, result.json and films in `folder`."""
    record = _record(bench, simulator, seed)
    tested = dict.fromkeys([simulator, *(["truth"] if record["truth"] is not None else [])])
    for name in tested:
        count = sum(record["truth" if name == "truth" else "own"]["success"])
        log.info("%s, trained in %s: %d of %d in %s", bench.setting.task, simulator, count, bench.setting.trials, name)
    _write(folder / "result.json", record)
    if record["policy"] is not None:
        films(bench, {f"trained in {simulator}": LinearPolicy.read(bench.task(simulator), record["policy"])},
              "truth" if record["truth"] is not None else simulator, folder)
    return record


def table(bench: Bench, simulators: Sequence[str], seeds: Sequence[int], folder: Path) -> Path:
    """Every simulator and seed, then the untrained policy; what lies in `folder`/jobs from the same setting is not made again.
    Writes <task>.md, .csv and films of the first trials into `folder`; the page's path."""
    jobs = [(UNTRAINED, 0), *((name, seed) for seed in seeds for name in simulators)]
    records = {}
    for name, seed in jobs:
        file = folder / "jobs" / f"{bench.setting.task}_{name}_{seed}.json"
        record = _read(file, bench.setting)
        if record is None:
            record = _record(bench, name, seed)
            _write(file, record)
        log.info("%s, trained in %s, seed %d: %d of %d in the truth", bench.setting.task, name, seed,
                 sum(record["truth"]["success"]), bench.setting.trials)
        records[name, seed] = record
    page = write_table(bench.setting, records, bench.task("truth"), folder)
    shown = {f"trained in {name}": records[name, seeds[0]] for name in simulators}
    policies = {title: LinearPolicy.read(bench.task("truth"), r["policy"]) for title, r in shown.items() if r["policy"] is not None}
    if policies:
        films(bench, policies, "truth", folder)
    return page


def _record(bench: Bench, simulator: str, seed: int) -> dict[str, Any]:
    s = bench.setting
    if simulator == UNTRAINED:
        found = Found(LinearPolicy(bench.task("truth")).requires_grad_(False), [], 0.0, 0)
    else:
        found = train(bench, simulator, seed)
    known = s.scene is not None or _of_builtin(bench)
    own = None if simulator in (UNTRAINED, "truth") else test(bench, simulator, found.policy)
    truth = test(bench, "truth", found.policy) if known else None
    written = found.policy.written() if isinstance(found.policy, LinearPolicy) else None
    return {"setting": _plain(s), "simulator": simulator, "seed": seed, "policy": written, "history": found.history[-200:],
            "seconds": round(found.seconds, 1), "played": found.trials, "own": own, "truth": truth}  # fmt: skip


def _of_builtin(bench: Bench) -> bool:
    try:
        bench.simulator("truth")
    except ConfigError:
        return False
    return True


def _plain(setting: Setting) -> dict[str, Any]:
    return json.loads(json.dumps(asdict(setting)))


FREE = ("device", "worlds")
"""Of a setting: where it is computed, which does not make a result another one."""


def _read(file: Path, setting: Setting) -> dict[str, Any] | None:
    """A kept job of the same setting. Errors: DataError for one of another setting: a folder holds one study."""
    if not file.is_file():
        return None
    try:
        record = json.loads(file.read_text())
        kept = {k: v for k, v in record["setting"].items() if k not in FREE}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{file}: expected the result of a job, found a damaged one ({error}); remove it and try again") from error
    wanted = {k: v for k, v in _plain(setting).items() if k not in FREE}
    if kept != wanted:
        other = ", ".join(f"{k}={kept.get(k)!r} instead of {wanted[k]!r}" for k in wanted if kept.get(k) != wanted[k])
        raise DataError(f"{file}: expected a job of the same setting, found {other}; choose another folder with out=")
    return record


def _write(file: Path, record: Mapping[str, Any]) -> None:
    """Whole or not at all: its presence says that the job is complete."""
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(record))
    partial.replace(file)


def films(bench: Bench, policies: Mapping[str, Callable[[Tensor], Tensor]], simulator: str, folder: Path) -> list[Path]:
    """The first tested trials under each policy, in that simulator: one strip and one video a trial."""
    task = bench.task(simulator)
    count = min(FILMED, bench.setting.trials)
    arena = bench.arena(simulator, count)
    # the same numbers as in the test: trials are drawn column by column
    drawn = task.draw(bench.setting.trials, torch.Generator().manual_seed(TEST_SEED)).select(slice(count))
    played = {title: play(arena, drawn, policy, record=True) for title, policy in policies.items()}
    written = []
    for b in range(count):
        rows = {f"{title}: {'success' if bool(p.success[b]) else 'failure'} ({simulator})": film(arena, p.states, b, 25)
                for title, p in played.items()}
        written += write_films(folder, rows, f"{task.name}_trial_{b}")
    return written


def write_table(setting: Setting, records: Mapping[tuple[str, int], Mapping[str, Any]], task: Task, folder: Path) -> Path:
    """<task>.md and <task>.csv. Every row is one simulator to train in."""
    names = list(dict.fromkeys(name for name, _ in records))
    header = ["trained in", "success in the truth", "mean", "in its own simulator", "mean loss in the truth", "seconds of training"]
    lines = []
    for name in names:
        found = [r for (n, _), r in sorted(records.items()) if n == name]
        counts = [sum(r["truth"]["success"]) for r in found]
        own = [sum(r["own"]["success"]) for r in found if r["own"] is not None]
        loss = [sum(r["truth"]["loss"]) / len(r["truth"]["loss"]) for r in found]
        lines.append([name, ", ".join(map(str, counts)), _mean(counts, setting.trials), ", ".join(map(str, own)) or "",
                      f"{sum(loss) / len(loss):.3f}", f"{sum(r['seconds'] for r in found) / len(found):.0f}"])  # fmt: skip
    seeds = sorted({seed for name, seed in records if name != UNTRAINED})
    text = [
        f"# {task.name}: policies tested in the hidden truth",
        f"Of {setting.trials} drawn trials, the same for every policy; one number a seed ({', '.join(map(str, seeds))}). Policy: "
        f"{setting.policy}. `none`: the policy that the search begins from. ±: standard deviation over seeds; of one seed's "
        f"{setting.trials} trials alone it is up to {100 * 0.5 / math.sqrt(setting.trials):.0f} in 100.",
        markdown(header, lines),
        "Setting: " + ", ".join(f"{k} {v}" for k, v in _plain(setting).items() if k != "search") + "; search "
        + ", ".join(f"{k} {v}" for k, v in asdict(setting.search).items()) + ".",
        "Task: " + ", ".join(f"{k} {v}" for k, v in asdict(task).items()) + ".",
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / f"{task.name}.md"
    page.write_text("\n\n".join(text) + "\n")
    with open(folder / f"{task.name}.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "trained_in", "seed", "tested_in", "trial", "success", "loss"])
        for (name, seed), record in sorted(records.items()):
            for tested in ("truth", "own"):
                if (result := record[tested]) is not None:
                    where = "truth" if tested == "truth" else name
                    for trial, (won, loss) in enumerate(zip(result["success"], result["loss"])):
                        writer.writerow([task.name, name, seed, where, trial, int(won), loss])
    return page


def _mean(counts: Sequence[int], trials: int) -> str:
    """Per hundred, with the standard deviation over seeds."""
    shares = [100 * count / trials for count in counts]
    mean = sum(shares) / len(shares)
    if len(shares) < 2:
        return f"{mean:.0f} %"
    return f"{mean:.0f} ± {math.sqrt(sum((s - mean) ** 2 for s in shares) / (len(shares) - 1)):.0f} %"
