"""Steps of Adam on the loss of images and motion: what a stage learns, the loss terms, their gradient, what is logged."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from mosa.data.batches import MotionBatch, SequenceBatch
from mosa.errors import SimulationDiverged
from mosa.modules.adapters.penalties import pool
from mosa.modules.fitting.losses import position_loss
from mosa.modules.fitting.stages import Stage
from mosa.modules.fitting.terms import Extra, Step, evaluate_terms
from mosa.modules.fitting.training_sequences import Take
from mosa.types import Rollout

log = logging.getLogger(__name__)


class KnownGradient(torch.autograd.Function):
    """A loss whose gradient was found already: its backward hands that out.

    Lightning asks for one loss and one backward pass. The graphs of several sequences would then be in memory together; so each
    sequence's gradient is found when its loss is, and only the sums are kept."""

    @staticmethod
    def forward(
        ctx, loss: Tensor, gradients: Sequence[Tensor | None], *parameters: Tensor
    ) -> Tensor:
        ctx.gradients = gradients
        return loss.clone()

    @staticmethod
    def backward(ctx, scale: Tensor):
        return (None, None, *(None if g is None else scale.to(g) * g for g in ctx.gradients))


class GradientSteps:
    """The part of `LitMosa` that runs stages by Adam."""

    def adam(self, stage: Stage) -> dict:
        """The optimiser of a stage and its schedule, as Lightning takes them. The rates follow `Stage.decay`, and are halved with
        every step that was taken back (`Retreat`)."""
        optimizer = torch.optim.Adam(self.groups(stage), betas=(0.9, 0.95))
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, partial(self._rate, stage))
        rate = {"scheduler": schedule, "interval": "step", "name": "lr"}
        return {"optimizer": optimizer, "lr_scheduler": rate}

    def _rate(self, stage: Stage, step: int) -> float:
        return stage.decay(step) * self.retreat.share

    def groups(self, stage: Stage) -> list[dict]:
        """Parameter groups of a stage."""
        body = self.body
        replaced = stage.learns_adapter and body.adapter is not None and body.adapter.replaces_law
        learned = [] if replaced else [p for p in body.material.parameters() if p.requires_grad]
        groups = [{"params": learned, "lr": stage.lr, "name": "material"}]
        if body.contact.enabled:
            params = list(body.contact.parameters())
            groups.append({"params": params, "lr": stage.lr_contact, "name": "contact"})
        if stage.learns_heterogeneity and body.heterogeneity is not None:
            params = list(body.heterogeneity.parameters())
            groups.append({"params": params, "lr": stage.lr_networks, "name": "heterogeneity"})
        if stage.learns_adapter and body.adapter is not None:
            params = [p for p in body.adapter.parameters() if p.requires_grad]
            groups.append({"params": params, "lr": stage.lr_adapter, "name": "adapter"})
        return [group for group in groups if group["params"]]

    def learned(self) -> list[Tensor]:
        """The parameters that the running optimiser moves."""
        return [p for group in self.running_optimizer.param_groups for p in group["params"]]

    def gradient_loss(self, stage: Stage, iteration: int, batch: MotionBatch) -> Tensor | None:
        """Mean loss of all sequences of the batch, whose backward gives the gradient. None where the body cannot be simulated and
        the step before was taken back: Lightning then makes no step."""
        learned = self.learned()
        if self.saved_retreat is not None:
            self.retreat.read(self.saved_retreat, learned)
            self.saved_retreat = None
        self.terms_of_step, self.taken_back = {}, False
        total: list[Tensor | None] = [None] * len(learned)
        try:
            for own in batch.sequences:
                weight = 1 / len(batch.sequences)
                for name, value in self.descend(
                    stage, iteration, own, weight, learned, total
                ).items():
                    self.terms_of_step[name] = self.terms_of_step.get(name, 0.0) + weight * value
            self.check_finite(stage, iteration, total)
        except SimulationDiverged as error:
            if not self.retreat.back(self.running_optimizer, learned):
                raise
            told = (
                "stage %s, iteration %d: the last step is undone, later ones are half as long: %s"
            )
            log.warning(told, stage.name, iteration, error)
            self.taken_back = True
            return None
        return KnownGradient.apply(self.terms_of_step.pop("loss"), total, *learned)

    def after_gradient_step(self, stage: Stage, iteration: int, loss: Tensor | None) -> None:
        """Bookkeeping after the optimiser's step. loss: before it; None where there was none, as the one before was taken back."""
        if self.taken_back:
            self.losses.append(self.losses[-1])
            return
        self.body.contact.project()
        self.losses.append(float(loss))
        self.report(stage, iteration, self.terms_of_step, loss, self.norms)

    def try_last_step(self, stage: Stage) -> None:
        """Take the last step of a stage back where the body cannot be simulated after it: no other one would find out."""
        try:
            model = self.body.model().only(
                heterogeneity=stage.learns_heterogeneity, adapter=stage.learns_adapter
            )
            with torch.no_grad():
                for take in self.takes:
                    self.body.simulate(
                        take.start, self.world, len(take.cues.positions), take.frame_dt, model=model
                    )
        except SimulationDiverged as error:
            if not self.retreat.back(self.running_optimizer, self.learned()):
                raise
            log.warning("stage %s: its last step is undone: %s", stage.name, error)

    def descend(
        self, stage: Stage, iteration: int, own, weight: float, learned: Sequence[Tensor],
        total: list[Tensor | None],
    ) -> dict[str, Tensor]:  # fmt: skip
        """Adds the gradient of one sequence's loss, times `weight`, to `total`; the loss, its terms and what else is logged, not
        weighted. own: its `SequenceBatch`.

        One graph at a time: memory is that of one sequence."""
        take = self.takes[own.index]
        frames = self.active_frames(stage, iteration, take)
        gains = (0.0,) if stage.calibrates else self.criterion.gains
        figures: dict[str, Tensor] = {}
        for gain in gains:
            terms, rollout = self.terms(stage, own, frames, take, gain)
            loss = sum(self.weights.get(name, 0.0) * value for name, value in terms.items())
            if not torch.isfinite(loss):
                bad = [name for name, value in terms.items() if not torch.isfinite(value)]
                raise SimulationDiverged(
                    f"stage {stage.name}, iteration {iteration}: loss terms {bad} are not finite; "
                    "lower fit.*.lr or simulation.courant"
                )
            found = torch.autograd.grad(weight / len(gains) * loss, learned, allow_unused=True)
            for i, (before, more) in enumerate(zip(total, found)):
                total[i] = more if before is None else before if more is None else before + more
            values = {name: value.detach() for name, value in terms.items()} | {
                "loss": loss.detach()
            }
            values["inverted"] = loss.new_tensor(float(rollout.inverted))
            if "mean_abs_C" in self.last:
                values["mean_abs_C"] = loss.new_tensor(self.last["mean_abs_C"])
            for name, value in values.items():
                figures[name] = figures.get(name, 0.0) + value / len(gains)
        return figures

    @torch.no_grad()
    def measure_misfit(self) -> float:
        """Mean distance of the particles from the reconstruction's, over the object's size, without adapter."""
        misfits, body = [], self.body
        for take in self.takes:
            model, seen = body.model().only(adapter=False), take.cues.positions
            x = body.simulate(take.start, self.world, len(seen), take.frame_dt, model=model).x
            misfits.append(float(position_loss(x, seen, body.size)))
        return sum(misfits) / len(misfits)

    def active_frames(self, stage: Stage, iteration: int, take: Take) -> int:
        length = len(take.cues.positions)
        return stage.active_frames(iteration, min(take.first_contact + 3, length), length)

    def terms(
        self, stage: Stage, own: SequenceBatch, frames: int, take: Take, gain: float = 0.0
    ) -> tuple[dict[str, Tensor], Rollout]:
        """Every loss term that has a weight (raw), over the first `frames` frames, and the rollout of `take` they were computed on.

        own: the take's part of the batch, of at least so many frames; gain: of the criterion's rollout, 0 for a free one."""
        body, weights, cues = self.body, self.weights, take.cues
        adapted = stage.learns_adapter and body.adapter is not None
        collected: list = []
        model = body.model().only(heterogeneity=stage.learns_heterogeneity, adapter=adapted)
        rollout = body.simulate(
            take.start, self.world, frames, take.frame_dt, model=model, gain=gain,
            collect=collected.append if adapted else None, observed=cues.positions if gain else None,
        )  # fmt: skip
        # a variance over time as well as over particles
        over_all = pool(collected) if collected else None
        targets = own.observations.select(range(len(own.observations.cameras)), frames)
        varies = stage.learns_heterogeneity and body.heterogeneity is not None
        step = Step(
            body, take.start, rollout, targets, cues, frames, self.background, varies, over_all, self.misfit,
            take.frame_dt, own.views, with_flow=weights.get("flow", 0.0) != 0, extra=Extra(own.extra),
        )  # fmt: skip
        terms = evaluate_terms(weights, step)
        if over_all is not None:
            self.last["mean_abs_C"] = float(over_all.mean_abs_C.detach())
        return terms, rollout

    def check_finite(
        self, stage: Stage, iteration: int, gradients: Sequence[Tensor | None]
    ) -> None:
        """A gradient that is not finite stops the run: it is never zeroed. Errors: SimulationDiverged naming the group."""
        left = iter(gradients)
        for group in self.running_optimizer.param_groups:
            own = [g for g in (next(left) for _ in group["params"]) if g is not None]
            if not all(bool(torch.isfinite(g).all()) for g in own):
                raise SimulationDiverged(
                    f"stage {stage.name}, iteration {iteration}: the gradient of {group['name']} is not "
                    "finite; lower simulation.courant or the learning rate of the stage"
                )

    def configure_gradient_clipping(
        self, optimizer, gradient_clip_val=None, gradient_clip_algorithm=None
    ) -> None:
        """The networks' groups are clipped at fit.clip, then all of them as Trainer(gradient_clip_val) asks."""
        if self.stage is None or self.stage.newton:
            if gradient_clip_val and all(stage.newton for stage in self.stages):
                warnings.warn(
                    "trainer.gradient_clip_val: has no effect in this run: all stages run Gauss-Newton, which has no gradient",
                    stacklevel=1,
                )
            return
        self.norms = self.clip_networks(self.running_optimizer)
        self.clip_gradients(optimizer, gradient_clip_val, gradient_clip_algorithm)

    def clip_networks(self, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Norm of the gradient by parameter group, before the networks' are clipped at fit.clip."""
        names, clipped = [g["name"] for g in optimizer.param_groups], ("heterogeneity", "adapter")
        bounds = {name: self.clip if name in clipped else float("inf") for name in names}
        return {group["name"]: float(torch.nn.utils.clip_grad_norm_(group["params"], bounds[group["name"]]))
                for group in optimizer.param_groups}  # fmt: skip

    def report(
        self, stage: Stage, iteration: int, terms: dict[str, Tensor], loss: Tensor,
        norms: dict[str, float],
    ) -> None:  # fmt: skip
        """Scalars of one step, means over the takes: every term raw and weighted, parameters, mean |C|, gradient norms."""
        values = {
            "loss/total": loss,
            "fit/frames": float(self.active_frames(stage, iteration, self.takes[-1])),
            "fit/stage": float(self.stage_index),
            "fit/inverted": terms.pop("inverted"),
        }
        if "mean_abs_C" in terms:
            values["adapter/mean_abs_C"] = terms.pop("mean_abs_C")
        for name, value in terms.items():
            values[f"loss_raw/{name}"] = value
            values[f"loss_weighted/{name}"] = self.weights[name] * value
        for name, value in norms.items():
            values[f"gradient_norm/{name}"] = value
        self.log_values(values)
