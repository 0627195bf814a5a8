"""Figures of a fitted body: every model variant on every sequence, as docs/figures.md defines them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any
from warnings import warn

import numpy as np
import torch
from torch import Tensor

from mosa.data.io.forces import curves_of, force_figures
from mosa.data.sequences import load_sequences
from mosa.errors import ConfigError, SimulationDiverged
from mosa.evaluation import metrics
from mosa.evaluation.analysis.anisotropy import stiffest_axis
from mosa.evaluation.analysis.stiffness import angle_between, stiffest
from mosa.evaluation.analysis.vibration import GROWTH_LIMIT, vibration_growth
from mosa.evaluation.settings import EvaluationSettings
from mosa.modules.body.body import Body, Start, World
from mosa.modules.body.material import material_states
from mosa.reconstruction.marker_body import cues_of_markers
from mosa.reconstruction.pose.starts import first_contact
from mosa.reconstruction.rest_shape import RestShape
from mosa.rendering.appearance.carried_splats import seen
from mosa.rendering.cameras import crop_boxes
from mosa.system.progress import tqdm
from mosa.system.threads import apart, threaded
from mosa.types import Rollout, Scene

SAME = 1e-6  # relative difference of stiffnesses that counts as none

PREFIX = {"adapted": "", "prior": "prior/", "prior_eta": "prior_eta/"}
NAMES = {"adapted": "the learned law", "prior": "the prior", "prior_eta": "the prior with eta"}


Boxes = tuple[Tensor, Tensor, int, int]
"""x0, y0 (V,), width and height [px] of a window in each of V cameras' images (`crop_boxes`)."""


@dataclass(frozen=True)
class Sequence:
    """A sequence to evaluate on. prefix: `train`, `train/<name>` or `test/<name>`; start: where the body starts; contact: first
    frame after first contact."""

    prefix: str
    scene: Scene
    start: Start
    contact: int

    @property
    def learned(self) -> bool:
        """Whether it is learned from."""
        return self.prefix.startswith("train")

    @property
    def frames(self) -> list[int]:
        """That are learned from, of a held-out sequence all."""
        return self.scene.training_frames if self.learned else list(range(self.scene.frames))

    @property
    def cameras(self) -> list[int]:
        """That are learned from, of a held-out sequence all."""
        return self.scene.training_cameras if self.learned else list(range(len(self.scene.cameras)))

    @cached_property
    def boxes(self) -> Boxes:
        """Of what the `cameras` see."""
        return boxes_of(self.scene, self.cameras)

    def to(self, device: torch.device | str) -> Sequence:
        """Itself, where Lightning moves a batch: the parts that are needed move later."""
        return self


def sequences(
    body: Body | RestShape, training: Scene, others: list[Scene], found: Mapping[str, Start]
) -> list[Sequence]:
    """found: start by prefix, in the order of the sequences."""
    pairs = zip(found.items(), [training, *others])
    return [Sequence(p, s, start, first_contact(body, start, s)) for (p, start), s in pairs]


def run_sequences(
    scene: Mapping[str, Any], starts: Mapping[str, Any], body: Body
) -> list[Sequence]:
    """The sequences that a run was evaluated on, read again. scene, starts: of its record. Errors: ConfigError, DataError."""
    found = {prefix: Start.read(written, body.rest) for prefix, written in starts.items()}
    return sequences(body, *load_sequences(scene), found)


