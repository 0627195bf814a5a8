"""The way of a run: scene -> reconstruction -> starts -> fit -> figures, rollouts, video. Stages are cached or resumable."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Collection
from contextlib import contextmanager
from pathlib import Path

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import LightningEnvironment
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from mosa import parallel
from mosa.analysis.figures import side_by_side, write_strip, write_video
from mosa.analysis.tables import geometry_lines, parameter_table, results_table
from mosa.callbacks import AtomicCheckpointIO, FitProgress, ImageStrips, KeepLast
from mosa.config import build_body, build_stages, build_world, plain, rehearse, run_config, world_config
from mosa.data.datamodule import MultiViewDataModule, training_observations
from mosa.errors import ConfigError, MosaError
from mosa.evaluation import Sequence, evaluate, floor_figures, identification, law_figures, render, true_motion
from mosa.modules.body import Body, Start
from mosa.modules.lit_mosa import LitMosa, Take
from mosa.physics.memory import KEPT_ON_CPU
from mosa.reconstruction.starts import first_contact, sequence_start, splats_of
from mosa.rendering.cameras import crop_boxes, crop_images
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import use_backend
from mosa.run import (
    begins_from,
    cost,
    device_names,
    device_of,
    finished,
    log_outcome,
    named_device,
    shared_starts,
    write_figures,
)  # fmt: skip
from mosa.schema import EVALUATION, SIMULATION, TRAINING, check
from mosa.twin import Twin, save_observed, save_rollout, save_truth
from mosa.types import MotionCues, Reconstruction, Scene


class Clock:
    """Wall time per stage, into `time/<stage>_s`."""

    def __init__(self) -> None:
        self.figures: dict[str, float] = {}

    @contextmanager
    def measure(self, stage: str):
        began = time.perf_counter()
        yield
        self.figures[f"time/{stage}_s"] = self.figures.get(f"time/{stage}_s", 0.0) + time.perf_counter() - began


def run_folder() -> Path:
    return Path(HydraConfig.get().runtime.output_dir)


def reconstruct_scene(cfg: DictConfig, scene: Scene, device: str) -> tuple[Reconstruction, float]:
    """Reconstruction of the training sequence and the grid spacing that goes with it [m]."""
    from mosa.reconstruction.pipeline import reconstruct, spacing_for
    from mosa.reconstruction.settings import build_settings

    settings = build_settings(**plain(cfg.reconstruction))
    dx = cfg.simulation.dx
    spacing = dx / 2 if dx is not None else spacing_for(scene, cfg.simulation.particles, settings, cache_dir=cache_folder(cfg),
                                                        device=device)
    reconstruction = reconstruct(scene, settings=settings, spacing=spacing, cache_dir=cache_folder(cfg), seed=cfg.seed,
                                 device=device)
    return reconstruction, 2 * spacing


def cache_folder(cfg: DictConfig) -> Path:
    """Folder of cached reconstructions: scene.cache, or mosa/ in the user's cache folder."""
    if cfg.scene.get("cache"):
        return Path(cfg.scene.cache)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mosa"


def scenes(cfg: DictConfig) -> tuple[Scene, list[Scene]]:
    """The training sequence and the others of the same object. Errors: ConfigError where scene.also_train names none of these."""
    from mosa.data.scene import held_out_sequences, load_scene

    keys = plain(cfg.scene)
    wanted = keys.pop("also_train", None) or []
    scene, others = load_scene(**keys), held_out_sequences(**keys)
    known = [s.sequence for s in others]
    if unknown := [name for name in wanted if name not in known]:
        found = f"has {', '.join(known)}" if known else "has none"
        raise ConfigError(f"scene.also_train: expected other sequences of the scene, found {unknown[0]!r}; it {found}")
    return scene, others


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


