"""Settings of the reconstruction, from the plain keys of conf/reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from mosa.errors import ConfigError
from mosa.reconstruction.carried import CarriedSettings
from mosa.reconstruction.dynamic import DynamicSettings
from mosa.reconstruction.geometry import GeometrySettings
from mosa.reconstruction.informed import InformedSettings
from mosa.reconstruction.static import FitSettings, StaticSettings


@dataclass(frozen=True)
class ReconstructionSettings:
    """resolution: voxels along the object's longest side in the hull; geometry: what of it is the body; ridge_passes: of
    hull.shave_ridges: the body where geometry.source is hull, else where its refinement starts; points: static Gaussians
    (with static.densify=mcmc at the start); neighbours: of the least-squares deformation; cue: neighbourhood | gaussian
    (docs/cues.md); margin: px of the windows around mattes; splats: 3DGS PLY file of the object at frame 0, in the scene's
    world, that replaces the static stage (None: fit it); informed: the motion once more, about the calibrated
    backbone's, where it is one of modes and the cue that of the neighbourhood."""

    resolution: int = 80
    ridge_passes: int = 24
    points: int = 3000
    neighbours: int = 20
    cue: str = "neighbourhood"
    margin: int = 6
    splats: str | None = None
    geometry: GeometrySettings = field(default_factory=GeometrySettings)
    static: StaticSettings = field(default_factory=StaticSettings)
    appearance: FitSettings = field(default_factory=lambda: FitSettings(keep=1.0))
    dynamic: DynamicSettings = field(default_factory=DynamicSettings)
    carried: CarriedSettings = field(default_factory=CarriedSettings)
    informed: InformedSettings = field(default_factory=InformedSettings)

    @property
    def looks_again(self) -> bool:
        """Whether the motion is found once more, informed by a simulation."""
        return self.informed.iterations > 0 and self.cue == "neighbourhood" and self.dynamic.model == "modes"

    def __post_init__(self) -> None:
        if self.cue not in ("neighbourhood", "gaussian"):
            raise ConfigError(f"reconstruction.cue: expected neighbourhood or gaussian, found {self.cue!r}")
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


def _section(cls: type, values: Mapping[str, Any], where: str) -> Any:
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected a section of keys, found {str(values)[:80]!r}")
    known = {f.name for f in fields(cls)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}, expected one of {', '.join(sorted(known))}")
    return cls(**values)


def build_settings(**keys: Any) -> ReconstructionSettings:
    """Settings from the plain keys of conf/reconstruction; ConfigError names an unknown key."""
    keys = dict(keys)
    sections = {"geometry": GeometrySettings, "static": StaticSettings, "appearance": FitSettings, "dynamic": DynamicSettings,
                "carried": CarriedSettings, "informed": InformedSettings}  # fmt: skip
    for name, cls in sections.items():
        if name in keys:
            keys[name] = _section(cls, keys[name] or {}, f"reconstruction.{name}")
    return _section(ReconstructionSettings, keys, "reconstruction")
