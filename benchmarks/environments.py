"""What the tasks of `mosa.environments` ask, measured on hidden truths alone: no learned twin is read, so that a task's
parameters can be chosen before any comparison.

    OMP_NUM_THREADS=1 python benchmarks/environments.py [--task placement hanging] [--scene rabbit] [--device cuda]
        [--trials 64] [--candidates 32] [--spacing 0.0125] [--set low=0.1 high=0.15 ...] [--heights 0.1:0.2 0.15:0.25 --choose FILE]

For each task, over trials drawn as in training:
- `plain`: share of trials in which the policy that a search begins from succeeds. Near 0 or 1 nothing can be learned.
- `law` and `noise`: how far [mm], in the median, the true body ends from its isotropic twin (the same matrix, without fibres and
  with one stiffness) under that policy, and how far from itself where only the hidden part of the trial is drawn anew. Where the
  law does not move it more than chance does, no simulator can be better than another.
- `best of truth`, `best of isotropic` : of so many random actions a trial, the one with the least loss in
  either law, tested in the true body with the hidden part drawn anew: what the right law is worth.

`--heights` measures each range of dropping heights; `--choose` writes the one that its rule names into a file, as
`options.low=... options.high=...` of `python -m mosa.environments`: of the ranges with `plain` from 10 to 90 % that with the
largest `law` over `noise` (of all ranges, where none is so), the lower one of equals.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch
from torch import Tensor

from mosa.environments.arena import Arena, Played, Simulator, play
from mosa.environments.policies import LinearPolicy
from mosa.environments.task import Trials
from mosa.environments.tasks import TASKS, task_named
from mosa.environments.truth import true_twin

CHOSEN = (0.1, 0.9)
"""Shares of plain success between which a range of heights may be chosen."""
SPREAD = 0.5
"""Of random actions, in the actions' range."""


def measured(
    name: str, options: argparse.Namespace, values: dict[str, float]
) -> tuple[str, float, float]:
    """A row of the table, share of plain success, and how much farther the law moves the end than chance does."""
    began = time.perf_counter()
    made = {"device": options.device, "spacing": options.spacing}
    truth, isotropic = (
        Simulator("truth", true_twin(options.scene, material=m, **made))
        for m in ("anisotropic", "isotropic")
    )
    task, drawing = (
        task_named(name, truth.twin.body.rest, **values),
        torch.Generator().manual_seed(1),
    )
    trials = task.draw(options.trials, drawing)
    anew = Trials(trials.observed, task.draw(options.trials, drawing).hidden)

    def ends(simulator: Simulator, trials: Trials, policy) -> tuple[Played, Tensor]:
        arena = Arena(simulator, task, len(trials))
        return play(arena, trials, policy), arena.view.center.cpu()

    plain = LinearPolicy(task)
    (played, there), (_, other), (_, again) = (
        ends(truth, trials, plain),
        ends(isotropic, trials, plain),
        ends(truth, anew, plain),
    )
    law, noise = (float(1e3 * (there - end).norm(dim=1).median()) for end in (other, again))
    best = ["", ""]
    if options.candidates:
        count = options.candidates
        many = Trials(
            trials.observed.repeat_interleave(count, 0),
            task.draw(options.trials * count, drawing).hidden,
        )
        actions = SPREAD * (
            2 * torch.rand(options.trials, count, len(task.actions), generator=drawing) - 1
        )
        for k, simulator in enumerate((truth, isotropic)):
            loss = (
                ends(simulator, many, lambda _: actions.flatten(0, 1))[0]
                .loss.cpu()
                .view(options.trials, count)
            )
            action = actions[torch.arange(options.trials), loss.argmin(1)]
            best[k] = (
                f"{100 * ends(truth, anew, lambda _, action=action: action)[0].success.float().mean():.0f} %"
            )
    succeeded = float(played.success.float().mean())
    heights = f"{task.low:g} to {task.high:g}"
    row = (f"| {name} | {heights} | {100 * succeeded:.0f} % | {law:.0f} | {noise:.0f} | {best[0]} | {best[1]} | "
           f"{time.perf_counter() - began:.0f} |")  # fmt: skip
    return row, succeeded, law / max(noise, 1e-3)


def chosen(found: list[tuple[tuple[float, float], float, float]]) -> tuple[float, float]:
    """The range of heights [m] among (range, plain, law over noise) that the rule names."""
    fit = [f for f in found if CHOSEN[0] <= f[1] <= CHOSEN[1]] or found
    return max(fit, key=lambda f: (f[2], -f[0][0]))[0]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--scene", default="rabbit")
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu"
    )
    parser.add_argument("--trials", type=int, default=64)
    parser.add_argument("--candidates", type=int, default=32)
    parser.add_argument("--spacing", type=float)
    parser.add_argument("--set", nargs="+", default=[], metavar="FIELD=NUMBER", help="of the tasks")
    parser.add_argument(
        "--heights", nargs="+", metavar="LOW:HIGH", help="[m] of placement and hanging"
    )
    parser.add_argument(
        "--choose", type=Path, metavar="FILE", help="of one task: write the chosen heights"
    )
    options = parser.parse_args()
    if options.choose and (not options.heights or len(options.task) != 1):
        parser.error("--choose: expected --heights, and one of placement, hanging as --task")
    torch.set_num_threads(1)
    values = {
        key: json.loads(value) for key, value in (item.split("=") for item in options.set)
    }  # a count stays whole
    ranges = [tuple(map(float, item.split(":"))) for item in options.heights or ()]
    print(
        "| task | heights [m] | plain | law [mm] | noise [mm] | best of truth | best of isotropic | s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in options.task:
        found = []
        for low, high in ranges or [(None, None)]:
            row, plain, ratio = measured(
                name, options, values | ({} if low is None else {"low": low, "high": high})
            )
            found.append(((low, high), plain, ratio))
            print(row, flush=True)
        if options.choose:
            low, high = chosen(found)
            options.choose.write_text(f"options.low={low:g} options.high={high:g}\n")


if __name__ == "__main__":
    main()
