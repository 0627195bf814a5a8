"""Settings of the commands whose packages nothing else needs: splats, capture, environments, material tests."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval, Len
from pydantic import Field

from mosa.config.command_settings import EvalSettings, Extensions, LawSections, TrainSettings
from mosa.modules.body.settings import HeterogeneitySettings
from mosa.settings import (
    Count,
    Entries,
    Expected,
    Folder,
    Four,
    Names,
    Pixels,
    Positive,
    Seed,
    Settings,
    Share,
    Text,
    Three,
    Weight,
    Zoom,
    is_number,
    such,
)

Period = Annotated[
    list[float], Expected("two numbers [from, to] in seconds"), such(lambda v: len(v) == 2 and v[0] < v[1])
]  # fmt: skip
Corners = Annotated[list[Three], Expected("two corners [[x, y, z], [x, y, z]]"), Len(2, 2)]
Direction = Annotated[
    list[float], Expected("a direction of three numbers, not zero"), Len(3, 3), such(any)
]
Views = Annotated[list[Three], Expected("a list of such"), Len(1)]
Rate = Annotated[float, Interval(ge=1, le=1e5)]
Readout = Annotated[float, Interval(ge=0, le=0.1)]
Seconds = Annotated[float, Interval(gt=0, le=60)]
Spacing = Annotated[float, Interval(ge=1e-4, le=1)]
Scan = Literal["auto", "down", "up", "left", "right"]


class GroundSection(Settings):
    """The ground that an object falls onto."""

    where: ClassVar[str] = "ground"

    mode: Literal["sticky", "slip", "separate", "touch"] = "separate"
    """kind of contact (docs/twin.md#colliders)"""
    friction: Weight = 0.5
    """Coulomb's coefficient, of separate and touch"""


class FilmSection(Settings):
    """The video of an object that falls."""

    where: ClassVar[str] = "film"

    size: Pixels = 400
    """px, [width, height]; one number: of a square. The caption's two bars add 26 px each to the
    height: 160 gives 160 x 212"""
    fps: Positive | None = None
    """frames per second; null: 0.3 of real time; the value of `rate`: real time"""
    view: Three | Views | None = None
    """direction from the object to the camera in the file's axes, or a list of such, [[x, y, z],
    ...], through which the camera turns about `up` while the film goes on; null: from the side, a
    little above"""
    zoom: Zoom = 1.0
    """magnification, or a list like [1, 3] or [1, 4, 2, 1], spread evenly over the film; 1: all of the
    motion is in the picture. Above 1 the camera follows the object"""
    shadow: bool = True
    """shadows of the object and the obstacles on the ground, under light from above"""
    caption: bool = True
    """title and times, above and below the picture"""


class SplatsSettings(LawSections):
    """python -m mosa.splats"""

    heterogeneity: HeterogeneitySettings = HeterogeneitySettings(enabled=False)
    """variation of the stiffness, which an object of a file has none of"""
    extensions: Extensions = []
    ply: Text
    """3DGS PLY (INRIA's layout) of the object"""
    ckpt_path: Text | None = None
    """a run whose law the object gets, in place of `prior`"""
    device: Text = "cpu"
    """cpu, cuda or `cuda:<number>`"""
    size: Positive | None = None
    """m, of the object's longest side; null: the file is in metres"""
    up: Three = [0, 1, 0]
    """upwards in the file's axes, which the scene keeps; COLMAP: [0, -1, 0]"""
    box: Corners | None = None
    """[[x, y, z], [x, y, z]] in the file's units: what lies in it is the object; null: all"""
    opacity: Share = 0.1
    """Gaussians with a smaller opacity are left out"""
    open_below: bool = False
    """the underside was never filmed: it is closed"""
    resolution: int = Field(80, ge=8, le=512)
    """voxels along the longest side of the solid that the Gaussians enclose"""
    share: float = Field(0.9, gt=0, le=1)
    """a place is inside if this share of 26 rays from it ends at Gaussians"""
    density: Positive | None = None
    """kg/m^3; null: 1000, or that of the run or preset"""
    preset: Text | None = None
    """jelly, silicone_10A, natural_rubber, clay, honey or dry_sand; refused beside prior, adapter
    and ckpt_path"""
    appearance: Literal["splats", "particles"] = "splats"
    """what is shown; particles: for fluids and sand"""
    gravity: Weight = 9.81
    """m/s^2"""
    height: Weight = 0.2
    """m, of the lowest particle above the ground"""
    ground: GroundSection = GroundSection()
    """the ground"""
    colliders: Entries | None = []
    """obstacles, such as {type: sphere, radius: 0.05, position: [0, 0.05, 0]}: as world.colliders
    of train.py, in the file's axes, in metres"""
    recentre: bool = False
    """the origin becomes the point of the ground below the object's middle"""
    rotation: Four | None = None
    """[ax, ay, az, degrees] about the body's centre, in the file's axes, before it falls"""
    velocity: Three = [0, 0, 0]
    """[vx, vy, vz] m/s, in the file's axes"""
    angular_velocity: Three = [0, 0, 0]
    """[wx, wy, wz] rad/s about the body's centre, in the file's axes"""
    frames: Count = 40
    """number of frames"""
    rate: Positive = 30
    """simulated frames per second"""
    formats: Names = ["ply"]
    """ply, gltf, sog: a file for each frame; usd, rrd: one file (docs/splats.md)"""
    video: bool = True
    """make simulation.mp4"""
    film: FilmSection = FilmSection()
    """the video"""


class PhoneSection(Settings):
    """What one phone has otherwise."""

    fps: Rate | None = None
    """frames per second as they were taken"""
    scan: Scan = "auto"
    """where the sensor's next row lies in the picture"""
    readout: Readout | None = None
    """s from the sensor's first row to its last"""


class CaptureSettings(Settings):
    """python -m mosa.capture"""

    videos: Folder
    """folder of videos, one of each phone"""
    poses: Folder
    """folder of a COLMAP model (.bin or .txt), or a transforms.json; images named as the videos"""
    output: Folder
    """folder that gets transforms.json, images, capture.md"""
    like: Folder | None = None
    """folder of an earlier capture by the same phones, whose world (scale, up, ground) this one
    gets"""
    mattes: Literal["plates", "masks"] = "plates"
    """plates: empty backgrounds; masks: videos of masks, of any other program"""
    plates: Folder | None = None
    """folder of `<phone>.png`, .jpg or .mp4; null: plates beside or in the videos' folder"""
    plate_seconds: Period | None = None
    """[from, to] of each video's clock in which it shows the empty background"""
    masks: Folder | None = None
    """folder of mask videos `<phone>.mp4`, white: the object"""
    fps: Rate | None = None
    """frames per second as they were taken; null: what the videos say (slow motion: set it)"""
    scan: Scan = "auto"
    """where the sensor's next row lies in the picture; auto: from the video"""
    readout: Readout | None = None
    """s from the sensor's first row to its last; null: found from the fall"""
    phones: dict[str, PhoneSection] | None = None
    """settings of single phones: {phone3: {fps: 240, scan: left, readout: 0.01}}"""
    max_offset: Seconds = 5.0
    """s by which the videos' beginnings may be apart"""
    flight: Period | None = None
    """[from, to] s on the first phone's clock, of the free fall; null: found"""
    gravity: float = Field(9.81, ge=0.01, le=1000)
    """m/s^2"""
    scale: Annotated[float, Interval(ge=1e-6, le=1e6)] | None = None
    """metres per unit of the poses; null: from the acceleration of the fall"""
    up: Direction | None = None
    """upwards in the poses' world; null: against the acceleration of the fall"""
    ground: Three | None = None
    """a point of the floor in the poses' world; null: where the object is lowest"""
    rate: Annotated[float, Interval(ge=1, le=2000)] | None = None
    """frames per second that are written; null: the slowest phone's"""
    before: Seconds = 0.1
    """s of free fall that are written"""
    after: Seconds = 0.25
    """s after the end of the free fall that are written"""
    colours: Literal["floor", "none"] = "floor"
    """floor: the phones' colours are matched by the floor that all plates show; none: no
    matching"""


class TruthSection(Settings):
    """The hidden truth of a built-in scene."""

    where: ClassVar[str] = "truth"

    scene: Text | None = None
    """built-in scene; null: that of the run"""
    spacing: Spacing | None = None
    """m, particle spacing of the truth; null: that of the films"""


class SearchSection(Settings):
    """policy=gradient, model"""

    where: ClassVar[str] = "search"

    iterations: Count = 60
    """number of iterations"""
    batch: int = Field(16, ge=1, le=10**5)
    """trials per iteration"""
    rate: float = Field(0.02, gt=0, le=10)
    """gradient: Adam's learning rate, falling to a tenth"""
    clip: Positive = 0.5
    """gradient: largest norm of one trial's gradient with respect to one action"""
    every: Count = 10
    """iterations between validations"""
    validation: Count = 32
    """validation trials, in the training simulator"""
    candidates: int = Field(32, ge=4, le=10**9)
    """model: candidate batches per iteration"""
    spread: Positive = 0.4
    """model: initial standard deviation of actions about those of the policy"""


OPTIONS = (
    "steps substeps low high near lean still tilt aim askew far close aside free leaning hardest before grip shut closing squeeze "
    "unsteady_tilt unsteady_aim unsteady_throw"
).split()
"""Fields of the tasks' classes (docs/environments.md)."""


class EnvironmentsSettings(Settings):
    """python -m mosa.environments"""

    extensions: Extensions = []
    task: Text = "placement"
    """placement or hanging, or the name of a task of an extension"""
    checkpoint: Text | None = None
    """checkpoint of a run: source of the learned and of the isotropic twin"""
    simulator: Annotated[
        str | Annotated[list[str], Len(1)], Expected("a name, or a list of names")
    ] = "learned"
    """simulator to train in: learned, isotropic or truth; a list makes a table"""
    seed: Seed = 0
    """seed of one policy"""
    seeds: Annotated[list[Seed], Expected("a list of whole numbers"), such(bool)] = [0, 1, 2]
    """seeds of the table"""
    policy: Text = "gradient"
    """gradient or model"""
    trials: Count = 100
    """number of tests, in the truth and in the training simulator"""
    device: Text = "cpu"
    """cpu, cuda or `cuda:<number>`"""
    worlds: Count | Literal["auto"] = "auto"
    """tests that run together; auto: 8 on a CPU, all of them on a GPU"""
    out: Text | None = None
    """folder of the results; null: the run folder"""
    jobs_only: bool = False
    """run the jobs of a list without making the table: for several processes that share one
    `out`"""
    films: int = Field(3, ge=0, le=100)
    """number of tests that are filmed, the first ones"""
    options: Annotated[
        dict[str, Any],
        Expected("numbers by the names of the task's fields"),
        such(lambda v: all(value is None or is_number(value) for value in v.values())),
    ] = dict.fromkeys(OPTIONS)
    """fields of the task's class (docs/environments.md); null: their defaults"""
    truth: TruthSection = TruthSection()
    """the hidden truth"""
    search: SearchSection = SearchSection()
    """the search of a policy"""


class MaterialSettings(LawSections):
    """mosa-material"""

    extensions: Extensions = []
    tests: Text
    """csv: test, mode, first, stress_1, ... (docs/material_tests.md)"""
    unit: Literal["Pa", "kPa", "MPa"]
    """unit of the file's stresses"""
    stress: Literal["nominal", "cauchy"] = "nominal"
    """of the file: force over the undeformed area, or true stress: over the area now"""
    incompressible: bool = True
    """true: the volume is constant; false: lateral stretches are solved for so that free faces
    carry no stress"""
    symmetry: Literal["full", "orthotropic"] = "full"
    """symmetry of the learned stiffness; orthotropic: mirrors across x, y and z"""
    evidence: bool = True
    """whether the stiffness' numbers have a prior, of a size by the evidence; false: least squares
    alone, as published fits: nearer to the tests, farther from those left out"""
    starts: int = Field(4, ge=1, le=100)
    """starts of the least squares; the best result is kept"""
    leave_out: bool = True
    """fit once more without each test, and predict that test"""
    known: Text | None = None
    """checkpoint of a fit, or material.json of other tests: what it says of the law's numbers is
    their prior (docs/several_recordings.md)"""
    density: Positive = 1000
    """kg/m^3, density of the cube in checkpoints/specimen.ckpt"""


COMMANDS: dict[str, type[Settings]] = {
    "train": TrainSettings, "eval": EvalSettings, "splats": SplatsSettings, "capture": CaptureSettings,
    "environments": EnvironmentsSettings, "material": MaterialSettings,
}  # fmt: skip
"""By the name of the file in conf/."""
