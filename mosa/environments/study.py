"""Policies trained in one simulator and tested in another: one policy, or the table over simulators and seeds, to be resumed."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mosa.config.leaf_settings import EnvironmentsSettings
from mosa.environments.arena import Arena, play, play_all, scene_of, simulator_named, truth_of
from mosa.environments.pictures import film, write_films
from mosa.environments.policies import SEARCHES, Found, LinearPolicy
from mosa.environments.task import Task
from mosa.environments.tasks import task_named
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.tables import markdown
from mosa.system.whole_files import write_table as write_csv
from mosa.system.whole_files import write_whole

log = logging.getLogger(__name__)

UNTRAINED = "none"  # the policy that a search begins from, which knows no simulator
TEST_SEED = 20_000_000  # of the tested trials, the same for all policies


class Bench:
    """The simulators and arenas of a study, each made once."""

    def __init__(self, setting: EnvironmentsSettings) -> None:
        s = self.setting = setting
        self.simulator = cache(
            lambda name: simulator_named(name, s.checkpoint, device=s.device, **s.truth.plain())
        )
        self.arena = cache(
            lambda name, worlds: Arena(self.simulator(name), self.task(name), worlds)
        )
        self._task: Task | None = None

    @property
    def knows_truth(self) -> bool:
        """Whether the twin was learned from a built-in scene, or one is named."""
        try:
            return self.simulator("truth") is not None
        except ConfigError:
            return False

    def task(self, name: str) -> Task:
        """One for all simulators, from the truth's size where it is known: `name` is the simulator to ask where it is not."""
        if self._task is None:
            rest = self.simulator("truth" if self.knows_truth else name).twin.body.rest
            self._task = task_named(self.setting.task, rest, **self.setting.options)
        return self._task


def train(bench: Bench, simulator: str, seed: int) -> Found:
    """A policy found in that simulator."""
    s = bench.setting
    torch.manual_seed(seed)
    worlds = s.search.batch * (s.search.candidates if s.policy == "model" else 1)
    arena = bench.arena(simulator, worlds)
    check = bench.arena(simulator, min(s.worlds, s.search.validation))

    def say(line: str) -> None:
        log.info("%s, %s, seed %d: %s", s.task, simulator, seed, line)

    return SEARCHES[s.policy](arena, check, s.search, seed, say)


