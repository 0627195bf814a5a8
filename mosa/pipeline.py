"""The way of a run: scene -> reconstruction -> starts -> fit -> figures, rollouts, video. Stages are cached or resumable."""

from __future__ import annotations

import logging
import os
import sys
import time
import warnings
from collections.abc import Collection
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import lightning as L
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.plugins.environments import LightningEnvironment
from omegaconf import DictConfig, OmegaConf

from mosa import __version__, parallel
from mosa.analysis.comparison import compare, write_comparisons
from mosa.analysis.tables import determined_text, geometry_lines, parameter_table, results_table
from mosa.callbacks import AtomicCheckpointIO, FitProgress, ImageStrips, KeepLast, Pace, StageNotes
from mosa.checkpoints import check_same, read_checkpoint
from mosa.config import build_body, build_fit, build_world, plain, run_config, world_config
from mosa.costs import Costs, before_data, duration, estimate, seconds_of_fit, speed_of_rollouts
from mosa.data.datamodule import MultiViewDataModule, training_observations
from mosa.data.sequences import load_sequences, taught_names
from mosa.data.splats import save_ply
from mosa.errors import ConfigError, DataError, MosaError
from mosa.evaluation import (
    Sequence,
    evaluate,
    floor_figures,
    hidden_figures,
    identification,
    law_figures,
    test_means,
    true_motion,
)
from mosa.guards import check_begin, check_configuration, check_evaluation, check_seen, check_starts, evaluated_scene
from mosa.loggers import build_loggers, chosen, log_outcome
from mosa.modules.body import Body, Start, World
from mosa.modules.carried_splats import CarriedSplats
from mosa.modules.gauss_newton import Posterior
from mosa.modules.lit_mosa import LitMosa, Take
from mosa.physics.contact.colliders import colliders_from_config
from mosa.plan import plan, plan_text
from mosa.prediction import determined, predicted_spread
from mosa.progress import tqdm
from mosa.reconstruction.resolution import ENOUGH, grid_spacing, resolution
from mosa.reconstruction.starts import first_contact, sequence_start, splats_of
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import use_backend
from mosa.rollout_file import save_rollout
from mosa.run import (
    begins_from,
    cost,
    device_names,
    device_of,
    finished,
    named_device,
    shared_starts,
    write_figures,
)  # fmt: skip
from mosa.twin import Twin, save_observed, save_spread, save_truth
from mosa.types import MotionCues, Reconstruction, Scene

log = logging.getLogger(__name__)


MOST_PARTICLES = {"cpu": 6000, "cuda": 30000}
"""Of simulation.particles=auto: what a machine identifies in the time that a user waits for a first result."""


class Clock:
    """Wall time per stage, into `time/<stage>_s`. costs: of what is still to come, once that can be said."""

    def __init__(self) -> None:
        self.figures: dict[str, float] = {}
        self.costs = Costs({}, 0.0)

    @contextmanager
    def measure(self, stage: str):
        began = time.perf_counter()
        yield
        self.figures[f"time/{stage}_s"] = self.figures.get(f"time/{stage}_s", 0.0) + time.perf_counter() - began
        log.info(self.costs.done(stage, time.perf_counter() - began))


def run_folder() -> Path:
    return Path(HydraConfig.get().runtime.output_dir)


def reconstruct_scene(cfg: DictConfig, scene: Scene, device: str) -> tuple[Reconstruction, float]:
    """Reconstruction of the training sequence and the grid spacing that goes with it [m]."""
    from mosa.reconstruction.pipeline import reconstruct
    from mosa.reconstruction.settings import build_settings

    settings = build_settings(**plain(cfg.reconstruction))
    spacing, per_cell = spacing_of(cfg, scene, device), cfg.simulation.particles_per_cell
    reconstruction = reconstruct(scene, settings=settings, spacing=spacing, cache_dir=cache_folder(cfg), seed=cfg.seed,
                                 device=device)
    return reconstruction, grid_spacing(spacing, per_cell)


def most_particles(device: str) -> int:
    """Of simulation.particles=auto."""
    return MOST_PARTICLES["cpu" if device == "cpu" else "cuda"]


def spacing_of(cfg: DictConfig, scene: Scene, device: str) -> float:
    """Of the particles [m]."""
    from mosa.reconstruction.pipeline import spacing_for
    from mosa.reconstruction.settings import build_settings

    dx, particles, per_cell = cfg.simulation.dx, cfg.simulation.particles, cfg.simulation.particles_per_cell
    if dx is not None:
        return dx / grid_spacing(1.0, per_cell)
    return spacing_for(scene, None if particles == "auto" else particles, build_settings(**plain(cfg.reconstruction)),
                       per_cell=per_cell, most=most_particles(device), cache_dir=cache_folder(cfg), device=device)


