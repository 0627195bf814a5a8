"""Steps of Adam on the loss of images and motion: what a stage learns, the loss terms, their gradient, the step."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor

from mosa import parallel
from mosa.errors import MosaError, SimulationDiverged
from mosa.modules.penalties import pool
from mosa.modules.stages import Stage
from mosa.modules.takes import Take
from mosa.modules.terms import Step, evaluate_terms
from mosa.types import Rollout

log = logging.getLogger(__name__)


class GradientSteps:
    """The part of `LitMosa` that runs stages by Adam."""

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

    def gradient_step(self, stage: Stage, iteration: int, views: list[int]) -> None:
        """One step of Adam on the mean loss of all takes, in these views. The step before is taken back where the body cannot be
        simulated after it."""
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
