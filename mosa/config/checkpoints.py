"""A run's checkpoint, read as data: its file may come from a stranger, and is checked before anything is built from it.

What is promised, and what is not, is in docs/safety.md.
"""

from __future__ import annotations

import math
import pickletools
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mosa.config.extensions import registered_keys
from mosa.config.keys import BODY
from mosa.errors import ConfigError, DataError
from mosa.modules.body.material import RIVALS
from mosa.modules.fitting.retreat import MOST_HALVINGS
from mosa.physics.constitutive.laws import law_named
from mosa.rendering.appearance.lighting import LIGHT
from mosa.rendering.appearance.spherical_harmonics import DEGREES
from mosa.schema import (
    FLAG,
    POSITIVE,
    THREE,
    WEIGHT,
    Kind,
    check,
    is_number,
    number,
    one_of,
    or_null,
    whole,
)
from mosa.system.limits import machine_memory
from mosa.types import GROUND_MODES

TENSORS = {"rest": (3,), "volume": (), "colors": (3,), "opacities": (), "covariances": (3, 3)}
"""What a body is made of, with the shape for each particle."""
SPLATS = {"means": (3,), "scales": (3,), "rotations": (4,), "opacities": (), "colors": (3,),
          "normals": (3,)}  # fmt: skip
BOUND_BYTES = 4000
"""Of a splat while it is bound to its neighbours."""
VERSION = 2
"""Of what a run keeps under `mosa` in its checkpoint; grows when a program that knows the one before could not read it. Before 2,
the numbers of the default adapter were coordinates in a basis that each processor found for itself."""
RESUMED = (
    "epoch",
    "global_step",
    "pytorch-lightning_version",
    "loops",
    "callbacks",
    "optimizer_states",
    "lr_schedulers",
)
"""What Lightning reads where a fit goes on."""
NAMED = {"collections OrderedDict", "torch Size", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter",
         *(f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte",
                                               "Bool"))}  # fmt: skip
"""Functions and classes that a checkpoint of this program refers to; torch knows some more, of which a few make large objects."""
BESIDE = ("ckpt_path", "resume", "optimized_metric", "logger", "callbacks", "trainer", "evaluation", "rendering.backend",
          "scene.cache", "scene.root", "identification.threads", "extensions")  # fmt: skip
"""Keys of a run that do not say what is learned, or say where things lie on this machine. A capture may have been moved: of
`scene.path` the last part counts."""
BY_CONTACT = or_null(Kind("numbers by contact", lambda v: isinstance(v, Mapping) and all(
    isinstance(x, float) and not math.isnan(x) for x in v.values())))  # fmt: skip
GOING_ON: dict[str, Kind] = {
    "stage": whole(0), "steps_done": whole(0), "particles": whole(1), "misfit": POSITIVE, "stage_over": FLAG,
    "losses": Kind("numbers", lambda v: isinstance(v, list) and all(is_number(x) for x in v)),
    "compared": or_null(Kind("distances by law", lambda v: isinstance(v, Mapping) and all(map(is_number, v.values())))),
    "grounds": BY_CONTACT, "ground_gains": BY_CONTACT, "parts": BY_CONTACT,
}  # fmt: skip
"""Of `mosa`, what a fit goes on from."""
NODES, DEPTH = 2_000_000, 40
"""Entries and levels of a checkpoint's containers: losses of a fit of 10,000 steps are 10,000."""

