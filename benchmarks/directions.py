"""What directions a drop determines: the law of a body with fibres, and of its twin without, from true motions.

    python benchmarks/directions.py make --out motions cylinder mandarin mandarin_twin        # a minute each on a CPU
    python benchmarks/directions.py fit motions/cylinder.npz --particles 1500 --plates --results fits.jsonl
    python benchmarks/directions.py table fits.jsonl
    python benchmarks/directions.py draw fits.jsonl --out docs/results

`make` simulates the training drop of a built-in body on a fine grid. `fit` fills the shape with other and fewer particles,
carries them along the true motion and adds an error to every frame (`calibration.noisy`). It calibrates the isotropic prior,
then learns the directions as the last stage of a run does (`adapter=operator`; `--black-box`: `adapter=direct` by Adam).
`--plates` presses specimens of the true, the isotropic and the learned law between two plates, over half a turn
(`mosa.evaluation.analysis.compression`). `--own-grid` learns from the true law's motion on the learner's own particles and grid,
so that the grid causes no error. `--drops train test_60` learns from several drops. `draw` writes the figure and this page.
"""

from __future__ import annotations

import json
import textwrap
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import calibration
import fits
import numpy as np
import torch
from matplotlib.figure import Figure as Canvas
from torch import Tensor

import mosa
from mosa.data.synthetic.bodies.objects import BuiltinObject, object_named
from mosa.data.synthetic.materials.hidden_material import HiddenMaterial
from mosa.evaluation.analysis.anisotropy import directions_in_plane
from mosa.evaluation.analysis.compression import Pressed, press
from mosa.evaluation.analysis.stiffness import angle_between, stiffest
from mosa.evaluation.analysis.tables import markdown
from mosa.evaluation.floor import floor_rollout
from mosa.evaluation.uncertainty import determined
from mosa.experiments.analyses import learned_modulus, redistribution, true_modulus
from mosa.experiments.commits import commit
from mosa.experiments.report.drawing import save
from mosa.experiments.specimens import force_at, pressed_modulus
from mosa.modules.body.body import Body, Start
from mosa.modules.fitting.training_sequences import Take
from mosa.reconstruction.motion.cues import neighbourhood, neighbourhood_cues
from mosa.training.lit_mosa import LitMosa
from mosa.training.run_folder import device_label

TWIN = "_twin"
"""At the end of a name: the same body without fibres and with one stiffness everywhere."""
PLATES = 13
"""Directions that a specimen is pressed in, over half a turn."""
STRAIN = 0.04
"""At which the plates' forces are compared."""


def object_of(name: str) -> BuiltinObject:
    body = object_named(name.removesuffix(TWIN))
    return replace(body, material=body.material.isotropic()) if name.endswith(TWIN) else body


def motion_of(path: Path, drop: str) -> Path:
    """Where the motion of a drop lies beside the training drop's `path`."""
    return path if drop == "train" else path.with_stem(f"{path.stem}_{drop}")


def make(name: str, folder: Path, seed: int, drops: list[str]) -> None:
    body = object_of(name)
    for drop in drops:
        calibration.keep(motion_of(folder / f"{name}.npz", drop), body, body.material, seed, drop)


def further(case: SimpleNamespace, path: Path, noise: float, rng: np.random.Generator) -> Take:
    """Another drop of the same body, stored at `path`, with errors of the motion of its own."""
    stored, body = np.load(path), case.body
    tensor = lambda a: torch.as_tensor(a, dtype=torch.float32, device=body.rest.device)  # noqa: E731
    rest = body.rest.cpu().double().numpy()
    truth = calibration.carried(stored, rest, case.object.spacing)
    seen = tensor(calibration.noisy(truth, rest, noise * np.ptp(rest[:, 1]), rng))
    start = Start(
        tensor(stored["rotation"]),
        tensor(truth[0].mean(0)),
        tensor(stored["velocity"]),
        torch.zeros(3).to(body.rest),
    )
    cues = neighbourhood_cues(
        seen, body.rest.new_zeros(1), neighbourhood(tensor(truth[0]))
    )  # their rotations are from frame 0 on
    spacing = float(body.volume.mean()) ** (1 / 3)
    return Take(start, None, cues, case.take.frame_dt, calibration.first_contact(truth, spacing))


