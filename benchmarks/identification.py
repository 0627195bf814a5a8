"""The identification by itself: cues of many scenes once, then fits of them by the dozen, without images.

    python benchmarks/identification.py make --out problems --device cuda scene=rabbit "scene=gorilla scene.material=isotropic"
    python benchmarks/identification.py fit problems/*.pt --device cuda --results fits.jsonl [--set identification.count=60 ...]
    python benchmarks/identification.py table fits.jsonl

`make` films, reconstructs, finds the starts and the cues about the calibrated backbone's motion, as a run does, and keeps what a
fit reads in one file of a few MB, with the truth for the figures. `fit` calibrates the prior and runs the joint stage on it: a few
seconds each on a GPU, minutes on a CPU. Figures are held-out errors after first contact, in mm, at 2000 particles.
docs/identification.md has tables that were made so.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from types import SimpleNamespace

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import Tensor

from mosa.analysis.stiffness import angle_between, stiffest
from mosa.assembly import assemble
from mosa.config import build_body
from mosa.data.builtin.floor import floor_rollout, hidden_of
from mosa.errors import MosaError
from mosa.evaluation import true_motion
from mosa.modules.body import Start
from mosa.modules.identification import Identification
from mosa.modules.lit_mosa import LitMosa, Take
from mosa.modules.residuals import sampled
from mosa.types import MotionCues

CONF = Path(__file__).parents[1] / "conf"
LAW = ("prior", "adapter", "heterogeneity", "identification", "criterion", "fit", "simulation")
"""Groups of the configuration that a fit takes as they are now, not as they were when the problem was made."""


def configuration(overrides: list[str]):
    with initialize_config_dir(str(CONF.resolve()), version_base=None):
        return compose("train", overrides=overrides)


def rms_mm(away: Tensor) -> float:
    return 1e3 * float(away.square().sum(-1).mean().sqrt())


def make(overrides: list[str], folder: Path, device: str) -> Path:
    """The problem of one scene."""
    cfg = configuration(overrides)
    made = assemble(cfg, device)
    scene, body = made.scene, made.body
    chosen, sequences = sampled(len(body.rest), torch.device("cpu")), {}
    for each in made.sequences:
        s = each.scene
        sequences[each.prefix] = {
            "start": each.start.written(), "contact": each.contact, "frames": s.frames,
            "frame_dt": float(s.times[1] - s.times[0]), "truth": true_motion(body, s)[:, chosen].cpu(),
            "floor": floor_rollout(body, s, made.world)[:, chosen].cpu(),
        }  # fmt: skip
    # as a run does before its joint stage: the cues once more, about the calibrated backbone's motion
    module = made.module
    calibration = module.identifying(module.stages[0])
    calibration.search()
    run(calibration, module.stages[0].iterations)
    module.inform()
    cues, T, hidden = module.takes[0].cues, len(scene.training_frames), hidden_of(scene)
    kept = {name: getattr(cues, name)[:T].cpu() for name in ("positions", "rotation", "stretch", "weight")}
    problem = {
        "config": made.config, "rest": body.rest.cpu(), "volume": body.volume.cpu(), "sequences": sequences, "cues": kept,
        "fibre": getattr(hidden, "fibre", None) if getattr(hidden, "ratio", 1) > 1 else None,
        "factor": hidden.factor(body.rest.cpu().float()),
    }  # fmt: skip
    twin = "_twin" if cfg.scene.get("material") == "isotropic" else ""
    path = folder / f"{scene.name}{twin}_{len(body.rest)}.pt"
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(problem, path)
    seen, true = kept["positions"][:, chosen], sequences["train"]["truth"][:T]
    contact = sequences["train"]["contact"]
    print(f"{path}: {len(body.rest)} particles, cues off by {rms_mm((seen - true)[contact:]):.2f} mm after contact", flush=True)
    return path


def read(path: Path, overrides: list[str], device: str) -> SimpleNamespace:
    """The module that fits the body of a problem with the law and the settings of `overrides`, and its sequences."""
    problem = torch.load(path, weights_only=True)
    cfg = OmegaConf.to_container(configuration(overrides), resolve=True)
    config = problem["config"] | {"cfg": problem["config"]["cfg"] | {name: cfg[name] for name in LAW}}
    n = len(problem["rest"])
    tensors = {"rest": problem["rest"], "volume": problem["volume"], "colors": torch.zeros(n, 3), "opacities": torch.ones(n),
               "covariances": torch.eye(3).expand(n, 3, 3).clone()}  # fmt: skip
    body = build_body(config, tensors).to(device)
    for own in problem["sequences"].values():
        own["start"] = Start.read(own["start"], body.rest)
    train, cues = problem["sequences"]["train"], {k: v.float().to(device) for k, v in problem["cues"].items()}
    take = Take(train["start"], None, MotionCues(**cues, covariances=torch.zeros(1, device=device)), train["frame_dt"],
                train["contact"])  # without images  # fmt: skip
    module = LitMosa.from_config(config, body, takes=[take], background=torch.ones(3, device=device))
    return SimpleNamespace(problem=problem, module=module, body=body)


@torch.no_grad()
def errors(case: SimpleNamespace, **switches: bool) -> dict[str, float]:
    """By sequence, [mm]."""
    chosen, found, model = sampled(len(case.body.rest), torch.device("cpu")), {}, case.body.model().only(**switches)
    for prefix, s in case.problem["sequences"].items():
        x = case.body.simulate(s["start"], case.module.world, s["frames"], s["frame_dt"], model=model).x[:, chosen].cpu()
        found[prefix] = rms_mm((x - s["truth"])[s["contact"] :])
    return found


def held_out(by_sequence: dict[str, float]) -> float:
    tests = [value for prefix, value in by_sequence.items() if prefix.startswith("test")]
    return sum(tests) / len(tests)


def fit(path: Path, overrides: list[str], device: str) -> dict:
    """Calibration and joint stage; the figures of both."""
    began, case = time.perf_counter(), read(path, overrides, device)
    module, body = case.module, case.body
    stages = module.stages
    calibration = module.identifying(stages[0])
    calibration.search()
    run(calibration, stages[0].iterations)
    prior = errors(case, heterogeneity=False, adapter=False)
    body.adapter.switch_on(body.material.reference_modulus(), body.material.poisson())
    joint = module.identifying(stages[-1])
    taken = run(joint, stages[-1].iterations)
    learned = errors(case)
    floor = {k: rms_mm((s["floor"] - s["truth"])[s["contact"] :]) for k, s in case.problem["sequences"].items()}
    body.adapter.follow(body.material.poisson())
    axis, ratio = stiffest(body.adapter.stiffness().detach().cpu())
    fibre, factor, true = case.problem["fibre"], body.factor(body.heterogeneity).detach().cpu(), case.problem["factor"]
    varies = float(true.std()) > 1e-6 and float(factor.std()) > 1e-6
    return {
        "problem": path.stem, "set": overrides, "prior_mm": held_out(prior), "learned_mm": held_out(learned),
        "ratio": held_out(learned) / held_out(prior), "each_mm": learned, "prior_each_mm": prior, "floor_mm": held_out(floor),
        "stiffness_ratio": float(ratio), "mean_abs_C": float(body.adapter.statistics().mean_abs_C),
        "fibre_deg": None if fibre is None else float(angle_between(axis, torch.tensor(fibre))),
        "eta": float(torch.corrcoef(torch.stack([factor.float(), true]))[0, 1]) if varies else None,
        "grid": joint.multiple(), "iterations": taken, "seconds": time.perf_counter() - began,
    } | {name: float(value.detach()) for name, value in body.material.physical().items()}  # fmt: skip


def run(identification: Identification, most: int) -> int:
    for i in range(most):
        identification.iterate()
        if identification.converged:
            return i + 1
    return most


def table(records: list[dict]) -> str:
    heads = ("problem", "set", "prior mm", "learned mm", "ratio", "floor mm", "stiffness ratio", "fibre deg", "mean abs C", "eta",
             "grid", "s")  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for r in sorted(records, key=lambda r: (r["set"], r["problem"])):
        def shown(name: str, digits: int, r=r) -> str:
            return "" if r[name] is None else f"{r[name]:.{digits}f}"

        lines.append(f"| {r['problem']} | {' '.join(r['set'])} | " + " | ".join(
            shown(name, digits) for name, digits in (
                ("prior_mm", 1), ("learned_mm", 1), ("ratio", 2), ("floor_mm", 1), ("stiffness_ratio", 2), ("fibre_deg", 0),
                ("mean_abs_C", 3), ("eta", 2), ("grid", 2), ("seconds", 0))) + " |")  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "fit", "table"))
    parser.add_argument("inputs", nargs="+", help="make: overrides of one scene each, in quotes; fit: problems; table: results")
    parser.add_argument("--out", type=Path, default=Path("problems"), help="make: folder of the problems")
    parser.add_argument("--results", type=Path, default=Path("fits.jsonl"), help="fit: a line is added for each")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--set", nargs="*", default=["prior=neo_hookean"], help="fit: overrides of the law and its identification")
    options = parser.parse_args()
    if options.what == "table":
        print(table([json.loads(line) for name in options.inputs for line in Path(name).read_text().splitlines()]))
        return
    for each in options.inputs:
        if options.what == "make":
            make(each.split(), options.out, options.device)
            continue
        try:
            record = fit(Path(each), options.set, options.device)
        except MosaError as error:
            print(f"{each}: {error}", flush=True)
            continue
        with options.results.open("a") as file:
            file.write(json.dumps(record) + "\n")
        print(table([record]).splitlines()[-1], flush=True)


if __name__ == "__main__":
    main()
