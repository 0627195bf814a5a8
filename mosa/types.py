"""What travels between the stages: frozen containers with shapes and units. SI throughout, images in [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import torch
from torch import Tensor

from mosa.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Held = TypeVar("Held", bound="DataclassInstance")


def in_brief(held: Any) -> str:
    """A dataclass or named tuple in a line: of tensors their shapes, of what holds many things how many, of the rest the values."""

    def said(value: Any) -> str:
        if isinstance(value, Tensor):
            if not dense(value):
                return f"{value.layout} on {value.device}"
            return str(tuple(value.shape)) if value.numel() > 3 else str(value.tolist())
        if isinstance(value, (tuple, list, dict)) and len(value) > 3:
            return f"{len(value)} items"
        return repr(value)

    names = getattr(held, "_fields", None) or [f.name for f in fields(held) if f.repr]
    parts = ((name, getattr(held, name)) for name in names)
    shown = ", ".join(f"{name}={said(value)}" for name, value in parts if value is not None)
    return f"{type(held).__name__}({shown})"


def dense(value: Any) -> bool:
    """Whether it is a tensor whose numbers lie in memory: not sparse, nested, quantised or meta."""
    if not isinstance(value, Tensor) or value.is_quantized or value.is_nested:
        return False
    return value.layout is torch.strided and not value.is_meta


def moved(held: Held, device: torch.device | str) -> Held:
    """A dataclass with its tensors, and those of its parts, on a device."""

    def at(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value.to(device)
        return (
            moved(value, device) if is_dataclass(value) and not isinstance(value, type) else value
        )

    return replace(held, **{f.name: at(getattr(held, f.name)) for f in fields(held)})


def metres(places: Tensor) -> list[Any]:
    """Places [m] as numbers for a message, to 0.01 mm."""
    rounded: list[Any] = (torch.round(places.detach().double(), decimals=5) + 0.0).tolist()
    return rounded  # 0 added: -0.0 becomes 0.0


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size. `w2c` maps world metres to OpenCV camera axes (x right, y down, z forward).

    K: (V, 3, 3) [px], pixel centres at half integers; w2c: (V, 4, 4); names: V strings."""

    __repr__ = in_brief

    K: Tensor
    w2c: Tensor
    width: int
    height: int
    names: tuple[str, ...]

    def __len__(self) -> int:
        return self.K.shape[0]

    def select(self, indices: list[int]) -> Cameras:
        """The cameras at `indices`, in that order."""
        at = torch.tensor(indices, dtype=torch.long, device=self.K.device)
        names = tuple(self.names[i] for i in indices)
        return replace(self, K=self.K[at], w2c=self.w2c[at], names=names)

    def to(self, device: torch.device | str) -> Cameras:
        return moved(self, device)


AUTO = "auto"  # mode of a ground: how it is touched is found with the law
RUBBING = ("separate", "touch")
"""Of these modes, those with friction: the body leaves the ground freely, and is met at nodes or at its own particles."""


@dataclass(frozen=True)
class Ground:
    """The half space below `height` [m] along the up axis. mode: sticky | slip | separate | touch; friction: Coulomb, separate
    and touch only; accuracy: standard deviation [m] of the height, None where nobody knows it.

    In a scene the mode may be `AUTO`; a world that is simulated has one of the four."""

    height: float
    mode: str = "sticky"
    friction: float = 0.0
    accuracy: float | None = None


FALLING, REST = "falling", "rest"  # how a film starts