def in_plane(material: HiddenMaterial, count: int) -> tuple[Tensor, Tensor]:
    """Angles (K,) [rad] from the fibre and unit vectors (K, 3), in its plane with the axis that it is furthest from."""
    fibre = torch.tensor(material.fibre).double()
    across = torch.eye(3).double()[int(fibre.abs().argmin())]
    return directions_in_plane(fibre.tolist(), across.tolist(), count)


def pressed_truth(material: HiddenMaterial, directions: Tensor) -> list[Pressed]:
    """A specimen of the true law, without its variation over the body."""
    one = {
        key: value[0]
        for key, value in replace(material, amplitude=0.0).parameters(torch.zeros(1, 3)).items()
    }
    return [press(material.law, one, n, modulus=material.wave_modulus(), poisson=material.known["nu"], density=material.density,
                  stiffening=1.0) for n in directions]  # fmt: skip


def compared(found: list[Pressed], true: list[Pressed]) -> dict:
    """Young's moduli [Pa], and the largest relative error of them and of the forces."""
    E = [each.modulus for each in found]
    off = [abs(a.modulus / b.modulus - 1) for a, b in zip(found, true)]
    forces = [abs(force_at(a, STRAIN) / force_at(b, STRAIN) - 1) for a, b in zip(found, true)]
    return {
        "E": E,
        "E_off_mean": sum(off) / len(off),
        "E_off_largest": max(off),
        "force_off_largest": max(forces),
    }


def level_and_shape(found: Tensor, true: Tensor) -> dict[str, float]:
    """Of moduli over the angle, (K,) each: by how much they are off, and that error taken apart: the geometric mean of found over
    true, and by how much what is found is off when it is divided by that. Too coarse a grid makes a law stiffer all over."""
    ratio = found / true
    level = float(ratio.log().mean().exp())
    off, shape = (ratio - 1).abs(), (ratio / level - 1).abs()
    return {"E_off_mean": float(off.mean()), "E_off_largest": float(off.max()), "E_level": level,
            "E_shape_off_mean": float(shape.mean()), "E_shape_off_largest": float(shape.max())}  # fmt: skip


def true_law_here(case: SimpleNamespace, path: Path) -> Tensor:
    """(T, N, 3) [m], where the true law takes the learner's particles on the learner's grid, from its contact height."""
    stored = np.load(path)
    tensor = lambda a: torch.as_tensor(a, dtype=torch.float32)  # noqa: E731
    truth = SimpleNamespace(rest=tensor(stored["rest"]), positions=tensor(stored["positions"]), velocity=tensor(stored["velocity"]),
                            rotation=torch.eye(3), parameters={"ratio": case.object.material.ratio})  # fmt: skip
    frames = len(case.truth)
    scene = SimpleNamespace(name=path.stem.removesuffix(TWIN), synthetic=True, truth=truth, frames=frames,
                            frame_dt=case.take.frame_dt)  # fmt: skip
    return floor_rollout(case.body, scene, case.world).to(case.truth)


def on_own_grid(case: SimpleNamespace, path: Path, noise: float, seed: int) -> None:
    """Learn from where the true law goes on the learner's grid, in place of where it went on its own."""
    case.truth = true_law_here(case, path)
    rest = case.body.rest
    true, points = case.truth.cpu().double().numpy(), rest.cpu().double().numpy()
    seen = calibration.noisy(
        true, points, noise * np.ptp(points[:, 1]), np.random.default_rng([seed, 12])
    )
    cues = neighbourhood_cues(
        torch.as_tensor(seen).to(rest), rest.new_zeros(1), neighbourhood(rest)
    )
    case.take = Take(case.take.start, None, cues, case.take.frame_dt, case.take.first_contact)


class NoImages:
    """In place of a take's observations, where no loss term asks for images."""

    cameras = (None,)

    def select(self, views: list[int], frames: int) -> None:
        return None