STRONGEST, WIDEST = 1e4, 1e5
"""[m/s^2] of gravity and [m] of a world's box."""
BRIGHTEST = 10.0
"""Of a colour, which a fit may bring beyond 1."""
SPACING = 0.02, 5.0
"""Distance between particles, in cells: 1/64 to 50 of them in a cell's volume, with room."""
BOX = Kind(
    "two corners, min below max",
    lambda v: (
        isinstance(v, list)
        and len(v) == 2
        and all(map(THREE.fits, v))
        and all(a < b for a, b in zip(*v))
    ),
)
TURNED = Kind("a 3x3 rotation matrix", lambda v: is_rotation(v))
START = {"rotation": TURNED, "center": THREE, "velocity": THREE, "angular_velocity": THREE}
STORED: dict[str, Kind] = {
    "density": number(0.1, 1e5), "dx": number(1e-6, 100), "frame_dt": number(1e-6, 100), "world.gravity": THREE, "world.box": BOX,
    "world.up": Kind("a direction", lambda v: THREE.fits(v) and any(v)),
    "world.ground.height": Kind("a number", is_number), "world.ground.mode": one_of(*GROUND_MODES),
    "world.ground.friction": WEIGHT, "world.ground.accuracy": or_null(WEIGHT),
    **{f"starts.*.{name}": kind for name, kind in START.items()},
}  # fmt: skip
"""Beside the configuration itself, what a run measured."""


def is_rotation(value: Any) -> bool:
    """Nested lists of a 3x3 matrix with R R^T = I and det R = 1, to 1e-3."""
    if not (isinstance(value, list) and len(value) == 3 and all(map(THREE.fits, value))):
        return False
    R = torch.tensor(value, dtype=torch.float64)
    return (
        float((R @ R.T - torch.eye(3).double()).abs().max()) < 1e-3
        and float(torch.linalg.det(R)) > 0
    )


