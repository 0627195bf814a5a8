"""What is measured on a fitted body, and with how many points."""

from __future__ import annotations

from dataclasses import dataclass

from mosa.schema import COUNT, FLAG, check_knobs, knob


@dataclass(frozen=True)
class EvaluationSettings:
    """floor: whether the true law, where it is known, is rolled out on the learner's own grid; samples: points of the chamfer
    distance; assignment: points of the exact assignment of the earth mover's distance; video: whether a comparison is filmed.

    Errors: ConfigError naming the key."""

    floor: bool = knob(True, FLAG)
    samples: int = knob(8192, COUNT)
    assignment: int = knob(2048, COUNT)
    video: bool = knob(True, FLAG)

    def __post_init__(self) -> None:
        check_knobs(self, "evaluation")
