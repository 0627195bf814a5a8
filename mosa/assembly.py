"""A run put together from its configuration, in one place: what train.py fits, and what tests and benchmarks measure.

    run = assemble(cfg)
    run.module          # the LightningModule, with its body, takes and stages; every part it needs was made for it
    run.reconstruction  # a part by itself; nothing after it is made
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import torch
from omegaconf import DictConfig

from mosa.config import build_body, build_world, plain, run_config
from mosa.data.builtin.takes import default_cache
from mosa.data.datamodule import MultiViewDataModule, training_observations
from mosa.data.sequences import load_sequences, taught_names
from mosa.evaluation import Sequence, sequences
from mosa.modules.body import Body, Start, World
from mosa.modules.carried_splats import CarriedSplats
from mosa.modules.lit_mosa import LitMosa
from mosa.modules.takes import Take
from mosa.physics.constitutive.laws import law_named
from mosa.progress import tqdm
from mosa.reconstruction.moved import SecondLook
from mosa.reconstruction.pipeline import follow, reconstruct, spacing_for, stored
from mosa.reconstruction.resolution import grid_spacing
from mosa.reconstruction.settings import ReconstructionSettings, build_settings
from mosa.reconstruction.starts import appearance_of, first_contact, sequence_start
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import use_backend
from mosa.run import most_particles
from mosa.types import MotionCues, Reconstruction, Scene


def assemble(cfg: DictConfig, device: torch.device | str = "cpu", *, held_out: bool = True) -> Run:
    """The run that `cfg`, a configuration of conf/train.yaml, describes. held_out: with the sequences nothing is learned from.

    Errors, here or where a part is asked for: ConfigError naming the key, DataError naming the file."""
    use_backend(cfg.rendering.backend)
    return Run(cfg, device, held_out)


class Run:
    """The parts of a run, each made when it or what needs it is first asked for, and then kept: data, reconstruction, body, starts,
    module. A part may be set before, where it comes from elsewhere (the starts of another process)."""

    def __init__(self, cfg: DictConfig, device: torch.device | str = "cpu", held_out: bool = True) -> None:
        self.cfg, self.device, self.held_out = cfg, device, held_out

    # ---------------------------------------------------------------- data
    @cached_property
    def taught(self) -> list[str]:
        """Names of the sequences beside the training one that are learned from."""
        return taught_names(plain(self.cfg.scene))

    @cached_property
    def scenes(self) -> tuple[Scene, list[Scene]]:
        """The training sequence and the others of the same object."""
        training, others = scenes(self.cfg)
        return training, [s for s in others if self.held_out or s.sequence in self.taught]

    @property
    def scene(self) -> Scene:
        """The training sequence."""
        return self.scenes[0]

    # ---------------------------------------------------------------- reconstruction
    @property
    def cache(self) -> Path:
        """Folder of cached reconstructions: scene.cache, or mosa/ in the user's cache folder."""
        return Path(self.cfg.scene.cache) if self.cfg.scene.get("cache") else default_cache()

    @property
    def reconstruction_settings(self) -> ReconstructionSettings:
        return build_settings(**plain(self.cfg.reconstruction))

    @cached_property
    def spacing(self) -> float:
        """Of the particles [m]."""
        settings = self.cfg.simulation
        dx, particles, per_cell = settings.dx, settings.particles, settings.particles_per_cell
        if dx is not None:
            return dx / grid_spacing(1.0, per_cell)
        return spacing_for(self.scene, None if particles == "auto" else particles, self.reconstruction_settings, per_cell=per_cell,
                           most=most_particles(self.device), cache_dir=self.cache, device=self.device)

    @property
    def dx(self) -> float:
        """Grid spacing [m]."""
        return grid_spacing(self.spacing, self.cfg.simulation.particles_per_cell)

    def reconstructed(self) -> bool:
        """Whether the training sequence's reconstruction lies in the cache."""
        return stored(self.scene, lambda: self.spacing, self.reconstruction_settings, cache_dir=self.cache, seed=self.cfg.seed)

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Of the training sequence."""
        return reconstruct(self.scene, settings=self.reconstruction_settings, spacing=self.spacing, cache_dir=self.cache,
                           seed=self.cfg.seed, device=self.device)

    def followed(self, scene: Scene) -> Reconstruction:
        """Reconstruction of another sequence of the body that was found in the training one."""
        start = self.starts[f"train/{scene.sequence}"]
        return follow(scene, self.scene, self.reconstruction, rotation=start.rotation, center=start.center,
                      rest_center=self.body.center, settings=self.reconstruction_settings, cache_dir=self.cache,
                      seed=self.cfg.seed, device=self.device)

    # ---------------------------------------------------------------- body and world
    @cached_property
    def config(self) -> dict:
        """What a checkpoint keeps of the run; with the starts once they are known."""
        return run_config(plain(self.cfg), self.scene, self.dx)

    @cached_property
    def body(self) -> Body:
        """With the law, settings and appearance of the run."""
        return body_of(self.reconstruction, self.config).to(self.device)

    @cached_property
    def world(self) -> World:
        return build_world(self.config["world"])

    # ---------------------------------------------------------------- starts
    @cached_property
    def starts(self) -> dict[str, Start]:
        return self.find_starts()

    def find_starts(self) -> dict[str, Start]:
        """Initial states by prefix, from images alone: pose of frame 0, velocity of the frames before contact.

        Prefixes: train, then train/<name> for the sequences that are learned from, test/<name> for the rest, in their order."""
        body, (training, others) = self.body, self.scenes
        seen = appearance_of(body)
        found = {"train": sequence_start(body, seen, training, register=False)}
        for scene in tqdm(others, "poses of the other sequences", leave=False):
            prefix = f"{'train' if scene.sequence in self.taught else 'test'}/{scene.sequence}"
            found[prefix] = sequence_start(body, seen, scene, register=True)
        return found

    @property
    def sequences(self) -> list[Sequence]:
        """What the run is evaluated on."""
        return sequences(self.body, *self.scenes, self.starts)

    # ---------------------------------------------------------------- fit
    @cached_property
    def module(self) -> LitMosa:
        """What Lightning fits, with its targets and stages."""
        self.config["starts"] = {prefix: start.written() for prefix, start in self.starts.items()}
        seen = [("train", self.scene, self.reconstruction)]
        seen += [(f"train/{s.sequence}", s, self.followed(s)) for s in self.scenes[1] if s.sequence in self.taught]
        takes = [self.take(scene, self.starts[prefix], found) for prefix, scene, found in seen]
        return LitMosa.from_config(self.config, self.body, takes=takes, background=self.scene.background.to(self.device))

    @property
    def data(self) -> MultiViewDataModule:
        """The schedule of views of `module`."""
        module = self.module
        return MultiViewDataModule(module.takes[0].observations, views_per_step=self.cfg.fit.views,
                                   steps=sum(s.iterations for s in module.stages), seed=self.cfg.seed)

    def take(self, scene: Scene, start: Start, reconstruction: Reconstruction) -> Take:
        """What the fit reads of one sequence, on the run's device."""
        frames, cues = len(scene.training_frames), reconstruction.cues
        names = ("positions", "rotation", "stretch", "weight", "covariances")
        return Take(
            start, training_observations(scene, reconstruction, margin=self.cfg.rendering.margin, device=self.device),
            MotionCues(*(getattr(cues, n)[:frames].to(self.device) for n in names)), float(scene.times[1] - scene.times[0]),
            first_contact(self.body, start, scene), self.second_look(scene, reconstruction),
        )  # fmt: skip

    def second_look(self, scene: Scene, reconstruction: Reconstruction) -> SecondLook | None:
        """Finds the cues of a sequence about a prediction, where reconstruction.informed asks for it."""
        settings = self.reconstruction_settings
        if not settings.looks_again:
            return None
        return SecondLook(scene, reconstruction, settings, self.cfg.seed, self.device,
                          plastic=lambda: law_named(self.body.material.law).plastic)


def scenes(cfg: DictConfig) -> tuple[Scene, list[Scene]]:
    """The training sequence and the others of the same object. Errors: ConfigError, DataError."""
    return load_sequences(plain(cfg.scene))


def body_of(reconstruction: Reconstruction, config: dict) -> Body:
    """The body of a reconstruction, with the law, settings and appearance of the run."""
    splats = reconstruction.splats
    body = build_body(config, {"rest": splats.means, "volume": reconstruction.volume, "colors": splats.colors,
                               "opacities": splats.opacities,
                               "covariances": covariance_from(splats.scales, splats.rotations)})
    if reconstruction.appearance is not None and config["cfg"]["rendering"].get("appearance", "splats") == "splats":
        body.splats = CarriedSplats(reconstruction.appearance, body.rest)
    return body
