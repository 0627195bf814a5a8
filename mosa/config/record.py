"""The record of a run: what its checkpoint holds under `mosa`, beside the tensors of its body. Typed, versioned, plain data only.

The settings are those that the user gave, untouched. What was measured from the data and what the run decided are fields of their
own; nothing is read back from anywhere else."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from annotated_types import Interval
from pydantic import AllowInfNan, BeforeValidator, model_validator

from mosa.config.command_settings import BodySections
from mosa.data.scene import GroundSettings
from mosa.errors import ConfigError
from mosa.modules.body.body import Body, Start, World
from mosa.modules.body.material import RIVALS
from mosa.modules.fitting.retreat import MOST_HALVINGS
from mosa.physics.constitutive.laws import law_named
from mosa.rendering.appearance.lighting import LIGHT
from mosa.rendering.appearance.spherical_harmonics import DEGREES
from mosa.settings import (
    Expected,
    Names,
    Number,
    Positive,
    Section,
    Settings,
    Three,
    Weight,
    Whole,
    such,
)
from mosa.system.limits import machine_memory
from mosa.types import AUTO, Ground, dense

VERSION = 3  # of a record; grows whenever its fields change. There is one reader, of this version.
STRONGEST, WIDEST = 1e4, 1e5  # [m/s^2] of gravity and [m] of a world's box
LARGEST_MEAN = 300.0  # of a posterior's numbers, most of which are logarithms
BOUND_BYTES = 4000  # of a splat while it is bound to its neighbours
SPLATS = {"means": (3,), "scales": (3,), "rotations": (4,), "opacities": (), "colors": (3,),
          "normals": (3,)}  # fmt: skip


def finite(value: Any, *shapes: Sequence[int | None]) -> bool:
    """Whether it is a dense tensor of finite floating point numbers, of one of these shapes; None: any length."""
    return (
        dense(value)
        and value.is_floating_point()
        and bool(torch.isfinite(value).all())
        and (not shapes or any(len(s) == value.ndim and all(a in (None, b) for a, b in zip(s, value.shape)) for s in shapes))
    )  # fmt: skip


def is_rotation(value: Any) -> bool:
    """Nested lists of a 3x3 matrix with R R^T = I and det R = 1, to 1e-3."""
    if not (len(value) == 3 and all(len(row) == 3 for row in value)):
        return False
    R = torch.tensor(value, dtype=torch.float64)
    near = float((R @ R.T - torch.eye(3).double()).abs().max()) < 1e-3
    return near and float(torch.linalg.det(R)) > 0


Finite = Annotated[Any, Expected("finite numbers"), such(finite)]
ByLaw = Annotated[
    dict[str, Any], Expected(f"numbers of laws among {', '.join(RIVALS)}"), such(lambda v: set(v) <= set(RIVALS))
]  # fmt: skip
Tensors = Annotated[list[Finite] | None, Expected("null, or a list of finite tensors")]
Rotation = Annotated[list[list[float]], Expected("a 3x3 rotation matrix"), such(is_rotation)]
Box = Annotated[
    list[Three], Expected("two corners, min below max"), such(lambda v: len(v) == 2 and all(a < b for a, b in zip(*v)))
]  # fmt: skip
Direction = Annotated[Three, Expected("a direction"), such(any)]
Distances = Annotated[
    dict[str, Annotated[float, AllowInfNan(True)]], Expected("numbers by name"), such(lambda v: not any(x != x for x in v.values()))
]  # fmt: skip
FieldsOfRollouts = Annotated[
    list[Annotated[list[Finite] | tuple[Finite, ...], such(lambda v: len(v) == 3)]] | None,
    Expected("null, or for each rollout three tensors of finite numbers"),
]
Positions = Annotated[
    list[Annotated[Any, such(lambda t: finite(t, (None, None, 3)))]] | None,
    Expected("null, or for each sequence finite positions of shape (T, N, 3)"),
]
Responses = Annotated[
    Any, Expected("null, or for each sequence null or finite tensors `about` (T, N, 3) and `share` (T, 3 K, 3 K)"),
    such(lambda v: v is None or (isinstance(v, list) and all(each is None or (
        isinstance(each, dict) and set(each) == {"about", "share"} and all(finite(t, (None,) * 3) for t in each.values()))
        for each in v))),
]  # fmt: skip


def sequence_names(starts: Any) -> Any:
    """They name entries of the files that are written. Errors: ConfigError."""
    for name in starts if isinstance(starts, Mapping) else ():
        if re.fullmatch(r"(train|test)(/[\w-]+)?", str(name)) is None:
            raise ConfigError(
                f"mosa.starts: expected names like train or test/<sequence>, found {str(name)[:80]!r}"
            )
    return starts


class WorldRecord(Settings):
    """What a scene says of its world: gravity [m/s^2], up, box [m], and sets of particles whose motion
    it measured. Walls and solids are in the settings."""

    gravity: Three
    up: Direction
    box: Box
    driven: list[Section] = []


class StartRecord(Settings):
    """A body's first state: rotation, centre [m], velocity [m/s], angular velocity [rad/s]; masses
    that go with it in this sequence."""

    rotation: Rotation
    center: Three
    velocity: Three
    angular_velocity: Three
    loads: list[Section] = []


class BodyRecord(Settings):
    """What a body and its world are built from, beside its tensors.

    settings: of the command, as the user gave them; law: the one that the calibration chose among prior.candidates, None where none
    was chosen; density [kg/m^3], dx [m], frame_dt [s]; starts: by sequence; data: what tells the data apart."""

    where: ClassVar[str] = "mosa"

    settings: Section
    law: str | None = None
    ground: GroundSettings | None
    world: WorldRecord
    density: Annotated[float, Interval(ge=0.1, le=1e5)]
    dx: Annotated[float, Interval(ge=1e-6, le=100)]
    frame_dt: Annotated[float, Interval(ge=1e-6, le=100)]
    starts: Annotated[dict[str, StartRecord], BeforeValidator(sequence_names)] = {}
    data: Section = {}

    @property
    def sections(self) -> BodySections:
        """The settings of the body, typed. Errors: ConfigError naming the key."""
        return BodySections.part(self.settings)

    @property
    def ground_is_sought(self) -> bool:
        """Whether nobody said how the ground is touched (scene.ground.mode=auto), and it is not found yet."""
        return self.ground is not None and self.ground.mode == AUTO

    def on(self, ground: Ground) -> Self:
        """With the ground that was found."""
        return self.but(ground=GroundSettings(**asdict(ground)))

    @classmethod
    def of(cls, body: Body, world: World, frame_dt: float, start: Start | None = None) -> Self:
        """Of parts that no configuration made."""
        known = {"train": start.written()} if start is not None else {}
        return cls(
            settings={}, ground=None if world.ground is None else asdict(world.ground), density=body.density, dx=body.settings.dx,
            world={name: getattr(world, name).tolist() for name in ("gravity", "up", "box")}, frame_dt=frame_dt, starts=known,
        )  # fmt: skip

    @model_validator(mode="after")
    def _sense(self) -> Self:
        """A world that holds together: numbers may be finite and yet mean nothing."""
        gravity, up = (
            torch.tensor(each, dtype=torch.float64) for each in (self.world.gravity, self.world.up)
        )
        if self.ground is not None:
            corners = torch.cartesian_prod(*torch.tensor(self.world.box, dtype=torch.float64).T)
            heights = corners @ (up / up.norm())
            if not float(heights.min()) <= self.ground.height <= float(heights.max()):
                raise ConfigError(
                    f"mosa.ground.height: expected a ground inside of the box {self.world.box}, found {self.ground.height:g}"
                )
            if bool(gravity.any()) and not float(gravity @ up) < 0:
                raise ConfigError(
                    f"mosa.world.gravity: expected a pull against up = {self.world.up}, found {self.world.gravity}"
                )
        widest = max(abs(x) for corner in self.world.box for x in corner)
        if float(gravity.norm()) > STRONGEST or widest > WIDEST:
            raise ConfigError(
                f"mosa.world: expected a gravity of at most {STRONGEST:g} m/s^2 and a box within {WIDEST:g} m, found "
                f"{self.world.gravity} and {self.world.box}"
            )
        return self


class PosteriorRecord(Settings):
    """The law's distribution: of D learned numbers, as `Posterior.read` takes it. model_error [m]."""

    names: Names
    mean: Finite
    covariance: Finite
    determined: Finite
    model_error: Weight
    rivals: ByLaw = {}

    @model_validator(mode="after")
    def _whole(self) -> Self:
        count = len(self.names)
        shapes = {"mean": (count,), "covariance": (count, count), "determined": (count,)}
        parts = {name: (getattr(self, name), shape) for name, shape in shapes.items()}
        parts |= {f"rivals.{law}": (value, (count,)) for law, value in self.rivals.items()}
        for name, (value, shape) in parts.items():
            if not finite(value, shape):
                raise ConfigError(
                    f"mosa.posterior.{name}: expected {' x '.join(map(str, shape))} finite numbers"
                )
        C = self.covariance.double()
        spread = torch.linalg.eigvalsh(C)
        even = float((C - C.mT).abs().max()) <= 1e-6 * float(C.abs().max())
        if not even or not 1e-30 < float(spread.min()) <= float(spread.max()) < 1e30:
            raise ConfigError(
                "mosa.posterior.covariance: expected a symmetric, positive definite matrix"
            )
        if float(self.mean.abs().max()) > LARGEST_MEAN:
            raise ConfigError(
                f"mosa.posterior.mean: expected logarithms, numbers within {LARGEST_MEAN:g}"
            )
        return self