@dataclass(frozen=True)
class Truth:
    """What is known about a synthetic sequence and must never enter the learning path: evaluation only.

    rest: (M, 3) [m] rest positions in the *training* rest frame; positions: (T, M, 3) [m]; rotation: (3, 3) pose Q of the
    sequence relative to the training rest shape; velocity: (3,) [m/s]; parameters: name -> value of the hidden material.
    """

    __repr__ = in_brief

    rest: Tensor
    positions: Tensor
    rotation: Tensor
    velocity: Tensor
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Markers:
    """Tracked points of a sequence. names: M; rest: (M, 3) [m] where they are about the undeformed
    body; positions: (T, M, 3) [m], NaN where one was not seen; body: the solid (`colliders`) that
    the body is at rest; loads: sets with a mass, as in world.driven, of this sequence."""

    names: tuple[str, ...]
    rest: Tensor
    positions: Tensor
    body: Any
    loads: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class KnownBody:
    """Rest shape of a body from elsewhere. shape: file of a mesh, a cloud or 3D Gaussians, in its
    own axes and unit; scale: [m] of that unit, None where the mattes shall tell it; fingerprint: of
    the file."""

    shape: str
    scale: float | None = None
    fingerprint: str = ""


@dataclass(frozen=True)
class Scene:
    """One sequence of multi-view images of one object; the same for every data format.

    images: (V, T, H, W, 3) float32 in [0, 1], composited on `background`; mattes: (V, T, H, W) in [0, 1]; times: (T,) [s];
    gravity, up: (3,) [m/s^2], unit; box: (2, 3) [m] min and max of the world that may be used; density [kg/m^3].
    `last_free_frame`: index of the last frame before first contact, None = find it from the data.
    `holdout_cameras`, `holdout_frames`: indices that no stage of learning may read.
    start: `FALLING`, or `REST`: at frame 0 nothing moves, and the body may be in contact already.
    `markers`: tracked points in place of images, of which there are then none (V = 0).
    `body`: the rest shape, where it is known from elsewhere.
    `driven`: sets of the body's particles whose motion was measured, entries as in world.driven."""

    __repr__ = in_brief

    name: str
    sequence: str
    images: Tensor
    mattes: Tensor
    cameras: Cameras
    times: Tensor
    gravity: Tensor
    up: Tensor
    ground: Ground | None
    box: Tensor
    density: float
    background: Tensor
    synthetic: bool
    last_free_frame: int | None = None
    holdout_cameras: tuple[int, ...] = ()
    holdout_frames: tuple[int, ...] = ()
    truth: Truth | None = None
    particles: tuple[Tensor, ...] | None = None
    known_parameters: dict[str, float] = field(default_factory=dict)
    fingerprint: str = ""
    start: str = FALLING
    markers: Markers | None = None
    body: KnownBody | None = None
    driven: tuple[dict[str, Any], ...] = ()

    @property
    def frames(self) -> int:
        return self.images.shape[1]

    @property
    def frame_dt(self) -> float:
        """[s], from frame to frame."""
        return float(self.times[1] - self.times[0])

    @property
    def training_cameras(self) -> list[int]:
        return [i for i in range(len(self.cameras)) if i not in self.holdout_cameras]

    @property
    def training_frames(self) -> list[int]:
        """Frames that learning may read: always a prefix of the sequence (held-out frames are its last ones)."""
        return [t for t in range(self.frames) if t not in self.holdout_frames]


@dataclass(frozen=True)
class Splats:
    """N Gaussians at rest: means (N, 3) [m], scales (N, 3) standard deviations [m], rotations (N, 4) unit quaternions wxyz,
    opacities (N,) in (0, 1), colors (N, 3) in [0, 1]."""

    __repr__ = in_brief

    means: Tensor
    scales: Tensor
    rotations: Tensor
    opacities: Tensor
    colors: Tensor

    def to(self, device: torch.device | str) -> Splats:
        return moved(self, device)


@dataclass(frozen=True)
class Appearance:
    """Splats whose colours depend on the line of sight and on the light. harmonics: (N, K, 3), K = 1, 4, 9, 16 coefficients of real
    spherical harmonics in the axes of the rest shape (`spherical_harmonics.py`); `splats.colors` are their means.
    normals: (N, 3) of the surface at rest and light: (8,) by which the colours change as these turn (`lighting.py`);
    None: they do not."""

    __repr__ = in_brief

    splats: Splats
    harmonics: Tensor
    normals: Tensor | None = None
    light: Tensor | None = None

    def to(self, device: torch.device | str) -> Appearance:
        return moved(self, device)


