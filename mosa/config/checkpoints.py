"""A run's checkpoint, read as data: its file may come from a stranger, and is checked before anything is built from it.

What is promised, and what is not, is in docs/safety.md."""

from __future__ import annotations

import importlib
import pickletools
import re
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mosa.config.record import VERSION, BodyRecord, RunRecord
from mosa.errors import ConfigError, DataError, MosaError
from mosa.modules.adapters.registry import adapter_class
from mosa.settings import arguments_of
from mosa.system.limits import machine_memory
from mosa.types import dense

TENSORS = {"rest": (3,), "volume": (), "colors": (3,), "opacities": (), "covariances": (3, 3)}
"""What a body is made of, with the shape for each particle."""
RESUMED = (
    "epoch", "global_step", "pytorch-lightning_version", "loops", "callbacks", "optimizer_states",
    "lr_schedulers",
)  # fmt: skip
"""What Lightning reads where a fit goes on."""
NAMED = {"collections OrderedDict", "torch Size", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter",
         *(f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte",
                                               "Bool"))}  # fmt: skip
"""Functions and classes that a checkpoint of this program refers to; torch knows some more, of which a few make large objects."""
BESIDE = ("ckpt_path", "resume", "optimized_metric", "logger", "callbacks", "trainer", "evaluation",
          "scene.cache", "scene.root", "identification.threads", "extensions")  # fmt: skip
"""Keys of a run that do not say what is learned, or say where things lie on this machine. A capture may have been moved: of
`scene.path` the last part counts."""
UNREADABLE = "not a readable checkpoint"
NODES, DEPTH = 2_000_000, 40  # of a checkpoint's containers: entries, levels
BRIGHTEST = 10.0  # of a colour, which a fit may bring beyond 1
SPACING = 0.02, 5.0  # distance of particles in cells: 1/64 to 50 of them in a cell, with room


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Errors: DataError naming the file, for whatever is wrong with it."""
    try:
        yield
    except MosaError as error:
        raise DataError(f"ckpt_path: {path}: {error}") from error


@contextmanager
def given_as(argument: str) -> Iterator[None]:
    """Errors that name a checkpoint's file by the key `ckpt_path` name it by this argument, which a command has in its place."""
    try:
        yield
    except DataError as error:
        raise DataError(re.sub(r"^ckpt_path\b", argument, str(error))) from error


def read_checkpoint(path: str | Path) -> dict:
    """The checkpoint's dictionary: plain containers and dense tensors, nothing executed. Errors: DataError naming the file."""
    if not isinstance(path, (str, Path)):
        raise DataError(f"ckpt_path: expected the path of a checkpoint, found {path!r}")
    with reading(path):
        try:
            if not Path(path).is_file():
                found = "a folder" if Path(path).is_dir() else "no such file"
                raise DataError(f"{found}; a run writes <run folder>/checkpoints/last.ckpt")
            check_archive(Path(path))
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        except DataError:
            raise
        except Exception as error:  # whatever torch finds: the file is not what its name says
            first = (str(error).splitlines() or [""])[0][:200]
            raise DataError(f"{UNREADABLE} ({type(error).__name__}: {first})") from error
        check_containers(checkpoint)
        if not isinstance(checkpoint, dict) or "mosa" not in checkpoint:
            raise DataError("was not written by this program (no entry 'mosa')")
        saved = checkpoint["mosa"]
        version = saved.get("version") if isinstance(saved, dict) else None
        if version != VERSION or isinstance(version, bool):
            raise DataError(
                f"mosa.version: expected {VERSION}, found {str(version)[:80]!r}: it is of another version of this program, whose "
                "records are not read; learn it again"
            )
    return checkpoint


def check_archive(path: Path) -> None:
    """The archive unpacks to no more than its own size, and its pickle names nothing but tensors. Errors: DataError."""
    if not zipfile.is_zipfile(path):
        raise DataError(f"{UNREADABLE} (expected a zip archive: cut off, or another file?)")
    with zipfile.ZipFile(path) as archive:
        names, unpacked = archive.namelist(), sum(e.file_size for e in archive.infolist())
        if unpacked > min(path.stat().st_size, machine_memory()):
            raise DataError("unpacks to more than its size, or than this machine's memory")
        if len(set(names)) < len(names):
            raise DataError(f"{UNREADABLE} (an entry of its archive is there twice)")
        # torch does not compare the sums: a flipped bit would be another number
        if (damaged := archive.testzip()) is not None:
            raise DataError(f"damaged: its part {damaged} is not what was written (another sum)")
        for entry in (name for name in names if name.endswith(".pkl")):
            for code, named, _ in pickletools.genops(archive.read(entry)):
                # STACK_GLOBAL names nothing here, and is not written
                if "GLOBAL" in code.name and named not in NAMED:
                    raise DataError(
                        f"refers to {named or 'a function or class'}, not only to tensors and "
                        "plain values"
                    )


