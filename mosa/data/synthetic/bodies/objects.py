"""What each built-in scene is: a shape, a hidden material, the drops, and how it is filmed. Fixed: figures depend on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosa.data.synthetic.materials.hidden import Hidden
from mosa.data.synthetic.materials.hidden_material import FORMS, HiddenMaterial
from mosa.data.synthetic.materials.hidden_yield import HiddenYield
from mosa.data.synthetic.materials.published import PublishedMaterial
from mosa.errors import ConfigError


@dataclass(frozen=True)
class Drop:
    """One sequence. axis, degrees: how the body is turned; speed: downwards at frame 0 [m/s]; offset: of its centre in the
    horizontal plane [m]; contact: time at which its lowest point would reach the ground [s]."""

    speed: float
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    degrees: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    contact: float = 0.07

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3)."""
        axis = np.asarray(self.axis) / np.linalg.norm(self.axis)
        return Rotation.from_rotvec(math.radians(self.degrees) * axis).as_matrix()


@dataclass(frozen=True)
class Footage:
    """cameras, frames, native image size [px], fps; field: half width seen at the target [m]; target height, distance [m]."""

    cameras: int = 12
    frames: int = 15
    size: int = 400
    fps: float = 50.0
    field: float = 0.36
    target: float = 0.33
    distance: float = 1.8
    elevations: tuple[float, ...] = (0.16, 0.55, 0.95)


@dataclass(frozen=True)
class Meeting:
    """How a truth meets the ground, and what its scene says of that.

    cell: of the truth's grid, in particle spacings; lift [cells]: how much higher it is simulated than
    it is filmed; stated [m]: the ground's height in the scene, which truly is 0; mode, friction: of the
    ground, in the truth and in the scene. A sticky grid stops a body's surface about 0.4 cells above the
    plane (rabbit, impacts at 3 to 4 m/s), so that with that lift the pictures show contact at height 0."""

    cell: float = 2.0
    lift: float = 0.4
    stated: float = 0.0
    mode: str = "sticky"
    friction: float = 0.0


@dataclass(frozen=True)
class BuiltinObject:
    """height: of the shape [m]; spacing of the truth's particles [m] (the rabbit's grid has 0.015 m,
    finer than a learner's of up to 9000 particles); pitch of its surface mesh [m]. remesh: whether the
    surface is found anew in every frame, as that of what flows; reach: half width of the world that may
    be used [m], None: as for all; meeting: with the ground."""

    shape: str
    height: float
    material: Hidden | PublishedMaterial
    drops: dict[str, Drop]
    footage: Footage = field(default_factory=Footage)
    spacing: float = 0.0075
    pitch: float = 0.0025
    # no part of a cached film's name, or those of the other objects would all be made again
    remesh: bool = field(default=False, repr=False)
    reach: float | None = field(default=None, repr=False)
    meeting: Meeting = field(default_factory=Meeting, repr=False)

    @property
    def dx(self) -> float:
        """Grid spacing of the truth [m]."""
        return self.meeting.cell * self.spacing


RABBIT = HiddenMaterial(
    E=2e5, nu=0.3, ratio=1.6, fibre=(1.0, 0.3, 0.0), amplitude=0.2, period=0.125
)  # fmt: skip
# stiffer and slower to squash, fibres lean across the axis, and the stiffness varies along the body
PEANUT = HiddenMaterial(
    E=3e5, nu=0.35, ratio=1.9, fibre=(0.2, 0.5, 1.0), amplitude=0.25, period=0.16, axis=(0.3, 0.9, 0.3)
)  # fmt: skip

