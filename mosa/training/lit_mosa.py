"""The LightningModule: a body in its world, fitted in stages to what a `SceneDataModule` serves.

    import lightning as L
    from mosa import LitMosa, SceneDataModule, compose

    cfg = compose("scene=rabbit", "prior=neo_hookean")
    data, module = SceneDataModule(cfg), LitMosa(cfg)
    L.Trainer(max_epochs=-1).fit(module, datamodule=data)     # ends with the last stage
    module = LitMosa.load_from_checkpoint(path)               # to use, to test, or to fit on

Any Trainer drives it. A stage runs by Gauss-Newton (`newton_steps.py`: an epoch is one iteration, over all views) or by Adam
(`adam_steps.py`: an epoch is a pass over the training views). `Stages`, a callback that the module brings along, leads from one
stage to the next."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Checkpoint, GradientAccumulationScheduler
from omegaconf import DictConfig
from torch import Tensor
from torch.utils.data import DataLoader, default_collate

from mosa.config.build import body_of, build_body, build_fit, fitting, plain, rehearse
from mosa.config.checkpoints import (
    TENSORS,
    check_plain,
    check_same_data,
    check_same_scene,
    differing,
    listed,
    other_scene,
    read_checkpoint,
)
from mosa.config.command_settings import TrainSettings
from mosa.config.composition import composed
from mosa.config.effects import warn_without_effect
from mosa.config.known_numbers import known_numbers
from mosa.config.record import BodyRecord, FitRecord, RunRecord
from mosa.data.batches import MotionBatch
from mosa.data.observations import Observations
from mosa.errors import ConfigError, SimulationDiverged
from mosa.evaluation import metrics
from mosa.evaluation.evaluate import evaluate, run_sequences
from mosa.modules.adapters.penalties import MISFIT
from mosa.modules.body.body import Body, World
from mosa.modules.fitting import losses
from mosa.modules.fitting.adam_steps import GradientSteps
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.newton_optimizer import GaussNewtonOptimizer
from mosa.modules.fitting.newton_steps import NewtonSteps
from mosa.modules.fitting.parameters import is_learned, tensors_of
from mosa.modules.fitting.retreat import Retreat
from mosa.modules.fitting.search.yielding import warn_of_yielding
from mosa.modules.fitting.stages import Stage
from mosa.modules.fitting.stages_callback import Stages
from mosa.modules.fitting.terms import check_terms
from mosa.modules.fitting.training_sequences import Take, seen_again, with_positions
from mosa.physics import exact_sums
from mosa.physics.constitutive.laws import law_named
from mosa.physics.world import Start
from mosa.rendering.observer import Views, deformed_covariances, observe
from mosa.system.limits import return_memory
from mosa.training.datamodule import SceneDataModule, served
from mosa.types import Ground, Rollout

log = logging.getLogger(__name__)

PRECISIONS = ("32-true",)  # of a Trainer. The simulation has its own: simulation.precision=64.
MADE = ("trainer", "callbacks", "logger")  # made by Hydra, so not kept in a checkpoint
OF_DATA = ("scene", "reconstruction", "rendering", "seed")  # the data module's
SETTLED = 0.8
"""Of what the look before moved the motion by: one that moves it by more only scatters, and is the last. Where the cues follow the
law, each moves it by 0.2 to 0.75 times as much."""
KEPT = (
    "steps_done", "stage_over", "moves", "misfit", "compared", "grounds", "ground_gains", "law_gains", "parts",
)  # fmt: skip
"""What a checkpoint has of the fit under the same name (`FitRecord`)."""


def other_reading(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Keys beside the scene's that differ, of which the fit takes the data module's: those of a module would do nothing."""
    read = ("seed", "reconstruction.", "rendering.", "simulation.particles_per_cell", "fit.views")
    return [each for each in differing(one, other) if each[0].startswith(read)]


