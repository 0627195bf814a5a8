"""Does the drop that `plan` ranks first teach more than others? Candidates are filmed, and the law is learned with each of them.

    python benchmarks/planned.py make --out planned --device cuda scene=rabbit scene=chick1      (films six drops each)
    python benchmarks/planned.py fit planned/*.pt --device cuda --results planned.jsonl [--set prior=neo_hookean]
    python benchmarks/planned.py table planned.jsonl

The candidates are those of `plan`, without the rest pose, which the training drop shows. `make` sees all of them as a run sees
drops that it learns from, about the backbone that is calibrated on all; `fit` learns from the training drop alone, ranks the
candidates by the posterior of that, then learns from the training drop and one candidate at a time. Figures are held-out errors
after first contact on the scene's own held-out drops, in mm.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import fits
import identification
import torch

from mosa.data.synthetic.bodies.objects import OBJECTS, Drop, object_named
from mosa.modules.body.body import Start
from mosa.twin.drop_planning import drawn_starts, plan
from mosa.twin.twin import Twin

CANDIDATES = 6


def named(k: int) -> str:
    return f"plan_{k}"


def film(name: str, count: int) -> list[str]:
    """Candidate drops as further sequences of a built-in scene of this process; their names."""
    body = object_named(name)
    train = body.drops["train"]
    drops = {named(k): Drop(train.speed, start[:3], start[3], train.offset, train.contact)
             for k, start in enumerate(drawn_starts(count + 1, 0)[1:], 1)}  # fmt: skip
    OBJECTS[name] = replace(body, drops=body.drops | drops)
    return list(drops)


def make(overrides: list[str], folder: Path, device: str, count: int = CANDIDATES) -> Path:
    """The problem of a scene with cues of the training drop and of every candidate."""
    name = next(word.split("=")[1] for word in overrides if word.startswith("scene="))
    drops = film(name, count)
    return identification.make(
        [*overrides, f"scene.also_train=[{','.join(drops)}]"], folder, device
    )


def with_only(problem: dict, k: int | None) -> dict:
    """The problem of learning from the training drop and candidate k (from 1), None: no candidate."""
    kept = {
        name: s
        for name, s in problem["sequences"].items()
        if "/plan_" not in name or name.endswith(f"/{named(k)}")
    }
    return problem | {"sequences": kept}


def fit(path: Path, overrides: list[str], device: str) -> dict:
    """Gains of the candidates [nats], and what was learned with each."""
    began, problem = time.perf_counter(), torch.load(path, weights_only=True)
    count = sum("/plan_" in name for name in problem["sequences"])

    def learned(k: int | None):
        with tempfile.TemporaryDirectory() as folder:
            own = Path(folder) / "problem.pt"
            torch.save(with_only(problem, k), own)
            return identification.identified(own, overrides, device)

    def off(case) -> float:
        return identification.held_out(identification.errors(case, identification.motions(case)))

    case = learned(None)
    train = problem["sequences"]["train"]
    twin = Twin(case.body, case.module.world, train["frame_dt"], case.module.record, Start.read(train["start"], case.body.rest),
                case.joint.posterior())  # fmt: skip
    gains = {
        each.rotation: each.gain for each in plan(twin, count=count + 1, frames=train["frames"])
    }
    alone, prior = off(case), identification.held_out(identification.errors(case, case.prior))
    starts = drawn_starts(count + 1, 0)[1:]
    both = [off(learned(k)) for k in range(1, count + 1)]
    gained = [gains.get(start) for start in starts]
    best = max((k for k in range(count) if gained[k] is not None), key=gained.__getitem__)
    others = [error for k, error in enumerate(both) if k != best]
    return {"problem": path.stem, "set": overrides, "prior_mm": prior, "one_drop_mm": alone, "gains": gained, "errors_mm": both,
            "planned_mm": both[best], "others_mm": statistics.mean(others), "seconds": time.perf_counter() - began}  # fmt: skip


def table(records: list[dict]) -> str:
    heads = (
        "problem",
        "prior mm",
        "one drop mm",
        "planned mm",
        "mean of the others mm",
        "gain of each, nats: error, mm",
        "s",
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for r in sorted(records, key=lambda r: r["problem"]):
        each = ", ".join(
            f"{'-' if g is None else f'{g:.2f}'}: {e:.1f}"
            for g, e in zip(r["gains"], r["errors_mm"])
        )
        errors = " | ".join(
            f"{r[name]:.1f}" for name in ("prior_mm", "one_drop_mm", "planned_mm", "others_mm")
        )
        lines.append(f"| {r['problem']} | {errors} | {each} | {r['seconds']:.0f} |")
    return "\n".join(lines)


def main() -> None:
    parser = fits.parser_of(__doc__, "overrides of one scene each, in quotes", "planned")
    parser.set_defaults(set=["prior=neo_hookean"])
    parser.add_argument("--count", type=int, default=CANDIDATES, help="make: candidates")
    options = parser.parse_args()
    fits.run(
        options,
        lambda words: make(words.split(), options.out, options.device, options.count),
        lambda path: fit(path, options.set, options.device),
        table,
    )


if __name__ == "__main__":
    main()
