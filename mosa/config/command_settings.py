"""All settings of each command, one model for each: what its configuration may say, the defaults, and a line on every key.

Models of sections stay in the packages that use them; importing them takes no torch, so that a command line is read at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval, Len
from pydantic import ConfigDict, Field

from mosa.evaluation.settings import EvaluationSettings
from mosa.modules.body.settings import HeterogeneitySettings, PriorSection, WorldSection
from mosa.modules.body.simulation_settings import SimulationSection
from mosa.modules.fitting.identification_settings import (
    Criterion,
    IdentificationSettings,
    LossWeights,
)
from mosa.modules.fitting.stages import FitSection
from mosa.reconstruction.settings import ReconstructionSettings
from mosa.rendering.settings import RenderingSettings
from mosa.settings import (
    Count,
    Entries,
    Expected,
    Folder,
    Four,
    Names,
    Number,
    Section,
    Seed,
    Settings,
    Text,
    Three,
    such,
)

FIGURES = ("train", "test", "camera", "prior", "prior_eta", "id", "id_prior", "floor", "time", "posterior", "geometry", "frames",
           "val")  # fmt: skip
"""What the names of figures begin with."""
Figure = Annotated[
    str, Expected("a figure's name like test/rms_m (docs/figures.md)"), such(lambda v: "/" in v and v.split("/")[0] in FIGURES)
]  # fmt: skip
Sequences = Annotated[
    list[Any], Expected("a list of names or folders like [a, b], or of sections like {path: a, frames: [0, 9]}"),
    such(lambda v: all(isinstance(s, str) or (isinstance(s, Mapping) and isinstance(s.get("path"), str)) for s in v)),
]  # fmt: skip
Extensions = Annotated[
    Names | None,
    Field(description="modules that register laws, adapters, loss terms, metrics, formats (docs/extending.md)"),
]  # fmt: skip


Place = Annotated[
    list[float | None], Expected("three numbers, null for one that is left as it is"), Len(3, 3)
]


class AdapterSection(Settings):
    """The section `adapter`. Its other keys are the arguments of the adapter that is named (`mosa.modules.adapters`)."""

    model_config = ConfigDict(extra="allow")
    where: ClassVar[str] = "adapter"

    name: Text | None = None
    """the adapter, by the name that it is registered with; null: none"""


class SceneSection(Settings):
    """The section `scene`. Its other keys are the arguments of the format's loader (docs/data.md)."""

    model_config = ConfigDict(extra="allow")
    where: ClassVar[str] = "scene"

    also_train: Sequences | None = None
    """further sequences to learn from (docs/several_recordings.md)"""
    test: Sequences | None = None
    """held-out sequences, which results report as `test/<name>`"""
    cache: Folder | None = None
    """folder of computed files; null: mosa/ in the user's cache folder"""


class LawSections(Settings):
    """What a body's law is built from."""

    seed: Seed = 0
    """seed of all random numbers"""
    prior: PriorSection
    """the isotropic law"""
    simulation: SimulationSection = SimulationSection()
    """grid and time steps"""
    heterogeneity: HeterogeneitySettings = HeterogeneitySettings()
    """variation of the stiffness"""
    adapter: AdapterSection = AdapterSection()
    """the correction of the law"""


class BodySections(LawSections):
    """What a body and its world are built from."""

    world: WorldSection = WorldSection()
    """surroundings of the body"""


class DataSections(Settings):
    """What a scene's data are made by."""

    seed: Seed = 0
    """seed of all random numbers"""
    scene: SceneSection
    """the films"""
    reconstruction: ReconstructionSettings = ReconstructionSettings()
    """body and motion from images"""
    simulation: SimulationSection = SimulationSection()
    """grid and time steps"""
    fit: FitSection = FitSection()
    """stages of the fit"""
    rendering: RenderingSettings = RenderingSettings()
    """images that are rendered"""


class TrainSettings(BodySections, DataSections):
    """train.py"""

    deterministic: bool = False
    """the same bits in every run on the same GPU; slower there. On a CPU a run's bits are always
    the same. This key, not trainer.deterministic"""
    extensions: Extensions = []
    ckpt_path: Text | None = None
    """checkpoint, of the same configuration, that the fit goes on from"""
    resume: Literal["auto"] | None = None
    """auto: skip where the run folder has metrics.json, go on from its checkpoints/last.ckpt
    (docs/sweeps.md); a checkpoint's path is ckpt_path"""
    optimized_metric: Figure = "val/loss"
    """figure that a search (hydra/sweeper=optuna) minimises. val/... needs held-out cameras or
    frames; test/... would choose by the test films"""
    criterion: Criterion = Criterion()
    """simulation that is compared with the cues"""
    trainer: Section = {}
    """arguments of Lightning's Trainer"""
    callbacks: Section | None = {}
    """callbacks by name, each with _target_"""
    logger: Section | None = {}
    """loggers by name, each with _target_"""
    identification: IdentificationSettings = IdentificationSettings()
    """Gauss-Newton"""
    losses: LossWeights = LossWeights()
    """weights of the loss terms"""
    evaluation: EvaluationSettings = EvaluationSettings()
    """evaluation of the learned law"""


class SimulateSection(Settings):
    """A new start, in place of the evaluation. What is left out is taken from the training sequence."""

    where: ClassVar[str] = "simulate"
    STARTS: ClassVar[tuple[str, ...]] = (
        "velocity", "rotation", "position", "height", "angular_velocity", "colliders", "driven",
    )  # fmt: skip

    velocity: Three | None = None
    """[vx, vy, vz] m/s; any of these seven starts a new simulation"""
    rotation: Four | None = None
    """[ax, ay, az, degrees] about the body's centre"""
    position: Place | None = None
    """[x, y, z] m of the body's centre, null for a number that is left as it is"""
    height: Number | None = None
    """m, lowest point of the body above the ground"""
    angular_velocity: Three | None = None
    """[wx, wy, wz] rad/s"""
    colliders: Entries | None = None
    """in place of the world's: a list as world.colliders of train.py"""
    driven: Entries | None = None
    """in place of the world's: a list as world.driven of train.py"""
    frames: Count = 30
    """number of frames; has an effect with one of the keys above, as variant does"""
    variant: Literal["adapted", "prior_eta", "prior"] = "adapted"
    """model to simulate: prior, prior_eta or adapted (docs/figures.md)"""


class EvalSettings(Settings):
    """eval.py"""

    extensions: Extensions = []
    ckpt_path: Text
    """checkpoint of a run"""
    device: Text = "cpu"
    """cpu, cuda or `cuda:<number>`"""
    deterministic: bool = False
    """as in train.py"""
    cache: Folder | None = None
    """folder of computed files; null: ~/.cache/mosa, never the folder that a checkpoint names"""
    appearance: Literal["splats", "particles"] | None = None
    """splats or particles in images; null: as in the run"""
    plan: Annotated[int, Interval(ge=2, le=10**9)] | None = None
    """candidates: instead of the evaluation, rank drops and presses from so many poses by what
    their motion would tell"""
    scene: Section | None = None
    """another scene to evaluate on; null: the run's"""
    evaluation: EvaluationSettings = EvaluationSettings()
    """evaluation of the learned law"""
    simulate: SimulateSection = SimulateSection()
    """simulate a new start"""
