"""The identification by itself: cues of many scenes once, then fits of them by the dozen, without images.

    python benchmarks/identification.py make --out problems --device cuda scene=rabbit "scene=gorilla scene.material=isotropic"
    python benchmarks/identification.py fit problems/*.pt --device cuda --results fits.jsonl [--set identification.count=60 ...]
    python benchmarks/identification.py table fits.jsonl

`make` films, reconstructs, finds the starts and the cues about the calibrated backbone's motion, as a run does, and keeps what a
fit reads in one file of a few MB, with the truth for the figures; of several drops with scene.also_train. `fit` calibrates the
prior and runs the joint stage on it: a few seconds each on a GPU, minutes on a CPU. Figures are held-out errors after first
contact, in mm, at 2000 particles; of all drops where none is held out.
docs/lab/2026-11-identification.md has tables that were made so.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from types import SimpleNamespace

import fits
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import Tensor

from mosa.config.build import build_body, plain, world_of
from mosa.config.record import BodyRecord
from mosa.evaluation.analysis.stiffness import angle_between, stiffest
from mosa.evaluation.evaluate import true_motion
from mosa.evaluation.floor import floor_rollout, hidden_of
from mosa.evaluation.uncertainty import (
    DRAWS,
    LEAST_DRAWS,
    among_forms,
    determined,
    motions_under,
    total_spread,
)
from mosa.modules.body.body import Start
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.residuals import sampled
from mosa.modules.fitting.training_sequences import Take
from mosa.reconstruction.motion.response import Response
from mosa.training.datamodule import SceneDataModule
from mosa.training.lit_mosa import LitMosa
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
    """The problem of one scene, with cues of every sequence that it is learned from (scene.also_train)."""
    cfg = configuration(overrides)
    data, module = SceneDataModule(cfg, device=device), LitMosa(plain(cfg))
    module.attach(data)
    scene, body = data.scene, module.body
    chosen = sampled(len(body.rest), torch.device("cpu"))
    # of the contact height that a run starts from, which a calibration under the wrong law may leave
    floors = {
        each.prefix: floor_rollout(body, each.scene, world_of(data.measured))[:, chosen].cpu()
        for each in data.sequences
    }
    # as a run does before its joint stage: the cues once more, about the calibrated backbone's motion
    calibration = module.identifying(module.stages[0])
    calibration.search()
    fits.iterated(calibration, module.stages[0].iterations)
    module.inform()
    sequences, hidden = {}, hidden_of(scene)
    takes = iter(module.takes)  # the sequences that are learned from come first, in their order
    for each in data.sequences:
        s = each.scene
        sequences[each.prefix] = {
            "start": each.start.written(), "contact": each.contact, "frames": s.frames,
            "frame_dt": s.frame_dt, "truth": true_motion(body, s)[:, chosen].cpu(),
            "floor": floors[each.prefix], "cues": None, "response": None,
        }  # fmt: skip
        if each.prefix.startswith("train"):
            take, T = next(takes), len(s.training_frames)
            sequences[each.prefix]["cues"] = {
                name: getattr(take.cues, name)[:T].cpu()
                for name in ("positions", "rotation", "stretch", "weight")
            }
            sequences[each.prefix]["response"] = take.response and {
                part.name: getattr(take.response, part.name).cpu()
                for part in dataclasses.fields(Response)
            }
    problem = {
        "record": data.measured.plain(), "rest": body.rest.cpu(), "volume": body.volume.cpu(), "sequences": sequences,
        "fibre": getattr(hidden, "fibre", None) if getattr(hidden, "ratio", 1) > 1 else None,
        "factor": hidden.factor(body.rest.cpu().float()),
    }  # fmt: skip
    name = scene.name + ("_twin" if cfg.scene.get("material") == "isotropic" else "")
    name += f"_{len(module.takes)}drops" * (len(module.takes) > 1) + f"_seed{cfg.seed}" * (
        cfg.seed != 0
    )
    path = folder / f"{name}_{len(body.rest)}.pt"
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(problem, path)
    for (prefix, s), each in zip(sequences.items(), data.sequences):
        laid = (body.rest - body.center) @ each.start.rotation.T + each.start.center
        print(
            f"{path}: start of {prefix} off by {rms_mm(laid[chosen].cpu() - s['truth'][0]):.2f} mm",
            flush=True,
        )
        if s["cues"] is not None:
            seen, contact = s["cues"]["positions"][:, chosen], s["contact"]
            off = rms_mm((seen - s["truth"][: len(seen)])[contact:])
            print(
                f"{path}: {len(body.rest)} particles, cues of {prefix} off by {off:.2f} mm after contact",
                flush=True,
            )
    return path


def read(path: Path, overrides: list[str], device: str) -> SimpleNamespace:
    """The module that fits the body of a problem with the law and the settings of `overrides`, and its sequences."""
    problem = torch.load(path, weights_only=True)
    cfg = OmegaConf.to_container(configuration(overrides), resolve=True)
    record = BodyRecord.read(problem["record"])
    record = record.but(settings=record.settings | {name: cfg[name] for name in LAW})
    n = len(problem["rest"])
    tensors = {"rest": problem["rest"], "volume": problem["volume"], "colors": torch.zeros(n, 3), "opacities": torch.ones(n),
               "covariances": torch.eye(3).expand(n, 3, 3).clone()}  # fmt: skip
    body = build_body(record, tensors).to(device)
    takes = []
    for own in problem["sequences"].values():
        own["start"] = Start.read(own["start"], body.rest)
        if own["cues"] is not None:  # without images
            cues = {k: v.float().to(device) for k, v in own["cues"].items()}
            kept = own.get("response")
            takes.append(
                Take(
                    own["start"],
                    None,
                    MotionCues(**cues, covariances=torch.zeros(1, device=device)),
                    own["frame_dt"],
                    own["contact"],
                    response=kept and Response(**{k: v.to(device) for k, v in kept.items()}),
                )
            )
    module = LitMosa.from_record(record, body, takes=takes, background=torch.ones(3, device=device))
    return SimpleNamespace(problem=problem, module=module, body=body)


@torch.no_grad()
def motions(case: SimpleNamespace, **switches: bool) -> dict[str, Tensor]:
    """(T, M, 3) [m] of the particles that are compared, by sequence."""
    chosen, model = (
        sampled(len(case.body.rest), torch.device("cpu")),
        case.body.model().only(**switches),
    )
    return {
        prefix: case.body.simulate(
            s["start"], case.module.world, s["frames"], s["frame_dt"], model=model
        )
        .x[:, chosen]
        .cpu()
        for prefix, s in case.problem["sequences"].items()
    }


def errors(case: SimpleNamespace, found: dict[str, Tensor]) -> dict[str, float]:
    """By sequence, [mm]."""
    sequences = case.problem["sequences"]
    return {
        prefix: rms_mm((x - sequences[prefix]["truth"])[sequences[prefix]["contact"] :])
        for prefix, x in found.items()
    }


def held_out(by_sequence: dict[str, float]) -> float:
    """Mean over the sequences that were not learned from; over all where none is left."""
    tests = [value for prefix, value in by_sequence.items() if prefix.startswith("test")] or list(
        by_sequence.values()
    )
    return sum(tests) / len(tests)


def coverage(case: SimpleNamespace, found: dict[str, Tensor], posterior: Posterior) -> float | None:
    """Share of held-out particle errors after contact within two predicted standard deviations, as `predicted_spread` has them;
    None without held-out sequences or draws that can be simulated."""
    predicted = lambda body: motions(SimpleNamespace(**vars(case) | {"body": body}))  # noqa: E731
    law, rivals = case.body.material.law, list(posterior.rivals.items())
    laws = [(law, n) for n in posterior.draws(DRAWS, torch.Generator().manual_seed(0))]
    drawn = motions_under(case.body, laws, predicted)
    others, within = motions_under(case.body, rivals, predicted), []
    for prefix in (name for name in found if name.startswith("test") and len(drawn) >= LEAST_DRAWS):
        s = case.problem["sequences"][prefix]
        sd = total_spread(torch.stack([x[prefix] for x in drawn]), posterior.model_error,
                          among_forms(found[prefix], [x[prefix] for x in others]))  # fmt: skip
        within.append(
            ((found[prefix] - s["truth"]).norm(dim=-1) <= 2 * sd)[s["contact"] :].double().mean()
        )
    return float(sum(within) / len(within)) if within else None


def identified(path: Path, overrides: list[str], device: str) -> SimpleNamespace:
    """A problem after its calibration and its joint stage; what the calibrated prior predicts, and the iterations taken."""
    case = read(path, overrides, device)
    module, body = case.module, case.body
    calibration = module.identifying(module.stages[0])
    calibration.search()
    fits.iterated(calibration, module.stages[0].iterations)
    case.prior = motions(case, heterogeneity=False, adapter=False)
    body.adapter.switch_on(body.material.reference_modulus(), body.material.poisson())
    case.joint = module.identifying(module.stages[-1])
    case.iterations = fits.iterated(case.joint, module.stages[-1].iterations)
    return case


def fit(path: Path, overrides: list[str], device: str) -> dict:
    """Calibration and joint stage; the figures of both."""
    began = time.perf_counter()
    return figures(identified(path, overrides, device)) | {
        "problem": path.stem,
        "set": overrides,
        "seconds": time.perf_counter() - began,
    }


def figures(case: SimpleNamespace) -> dict:
    """Of an identified problem."""
    body, posterior, found = case.body, case.joint.posterior(), motions(case)
    prior, learned = errors(case, case.prior), errors(case, found)
    floor = errors(case, {prefix: s["floor"] for prefix, s in case.problem["sequences"].items()})
    body.adapter.follow(body.material.poisson())
    axis, ratio = stiffest(body.adapter.stiffness().detach().cpu())
    fibre, factor, true = (
        case.problem["fibre"],
        body.factor(body.heterogeneity).detach().cpu(),
        case.problem["factor"],
    )
    varies = float(true.std()) > 1e-6 and float(factor.std()) > 1e-6
    return {
        "prior_mm": held_out(prior), "learned_mm": held_out(learned),
        "ratio": held_out(learned) / held_out(prior), "each_mm": learned, "prior_each_mm": prior, "floor_mm": held_out(floor),
        "stiffness_ratio": float(ratio), "mean_abs_C": float(body.adapter.statistics().mean_abs_C.detach()),
        "fibre_deg": None if fibre is None else float(angle_between(axis, torch.tensor(fibre))),
        "cone_deg": determined(body, posterior)["posterior/stiffest_cone_deg"], "coverage": coverage(case, found, posterior),
        "eta": float(torch.corrcoef(torch.stack([factor.float(), true]))[0, 1]) if varies else None,
        "grid": case.joint.grid_share(), "iterations": case.iterations,
    } | {name: float(value.detach()) for name, value in body.material.physical().items()}  # fmt: skip


def table(records: list[dict]) -> str:
    heads = ("problem", "set", "prior mm", "learned mm", "ratio", "floor mm", "stiffness ratio", "fibre deg", "cone deg",
             "coverage", "mean abs C", "eta", "grid", "s")  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for r in sorted(records, key=lambda r: (r["set"], r["problem"])):

        def shown(name: str, digits: int, r=r) -> str:
            return "" if r[name] is None else f"{r[name]:.{digits}f}"

        lines.append(f"| {r['problem']} | {' '.join(r['set'])} | " + " | ".join(
            shown(name, digits) for name, digits in (
                ("prior_mm", 1), ("learned_mm", 1), ("ratio", 2), ("floor_mm", 1), ("stiffness_ratio", 2), ("fibre_deg", 0),
                ("cone_deg", 0), ("coverage", 2), ("mean_abs_C", 3), ("eta", 2), ("grid", 2), ("seconds", 0))) + " |")  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = fits.parser_of(__doc__, "overrides of one scene each, in quotes", "problems")
    parser.set_defaults(set=["prior=neo_hookean"])
    options = parser.parse_args()
    fits.run(
        options,
        lambda words: make(words.split(), options.out, options.device),
        lambda path: fit(path, options.set, options.device),
        table,
    )


if __name__ == "__main__":
    main()
