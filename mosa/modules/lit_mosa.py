"""LightningModule of the fit: what it holds, what a checkpoint keeps of it, how one stage follows the other, what is logged.

A stage runs by iterations of Gauss-Newton (`newton_steps.py`) or by steps of Adam (`gradient_steps.py`). The mathematics lives in
the modules that those two wire.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import lightning as L
import torch
from torch import Tensor

from mosa import losses, parallel
from mosa.checkpoints import VERSION
from mosa.config import build_criterion, build_identification, build_stages, build_world
from mosa.errors import ConfigError
from mosa.modules.body import Body, World
from mosa.modules.criteria import Criterion
from mosa.modules.gauss_newton import Posterior
from mosa.modules.gradient_steps import GradientSteps
from mosa.modules.identification import Identification
from mosa.modules.identification_settings import IdentificationSettings
from mosa.modules.material import material_states
from mosa.modules.newton_steps import NewtonSteps
from mosa.modules.observer import deformed_covariances, observe
from mosa.modules.penalties import MISFIT
from mosa.modules.restorable import Restorable
from mosa.modules.retreat import Retreat
from mosa.modules.stages import Stage
from mosa.modules.takes import Take, seen_again, with_positions
from mosa.modules.terms import check_terms
from mosa.types import AUTO, Ground


class LitMosa(NewtonSteps, GradientSteps, Restorable, L.LightningModule):
    """Fits a body to one or more sequences in stages: the loss is the mean over them.

    weights: per loss term (`mosa.modules.terms`); config: plain containers from which `eval.py` rebuilds the run.
    """

    def __init__(
        self,
        body: Body,
        *,
        takes: Sequence[Take],
        world: World,
        background: Tensor,
        stages: Sequence[Stage],
        weights: Mapping[str, float],
        clip: float = 1.0,
        config: dict | None = None,
        criterion: Criterion | None = None,
        settings: IdentificationSettings | None = None,
    ) -> None:
        super().__init__()
        check_terms(weights, body.adapter)
        self.automatic_optimization = False
        self.body, self.world, self.takes, self.background = body, world, list(takes), background
        self.first_takes = list(takes)
        self.stages = list(stages)
        self.weights, self.clip, self.config = dict(weights), clip, config or {}
        self.stage_index, self.losses, self.steps_done = 0, [], 0
        self.misfit = MISFIT  # of the model the joint stage starts from, measured when it begins
        self.last: dict[str, float] = {}
        self.criterion, self.settings = criterion or Criterion("free"), settings or IdentificationSettings()
        self.identification: Identification | None = None  # of the running stage, where it is Gauss-Newton's
        self.saved_identification: dict | None = None  # its state in the checkpoint that the fit goes on from
        self.posterior: Posterior | None = None
        self.retreat, self.saved_retreat = Retreat(), None  # of the running stage, where it is Adam's
        self.informed = False  # whether the takes have the cues about the calibrated backbone
        self.compared: dict[str, float] = {}  # mean distance [m] of the calibrated candidates for the backbone
        self.ground_gains: dict[str, float] = {}  # of other contacts about the learned law, once it has been asked
        self.untouched = copy.deepcopy(body.state_dict()) if self.ground_is_sought else None  # what a fit begins again from
        self.grounds: dict[str, float] = {}  # mean distance [m] of the contacts with the ground that were tried

    @classmethod
    def from_config(cls, config: dict, body: Body, *, takes: Sequence[Take | None], background: Tensor) -> LitMosa:
        """The module that fits `body` in the stages of a run. config: what a checkpoint keeps (`mosa.config.run_config`); takes:
        what it learns from, none where it is only used. Errors: ConfigError naming the key."""
        cfg = config["cfg"]
        stages = build_stages(cfg["fit"], body.heterogeneity, body.adapter)
        if not (cfg["reconstruction"].get("informed") or {}).get("iterations", 0):
            stages = [stage for stage in stages if not stage.looks_again]
        return cls(body, takes=takes, world=build_world(config["world"]), background=background, stages=stages,
                   weights=cfg["losses"], clip=cfg["fit"]["clip"], config=config, criterion=build_criterion(cfg),
                   settings=build_identification(cfg))

    # ---------------------------------------------------------------- state
    @property
    def stage(self) -> Stage | None:
        """The running stage; None when all have ended."""
        return self.stages[self.stage_index] if self.stage_index < len(self.stages) else None

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        checkpoint["mosa"] = {"version": VERSION, "config": self.config, "stage": self.stage_index, "losses": list(self.losses),
                              "steps_done": self.steps_done, "particles": len(self.body.rest), "misfit": self.misfit,
                              "start": self.takes[0].start.written(),
                              "identification": self.identification.state() if self.identification else None,
                              "compared": self.compared, "grounds": self.grounds, "ground_gains": self.ground_gains,
                              "retreat": self.retreat.written(),
                              "cues": [take.cues.positions.cpu() for take in self.takes] if self.informed else None,
                              "responses": [take.response and take.response.written() for take in self.takes]
                              if self.informed else None,
                              "posterior": self.posterior.written() if self.posterior else None,
                              "splats": self.body.splats.written() if self.body.splats is not None else None}

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        if "mosa" not in checkpoint:
            raise ConfigError("ckpt_path: the checkpoint was not written by this program (no entry 'mosa')")
        saved = checkpoint["mosa"]
        if saved["particles"] != len(self.body.rest):
            raise ConfigError(f"ckpt_path: expected a body of {len(self.body.rest)} particles, found {saved['particles']}: the "
                              "checkpoint belongs to another scene, reconstruction or simulation.particles")
        self.stage_index, self.losses, self.steps_done = saved["stage"], list(saved["losses"]), saved["steps_done"]
        self.misfit = saved.get("misfit", MISFIT)
        self.saved_identification = saved.get("identification")
        self.saved_retreat = saved.get("retreat")
        self.compared = dict(saved.get("compared") or {})
        if self.compared and (candidates := self.body.material.candidates):
            if (law := saved["config"]["cfg"]["prior"]["law"]) not in candidates:
                raise ConfigError(f"ckpt_path: expected a law among prior.candidates, {', '.join(candidates)}, found {law!r} in "
                                  "the checkpoint: it belongs to another configuration")
            for material in (self.body.material, *(variant["material"] for variant in self.body.frozen.values())):
                material.choose(law)
            self.settle_law()
        self.grounds, self.ground_gains = dict(saved.get("grounds") or {}), dict(saved.get("ground_gains") or {})
        if self.ground_is_sought and (written := saved["config"]["world"]["ground"]) is not None:
            self.settle_ground(Ground(**written))
        self.posterior = Posterior.read(saved["posterior"]) if saved.get("posterior") else None
        if saved.get("cues") is not None and self.takes:
            self.takes, self.informed = with_positions(self.takes, saved["cues"], saved.get("responses")), True
        elif (self.losses and self.stage is not None and (self.stage.looks_again or not self.stage.calibrates)
              and any(take.again for take in self.takes)):  # fmt: skip
            raise ConfigError("ckpt_path: expected the motion that reconstruction.informed finds, as this stage began after it, "
                              "found none in the checkpoint: set reconstruction.informed.iterations=0, as the run had it")

    def settle_law(self) -> None:
        """What is written from now on is a run of the law that was chosen."""
        prior = dict(self.config.get("cfg", {}).get("prior", {}))
        if prior:
            self.config["cfg"]["prior"] = prior | {"law": self.body.material.law, "candidates": []}

    @property
    def ground_is_sought(self) -> bool:
        """Whether nobody said how the ground is touched (scene.ground.mode=auto), and it is not found yet."""
        return ((self.config.get("world") or {}).get("ground") or {}).get("mode") == AUTO

    def settle_ground(self, ground: Ground) -> None:
        """What is simulated and written from now on meets this ground."""
        self.world = replace(self.world, ground=ground)
        self.config["world"]["ground"] = asdict(ground)

    def begin_again(self, ground: Ground) -> None:
        """All stages from the start, on another ground, with the motion that was seen at first: the second look was about a body
        that met the old one."""
        self.settle_ground(ground)
        self.body.load_state_dict(self.untouched)
        self.takes, self.informed = list(self.first_takes), False
        self.stage_index, self.losses, self.identification, self.posterior = 0, [], None, None

    # ---------------------------------------------------------------- one step
    def training_step(self, batch, _index: int) -> None:
        """One iteration of the running stage, begun or ended where it is its first or last. batch: numbers of the views."""
        stage, iteration = self.stage, len(self.losses)
        if iteration == 0:
            self.begin(stage)
        if stage.newton:
            self.newton_step(stage, iteration)
        else:
            self.gradient_step(stage, iteration, batch)

    # ---------------------------------------------------------------- stages
    def begin(self, stage: Stage) -> None:
        """What a stage starts from."""
        if stage.start is not None:
            self.body.thaw(stage.start)
        if self.ground_is_sought and not stage.newton:
            warnings.warn(f"scene.ground.mode: auto asks for fit.{stage.name}.optimizer=gauss_newton, which compares contacts; "
                          "found adam, and the body sticks to the ground: say sticky, slip, separate or touch", stacklevel=1)
            self.settle_ground(self.world.ground)
        if stage.looks_again or not (stage.calibrates or self.informed):
            self.inform(response=stage.newton and not stage.calibrates)
        adapter, material = self.body.adapter, self.body.material
        if stage.learns_adapter and adapter is not None:
            adapter.switch_on(material.reference_modulus(), material.poisson())
            parameters = {k: v.detach() for k, v in material.per_particle(1.0).items()}
            adapter.prepare(material.law, material_states(material.law, parameters, self.body.law_options))
            if self.weights.get("operator", 0.0) != 0:
                self.misfit = max(parallel.mean(self.measure_misfit()), 0.1 * MISFIT)
        parallel.synchronise(self.body)  # on a GPU ranks may come to slightly different numbers

    def inform(self, response: bool = True) -> None:
        """The cues of the takes once more, about what the calibrated backbone predicts; response: and what they keep of that."""
        if any(take.again for take in self.takes):
            self.takes, self.informed = [seen_again(take, self.body, self.world, response) for take in self.takes], True

    @torch.no_grad()
    def measure_misfit(self) -> float:
        """Mean distance of the particles from the reconstruction's, over the object's size, without adapter."""
        misfits = []
        for take in self.takes:
            model = self.body.model().only(adapter=False)
            rollout = self.body.simulate(take.start, self.world, len(take.cues.positions), take.frame_dt, model=model)
            misfits.append(float(losses.position_loss(rollout.x, take.cues.positions, self.body.size)))
        return sum(misfits) / len(misfits)

    def finish(self, stage: Stage) -> None:
        """Keep the stage's result and go on to the next; stop the trainer after the last."""
        self.end(stage)
        if self.stage is None:
            self.trainer.should_stop = True

    def end(self, stage: Stage) -> None:
        """Keep the stage's result as a backbone and go on to the next."""
        for name in stage.keeps:
            self.body.freeze(name)
        self.stage_index, self.losses, self.identification = self.stage_index + 1, [], None
        self.retreat = Retreat()

    def on_train_start(self) -> None:
        if self.stage is None:  # a run that was stopped after its fit
            self.trainer.should_stop = True

    # ---------------------------------------------------------------- logs
    def log_values(self, values: dict[str, Tensor | float]) -> None:
        """These scalars and the parameters, into the logs and `last`."""
        for name, value in self.body.material.physical().items():
            values[f"id/{name}"] = value.detach()
        values["id/contact_offset"] = self.body.contact.lift(self.world.ground).detach()
        self.log_dict({k: torch.as_tensor(v, dtype=torch.float32) for k, v in values.items()}, on_step=True, on_epoch=False)
        self.last |= {k: float(v) for k, v in values.items()}

    @torch.no_grad()
    def strip(self, view: int = 0) -> Tensor:
        """(3, 2 h, T w) strip of one view of the first sequence: real above, rendered below, every frame from left to right."""
        take, body = self.takes[0], self.body
        frames = len(take.cues.positions)
        rollout = body.simulate(take.start, self.world, frames, take.frame_dt)
        targets = take.observations.select([view], frames)
        seen = observe(rollout.x, deformed_covariances(rollout.F_tot, body.covariances), body.opacities, body.colors,
                       targets.cameras, self.background)
        rows = [torch.cat(list(images[0]), 1) for images in (targets.images, seen.images)]
        return torch.cat(rows, 0).clamp(0, 1).permute(2, 0, 1)