def learn_black_box(module: LitMosa, body: Body) -> None:
    """The joint stage of a run by Adam, on positions, rotations and stretches."""
    module.takes = [replace(take, observations=NoImages()) for take in module.takes]
    stage = module.stages[-1]
    module.stage_index = len(module.stages) - 1
    module.begin(stage)
    module.weights = {
        name: value
        for name, value in module.weights.items()
        if name not in ("image", "mask", "flow")
    }
    made = module.adam(stage)
    optimizer, schedule = made["optimizer"], made["lr_scheduler"]["scheduler"]
    for iteration in range(stage.iterations):
        optimizer.zero_grad()
        take = module.takes[iteration % len(module.takes)]
        for gain in module.criterion.gains:
            terms, _ = module.terms(
                stage,
                SimpleNamespace(observations=take.observations, views=(), extra={}),
                module.active_frames(stage, iteration, take),
                take,
                gain=gain,
            )
            (
                sum(module.weights[name] * value for name, value in terms.items())
                / len(module.criterion.gains)
            ).backward()
        module.clip_networks(optimizer)
        optimizer.step()
        schedule.step()
        body.contact.project()


def fit(
    path: Path, particles: int, more: list[str], seed: int, noise: float, device: str, plates: bool, black_box: bool,
    own_grid: bool, drops: list[str],
) -> dict:  # fmt: skip
    """Of one body: calibration, joint stage, and what its laws are, along the directions of a plane."""
    began, truth = time.perf_counter(), object_of(path.stem)
    words = [
        f"scene={path.stem.removesuffix(TWIN)}",
        "prior=neo_hookean",
        *(["adapter=direct"] if black_box else []),
        *more,
    ]
    case = calibration.learner_of(
        path, truth, calibration.composed(words), particles, seed, noise, device
    )
    if own_grid:
        on_own_grid(case, path, noise, seed)
    body, take = case.body, case.take
    takes = [take, *(further(case, motion_of(path, drop), noise, np.random.default_rng([seed, 12, i]))
                     for i, drop in enumerate(drops) if drop != "train")]  # fmt: skip
    module = LitMosa.from_record(
        case.record, body, takes=takes, background=torch.ones(3, device=device)
    )
    calibrated = module.identifying(module.stages[0])
    calibrated.search()
    fits.iterated(calibrated, module.stages[0].iterations)
    body.freeze("prior")
    print(f"  {path.stem}: calibrated after {time.perf_counter() - began:.0f} s", flush=True)

    def rms_mm(x: Tensor) -> float:
        return 1e3 * float((x - case.truth)[take.first_contact :].square().sum(-1).mean().sqrt())

    @torch.no_grad()
    def away() -> float:
        return rms_mm(body.simulate(take.start, case.world, len(case.truth), take.frame_dt).x)

    prior_mm, floor_mm, posterior = away(), rms_mm(true_law_here(case, path)), None
    if black_box:
        learn_black_box(module, body)
    else:
        body.adapter.switch_on(body.material.reference_modulus(), body.material.poisson())
        joint = module.identifying(module.stages[-1])
        fits.iterated(joint, module.stages[-1].iterations)
        posterior = joint.posterior()
    learned_mm, body = away(), body.cpu()
    print(f"  {path.stem}: learned after {time.perf_counter() - began:.0f} s", flush=True)
    angles, n = in_plane(truth.material, 37)
    true, learned, w = true_modulus(path.stem.removesuffix(TWIN), "isotropic" if path.stem.endswith(TWIN) else "anisotropic", n), \
        learned_modulus(body, n).detach(), redistribution(body, n)  # fmt: skip
    record = {
        "body": path.stem, "method": "black box" if black_box else "ours", "set": more, "particles": len(body.rest), "seed": seed,
        "noise": noise, "own_grid": own_grid, "drops": drops, "cells": float(np.ptp(body.rest[:, 1])) / body.settings.dx,
        "prior_mm": prior_mm, "learned_mm": learned_mm, "floor_mm": floor_mm, "degrees": torch.rad2deg(angles).tolist(),
        "E_along": learned.tolist(), "true_E_along": true.tolist(), "w": w.detach().tolist(), "w_range": float(w.max() - w.min()),
        "fibre_deg": None, "cone_deg": None,
    } | level_and_shape(learned, true)  # fmt: skip
    record |= {name: float(value.detach()) for name, value in body.material.physical().items()}
    if not black_box:
        body.adapter.follow(body.material.poisson())
        axis, ratio = stiffest(body.adapter.stiffness().detach().cpu())
        record["stiffness_ratio"] = float(ratio)
        record["cone_deg"] = determined(body, posterior)["posterior/stiffest_cone_deg"]
        if truth.material.ratio > 1:
            record["fibre_deg"] = float(angle_between(axis, torch.tensor(truth.material.fibre)))
    if plates:
        angles, n = in_plane(truth.material, PLATES)
        reference = pressed_truth(truth.material, n)
        record["plates"] = {"degrees": torch.rad2deg(angles).tolist(), "true": compared(reference, reference)["E"],
                            "prior": compared(pressed_modulus(body, "prior", n), reference),
                            "learned": compared(pressed_modulus(body, "adapted", n), reference)}  # fmt: skip
    return record | {
        "seconds": time.perf_counter() - began,
        "commit": commit(),
        "machine": device_label(device),
    }


