"""What each key of a configuration may be, checked before anything is computed: a typing mistake costs no reconstruction.

What settings dataclasses say of their fields is taken from them, what an adapter says of its arguments is added where its name is
known (`mosa.config.extensions.registered_keys`). Only kinds and ranges of single values are here; which names,
files and combinations exist is said where they are used.
"""

from __future__ import annotations

from mosa.evaluation.settings import EvaluationSettings
from mosa.modules.body.heterogeneity import HeterogeneitySettings
from mosa.modules.body.simulation_settings import SimulationSettings
from mosa.modules.fitting.criteria import Criterion
from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.modules.fitting.stages import Stage
from mosa.physics.engine.law_options import LawOptions
from mosa.reconstruction.gaussians.carried import CarriedSettings
from mosa.reconstruction.gaussians.static import FitSettings, StaticSettings
from mosa.reconstruction.geometry.body import GeometrySettings
from mosa.reconstruction.motion.dynamic import DynamicSettings
from mosa.reconstruction.motion.informed import InformedSettings
from mosa.reconstruction.settings import ReconstructionSettings
from mosa.schema import (
    COUNT,
    ENTRIES,
    FLAG,
    FOLDER,
    NAMES,
    PLACE,
    POSITIVE,
    SECTION,
    SEQUENCES,
    TEXT,
    THREE,
    TURN,
    WEIGHT,
    Kind,
    is_number,
    kinds_of,
    number,
    one_of,
    or_auto,
    or_null,
    whole,
)
from mosa.types import GROUND_MODES

SECTIONS = ("scene", "prior", "adapter", "reconstruction", "simulation", "fit", "rendering", "trainer", "callbacks", "evaluation",
            "heterogeneity", "losses", "world", "criterion", "identification",
            "fit.prior", "fit.prior_eta", "fit.joint", "reconstruction.static",
            "reconstruction.appearance", "reconstruction.dynamic", "reconstruction.carried",
            "reconstruction.informed", "reconstruction.geometry")  # fmt: skip

FIGURE = Kind(
    "a figure's name like test/rms_m (docs/figures.md)",
    lambda v: isinstance(v, str) and v.split("/")[0] in FIGURES and "/" in v,
)
FIGURES = (
    "train",
    "test",
    "camera",
    "prior",
    "prior_eta",
    "id",
    "id_prior",
    "floor",
    "time",
    "posterior",
    "geometry",
    "frames",
    "extrapolated",
    "val",
)
"""What the names of figures begin with."""

TRAINING: dict[str, Kind] = {
    **{name: SECTION for name in SECTIONS},
    **kinds_of(SimulationSettings, "simulation"),
    **kinds_of(LawOptions, "prior.options"),
    **kinds_of(Stage, "fit.*"),
    **kinds_of(GeometrySettings, "reconstruction.geometry"),
    **kinds_of(StaticSettings, "reconstruction.static"),
    **kinds_of(FitSettings, "reconstruction.appearance"),
    **kinds_of(CarriedSettings, "reconstruction.carried"),
    **kinds_of(InformedSettings, "reconstruction.informed"),
    **kinds_of(ReconstructionSettings, "reconstruction"),
    **kinds_of(DynamicSettings, "reconstruction.dynamic"),
    **kinds_of(HeterogeneitySettings, "heterogeneity"),
    **kinds_of(Criterion, "criterion"),
    **kinds_of(IdentificationSettings, "identification"),
    "seed": whole(0, 2**32 - 1),
    "extrapolate": FLAG,
    "extensions": or_null(NAMES),
    "scene.also_train": or_null(SEQUENCES),
    "scene.test": or_null(SEQUENCES),
    "fit.views": COUNT,
    "fit.clip": POSITIVE,
    "losses.*": WEIGHT,
    "prior.candidates": or_null(NAMES),
    "adapter.name": or_null(TEXT),
    "adapter._target_": or_null(TEXT),
    "simulation.particles": or_auto(whole(8, 10**8)),
    "simulation.particles_per_cell": number(1, 64),
    "simulation.dx": or_null(POSITIVE),
    "prior.law": TEXT,
    "prior.parameters": SECTION,
    "prior.frozen": or_null(NAMES),
    "prior.modulated": or_null(NAMES),
    "prior.options": or_null(SECTION),
    "rendering.margin": whole(0, 256),
    "world.walls": or_null(SECTION),
    "world.colliders": or_null(ENTRIES),
    "world.driven": or_null(ENTRIES),
    "world.forces": or_null(ENTRIES),
    "rendering.backend": TEXT,
    "rendering.appearance": one_of("splats", "particles"),
    "ckpt_path": or_null(TEXT),
    "optimized_metric": FIGURE,
    "scene.cache": or_null(FOLDER),  # an empty one would be the folder that this was started in
}
BODY = {key: kind for key, kind in TRAINING.items()
        if key.split(".")[0] in ("seed", "simulation", "prior", "heterogeneity", "adapter", "world")}  # fmt: skip