@dataclass(frozen=True)
class MotionCues:
    """What the dynamic reconstruction saw, per particle and frame, frame 0 first.

    positions: (T, N, 3) [m]; rotation: (T, N, 3, 3), stretch: (T, N, 3) descending singular values, both relative to frame 0;
    weight: (T, N) in [0, 1], 0 where rotation and stretch are not determined; covariances: (T, N, 3, 3) [m^2] of the dynamic
    Gaussians, from which cue flow maps are rendered; eyes: (V, 3) [m] of the cameras that saw it, None for as
    many as tell all. One sees the direction of a particle, not its distance."""

    __repr__ = in_brief

    positions: Tensor
    rotation: Tensor
    stretch: Tensor
    weight: Tensor
    covariances: Tensor
    eyes: Tensor | None = None

    def to(self, device: torch.device | str) -> MotionCues:
        return moved(self, device)

    def first(self, frames: int) -> MotionCues:
        """Of the first `frames` frames."""
        cut = {f.name: getattr(self, f.name)[:frames] for f in fields(self) if f.name != "eyes"}
        return replace(self, **cut)

    @property
    def single(self) -> bool:
        """Whether one camera saw it."""
        return self.eyes is not None and len(self.eyes) == 1

    def away(self, x: Tensor) -> Tensor:
        """(T, N, 3) [m] of particles at x from where they were seen; from the lines of sight of a single camera."""
        return self.across(x - self.positions, self.positions)

    def across(self, away: Tensor, seen: Tensor) -> Tensor:
        """(..., N, 3) [m] of distances `away` from positions `seen`, without what a single camera does not see of them."""
        if self.eyes is None or not self.single:
            return away
        sight = torch.nn.functional.normalize(seen - self.eyes[0], dim=-1).to(away)
        return away - (away * sight).sum(-1, keepdim=True) * sight


@dataclass(frozen=True)
class MarkerCues:
    """Tracked points as cues. positions: (T, M, 3) [m], NaN where one was not seen; each is the sum
    of `weights` (M, K) times the positions of `particles` (M, K)."""

    positions: Tensor
    particles: Tensor
    weights: Tensor
    eyes: ClassVar[None] = None
    single: ClassVar[bool] = False

    def to(self, device: torch.device | str) -> MarkerCues:
        return moved(self, device)

    def first(self, frames: int) -> MarkerCues:
        """Of the first `frames` frames."""
        return replace(self, positions=self.positions[:frames])

    def seen(self, x: Tensor) -> Tensor:
        """(T, M, 3) [m] where the points are when the particles are at x (T, N, 3)."""
        return (x[:, self.particles] * self.weights.to(x)[..., None]).sum(-2)

    def away(self, x: Tensor) -> Tensor:
        """(T, M, 3) [m] of the points, when the particles are at x, from where they were seen: 0
        for those that were not, and the others of the frame stand in for them in its mean
        square."""
        found = self.seen(x) - self.positions
        there = torch.isfinite(found).all(-1, keepdim=True)
        share = there.to(x).mean(1, keepdim=True).clamp_min(1 / there.shape[1])
        return torch.where(there, found, 0.0) / share.sqrt()


