"""LightningModule of the fit: wires body, simulation, rendering and losses; logs; steps. The mathematics lives elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import lightning as L
import torch
from torch import Tensor

from mosa import losses, parallel
from mosa.checkpoints import VERSION
from mosa.config import build_criterion, build_identification, build_stages, build_world
from mosa.errors import ConfigError, DataError, MosaError, SimulationDiverged
from mosa.modules.body import Body, World
from mosa.modules.criteria import Criterion
from mosa.modules.gauss_newton import Posterior
from mosa.modules.identification import Identification, IdentificationSettings, choose_law
from mosa.modules.material import material_states
from mosa.modules.observer import deformed_covariances, observe
from mosa.modules.penalties import MISFIT, pool
from mosa.modules.residuals import SAMPLES
from mosa.modules.restorable import Restorable
from mosa.modules.retreat import Retreat
from mosa.modules.stages import Stage
from mosa.modules.takes import Take, seen_again, with_positions
from mosa.modules.terms import Step, check_terms, evaluate_terms
from mosa.progress import tqdm
from mosa.types import Rollout

log = logging.getLogger(__name__)


class LitMosa(Restorable, L.LightningModule):
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
                              "compared": self.compared, "retreat": self.retreat.written(),
                              "cues": [take.cues.positions.cpu() for take in self.takes] if self.informed else None,
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
        self.posterior = Posterior.read(saved["posterior"]) if saved.get("posterior") else None
        if saved.get("cues") is not None and self.takes:
            self.takes, self.informed = with_positions(self.takes, saved["cues"]), True
        elif (self.losses and self.stage is not None and (self.stage.looks_again or not self.stage.calibrates)
              and any(take.again for take in self.takes)):  # fmt: skip
            raise ConfigError("ckpt_path: expected the motion that reconstruction.informed finds, as this stage began after it, "
                              "found none in the checkpoint: set reconstruction.informed.iterations=0, as the run had it")

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.groups(stage), betas=(0.9, 0.95)) for stage in self.stages]

    def groups(self, stage: Stage) -> list[dict]:
        """Parameter groups of a stage; `rate` keeps the learning rate before decay."""
        body = self.body
        replaced = stage.learns_adapter and body.adapter is not None and body.adapter.replaces_law
        learned = [] if replaced else [p for p in body.material.parameters() if p.requires_grad]
        groups = [{"params": learned, "rate": stage.lr, "name": "material"}]
        if body.contact.enabled:
            groups.append({"params": list(body.contact.parameters()), "rate": stage.lr_contact, "name": "contact"})
        if stage.learns_heterogeneity and body.heterogeneity is not None:
            groups.append({"params": list(body.heterogeneity.parameters()), "rate": stage.lr_networks, "name": "heterogeneity"})
        if stage.learns_adapter and body.adapter is not None:
            params = [p for p in body.adapter.parameters() if p.requires_grad]
            groups.append({"params": params, "rate": stage.lr_adapter, "name": "adapter"})
        return [{**g, "lr": g["rate"]} for g in groups if g["params"]]

    # ---------------------------------------------------------------- one step
    def training_step(self, batch, _index: int) -> None:
        views = batch
        stage = self.stage
        iteration = len(self.losses)
        if iteration == 0:
            self.begin(stage)
        if stage.newton:
            self.newton_step(stage, iteration)
            return
        optimizer = self.optimizers()
        optimizer = optimizer[self.stage_index] if isinstance(optimizer, list) else optimizer
        learned = [p for group in optimizer.param_groups for p in group["params"]]
        if self.saved_retreat is not None:
            self.retreat.read(self.saved_retreat, learned)
            self.saved_retreat = None
        for group in optimizer.param_groups:
            group["lr"] = group["rate"] * stage.decay(iteration) * self.retreat.share
        optimizer.zero_grad()
        figures, failure = {}, None
        try:
            for index, own, weight in parallel.share(len(self.takes), views):
                for name, value in self.descend(stage, iteration, self.takes[index], own, weight).items():
                    figures[name] = figures.get(name, 0.0) + weight * value
        except MosaError as error:
            failure = error
        try:
            parallel.agree(failure)
            terms = parallel.exchange(learned, figures)
            norms = self.gradient_norms(optimizer, stage, iteration)
        except SimulationDiverged as error:  # on every rank alike
            if not self.retreat.back(optimizer, learned):
                raise
            log.warning("stage %s, iteration %d: the step before is taken back, and steps are half as long from here: %s",
                        stage.name, iteration, error)
            self.losses.append(self.losses[-1])
            self.steps_done += 1
        else:
            loss = terms.pop("loss")
            self.retreat.note(learned)
            optimizer.step()
            self.body.contact.project()
            self.losses.append(float(loss))
            self.steps_done += 1
            self.report(stage, iteration, terms, loss, norms)
        if stage.ended(self.losses):
            self.try_last_step(stage, optimizer, learned)
            self.finish(stage)

    def try_last_step(self, stage: Stage, optimizer: torch.optim.Optimizer, learned: Sequence[Tensor]) -> None:
        """Take the last step of a stage back where the body cannot be simulated after it: no other one would find out."""
        failure = None
        try:
            model = self.body.model().only(heterogeneity=stage.learns_heterogeneity, adapter=stage.learns_adapter)
            with torch.no_grad():
                for take in self.takes:
                    self.body.simulate(take.start, self.world, len(take.cues.positions), take.frame_dt, model=model)
        except MosaError as error:
            failure = error
        try:
            parallel.agree(failure)
        except SimulationDiverged as error:
            if not self.retreat.back(optimizer, learned):
                raise
            log.warning("stage %s: its last step is taken back: %s", stage.name, error)

    def newton_step(self, stage: Stage, iteration: int) -> None:
        """One iteration of Gauss-Newton: of all numbers on all takes, without images."""
        failure, found = None, {}
        try:
            if self.identification is None:
                saved = self.saved_identification if iteration > 0 else None
                self.identification = self.begun(stage, saved)
            found = self.identification.iterate()
        except MosaError as error:
            failure = error
        parallel.agree(failure)
        parallel.synchronise(self.body)  # ranks do the same work, and on a GPU come to slightly different numbers
        self.losses.append(found["after"])
        self.steps_done += 1
        self.report_newton(found)
        if self.identification.converged or stage.ended(self.losses):
            self.keep_posterior(stage)
            self.finish(stage)

    def begun(self, stage: Stage, saved: Mapping[str, Any] | None = None) -> Identification:
        """A stage's identification, ready for its first iteration, or for the next one where `saved` is what a checkpoint kept."""
        searched = bool(self.body.material.candidates)  # then the best of them is where its calibration left it
        if searched:
            self.compared = choose_law(self.body, self.body.material.candidates, lambda: self.identifying(stage))
            self.settle_law()
        identification = self.identifying(stage)
        if saved is not None:
            self.go_on(identification, saved)
        elif stage.calibrates and not searched and not stage.looks_again:
            identification.search()
        return identification

    def keep_posterior(self, stage: Stage) -> None:
        """Of the running identification, where it is the last one."""
        alone = self.body.adapter is None and self.body.heterogeneity is None  # then the calibration is all there is
        if stage.learns_adapter or (stage.calibrates and alone):
            self.posterior = self.identification.posterior()

    def identify(self) -> None:
        """All stages by Gauss-Newton without a trainer: nothing is logged or kept. Errors: those of an iteration."""
        for stage in self.stages[self.stage_index :]:
            self.begin(stage)
            self.identification = self.begun(stage)
            for _ in tqdm(range(stage.iterations), f"stage {stage.name}", leave=False):
                self.identification.iterate()
                if self.identification.converged:
                    break
            self.keep_posterior(stage)
            self.end(stage)

    def identifying(self, stage: Stage) -> Identification:
        """A stage's identification on the takes, from where the body stands."""
        kinds = tuple(self.weights.get(name, 0.0) != 0 for name in ("position", "rotation", "stretch"))
        return Identification(self.body, self.takes, self.world, stage, self.criterion, self.settings, kinds)

    def go_on(self, identification: Identification, saved: Mapping[str, Any]) -> None:
        """The identification as a checkpoint has it, whose containers were checked. Errors: DataError where it is another fit's."""
        expected = [len(self.takes[i].cues.positions) - 1 for i, _ in identification.pairs]
        samples = min(len(self.body.rest), SAMPLES)
        for name, size in (("noise", ()), ("grid", (samples, 3))):
            found = saved.get(name)
            if found is not None and [[tuple(t.shape) for t in each] for each in found] != [[(T, *size)] * 3 for T in expected]:
                raise DataError(f"ckpt_path: mosa.identification.{name}: expected tensors of {expected} frames after the "
                                "first, found others: the checkpoint belongs to another configuration")
        if len(saved["factors"]) != (count := len(identification.newton.blocks)):
            raise DataError(f"ckpt_path: mosa.identification.factors: expected {count} numbers, found {len(saved['factors'])}: "
                            "the checkpoint belongs to another configuration")
        identification.restore(dict(saved))

    def settle_law(self) -> None:
        """What is written from now on is a run of the law that was chosen."""
        prior = dict(self.config.get("cfg", {}).get("prior", {}))
        if prior:
            self.config["cfg"]["prior"] = prior | {"law": self.body.material.law, "candidates": []}

    def report_newton(self, found: dict[str, float]) -> None:
        """Scalars of one iteration: cost, step, what the evidence found, parameters."""
        values = {"loss/total": found["after"], "fit/stage": float(self.stage_index), "newton/share": found["share"],
                  "newton/length": found["length"]}
        values |= {f"newton/{name}": value for name, value in found.items() if name.startswith("sd/")}
        values["fit/distance_m"] = self.identification.distance()
        self.log_values(values)

    def descend(self, stage: Stage, iteration: int, take: Take, views: list[int], weight: float) -> dict[str, Tensor]:
        """Add the gradient of one take's loss, times `weight`; the loss, its terms and what else is logged, not weighted.

        One graph at a time: memory is that of one sequence.
        """
        frames = self.active_frames(stage, iteration, take)
        gains = (0.0,) if stage.calibrates else self.criterion.gains
        figures: dict[str, Tensor] = {}
        for gain in gains:
            for name, value in self._descend(stage, iteration, take, views, weight / len(gains), frames, gain).items():
                figures[name] = figures.get(name, 0.0) + value / len(gains)
        return figures

    def _descend(
        self, stage: Stage, iteration: int, take: Take, views: list[int], weight: float, frames: int, gain: float
    ) -> dict[str, Tensor]:
        """`descend` for one of the criterion's rollouts."""
        terms, rollout = self.terms(stage, views, frames, take, gain)
        loss = sum(self.weights.get(name, 0.0) * value for name, value in terms.items())
        if not torch.isfinite(loss):
            bad = [name for name, value in terms.items() if not torch.isfinite(value)]
            raise SimulationDiverged(f"stage {stage.name}, iteration {iteration}: loss terms {bad} are not finite; "
                                     "lower fit.*.lr or simulation.courant")
        self.manual_backward(weight * loss)
        figures = {name: value.detach() for name, value in terms.items()} | {"loss": loss.detach()}
        figures["inverted"] = loss.new_tensor(float(rollout.inverted))
        if "mean_abs_C" in self.last:
            figures["mean_abs_C"] = loss.new_tensor(self.last["mean_abs_C"])
        return figures

    def active_frames(self, stage: Stage, iteration: int, take: Take) -> int:
        length = len(take.cues.positions)
        return stage.active_frames(iteration, min(take.first_contact + 3, length), length)

    def terms(
        self, stage: Stage, views: list[int], frames: int, take: Take | None = None, gain: float = 0.0
    ) -> tuple[dict[str, Tensor], Rollout]:
        """Every loss term that has a weight (raw), and the rollout of `take` (the first where None) they were computed on.

        gain: of the criterion's rollout, 0 for a free one."""
        take = self.takes[0] if take is None else take
        body, weights, cues = self.body, self.weights, take.cues
        adapted = stage.learns_adapter and body.adapter is not None
        collected: list = []
        rollout = body.simulate(
            take.start, self.world, frames, take.frame_dt,
            model=body.model().only(heterogeneity=stage.learns_heterogeneity, adapter=adapted),
            collect=collected.append if adapted else None, observed=cues.positions if gain else None, gain=gain,
        )
        over_all = pool(collected) if collected else None  # a variance over time as well as over particles
        targets = take.observations.select([v % len(take.observations.cameras) for v in views], frames)
        varies = stage.learns_heterogeneity and body.heterogeneity is not None
        step = Step(body, take.start, rollout, targets, cues, frames, self.background, varies, over_all, self.misfit,
                    with_flow=weights.get("flow", 0.0) != 0)
        terms = evaluate_terms(weights, step)
        if over_all is not None:
            self.last["mean_abs_C"] = float(over_all.mean_abs_C.detach())
        return terms, rollout

    def gradient_norms(self, optimizer, stage: Stage, iteration: int) -> dict[str, float]:
        """Norm per parameter group; the networks' are clipped. A non-finite one stops the run: it is never zeroed."""
        norms = {}
        for group in optimizer.param_groups:
            bound = self.clip if group["name"] in ("heterogeneity", "adapter") else float("inf")
            norm = float(torch.nn.utils.clip_grad_norm_(group["params"], bound))
            if norm != norm or norm == float("inf"):
                raise SimulationDiverged(f"stage {stage.name}, iteration {iteration}: the gradient of {group['name']} is not "
                                         "finite; lower simulation.courant or the learning rate of the stage")
            norms[group["name"]] = norm
        return norms

    # ---------------------------------------------------------------- stages
    def begin(self, stage: Stage) -> None:
        """What a stage starts from."""
        if stage.start is not None:
            self.body.thaw(stage.start)
        if stage.looks_again or not (stage.calibrates or self.informed):
            self.inform()
        adapter, material = self.body.adapter, self.body.material
        if stage.learns_adapter and adapter is not None:
            adapter.switch_on(material.reference_modulus(), material.poisson())
            parameters = {k: v.detach() for k, v in material.per_particle(1.0).items()}
            adapter.prepare(material.law, material_states(material.law, parameters, self.body.law_options))
            if self.weights.get("operator", 0.0) != 0:
                self.misfit = max(parallel.mean(self.measure_misfit()), 0.1 * MISFIT)
        parallel.synchronise(self.body)  # on a GPU ranks may come to slightly different numbers

    def inform(self) -> None:
        """The cues of the takes once more, about what the calibrated backbone predicts."""
        if any(take.again for take in self.takes):
            self.takes, self.informed = [seen_again(take, self.body, self.world) for take in self.takes], True

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
    def report(self, stage: Stage, iteration: int, terms: dict[str, Tensor], loss: Tensor, norms: dict[str, float]) -> None:
        """Scalars of one step, means over the takes: every term raw and weighted, parameters, mean |C|, gradient norms."""
        values = {"loss/total": loss, "fit/frames": float(self.active_frames(stage, iteration, self.takes[-1])),
                  "fit/stage": float(self.stage_index), "fit/inverted": terms.pop("inverted")}
        if "mean_abs_C" in terms:
            values["adapter/mean_abs_C"] = terms.pop("mean_abs_C")
        for name, value in terms.items():
            values[f"loss_raw/{name}"] = value
            values[f"loss_weighted/{name}"] = self.weights[name] * value
        for name, value in norms.items():
            values[f"gradient_norm/{name}"] = value
        self.log_values(values)

    def log_values(self, values: dict[str, Tensor | float]) -> None:
        """These scalars and the parameters, into the logs and `last`."""
        for name, value in self.body.material.physical().items():
            values[f"id/{name}"] = value.detach()
        values["id/contact_offset"] = self.body.contact().detach()
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