class IdentificationRecord(Settings):
    """A running stage of Gauss-Newton."""

    iteration: Whole
    factors: Annotated[list[Positive], Expected("numbers above 0")]
    multiple: Number = 0.0
    noise: FieldsOfRollouts
    grid: FieldsOfRollouts = None


class RetreatRecord(Settings):
    """A running stage of Adam: halvings of its steps, and the numbers before the last."""

    halvings: Annotated[int, Interval(ge=0, le=MOST_HALVINGS)]
    before: Tensors


class FitRecord(Settings):
    """How far a fit is: what it goes on from.

    compared, grounds: mean distances [m] of the candidates for law and contact; ground_gains,
    law_gains: of other contacts and backbones about what was learned, of the logarithm of the
    likelihood; parts: errors [m] of held-back frames by `search.parts`; moves: of the looks of
    a calibration [m]; cues, responses: of the motion that was found once more."""

    stage: Whole
    steps_done: Whole
    losses: Annotated[list[float], Expected("numbers")]
    stage_over: bool = False
    moves: Annotated[list[float], Expected("numbers")] = []
    particles: Annotated[int, Interval(ge=1)]
    misfit: Positive
    compared: Distances = {}
    grounds: Distances = {}
    ground_gains: Distances = {}
    law_gains: Distances = {}
    parts: Distances = {}
    identification: IdentificationRecord | None = None
    retreat: RetreatRecord | None = None
    cues: Positions = None
    responses: Responses = None


