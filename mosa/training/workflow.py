"""The way of a run: scene -> reconstruction -> starts -> fit -> figures, rollouts, video. Stages are cached or resumable."""

from __future__ import annotations

import logging
import time
import warnings
from contextlib import contextmanager
from dataclasses import replace

import lightning as L
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import LambdaCallback
from omegaconf import DictConfig, OmegaConf

from mosa import __version__
from mosa.config.build import measured, plain, world_of
from mosa.config.checkpoints import check_same_data
from mosa.config.command_settings import SimulateSection
from mosa.config.composition import with_defaults
from mosa.config.extensions import load_extensions
from mosa.data.sequences import load_sequences
from mosa.errors import ConfigError, DataError
from mosa.evaluation.evaluate import sequences
from mosa.evaluation.metrics import unexplained
from mosa.evaluation.same_body import warn_of_other_bodies
from mosa.modules.body.body import Body, Start
from mosa.modules.fitting.parameters import warn_of_ends
from mosa.physics import exact_sums
from mosa.physics.contact.colliders import colliders_from_config
from mosa.physics.contact.driven import driven_from_config
from mosa.reconstruction.marker_body import in_own_axes
from mosa.reconstruction.pose.starts import appearance_of, sequence_start
from mosa.reconstruction.resolution import ENOUGH, resolution
from mosa.system.limits import named_device, return_memory
from mosa.system.whole_files import write_whole
from mosa.training.datamodule import SceneDataModule
from mosa.training.first_picture import write_first_picture
from mosa.training.fitting import build_trainer, fit
from mosa.training.lit_mosa import LitMosa
from mosa.training.loggers import log_outcome
from mosa.training.memory import check_before_data, check_with_data
from mosa.training.outputs import clear, figures_of, optimized, start_figures, write_outputs
from mosa.training.preflight import (
    check_begin,
    check_configuration,
    check_curves,
    check_evaluation,
    check_held,
    check_seen,
    check_starts,
    evaluated_scene,
    warn_of_little,
)  # fmt: skip
from mosa.training.run_folder import (
    VALIDATION,
    begins_from,
    cost,
    finished,
    most_particles,
    peak_memory,
    quiet,
    run_folder,
)  # fmt: skip
from mosa.twin.drop_planning import plan, plan_text
from mosa.twin.rollout_file import save_observed
from mosa.twin.twin import Twin
from mosa.types import AUTO

log = logging.getLogger(__name__)


@contextmanager
def timed(times: dict[str, float], stage: str):
    """The wall time of a stage, into `time/<stage>_s`."""
    began = time.perf_counter()
    yield
    times[f"time/{stage}_s"] = took = time.perf_counter() - began
    return_memory()
    log.info("%s took %.1f s, at most %.1f GB so far", stage, took, peak_memory())