def test(bench: Bench, simulator: str, policy: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Success and loss of the drawn trials in that simulator, one by one."""
    s = bench.setting
    arena = bench.arena(simulator, min(s.worlds, s.trials))
    trials = arena.task.draw(s.trials, torch.Generator().manual_seed(TEST_SEED))
    loss, success = play_all(arena, trials, policy)
    return {"success": success.tolist(), "loss": [round(v, 5) for v in loss.tolist()]}


def one(bench: Bench, simulator: str, seed: int, folder: Path, filmed: int = 3) -> dict[str, Any]:
    """Train in one simulator, test there and in the truth where it is known; result.json and films of that many trials in
    `folder`."""
    record = _record(bench, simulator, seed)
    where = simulator if record["truth"] is None else "truth"
    for name, result in ((simulator, record["own"]), ("truth", record["truth"])):
        if result is not None:
            log_successes(bench, simulator, seed, result, name)
    write_whole(folder / "result.json", json.dumps(record))
    policy = LinearPolicy.read(bench.task(simulator), record["policy"])
    films(bench, {f"trained in {simulator}": policy}, where, folder, filmed)
    return record


def log_successes(
    bench: Bench, simulator: str, seed: int, result: Mapping[str, Any], where: str
) -> None:
    """How often a policy succeeded, as a line of the log."""
    s, won = bench.setting, sum(result["success"])
    log.info("%s, trained in %s, seed %d: %d of %d in %s", s.task, simulator, seed, won, s.trials, where)  # fmt: skip


Records = Mapping[tuple[str, int], Mapping[str, Any]]


def make_jobs(bench: Bench, jobs: Sequence[tuple[str, int]], folder: Path) -> Records:
    """The records of (simulator or `UNTRAINED`, seed); what lies in `folder`/jobs from the same setting is not made again. Several
    processes may make jobs of one folder."""
    records = {}
    for name, seed in jobs:
        file = folder / "jobs" / f"{bench.setting.task}_{name}_{seed}.json"
        record = _read(file, _identity(bench, name))
        if record is None:
            record = _record(bench, name, seed)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, json.dumps(record))
        log_successes(bench, name, seed, record["truth"], "truth")
        records[name, seed] = record
    return records


def table(
    bench: Bench, simulators: Sequence[str], seeds: Sequence[int], folder: Path, filmed: int = 3
) -> Path:
    """Every simulator and seed, and the untrained policy. Writes <task>.md, .csv and films of that many trials into `folder`; the
    page's path."""
    simulators = [name for name in simulators if name != UNTRAINED]
    jobs = [(UNTRAINED, 0), *((name, seed) for seed in seeds for name in simulators)]
    records, task = make_jobs(bench, jobs, folder), bench.task("truth")
    page = write_table(bench.setting, records, task, folder, about_twin(bench))
    policies = {
        f"trained in {name}": LinearPolicy.read(task, records[name, seeds[0]]["policy"])
        for name in simulators
    }
    films(bench, policies, "truth", folder, filmed)
    return page


def _record(bench: Bench, simulator: str, seed: int) -> dict[str, Any]:
    s = bench.setting
    if simulator == UNTRAINED:
        found = Found(LinearPolicy(bench.task("truth")).requires_grad_(False), [], 0.0, 0)
    else:
        found = train(bench, simulator, seed)
    known = s.truth.scene is not None or bench.knows_truth
    own = None if simulator in (UNTRAINED, "truth") else test(bench, simulator, found.policy)
    truth = test(bench, "truth", found.policy) if known else None
    return {
        "setting": _identity(bench, simulator), "simulator": simulator, "seed": seed, "policy": found.policy.written(),
        "history": found.history[-200:], "seconds": round(found.seconds, 1), "played": found.trials, "own": own, "truth": truth,
    }  # fmt: skip


def _plain(setting: EnvironmentsSettings) -> dict[str, Any]:
    """What results depend on; of the checkpoint its content in place of its path: a study may go on on another machine."""
    content = None
    if setting.checkpoint is not None:
        content = hashlib.sha256(Path(setting.checkpoint).read_bytes()).hexdigest()[:16]
    plain = setting.plain()
    return {"task": setting.task, "checkpoint": content, **plain["truth"],
            **{key: plain[key] for key in ("policy", "search", "trials", "options")}}  # fmt: skip


def _identity(bench: Bench, simulator: str) -> dict[str, Any]:
    """The setting of a job. One that reads no learned twin has its hidden truth in place of checkpoint and scene: it can be made
    before the twin is learned, and is the same for all twins of a scene."""
    s, found = bench.setting, _plain(bench.setting)
    if simulator not in (UNTRAINED, "truth"):
        return found
    known: Mapping[str, Any] = {"name": s.truth.scene}
    if s.truth.scene is None:
        known = scene_of(bench.simulator("learned").twin, s.checkpoint)
    return found | {"checkpoint": None, "scene": None, "truth": truth_of(known)}


def _read(file: Path, wanted: Mapping[str, Any]) -> dict[str, Any] | None:
    """A kept job of the same setting. Errors: DataError for one of another setting: a folder holds one study."""
    if not file.is_file():
        return None
    try:
        record = json.loads(file.read_text())
        kept = dict(record["setting"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{file}: expected the result of a job, found a damaged one ({error}): remove it"
        ) from error
    if kept != wanted:
        differs = [k for k in wanted if kept.get(k) != wanted[k]]
        other = ", ".join(f"{k}={kept.get(k)!r} instead of {wanted[k]!r}" for k in differs)
        raise DataError(
            f"{file}: expected a job of the same setting, found {other}; choose another out="
        )
    return record


def films(
    bench: Bench,
    policies: Mapping[str, Callable[[Tensor], Tensor]],
    simulator: str,
    folder: Path,
    filmed: int,
) -> None:
    """The first tested trials under each policy, in that simulator: one strip and one video a trial."""
    task = bench.task(simulator)
    count = min(filmed, bench.setting.trials)
    if count == 0:
        return
    arena = bench.arena(simulator, count)
    # the same numbers as in the test: trials are drawn column by column
    drawn = task.draw(bench.setting.trials, torch.Generator().manual_seed(TEST_SEED))
    drawn = drawn.select(slice(count))
    played = {title: play(arena, drawn, policy, record=True) for title, policy in policies.items()}
    for b in range(count):
        rows = {}
        for title, p in played.items():
            ends = "success" if bool(p.success[b]) else "failure"
            rows[f"{title}: {ends} ({simulator})"] = film(arena, p.states, b, 25)
        write_films(folder, rows, f"{task.name}_trial_{b}")


def about_twin(bench: Bench) -> str:
    """What the learned and the isotropic simulator are, in a sentence; empty without a run."""
    if bench.setting.checkpoint is None:
        return ""
    twin = bench.simulator("learned").twin
    return (f"Twin: learned from scene {scene_of(twin, bench.setting.checkpoint)['name']}, prior {twin.body.material.law}, "
            f"{len(twin.body.rest)} particles on a grid of {1e3 * twin.body.settings.dx:.1f} mm.")  # fmt: skip


def write_table(
    setting: EnvironmentsSettings, records: Records, task: Task, folder: Path, about: str = ""
) -> Path:
    """<task>.md and <task>.csv. Every row is one simulator to train in. about: a sentence on the twin."""
    lines, rows = [], []
    for name in dict.fromkeys(name for name, _ in records):
        found = [r for (n, _), r in sorted(records.items()) if n == name]
        counts = [sum(r["truth"]["success"]) for r in found]
        own = ", ".join(str(sum(r["own"]["success"])) for r in found if r["own"] is not None)
        loss = statistics.fmean(statistics.fmean(r["truth"]["loss"]) for r in found)
        seconds = statistics.fmean(r["seconds"] for r in found)
        shown = ", ".join(map(str, counts))
        lines.append([name, shown, _mean(counts, setting.trials), own, f"{loss:.3f}", f"{seconds:.0f}"])  # fmt: skip
    for (name, seed), record in sorted(records.items()):
        for tested, where in (("truth", "truth"), ("own", name)):
            for trial, pair in enumerate(zip(*record[tested].values()) if record[tested] else ()):
                rows.append([task.name, name, seed, where, trial, int(pair[0]), pair[1]])
    header = ["trained in", "success in the truth", "mean", "in its own simulator", "mean loss in the truth",
              "seconds of training"]  # fmt: skip
    seeds = sorted({seed for name, seed in records if name != UNTRAINED})
    text = [
        f"# {task.name}: policies tested in the hidden truth",
        f"Of {setting.trials} drawn trials, the same for every policy; one number a seed ({', '.join(map(str, seeds))}). Policy: "
        f"{setting.policy}. `none`: the policy that the search begins from. ±: standard deviation over seeds; of one seed's "
        f"{setting.trials} trials alone it is up to {100 * 0.5 / math.sqrt(setting.trials):.0f} in 100.",
        markdown(header, lines),
        *([about] if about else []),
        "Setting: " + _listed({k: v for k, v in _plain(setting).items() if k not in UNSAID}) + "; search "
        + _listed(setting.search.plain()) + ".",
        "Task: " + _listed(asdict(task)) + ".",
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / f"{task.name}.md"
    write_whole(page, "\n\n".join(text) + "\n")
    columns = ["task", "trained_in", "seed", "tested_in", "trial", "success", "loss"]
    write_csv(page.with_suffix(".csv"), columns, rows)
    return page


UNSAID = ("search", "options", "checkpoint")  # said elsewhere, or of one machine


def _listed(values: Mapping[str, Any]) -> str:
    shown = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in values.items()}
    return ", ".join(f"{k} {v}" for k, v in shown.items())


def _mean(counts: Sequence[int], trials: int) -> str:
    """Per hundred, with the standard deviation over seeds."""
    shares = [100 * count / trials for count in counts]
    spread = f" ± {statistics.stdev(shares):.0f}" if len(shares) > 1 else ""
    return f"{statistics.fmean(shares):.0f}{spread} %"