def check_plain(where: str, value: Any) -> None:
    """What is to be saved can be read again as data. Errors: ConfigError naming the part."""
    if type(value) in (dict, OrderedDict, list, tuple):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            check_plain(f"{where}.{key}".strip("."), part)
    elif type(value) not in (str, int, float, bool, type(None)) and not isinstance(value, Tensor):
        raise ConfigError(
            f"{where}: expected numbers, texts, lists, dictionaries and tensors, which a checkpoint can be read with, found "
            f"{type(value).__name__} (docs/safety.md): give state_dict() plain values"
        )


def check_containers(checkpoint: Any) -> None:
    """Plain values in a bounded tree, whole tensors, no interpolation. Errors: DataError."""
    left, waiting = NODES, [(checkpoint, 0, "")]
    while waiting:
        value, depth, where = waiting.pop()
        left -= 1
        if left < 0 or depth > DEPTH:
            raise DataError(
                f"{where}: expected at most {NODES} entries in {DEPTH} levels, found more"
            )
        if isinstance(value, Mapping):
            if bad := [key for key in value if not isinstance(key, (str, int))]:
                raise DataError(f"{where}: expected names, found {bad[0]!r}")
            waiting += [(v, depth + 1, f"{where}.{k}".strip(".")) for k, v in value.items()]
        elif isinstance(value, (list, tuple)):
            waiting += [(v, depth + 1, where) for v in value]
        elif isinstance(value, Tensor):
            whole = dense(value) and value.device.type == "cpu"
            if not whole or value.numel() * value.element_size() > value.untyped_storage().nbytes():
                found = tuple(value.shape)
                raise DataError(
                    f"{where}: expected a dense tensor of as many numbers as are stored, found "
                    f"{found}"
                )
        elif not isinstance(value, (str, int, float, type(None))):
            kind = type(value).__name__
            raise DataError(f"{where}: expected numbers, texts and tensors, found {kind}")
        elif where.startswith("mosa.settings") and ("${" in str(value) or "\0" in str(value)):
            found = value[:80]
            raise DataError(
                f"{where}: expected a value, found {found!r}: interpolations are not resolved"
            )


def record_of(checkpoint: Mapping[str, Any], path: str | Path) -> RunRecord:
    """The record in a read checkpoint; its settings of the body are checked with it. Errors: DataError naming file and part."""
    with reading(f"{path}: stored record"):
        try:
            record = RunRecord.read(checkpoint["mosa"])
            keys = record.sections.adapter.plain()
            if (build := adapter_class(keys)) is not None:
                del keys["name"]
                arguments_of(build, "adapter").read(keys, "adapter")
        except ConfigError as error:
            if "unknown key" not in str(error):
                raise
            version = importlib.import_module("mosa").__version__  # beside all layers
            raise DataError(
                f"{error}: expected the settings of this version of mosa, {version}, found those "
                "of another one; learn it again, or use the version that wrote it"
            ) from error
    return record


def checked(checkpoint: Mapping[str, Any], path: str | Path) -> tuple[RunRecord, dict[str, Tensor]]:
    """(record, tensors of the body) of a read checkpoint. Errors: DataError naming file and part."""
    record, state = record_of(checkpoint, path), checkpoint.get("state_dict")
    with reading(path):
        if not isinstance(state, Mapping):
            raise DataError("expected the part state_dict, found none")
        tensors = body_tensors(state)
        check_tensors(tensors)
        check_spacing(record, tensors)
    return record, tensors


def body_tensors(state: Mapping[str, Any]) -> dict[str, Any]:
    """Of a module's state, by their names in the body."""
    own = (k for k in state if isinstance(k, str) and k.startswith("body."))
    return {k.removeprefix("body."): state[k] for k in own}