@torch.no_grad()
def rollouts(
    body: Body, sequence: Sequence, world: World
) -> tuple[dict[str, Rollout], float | None, float]:
    """The rollout of every variant over all frames of `sequence`, mean |C| of the adapted one (None without an adapter), and the
    particle substeps per second of the last. A variant that cannot be simulated on it is left out, with a warning: on a training
    sequence too, which the fit has simulated near the observed motion, and without its held-out frames."""
    scene = sequence.scene
    sizes: list[float] = []
    result, rate = {}, 0.0
    for v in body.variants:
        began, counted = time.perf_counter(), len(sizes)
        try:
            collect = lambda found: sizes.append(float(found.mean_abs_C))  # noqa: E731
            how = {"model": body.model(v), "collect": collect}
            result[v] = body.simulate(sequence.start, world, scene.frames, scene.frame_dt, **how)
        except (SimulationDiverged, ConfigError) as error:
            del sizes[counted:]
            warn(
                f"{sequence.prefix}: {NAMES[v]} cannot be simulated there, its errors count as infinite ({error})",
                stacklevel=2,
            )
            continue
        if body.rest.is_cuda:
            torch.cuda.synchronize()
        rate = len(body.rest) * sum(result[v].counts) / (time.perf_counter() - began)
    return result, float(np.mean(sizes)) if sizes else None, rate


def render(
    body: Body, rollout: Rollout, scene: Scene, kept: int | None = 1
) -> Callable[[int], Tensor]:
    """Images (T, H, W, 3) of a rollout by camera, on the body's device: of its splats where it has some. kept: of how many cameras
    they stay in memory, None for all."""
    device = body.rest.device
    shown, background = seen(body, rollout.x, rollout.F_tot), scene.background.to(device)

    @lru_cache(kept)
    @torch.no_grad()
    def images(camera: int) -> Tensor:
        views = scene.cameras.select([camera]).to(device)
        return shown.images(views, background)[0].clamp_(0, 1)

    return images


def boxes_of(scene: Scene, cameras: list[int]) -> Boxes:
    """One box per camera: that of the true mattes over all frames plus 10 px."""
    return crop_boxes(scene.mattes[cameras], margin=10)


def image_metrics(
    images: Callable[[int], Tensor],
    scene: Scene,
    cameras: list[int],
    frames: list[int],
    boxes: Boxes,
) -> dict[str, float]:
    """PSNR and SSIM, in full and in `boxes_of` these cameras.

    images: (T, H, W, 3) by camera, all frames; where they lie is where they are compared."""
    if not frames:
        return {}
    x0, y0, width, height = boxes
    kinds = {"psnr": metrics.psnr, "ssim": metrics.ssim}
    kinds |= {own: partial(metric.of, own) for own, metric in metrics.IMAGE_METRICS.items()}
    found: dict[str, list[float]] = {
        f"{kind}_{name}": [] for name in ("crop", "full") for kind in kinds
    }
    for camera, x, y in zip(cameras, x0.tolist(), y0.tolist()):
        seen = images(camera)[frames]
        real = scene.images[camera][frames].to(seen.device)
        crop = (slice(None), slice(y, y + height), slice(x, x + width))
        for name, pair in (("crop", (seen[crop], real[crop])), ("full", (seen, real))):
            for kind, function in kinds.items():
                found[f"{kind}_{name}"].append(function(*pair))
    return {name: float(np.mean(values)) for name, values in found.items()}