"""Of these, what a checkpoint's body is built from."""
EVALUATION: dict[str, Kind] = {"deterministic": FLAG} | kinds_of(EvaluationSettings, "evaluation")
SIMULATION: dict[str, Kind] = {
    **{name: SECTION for name in ("simulate", "evaluation")},
    "extensions": or_null(NAMES),
    "ckpt_path": TEXT,
    "cache": or_null(FOLDER),
    "plan": or_null(whole(2)),
    "appearance": or_null(one_of("splats", "particles")),
    "simulate.variant": one_of("adapted", "prior_eta", "prior"),
    "simulate.velocity": or_null(THREE),
    "simulate.angular_velocity": or_null(THREE),
    "simulate.rotation": or_null(TURN),
    "simulate.position": or_null(PLACE),
    "simulate.height": or_null(Kind("a number", is_number)),
    "simulate.colliders": or_null(ENTRIES),
    "simulate.driven": or_null(ENTRIES),
    "simulate.frames": COUNT,
}
SPLATS: dict[str, Kind] = {
    **{
        key: kind
        for key, kind in BODY.items()
        if key.split(".")[0] in ("seed", "prior", "simulation", "adapter", "heterogeneity")
    },
    "extensions": or_null(NAMES),
    "ply": TEXT,
    "ckpt_path": or_null(TEXT),
    "device": TEXT,
    "size": or_null(POSITIVE),
    "up": THREE,
    "box": or_null(
        Kind(
            "two corners [[x, y, z], [x, y, z]]",
            lambda v: isinstance(v, list) and len(v) == 2 and all(map(THREE.fits, v)),
        )
    ),
    "opacity": number(0, 1),
    "open_below": FLAG,
    "resolution": whole(8, 512),
    "share": number(0, 1, above=True),
    "density": or_null(POSITIVE),
    "gravity": WEIGHT,
    "height": WEIGHT,
    "ground": SECTION,
    "ground.mode": one_of(*GROUND_MODES),
    "ground.friction": WEIGHT,
    "rotation": or_null(TURN),
    "velocity": THREE,
    "angular_velocity": THREE,
    "frames": COUNT,
    "rate": POSITIVE,
    "formats": NAMES,
    "video": FLAG,
}
"""Of conf/splats.yaml."""
PERIOD = Kind(
    "two numbers [from, to] in seconds",
    lambda v: isinstance(v, list) and len(v) == 2 and all(map(is_number, v)) and v[0] < v[1],
)
FOLDER = Kind(
    "the path of a folder", lambda v: isinstance(v, str) and bool(v.strip()) and "\0" not in v
)
RATE = number(1, 1e5)
"""Frames per second."""
CAPTURE: dict[str, Kind] = {
    **{name: FOLDER for name in ("videos", "poses", "output")},
    **{name: or_null(FOLDER) for name in ("like", "plates", "masks")},
    "mattes": one_of("plates", "rembg", "masks"),
    "plate_seconds": or_null(PERIOD),
    "fps": or_null(RATE),
    "scan": one_of("auto", "down", "up", "left", "right"),
    "readout": or_null(number(0, 0.1)),
    "phones": or_null(SECTION),
    "phones.*": SECTION,
    "phones.*.fps": or_null(RATE),
    "phones.*.scan": one_of("auto", "down", "up", "left", "right"),
    "phones.*.readout": or_null(number(0, 0.1)),
    "max_offset": number(0, 60, above=True),
    "flight": or_null(PERIOD),
    "gravity": number(0.01, 1000),
    "scale": or_null(number(1e-6, 1e6)),
    "up": or_null(
        Kind("a direction of three numbers, not zero", lambda v: THREE.fits(v) and any(v))
    ),
    "ground": or_null(THREE),
    "rate": or_null(number(1, 2000)),
    "before": number(0, 60, above=True),
    "after": number(0, 60, above=True),
    "interpolation": one_of("flow", "shift", "none"),
    "colours": one_of("floor", "none"),
}
"""Of conf/capture.yaml."""
ENVIRONMENTS: dict[str, Kind] = {
    **{name: SECTION for name in ("truth", "search", "options")},
    "task": TEXT,
    "policy": TEXT,
    "checkpoint": or_null(TEXT),
    "simulator": Kind(
        "a name, or a list of names", lambda v: isinstance(v, str) or (NAMES.fits(v) and bool(v))
    ),
    "seed": whole(0, 2**32 - 1),
    "seeds": Kind(
        "a list of whole numbers",
        lambda v: isinstance(v, list) and bool(v) and all(map(whole(0, 2**32 - 1).fits, v)),
    ),
    "trials": COUNT,
    "device": TEXT,
    "worlds": or_auto(COUNT),
    "out": or_null(TEXT),
    "page": or_null(TEXT),
    "jobs_only": FLAG,
    "films": whole(0, 100),
    "options.steps": or_null(COUNT),
    "options.*": or_null(Kind("a number", is_number)),
    "truth.scene": or_null(TEXT),
    "truth.spacing": or_null(number(1e-4, 1)),
    "truth.train_spacing": or_null(number(1e-4, 1)),
    "search.iterations": COUNT,
    "search.batch": whole(1, 10**5),
    "search.rate": number(0, 10, above=True),
    "search.clip": POSITIVE,
    "search.every": COUNT,
    "search.validation": COUNT,
    "search.candidates": whole(4),
    "search.spread": POSITIVE,
    "decisions": COUNT,
}
"""Of conf/environments.yaml."""
