"""The staged schedule: what is optimised when, and when a stage ends."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, fields, replace

from mosa.errors import ConfigError
from mosa.schema import COUNT, WEIGHT, check_knobs, knob, one_of, or_null, whole

STAGES = ("prior", "prior_eta", "joint")


@dataclass(frozen=True)
class Stage:
    """One stage of the fit.

    iterations: of Adam; optimizer: auto | gauss_newton | adam, auto being the first where all that is learned has few numbers;
    newton_iterations: of Gauss-Newton, at most. The rates are Adam's. lr: global parameters; lr_networks: heterogeneity field;
    lr_adapter: adapter; lr_contact [cells]: contact offset;
    converged: relative change of the mean loss of 10 iterations below which the stage ends (0: run all iterations);
    start: backbone whose parameters the stage starts from (joint: prior | prior_eta); looks: of prior, where nothing else is
    learned and Gauss-Newton does: how often it goes on from the motion found once more about its own result (`Recalibration`).
    """

    name: str
    iterations: int = knob(MISSING, whole(0))
    lr: float = knob(MISSING, WEIGHT)
    lr_networks: float = knob(0.0, WEIGHT)
    lr_adapter: float = knob(0.0, WEIGHT)
    lr_contact: float = knob(0.0, WEIGHT)
    converged: float = knob(0.0, WEIGHT)
    start: str | None = knob(None, or_null(one_of("prior", "prior_eta")))
    optimizer: str = knob("auto", one_of("auto", "gauss_newton", "adam"))
    newton_iterations: int = knob(8, COUNT)
    looks: int = knob(0, whole(0))

    def __post_init__(self) -> None:
        if self.name not in STAGES:
            raise ConfigError(
                f"fit: expected a stage among {', '.join(STAGES)}, found {self.name!r}"
            )
        check_knobs(self, f"fit.{self.name}")

    @property
    def calibrates(self) -> bool:
        """Whether the stage learns the global parameters alone, from free rollouts of which more and more frames count."""
        return self.name == "prior"

    @property
    def looks_again(self) -> bool:
        """Whether it is a calibration that begins with the motion found once more, each time anew."""
        return False

    @property
    def learns_heterogeneity(self) -> bool:
        return not self.calibrates

    @property
    def learns_adapter(self) -> bool:
        return self.name == "joint"

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
                f"fit.{self.name}.optimizer: gauss_newton learns few numbers (adapter=operator or none, "
                "heterogeneity.kind=modes), not networks; expected adam or auto"
            )
        chosen = "adam" if self.optimizer == "adam" or not few else "gauss_newton"
        iterations = (
            min(self.iterations, self.newton_iterations)
            if chosen == "gauss_newton"
            else self.iterations
        )
        return replace(self, optimizer=chosen, iterations=iterations)

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


@dataclass(frozen=True)
class Recalibration(Stage):
    """A calibration that goes on from the one before, with the motion found once more about that one's result. What flows or yields
    is seen too poorly by a reconstruction that knows no mechanics; each look lets the calibrated law say what images do not."""

    @property
    def looks_again(self) -> bool:
        return True


def recalibrations(stages: list[Stage]) -> list[Stage]:
    """With those that follow a calibration which is all there is, as many as it asks for."""
    if len(stages) != 1 or not stages[0].newton:
        return stages
    own = {f.name: getattr(stages[0], f.name) for f in fields(Stage)}
    return stages + [Recalibration(**own) for _ in range(stages[0].looks)]