def train(cfg: DictConfig) -> float | None:
    """Run everything `cfg` asks for; returns the figure a sweep optimises. Errors: MosaError of whatever was wrong."""
    quiet()
    load_extensions(plain(cfg).get("extensions"))
    settings = check_configuration(plain(cfg))
    cfg = with_defaults(cfg, "train")
    L.seed_everything(cfg.seed, verbose=False)
    exact_sums.use(cfg.deterministic)
    times, folder = dict[str, float](), run_folder()
    log.info("mosa %s: %s", __version__, " ".join(HydraConfig.get().overrides.task))
    if (done := finished(cfg, folder)) is not None:
        log.info("skipped: %s has its metrics.json (resume=auto)", folder)
        return optimized(done, cfg.optimized_metric)
    cfg.ckpt_path = begins_from(cfg, folder)
    begun = check_begin(cfg)
    trainer = build_trainer(cfg, folder)
    device = str(trainer.strategy.root_device)
    data = SceneDataModule(cfg, device=device)
    most = most_particles(device)
    check_before_data(settings.plain(), most)
    with timed(times, "data"):
        scene = data.scene
        if scene.synthetic and device == "cpu":  # the other films are still to be made
            data.read_ahead()
        else:
            _ = data.scenes
    if begun is not None:
        check_same_data(begun, data.fingerprints, cfg.ckpt_path)
    check_curves(cfg, [scene] if scene.synthetic else [scene, *data.scenes[1]])
    filmed = scene.markers is None
    if filmed:
        check_seen(cfg, scene)
        check_with_data(settings.plain(), scene, data.others, most)
    else:
        log.info("tracked points only: no reconstruction from images, no figures of images")
    if scene.synthetic:
        log.info("scene %s: synthetic, made by this program; not a capture", scene.name)
    with timed(times, "reconstruction"):
        shape, dx = data.shape, data.dx
    cm3 = 1e6 * float(shape.volume.sum())
    log.info("body: %d particles, %.4g cm^3, grid spacing %.4g m", len(shape.rest), cm3, dx)
    lattice = shape.rest if filmed else in_own_axes(scene, shape.rest)
    resolved = resolution(lattice, data.reconstruction.spacing, dx)
    thin = "" if resolved.enough else (
        f"simulation.particles: the thin parts of this body are {resolved.cells:.1f} cells across, fewer than "
        f"{ENOUGH:g}: the grid makes them too stiff and the learned law compensates for it, so it may predict worse "
        f"than its prior; take about {resolved.particles} particles{', or adapter=none' if cfg.adapter.name else ''}"
    )  # fmt: skip
    if thin:
        warnings.warn(thin, stacklevel=1)
    if resolved.pieces > 1:
        warnings.warn(
            f"scene: expected one body, found {resolved.pieces} pieces that do not touch: they are learned as one material, and "
            f"closer than {2 * dx:.2g} m (two grid cells) they move as one; film each by itself", stacklevel=1,
        )  # fmt: skip
    with timed(times, "starts"):
        if filmed:
            write_first_picture(folder, data, trainer.loggers)
        starts = data.starts
    for prefix, start in starts.items():
        velocity = ", ".join(f"{v:.3f}" for v in start.velocity.tolist())
        log.info("start of %s: velocity (%s) m/s", prefix, velocity)
    with timed(times, "fit"):
        module = LitMosa(plain(cfg))
        module.attach(data)
        trainer.callbacks.append(LambdaCallback(on_fit_start=lambda *_: clear(folder)))
        cut = learn(module, data, trainer, cfg.ckpt_path)
    body, world = module.body, module.world  # with the contact that was found
    learned_from = [prefix for prefix in starts if prefix.startswith("train")]
    if filmed:
        seen = {prefix: take.cues for prefix, take in zip(learned_from, module.takes)}
        save_observed(folder / "observed.npz", seen)
    with timed(times, "evaluation"):
        evaluated, posterior = data.sequences, module.posterior
        figures, kept = figures_of(settings.evaluation, body, evaluated, world, posterior, folder)
        for prefix, take in zip(learned_from, module.takes):
            if (own := kept[prefix].get("adapted")) is not None:
                off = unexplained(own.x, take.cues, take.first_contact, body.size)
                figures |= {f"unexplained/{prefix}/{name}": value for name, value in off.items()}
        figures |= start_figures(starts["train"]) | data.reconstruction.geometry | module.figures()
    sizes = {"seed": cfg.seed, "particles": len(body.rest), "dx_m": dx}
    figures |= times | cost(device) | sizes
    figures["geometry/cells_across"] = resolved.cells
    logged = trainer.callback_metrics.items()
    figures |= {k: float(v) for k, v in logged if k.startswith(VALIDATION)}
    log_outcome(trainer.loggers, plain(cfg), figures)
    small = HydraConfig.get().runtime.choices.get("debug")
    smoke = f"**A small smoke run (debug={small}): its figures mean nothing.**" if small else ""
    note = "\n\n".join(filter(None, (smoke, cut, thin)))
    write_outputs(folder, cfg, body, evaluated, figures, kept, world, note)
    return optimized(figures, cfg.optimized_metric)