def check_numbers(record: RunRecord, count: int, path: str | Path) -> None:
    """The posterior, where there is one, is of a body with so many learned numbers. Errors: DataError."""
    found = None if record.posterior is None else len(record.posterior.names)
    if found not in (None, count):
        raise DataError(
            f"ckpt_path: {path}: mosa.posterior.names: expected {count} names, found {found}"
        )


def check_tensors(tensors: Mapping[str, Any]) -> None:
    """Shapes, types and numbers of a body's tensors. Errors: DataError naming the tensor."""
    if missing := [name for name in TENSORS if not isinstance(tensors.get(name), Tensor)]:
        raise DataError(f"expected the tensors {', '.join(TENSORS)}, found no {', '.join(missing)}")
    count = len(tensors["rest"]) if tensors["rest"].ndim else 0
    for name, each in TENSORS.items():
        found = tensors[name]
        known = found.dtype in (torch.float32, torch.float64)
        if tuple(found.shape) != (count, *each) or count == 0 or not known:
            wanted = ", ".join(("N", *map(str, each)))
            raise DataError(
                f"body.{name}: expected floating point numbers of shape ({wanted}), N particles, "
                f"found {found.dtype} {tuple(found.shape)}"
            )
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise DataError(f"body.{name}: expected a tensor, found {type(value).__name__}")
        # an adapter that was not switched on yet has no unit
        unset = name.startswith("adapter.") and value.ndim == 0
        if value.is_floating_point() and not unset and not bool(torch.isfinite(value).all()):
            raise DataError(f"body.{name}: expected finite numbers")
    rest, volume, colors, opacities, covariances = (tensors[name].detach() for name in TENSORS)
    low, high, most = (float(v) for v in (opacities.min(), opacities.max(), colors.abs().max()))
    if not 0 <= low <= high <= 1 or most > BRIGHTEST:
        raise DataError(
            "body.opacities, body.colors: expected opacities from 0 to 1 and colours within "
            f"{BRIGHTEST:g}, found {low:g} to {high:g} and {most:g}"
        )
    widths = torch.linalg.eigvalsh(covariances.double())
    low, high = float(widths.min()), float(widths.max())
    size = float((rest.amax(0) - rest.amin(0)).max())
    uneven = float((covariances - covariances.mT).abs().max())
    if uneven > 1e-3 * float(covariances.abs().max()) or low < -1e-3 * high or high > size**2:
        raise DataError(
            "body.covariances: expected symmetric, positive ones of particles smaller than the "
            f"body of {size:.3g} m, found squared widths of {low:.3g} to {high:.3g} m^2"
        )
    if not float(volume.min()) > 0:
        raise DataError(f"body.volume: expected volumes above 0 m^3, found {float(volume.min()):g}")


def check_spacing(record: BodyRecord, tensors: Mapping[str, Tensor]) -> None:
    """Particles as far apart as the cells of their grid are wide. Errors: DataError."""
    share = float(tensors["volume"].double().mean()) ** (1 / 3) / record.dx
    if not SPACING[0] < share < SPACING[1]:
        raise DataError(
            f"body.volume: expected particles {SPACING[0]:g} to {SPACING[1]:g} cells of dx = {record.dx:g} m apart, found "
            f"{share:.3g}"
        )


