"""What each value of the configuration may be, checked before anything is computed: a typing mistake costs no reconstruction.

Only kinds and ranges of single values are here; which names, files and combinations exist is said where they are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from mosa.errors import ConfigError


class Kind(NamedTuple):
    """described: as it stands in a message after 'expected'; fits: whether a value is one."""

    described: str
    fits: Callable[[Any], bool]


def is_number(value: Any) -> bool:
    """A finite number that is no flag."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def number(low: float, high: float = math.inf, *, above: bool = False) -> Kind:
    """From `low`, or `above` it, to `high`."""
    start = f"above {low:g}" if above else f"of at least {low:g}"
    limit = f" and at most {high:g}" if math.isfinite(high) else ""
    return Kind(f"a number {start}{limit}", lambda v: is_number(v) and (v > low or (v == low and not above)) and v <= high)


def whole(low: int, high: int | None = None) -> Kind:
    limit = "" if high is None else f" and at most {high}"
    return Kind(f"a whole number of at least {low}{limit}",
                lambda v: isinstance(v, int) and not isinstance(v, bool) and low <= v and (high is None or v <= high))


def one_of(*names: str) -> Kind:
    return Kind(" or ".join(names), lambda v: isinstance(v, str) and v in names)


def or_null(kind: Kind) -> Kind:
    return Kind(f"{kind.described}, or null", lambda v: v is None or kind.fits(v))


def or_auto(kind: Kind) -> Kind:
    return Kind(f"{kind.described}, or auto", lambda v: v == "auto" or kind.fits(v))


def is_sequence(value: Any) -> bool:
    """A sequence as scene.also_train and scene.test name it (mosa/data/sequences.py)."""
    return isinstance(value, str) or (isinstance(value, Mapping) and isinstance(value.get("path"), str))


TEXT = Kind("a text", lambda v: isinstance(v, str))
FLAG = Kind("true or false", lambda v: isinstance(v, bool))
NAMES = Kind("a list of names like [a, b]", lambda v: isinstance(v, list) and all(isinstance(name, str) for name in v))
SEQUENCES = Kind("a list of names or folders like [a, b], or of sections like {path: a, frames: [0, 9]}",
                 lambda v: isinstance(v, list) and all(map(is_sequence, v)))
SECTION = Kind("a section of keys", lambda v: isinstance(v, Mapping))
ENTRIES = Kind("a list of sections", lambda v: isinstance(v, list) and all(isinstance(entry, Mapping) for entry in v))
THREE = Kind("three numbers", lambda v: isinstance(v, list) and len(v) == 3 and all(map(is_number, v)))
PLACE = Kind("three numbers, null for one that is left as it is",
             lambda v: isinstance(v, list) and len(v) == 3 and all(x is None or is_number(x) for x in v))  # fmt: skip
TURN = Kind("four numbers, an axis and degrees", lambda v: isinstance(v, list) and len(v) == 4 and all(map(is_number, v)))
POSITIVE, WEIGHT, COUNT = number(0, above=True), number(0), whole(1)
WIDEST = 4096
"""Of a layer of a network: many times what any run has used, and far below what memory would not hold."""

SECTIONS = ("scene", "prior", "adapter", "reconstruction", "simulation", "fit", "rendering", "trainer", "logger", "evaluation",
            "heterogeneity", "losses", "world", "criterion", "identification",
            "fit.prior", "fit.prior_eta", "fit.joint", "reconstruction.static",
            "reconstruction.appearance", "reconstruction.dynamic", "reconstruction.carried")  # fmt: skip

FIGURE = Kind("a figure's name like test/rms_m (docs/figures.md)",
              lambda v: isinstance(v, str) and v.split("/")[0] in FIGURES and "/" in v)
FIGURES = ("train", "test", "camera", "prior", "prior_eta", "id", "id_prior", "floor", "time", "posterior", "geometry", "frames")
"""What the names of figures begin with."""