HEADS = ("body", "law", "set", "drops", "particles", "cells of height", "noise [%]", "rms [mm]", "floor [mm]",
         "largest less smallest w", "stiffest over softest", "stiffest from the fibre [degrees]", "95 % cone [degrees]",
         "time [s]")  # fmt: skip
MODULI = (*HEADS[:5], "E off, mean [%]", "E off, largest [%]", "level of E over the true one", "shape of E off, mean [%]",
          "shape of E off, largest [%]", "E between plates off, mean [%]", "E between plates off, largest [%]",
          "force off, largest [%]")  # fmt: skip


def settings(record: dict) -> str:
    """Overrides that the law was learned with, but for those that change no figure."""
    return " ".join(
        word for word in record["set"] if not word.startswith("identification.threads=")
    )


def shown(value: float | None, digits: int, scale: float = 1.0) -> str:
    return "" if value is None else f"{scale * value:.{digits}f}"


def off(plates: dict | None) -> list[str]:
    """Of one law's specimens from the true one's."""
    names = ("E_off_mean", "E_off_largest", "force_off_largest")
    return [""] * 3 if plates is None else [shown(plates[name], 1, 100) for name in names]


def table(records: list[dict]) -> str:
    """Motion and directions of every law, and below them its moduli over the directions."""
    found, moduli = [], []
    for r in records:
        plates = r.get("plates") or {}
        where = [settings(r), len(r["drops"]), r["particles"]]
        on = [shown(r["cells"], 1), shown(r["noise"], 1, 100) + ", own grid" * r["own_grid"]]
        floor = shown(r["floor_mm"], 1)
        prior, own = [r["body"], "isotropic", *where], [r["body"], r["method"], *where]
        directions = [shown(r["w_range"], 3), shown(r.get("stiffness_ratio"), 3), shown(r["fibre_deg"], 0), shown(r["cone_deg"], 0),
                      shown(r["seconds"], 0)]  # fmt: skip
        found += [[*prior, *on, shown(r["prior_mm"], 1), floor, *[""] * 5],
                  [*own, *on, shown(r["learned_mm"], 1), floor, *directions]]  # fmt: skip
        E = [
            shown(r[f"E_{name}"], 1, 100)
            for name in ("off_mean", "off_largest", "shape_off_mean", "shape_off_largest")
        ]
        moduli += [[*prior, *[""] * 5, *off(plates.get("prior"))],
                   [*own, *E[:2], shown(r["E_level"], 3), *E[2:], *off(plates.get("learned"))]]  # fmt: skip
    return "\n\n".join(
        markdown(heads, [row for i, row in enumerate(rows) if row not in rows[:i]])
        for heads, rows in ((HEADS, found), (MODULI, moduli))
    )


def claim(records: list[dict]) -> str:
    off = max(r["fibre_deg"] for r in records if r["fibre_deg"] is not None)
    return (
        f"**The stiffest learned direction is off by {off:.0f} degrees at most, and E over the directions by "
        f"{100 * max(r['E_off_mean'] for r in records):.1f} % on average at most.** "
        "The floor is the true law on the learner's grid."
    )


