"""What is measured on a fitted body, and with how many points."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from mosa.settings import Count, Settings


class EvaluationSettings(Settings):
    """The section `evaluation`."""

    where: ClassVar[str] = "evaluation"

    floor: bool = Field(
        True, description="built-in scenes: simulate the true law on the learner's grid (row floor)"
    )
    samples: Count = Field(8192, description="points of the chamfer distance")
    assignment: Count = Field(
        2048, description="points of the exact assignment of the earth mover's distance"
    )
    video: bool = Field(True, description="make video.mp4 and strip.png")
