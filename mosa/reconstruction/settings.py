"""Settings of the reconstruction, from the plain keys of conf/reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mosa.errors import ConfigError
from mosa.reconstruction.gaussians.carried import CarriedSettings
from mosa.reconstruction.gaussians.static import FitSettings, StaticSettings
from mosa.reconstruction.geometry.body import GeometrySettings
from mosa.reconstruction.motion.dynamic import DynamicSettings
from mosa.reconstruction.motion.informed import InformedSettings
from mosa.schema import TEXT, check_knobs, knob, known_keys, one_of, or_null, whole


@dataclass(frozen=True)
class ReconstructionSettings:
    """resolution: voxels along the object's longest side in the hull; geometry: what of it is the body; ridge_passes: of
    hull.shave_ridges: the body where geometry.source is hull, else where its refinement starts; points: static Gaussians
    (with static.densify=mcmc at the start); neighbours: of the least-squares deformation; cue: neighbourhood | gaussian
    (docs/cues.md); margin: px of the windows around mattes; splats: 3DGS PLY file of the object at frame 0, in the scene's
    world, that replaces the static stage (None: fit it); informed: the motion once more, about the calibrated
    backbone's, where it is one of modes and the cue that of the neighbourhood."""

    resolution: int = knob(80, whole(8, 1024))  # a hull of that many voxels per side has 4 GB
    ridge_passes: int = knob(24, whole(0, 10**4))
    points: int = knob(3000, whole(8, 10**8))
    neighbours: int = knob(20, whole(4, 1000))  # fewer leave every deformation gradient open
    cue: str = knob("neighbourhood", one_of("neighbourhood", "gaussian"))
    margin: int = knob(6, whole(0, 256))  # of windows in memory, all at once
    splats: str | None = knob(None, or_null(TEXT))
    geometry: GeometrySettings = field(default_factory=GeometrySettings)
    static: StaticSettings = field(default_factory=StaticSettings)
    appearance: FitSettings = field(default_factory=lambda: FitSettings(keep=1.0))
    dynamic: DynamicSettings = field(default_factory=DynamicSettings)
    carried: CarriedSettings = field(default_factory=CarriedSettings)
    informed: InformedSettings = field(default_factory=InformedSettings)

    @property
    def looks_again(self) -> bool:
        """Whether the motion is found once more, informed by a simulation."""
        return (
            self.informed.iterations > 0
            and self.cue == "neighbourhood"
            and self.dynamic.model == "modes"
        )

    def __post_init__(self) -> None:
        check_knobs(self, "reconstruction")
        if self.static.max_points is not None and self.static.max_points < self.points:
            raise ConfigError(
                f"reconstruction.static.max_points: expected at least reconstruction.points={self.points}, the number at the "
                f"start, found {self.static.max_points}"
            )
        free = self.dynamic.free_shape or self.dynamic.model == "network"
        if self.cue == "gaussian" and not free:
            raise ConfigError(
                "reconstruction.cue=gaussian reads the Gaussians' own scale and rotation: set "
                "reconstruction.dynamic.free_shape=true or reconstruction.dynamic.model=network"
            )


def build_settings(**keys: Any) -> ReconstructionSettings:
    """Settings from the plain keys of conf/reconstruction; ConfigError names an unknown key."""
    keys = dict(keys)
    sections = {"geometry": GeometrySettings, "static": StaticSettings, "appearance": FitSettings, "dynamic": DynamicSettings,
                "carried": CarriedSettings, "informed": InformedSettings}  # fmt: skip
    for name, cls in sections.items():
        if name in keys:
            keys[name] = known_keys(f"reconstruction.{name}", cls, keys[name] or {})
    return known_keys("reconstruction", ReconstructionSettings, keys)
