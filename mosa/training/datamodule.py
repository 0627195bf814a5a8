"""The data of a scene under Lightning: films, reconstruction, starts, and batches of frames with their motion cues.

    from mosa import SceneDataModule

    data = SceneDataModule("rabbit")
    data.prepare_data()                             # makes or finds the films
    data.setup("fit")                               # checks, reconstructs (cached) and finds the starts
    batch = next(iter(data.train_dataloader()))     # some views of every frame, with their cues

It stands alone; `LitMosa` asks it for the particles that a body is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig
from torch import Tensor
from torch.utils.data import DataLoader

from mosa.config.build import measured, plain
from mosa.config.command_settings import DataSections
from mosa.config.composition import composed
from mosa.config.record import BodyRecord
from mosa.data.batches import Epochs, MotionBatch, SequenceBatch, ViewSchedule, on_device
from mosa.data.observations import cropped, training_observations
from mosa.data.scene import held_out_of
from mosa.data.sequences import load_first, load_sequences, taught_names
from mosa.errors import ConfigError
from mosa.evaluation.evaluate import Sequence as EvaluatedSequence
from mosa.evaluation.evaluate import sequences
from mosa.modules.fitting.training_sequences import Take
from mosa.physics import exact_sums
from mosa.physics.world import Start
from mosa.reconstruction.marker_body import (
    followed_by_markers,
    marker_spacing,
    reconstruction_of_markers,
)
from mosa.reconstruction.motion.moved import SecondLook
from mosa.reconstruction.pipeline import follow, reconstruct, spacing_for
from mosa.reconstruction.pose.starts import appearance_of, first_contact, sequence_start
from mosa.reconstruction.resolution import grid_spacing
from mosa.reconstruction.rest_shape import RestShape
from mosa.system.caches import default_cache
from mosa.system.progress import tqdm
from mosa.training.run_folder import most_particles
from mosa.types import Appearance, Reconstruction, Scene


def served(batches: Any) -> DataLoader[Any]:
    """Batches that are made whole, one after another. batches: an iterable data set, or a sequence."""
    return DataLoader(batches, batch_size=None, collate_fn=_whole)


def _whole(batch: Any) -> Any:
    return batch


class SceneDataModule(L.LightningDataModule):
    """One scene: the sequence that is reconstructed and learned from, further ones of the same object (`scene.also_train`), and
    those that are held out.

    Batches: train_dataloader has `MotionBatch` (some views of all frames that may be read), one epoch a pass over the views;
    val_dataloader the held-out cameras and the held-out frames of the training sequence, where there are any; test_dataloader the
    held-out sequences (`evaluation.Sequence`); predict_dataloader new starts in the words of `Twin.simulate`."""

    def __init__(
        self,
        scene: str | Mapping[str, Any] | DictConfig = "rabbit",
        *overrides: str,
        device: torch.device | str | None = None,
        held_out: bool = True,
        predict: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """scene: a name of conf/scene, or a whole configuration (`mosa.compose`); overrides: as on the command line, beside a name.

        device: where reconstruction and targets are; None: the trainer's. held_out: whether to load sequences that nothing is
        learned from. predict: starts of predict_dataloader; none: those of all sequences. Errors, here or where a part is asked
        for: ConfigError naming the key, DataError naming the file."""
        super().__init__()
        self.cfg = composed(scene, overrides)
        self.settings = DataSections.part(plain(self.cfg))
        if self.cfg.get("deterministic"):
            exact_sums.use()
        self.device, self.held_out, self.predict = device, held_out, list(predict)
        self._ahead: Future[list[Scene]] | None = None

    def __repr__(self) -> str:
        scene = dict(self.cfg.scene)
        return f"SceneDataModule(scene={scene.get('name') or scene.get('path')!r})"

    def __init_subclass__(cls, **keys: Any) -> None:
        super().__init_subclass__(**keys)
        if "scenes" in vars(cls):  # a checkpoint would name another scene than it was fitted to
            raise ConfigError(
                f"{cls.__name__}.scenes: expected scenes that the configuration names, found an override: register_format reads "
                "films of any format (docs/own_training_script.md, 'Films in a format of your own')"
            )

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: Any, *_: Any, **__: Any) -> SceneDataModule:
        """Errors: ConfigError. Lightning would make a data module of the default scene."""
        raise ConfigError(
            "SceneDataModule.load_from_checkpoint: expected the configuration of a run, found its checkpoint, which holds no data; "
            f"SceneDataModule(LitMosa.load_from_checkpoint({str(checkpoint_path)!r}).cfg)"
        )

    # ---------------------------------------------------------------- Lightning's hooks
    def prepare_data(self) -> None:
        """Makes the films of a built-in scene that are not in the cache, or reads those of a folder, and keeps nothing in memory.
        Does nothing under a trainer: a fit first compares the scene with that of the checkpoint that it resumes."""
        if self.trainer is None:
            load_sequences(plain(self.cfg.scene))

    def setup(self, stage: str) -> None:
        """Loads the films, reconstructs and finds the starts; under a trainer each is done when it is first needed. stage: fit |
        validate | test | predict."""
        if self.device is None:
            self.device = "cpu" if self.trainer is None else self.trainer.strategy.root_device
        if self.trainer is None:
            _ = self.starts
            if stage in ("fit", "validate"):
                _ = self.epochs

    def train_dataloader(self) -> DataLoader[Any]:
        """`MotionBatch` of one epoch each time that it is iterated over (`Epochs`)."""
        return served(self.epochs)

    def val_dataloader(self) -> DataLoader[Any]:
        """The held-out cameras in the training frames, and all cameras in the held-out frames, of the training sequence. Empty
        where nothing is held out."""
        return served(self.held_back)

    def test_dataloader(self) -> DataLoader[Any]:
        """The held-out sequences."""
        return served([s for s in self.sequences if s.prefix.startswith("test")])

    def predict_dataloader(self) -> DataLoader[Any]:
        """Keyword arguments of `Twin.simulate`, one mapping a start."""
        names = {"position": "center"} | {
            k: k for k in ("rotation", "velocity", "angular_velocity")
        }
        begins = (({k: getattr(s.start, v) for k, v in names.items()}, s) for s in self.sequences)
        return served(self.predict or [own | {"frames": s.scene.frames} for own, s in begins])

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """Moves a batch of a fit. Sequences and starts stay where they are: the parts that are needed are moved later."""
        return batch.to(device) if isinstance(batch, MotionBatch) else batch

    # ---------------------------------------------------------------- films
    @cached_property
    def taught(self) -> list[str]:
        """Names of the further sequences that are learned from."""
        return taught_names(plain(self.cfg.scene))

    @cached_property
    def _first(self) -> tuple[Scene, Callable[[], list[Scene]]]:
        return load_first(plain(self.cfg.scene))

    @property
    def scene(self) -> Scene:
        """The training sequence."""
        return self._first[0]

    @property
    def others(self) -> int:
        """Number of sequences beside the training one; films of a built-in scene need not be made to count them."""
        if self.scene.synthetic:
            return len(held_out_of(plain(self.cfg.scene)))
        return len(self.scenes[1])

    def read_ahead(self) -> None:
        """Makes the films of the other sequences in a background thread; `scenes` waits for it."""
        self._ahead = ThreadPoolExecutor(1).submit(self._first[1])

    @cached_property
    def scenes(self) -> tuple[Scene, list[Scene]]:
        """The training sequence and the others of the same object."""
        others = self._first[1]() if self._ahead is None else self._ahead.result()
        return self.scene, [s for s in others if self.held_out or s.sequence in self.taught]

    def prefix(self, scene: Scene) -> str:
        """Prefix of the figures of a sequence beside the training one: `train/<name>` if it is learned from, else `test/<name>`."""
        return f"{'train' if scene.sequence in self.taught else 'test'}/{scene.sequence}"

    @property
    def fingerprints(self) -> dict[str, str]:
        """Fingerprints of the recorded films, by sequence; built-in scenes have none."""
        named = {"train": self.scene} | {self.prefix(scene): scene for scene in self.scenes[1]}
        return {name: scene.fingerprint for name, scene in named.items() if not scene.synthetic}

    # ---------------------------------------------------------------- reconstruction
    @property
    def cache(self) -> Path:
        """Folder of cached reconstructions: scene.cache, or mosa/ in the user's cache folder."""
        cache = self.settings.scene.cache
        return Path(cache) if cache else default_cache()

    @cached_property
    def spacing(self) -> float:
        """Distance between neighbouring particles [m]."""
        settings = self.settings.simulation
        dx, per_cell = settings.dx, settings.particles_per_cell
        particles = None if settings.particles == "auto" else settings.particles
        if dx is not None:
            return float(dx / grid_spacing(1.0, per_cell))
        if self.scene.markers is not None:
            return marker_spacing(self.scene, particles)
        device = self.device or "cpu"
        return spacing_for(
            self.scene, particles, self.settings.reconstruction, per_cell=per_cell,
            most=most_particles(device), cache_dir=self.cache, device=device,
        )  # fmt: skip

    @property
    def dx(self) -> float:
        """Grid spacing [m]."""
        return grid_spacing(self.spacing, self.settings.simulation.particles_per_cell)

    @property
    def _found_with(self) -> dict[str, Any]:
        """Arguments that the reconstructions of all sequences share."""
        settings, device = self.settings, self.device or "cpu"
        return {"settings": settings.reconstruction, "cache_dir": self.cache, "seed": settings.seed,
                "device": device}  # fmt: skip

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Reconstruction of the training sequence."""
        if self.scene.markers is not None:
            return reconstruction_of_markers(self.scene, self.spacing)
        return reconstruct(self.scene, spacing=self.spacing, **self._found_with)

    @cached_property
    def shape(self) -> RestShape:
        """The particles of the body, on the device."""
        shown = self.settings.rendering.appearance == "splats"
        return RestShape.of(self.reconstruction, self.device or "cpu", with_splats=shown)

    def followed(self, scene: Scene) -> Reconstruction:
        """Reconstruction of another sequence of the body that was found in the training one."""
        if scene.markers is not None:
            return followed_by_markers(scene, self.reconstruction)
        start = self.starts[f"train/{scene.sequence}"]
        return follow(
            scene, self.scene, self.reconstruction, rotation=start.rotation, center=start.center,
            rest_center=self.shape.center, **self._found_with,
        )  # fmt: skip

    # ---------------------------------------------------------------- starts
    @cached_property
    def start(self) -> Start:
        """Initial state of the training sequence, from images alone: the rest pose, velocity of the frames before contact."""
        return self._start_of(self.scene, register=False)

    def _start_of(self, scene: Scene, register: bool = True) -> Start:
        moving = self.reconstruction.moving
        place = None if moving is None else moving.place
        return sequence_start(self.shape, self._seen, scene, register=register, place=place)

    @cached_property
    def _seen(self) -> Appearance:
        return appearance_of(self.shape)

    @cached_property
    def starts(self) -> dict[str, Start]:
        """Initial states by prefix: `start`, and those of the other sequences, whose pose in frame 0 is found too.

        Prefixes: train, then `train/<name>` for sequences that are learned from, `test/<name>` for the rest, in their order."""
        found = {"train": self.start}
        for scene in tqdm(self.scenes[1], "poses of the other sequences", leave=False):
            found[self.prefix(scene)] = self._start_of(scene)
        return found

    @property
    def sequences(self) -> list[EvaluatedSequence]:
        """Every sequence with its start, as a run is evaluated on them."""
        return sequences(self.shape, *self.scenes, self.starts)

    @property
    def measured(self) -> BodyRecord:
        """Record of the data in a checkpoint, beside the settings: world, density, spacing, starts."""
        return measured(plain(self.cfg), self.scene, self.dx, self.starts, self.fingerprints)

    # ---------------------------------------------------------------- what a fit reads
    @cached_property
    def takes(self) -> list[Take]:
        """The sequences that are learned from, the training one first."""
        others = [s for s in self.scenes[1] if s.sequence in self.taught]
        seen = [("train", self.scene, self.reconstruction)]
        seen += [(f"train/{s.sequence}", s, self.followed(s)) for s in others]
        return [self.take(scene, self.starts[prefix], found) for prefix, scene, found in seen]

    def take(self, scene: Scene, start: Start, reconstruction: Reconstruction) -> Take:
        """Training data of one sequence, on the device."""
        device, frames = self.device or "cpu", len(scene.training_frames)
        return Take(
            start, training_observations(scene, reconstruction, margin=self.settings.rendering.margin, device=device),
            reconstruction.cues.first(frames).to(device), scene.frame_dt,
            first_contact(self.shape, start, scene), self.second_look(scene, reconstruction), scene.sequence,
            on_device(self.further_cues(scene, reconstruction) or {}, device),
        )  # fmt: skip

    def second_look(self, scene: Scene, reconstruction: Reconstruction) -> SecondLook | None:
        """Finder of the cues of a sequence about a prediction; None unless reconstruction.informed asks for it."""
        settings = self.settings.reconstruction
        if not settings.looks_again or scene.markers is not None:
            return None
        return SecondLook(scene, reconstruction, settings, self.settings.seed, self.device or "cpu")

    def further_cues(self, scene: Scene, reconstruction: Reconstruction) -> dict[str, Tensor]:
        """Tensors by name that batches carry as `extra`, frames first, for loss terms of a subclass that overrides this method.
        They cover `scene.training_frames` and `scene.training_cameras` alone: the others are held out."""
        return {}

    @cached_property
    def epochs(self) -> Epochs:
        """The training batches; the fit sets their order before each epoch."""
        views = max(1, len(self.takes[0].observations.cameras))  # none beside tracked points
        return Epochs(ViewSchedule(views, self.settings.fit.views, self.settings.seed), self.batch)

    def batch(self, views: Sequence[int]) -> MotionBatch:
        """The given views of all sequences that are learned from, in all training frames."""
        own = (self.sequence_batch(i, take, views) for i, take in enumerate(self.takes))
        return MotionBatch(sequences=tuple(own))

    def sequence_batch(self, index: int, take: Take, views: Sequence[int]) -> SequenceBatch:
        cameras = len(take.observations.cameras)
        chosen = [view % cameras for view in views] if cameras else []
        frames = list(range(len(take.cues.positions)))
        return SequenceBatch(
            name=take.name, index=index, views=chosen, frames=frames, observations=take.observations.select(chosen),
            cues=take.cues, extra=dict(take.extra),
        )  # fmt: skip

    @cached_property
    def held_back(self) -> list[MotionBatch]:
        """The validation batches, named `cameras` and `frames`."""
        scene, margin = self.scene, self.settings.rendering.margin
        parts = {"cameras": (scene.holdout_cameras, scene.training_frames),
                 "frames": (range(len(scene.cameras)), scene.holdout_frames)}  # fmt: skip
        found = []
        for name, (views, frames) in parts.items():
            if views and frames:
                seen = {"cues": None, "observations": cropped(scene, views, frames, margin)}
                where = {"index": 0, "views": list(views), "frames": list(frames)}
                own = SequenceBatch(name=name, extra={}, **where, **seen)
                found.append(MotionBatch(sequences=(own,)))
        return found