TRAINING: dict[str, Kind] = {
    **{name: SECTION for name in SECTIONS},
    "seed": whole(0, 2**32 - 1),
    "extensions": or_null(NAMES),
    "scene.also_train": or_null(SEQUENCES),
    "scene.test": or_null(SEQUENCES),
    "fit.views": COUNT,
    "fit.clip": POSITIVE,
    "fit.*.iterations": whole(0),
    "fit.*.lr*": WEIGHT,
    "fit.*.converged": WEIGHT,
    "fit.joint.start": or_null(one_of("prior", "prior_eta")),
    "losses.*": WEIGHT,
    "heterogeneity.enabled": FLAG,
    "heterogeneity.kind": one_of("modes", "network"),
    "heterogeneity.wavelength": number(0, 2, above=True),
    "heterogeneity.most": whole(1, WIDEST),
    "criterion.name": one_of("free", "corrected", "both"),
    "criterion.gain": number(0, 1, above=True),
    "identification.count": POSITIVE,
    "identification.grid_error": number(0, 10),
    "identification.model_error": number(0, 1),
    "identification.operator_sd": POSITIVE,
    "identification.stiffness_sd": POSITIVE,
    "identification.smoothness": WEIGHT,
    "identification.evidence": FLAG,
    "identification.tolerance": POSITIVE,
    "identification.threads": whole(0, 256),
    "fit.*.optimizer": one_of("auto", "gauss_newton", "adam"),
    "fit.*.newton_iterations": COUNT,
    "adapter.strain": one_of("green", "biot", "hencky"),
    "prior.candidates": or_null(NAMES),
    "heterogeneity.amplitude": POSITIVE,
    "heterogeneity.hidden": whole(1, WIDEST),
    "heterogeneity.frequencies": whole(0, 32),
    "adapter.name": or_null(TEXT),
    "adapter._target_": or_null(TEXT),
    "adapter.alpha": POSITIVE,
    "adapter.alpha_normal": or_null(POSITIVE),
    "adapter.l_max": or_null(POSITIVE),
    "adapter.input_scale": POSITIVE,
    "adapter.hidden": whole(1, WIDEST),
    "adapter.start": one_of("prior", "random"),
    "adapter.plastic_rate": POSITIVE,
    "adapter.rank": whole(1, WIDEST),
    "adapter.scaling": POSITIVE,
    "adapter.nodes": whole(8, 10**5),
    "adapter.neighbours": whole(4, 1000),
    "adapter.stiffer": number(0, 5, above=True),
    **{f"adapter.{name}": FLAG for name in ("rest_free", "plastic", "major_symmetry", "recompute", "no_C", "no_pre", "no_post",
                                            "no_prior_stress")},
    "simulation.particles": or_auto(whole(8, 10**8)),
    "simulation.particles_per_cell": number(1, 64),
    "simulation.dx": or_null(POSITIVE),
    "simulation.courant": number(0, 1, above=True),  # beyond, an explicit step is unstable
    "simulation.adaptive": FLAG,
    "simulation.contact_offset": FLAG,
    "simulation.stride": whole(1, 10**6),
    "simulation.max_substeps": whole(1, 10**6),
    "prior.law": TEXT,
    "prior.parameters": SECTION,
    "prior.frozen": or_null(NAMES),
    "prior.modulated": or_null(NAMES),
    "prior.options": or_null(SECTION),
    "prior.options.yield_convention": one_of("paper", "sqrt23"),
    "prior.options.norm_eps": WEIGHT,
    "prior.options.rebuild": FLAG,
    "prior.options.on_inversion": one_of("warn", "ignore", "error"),
    "prior.options.init_affine": one_of("spin", "zero"),
    "rendering.margin": whole(0),
    "reconstruction.resolution": whole(8, 1024),  # a hull of that many voxels per side has 4 GB
    "reconstruction.splats": or_null(TEXT),
    "reconstruction.cue": one_of("neighbourhood", "gaussian"),
    "reconstruction.dynamic.model": one_of("modes", "network"),
    "reconstruction.dynamic.carriers": one_of("static", "particles"),
    "reconstruction.ridge_passes": whole(0),
    "reconstruction.geometry.source": one_of("images", "hull"),
    "reconstruction.geometry.frames": COUNT,
    "reconstruction.points": whole(8, 10**8),
    "reconstruction.neighbours": whole(4),  # fewer leave every deformation gradient open
    "reconstruction.margin": whole(0),
    "reconstruction.*.iterations": whole(0),
    "reconstruction.*.views": COUNT,
    "reconstruction.*.keep": WEIGHT,
    "reconstruction.carried.keep_harmonics": WEIGHT,
    "reconstruction.*.lr*": WEIGHT,
    "reconstruction.*.ssim": number(0, 1),
    "reconstruction.*.matte": WEIGHT,
    "reconstruction.carried.degree": whole(0, 3),
    "reconstruction.carried.light": FLAG,
    "reconstruction.*.shape": one_of("isotropic", "anisotropic"),
    "reconstruction.*.largest": number(1),
    "reconstruction.*.axis_ratio": number(1),
    "reconstruction.static.start": one_of("hull", "random"),
    "reconstruction.static.densify": one_of("relocate", "mcmc"),
    "reconstruction.static.max_points": or_null(whole(8)),
    "reconstruction.static.relocate_every": whole(0),
    "reconstruction.static.refine_every": COUNT,
    "reconstruction.static.growth": WEIGHT,
    "reconstruction.static.fade": WEIGHT,
    "reconstruction.static.noise": WEIGHT,
    "reconstruction.dynamic.modes": COUNT,
    "reconstruction.dynamic.track_iterations": whole(0),
    "reconstruction.dynamic.track_views": COUNT,
    "reconstruction.dynamic.free_shape": FLAG,
    "reconstruction.dynamic.elastic": WEIGHT,
    "reconstruction.dynamic.bending": WEIGHT,
    "reconstruction.dynamic.bending_scale": WEIGHT,
    "reconstruction.dynamic.hidden": whole(1, WIDEST),
    "world.walls": or_null(SECTION),
    "world.colliders": or_null(ENTRIES),
    "logger.tensorboard": or_null(SECTION),
    "logger.csv": or_null(SECTION),
    "logger.wandb": or_null(SECTION),
    "logger.wandb.offline": FLAG,
    "logger.wandb.tags": or_null(NAMES),
    "rendering.backend": TEXT,
    "rendering.appearance": one_of("splats", "particles"),
    "ckpt_path": or_null(TEXT),
    "optimized_metric": FIGURE,
    "scene.cache": or_null(TEXT),
    "logger.images_every": whole(0),
}
BODY = {key: kind for key, kind in TRAINING.items()
        if key.split(".")[0] in ("seed", "simulation", "prior", "heterogeneity", "adapter", "world")}  # fmt: skip