def train(cfg: DictConfig) -> float | None:
    """Run everything `cfg` asks for; returns the figure a sweep optimises. Errors: MosaError of whatever was wrong."""
    quiet()
    check(plain(cfg), TRAINING, EVALUATION)
    rehearse(plain(cfg))
    L.seed_everything(cfg.seed, verbose=False)
    clock, folder = Clock(), run_folder()
    if (done := finished(cfg, folder)) is not None:
        print(f"skipped: {folder} has its metrics.json (resume=auto)")
        return optimized(done, cfg.optimized_metric)
    cfg.ckpt_path = begins_from(cfg, folder)
    device = device_of(cfg)
    use_backend(cfg.rendering.backend)
    with clock.measure("data"):
        scene, held_out = scenes(cfg)
    taught = list(cfg.scene.get("also_train") or [])
    parallel.check_share(len(device_names(cfg)), 1 + len(taught), min(cfg.fit.views, len(scene.training_cameras)))
    if scene.synthetic:
        print(f"scene {scene.name}: synthetic, made by this program; not a capture")
    with clock.measure("reconstruction"):
        reconstruction, dx = reconstruct_scene(cfg, scene, device)
    config = run_config(plain(cfg), scene, dx)
    body = body_of(reconstruction, config).to(device)
    with clock.measure("starts"):
        found = shared_starts(cfg, folder, lambda: starts(body, reconstruction, scene, held_out, taught), body)
    config["starts"] = {k: s.written() for k, s in found.items()}
    world = build_world(config["world"])
    with clock.measure("fit"):
        more = [(s, found[f"train/{s.sequence}"]) for s in held_out if s.sequence in taught]
        module, data = assemble_fit(cfg, scene, reconstruction, body, found["train"], config, device, more)
        if parallel.launched_rank() == 0:
            print(fit_estimate(module, len(device_names(cfg))))
        fit(cfg, module, data, folder, device)
    if parallel.launched_rank() != 0:
        return None
    learned_from = [prefix for prefix in found if prefix.startswith("train")]
    save_observed(folder / "observed.npz", {prefix: take.cues for prefix, take in zip(learned_from, module.takes)})
    with clock.measure("evaluation"):
        figures, kept = evaluate(body, sequences(body, scene, held_out, found), world,
                                 samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
    figures |= identification(body, scene) | law_figures(body) | start_figures(found["train"]) | reconstruction.geometry
    if cfg.evaluation.floor:
        figures |= floor_figures(body, sequences(body, scene, held_out, found), world,
                                 samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
        figures |= true_geometry(body, scene)
    figures |= clock.figures | cost(device) | {"seed": cfg.seed, "particles": len(body.rest), "dx_m": dx}
    if cfg.logger.enabled:
        log_outcome(folder, plain(cfg), figures)
    write_outputs(folder, cfg, body, sequences(body, scene, held_out, found), figures, kept)
    return optimized(figures, cfg.optimized_metric)


def body_of(reconstruction: Reconstruction, config: dict) -> Body:
    """The body of a reconstruction, with the law and settings of the run."""
    splats = reconstruction.splats
    return build_body(config, {"rest": splats.means, "volume": reconstruction.volume, "colors": splats.colors,
                               "opacities": splats.opacities,
                               "covariances": covariance_from(splats.scales, splats.rotations)})


def assemble_fit(
    cfg, scene, reconstruction, body, start, config, device, more: list[tuple[Scene, Start]] = ()
) -> tuple[LitMosa, MultiViewDataModule]:
    """What Lightning fits: the module with its targets and stages, and the schedule of views. more: further sequences to learn
    from; their motion is reconstructed with the body of the first."""
    seen = [(scene, start, reconstruction)]
    seen += [(s, begun, follow_scene(cfg, s, scene, reconstruction, body, begun, device)) for s, begun in more]
    takes = [take_of(cfg, *each, body, device) for each in seen]
    settings = plain(cfg.fit)
    stages = build_stages(settings, heterogeneity=body.heterogeneity is not None, adapter=body.adapter is not None)
    module = LitMosa(
        body, takes=takes, world=build_world(config["world"]), background=scene.background.to(device),
        stages=stages, weights=plain(cfg.losses), clip=settings["clip"], config=config,
    )
    data = MultiViewDataModule(takes[0].observations, views_per_step=settings["views"],
                               steps=sum(s.iterations for s in stages), seed=cfg.seed)
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


BACKWARD = 2.5  # cost of a step with gradients over one without, measured on the rabbit
ADAPTER_COST, ADAPTER_BYTES = 1.8, 4.8e3  # of a step with networks over one without; per particle and evaluation
STATE_BYTES = 330  # per particle and substep kept for the backward pass, with its share of the grid; measured on the rabbit


def fit_estimate(module: LitMosa, processes: int = 1) -> str:
    """One line on how long the fit will take and what its networks will keep in memory, from one timed step without gradients."""
    body, stages = module.body, module.stages
    first = module.takes[0]
    frames = len(first.cues.positions)
    began = time.perf_counter()
    with torch.no_grad():
        module.terms(stages[0], [0, min(1, len(first.observations.cameras) - 1)], frames)
    step = BACKWARD * (time.perf_counter() - began) * -(-len(module.takes) // processes)
    networks = body.adapter is not None and not body.adapter.steady
    seconds = sum(s.iterations * step * (ADAPTER_COST if s.name == "joint" and networks else 1) for s in stages)
    evaluations = (frames - 1) * body.last_substeps / body.settings.stride
    memory = evaluations * len(body.rest) * ADAPTER_BYTES if networks else 0
    kept = 0 if body.rest.is_cuda else min(KEPT_ON_CPU, (frames - 1) * body.last_substeps * len(body.rest) * STATE_BYTES)
    return (f"fit: {len(body.rest)} particles, {frames} frames of {body.last_substeps} substeps, at most "
            f"{sum(s.iterations for s in stages)} steps, about {seconds / 60:.0f} minutes and {0.8 + (memory + kept) / 1e9:.1f} GB")


def fit(cfg, module: LitMosa, data: MultiViewDataModule, folder: Path, device: str) -> None:
    """The staged optimisation under Lightning; resumes from cfg.ckpt_path. Errors: ConfigError for a missing checkpoint."""
    if cfg.ckpt_path is not None and not Path(cfg.ckpt_path).is_file():
        raise ConfigError(f"ckpt_path: no file {cfg.ckpt_path}; a run writes <run folder>/checkpoints/last.ckpt")
    logger = TensorBoardLogger(folder, name="tensorboard", version="", default_hp_metric=False) if cfg.logger.enabled else False
    callbacks = [KeepLast(folder / "checkpoints"), FitProgress()]
    if cfg.logger.enabled and cfg.logger.images_every:
        callbacks.append(ImageStrips(cfg.logger.images_every))
    shared = {"strategy": parallel.SharedSteps()} if len(device_names(cfg)) > 1 else {}
    trainer = L.Trainer(accelerator=cfg.trainer.accelerator, devices=plain(cfg.trainer)["devices"], max_epochs=-1, logger=logger,
                        callbacks=callbacks, plugins=[AtomicCheckpointIO(), LightningEnvironment()], enable_checkpointing=False,
                        enable_progress_bar=False, enable_model_summary=False, log_every_n_steps=1,
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


def write_outputs(folder: Path, cfg: DictConfig, body: Body, evaluated: list[Sequence], figures: dict, kept: dict) -> None:
    """rollout.npz and prior.npz, truth.npz where it is known; video.mp4 of the last held-out sequence, strip.png of all; tables in
    results.md; metrics.json."""
    for variant, name in (("adapted", "rollout.npz"), ("prior", "prior.npz")):
        save_rollout(folder / name, {prefix: variants[variant] for prefix, variants in kept.items()})
    if known := {s.prefix: true_motion(body, s.scene) for s in evaluated if s.scene.truth is not None}:
        save_truth(folder / "truth.npz", known)
    if cfg.evaluation.video:
        shown = [s for s in evaluated if s.prefix.startswith("test")] or evaluated[-1:]
        pictures = {s.prefix: comparison(body, s, kept[s.prefix]) for s in shown}
        columns = pictures[shown[-1].prefix]
        enlarge = max(1, round(320 / max(columns["real"].shape[1:3])))
        write_video(folder / "video.mp4", side_by_side(columns, enlarge), fps=6)
        rows = {f"{prefix}: {title}": images for prefix, each in pictures.items() for title, images in each.items()}
        write_strip(folder / "strip.png", rows, enlarge=max(1, enlarge - 1))
    table = "\n\n".join(part for part in (results_table(figures), parameter_table(figures), geometry_lines(figures)) if part)
    (folder / "results.md").write_text(table + "\n")
    write_figures(folder, figures)  # the last file: the run is complete
    print(f"\n{table}\n\nrun folder: {folder}")


def comparison(body: Body, shown: Sequence, variants: dict) -> dict:
    """Images (T, h, w, 3) of real, prior and adapted from the first camera, cut to where the object goes."""
    scene = shown.scene
    camera = [(scene.training_cameras or [0])[0]]
    x0, y0, width, height = crop_boxes(scene.mattes[camera], margin=16)
    columns = {"real": scene.images[camera]}
    for variant, title in (("prior", "prior"), ("adapted", "adapted (MoSA)")):
        columns[title] = render(body, variants[variant], scene, camera).cpu()
    return {title: crop_images(images, x0, y0, width, height, axis=2)[0] for title, images in columns.items()}


def optimized(figures: dict[str, float], wanted: str) -> float | None:
    """The figure a sweep minimises: `wanted`, or the first that exists of its fallbacks."""
    for key in (wanted, "test/rms_m", "train/rms_m"):
        if key in figures:
            return figures[key]
    return -figures["train/psnr_crop"] if "train/psnr_crop" in figures else None


def evaluate_checkpoint(cfg: DictConfig) -> float | None:
    """`eval.py`: reproduce the figures of a run, evaluate on another scene, or simulate from a new start."""
    quiet()
    if OmegaConf.is_missing(cfg, "ckpt_path"):
        raise ConfigError("ckpt_path: expected the checkpoint of a run, found none; "
                          "python eval.py ckpt_path=<run folder>/checkpoints/last.ckpt")
    check(plain(cfg), EVALUATION, SIMULATION)
    folder = run_folder()
    twin = Twin.load(cfg.ckpt_path, named_device(cfg.device))
    simulate = plain(cfg.simulate)
    if any(simulate[k] is not None for k in ("velocity", "rotation", "height", "angular_velocity", "colliders")):
        rollout = twin.simulate(**simulate, progress=True)
        print(f"simulated {len(rollout.x)} frames into {twin.export(rollout, folder)}")
        return None
    run = OmegaConf.create(twin.config["cfg"])
    if cfg.get("scene"):
        run.scene = cfg.scene
    scene, held_out = scenes(run)
    body, world = twin.body, twin.world
    if cfg.get("scene"):
        splats = splats_of(body)
        found = {f"test/{s.sequence}": sequence_start(body, splats, s, register=True) for s in (scene, *held_out)}
        # the body moves in the world that the scene shows, among the run's walls and colliders
        world = build_world(world_config(scene) | (twin.config["cfg"].get("world") or {}))
    else:
        found = {k: Start.read(s, body.rest) for k, s in twin.config["starts"].items()}
    evaluated = sequences(body, scene, held_out, found)
    figures, kept = evaluate(body, evaluated, world, samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
    figures |= identification(body, scene) | law_figures(body)
    if cfg.evaluation.floor:
        figures |= floor_figures(body, evaluated, world, samples=cfg.evaluation.samples, assignment=cfg.evaluation.assignment)
        figures |= true_geometry(body, scene)
    write_outputs(folder, cfg, body, evaluated, figures, kept)
    return optimized(figures, "test/rms_m")


def quiet() -> None:
    """Keep library chatter off the screen; errors and our own output stay."""
    import logging

    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning.*")