def learn(module: LitMosa, data: SceneDataModule, trainer: L.Trainer, ckpt_path: str | None) -> str:
    """The run's fit, from its checks to its warnings. Returns what `fit` does. Errors: MosaError."""
    body, starts, recordings = module.body, data.starts, [data.scene, *data.scenes[1]]
    check_held(module.world, body)
    check_starts(module.world, body, starts)
    warn_of_little(module.world, body, starts, recordings)
    warn_of_other_bodies(body, starts, recordings)
    if recordings[0].markers is not None and not all(stage.newton for stage in module.stages):
        raise ConfigError(
            "scene=markers: expected stages that run Gauss-Newton, which compares tracked points, "
            "found Adam (fit.<stage>.optimizer): choose adapter=operator or adapter=none"
        )
    frames, steps = len(module.takes[0].cues.positions), sum(s.iterations for s in module.stages)
    log.info("fit: %d particles, %d frames, at most %d steps", len(body.rest), frames, steps)
    cut = fit(trainer, module, data, ckpt_path)
    warn_of_ends(body.material)
    return cut


def evaluate_checkpoint(cfg: DictConfig) -> float | None:
    """`eval.py`: reproduce the figures of a run, evaluate on another scene, or simulate from a new start."""
    quiet()
    if OmegaConf.is_missing(cfg, "ckpt_path"):
        raise ConfigError(
            "ckpt_path: expected the checkpoint of a run, found none; "
            "python eval.py ckpt_path=<run folder>/checkpoints/last.ckpt"
        )
    load_extensions(plain(cfg).get("extensions"))
    settings = check_evaluation(plain(cfg))
    cfg = with_defaults(cfg, "eval")
    exact_sums.use(cfg.deterministic)
    folder = run_folder()
    twin = Twin.load(cfg.ckpt_path, named_device(cfg.device))
    if cfg.plan is not None:
        ranked = plan(twin, count=cfg.plan, presses=True)
        log.info("\n%s", plan_text(ranked))
        write_whole(folder / "plan.md", plan_text(ranked) + "\n")
        return -ranked[0].gain
    show(twin.body, cfg.appearance)
    simulate = plain(cfg.simulate)
    if any(simulate[k] is not None for k in SimulateSection.STARTS):
        rollout = twin.simulate(**simulate, progress=True)
        readers = {"colliders": colliders_from_config, "driven": driven_from_config}
        asked = {k: simulate[k] for k in readers if simulate[k] is not None}
        given = {k: readers[k](value, f"simulate.{k}") for k, value in asked.items()}
        world = replace(twin.world, **given)
        filmed = {"video": cfg.evaluation.video, "progress": True}
        written = twin.export(rollout, folder, colliders=world.solids, **filmed)
        log.info("simulated %d frames into %s", len(rollout.x), written)
        return None
    scene, held_out = load_sequences(plain(evaluated_scene(cfg, twin).scene))
    body, world = twin.body, twin.world
    if cfg.get("scene"):
        seen = appearance_of(body)
        shown = {f"test/{s.sequence}": s for s in (scene, *held_out)}
        found = {k: sequence_start(body, seen, s, register=True) for k, s in shown.items()}
        # the body moves in the world that the scene shows, among the run's walls and colliders
        world = world_of(measured(twin.record.settings, scene, twin.record.dx))
        if scene.ground is not None and scene.ground.mode == AUTO and twin.world.ground is not None:
            touched = replace(twin.world.ground, height=scene.ground.height)  # as the run found it
            world = replace(world, ground=touched)
        warn_of_other_bodies(body, found, [scene, *held_out])
    else:
        found = {k: Start.read(s.plain(), body.rest) for k, s in twin.record.starts.items()}
        if len(found) != 1 + len(held_out):
            raise DataError(
                f"ckpt_path: {cfg.ckpt_path}: expected a start for each of the scene's "
                f"{1 + len(held_out)} sequences, found {len(found)}: another scene than the run's"
            )
        here = zip(found, (scene, *held_out), strict=True)
        check_same_data(twin.record, {name: s.fingerprint for name, s in here}, cfg.ckpt_path)
    check_starts(world, body, found)
    evaluated = sequences(body, scene, held_out, found)
    figures, kept = figures_of(settings.evaluation, body, evaluated, world, twin.posterior, folder)
    write_outputs(folder, cfg, body, evaluated, figures, kept, world)
    return figures.get("test/rms_m")


def show(body: Body, appearance: str | None) -> None:
    """What the body's images show from now on: splats or particles, None for what they are. Errors: ConfigError without splats."""
    if appearance == "splats" and body.splats is None:
        raise ConfigError(
            "appearance: expected particles, found splats: the run kept none (rendering.appearance)"
        )
    if appearance == "particles":
        body.splats = None