MANDARIN = HiddenMaterial(
    E=2.5e5, nu=0.32, ratio=1.7, fibre=(0.4, 1.0, 0.3), amplitude=0.2, period=0.14, axis=(0.2, 0.3, 0.9)
)  # fmt: skip
# dents where it lands, and in one direction more easily than in another: the coefficients span yield stresses of 1 to 1.8
CLAY = HiddenYield(
    E=2e5, nu=0.3, yield_stress=1.5e4, coefficients=(0.6, 1.5, 2.0, 0.7, 1.8, 0.6), turn=(0.4, 0.3, 0.2), amplitude=0.2,
    period=0.125,
)  # fmt: skip
CHICK = HiddenMaterial(
    E=2.2e5, nu=0.28, ratio=1.8, fibre=(0.3, -0.2, 1.0), amplitude=0.15, period=0.13, axis=(0.0, 1.0, 0.3)
)  # fmt: skip
# the second five: shapes, materials and drops were fixed together, before anything was fitted on them
GORILLA = HiddenMaterial(
    E=3e5, nu=0.3, ratio=1.75, fibre=(0.3, 1.0, 0.4), amplitude=0.2, period=0.15, axis=(0.6, 0.7, 0.3)
)  # fmt: skip
CHICK2 = HiddenMaterial(
    E=2.4e5, nu=0.27, ratio=2.0, fibre=(0.5, 0.6, -0.7), amplitude=0.25, period=0.12, axis=(0.3, -0.4, 0.9)
)  # fmt: skip
RAINBOWBALL = HiddenMaterial(
    E=1.8e5, nu=0.36, ratio=1.5, fibre=(-0.6, 0.5, 0.6), amplitude=0.18, period=0.11, axis=(0.6, 0.2, -0.7)
)  # fmt: skip
CALF = HiddenMaterial(
    E=3.5e5, nu=0.33, ratio=1.65, fibre=(1.0, 0.2, 0.35), amplitude=0.22, period=0.17, axis=(0.9, 0.2, 0.4)
)  # fmt: skip
# no directions, one stiffness: what is learned of it has to be nothing
RING = HiddenMaterial(E=2.5e5, nu=0.34, ratio=1.0, fibre=(1.0, 0.0, 0.0), amplitude=0.0, period=0.1)

# strong fibres in the plane of x and the vertical, no other variation: what a compression test of a specimen measures
CYLINDER = HiddenMaterial(
    E=2e5, nu=0.3, ratio=1.8, fibre=(1.0, 0.4, 0.0), amplitude=0.0, period=0.1
)  # fmt: skip

DROPS = {
    "train": Drop(speed=2.5),
    "test_60": Drop(speed=2.5, axis=(0.3, 0.2, 1.0), degrees=60.0, offset=(-0.035, -0.010)),
    "test_40": Drop(speed=3.2, axis=(1.0, 0.4, 0.2), degrees=40.0, offset=(-0.010, 0.030)),
}