def read_checkpoint(path: str | Path) -> dict:
    """The checkpoint's dictionary: plain containers and dense tensors, nothing executed. Errors: DataError naming the file."""
    if not isinstance(path, (str, Path)):
        raise DataError(f"ckpt_path: expected the path of a checkpoint, found {path!r}")
    path = Path(path)
    try:
        if not path.is_file():
            raise DataError(
                f"ckpt_path: no file {path}; a run writes <run folder>/checkpoints/last.ckpt"
            )
        check_archive(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except DataError:
        raise
    except Exception as error:  # whatever torch finds: the file is not what its name says
        first = (str(error).splitlines() or [""])[0][:200]
        raise DataError(
            f"ckpt_path: {path} is not a readable checkpoint ({type(error).__name__}: {first})"
        ) from error
    check_containers(checkpoint, path)
    if not isinstance(checkpoint, dict) or "mosa" not in checkpoint:
        raise DataError(f"ckpt_path: {path} was not written by this program (no entry 'mosa')")
    saved = checkpoint["mosa"]
    version = (
        saved.get("version", 0) if isinstance(saved, dict) else 0
    )  # 0: of before there were numbers
    if not whole(0).fits(version) or version > VERSION:
        raise DataError(
            f"ckpt_path: {path}: mosa.version: expected at most {VERSION}, found {version!r}: it is of a newer "
            "version of this program"
        )
    weights = checkpoint.get("state_dict")
    numbers = weights.get("body.adapter.numbers") if isinstance(weights, Mapping) else None
    if version < 2 and isinstance(numbers, torch.Tensor) and bool((numbers != 0).any()):
        raise DataError(
            f"ckpt_path: {path}: mosa.version: expected {VERSION} for a law learned by the default adapter, found "
            f"{version}: its numbers are coordinates in a basis that depended on the processor it was learned on, and "
            "would be another law here; learn it again"
        )
    return checkpoint


def check_archive(path: Path) -> None:
    """The archive unpacks to no more than its own size, and its pickle names nothing but tensors. Errors: DataError."""
    if not zipfile.is_zipfile(path):
        raise DataError(
            f"ckpt_path: {path} is not a readable checkpoint (expected a zip archive: cut off, or another file?)"
        )
    size = path.stat().st_size
    if size > machine_memory():
        raise DataError(
            f"ckpt_path: {path} has {size / 1e9:.1f} GB, this machine {machine_memory() / 1e9:.1f} GB of memory"
        )
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > size:
            raise DataError(
                f"ckpt_path: {path} unpacks to more than its {size} bytes; a run's checkpoint is not compressed"
            )
        names = archive.namelist()
        if len(set(names)) < len(names):
            raise DataError(
                f"ckpt_path: {path} is not a readable checkpoint (an entry of its archive is there twice)"
            )
        if (
            damaged := archive.testzip()
        ) is not None:  # torch does not compare the sums: a flipped bit would be another number
            raise DataError(
                f"ckpt_path: {path} is damaged: its part {damaged} is not what was written (another sum)"
            )
        for entry in names:
            if not entry.endswith(".pkl"):
                continue
            for code, named, _ in pickletools.genops(archive.read(entry)):
                if (
                    "GLOBAL" in code.name and named not in NAMED
                ):  # STACK_GLOBAL names nothing here, and is not written
                    raise DataError(
                        f"ckpt_path: {path} refers to {named or 'a function or class'}; a run's checkpoint holds "
                        "numbers, texts and tensors only, and nothing else is loaded"
                    )


def check_containers(checkpoint: Any, path: Path) -> None:
    """Plain values in a bounded tree, whole tensors, no interpolation. Errors: DataError."""
    left, waiting = NODES, [(checkpoint, 0, "")]
    while waiting:
        value, depth, where = waiting.pop()
        left -= 1
        if left < 0 or depth > DEPTH:
            raise DataError(
                f"ckpt_path: {path}: expected at most {NODES} entries in {DEPTH} levels, found more at {where}"
            )
        if isinstance(value, Mapping):
            if bad := [key for key in value if not isinstance(key, (str, int))]:
                raise DataError(f"ckpt_path: {path}: {where}: expected names, found {bad[0]!r}")
            waiting += [(v, depth + 1, f"{where}.{k}".strip(".")) for k, v in value.items()]
        elif isinstance(value, (list, tuple)):
            waiting += [(v, depth + 1, where) for v in value]
        elif isinstance(value, Tensor):
            plain = (
                value.layout == torch.strided
                and value.device.type == "cpu"
                and not value.is_quantized
            )
            if not plain or value.numel() * value.element_size() > value.untyped_storage().nbytes():
                raise DataError(
                    f"ckpt_path: {path}: {where}: expected a dense tensor of as many numbers as are stored, found one "
                    f"of shape {tuple(value.shape)}"
                )
        elif (
            isinstance(value, str)
            and where.startswith("mosa.config")
            and ("${" in value or "\0" in value)
        ):
            raise DataError(
                f"ckpt_path: {path}: {where}: expected a value, found {value[:80]!r}: interpolations of a stored "
                "configuration are not resolved"
            )
        elif not isinstance(value, (str, int, float, type(None))):
            raise DataError(
                f"ckpt_path: {path}: {where}: expected numbers, texts and tensors, found {type(value).__name__}"
            )


def checked(
    checkpoint: Mapping[str, Any], path: str | Path
) -> tuple[dict, dict, dict[str, Tensor]]:
    """(configuration, start, tensors of the body) of a read checkpoint. Errors: DataError naming file and part."""
    saved, state = checkpoint["mosa"], checkpoint.get("state_dict")
    try:
        parts(saved, ("config", "start"), "mosa")
        config = saved["config"]
        parts(config, ("cfg", "world", "density", "dx", "frame_dt"), "mosa.config")
        parts(
            config["cfg"],
            ("seed", "simulation", "prior", "heterogeneity", "adapter"),
            "mosa.config.cfg",
        )
        parts(config["world"], ("ground", "gravity", "up", "box"), "mosa.config.world")
        parts(saved["start"], START, "mosa.start")
        starts = config.get("starts") or {}
        parts(starts, (), "mosa.config.starts")
        for name, start in starts.items():
            if (
                re.fullmatch(r"(train|test)(/[\w-]+)?", str(name)) is None
            ):  # it names entries of the files that are written
                raise ConfigError(
                    f"mosa.config.starts: expected names like train or test/<sequence>, found {str(name)[:80]!r}"
                )
            parts(start, START, f"mosa.config.starts.{name}")
        if config["world"]["ground"] is not None:
            parts(config["world"]["ground"], ("height",), "mosa.config.world.ground")
        stored = {name: config[name] for name in ("density", "dx", "frame_dt", "world")}
        check(stored | {"starts": {"fit": saved["start"], **starts}}, STORED)
        used = {
            name: config["cfg"][name]
            for name in ("seed", "simulation", "prior", "heterogeneity", "adapter")
        }
        check(used | {"world": config["cfg"].get("world") or {}}, BODY, registered_keys(used))
    except ConfigError as error:
        raise DataError(f"ckpt_path: {path}: stored configuration: {error}") from error
    if not isinstance(state, Mapping):
        raise DataError(f"ckpt_path: {path}: expected the part state_dict, found none")
    tensors = {
        k.removeprefix("body."): v
        for k, v in state.items()
        if isinstance(k, str) and k.startswith("body.")
    }
    check_tensors(tensors, path)
    check_sense(config, tensors, path)
    return config, saved["start"], tensors


def checked_posterior(checkpoint: Mapping[str, Any], numbers: int, path: str | Path) -> dict | None:
    """What `Posterior.read` takes, of a body with so many learned numbers; None where the run kept none. Errors: DataError."""
    found = checkpoint["mosa"].get("posterior")
    if found is None:
        return None
    where = f"ckpt_path: {path}: mosa.posterior"
    shapes = {"mean": (numbers,), "covariance": (numbers, numbers), "determined": (numbers,)}
    try:
        parts(found, ("names", "model_error", *shapes), "mosa.posterior")
    except ConfigError as error:
        raise DataError(f"ckpt_path: {path}: {error}") from error
    for name, shape in shapes.items():
        value = found[name]
        if (
            not isinstance(value, Tensor)
            or tuple(value.shape) != shape
            or not bool(torch.isfinite(value).all())
        ):
            raise DataError(
                f"{where}.{name}: expected {' x '.join(map(str, shape))} finite numbers"
            )
    names = found["names"]
    if (
        not isinstance(names, list)
        or len(names) != numbers
        or not all(isinstance(n, str) for n in names)
    ):
        raise DataError(f"{where}.names: expected {numbers} names")
    if not is_number(found["model_error"]) or found["model_error"] < 0:
        raise DataError(
            f"{where}.model_error: expected a distance in m, found {found['model_error']!r}"
        )
    rivals = found.get("rivals", {})
    if not isinstance(rivals, Mapping) or not set(rivals) <= set(RIVALS):
        raise DataError(f"{where}.rivals: expected numbers of laws among {', '.join(RIVALS)}")
    for law, value in rivals.items():
        if (
            not isinstance(value, Tensor)
            or tuple(value.shape) != (numbers,)
            or not bool(torch.isfinite(value).all())
        ):
            raise DataError(f"{where}.rivals.{law}: expected {numbers} finite numbers")
    if not float(torch.linalg.eigvalsh(found["covariance"].double()).min()) > 0:
        raise DataError(f"{where}.covariance: expected a positive definite matrix")
    return found


def checked_splats(checkpoint: Mapping[str, Any], path: str | Path) -> dict[str, Tensor] | None:
    """What `CarriedSplats.read` takes; None where the run kept none. Errors: DataError naming file and part."""
    found = checkpoint["mosa"].get("splats")
    if found is None:
        return None
    where = f"ckpt_path: {path}: mosa.splats"
    try:
        parts(found, (*SPLATS, "harmonics", "light"), "mosa.splats")
    except ConfigError as error:
        raise DataError(f"ckpt_path: {path}: {error}") from error
    tensors = {name: found[name] for name in (*SPLATS, "harmonics", "light")}
    count = (
        len(tensors["means"])
        if isinstance(tensors["means"], Tensor) and tensors["means"].ndim
        else 0
    )
    if not 0 < count <= machine_memory() // (2 * BOUND_BYTES):
        raise DataError(
            f"{where}.means: expected 1 to {machine_memory() // (2 * BOUND_BYTES)} splats, which take half of this "
            f"machine's memory, found {count}"
        )
    for name, value in tensors.items():
        shapes = [(count, *SPLATS[name])] if name in SPLATS else [(count, k, 3) for k in DEGREES]
        shapes = [(LIGHT,)] if name == "light" else shapes
        if not isinstance(value, Tensor) or tuple(value.shape) not in shapes or not value.is_floating_point() or not bool(
                torch.isfinite(value).all()):  # fmt: skip
            raise DataError(
                f"{where}.{name}: expected finite numbers of shape {' or '.join(map(str, shapes))}"
            )
    turned = (tensors[name].norm(dim=1).min() for name in ("rotations", "normals"))
    if not float(tensors["scales"].min()) > 0 or not all(map(float, turned)):
        raise DataError(
            f"{where}: expected scales above 0 m, quaternions and normals that are not zero"
        )
    if float(tensors["opacities"].min()) < 0 or float(tensors["opacities"].max()) > 1:
        raise DataError(f"{where}.opacities: expected numbers from 0 to 1")
    return tensors


def parts(found: Any, wanted: Iterable[str], where: str) -> None:
    """Errors: ConfigError naming the parts that are missing."""
    if not isinstance(found, Mapping):
        raise ConfigError(
            f"{where}: expected a section with {', '.join(wanted)}, found {str(found)[:80]!r}"
        )
    if missing := [name for name in wanted if name not in found]:
        raise ConfigError(
            f"{where}: expected the parts {', '.join(wanted)}, found none called {', '.join(missing)}"
        )


def check_tensors(tensors: Mapping[str, Any], path: str | Path) -> None:
    """Shapes, types and numbers of a body's tensors. Errors: DataError naming the tensor."""
    if missing := [name for name in TENSORS if not isinstance(tensors.get(name), Tensor)]:
        raise DataError(
            f"ckpt_path: {path}: expected the tensors {', '.join(TENSORS)} of a body, found no {', '.join(missing)}"
        )
    count = len(tensors["rest"]) if tensors["rest"].ndim else 0
    for name, each in TENSORS.items():
        found = tensors[name]
        if (
            tuple(found.shape) != (count, *each)
            or count == 0
            or found.dtype not in (torch.float32, torch.float64)
        ):
            raise DataError(
                f"ckpt_path: {path}: body.{name}: expected floating point numbers of shape "
                f"({', '.join(('N', *map(str, each)))}), N particles, found {found.dtype} {tuple(found.shape)}"
            )
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise DataError(
                f"ckpt_path: {path}: body.{name}: expected a tensor, found {type(value).__name__}"
            )
        unset = (
            name.startswith("adapter.") and value.ndim == 0
        )  # an adapter that was not switched on yet has no unit
        if value.is_floating_point() and not unset and not bool(torch.isfinite(value).all()):
            raise DataError(f"ckpt_path: {path}: body.{name}: expected finite numbers")
    opacities, colors, covariances = (
        tensors[name].detach() for name in ("opacities", "colors", "covariances")
    )
    if (
        not 0 <= float(opacities.min()) <= float(opacities.max()) <= 1
        or float(colors.abs().max()) > BRIGHTEST
    ):
        raise DataError(
            f"ckpt_path: {path}: body.opacities, body.colors: expected opacities from 0 to 1 and colours within "
            f"{BRIGHTEST:g}, found {float(opacities.min()):g} to {float(opacities.max()):g} and "
            f"{float(colors.abs().max()):g}"
        )
    widths, size = (
        torch.linalg.eigvalsh(covariances.double()),
        float((tensors["rest"].amax(0) - tensors["rest"].amin(0)).max()),
    )
    uneven = float((covariances - covariances.mT).abs().max()) > 1e-3 * float(
        covariances.abs().max()
    )
    if uneven or float(widths.min()) < -1e-3 * float(widths.max()) or float(widths.max()) > size**2:
        raise DataError(
            f"ckpt_path: {path}: body.covariances: expected symmetric, positive ones of particles smaller than the "
            f"body of {size:.3g} m, found squared widths of {float(widths.min()):.3g} to {float(widths.max()):.3g} m^2"
        )
    if not float(tensors["volume"].min()) > 0 or not math.isfinite(
        float(tensors["rest"].abs().max())
    ):
        raise DataError(
            f"ckpt_path: {path}: body.volume: expected volumes above 0 m^3, found {float(tensors['volume'].min()):g}"
        )


def check_sense(config: Mapping[str, Any], tensors: Mapping[str, Tensor], path: str | Path) -> None:
    """A body that can be, in a world that holds together: numbers may be finite and yet mean nothing. Errors: DataError."""
    world, where = config["world"], f"ckpt_path: {path}: stored configuration: world"
    gravity, up = (torch.tensor(world[name], dtype=torch.float64) for name in ("gravity", "up"))
    if world["ground"] is not None:
        corners = torch.cartesian_prod(*torch.tensor(world["box"], dtype=torch.float64).T) @ (
            up / up.norm()
        )
        if not float(corners.min()) <= world["ground"]["height"] <= float(corners.max()):
            raise DataError(
                f"{where}.ground.height: expected a ground inside of the box {world['box']}, found "
                f"{world['ground']['height']:g}"
            )
        if bool(gravity.any()) and not float(gravity @ up) < 0:
            raise DataError(
                f"{where}.gravity: expected a pull against up = {world['up']}, found {world['gravity']}"
            )
    if (
        float(gravity.norm()) > STRONGEST
        or max(abs(x) for corner in world["box"] for x in corner) > WIDEST
    ):
        raise DataError(
            f"{where}: expected a gravity of at most {STRONGEST:g} m/s^2 and a box within {WIDEST:g} m, found "
            f"{world['gravity']} and {world['box']}"
        )
    share = float(tensors["volume"].double().mean()) ** (1 / 3) / config["dx"]
    if not SPACING[0] < share < SPACING[1]:
        raise DataError(
            f"ckpt_path: {path}: body.volume: expected particles {SPACING[0]:g} to {SPACING[1]:g} cells of "
            f"dx = {config['dx']:g} m apart, found {share:.3g}"
        )


def check_kinds(found: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> None:
    """Numbers where numbers are wanted: copying would turn flags and whole numbers into them. Errors: DataError."""
    for name, value in wanted.items():
        if name in found and found[name].dtype != value.dtype and not (
            {found[name].dtype, value.dtype} <= {torch.float32, torch.float64}):  # fmt: skip
            raise DataError(f"body.{name}: expected {value.dtype}, found {found[name].dtype}")


def check_same(checkpoint: Mapping[str, Any], module: torch.nn.Module, path: str | Path) -> None:
    """The checkpoint is of this very model. Errors: DataError naming the first part that is not."""
    here, there = module.state_dict(), checkpoint["state_dict"]
    count = len(here["body.rest"])
    if checkpoint["mosa"]["particles"] != count:
        raise DataError(
            f"ckpt_path: {path}: expected a body of {count} particles, found {checkpoint['mosa']['particles']}: the "
            "checkpoint belongs to another scene, reconstruction or simulation.particles"
        )
    for name in sorted(set(here) | set(there)):
        found = [
            f"{tuple(state[name].shape)}{'' if state[name].is_floating_point() else ' of whole numbers or flags'}"
            if isinstance(state.get(name), Tensor)
            else None
            for state in (here, there)
        ]
        if found[0] != found[1]:
            raise DataError(
                f"ckpt_path: {path}: {name}: expected {found[0] or 'nothing of that name'}, found {found[1]}: "
                "the checkpoint belongs to another configuration (adapter, prior, heterogeneity)"
            )
    check_tensors(
        {k.removeprefix("body."): v for k, v in there.items() if k.startswith("body.")}, path
    )
    stage, most = checkpoint["mosa"]["stage"], len(module.stages)
    if stage > most:
        raise DataError(
            f"ckpt_path: {path}: mosa.stage: expected at most {most}, the stages of this fit, found {stage}: the "
            "checkpoint belongs to another configuration (fit)"
        )


def check_same_run(
    checkpoint: Mapping[str, Any], values: Mapping[str, Any], folder: str | Path
) -> None:
    """The checkpoint in a run's folder is of the configuration that resume=auto is to go on with: figures and steps of another one
    would else pass for this one's. Keys that only one of both has are of another version. Errors: ConfigError naming the keys."""
    if (stored := stored_keys(checkpoint)) is None:
        return
    chosen = (
        ("prior",) if checkpoint["mosa"].get("compared") else ()
    )  # a law was chosen among prior.candidates
    if found := list(differing(stored, values, (*BESIDE, *chosen))):
        raise ConfigError(
            f"resume: expected in {folder} a run of this configuration, found another one's ({listed(found)}); give "
            "this run a folder of its own, begin anew in this one with resume=null, or go on from its checkpoint "
            "with ckpt_path="
        )


def check_same_scene(
    checkpoint: Mapping[str, Any], values: Mapping[str, Any], path: str | Path
) -> None:
    """The checkpoint that ckpt_path names was fitted to the data that the fit is to go on with: a body of as many particles would
    take another's law for its own. Other keys may differ. Errors: ConfigError naming those of the scene that do."""
    stored, without = stored_keys(checkpoint), (*BESIDE, "scene.test")
    if stored is not None and (
        found := list(differing(stored.get("scene"), values.get("scene"), without, "scene"))
    ):
        raise ConfigError(
            f"ckpt_path: expected in {path} a fit to this scene, found one to another ({listed(found)}); a law is "
            "taken to another object with python eval.py or python -m mosa.splats"
        )


def stored_keys(checkpoint: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The configuration that a checkpoint's run had; None where it does not say."""
    stored = checkpoint["mosa"].get("config")
    stored = stored.get("cfg") if isinstance(stored, Mapping) else None
    return stored if isinstance(stored, Mapping) else None


def listed(found: Sequence[tuple[str, Any, Any]]) -> str:
    """Keys that differ, with both values."""
    shown = ", ".join(
        f"{key}: {str(there)[:60]} there, {str(here)[:60]} here" for key, there, here in found[:4]
    )
    return shown + (f", and {len(found) - 4} more" if len(found) > 4 else "")


def differing(
    stored: Any, values: Any, without: Sequence[str] = (), where: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """(key, stored, given) of the values that differ among those that both have; `without`: keys with all that is below them."""
    if isinstance(stored, Mapping) and isinstance(values, Mapping):
        for key in sorted(set(stored) & set(values), key=str):
            below = f"{where}.{key}".strip(".")
            if below not in without:
                yield from differing(stored[key], values[key], without, below)
    elif where == "scene.path" and isinstance(stored, str) and isinstance(values, str):
        if Path(stored).name != Path(values).name:
            yield where, stored, values
    elif (list(stored) if isinstance(stored, tuple) else stored) != values:
        yield where, stored, values


def check_cues(found: Any) -> None:
    """Positions that a fit found once more, of each sequence; None where it did not. Errors: ConfigError."""
    shaped = isinstance(found, list) and all(
        isinstance(t, Tensor) and t.ndim == 3 and t.shape[2] == 3 for t in found
    )
    if found is not None and not (
        shaped and all(t.is_floating_point() and bool(torch.isfinite(t).all()) for t in found)
    ):
        described = (
            [tuple(t.shape) if isinstance(t, Tensor) else type(t).__name__ for t in found]
            if isinstance(found, list)
            else type(found).__name__
        )
        raise ConfigError(f"mosa.cues: expected null, or for each sequence finite positions of shape (T, N, 3), found "
                          f"{str(described)[:200]}")  # fmt: skip


def check_responses(found: Any) -> None:
    """What the cues of each sequence keep of the prediction that they were found about; None where none is known. Errors:
    ConfigError."""

    def kept(each: Any) -> bool:
        return each is None or (isinstance(each, dict) and set(each) == {"about", "share"} and all(
            isinstance(t, Tensor) and t.ndim == 3 and t.is_floating_point() and bool(torch.isfinite(t).all())
            for t in each.values()))  # fmt: skip

    if found is not None and not (isinstance(found, list) and all(kept(each) for each in found)):
        raise ConfigError(
            "mosa.responses: expected null, or for each sequence null or finite tensors `about` (T, N, 3) and "
            "`share` (T, 3 K, 3 K)"
        )


def check_identification(found: Any) -> None:
    """The state of a running stage of Gauss-Newton; None outside of one. Errors: ConfigError."""
    if found is None:
        return
    parts(found, ("iteration", "factors", "noise"), "mosa.identification")
    check({"mosa": {"identification": {name: found.get(name, 0) for name in ("iteration", "factors", "multiple")}}},
          {"mosa.identification.iteration": whole(0), "mosa.identification.multiple": Kind("a number", is_number),
           "mosa.identification.factors": Kind("numbers above 0", lambda v: isinstance(v, list) and all(
               is_number(x) and x > 0 for x in v))})  # fmt: skip
    for name in ("noise", "grid"):
        groups = found.get(name)
        if groups is not None and not (isinstance(groups, list) and all(
            isinstance(each, (list, tuple)) and len(each) == 3 and all(
                isinstance(t, Tensor) and t.is_floating_point() and bool(torch.isfinite(t).all()) for t in each)
            for each in groups)):  # fmt: skip
            raise ConfigError(
                f"mosa.identification.{name}: expected null, or for each rollout three tensors of finite numbers"
            )


def check_retreat(found: Any) -> None:
    """Of a running stage of Adam: halvings of its steps, and the numbers before the last; None where none is kept. Errors:
    ConfigError."""
    if found is None:
        return
    parts(found, ("halvings", "before"), "mosa.retreat")
    check(
        {"mosa": {"retreat": {"halvings": found["halvings"]}}},
        {"mosa.retreat.halvings": whole(0, MOST_HALVINGS)},
    )
    before = found["before"]
    if before is not None and not (isinstance(before, list) and all(
        isinstance(t, Tensor) and t.is_floating_point() and bool(torch.isfinite(t).all()) for t in before)):  # fmt: skip
        raise ConfigError("mosa.retreat.before: expected null, or a list of finite tensors")


def check_resumed(checkpoint: Mapping[str, Any], path: str | Path) -> None:
    """What a fit goes on from is there. Errors: DataError naming what is missing."""
    try:
        parts(checkpoint, (*RESUMED, "state_dict"), "checkpoint")
        check(checkpoint, {"state_dict": Kind("tensors by name", lambda v: isinstance(v, Mapping) and all(
            isinstance(name, str) for name in v))})  # fmt: skip
        saved = checkpoint["mosa"]
        parts(saved, ("stage", "losses", "steps_done", "particles"), "mosa")
        check(
            {"mosa": {name: saved[name] for name in GOING_ON if name in saved}},
            {f"mosa.{name}": kind for name, kind in GOING_ON.items()},
        )
        check_cues(saved.get("cues"))
        check_responses(saved.get("responses"))
        check_identification(saved.get("identification"))
        check_retreat(saved.get("retreat"))
        if (ground := ((saved.get("config") or {}).get("world") or {}).get("ground")) is not None:
            parts(ground, ("height", "mode", "friction"), "mosa.config.world.ground")
            check(
                {"world": {"ground": ground}},
                {key: kind for key, kind in STORED.items() if key.startswith("world.ground.")},
            )
        if saved.get("compared"):
            law = saved["config"]["cfg"]["prior"]["law"] if "config" in saved else None
            if not isinstance(law, str):
                raise ConfigError(
                    f"mosa.config.cfg.prior.law: expected the law that was chosen, found {str(law)[:80]!r}"
                )
            law_named(law)
    except (KeyError, TypeError) as error:
        raise DataError(
            f"ckpt_path: {path}: mosa.config: expected the run's configuration, found none ({error})"
        ) from error
    except ConfigError as error:
        raise DataError(
            f"ckpt_path: {path}: {error}; a fit goes on from a checkpoint that train.py wrote"
        ) from error