def motion_metrics(
    x: Tensor,
    body: Body,
    sequence: Sequence,
    frames: list[int],
    settings: EvaluationSettings,
    target: Tensor | None = None,
) -> dict[str, float]:
    """rms_m, chamfer and earth mover's distance after first contact, where the true motion is known.

    target: `true_motion`, where it is at hand: it is the same for all models."""
    truth = sequence.scene.truth
    after = [t for t in frames if t >= sequence.contact]
    if not after:
        return {}
    if sequence.scene.markers is not None:
        away = cues_of_markers(sequence.scene, body.rest.cpu()).away(x)[after]
        return {"rms_m": float(away.square().sum(-1).mean().sqrt())}
    if truth is None:
        clouds = sequence.scene.particles
        if clouds is None:
            return {}
        pairs = [(x[t], clouds[t]) for t in after]
        result = {}
    else:
        target = true_motion(body, sequence.scene) if target is None else target
        result = {"rms_m": metrics.rms(x[after], target[after])}
        own = metrics.MOTION_METRICS.items()
        result |= {name: metric.of(name, x[after], target[after]) for name, metric in own}
        pairs = [(x[t], truth.positions[t]) for t in after]
    chamfer = partial(metrics.chamfer_distances, samples=settings.samples)
    each = list(threaded(lambda pair: chamfer(*pair), pairs))
    result |= {name: float(np.mean([found[name] for found in each])) for name in each[0]}
    emd, last = partial(metrics.emd, samples=settings.assignment), pairs[:: max(1, len(pairs) // 3)]
    return result | {"emd_m": float(np.mean(list(threaded(lambda pair: emd(*pair), last))))}


def true_motion(body: Body, scene: Scene) -> Tensor | None:
    """(T, N, 3) [m] where the body's particles would truly be, None where that is not known."""
    if (truth := scene.truth) is None:
        return None
    # a checkpoint's particles are written into the same tensor, which then counts another version
    version = 0 if body.rest.is_inference() else body.rest._version
    return _carried(truth.rest, truth.positions, body.rest, version)


@lru_cache(8)  # of the tensors themselves: the figures of a run ask five times
def _carried(rest: Tensor, positions: Tensor, query: Tensor, _version: int) -> Tensor:
    return metrics.interpolate_motion(rest, positions, query.cpu())


@torch.no_grad()
def evaluate(
    body: Body, sequences: list[Sequence], world: World, settings: EvaluationSettings
) -> tuple[dict[str, float], dict[str, dict[str, Rollout]]]:
    """All figures, flat, named as in docs/figures.md, and the rollouts that could be simulated: result[sequence prefix][variant].

    Errors: SimulationDiverged where none of them could be."""
    figures: dict[str, float] = {}
    measured, missing = set[str](), list[tuple[str, str]]()
    ran = list(apart(body, sequences, lambda own, each: rollouts(own, each, world)))
    kept = {each.prefix: simulated for each, (simulated, _, _) in zip(sequences, ran)}
    targets = {each.prefix: true_motion(body, each.scene) for each in sequences}

    def compared(own: Body, of: tuple[Sequence, str]) -> dict[str, float]:
        sequence, variant = of
        rollout, target = kept[sequence.prefix][variant], targets[sequence.prefix]
        return sequence_metrics(own, sequence, rollout, PREFIX[variant], settings, target)

    every = [(sequence, variant) for sequence in sequences for variant in kept[sequence.prefix]]
    found = apart(body, every, compared)
    bar = tqdm(found, "evaluate", len(every), unit="rollout", dynamic_ncols=True)
    of_each = {(each.prefix, variant): own for (each, variant), own in zip(every, bar)}
    for sequence, (simulated, size, _) in zip(sequences, ran):
        if size is not None:
            figures[f"{sequence.prefix}/mean_abs_C"] = size
        for variant in body.variants:
            model = PREFIX[variant]
            if variant in simulated:
                if world.forces and variant == "adapted":
                    scene, first = sequence.scene, sequence.prefix == "train"
                    curves = curves_of(world.forces, scene.sequence, first)
                    figures |= force_figures(simulated[variant], curves, world, scene.frame_dt)
                figures |= of_each[sequence.prefix, variant]
                measured |= {
                    key.rpartition("/")[2]
                    for key in figures
                    if key.startswith(f"{model}{sequence.prefix}/")
                }
            else:
                missing += [(model, part) for part in parts_of(sequence)]
    if not measured:
        raise SimulationDiverged(
            "evaluation: neither the law nor its prior can be simulated on any of these sequences: "
            f"{', '.join(s.prefix for s in sequences)}; the warnings above say why"
        )
    # all that held-out cameras tell
    of_pictures = {name for name in measured if name.endswith(("_crop", "_full"))}
    figures |= {f"{model}{part}/{name}": worst(name) for model, part in missing
                for name in (of_pictures if part == "camera" else measured - {"mean_abs_C"})}  # fmt: skip
    figures |= test_means(figures)
    rates = [rate for _, _, rate in ran]
    figures["time/particle_substeps_per_s"] = max(rates)  # the first rollouts also load kernels
    return figures, kept


def parts_of(sequence: Sequence) -> list[str]:
    """What its figures are of: the sequence, and of the first training sequence its held-out frames and cameras."""
    if sequence.prefix != "train":
        return [sequence.prefix]
    held = {"frames": sequence.scene.holdout_frames, "camera": sequence.scene.holdout_cameras}
    return [sequence.prefix, *(part for part, indices in held.items() if indices)]


def worst(name: str) -> float:
    """The figure of a rollout that there is not: no error so large and no picture so bad; of pictures compared by a metric that was
    registered, no number."""
    kind = name.split("_")[0]
    if kind in ("psnr", "ssim"):
        return -math.inf
    return math.nan if name.rsplit("_", 1)[0] in metrics.IMAGE_METRICS else math.inf


def sequence_metrics(
    body,
    sequence: Sequence,
    rollout: Rollout,
    model: str,
    settings: EvaluationSettings,
    target: Tensor | None,
) -> dict[str, float]:
    """The figures of one rollout: training views and frames, held-out frames, held-out cameras."""
    scene, x, parts, frames = sequence.scene, rollout.x.cpu(), parts_of(sequence), sequence.frames
    held = list(scene.holdout_cameras) if "camera" in parts else []
    images = render(body, rollout, scene, None if "frames" in parts else max(1, len(held)))

    def measured(part: str, frames: list[int]) -> dict[str, float]:
        figures = motion_metrics(x, body, sequence, frames, settings, target)
        if cameras := sequence.cameras:
            figures |= image_metrics(images, scene, cameras, frames, sequence.boxes)
        return {f"{model}{part}/{k}": v for k, v in figures.items()}

    result = measured(sequence.prefix, frames)
    if "frames" in parts:
        result |= measured("frames", list(scene.holdout_frames))
    if held:
        boxes = boxes_of(scene, held)
        figures = image_metrics(images, scene, held, frames, boxes)
        result |= {f"{model}camera/{k}": v for k, v in figures.items()}
        for t in frames:
            figures = image_metrics(images, scene, held, [t], boxes)
            where = f"{model}camera/frame_{t:02d}"
            result |= {f"{where}/{k}": figures[k] for k in ("psnr_crop", "ssim_crop")}
    return result


def test_means(figures: Mapping[str, float]) -> dict[str, float]:
    """`test/<metric>`: mean over the held-out sequences, for each model."""
    groups: dict[str, list[float]] = {}
    for key, value in figures.items():
        model, mark, rest = key.partition("test/")
        if mark and "/" in rest:
            groups.setdefault(f"{model}test/{rest.split('/', 1)[1]}", []).append(value)
    return {key: float(np.mean(values)) for key, values in groups.items()}


def floor_figures(
    body: Body, evaluated: list[Sequence], world: World, settings: EvaluationSettings
) -> dict[str, float]:
    """What no law can get below, to read the figures of a model against.

    `floor/<part>/...`: the true law on the learner's own grid and particles, on synthetic scenes, over the same frames and with as
    many points as the models. `floor/sampling/...`: two random samplings of the true shape, where true positions are known."""
    from mosa.evaluation.floor import floor_rollout

    figures, known = {}, [s for s in evaluated if s.scene.truth is not None]
    found = list(apart(body, known, lambda own, each: floor_rollout(own, each.scene, world)))
    for sequence, x in zip(known, found):
        result = motion_metrics(x, body, sequence, sequence.frames, settings)
        figures |= {f"floor/{sequence.prefix}/{k}": v for k, v in result.items()}
    figures |= test_means(figures)
    true = [s.scene.truth.rest for s in known]
    if clouds := true or [s.scene.particles[0] for s in evaluated if s.scene.particles]:
        sizes = {"samples": settings.samples, "assignment": settings.assignment}
        floors = metrics.sampling_floors(clouds[0], len(body.rest), len(clouds[0]), **sizes)
        figures |= {f"floor/sampling/{name}": value for name, value in floors.items()}
    return figures


def identification(body: Body, scene: Scene, world: World) -> dict[str, float]:
    """Identified parameters after calibration (`id_prior/`) and after the joint stage (`id/`), with errors where truth is known.
    world: with the contact that the fit found."""
    figures = {}
    for prefix, variant in (("id_prior", "prior"), ("id", "adapted")):
        model = body.model(variant)
        material, mean = model.material, float(body.factor(model.heterogeneity).detach().mean())
        for name, value in material.physical().items():
            found = float(value.detach()) * (mean if name in material.modulated else 1.0)
            figures[f"{prefix}/{name}"] = found
            if (true := scene.known_parameters.get(name)) is not None:
                errors = metrics.identification_errors(name, found, true)
                figures |= {f"{prefix}/{key}": value for key, value in errors.items()}
        height = model.contact.height(world.ground, body.settings.dx)
        figures[f"{prefix}/contact_offset_m"] = float(height.detach())
    if body.contact.at_limit(world.ground, body.settings.dx):
        figures["id/contact_at_limit"] = 1.0
    return figures


def hidden_figures(body: Body, scene: Scene, figures: Mapping[str, float]) -> dict[str, float]:
    """What was learned beside the hidden material of a built-in scene: `id/fibre_angle_deg` between the stiffest direction found
    (of `law_figures`) and the fibres, where both laws are anisotropic, and
    `id/stiffness_correlation` of the stiffness over the particles, where the truth has it."""
    if scene.truth is None or not scene.synthetic:
        return {}
    from mosa.evaluation.floor import hidden_of

    hidden, found = hidden_of(scene), {}
    fibre = getattr(hidden, "fibre", None)
    axis = [figures.get(f"id/stiffest_{name}") for name in "xyz"]
    ratios = getattr(hidden, "ratio", 1), figures.get("id/stiffness_ratio", 1)
    if fibre is not None and min(ratios) > 1 + SAME and None not in axis:
        found["id/fibre_angle_deg"] = float(angle_between(torch.tensor(axis), torch.tensor(fibre)))
    learned = body.factor(body.model().heterogeneity).detach().cpu()
    true = hidden.factor(body.rest.cpu().float())
    if float(true.std()) > 1e-6 and float(learned.std()) > 1e-6:
        both = torch.stack([true, learned.float()])
        found["id/stiffness_correlation"] = float(torch.corrcoef(both)[0, 1])
    return found


def law_figures(body: Body) -> dict[str, float]:
    """What the learned law is like by itself: its stiffest direction; whether one without an energy makes some (with a warning)."""
    adapter, material = body.adapter, body.material
    if adapter is None or not adapter.is_on or adapter.own_dynamics:  # which brings no law
        return {}
    figures = {}
    adapter.follow(material.poisson())
    if not adapter.energetic:  # a law that has an energy makes none
        run = {"stride": body.settings.stride, "law_options": body.law_options}
        growth = vibration_growth(material, adapter, density=body.density, **run)
        figures["id/growth_per_period"] = growth
        if growth > GROWTH_LIMIT:
            warn(
                f"the learned law creates energy: a freely vibrating block grows by a factor of {growth:.3g} in a period; the law "
                "of adapter=operator has an energy and cannot", stacklevel=2,
            )  # fmt: skip
    if (stiffness := adapter.stiffness()) is not None:
        axis, ratio = stiffest(stiffness.detach().cpu())
        figures["id/stiffness_ratio"] = float(ratio)
        return figures | {f"id/stiffest_{name}": float(value) for name, value in zip("xyz", axis)}
    if "E" in material.physical():
        states = material_states(material.law, material.per_particle(), body.law_options)
        try:
            axis, figures["id/stiffness_ratio"] = stiffest_axis(states, adapter)
        except SimulationDiverged:  # a law without a tensile modulus
            return figures
        figures |= {f"id/stiffest_{name}": float(value) for name, value in zip("xyz", axis)}
    return figures
