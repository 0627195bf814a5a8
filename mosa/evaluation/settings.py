"""What is measured on a fitted body, and with how many points."""

from __future__ import annotations

from typing import ClassVar

from mosa.settings import Count, Settings


class EvaluationSettings(Settings):
    """The section `evaluation`."""

    where: ClassVar[str] = "evaluation"

    floor: bool = True
    """built-in scenes: simulate the true law on the learner's grid (row floor)"""
    samples: Count = 8192
    """points of the chamfer distance"""
    assignment: Count = 512
    """points of the exact assignment of the earth mover's distance"""
    video: bool = True
    """make video.mp4"""