def check_trainer(trainer: L.Trainer, precision: Any = None) -> None:
    """Errors: ConfigError naming an argument that no fit can do with. precision: as it was given, which a Trainer may change."""
    if trainer.world_size != 1:
        raise ConfigError(
            "trainer.devices: expected 1, or a list with the index of one GPU, found "
            f"{trainer.world_size} (docs/sweeps.md)"
        )
    if trainer.precision not in PRECISIONS:
        raise ConfigError(
            f"trainer.precision: expected {' or '.join(PRECISIONS)}, found {precision or trainer.precision!r}: the "
            "simulation is single precision, or double by simulation.precision=64"
        )
    accumulators = [c for c in trainer.callbacks if isinstance(c, GradientAccumulationScheduler)]
    # the schedule of views counts a batch as a step
    if trainer.accumulate_grad_batches != 1 or accumulators:
        found = type(accumulators[0]).__name__ if accumulators else trainer.accumulate_grad_batches
        raise ConfigError(
            f"trainer.accumulate_grad_batches: expected 1, found {found}: fit.views says how many views a step reads"
        )
    # Lightning would wait for steps that no stage makes
    for name, most in (("min_steps", 0), ("min_epochs", 1)):
        if (found := getattr(trainer, name) or 0) > most:
            raise ConfigError(
                f"trainer.{name}: expected none, found {found}: the last stage ends the fit, and fit.<stage>.iterations a stage"
            )
    for name in ("limit_train_batches", "val_check_interval"):
        if isinstance(found := getattr(trainer, name), float) and found != 1:
            raise ConfigError(
                f"trainer.{name}: expected a whole number of batches, found {found}: the epochs of stages differ in length"
            )