"""Of these, what a checkpoint's body is built from."""
EVALUATION: dict[str, Kind] = {
    "evaluation.floor": FLAG,
    "evaluation.samples": COUNT,
    "evaluation.assignment": COUNT,
    "evaluation.video": FLAG,
}
SIMULATION: dict[str, Kind] = {
    **{name: SECTION for name in ("simulate", "evaluation")},
    "extensions": or_null(NAMES),
    "ckpt_path": TEXT,
    "cache": or_null(TEXT),
    "plan": or_null(whole(2)),
    "appearance": or_null(one_of("splats", "particles")),
    "simulate.variant": one_of("adapted", "prior_eta", "prior"),
    "simulate.velocity": or_null(THREE),
    "simulate.angular_velocity": or_null(THREE),
    "simulate.rotation": or_null(TURN),
    "simulate.position": or_null(PLACE),
    "simulate.height": or_null(Kind("a number", is_number)),
    "simulate.colliders": or_null(ENTRIES),
    "simulate.frames": COUNT,
}
SPLATS: dict[str, Kind] = {
    **{key: kind for key, kind in BODY.items() if key.split(".")[0] in ("seed", "prior", "simulation", "adapter", "heterogeneity")},
    "extensions": or_null(NAMES),
    "ply": TEXT,
    "ckpt_path": or_null(TEXT),
    "device": TEXT,
    "size": or_null(POSITIVE),
    "up": THREE,
    "box": or_null(Kind("two corners [[x, y, z], [x, y, z]]",
                        lambda v: isinstance(v, list) and len(v) == 2 and all(map(THREE.fits, v)))),
    "opacity": number(0, 1),
    "open_below": FLAG,
    "resolution": whole(8, 512),
    "share": number(0, 1, above=True),
    "density": or_null(POSITIVE),
    "gravity": WEIGHT,
    "height": WEIGHT,
    "ground": SECTION,
    "ground.mode": one_of("sticky", "slip", "separate"),
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


def check(values: Mapping[str, Any], *schemas: Mapping[str, Kind]) -> None:
    """Every value of a nested configuration that a schema knows is of its kind. Patterns stand for one level each.

    Errors: ConfigError with the key, what was expected and what was found, for the first that is not.
    """
    kinds = {pattern: kind for schema in schemas for pattern, kind in schema.items()}
    _check(values, kinds, ())


def _check(values: Mapping[str, Any], kinds: Mapping[str, Kind], path: tuple[str, ...]) -> None:
    for key, value in values.items():
        here = (*path, str(key))
        for pattern, kind in kinds.items():
            parts = pattern.split(".")
            if len(parts) == len(here) and all(map(fnmatchcase, here, parts)) and not kind.fits(value):
                raise ConfigError(f"{'.'.join(here)}: expected {kind.described}, found {value!r}")
        if isinstance(value, Mapping):
            _check(value, kinds, here)
