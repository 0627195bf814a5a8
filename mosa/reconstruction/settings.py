"""Settings of the reconstruction: the section `reconstruction`."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval
from pydantic import Field, model_validator

from mosa.errors import ConfigError
from mosa.settings import Count, Positive, Settings, Share, Text, Weight, Whole, Width

Layers = Annotated[int, Interval(ge=1, le=100)]
AtLeastOne = Annotated[float, Interval(ge=1)]


class GeometrySection(Settings):
    """What of the visual hull is the body (docs/seeing.md)."""

    where: ClassVar[str] = "reconstruction.geometry"
    needs: ClassVar[dict[str, str]] = {"frames": "source=images"}

    source: Literal["images", "hull", "gaussians"] = "images"
    """images: carved by colours, refined by colours and the outlines of all free frames; hull: the
    hull with its ridges rounded; gaussians: what lies behind the static Gaussians in every view
    (GIC, the paper)"""
    frames: Count = 6
    """frames of free flight whose outlines and colours are used, at most"""


class FitSettings(Settings):
    """How Gaussians are fitted to images. Steps are Adam's."""

    where: ClassVar[str] = "reconstruction.appearance"

    iterations: Whole = 400
    """steps"""
    views: Count = 2
    """images in a step"""
    lr_positions: Weight = 0.03
    """learning rate of positions, in units of the mean scale"""
    lr_scales: Weight = 0.02
    """learning rate of the logarithms of scales"""
    ssim: Share = 0.2
    """weight of 1 - SSIM; the rest is L1"""
    matte: Weight = 1.0
    """weight of the matte's error"""
    keep: Weight = 0.0
    """weight of the initial colour, in pixels of an image"""
    largest: AtLeastOne = 2.0
    """largest scale of a Gaussian, over its initial scale"""
    shape: Literal["isotropic", "anisotropic"] = "isotropic"
    """anisotropic: three scales and a rotation each, which start isotropic"""
    axis_ratio: AtLeastOne = 10.0
    """anisotropic Gaussians: largest over smallest scale, at most"""


class StaticSettings(FitSettings):
    """The static stage: Gaussians fitted to frame 0."""

    where: ClassVar[str] = "reconstruction.static"

    relocate_every: Whole = 100
    """steps between relocations of vanished Gaussians to opaque ones; 0: never"""


class CarriedSettings(FitSettings):
    """The static Gaussians, fitted to all training frames as the observed motion carries them: what images show."""

    where: ClassVar[str] = "reconstruction.carried"
    needs: ClassVar[dict[str, str]] = {"[!i]*": "iterations!=0"}

    views: Count = 4
    """images in a step"""
    keep: Weight = 1.0
    """weight of the initial colour, in pixels of an image"""
    shape: Literal["isotropic", "anisotropic"] = "anisotropic"
    """anisotropic: three scales and a rotation each"""
    degree: int = Field(1, ge=0, le=3)
    """degree of the spherical harmonics"""
    keep_harmonics: Weight = 10.0
    """weight of zero harmonics, in pixels of an image: keeps colours plain in directions that no
    training camera sees"""
    light: bool = True
    """fit a light that stays fixed while the body turns"""


class InformedSettings(Settings):
    """The motion once more, about what the calibrated backbone predicts (docs/cues.md)."""

    where: ClassVar[str] = "reconstruction.informed"
    needs: ClassVar[dict[str, str]] = {
        "views lr elastic bending response carriers": "iterations!=0"
    }

    iterations: Whole = 80
    """steps; 0: no second fit"""
    views: Count = 1
    """images of every frame in a step"""
    lr: Positive = 0.02
    """learning rate, in units of the object's radius"""
    elastic: Weight = 0.3
    """weight of the elastic energy of the difference from the prediction"""
    bending: Weight = 1.0
    """weight of the curvature of the difference from the prediction"""
    response: Whole = 4
    """views of every frame from which the cues' bias towards the prediction is measured; 0: it is
    not removed"""
    carriers: Literal["auto", "fitted", "first"] = "auto"
    """Gaussians compared with the images: fitted to all frames, in their light; first: those of the
    first motion; auto: first of a body that yields or flows, which the first motion may have
    lost"""