@dataclass(frozen=True)
class Reconstruction:
    """Particles P_0 with their appearance at frame 0 and the motion cues. spacing [m]; volume: (N,) [m^3] initial volume;
    static: Gaussians of the static stage, which carry the images where other sequences of the body are followed; geometry: figures
    of the body that was filled (`geometry/body.py`); appearance: splats at frame 0 that the particles' motion carries
    (`gaussians/carried.py`); moving: what its motion was fitted with (`MovingParts`), for the
    second look at it."""

    __repr__ = in_brief

    splats: Splats
    spacing: float
    volume: Tensor
    cues: MotionCues | MarkerCues
    static: Splats | None = None
    geometry: dict[str, float] = field(default_factory=dict)
    appearance: Appearance | None = None
    moving: Any = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class ParticleState:
    """State between substeps. x, v: (N, 3) [m], [m/s]; C_affine: (N, 3, 3) [1/s]; F, F_tot: (N, 3, 3).

    For laws without return mapping F_tot is the same tensor as F. Of B worlds: (B, N, ...) each."""

    __repr__ = in_brief

    x: Tensor
    v: Tensor
    C_affine: Tensor
    F: Tensor
    F_tot: Tensor

    @classmethod
    def at_rest(cls, x: Tensor) -> ParticleState:
        """Undeformed particles at x (N, 3) or (B, N, 3) [m] that do not move. Errors: ConfigError for anything else."""
        if not (isinstance(x, Tensor) and x.ndim in (2, 3) and x.shape[-1] == 3 and x.is_floating_point()):  # fmt: skip
            found = f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else type(x).__name__
            raise ConfigError(
                "x: expected a torch tensor of floating point numbers of shape (particles, 3) or (worlds, particles, 3), "
                f"found {found}"
            )
        still = torch.zeros_like(x)
        F = torch.eye(3).to(x).expand(*x.shape, 3).contiguous()
        return cls(x, still, torch.zeros_like(F), F, F)

    @classmethod
    def stack(cls, states: Sequence[ParticleState]) -> ParticleState:
        """The states of equally many particles each, as those of B worlds."""
        return cls(
            *(torch.stack([getattr(state, f.name) for state in states]) for f in fields(cls))
        )

    def to(self, dtype: torch.dtype) -> ParticleState:
        """In this type, but x in float64 stays so."""
        return ParticleState(
            *(
                t if t is self.x and t.dtype == torch.float64 else t.to(dtype)
                for t in vars(self).values()
            )
        )

    def worlds(self) -> list[ParticleState]:
        """The states of B worlds, one by one."""
        return [
            ParticleState(*parts)
            for parts in zip(*(getattr(self, f.name).unbind(0) for f in fields(self)))
        ]


@dataclass(frozen=True)
class Rollout:
    """Simulated frames, frame 0 first. x, v: (T, N, 3); F, F_tot: (T, N, 3, 3); times: (T,) [s]; final: state to go on from.

    inverted: number of (particle, frame) pairs with det F <= 0. reactions: (T - 1, substeps, K, 6) force [N] and torque about the
    collider's origin [N m] that the body exerts on each of K colliders, driven sets after the
    solids, None without any; a frame's mean is `.mean(1)`.
    Where the substeps vary by frame they are (T - 1, 1, K, 6), that mean. counts: substeps of each of the T - 1 frame intervals.
    Of B worlds: x (T, B, N, 3) and so on, final (B, N, ...), reactions (T - 1, substeps, B, K, 6), see `worlds`.
    """

    __repr__ = in_brief

    x: Tensor
    v: Tensor
    F: Tensor
    F_tot: Tensor
    times: Tensor
    final: ParticleState
    inverted: int = 0
    reactions: Tensor | None = None
    counts: tuple[int, ...] = ()

    @property
    def substeps(self) -> int:
        """Mean of `counts`, rounded up; 0 of the start alone."""
        return -(-sum(self.counts) // max(1, len(self.counts)))

    def to(self, device: torch.device | str) -> Rollout:
        return moved(self, device)

    def worlds(self) -> list[Rollout]:
        """The rollouts of B worlds, one by one; `inverted` is then of all of them."""
        parts = zip(*(getattr(self, name).unbind(1) for name in ("x", "v", "F", "F_tot")))
        forces = (None,) * self.x.shape[1] if self.reactions is None else self.reactions.unbind(2)
        return [
            replace(self, x=x, v=v, F=F, F_tot=F_tot, final=final, reactions=force)
            for (x, v, F, F_tot), final, force in zip(parts, self.final.worlds(), forces)
        ]