OBJECTS = {
    "rabbit": BuiltinObject("rabbit", 0.25, RABBIT, DROPS),
    "rabbit_plastic": BuiltinObject("rabbit", 0.25, CLAY, DROPS),
    "peanut": BuiltinObject(
        "peanut", 0.133, PEANUT,
        {"train": DROPS["train"], "test_60": replace(DROPS["test_60"], offset=(-0.10, 0.015)),
         "test_40": replace(DROPS["test_40"], offset=(-0.065, -0.01))},
        Footage(target=0.26), spacing=0.006,
    ),
    "mandarin": BuiltinObject(
        "mandarin", 0.1915, MANDARIN,
        {"train": DROPS["train"], "test_60": replace(DROPS["test_60"], offset=(0.0, 0.0)),
         "test_40": replace(DROPS["test_40"], offset=(0.0, 0.0))},
        Footage(target=0.28), spacing=0.0065,
    ),
    "chick1": BuiltinObject("chick1", 0.22, CHICK, DROPS, Footage(target=0.31), spacing=0.007),
    "gorilla": BuiltinObject(
        "gorilla", 0.258, GORILLA,
        {"train": Drop(speed=2.2), "test_50": Drop(speed=2.4, axis=(0.2, 0.5, 1.0), degrees=50.0, offset=(-0.03, 0.0)),
         "test_70": Drop(speed=2.8, axis=(1.0, -0.3, 0.4), degrees=70.0, offset=(-0.01, 0.05))},
        Footage(target=0.24), spacing=0.007,
    ),
    "chick2": BuiltinObject(
        "chick2", 0.24, CHICK2,
        {"train": Drop(speed=2.4), "test_80": Drop(speed=2.4, axis=(0.4, 0.3, -1.0), degrees=80.0, offset=(0.03, 0.0)),
         "test_45": Drop(speed=3.0, axis=(-1.0, 0.5, 0.3), degrees=45.0, offset=(0.0, -0.03))},
        Footage(target=0.24), spacing=0.0065,
    ),
    "rainbowball": BuiltinObject(
        "rainbowball", 0.2, RAINBOWBALL,
        {"train": Drop(speed=2.5), "test_65": Drop(speed=2.8, axis=(0.7, -0.2, 0.6), degrees=65.0),
         "test_100": Drop(speed=3.2, axis=(-0.3, 0.5, 1.0), degrees=100.0)},
        Footage(target=0.33), spacing=0.0065,
    ),
    "calf": BuiltinObject(
        "calf", 0.267, CALF,
        {"train": Drop(speed=2.0), "test_55": Drop(speed=2.2, axis=(0.3, 0.4, 1.0), degrees=55.0, offset=(-0.02, 0.0)),
         "test_75": Drop(speed=2.6, axis=(1.0, 0.3, 0.2), degrees=75.0, offset=(-0.07, -0.07))},
        Footage(target=0.24), spacing=0.0065,
    ),
    "ring": BuiltinObject(
        "ring", 0.184, RING,
        {"train": Drop(speed=2.2), "test_60": Drop(speed=2.5, axis=(0.2, 0.3, 1.0), degrees=60.0),
         "test_110": Drop(speed=2.8, axis=(1.0, 0.2, -0.4), degrees=110.0)},
        Footage(target=0.24), spacing=0.005, pitch=0.002,
    ),
    "cylinder": BuiltinObject(
        "cylinder", 0.24, CYLINDER,
        {"train": Drop(speed=2.5), "test_60": Drop(speed=2.5, axis=(0.3, 0.2, 1.0), degrees=60.0),
         "test_90": Drop(speed=3.0, axis=(0.0, 0.0, 1.0), degrees=90.0)},
        Footage(target=0.30), spacing=0.0065,
    ),
    # the rabbit, small and short, for tests and sweeps: every stage of the program, none of its accuracy
    "tiny": BuiltinObject(
        "rabbit", 0.25, RABBIT,
        {name: Drop(d.speed, d.axis, d.degrees, d.offset, contact=0.032) for name, d in DROPS.items()},
        Footage(cameras=6, frames=5, size=128, field=0.25, target=0.165), spacing=0.0125, pitch=0.006,
    ),
}  # fmt: skip


PACNERF = {"train": Drop(speed=0.5, contact=0.21)}  # as the bird's


def stand_in(shape: str, height: float, law: str, *, spacing: float = 0.0125, remesh: bool = False, frames: int = 14,
             held: tuple[str, ...] = (), convention: str = "paper", **values: float) -> BuiltinObject:  # fmt: skip
    """An object that stands in for a scene of PAC-NeRF, with its published law and parameters, filmed as there: 11 cameras, 24
    frames a second."""
    material = PublishedMaterial(
        law=law, values=tuple(values.items()), held=held, convention=convention
    )
    film = Footage(11, frames, size=400, fps=24.0, field=0.52, target=0.38, distance=3.0)
    return BuiltinObject(
        shape,
        height,
        material,
        PACNERF,
        film,
        spacing=spacing,
        pitch=0.006,
        remesh=remesh,
        reach=1.6,
    )


OBJECTS |= {
    "torus": stand_in("torus", 0.313, "neo_hookean", E=1e6, nu=0.3, spacing=0.011),
    "bird": stand_in("bird", 0.398, "neo_hookean", E=3e5, nu=0.3),
    "playdoh": stand_in("playdoh", 0.32, "von_mises", E=2e6, nu=0.3, yield_stress=1.54e4, convention="sqrt23", frames=12,
                        spacing=0.011),
    "cat": stand_in("cat", 0.497, "von_mises", E=1e6, nu=0.3, yield_stress=3.85e3, convention="sqrt23", frames=12),
    "droplet": stand_in("droplet", 0.375, "newtonian", mu=200.0, kappa=1e5, remesh=True, frames=13, spacing=0.011),
    "letter": stand_in("letter", 0.45, "newtonian", mu=100.0, kappa=1e5, remesh=True, frames=16, spacing=0.0095),
    "cream": stand_in("cream", 0.365, "herschel_bulkley_hencky", mu=1e4, kappa=1e6, yield_stress=3e3, viscosity=10.0, remesh=True,
                      spacing=0.011),
    "toothpaste": replace(
        stand_in("toothpaste", 0.051, "herschel_bulkley_hencky", mu=5e3, kappa=1e5, yield_stress=200.0, viscosity=10.0, remesh=True,
                 spacing=0.0011),
        drops={"train": Drop(speed=0.2, contact=0.1)},
        footage=Footage(cameras=11, frames=14, size=400, fps=50.0, field=0.075, target=0.058, distance=0.45), pitch=0.0008,
    ),
    "trophy": stand_in("trophy", 0.418, "drucker_prager", E=1e6, nu=0.3, friction_angle=40.0, cohesion=0.0,
                       held=("E", "nu", "cohesion"), remesh=True, spacing=0.011),
}  # fmt: skip