class DynamicSettings(Settings):
    """The motion of the particles. Steps are in units of the object's radius, for all amplitudes of a frame together."""

    where: ClassVar[str] = "reconstruction.dynamic"
    needs: ClassVar[dict[str, str]] = {
        "modes": "model=modes",
        "bases hidden basis_layers coefficient_layers *_frequencies lr_network frames": "model=network",
    }

    model: Literal["modes", "network"] = "modes"
    """modes: amplitudes of smooth modes in each frame; network: motion bases (GIC)"""
    carriers: Literal["static", "particles"] = "static"
    """Gaussians compared with the images: static: those of the static stage, moved by the motion;
    particles: one for each particle (the paper)"""
    modes: Count = 120
    """number of modes"""
    free_shape: bool = False
    """scale and rotation of the Gaussians are free and do not follow the deformation; always true
    for the network"""
    track_iterations: Whole = 40
    """steps of a frame in the first pass"""
    track_views: Count = 4
    """images in a step of the first pass"""
    iterations: Whole = 150
    """steps of the joint refinement"""
    views: Count = 1
    """images of every frame in a step of the refinement"""
    lr: Weight = 0.01
    """learning rate of the refinement"""
    ssim: Share = 0.0
    """weight of 1 - SSIM; the rest is L1"""
    matte: Weight = 1.0
    """weight of the matte's error"""
    elastic: Weight = 0.01
    """weight of the mean St. Venant-Kirchhoff energy"""
    bending: Weight = 3.5
    """weight of the modes' mean squared curvature, in units of the body's size"""
    bending_scale: Weight = 0.001
    """curvature of a frame from which on that weight falls in the refinement; 0: never. Thick
    bodies stay below 0.001 but for their first impact; the limbs of a thin one truly bend by 0.005
    to 0.04"""
    poisson: float = Field(0.3, ge=0, le=0.49)
    """Poisson ratio of the elastic energy"""
    bases: Width = 10
    """network: motion bases"""
    hidden: Width = 256
    """network: width"""
    basis_layers: Layers = 8
    """network: layers of the bases"""
    coefficient_layers: Layers = 3
    """network: layers of the coefficients"""
    space_frequencies: int = Field(4, ge=0, le=16)
    """network: sines and cosines of a position; GIC: 10"""
    time_frequencies: int = Field(5, ge=0, le=16)
    """network: sines and cosines of the time; GIC: 6"""
    lr_network: Weight = 5e-4
    """network: learning rate"""
    frames: Count | None = None
    """network: frames in a step of the refinement, drawn at random; null: all; GIC: 1"""


class ReconstructionSettings(Settings):
    """The section `reconstruction`: body, appearance and motion from images."""

    where: ClassVar[str] = "reconstruction"
    needs: ClassVar[dict[str, str]] = {"static": "splats=null"}

    resolution: int = Field(80, ge=8, le=1024)
    """voxels along the object's longest side in the visual hull"""
    ridge_passes: int = Field(24, ge=0, le=10**4)
    """passes that round the hull's ridges, where the cones of two outlines meet; 0: none"""
    points: int = Field(3000, ge=8, le=10**8)
    """static Gaussians"""
    neighbours: int = Field(20, ge=4, le=1000)
    """neighbours from which a particle's deformation gradient is fitted; fewer than 4 do not
    determine it"""
    cue: Literal["neighbourhood", "gaussian"] = "neighbourhood"
    """source of the cues of rotation and stretch (docs/cues.md); gaussian needs
    dynamic.free_shape=true or the network"""
    margin: int = Field(6, ge=0, le=256)
    """px around the mattes in the windows that are kept in memory"""
    splats: Text | None = None
    """3DGS PLY of the object at frame 0, in the scene's world, that replaces the static stage"""
    geometry: GeometrySection = GeometrySection()
    """the body inside the visual hull"""
    static: StaticSettings = StaticSettings()
    """static Gaussians"""
    appearance: FitSettings = FitSettings(keep=1.0)
    """appearance of the particles"""
    dynamic: DynamicSettings = DynamicSettings()
    """motion of the body"""
    carried: CarriedSettings = CarriedSettings()
    """Gaussians carried by the motion"""
    informed: InformedSettings = InformedSettings()
    """second fit of the motion, from the calibrated law's prediction"""

    @property
    def looks_again(self) -> bool:
        """Whether the motion is found once more, informed by a simulation."""
        modes = self.cue == "neighbourhood" and self.dynamic.model == "modes"
        return modes and self.informed.iterations > 0

    @model_validator(mode="after")
    def _together(self) -> ReconstructionSettings:
        free = self.dynamic.free_shape or self.dynamic.model == "network"
        if self.cue == "gaussian" and not free:
            raise ConfigError(
                "reconstruction.cue=gaussian reads the Gaussians' own scale and rotation: set "
                "reconstruction.dynamic.free_shape=true or reconstruction.dynamic.model=network"
            )
        return self


def build_settings(**keys: Any) -> ReconstructionSettings:
    """Settings from the plain keys of conf/reconstruction. Errors: ConfigError naming the key."""
    return ReconstructionSettings.read(keys)