class SplatsRecord(Settings):
    """M splats that the body carries, as `CarriedSplats.read` takes them."""

    where: ClassVar[str] = "mosa.splats"

    means: Finite
    scales: Finite
    rotations: Finite
    opacities: Finite
    colors: Finite
    normals: Finite
    harmonics: Finite
    light: Finite

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        count = len(self.means) if self.means.ndim else 0
        most = machine_memory() // (2 * BOUND_BYTES)
        if not 0 < count <= most:
            raise ConfigError(
                f"mosa.splats.means: expected 1 to {most} splats, which take half of this machine's memory, found {count}"
            )
        shapes = {name: [(count, *shape)] for name, shape in SPLATS.items()}
        shapes |= {"harmonics": [(count, k, 3) for k in DEGREES], "light": [(LIGHT,)]}
        for name, allowed in shapes.items():
            if not finite(getattr(self, name), *allowed):
                raise ConfigError(
                    f"mosa.splats.{name}: expected finite numbers of shape {' or '.join(map(str, allowed))}"
                )
        turned = (getattr(self, name).norm(dim=1).min() for name in ("rotations", "normals"))
        if not float(self.scales.min()) > 0 or not all(map(float, turned)):
            raise ConfigError(
                "mosa.splats: expected scales above 0 m, quaternions and normals that are not zero"
            )
        if float(self.opacities.min()) < 0 or float(self.opacities.max()) > 1:
            raise ConfigError("mosa.splats.opacities: expected numbers from 0 to 1")
        return self


class RunRecord(BodyRecord):
    """All of `mosa` in a checkpoint. start: of the training sequence; fit: None where nothing was fitted; posterior, splats: None
    where the run kept none."""

    version: Literal[3] = 3
    start: StartRecord
    fit: FitRecord | None = None
    posterior: PosteriorRecord | None = None
    splats: SplatsRecord | None = None

    @property
    def body(self) -> BodyRecord:
        """What a body is built from, of all this."""
        return BodyRecord(**{name: getattr(self, name) for name in BodyRecord.model_fields})

    @model_validator(mode="after")
    def _decided(self) -> Self:
        if self.law is not None:
            law_named(self.law)
        if self.fit is not None and self.fit.compared and self.law is None:
            raise ConfigError("mosa.law: expected the law that was chosen, found None")
        return self