def draw(records: list[dict], folder: Path) -> None:
    """directions_from_motion.png, .md and .json: E(theta), between plates where specimens were pressed, and w(theta)."""
    names = list(dict.fromkeys(r["body"] for r in records))
    canvas = Canvas(figsize=(1.5 + 3.6 * len(names), 6.0), layout="constrained")
    grid = canvas.subplots(2, len(names), squeeze=False)
    top = max(0.05, max(max(r["w"]) for r in records))
    for column, name in enumerate(names):
        above, below = grid[:, column]
        own = [r for r in records if r["body"] == name]
        for r in own:
            plates, same = r.get("plates"), [s for s in own if s["method"] == r["method"]]
            degrees = plates["degrees"] if plates else r["degrees"]
            label = r["method"] + (
                f", {r['particles']} particles" if len({s["particles"] for s in same}) > 1 else ""
            )
            label += f", {len(r['drops'])} drops" if len(r["drops"]) > 1 else ""
            label += f"\n{textwrap.fill(settings(r), 30)}" if settings(r) else ""
            if not above.lines:
                above.plot(
                    degrees,
                    [e / 1e3 for e in (plates["true"] if plates else r["true_E_along"])],
                    "k--",
                    label="truth",
                )
                if plates:
                    above.plot(degrees, [e / 1e3 for e in plates["prior"]["E"]], label="isotropic")
            (line,) = above.plot(
                degrees,
                [e / 1e3 for e in (plates["learned"]["E"] if plates else r["E_along"])],
                label=label,
            )
            below.plot(r["degrees"], r["w"], label=label, color=line.get_color())
            above.set_ylabel("E between plates [kPa]" if plates else "E [kPa]")
        above.set_ylim(0, 1.05 * above.get_ylim()[1])
        above.set_title(name.replace(TWIN, ", isotropic twin"), fontsize=10)
        below.set_ylim(0, 1.05 * top)
        below.set_ylabel("w")
        below.set_xlabel("angle from the fibre [degrees]")
        under = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.18), "ncols": 2, "fontsize": 8}
        below.legend(*above.get_legend_handles_labels(), **under)
    folder.mkdir(parents=True, exist_ok=True)
    stem = folder / "directions_from_motion"
    picture = save(canvas, stem)
    stem.with_suffix(".json").write_text(json.dumps(records, indent=1))
    commits, machines, seeds = (
        ", ".join(sorted({str(r[key]) for r in records})) for key in ("commit", "machine", "seed")
    )
    stem.with_suffix(".md").write_text("\n".join([
        "# Directions from true motions", "", claim(records), "", __doc__.split("\n\n")[2].strip(), "", table(records), "",
        f"![E and w over the angle from the fibre]({picture.name})", "",
        "- command: `python benchmarks/directions.py make`, `fit --plates` (`--black-box`, `--own-grid`) and `draw`",
        f"- version {mosa.__version__}, commit {commits}",
        f"- seed {seeds}; noise: error of the motion over the body's height; {machines}", ""]))  # fmt: skip


def main() -> None:
    parser = fits.parser_of(
        __doc__,
        "names of built-in bodies with fibres, _twin behind those without",
        "motions",
        pictures=True,
    )
    calibration.add_options(parser)
    parser.add_argument(
        "--plates", action="store_true", help="fit: press specimens between plates too"
    )
    parser.add_argument(
        "--black-box", action="store_true", help="fit: adapter=direct in place of ours"
    )
    parser.add_argument(
        "--own-grid",
        action="store_true",
        help="fit: the true law's motion on the learner's particles and grid",
    )
    parser.set_defaults(particles=4000)
    parser.add_argument(
        "--drops",
        nargs="+",
        default=["train"],
        help="make, fit: drops to learn from, train among them",
    )
    options = parser.parse_args()
    if "train" not in options.drops or (options.own_grid and len(options.drops) > 1):
        parser.error("--drops: expected train among them, and train alone with --own-grid")
    given = (
        options.particles,
        options.set,
        options.seed,
        options.noise,
        options.device,
        options.plates,
        options.black_box,
        options.own_grid,
        options.drops,
    )
    fits.run(options, lambda name: make(name, options.out, options.seed, options.drops), lambda path: fit(path, *given),
             table, draw)  # fmt: skip


if __name__ == "__main__":
    main()
