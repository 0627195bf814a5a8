"""What the tasks of `mosa.environments` ask, measured on hidden truths alone: no learned twin is read, so that a task's
parameters can be chosen before any comparison.

    OMP_NUM_THREADS=1 python benchmarks/environments.py [--task placement hanging pushing] [--scene rabbit] [--device cuda]
        [--trials 64] [--candidates 32] [--spacing 0.0125] [--set low=0.1 high=0.15 ...] [--heights 0.1:0.2 0.15:0.25 --choose FILE]

For each task, over trials drawn as in training:
- `plain`: share of trials in which the policy that a search begins from succeeds. Near 0 or 1 nothing can be learned.
- `reachable` (tasks of one decision): share of trials in which one of so many random actions succeeds.
- `told apart`: of the true body against its isotropic twin (the same matrix, without fibres and with one stiffness), both under
  that policy: mean distance of their centres at the end [mm], mean angle between their up axes [degrees], and the share of trials
  in which one succeeds and the other does not. Where it is small no simulator can be better than another.

`--heights` measures each range of dropping heights; `--choose` writes the one that its rule names into a file, as
`options.low=... options.high=...` of `python -m mosa.environments`: of the ranges with `plain` from 10 to 90 % that which tells
laws apart in most trials (of all ranges, where none is so), the lower one of equals.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from mosa.environments.arena import Arena, Simulator, play
from mosa.environments.policies import LinearPolicy
from mosa.environments.tasks import TASKS, Release, task_named
from mosa.environments.truth import true_twin

CHOSEN = (0.1, 0.9)
"""Shares of plain success between which a range of heights may be chosen."""


def measured(name: str, options: argparse.Namespace, values: dict[str, float]) -> tuple[str, float, float]:
    """A row of the table, share of plain success, and share of trials in which the two laws' success differs."""
    began = time.perf_counter()
    made = [Simulator("truth", true_twin(options.scene, material=material, device=options.device, spacing=options.spacing))
            for material in ("anisotropic", "isotropic")]  # fmt: skip
    task = task_named(name, made[0].twin.body.rest, **values)
    trials = task.draw(options.trials, torch.Generator().manual_seed(1))
    ends, wins = [], []
    for simulator in made:
        arena = Arena(simulator, task, options.trials)
        wins.append(play(arena, trials, LinearPolicy(task)).success)
        ends.append(arena.view)
    apart = 1e3 * (ends[0].center - ends[1].center).norm(dim=1).mean()
    angle = torch.rad2deg((ends[0].upright * ends[1].upright).sum(1).clamp(-1, 1).acos()).mean()
    reachable = ""
    if task.once and options.candidates:
        arena, generator = Arena(made[0], task, options.trials), torch.Generator().manual_seed(2)
        won = wins[0].clone()
        for _ in range(options.candidates):
            action = 2 * torch.rand(options.trials, len(task.actions), generator=generator) - 1
            won |= play(arena, trials, lambda _, action=action: action).success
        reachable = f"{100 * won.float().mean():.0f} %"
    plain, differs = float(wins[0].float().mean()), float((wins[0] != wins[1]).float().mean())
    heights = f"{task.low:g} to {task.high:g}" if isinstance(task, Release) else ""
    row = (f"| {name} | {heights} | {100 * plain:.0f} % | {reachable} | {apart:.0f} | {angle:.0f} | {100 * differs:.0f} % | "
           f"{time.perf_counter() - began:.0f} |")  # fmt: skip
    return row, plain, differs


def chosen(found: list[tuple[tuple[float, float], float, float]]) -> tuple[float, float]:
    """The range of heights [m] among (range, plain, differs) that the rule names."""
    fit = [f for f in found if CHOSEN[0] <= f[1] <= CHOSEN[1]] or found
    return max(fit, key=lambda f: (f[2], -f[0][0]))[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--scene", default="rabbit")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--trials", type=int, default=64)
    parser.add_argument("--candidates", type=int, default=32)
    parser.add_argument("--spacing", type=float)
    parser.add_argument("--set", nargs="+", default=[], metavar="FIELD=NUMBER", help="of the tasks")
    parser.add_argument("--heights", nargs="+", metavar="LOW:HIGH", help="[m] of placement and hanging")
    parser.add_argument("--choose", type=Path, metavar="FILE", help="of one task: write the chosen heights")
    options = parser.parse_args()
    if options.choose and (not options.heights or len(options.task) != 1 or options.task == ["pushing"]):
        parser.error("--choose: expected --heights, and one of placement, hanging as --task")
    torch.set_num_threads(1)
    values = {key: json.loads(value) for key, value in (item.split("=") for item in options.set)}  # a count stays whole
    ranges = [tuple(map(float, item.split(":"))) for item in options.heights or ()]
    print("| task | heights [m] | plain | reachable | told apart [mm] | [degrees] | success differs | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.task:
        found = []
        for low, high in ranges if ranges and name != "pushing" else [(None, None)]:
            row, plain, differs = measured(name, options, values | ({} if low is None else {"low": low, "high": high}))
            found.append(((low, high), plain, differs))
            print(row, flush=True)
        if options.choose:
            low, high = chosen(found)
            options.choose.write_text(f"options.low={low:g} options.high={high:g}\n")


if __name__ == "__main__":
    main()
