"""What the configuration says of an identification: what is compared, which prior the learned numbers have, the noise, weights."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval
from pydantic import ConfigDict, Field

from mosa.settings import Positive, Settings, Text, Weight


class Criterion(Settings):
    """What a fit compares with the motion that was seen. Calibration compares free rollouts by Adam, of laws that yield or flow,
    and with adaptive substeps."""

    where: ClassVar[str] = "criterion"
    needs: ClassVar[dict[str, str]] = {"gain": "name!=free"}

    name: Literal["free", "corrected", "both"] = "corrected"
    """corrected: after every frame the velocities are corrected towards what was seen, and the next frame is predicted; free:
    rollouts from the start, as the paper has it; both: each with half of the weight"""
    gain: float = Field(0.5, gt=0, le=1)
    """corrected: share of the distance from the observation that the corrected velocity closes in a frame"""

    @property
    def gains(self) -> tuple[float, ...]:
        """One rollout is compared for each; 0 is the free one."""
        return {"free": (0.0,), "corrected": (self.gain,), "both": (0.0, self.gain)}[self.name]


class IdentificationSettings(Settings):
    """Gauss-Newton (`Identification`): which prior the learned numbers have, and the noise."""

    where: ClassVar[str] = "identification"
    needs: ClassVar[dict[str, str]] = {"*": "newton"}

    count: Positive = 30.0
    """independent data in a frame of the cues: neighbouring particles move alike"""
    grid_error: Annotated[float, Interval(ge=0, le=10)] = 1.0
    """of the grid, in differences from one that is 1.25 times as coarse: no frame is trusted beyond it, and a multiple of it is
    identified beside the law; 0: none, and for the parts of the law an assumed one"""
    model_error: float = Field(0.02, ge=0, le=1)
    """error of the simulation from other causes, in grid cells"""
    operator_sd: Positive = 0.1
    """prior standard deviation of the adapter's numbers, before the evidence finds their size"""
    stiffness_sd: Positive = 0.12
    """prior standard deviation of the stiffness modes, as `operator_sd`; it falls with the wave number k as (1 + (k/2)^2)^(-1/2)"""
    known: Text | None = None
    """checkpoint of another fit, or material.json of mosa-material: what it says of the law's
    numbers is their prior (docs/several_recordings.md)"""
    tolerance: Positive = 0.3
    """a stage ends when its last step is this small, in standard deviations of the posterior"""
    threads: int = Field(0, ge=0, le=256)
    """rollouts side by side on a CPU; 0: one for each core, at most 8"""


class LossWeights(Settings):
    """Weights of the loss terms (`mosa/modules/fitting/losses.py`); 0 switches a term off. Terms of extensions are further keys."""

    model_config = ConfigDict(extra="allow")
    where: ClassVar[str] = "losses"
    needs: ClassVar[dict[str, str]] = {
        "image mask flow heterogeneity operator operator_variance further": "adam",
        "rotation stretch": "adapted",
    }
    __pydantic_extra__: dict[str, Weight] = Field(init=False)

    image: Weight = 1.0
    """rendered images"""
    mask: Weight = 1.0
    """rendered mattes"""
    flow: Weight = 1.0
    """optical flow"""
    rotation: Weight = 0.1
    """cue of rotation; Gauss-Newton uses it if the weight is above 0"""
    stretch: Weight = 0.1
    """cue of stretch; Gauss-Newton uses it if the weight is above 0"""
    heterogeneity: Weight = 0.1
    """size of the heterogeneity"""
    position: Weight = 1.0
    """not in the paper: particle positions of the reconstruction, over the object's size;
    Gauss-Newton uses it if the weight is above 0"""
    operator: Weight = 0.0
    """not in the paper: root mean square of the entries of C and of L_pre, L_post, as in a group lasso. The weight applies if the
    calibrated prior misses the reconstruction by 1 % of the object's size, and falls as 1 / misfit^2 (misfit: of the model that the
    joint stage starts from, at least 0.1 %)"""
    operator_variance: Weight = 0.0
    """not in the paper: variance of the operator over particles and states"""

    def weights(self) -> dict[str, Any]:
        """By term."""
        return self.model_dump()
