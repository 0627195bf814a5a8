"""Iterations of Gauss-Newton on the distance between motion cues and rollouts, of all numbers of a stage at once."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mosa.errors import DataError, SimulationDiverged
from mosa.modules.body.body import Body
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.identification import EVIDENCE_ITERATIONS, Identification
from mosa.modules.fitting.parameters import is_learned
from mosa.modules.fitting.search.backbone import choose_law
from mosa.modules.fitting.search.ground import (
    EXPLAINED,
    RIVAL_ITERATIONS,
    choose_ground,
    gains_of_contacts,
    learned_on,
    named,
)  # fmt: skip
from mosa.modules.fitting.search.parts import PARTS, chosen
from mosa.modules.fitting.search.parts import named as named_parts
from mosa.modules.fitting.search.yielding import lasting
from mosa.modules.fitting.stages import Stage
from mosa.physics.constitutive.laws import law_named
from mosa.types import Ground

log = logging.getLogger(__name__)


class NewtonSteps:
    """The part of `LitMosa` that runs stages by Gauss-Newton."""

    known: Posterior | None
    columns: Tensor | None
    """(R, D) of the joint stage's first pass, where the stage before has made it."""

    def newton_loss(self, stage: Stage, iteration: int) -> Tensor:
        """Minus the logarithm of the posterior at the numbers as they stand; the optimiser goes on from there."""
        if self.identification is None:
            saved = self.saved_identification if iteration > 0 else None
            self.identification = self.begun(stage, saved)
        return torch.tensor(self.identification.prepare())

    def after_newton_step(self) -> None:
        """Bookkeeping after the optimiser's step."""
        found = self.identification.report
        self.losses.append(found["after"])
        self.report_newton(found)

    def begun(self, stage: Stage, saved: Mapping[str, Any] | None = None) -> Identification:
        """A stage's identification, ready for its first iteration, or for the next one where `saved` is what a checkpoint kept."""
        searched = False  # else the best of the candidates is where its calibration left it
        if self.ground_is_sought and stage.calibrates:
            self.find_ground(stage)
            searched = True
        if self.body.material.candidates:
            again, searched = searched, True
            self.compared = choose_law(
                self.body,
                self.body.material.candidates,
                lambda: self.identifying(stage),
                lambda: lasting(self.body, self.takes, self.world),
            )
            self.choose(self.body.material.law)
            if again and not law_named(self.body.material.law).elastic:
                self.find_ground(stage)  # what was found before was found with an elastic law
        identification = self.identifying(stage)
        if saved is not None:
            self.go_on(identification, saved)
        elif stage.calibrates and not searched and not stage.looks_again:
            identification.search()
        elif not stage.calibrates:
            self.share_columns(stage, identification)
        return identification

    def take_up(self, stage: Stage) -> None:
        """The identification of a stage whose last iteration another process made: what the end of a stage asks of it comes with
        an iteration, whose step is not taken."""
        self.identification = found = self.begun(stage, self.saved_identification)
        numbers = found.newton.seats[0].read()
        found.iterate()
        found.newton.seats[0].write(numbers)

    def share_columns(self, stage: Stage, identification: Identification) -> None:
        """Where the stages `prior_eta` and `joint` begin at the same numbers, the first Jacobian of the joint stage contains the
        other one's: it is made once, in `prior_eta`. A fit that is resumed between them makes it again."""
        if stage.learns_adapter:
            identification.first, self.columns = self.columns, None
            return
        later, learned = self.stages[self.stage_index + 1 :][:1], is_learned(self.body.adapter)
        if not (later and later[0].newton and later[0].start == "prior" and learned):
            return
        body = copy.deepcopy(self.body)
        body.switch_on()
        ahead = self.identifying(later[0], body=body)
        self.columns, names = ahead.columns(), ahead.newton.names()
        own = [names.index(name) for name in identification.newton.names()]
        identification.first = self.columns[:, own + [-1] * identification.two_grids]

    def find_ground(self, stage: Stage) -> None:
        """How the body touches the ground, by a calibration on each that may be."""
        ground, self.grounds = choose_ground(
            self.body, self.world.ground, lambda each: self.identifying(stage, each)
        )
        self.settle_ground(ground)

    def better_ground(self, stage: Stage) -> Ground | None:
        """Where the ground was sought and a law has been learned on what was found: another contact that explains the motion
        better, about that law. None where there is none, and once the fit has begun again. Of frictions that differ by less than
        that the fit takes the best, and stays where it was fitted to it."""
        if not stage.learns_adapter or not self.grounds or self.ground_gains:
            return None
        found, running = self.world.ground, self.identification
        gains, fit = gains_of_contacts(
            found, self.grounds, running, lambda ground: self.fitted_on(ground, stage)
        )
        if not gains:
            return None
        self.ground_gains = {named(ground): each for ground, each in gains.items()}
        best = max(gains, key=gains.get)
        begins_again = gains[best] > EXPLAINED
        moves = not begins_again and learned_on(named(found), self.ground_gains) == named(best)
        log.info("ground: %s explains the motion %s than %s (by %.1f of the logarithm of the likelihood)%s", named(best),
                 "better" if gains[best] > 0 else "worse", named(found), abs(gains[best]),
                 "; the fit begins again with it" if begins_again else "; the fit continues with it" if moves else "")  # fmt: skip
        if moves:
            self.go_to(best, fit)
        return best if begins_again else None

    def better_law(self, stage: Stage) -> str | None:
        """Where the backbone was chosen among candidates by their isotropic forms: another one of them that explains the motion
        better with what was learned about it. None where there is none, and once the fit has begun again."""
        if not stage.learns_adapter or not self.compared or self.law_gains:
            return None
        own = self.identification.cost()
        law = law_named(self.body.material.law)
        others = [
            n for n in self.compared if n != law.name and law.elastic and law_named(n).elastic
        ]
        gains = {law: own - self.fitted_on(self.world.ground, stage, law)[0] for law in others}
        self.law_gains = {law: gain for law, gain in gains.items() if math.isfinite(gain)}
        best = max(self.law_gains, key=self.law_gains.get, default=None)
        if best is None or self.law_gains[best] <= EXPLAINED:
            return None
        log.info("prior=auto: with the learned correction %s explains the motion better than %s (by %.1f of the logarithm of "
                 "the likelihood); the fit begins again with it", best, self.body.material.law, self.law_gains[best])  # fmt: skip
        return best

    def goes_back(self, stage: Stage) -> bool:
        """Begins all stages again where another ground or backbone explains the motion better at the end of `stage`, with the cues
        as they were found first: the second look was about the old ones."""
        ground = self.better_ground(stage)
        law = self.better_law(stage) if ground is None else None
        if ground is not None:
            self.settle_ground(ground)
        elif law is not None:
            self.choose(law)
        else:
            return False
        self.body.load_state_dict(self.unfitted(), strict=self.body.adapter is not None)
        self.takes, self.informed = list(self.first_takes), False
        self.stage_index, self.losses, self.identification, self.posterior = 0, [], None, None
        self.stage_over, self.columns = False, None
        return True

    def go_to(self, ground: Ground, fit: Identification) -> None:
        """From now on the fit is another one, which was made on this ground; `body` has its numbers."""
        self.settle_ground(ground)
        self.body.load_state_dict(fit.body.state_dict())
        self.identification = fit

    def fitted_on(
        self, ground: Ground, stage: Stage, law: str | None = None
    ) -> tuple[float, Identification]:
        """(cost, fit) of the running identification on a ground after `RIVAL_ITERATIONS`, from the same numbers and under the same
        noise; infinite where the body cannot be simulated there. The fit itself stays where it stands. law: of the backbone; None:
        as it is."""
        body, state = copy.deepcopy(self.body), self.identification.state()
        body.material.law = law or body.material.law
        other = self.identifying(stage, ground, body=body)
        other.restore(state | {"iteration": max(state["iteration"], EVIDENCE_ITERATIONS)})
        try:
            other.iterate_until_converged(RIVAL_ITERATIONS)
        except SimulationDiverged:
            return math.inf, other
        return other.report["after"], other

    def keep_posterior(self, stage: Stage) -> None:
        """Of the running identification, where it is the last one, after `settle_parts`."""
        # then the calibration is all there is
        alone = self.body.adapter is None and self.body.heterogeneity is None
        if stage.learns_adapter:
            names = self.identification.newton.names()
            self.posterior = self.settle_parts(stage).posterior().among(names)
        elif stage.calibrates and alone:
            self.posterior = self.identification.posterior()

    def settle_parts(self, stage: Stage) -> Identification:
        """The running identification, or that of a law with fewer parts where `search.parts` takes it, which the body then is.
        Without parts it is the prior, calibrated once more. What the first cues said of its numbers is then their prior, unless
        the law yields, of which they say too little: where a law's form is wrong, later cues alone move those that they hardly
        determine."""
        body, own = self.body, self.identification
        self.parts = own.held_back()
        if not self.parts or (best := chosen(self.parts)) == named_parts(own.parts):
            return own
        kept = [part for part in PARTS if part in best.split("+")]
        alone = not kept and self.weights.get("position", 0.0) != 0
        log.info("parts of the law that are kept: %s; errors of held-back frames: %s%s", best, ", ".join(
            f"{name} {1e3 * error:.2f} mm" for name, error in self.parts.items()),
            "; cues of rotation and stretch had no part in its numbers" * alone)  # fmt: skip
        with torch.no_grad():
            if "operator" in own.parts and "operator" not in kept:
                body.adapter.numbers.zero_()
            if "stiffness" in own.parts and "stiffness" not in kept:
                body.heterogeneity.coefficients.zero_()
        if not kept:
            body.thaw("prior")
        fewer = self.identifying(stage if kept else self.stages[0], parts=kept)
        known = fewer.newton.known
        if not kept and self.informed and not self.is_plastic():
            first = self.identifying(self.stages[0], parts=kept, takes=self.first_takes)
            first.iterate_until_converged(stage.iterations)
            fewer.newton.known = first.posterior()
        fewer.iterate_until_converged(stage.iterations)
        fewer.newton.known = known  # the posterior counts no image twice
        return fewer

    def identifying(
        self, stage: Stage, ground: Ground | None = None, parts: Sequence[str] = PARTS, body: Body | None = None,
        takes: Sequence | None = None,
    ) -> Identification:  # fmt: skip
        """A stage's identification on the takes, from where the body stands. ground: another one than the world's; parts: those
        that the law may have; body, takes: others than this fit's."""
        world = self.world if ground is None else replace(self.world, ground=ground)
        kinds = tuple(
            self.weights.get(name, 0.0) != 0 for name in ("position", "rotation", "stretch")
        )
        return Identification(
            body or self.body, takes or self.takes, world, stage, self.criterion, self.settings, kinds,
            parts=parts, known=self.posterior if stage.silhouettes else self.known,
        )  # fmt: skip

    def go_on(self, identification: Identification, saved: Mapping[str, Any]) -> None:
        """The identification as a checkpoint has it, whose containers were checked. Errors: DataError where it is another fit's."""
        expected = [len(self.takes[i].cues.positions) - 1 for i, _ in identification.pairs]
        samples = len(identification.chosen)
        for name, size in (("noise", ()), ("grid", (samples, 3))):
            found = saved.get(name)
            if found is not None and [[tuple(t.shape) for t in each] for each in found] != [
                [(T, *size)] * 3 for T in expected
            ]:
                raise DataError(
                    f"ckpt_path: mosa.identification.{name}: expected tensors of {expected} frames after the "
                    "first, found others: the checkpoint belongs to another configuration"
                )
        if len(saved["factors"]) != (count := len(identification.newton.blocks)):
            raise DataError(
                f"ckpt_path: mosa.identification.factors: expected {count} numbers, found {len(saved['factors'])}: "
                "the checkpoint belongs to another configuration"
            )
        identification.restore(dict(saved))

    def report_newton(self, found: dict[str, float]) -> None:
        """Scalars of one iteration: cost, step, what the evidence found, parameters."""
        values = {
            "loss/total": found["after"],
            "fit/stage": float(self.stage_index),
            "newton/share": found["share"],
            "newton/length": found["length"],
        }
        values |= {
            f"newton/{name}": value for name, value in found.items() if name.startswith("sd/")
        }
        values["fit/distance_m"] = self.identification.distance()
        self.log_values(values)

    def figures(self) -> dict[str, float]:
        """What was searched: distances [m] and gains of backbones and contacts, errors [m] of held-back frames."""
        found = {f"id_prior/compared/{law}_m": each for law, each in self.compared.items()}
        found |= {f"id_prior/gain/{law}": gain for law, gain in self.law_gains.items()}
        found |= {f"held_back/{name}_m": error for name, error in self.parts.items()}
        if self.parts:
            found["held_back/position_weight"] = self.weights.get("position", 0.0)
        found |= {f"id_prior/ground/{k}_m": v for k, v in self.grounds.items() if math.isfinite(v)}
        gains = self.ground_gains.items()
        return found | {f"id_prior/ground/{k}_gain": v for k, v in gains if math.isfinite(v)}