def reconstructed(cfg: DictConfig, scene: Scene, device: str) -> bool:
    """Whether the training sequence's reconstruction lies in the cache."""
    from mosa.reconstruction.pipeline import stored
    from mosa.reconstruction.settings import build_settings

    return stored(scene, lambda: spacing_of(cfg, scene, device), build_settings(**plain(cfg.reconstruction)),
                  cache_dir=cache_folder(cfg), seed=cfg.seed)


def cache_folder(cfg: DictConfig) -> Path:
    """Folder of cached reconstructions: scene.cache, or mosa/ in the user's cache folder."""
    if cfg.scene.get("cache"):
        return Path(cfg.scene.cache)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mosa"


def scenes(cfg: DictConfig) -> tuple[Scene, list[Scene]]:
    """The training sequence and the others of the same object. Errors: ConfigError, DataError."""
    return load_sequences(plain(cfg.scene))


def starts(
    body: Body, reconstruction: Reconstruction, training: Scene, others: list[Scene], taught: Collection[str] = ()
) -> dict[str, Start]:
    """Initial states by prefix, from images alone: pose of frame 0, velocity of the frames before contact.

    Prefixes: train, then train/<name> for the sequences named in `taught`, test/<name> for the rest, in the order of `others`.
    """
    splats = reconstruction.splats.to(body.rest.device)  # where its images are rendered
    found = {"train": sequence_start(body, splats, training, register=False)}
    for scene in tqdm(others, "poses of the other sequences", leave=False):
        prefix = f"{'train' if scene.sequence in taught else 'test'}/{scene.sequence}"
        found[prefix] = sequence_start(body, splats, scene, register=True)
    return found


def sequences(body: Body, training: Scene, others: list[Scene], found: dict[str, Start]) -> list[Sequence]:
    """found: start by prefix, in the order of the sequences (`starts`)."""
    return [Sequence(p, s, start, first_contact(body, start, s)) for (p, start), s in zip(found.items(), [training, *others])]


def run_sequences(config: dict, body: Body) -> list[Sequence]:
    """The sequences that the run of a checkpoint's `config` was evaluated on, read again."""
    scene, others = scenes(OmegaConf.create(config["cfg"]))
    return sequences(body, scene, others, {k: Start.read(s, body.rest) for k, s in config["starts"].items()})


