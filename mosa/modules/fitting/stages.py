"""The staged schedule: what is optimised when, and when a stage ends."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from mosa.errors import ConfigError
from mosa.settings import Count, Positive, Settings, Weight, Whole

STAGES = ("prior", "prior_eta", "joint")


class StageSettings(Settings):
    """A section of `fit`: how one stage is learned."""

    where: ClassVar[str] = "fit.*"
    needs: ClassVar[dict[str, str]] = {
        "newton_iterations": "newton",
        "iterations lr lr_networks lr_adapter lr_contact converged": "adam",
    }

    optimizer: Literal["auto", "gauss_newton", "adam"] = "auto"
    """auto: Gauss-Newton if the stage learns no network (adapter=operator, linear or none, heterogeneity.kind=modes), else Adam"""
    newton_iterations: Count = 8
    """iterations of Gauss-Newton, at most, each with a Jacobian of its own"""
    looks: Whole = 0
    """stage `prior` by Gauss-Newton: further calibrations at most, each after a second fit of the motion, until that
    settles; laws that yield or flow are then calibrated on the mattes once. 0: neither"""
    iterations: Whole
    """steps of Adam; 0 leaves the stage out, also by Gauss-Newton"""
    lr: Weight
    """Adam's rate, on the logarithms and logits of the global parameters"""
    lr_networks: Weight = 0.0
    """Adam's rate of the heterogeneity field"""
    lr_adapter: Weight = 0.0
    """Adam's rate of the adapter"""
    lr_contact: Weight = 0.0
    """Adam's rate of the contact offset [cells]"""
    converged: Weight = 0.0
    """Adam: stop when the mean loss of 10 iterations differs by less, relatively, from that of the
    10 before; 0: never"""
    start: Literal["prior", "prior_eta"] | None = None
    """stage `joint`: the stage from whose parameters and eta it starts"""


class Stage(StageSettings):
    """One stage of the fit, as it runs."""

    name: Literal["prior", "prior_eta", "joint", "networks"]
    looks_again: bool = False
    """Whether it is a calibration that goes on from the one before, with the motion found once more about that one's result. What
    flows or yields is seen too poorly by a reconstruction that knows no mechanics: the calibrated law says what images do not."""
    silhouettes: bool = False
    """Whether it is the last of these, and compares outlines in place of cues, which are not found again but are its prior."""

    @property
    def calibrates(self) -> bool:
        """Whether the stage learns the global parameters alone."""
        return self.name == "prior"

    @property
    def section(self) -> str:
        """The section of `fit` that it is read from."""
        return "joint" if self.name == "networks" else self.name

    @property
    def learns_heterogeneity(self) -> bool:
        return not self.calibrates

    @property
    def learns_adapter(self) -> bool:
        return self.name in ("joint", "networks")

    @property
    def keeps(self) -> tuple[str, ...]:
        """The backbones that its result is kept as. Calibration's is also what later stages go on from, should the one between them
        be left out."""
        return {"prior": ("prior_eta", "prior"), "prior_eta": ("prior_eta",)}.get(self.name, ())

    def learns(
        self, heterogeneity: object | None, adapter: object | None
    ) -> tuple[object | None, ...]:
        """Of these parts of a body those that the stage learns beside the global parameters; None for one that the body has not."""
        return (heterogeneity,) * self.learns_heterogeneity + (adapter,) * self.learns_adapter

    @property
    def newton(self) -> bool:
        """Whether the stage runs Gauss-Newton, once `resolved`."""
        return self.optimizer == "gauss_newton"

    def resolved(self, few: bool) -> Stage:
        """With the optimiser that it runs. few: whether Gauss-Newton can learn all that the stage learns.

        Errors: ConfigError where it is asked for and cannot."""
        if self.optimizer == "gauss_newton" and not few:
            raise ConfigError(
                f"fit.{self.name}.optimizer: gauss_newton learns few numbers (adapter=operator, linear or none, "
                "heterogeneity.kind=modes), not networks; expected adam or auto"
            )
        chosen = "adam" if self.optimizer == "adam" or not few else "gauss_newton"
        newton = chosen == "gauss_newton" and self.iterations > 0
        iterations = self.newton_iterations if newton else self.iterations
        return self.but(optimizer=chosen, iterations=iterations)

    def decay(self, iteration: int) -> float:
        """Factor of the learning rates: constant for the first half, then a cosine down to a tenth."""
        progress = max(0.0, 2 * iteration / max(self.iterations, 1) - 1)
        return 0.55 + 0.45 * math.cos(math.pi * min(progress, 1.0))

    def active_frames(self, iteration: int, first: int, total: int) -> int:
        """Frames that enter progressively in the first stage: from `first` to all over the first third of its iterations."""
        if not self.calibrates:
            return total
        ramp = max(1, self.iterations // 3)
        return min(total, max(2, first + math.ceil((total - first) * iteration / ramp)))

    def ended(self, losses: list[float]) -> bool:
        """Whether the stage is over after iterations with these losses."""
        if len(losses) >= self.iterations:
            return True
        ramp = max(1, self.iterations // 3)
        if self.converged <= 0 or len(losses) < ramp + 20:
            return False
        last, before = sum(losses[-10:]) / 10, sum(losses[-20:-10]) / 10
        return abs(last - before) < self.converged * abs(before)


def recalibrations(stages: list[Stage]) -> list[Stage]:
    """With those that follow a calibration which is all there is, as many as it asks for, and a last one by silhouettes."""
    if len(stages) != 1 or not stages[0].newton or not stages[0].looks:
        return stages
    looks = [stages[0].but(looks_again=True)] * stages[0].looks
    return [*stages, *looks, stages[0].but(looks_again=True, silhouettes=True)]


class FitSection(Settings):
    """The section `fit`: the stages, and what Adam's steps read."""

    where: ClassVar[str] = "fit"
    needs: ClassVar[dict[str, str]] = {"views clip": "adam"}

    views: Count = 2
    """Adam: cameras that a step renders"""
    clip: Positive = 1.0
    """Adam: bound of the gradient norm of the networks"""
    prior: StageSettings = StageSettings(
        newton_iterations=8, looks=8, iterations=40, lr=0.1, lr_contact=0.03, converged=1e-3
    )
    """first stage: the calibrated prior"""
    prior_eta: StageSettings = StageSettings(
        newton_iterations=1, iterations=20, lr=0.02, lr_networks=5e-3
    )
    """second stage: with the stiffness over the body"""
    joint: StageSettings = StageSettings(
        newton_iterations=8,
        iterations=40,
        lr=0.01,
        lr_networks=2e-3,
        lr_adapter=5e-3,
        start="prior",
    )
    """last stage: with the adapter; twice for networks that begin at learned numbers
    (adapter=mosa_from_linear), the second time by Adam"""

    def stage(self, name: str) -> Stage:
        """Of this name. Errors: ConfigError."""
        return Stage(name=name, **dict(getattr(self, name)))
