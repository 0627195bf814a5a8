"""How images are rendered, and what they show."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from mosa.settings import Settings


class RenderingSettings(Settings):
    """The section `rendering`."""

    where: ClassVar[str] = "rendering"

    margin: int = Field(6, ge=0, le=256)
    """px around the mattes' box that a training step renders"""
    appearance: Literal["splats", "particles"] = "splats"
    """Gaussians in evaluation, video, viewer and export: splats carried by the rollout, or
    particles"""