# Version 2: the truths above share one convention with a learner: each is simulated 0.4 cells
# higher than it is filmed, over a ground that is stated where it is. Films of the world share no
# convention, so that a learner may have learned this one. Version 2 keeps shapes, drops, cameras
# and moduli, and draws from a generator that the body's name seeds: the truth's grid, the height
# of its contact, the height that the scene states, the contact's mode and, where the body is
# elastic, the form of its law. Gorilla, rabbit and rainbowball yield, as in the paper. Fixed:
# figures depend on it.
SUFFIX = "_v2"  # of the names: `scene.name=calf_v2`
NAMES = (
    "rabbit", "peanut", "mandarin", "chick1", "gorilla", "chick2", "rainbowball", "calf", "ring",
)  # fmt: skip
YIELDING = {
    "rabbit": HiddenYield(
        E=2e5, nu=0.3, yield_stress=1.5e4, coefficients=(0.6, 1.5, 2.0, 0.7, 1.8, 0.6),
        turn=(0.4, 0.3, 0.2), amplitude=0.2, period=0.125,
    ),
    "gorilla": HiddenYield(
        E=3e5, nu=0.3, yield_stress=2.2e4, coefficients=(1.7, 0.7, 0.9, 1.9, 0.6, 1.2),
        turn=(-0.3, 0.5, 0.1), amplitude=0.2, period=0.15, axis=(0.6, 0.7, 0.3),
    ),
    "rainbowball": HiddenYield(
        E=1.8e5, nu=0.36, yield_stress=1.4e4, coefficients=(0.8, 2.1, 1.1, 0.7, 1.0, 1.6),
        turn=(0.1, -0.4, 0.6), amplitude=0.18, period=0.11, axis=(0.6, 0.2, -0.7),
    ),
}  # fmt: skip
LIFTS, STATED, CELLS = (0.0, 0.6), 0.005, (1.7, 2.4)
"""Lifts [cells of the truth's grid]; largest error of the stated height [m]; cell [spacings]."""


def drawn(name: str) -> BuiltinObject:
    """The body of that name in version 2."""
    rng = np.random.default_rng([2, *name.encode()])
    body = OBJECTS[name]
    cell, height = float(rng.uniform(*CELLS)), float(rng.uniform(-STATED, STATED))
    lift, kind, form = float(rng.uniform(*LIFTS)), rng.integers(4), str(rng.choice(list(FORMS)))
    if kind == 0:  # a grid's nodes as they are
        meeting = Meeting(cell, 0.0, height)
    elif kind == 1:  # particles meet the plane: nothing stops them above it
        meeting = Meeting(cell, 0.0, height, "touch", 0.5)
    else:
        meeting = Meeting(cell, lift, height)
    material = YIELDING.get(name, body.material)
    if isinstance(material, HiddenMaterial):
        material = replace(material, form=form)
    return replace(body, material=material, meeting=meeting)


OBJECTS |= {name + SUFFIX: drawn(name) for name in NAMES}


def object_named(name: str) -> BuiltinObject:
    """Errors: ConfigError naming the known ones."""
    if name not in OBJECTS:
        raise ConfigError(
            f"scene.name: expected one of the built-in {', '.join(sorted(OBJECTS))}, found {name!r}"
        )
    return OBJECTS[name]


def drop_named(name: str, sequence: str) -> Drop:
    """Errors: ConfigError naming the known sequences."""
    drops = object_named(name).drops
    if sequence not in drops:
        raise ConfigError(f"scene.sequence: {name} has {', '.join(drops)}, not {sequence!r}")
    return drops[sequence]