def train(cfg: DictConfig) -> float | None:
    """Run everything `cfg` asks for; returns the figure a sweep optimises. Errors: MosaError of whatever was wrong."""
    quiet()
    check_configuration(plain(cfg))
    chosen(plain(cfg.logger))
    L.seed_everything(cfg.seed, verbose=False)
    clock, folder = Clock(), run_folder()
    log.info("mosa %s: %s", __version__, " ".join(HydraConfig.get().overrides.task))
    if (done := finished(cfg, folder)) is not None:
        log.info("skipped: %s has its metrics.json (resume=auto)", folder)
        return optimized(done, cfg.optimized_metric)
    cfg.ckpt_path = begins_from(cfg, folder)
    check_begin(cfg)
    device = device_of(cfg)
    use_backend(cfg.rendering.backend)
    log.info(before_data(plain(cfg), most_particles(device)))
    with clock.measure("data"):
        scene, held_out = scenes(cfg)
    taught = taught_names(plain(cfg.scene))
    parallel.check_share(len(device_names(cfg)), 1 + len(taught), min(cfg.fit.views, len(scene.training_cameras)))
    check_seen(cfg, scene)
    clock.costs = estimate(plain(cfg), scene, len(held_out), 1 + len(taught), device, stored=reconstructed(cfg, scene, device),
                           processes=len(device_names(cfg)), most=most_particles(device))
    if parallel.launched_rank() == 0:
        log.info("this run takes %s; %.1f GB", clock.costs.said(), clock.costs.memory / 1e9)
    if scene.synthetic:
        log.info("scene %s: synthetic, made by this program; not a capture", scene.name)
    with clock.measure("reconstruction"):
        reconstruction, dx = reconstruct_scene(cfg, scene, device)
    volume = reconstruction.volume
    log.info("body: %d particles, %.4g cm^3, grid spacing %.4g m", len(volume), 1e6 * float(volume.sum()), dx)
    config = run_config(plain(cfg), scene, dx)
    body = body_of(reconstruction, config).to(device)
    resolved = resolution(body.rest, reconstruction.spacing, dx)
    if not resolved.enough:
        warnings.warn(f"simulation.particles: the thin parts of this body are {resolved.cells:.1f} cells across, fewer than "
                      f"{ENOUGH:g}: the grid stiffens them, and the law that is found makes up for it; about "
                      f"{resolved.particles} particles would resolve them", stacklevel=1)
    with clock.measure("starts"):
        found = shared_starts(cfg, folder, lambda: starts(body, reconstruction, scene, held_out, taught), body)
    for prefix, start in found.items():
        log.info("start of %s: velocity (%s) m/s", prefix, ", ".join(f"{v:.3f}" for v in start.velocity.tolist()))
    config["starts"] = {k: s.written() for k, s in found.items()}
    world = build_world(config["world"])
    check_starts(world, body, found)
    with clock.measure("fit"):
        more = [(s, found[f"train/{s.sequence}"]) for s in held_out if s.sequence in taught]
        module, data = assemble_fit(cfg, scene, reconstruction, body, found["train"], config, device, more)
        if parallel.launched_rank() == 0:
            log.info(fit_estimate(module, clock.costs, len(device_names(cfg))))
        fit(cfg, module, data, folder, device)
    if parallel.launched_rank() != 0:
        return None
    learned_from = [prefix for prefix in found if prefix.startswith("train")]
    save_observed(folder / "observed.npz", {prefix: take.cues for prefix, take in zip(learned_from, module.takes)})
    with clock.measure("evaluation"):
        evaluated = sequences(body, scene, held_out, found)
        figures, kept = evaluate(body, evaluated, world, samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
        figures |= identification(body, scene) | law_figures(body) | start_figures(found["train"]) | reconstruction.geometry
        figures |= hidden_figures(body, scene, figures) | posterior_figures(body, module.posterior, evaluated, world, folder)
        figures |= {f"id_prior/compared/{law}_m": distance for law, distance in module.compared.items()}
        if cfg.evaluation.floor:
            figures |= floor_figures(body, evaluated, world, samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
            figures |= true_geometry(body, scene)
    figures |= clock.figures | cost(device) | {"seed": cfg.seed, "particles": len(body.rest), "dx_m": dx}
    figures["geometry/cells_across"] = resolved.cells
    log_outcome(plain(cfg.logger), folder, plain(cfg), figures)
    write_outputs(folder, cfg, body, evaluated, figures, kept, world)
    return optimized(figures, cfg.optimized_metric)


def posterior_figures(body: Body, posterior: Posterior | None, evaluated: list[Sequence], world: World, folder: Path) -> dict:
    """What the data determined and how sure predictions are; uncertainty.npz with the latter. Nothing where there is no
    posterior."""
    if posterior is None:
        return {}
    figures, spreads = predicted_spread(body, posterior, evaluated, world)
    if spreads:
        save_spread(folder / "uncertainty.npz", spreads)
    return figures | test_means(figures) | determined(body, posterior)


def body_of(reconstruction: Reconstruction, config: dict) -> Body:
    """The body of a reconstruction, with the law, settings and appearance of the run."""
    splats = reconstruction.splats
    body = build_body(config, {"rest": splats.means, "volume": reconstruction.volume, "colors": splats.colors,
                               "opacities": splats.opacities,
                               "covariances": covariance_from(splats.scales, splats.rotations)})
    if reconstruction.appearance is not None and config["cfg"]["rendering"].get("appearance", "splats") == "splats":
        body.splats = CarriedSplats(reconstruction.appearance, body.rest)
    return body


def assemble_fit(
    cfg, scene, reconstruction, body, start, config, device, more: list[tuple[Scene, Start]] = ()
) -> tuple[LitMosa, MultiViewDataModule]:
    """What Lightning fits: the module with its targets and stages, and the schedule of views. more: further sequences to learn
    from; their motion is reconstructed with the body of the first."""
    seen = [(scene, start, reconstruction)]
    seen += [(s, begun, follow_scene(cfg, s, scene, reconstruction, body, begun, device)) for s, begun in more]
    takes = [take_of(cfg, *each, body, device) for each in seen]
    module = build_fit(config, body, takes=takes, background=scene.background.to(device))
    data = MultiViewDataModule(takes[0].observations, views_per_step=cfg.fit.views,
                               steps=sum(s.iterations for s in module.stages), seed=cfg.seed)
    return module, data


def follow_scene(cfg, scene, first, reconstruction, body, start, device) -> Reconstruction:
    """Reconstruction of another sequence of the body that `reconstruction` found in the scene `first`."""
    from mosa.reconstruction.pipeline import follow
    from mosa.reconstruction.settings import build_settings

    return follow(scene, first, reconstruction, rotation=start.rotation, center=start.center, rest_center=body.center,
                  settings=build_settings(**plain(cfg.reconstruction)), cache_dir=cache_folder(cfg), seed=cfg.seed, device=device)


def take_of(cfg, scene: Scene, start: Start, reconstruction: Reconstruction, body: Body, device) -> Take:
    """What the fit reads of one sequence, on `device`."""
    frames, cues = len(scene.training_frames), reconstruction.cues
    names = ("positions", "rotation", "stretch", "weight", "covariances")
    return Take(start, training_observations(scene, reconstruction, margin=cfg.rendering.margin, device=device),
                MotionCues(*(getattr(cues, n)[:frames].to(device) for n in names)), float(scene.times[1] - scene.times[0]),
                first_contact(body, start, scene))


def fit_estimate(module: LitMosa, costs: Costs, processes: int = 1) -> str:
    """One line on how long the fit will take, from rollouts of the body that was found, which `costs` takes over."""
    first, body = module.takes[0], module.body
    frames = len(first.cues.positions)
    frame = speed_of_rollouts(body, first.frame_dt, module.world.gravity, module.world.up)
    speeds = replace(costs.speeds, frame=frame)
    seconds = seconds_of_fit(module, speeds, frames, processes)
    costs.known("fit", seconds)
    return (f"fit: {len(body.rest)} particles, {frames} frames of {body.last_substeps} substeps, at most "
            f"{sum(s.iterations for s in module.stages)} steps, about {duration(seconds)}; the run takes about "
            f"{costs.memory / 1e9:.1f} GB")


def fit(cfg, module: LitMosa, data: MultiViewDataModule, folder: Path, device: str) -> None:
    """The staged optimisation under Lightning; resumes from cfg.ckpt_path. Errors: DataError for a checkpoint of another run."""
    if cfg.ckpt_path is not None:
        check_same(read_checkpoint(cfg.ckpt_path), module, cfg.ckpt_path)
    settings = plain(cfg.logger)
    logger = build_loggers(settings, folder)
    callbacks = [KeepLast(folder / "checkpoints"), FitProgress(), StageNotes(), *([Pace()] if logger else [])]
    if logger and settings.get("images_every"):
        callbacks.append(ImageStrips(settings["images_every"]))
    shared = {"strategy": parallel.SharedSteps()} if len(device_names(cfg)) > 1 else {}
    trainer = L.Trainer(accelerator=cfg.trainer.accelerator, devices=plain(cfg.trainer)["devices"], max_epochs=-1,
                        logger=logger or False, callbacks=callbacks, plugins=[AtomicCheckpointIO(), LightningEnvironment()],
                        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False, log_every_n_steps=1,
                        reload_dataloaders_every_n_epochs=1, default_root_dir=folder, use_distributed_sampler=False, **shared)
    try:
        trainer.fit(module, datamodule=data, ckpt_path=cfg.ckpt_path, weights_only=True)
    except MosaError as error:
        if parallel.launched_rank() != 0:  # what stops the fit stops it everywhere, and the first process says what it was
            sys.exit(2)
        if isinstance(error, parallel.RankLost) and (reason := trainer.strategy.launcher.wait_ended()):
            raise parallel.RankLost(parallel.LOST.format(reason)) from error
        raise
    except SystemExit:  # Lightning's answer to Ctrl-C
        raise KeyboardInterrupt from None
    finally:
        parallel.disconnect()
    if module.stage is not None:
        raise KeyboardInterrupt
    module.body.to(device)


def true_geometry(body: Body, scene: Scene) -> dict[str, float]:
    """Figures of the body against the true shape, where that is known."""
    from mosa.data.builtin.true_geometry import geometry_figures

    return geometry_figures(body.rest, body.volume, scene) if scene.synthetic and scene.truth is not None else {}


def start_figures(start: Start) -> dict[str, float]:
    names = ("x", "y", "z")
    return {f"id/v0_{n}": float(v) for n, v in zip(names, start.velocity)} | {
        f"id/omega0_{n}": float(v) for n, v in zip(names, start.angular_velocity)}


def write_outputs(
    folder: Path, cfg: DictConfig, body: Body, evaluated: list[Sequence], figures: dict, kept: dict, world: World
) -> None:
    """rollout.npz and prior.npz, truth.npz where it is known; splats.ply; video.mp4 of the last held-out sequence, strip.png of
    all; tables in results.md; metrics.json."""
    for variant, name in (("adapted", "rollout.npz"), ("prior", "prior.npz")):
        save_rollout(folder / name, {prefix: variants[variant] for prefix, variants in kept.items()}, world.colliders)
    if known := {s.prefix: true_motion(body, s.scene) for s in evaluated if s.scene.truth is not None}:
        save_truth(folder / "truth.npz", known)
    if body.splats is not None:
        known = body.splats.appearance
        save_ply(folder / "splats.ply", known.splats.to("cpu"), known.harmonics.cpu())
    if cfg.evaluation.video:
        shown = [s for s in evaluated if s.prefix.startswith("test")] or evaluated[-1:]
        write_comparisons(folder, {s.prefix: compare(body, s, kept[s.prefix]) for s in shown})
    parts = (results_table(figures), parameter_table(figures), determined_text(figures), geometry_lines(figures))
    table = "\n\n".join(filter(None, parts))
    (folder / "results.md").write_text(table + "\n")
    write_figures(folder, figures)  # the last file: the run is complete
    log.info("\n%s\n\nrun folder: %s", table, folder)


def optimized(figures: dict[str, float], wanted: str) -> float | None:
    """The figure a sweep minimises: `wanted`, or the first that exists of its fallbacks; of image figures the negative."""
    for key in (wanted, "test/rms_m", "train/rms_m"):
        if key in figures:
            return figures[key]
    return next((-figures[key] for key in ("test/psnr_crop", "train/psnr_crop") if key in figures), None)


def evaluate_checkpoint(cfg: DictConfig) -> float | None:
    """`eval.py`: reproduce the figures of a run, evaluate on another scene, or simulate from a new start."""
    quiet()
    if OmegaConf.is_missing(cfg, "ckpt_path"):
        raise ConfigError("ckpt_path: expected the checkpoint of a run, found none; "
                          "python eval.py ckpt_path=<run folder>/checkpoints/last.ckpt")
    check_evaluation(plain(cfg))
    folder = run_folder()
    twin = Twin.load(cfg.ckpt_path, named_device(cfg.device))
    if cfg.plan is not None:
        ranked = plan(twin, count=cfg.plan)
        log.info("\n%s", plan_text(ranked))
        (folder / "plan.md").write_text(plan_text(ranked) + "\n")
        return -ranked[0].gain
    show(twin.body, cfg.appearance)
    simulate = plain(cfg.simulate)
    if any(simulate[k] is not None for k in ("velocity", "rotation", "position", "height", "angular_velocity", "colliders")):
        rollout = twin.simulate(**simulate, progress=True)
        given = simulate["colliders"]
        solids = twin.world.colliders if given is None else colliders_from_config(given, "simulate.colliders")
        log.info("simulated %d frames into %s", len(rollout.x), twin.export(rollout, folder, colliders=solids))
        return None
    scene, held_out = scenes(evaluated_scene(cfg, twin))
    body, world = twin.body, twin.world
    if cfg.get("scene"):
        splats = splats_of(body)
        found = {f"test/{s.sequence}": sequence_start(body, splats, s, register=True) for s in (scene, *held_out)}
        # the body moves in the world that the scene shows, among the run's walls and colliders
        world = build_world(world_config(scene) | (twin.config["cfg"].get("world") or {}))
    else:
        found = {k: Start.read(s, body.rest) for k, s in (twin.config.get("starts") or {}).items()}
        if len(found) != 1 + len(held_out):
            raise DataError(f"ckpt_path: {cfg.ckpt_path}: expected a start for each of the scene's {1 + len(held_out)} sequences, "
                            f"found {len(found)}: the scene is another one than the run's")
    check_starts(world, body, found)
    evaluated = sequences(body, scene, held_out, found)
    figures, kept = evaluate(body, evaluated, world, samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
    figures |= identification(body, scene) | law_figures(body)
    figures |= hidden_figures(body, scene, figures) | posterior_figures(body, twin.posterior, evaluated, world, folder)
    if cfg.evaluation.floor:
        figures |= floor_figures(body, evaluated, world, samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
        figures |= true_geometry(body, scene)
    write_outputs(folder, cfg, body, evaluated, figures, kept, world)
    return optimized(figures, "test/rms_m")


def show(body: Body, appearance: str | None) -> None:
    """What the body's images show from now on: splats or particles, None for what they are. Errors: ConfigError without splats."""
    if appearance == "splats" and body.splats is None:
        raise ConfigError("appearance: expected particles, found splats: the run kept none (rendering.appearance=particles, or an "
                          "older one)")
    if appearance == "particles":
        body.splats = None


def quiet() -> None:
    """Keep library chatter off the screen; errors and our own output stay."""
    import logging

    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning.*")