class LitMosa(NewtonSteps, GradientSteps, L.LightningModule):
    """Fits a body to one or more sequences in stages: the loss is the mean over them.

    It has no body until `setup` has asked the data module for its particles, or a checkpoint was loaded."""

    def __init__(
        self, first: str | Mapping[str, Any] | DictConfig | None = None, *overrides: str
    ) -> None:
        """first, overrides: a whole configuration (`mosa.compose`), or overrides as on the command line. Errors: ConfigError."""
        super().__init__()
        alone = isinstance(first, dict) and not overrides
        whole = dict(first) if alone else plain(composed(first, overrides))
        self.cfg = {key: value for key, value in whole.items() if key not in MADE}
        if self.cfg:
            settings = TrainSettings.read(self.cfg)
            if settings.deterministic:
                exact_sums.use()
            if not isinstance(first, dict):  # the command line's, which preflight has seen
                given = [each for each in (first, *overrides) if isinstance(each, str)]
                warn_without_effect(settings, rehearse(settings), given)
        self.save_hyperparameters({"cfg": self.cfg}, logger=False)
        self._begin(None, None, (), torch.ones(3), (), {})

    def _begin(
        self, record: BodyRecord | None, body: Body | None, takes: Sequence[Take], background: Tensor, stages: Sequence[Stage],
        weights: Mapping[str, float], *, world: World | None = None, clip: float = 1.0, criterion: Criterion | None = None,
        settings: IdentificationSettings | None = None,
    ) -> None:  # fmt: skip
        """Everything as it is before the first step. weights: per loss term (`mosa.modules.fitting.terms`). Errors: ConfigError
        naming weights of no term."""
        if body is not None:
            check_terms(weights, body.adapter)
        self.body, self.world, self.background = body, world, background
        self.record, self.weights, self.clip = record, dict(weights), clip
        self.criterion = criterion or Criterion(name="free")
        self.settings = settings or IdentificationSettings()
        self.takes, self.first_takes, self.stages = list(takes), list(takes), list(stages)
        # of the training sequence
        self.start = takes[0].start.written() if takes and takes[0] is not None else None
        # where the fit is: stage, losses of its iterations, steps of all stages
        self.stage_index, self.losses, self.steps_done, self.stage_over = 0, [], 0, False
        self.running_optimizer: torch.optim.Optimizer | None = None
        # of a stage of Gauss-Newton, and its state in the checkpoint that the fit goes on from
        self.identification: Identification | None = None
        self.saved_identification: dict | None = None
        # of a stage of Adam
        self.retreat, self.saved_retreat, self.taken_back = Retreat(), None, False
        self.misfit = MISFIT  # of the model the joint stage starts from, measured when it begins
        self.norms: dict[str, float] = {}  # of the last step's gradient, by parameter group
        self.terms_of_step: dict[str, Tensor] = {}
        self.last: dict[str, float] = {}  # what was logged last
        self.saved_cues: tuple | None = None  # those of a checkpoint that was loaded without data
        self.informed = False  # whether the takes have the cues about the calibrated backbone
        self.moves: list[float] = []  # [m] of the cues, by each further look of a calibration
        # what was found: mean distances [m] of the calibrated candidates for the backbone and of the
        # contacts, gains of others about the learned law, errors [m] of held-back frames by parts
        self.compared, self.grounds, self.parts = {}, {}, {}
        self.law_gains, self.ground_gains = {}, {}
        self.posterior: Posterior | None = None
        self.columns = None
        self._known: dict[str, Posterior] = {}  # by law
        begins_again = body is not None and (self.ground_is_sought or body.material.candidates)
        self.untouched = copy.deepcopy(body.state_dict()) if begins_again else None

    @classmethod
    def of_parts(
        cls, body: Body, *, takes: Sequence[Take | None], world: World, background: Tensor, stages: Sequence[Stage],
        weights: Mapping[str, float], record: BodyRecord | None = None, **parts,
    ) -> LitMosa:  # fmt: skip
        """A module of parts that were made elsewhere (see `_begin`). record: kept in its checkpoints; None: made of the parts."""
        if record is None:
            frame_dt = takes[0].frame_dt if takes and takes[0] is not None else 1.0
            record = BodyRecord.of(body, world, frame_dt)
        module = cls({})
        module.cfg = record.settings
        module.save_hyperparameters({"cfg": module.cfg}, logger=False)
        module._begin(record, body, takes, background, stages, weights, world=world, **parts)
        return module

    @classmethod
    def from_record(
        cls, record: BodyRecord, body: Body, *, takes: Sequence[Take | None], background: Tensor
    ) -> LitMosa:
        """The module that fits `body` in the stages of a run. record: of the run (`mosa.config.build.measured`); takes: training
        sequences, none where the module is only used. Errors: ConfigError naming the key."""
        return cls.of_parts(
            body, takes=takes, background=background, record=record, **build_fit(record, body)
        )

    # ---------------------------------------------------------------- data
    def setup(self, stage: str) -> None:
        """Takes the body's particles and its world from the trainer's data module; for a fit not before the checkpoint that it
        resumes is known to be of this scene."""
        data = self.trainer.datamodule
        if isinstance(data, SceneDataModule):
            if stage != "fit":
                self.attach(data, fitting=stage == "validate")
        elif self.body is None or (stage in ("fit", "validate") and not self.takes):
            raise ConfigError(
                "LitMosa: expected a SceneDataModule, which knows the particles of the body and its films "
                "(trainer.fit(module, datamodule=SceneDataModule(cfg))), or for test and predict a module from "
                f"load_from_checkpoint, found {type(data).__name__ if data is not None else 'neither'}; a "
                "loader reads films in a format of your own (docs/extending.md, 'A data format')"
            )
        # what is saved at the end of an epoch belongs to the stage that comes next
        order = lambda each: (isinstance(each, Checkpoint), not isinstance(each, Stages))  # noqa: E731
        self.trainer.callbacks.sort(key=order)

    def configure_callbacks(self) -> list[L.Callback]:
        """Adds `Stages`, and checks trainer and configurations here, as Lightning calls this before any data are loaded."""
        check_trainer(self.trainer)
        data = getattr(self.trainer, "datamodule", None)
        here = plain(data.cfg) if hasattr(data, "cfg") else {}
        if self.record is not None and here:
            check_same_scene(self.record, here, "the module")
        elif found := [*other_scene(self.cfg, here), *other_reading(self.cfg, here)]:
            raise ConfigError(
                f"LitMosa, {type(data).__name__}: expected one configuration for both, found {listed(found)}"
            )
        known = any(isinstance(each, Stages) for each in self.trainer.callbacks)
        return [] if known else [Stages()]

    def attach_trainer(self) -> None:
        """Attaches the data module of the trainer of a fit, if it has one, on the trainer's device."""
        data = None if self._trainer is None else self.trainer.datamodule
        if isinstance(data, SceneDataModule):
            self.attach(data)
            self.to(self.device)

    def attach(self, data: SceneDataModule, fitting: bool = True) -> None:
        """Makes the body from the particles of `data` if there is none yet. fitting: also take the training sequences. Call it to
        have the body before there is a trainer. Errors: ConfigError if a checkpoint has another number of particles."""
        if self.body is None:
            measured = data.measured
            own = {key: measured.settings[key] for key in OF_DATA if key in measured.settings}
            record = measured.but(settings=self.cfg | own)
            body = body_of(data.shape, record)
            background = data.scene.background.to(body.rest.device)
            self._begin(record, body, (), background, **build_fit(record, body))
            self.start = data.starts["train"].written()
        elif len(data.shape.rest) != len(self.body.rest):
            raise self.of_another_body(len(data.shape.rest))
        if fitting and not self.takes:
            again = (
                take.again and replace(take.again, plastic=self.is_plastic) for take in data.takes
            )
            self.takes = [replace(take, again=each) for take, each in zip(data.takes, again)]
            self.first_takes = list(self.takes)
            if self.saved_cues is not None:
                self.takes, self.informed = with_positions(self.takes, *self.saved_cues), True

    def of_another_body(self, found: int | None) -> ConfigError:
        return ConfigError(
            f"ckpt_path: expected a fit to a body of {len(self.body.rest)} particles, found "
            f"{found}: the checkpoint belongs to another scene, reconstruction or "
            "simulation.particles"
        )

    def is_plastic(self) -> bool:
        """Whether the law yields; candidates for it may differ in this."""
        return law_named(self.body.material.law).plastic

    def shows_outlines(self) -> bool:
        """Whether outlines say more on the law than cues do: it yields or flows (of a bounce free rollouts say more about the
        grid), cameras see it, no solid can hide a part of it, and no force is measured, which would count for nothing."""
        if not self.is_plastic() or self.world.colliders or self.world.forces:
            return False
        return all(len(take.observations.cameras) for take in self.takes)

    # ---------------------------------------------------------------- state
    @property
    def stage(self) -> Stage | None:
        """The running stage; None when all have ended."""
        return self.stages[self.stage_index] if self.stage_index < len(self.stages) else None

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        """Adds the record of the run (`RunRecord`)."""
        cues = responses = None
        if self.informed:
            cues = [take.cues.positions.cpu() for take in self.takes]
            responses = [take.response and take.response.written() for take in self.takes]
        fit = FitRecord(
            **{name: getattr(self, name) for name in KEPT}, stage=self.stage_index, losses=list(self.losses),
            particles=len(self.body.rest), identification=self.identification.state() if self.identification else None,
            retreat=self.retreat.written(), cues=cues, responses=responses,
        )  # fmt: skip
        posterior, splats = self.posterior, self.body.splats
        record = RunRecord(
            **dict(self.record),
            start=self.start,
            fit=fit,
            posterior=posterior and posterior.written(),
            splats=None if splats is None else splats.written(),
        )
        check_plain("", checkpoint)  # with what callbacks and data modules of anyone's added
        checkpoint["mosa"] = record.plain()

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        """Resumes the fit of a checkpoint. Errors: ConfigError if that is of another scene or body, or of another program."""
        if "mosa" not in checkpoint:
            raise ConfigError("ckpt_path: the checkpoint was not written by this program")
        record = RunRecord.read(checkpoint["mosa"])
        saved = record.fit
        here = plain(self.trainer.datamodule.cfg) if self.record is None else self.record.settings
        check_same_scene(record, here, "the checkpoint")
        self.attach_trainer()
        if saved is None or saved.particles != len(self.body.rest):
            raise self.of_another_body(None if saved is None else saved.particles)
        check_same_data(record, self.record.data, "the checkpoint")
        for name in KEPT:
            setattr(self, name, copy.copy(getattr(saved, name)))
        self.stage_index, self.losses = saved.stage, list(saved.losses)
        self.start = record.start.plain()
        self.saved_identification = saved.identification and saved.identification.plain()
        self.saved_retreat = saved.retreat and saved.retreat.plain()
        if self.compared and (candidates := self.body.material.candidates):
            if (law := record.law) not in candidates:
                raise ConfigError(
                    f"ckpt_path: expected a law among prior.candidates, {', '.join(candidates)}, "
                    f"found {law!r}"
                )
            self.choose(law)
        if self.ground_is_sought and record.ground is not None and not record.ground_is_sought:
            self.settle_ground(Ground(**record.ground.plain()))
        self.posterior = Posterior.read(record.posterior.plain()) if record.posterior else None
        if saved.cues is not None:
            self.saved_cues = saved.cues, saved.responses
            if self.takes:
                self.takes, self.informed = with_positions(self.takes, *self.saved_cues), True
        elif (self.losses and self.stage is not None and (self.stage.looks_again or not self.stage.calibrates)
              and any(take.again for take in self.takes)):  # fmt: skip
            raise ConfigError(
                "ckpt_path: expected the motion that reconstruction.informed finds, found none: "
                "set reconstruction.informed.iterations=0, as the run had it"
            )

    def choose(self, law: str) -> None:
        """Makes this candidate the backbone of the run, and drops an adapter that cannot correct it."""
        self.body.choose(law)
        self.record = self.record.but(law=law)
        self.body.adapter = fitting(self.body.adapter, law)

    def unfitted(self) -> dict[str, Tensor]:
        """State of the body before its first step; made again where the module came from a checkpoint of a later one."""
        if self.untouched is not None:
            return self.untouched
        tensors = {name: getattr(self.body, name).cpu() for name in TENSORS}
        return build_body(self.record, tensors).state_dict()

    @property
    def known(self) -> Posterior | None:
        """Posterior of the law's numbers from another experiment (`identification.known`), None without one."""
        path, material = self.settings.known, self.body.material
        if path is not None and material.law not in self._known:
            found = known_numbers(path, material, self.body.adapter, "identification.known")
            self._known[material.law] = found
        return self._known.get(material.law)

    @property
    def ground_is_sought(self) -> bool:
        """Whether the fit has to find the contact with the ground (scene.ground.mode=auto) and has not found it yet."""
        return self.record is not None and self.record.ground_is_sought

    def settle_ground(self, ground: Ground) -> None:
        """Sets the ground of all further simulations and checkpoints."""
        self.world, self.record = replace(self.world, ground=ground), self.record.on(ground)

    # ---------------------------------------------------------------- one step
    def configure_optimizers(self):
        """The optimiser of the running stage, None after the last; `Stages` asks again for that of the next stage."""
        self.attach_trainer()
        stage = self.stage
        if stage is None:  # the fit has ended
            return None
        if not stage.newton:
            found = self.adam(stage)
            self.running_optimizer = found["optimizer"]
            return found
        body = self.body
        adapter = stage.learns_adapter and is_learned(body.adapter)
        varies = stage.learns_heterogeneity and is_learned(body.heterogeneity)
        numbers = tensors_of(body, adapter=adapter, heterogeneity=varies)
        self.running_optimizer = GaussNewtonOptimizer(
            numbers, partial(getattr, self, "identification")
        )
        return self.running_optimizer

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> int | None:
        """Skips the rest of an epoch once its stage is over."""
        return -1 if self.stage_over or self.stage is None else None

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor | None:
        """The loss before the step. Gauss-Newton: minus the logarithm of the posterior; Adam: the weighted terms of the views of
        `batch`, None if the previous step was undone."""
        running = self.stage, len(self.losses)
        return (
            self.newton_loss(*running) if self.stage.newton else self.gradient_loss(*running, batch)
        )

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        if loss.requires_grad:  # Gauss-Newton's has none
            loss.backward(*args, **kwargs)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if not (self.stage.newton or self.taken_back):
            self.retreat.note(self.learned())

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer, optimizer_closure=None) -> None:
        stage, iteration = self.stage, len(self.losses)
        loss = optimizer.step(closure=optimizer_closure)
        if stage.newton:
            self.after_newton_step()
        else:
            self.after_gradient_step(stage, iteration, loss)
        self.steps_done += 1
        self.stage_over = stage.ended(self.losses) or (
            stage.newton and self.identification.converged
        )

    @torch.no_grad()
    def validation_step(self, batch: MotionBatch, batch_idx: int) -> None:
        """Logs errors of the law's free rollout on the held-out part of the training sequence: `val/loss`, the weighted terms of
        images and mattes, `val/psnr` [dB] in the object's windows, and both by part (`val/cameras/...`, `val/frames/...`)."""
        (part,), take, body = batch.sequences, self.takes[0], self.body
        values = {"loss": float("inf"), "psnr": -float("inf")}  # of a law that cannot be simulated
        try:
            rollout = body.simulate(take.start, self.world, 1 + max(part.frames), take.frame_dt)
        except (SimulationDiverged, ConfigError) as error:
            log.warning("validation: the law cannot be simulated: %s", error)
        else:
            seen = part.observations
            shown = self.shown(rollout.x[part.frames], rollout.F_tot[part.frames], seen)
            image = float(losses.image_loss(shown.images, seen.images))
            mask = float(losses.mask_loss(shown.mattes, seen.mattes))
            loss = self.weights.get("image", 0.0) * image + self.weights.get("mask", 0.0) * mask
            psnr = metrics.psnr(shown.images.clamp(0, 1).flatten(0, 1), seen.images.flatten(0, 1))
            values = {"loss": loss, "psnr": psnr}
        for place in ("val", f"val/{part.name}"):
            self.log_dict({f"{place}/{k}": value for k, value in values.items()}, batch_size=1)

    def shown(self, x: Tensor, F_tot: Tensor, observations: Observations) -> Views:
        """Images of the body's particles in the cameras of `observations`."""
        body, covariances = self.body, deformed_covariances(F_tot, self.body.covariances)
        return observe(
            x, covariances, body.opacities, body.colors, observations.cameras, self.background
        )

    def test_dataloader(self) -> DataLoader:
        """The sequences that the run was evaluated on, from the configuration in its checkpoint, if there is no data module.
        Errors: DataError, ConfigError."""
        starts = {prefix: start.plain() for prefix, start in self.record.starts.items()}
        found = run_sequences(self.record.settings["scene"], starts, self.body)
        return served(found)

    def test_step(self, batch, batch_idx: int) -> None:
        """Logs the figures of every model on one sequence (docs/figures.md). batch: `evaluation.Sequence`."""
        here = replace(batch, start=type(batch.start).read(batch.start.written(), self.body.rest))
        settings = TrainSettings.part(self.cfg).evaluation
        figures, _ = evaluate(self.body, [here], self.world, settings)
        figures.pop("time/particle_substeps_per_s")
        self.log_dict(figures, batch_size=1)  # `test/<metric>` of several sequences is averaged

    def predict_step(self, batch: Mapping[str, Any], batch_idx: int) -> Rollout:
        """The law's rollout from a new start. batch: keyword arguments of `Twin.simulate`. Errors: ConfigError."""
        if not isinstance(batch, Mapping):  # to Lightning a mapping in a list is a loader of keys
            raise ConfigError(
                f"predict: expected starts as mappings like {{'height': 0.2}}, found "
                f"{batch!r:.80}; data.predict = [{{'height': 0.2}}] and "
                "trainer.predict(module, datamodule=data)"
            )
        loader = None if self._trainer is None else self.trainer.predict_dataloaders
        if getattr(loader, "collate_fn", None) is default_collate:
            raise ConfigError(
                "predict: expected starts one by one, DataLoader(starts, batch_size=None), found batches, whose numbers are tensors"
            )
        return self.twin().simulate(**batch)

    def twin(self):
        """The law as learned so far, for simulation (`mosa.twin.Twin`)."""
        from mosa.twin.twin import Twin

        first = Start.read(self.start, self.body.rest)
        return Twin(self.body, self.world, self.record.frame_dt, self.record, first, self.posterior)

    @classmethod
    def load_from_checkpoint(
        cls, checkpoint_path: str | Path, map_location: str | torch.device | None = None, **given
    ) -> LitMosa:
        """The module of a checkpoint, in evaluation mode: body, world, configuration and progress of its fit, which `trainer.fit`
        with the scene's data module resumes.

        The file is read as data (docs/safety.md); Lightning's other arguments (`strict`, `hparams_file`, ...) change nothing.
        Errors: DataError naming the file, ConfigError for hyperparameters in place of the checkpoint's."""
        from mosa.twin.twin import Twin

        if other := set(given).difference(("hparams_file", "strict", "weights_only")):
            raise ConfigError(
                f"load_from_checkpoint: expected no hyperparameters, which the checkpoint has, found {', '.join(sorted(other))}; "
                "trainer.fit(LitMosa(cfg), datamodule=data, ckpt_path=...) goes on with another configuration"
            )
        twin = Twin.load(checkpoint_path, "cpu" if map_location is None else map_location)
        module = cls.from_record(twin.record, twin.body, takes=(), background=torch.ones(3))
        module.on_load_checkpoint(read_checkpoint(checkpoint_path))
        return module.to(twin.body.rest.device).eval()

    # ---------------------------------------------------------------- stages
    def begin(self, stage: Stage) -> None:
        """Prepares body, ground and cues for a stage."""
        if stage.start is not None:
            self.body.thaw(stage.start)
        if self.ground_is_sought and not stage.newton:
            warnings.warn(
                f"scene.ground.mode: auto asks for fit.{stage.name}.optimizer=gauss_newton, which compares contacts; "
                "found adam, and the body sticks to the ground: say sticky, slip, separate or touch",
                stacklevel=1,
            )
            self.settle_ground(self.world.ground)
        if not stage.silhouettes and (stage.looks_again or not (stage.calibrates or self.informed)):
            moved = self.inform(response=stage.newton and not stage.calibrates)
            # a look that a stop cut short is made again, about cues that have moved already
            if stage.looks_again and len(self.moves) < self.stage_index:
                self.moves = [*self.moves, moved]
        return_memory()
        if stage.learns_adapter and self.body.adapter is not None:
            if stage.name != "networks":  # whose adapter the stage before has left on
                self.body.switch_on()
            if self.weights.get("operator", 0.0) != 0:
                self.misfit = max(self.measure_misfit(), 0.1 * MISFIT)

    def inform(self, response: bool = True) -> float:
        """Finds the cues again, about the prediction of the calibrated backbone. response: also the share of it that they keep.
        Returns how far that moved them [m], rms, of the sequence that moved most."""
        if not any(take.again for take in self.takes):
            return 0.0
        found = [seen_again(take, self.body, self.world, response) for take in self.takes]
        self.takes, self.informed = [take for take, _ in found], True
        return max(moved for _, moved in found)

    def finish(self) -> None:
        """Ends the running stage: the next one follows, or all of them again on another ground or about another backbone."""
        stage = self.stage
        if stage.newton:
            if self.identification is None:  # of a checkpoint from before this end
                self.take_up(stage)
            if self.goes_back(stage):
                return
            self.keep_posterior(stage)
        else:
            self.try_last_step(stage)
        self.end(stage)

    def end(self, stage: Stage) -> None:
        """Keeps the stage's result as a backbone and goes on to the next stage."""
        compared = not all(law_named(law).elastic for law in self.compared)
        if stage.calibrates and not stage.looks_again and not compared:
            warn_of_yielding(self.body, self.takes, self.world)
        for name in stage.keeps:
            self.body.freeze(name)
        settled = len(self.moves) > 1 and self.moves[-1] > SETTLED * self.moves[-2]
        # the looks are the last stages but for the one by silhouettes
        following = max(self.stage_index + 1, len(self.stages) - 1 if settled else 0)
        by_silhouettes = following < len(self.stages) and self.stages[following].silhouettes
        self.stage_index = following + (by_silhouettes and not self.shows_outlines())
        self.losses, self.identification = [], None
        self.retreat, self.stage_over = Retreat(), False
        if self.stage is not None and self.stage.name == "networks":  # before it has an optimiser
            if not self.body.adapter.numbers.any():  # `settle_parts`
                told = "the choice by held-back frames left the constant operator out: the networks begin at the prior"
                warnings.warn(f"adapter: {told}", stacklevel=1)
            self.body.adapter.vary()
            self.posterior, self.parts = None, {}  # both are of the numbers that they begin at

    # ---------------------------------------------------------------- logs
    def log_values(self, values: dict[str, Tensor | float]) -> None:
        """Logs these scalars and the parameters of the law, and keeps them in `last`."""
        for name, value in self.body.material.physical().items():
            values[f"id/{name}"] = value.detach()
        height = self.body.contact.height(self.world.ground, self.body.settings.dx)
        values["id/contact_offset"] = height.detach()
        tensors = {k: torch.as_tensor(v, dtype=torch.float32) for k, v in values.items()}
        self.log_dict(tensors, on_step=True, on_epoch=False)
        self.last |= {k: float(v) for k, v in values.items()}
