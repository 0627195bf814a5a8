"""What the tasks of `mosa.environments` ask, measured on hidden truths alone: no learned twin is read, so that a task's
parameters can be chosen before any comparison.

    OMP_NUM_THREADS=1 python benchmarks/environments.py [--task placement hanging pushing] [--scene rabbit] [--device cuda]
        [--trials 64] [--candidates 32] [--spacing 0.0125] [--set low=0.1 high=0.15 ...]

For each task, over trials drawn as in training:
- `plain`: share of trials in which the policy that a search begins from succeeds. Near 0 or 1 nothing can be learned.
- `reachable` (tasks of one decision): share of trials in which one of so many random actions succeeds.
- `told apart`: of the true body against its isotropic twin (the same matrix, without fibres and with one stiffness), both under
  that policy: mean distance of their centres at the end [mm], mean angle between their up axes [degrees], and the share of trials
  in which one succeeds and the other does not. Where it is small no simulator can be better than another.
"""

from __future__ import annotations

import argparse
import time

import torch

from mosa.environments.arena import Arena, Simulator, play
from mosa.environments.policies import LinearPolicy
from mosa.environments.tasks import TASKS, task_named
from mosa.environments.truth import true_twin


def measured(name: str, options: argparse.Namespace, values: dict[str, float]) -> str:
    """A row of the table."""
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
    if task.tool is None and options.candidates:
        arena, generator = Arena(made[0], task, options.trials), torch.Generator().manual_seed(2)
        won = wins[0].clone()
        for _ in range(options.candidates):
            action = 2 * torch.rand(options.trials, len(task.actions), generator=generator) - 1
            won |= play(arena, trials, lambda _, action=action: action).success
        reachable = f"{100 * won.float().mean():.0f} %"
    return (f"| {name} | {100 * wins[0].float().mean():.0f} % | {reachable} | {apart:.0f} | {angle:.0f} | "
            f"{100 * (wins[0] != wins[1]).float().mean():.0f} % | {time.perf_counter() - began:.0f} |")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--scene", default="rabbit")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--trials", type=int, default=64)
    parser.add_argument("--candidates", type=int, default=32)
    parser.add_argument("--spacing", type=float)
    parser.add_argument("--set", nargs="+", default=[], metavar="FIELD=NUMBER", help="of the tasks")
    options = parser.parse_args()
    torch.set_num_threads(1)
    values = {key: float(value) for key, value in (item.split("=") for item in options.set)}
    print("| task | plain | reachable | told apart [mm] | [degrees] | success differs | s |\n|---|---|---|---|---|---|---|")
    for name in options.task:
        print(measured(name, options, values), flush=True)


if __name__ == "__main__":
    main()