def check_kinds(found: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> None:
    """Numbers where numbers are wanted: copying would turn flags and whole numbers into them. Errors: DataError."""
    for name, value in wanted.items():
        if name in found and found[name].dtype != value.dtype and not (
            {found[name].dtype, value.dtype} <= {torch.float32, torch.float64}):  # fmt: skip
            raise DataError(f"body.{name}: expected {value.dtype}, found {found[name].dtype}")


def check_same(
    checkpoint: Mapping[str, Any], module: torch.nn.Module, path: str | Path
) -> RunRecord:
    """The record of a checkpoint, which is of this very model. Errors: DataError naming the first part that is not."""
    record = record_of(checkpoint, path)
    assert record.fit is not None, "check_resumed comes before"
    here, there = module.state_dict(), checkpoint["state_dict"]
    other = "the checkpoint belongs to another"
    with reading(path):
        if record.fit.particles != (count := len(here["body.rest"])):
            raise DataError(
                f"expected a body of {count} particles, found {record.fit.particles}: {other} scene, reconstruction or "
                "simulation.particles"
            )
        for name in sorted(set(here) | set(there)):
            wanted, found = kind_of(here.get(name)), kind_of(there.get(name))
            if wanted != found:
                raise DataError(
                    f"{name}: expected {wanted or 'nothing of that name'}, found {found}: {other} configuration (adapter, prior, "
                    "heterogeneity)"
                )
        check_tensors(body_tensors(there))
        if record.fit.stage > (most := len(module.stages)):
            raise DataError(
                f"mosa.fit.stage: expected at most {most}, the stages of this fit, found {record.fit.stage}: {other} "
                "configuration (fit)"
            )
    return record


def kind_of(value: Any) -> str | None:
    """Shape of a tensor, and whether it has floating point numbers; None of anything else."""
    if not isinstance(value, Tensor):
        return None
    return (
        f"{tuple(value.shape)}{'' if value.is_floating_point() else ' of whole numbers or flags'}"
    )


def check_same_run(record: RunRecord, values: Mapping[str, Any], folder: str | Path) -> None:
    """The checkpoint in a run's folder is of the configuration that resume=auto is to go on with: figures and steps of another one
    would else pass for this one's. Keys that only one of both has are of another version. Errors: ConfigError naming the keys."""
    if found := list(differing(record.settings, values, BESIDE)):
        raise ConfigError(
            f"resume: expected in {folder} a run of this configuration, found another one's ({listed(found)}); give "
            "this run a folder of its own, begin anew in this one with resume=null, or go on from its checkpoint "
            "with ckpt_path="
        )


def check_same_scene(record: BodyRecord, values: Mapping[str, Any], path: str | Path) -> None:
    """The checkpoint that ckpt_path names was fitted to the data that the fit is to go on with: a body of as many particles would
    take another's law for its own. Other keys may differ. Errors: ConfigError naming those that must not."""
    if found := other_scene(record.settings, values):
        raise ConfigError(
            f"ckpt_path: expected in {path} a fit to this scene, found one to another or of other particles "
            f"({listed(found)}); a law is taken to another object with python eval.py or python -m mosa.splats"
        )


def other_scene(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """The keys of the scene and of the particles that differ, as `differing` has them."""
    scenes = (each.get("scene") or {} for each in (one, other))
    sizes = [
        {k: v for k, v in (each.get("simulation") or {}).items() if k in ("particles", "dx")}
        for each in (one, other)
    ]
    return [
        *differing(*scenes, (*BESIDE, "scene.test"), "scene"),
        *differing(*sizes, where="simulation"),
    ]


def check_same_data(record: RunRecord, here: Mapping[str, str], path: str | Path) -> None:
    """Films are those of the run by their bytes, whatever their paths; one that either does not say is passed over. here:
    fingerprints by sequence. Errors: DataError naming the sequences."""
    if other := [name for name, bytes_ in here.items() if record.data.get(name, bytes_) != bytes_]:
        raise DataError(
            f"ckpt_path: {path}: expected the films that the run was fitted to, found other images, masks, cameras or times "
            f"below the same path ({', '.join(other)}): put those back (scene.root=, scene.path=), fit anew, or evaluate on "
            "these as another scene with python eval.py scene=<option>"
        )


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


def check_resumed(checkpoint: Mapping[str, Any], path: str | Path) -> RunRecord:
    """The record of a checkpoint that has all that a fit goes on from. Errors: DataError naming what is missing."""
    again, wanted = (
        "; a fit goes on from a checkpoint that train.py wrote",
        (*RESUMED, "state_dict"),
    )
    with reading(path):
        if missing := [name for name in wanted if name not in checkpoint]:
            raise DataError(
                f"checkpoint: expected the parts {', '.join(wanted)}, found none called {', '.join(missing)}{again}"
            )
        state = checkpoint["state_dict"]
        if not (isinstance(state, Mapping) and all(isinstance(name, str) for name in state)):
            raise DataError(f"state_dict: expected tensors by name{again}")
    record = record_of(checkpoint, path)
    with reading(path):
        if record.ground_is_sought:
            raise DataError(
                f"mosa.ground.mode: expected sticky or slip or separate or touch, found 'auto'{again}"
            )
        if record.fit is None:
            raise DataError(f"mosa.fit: expected this key, found none{again}")
    return record
