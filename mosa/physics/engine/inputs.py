"""What a user gives a simulator, checked and in the order and types of the kernels."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import SLOTS, Law
from mosa.physics.contact.colliders import Collider
from mosa.physics.contact.motion import Motion, Trajectory
from mosa.physics.engine.numerics import Numerics, State
from mosa.settings import shown
from mosa.types import ParticleState, dense

UNBOUNDED = 1e30
FASTEST = 1e6
"""[m/s], [rad/s] of a start: the time step would be refused far below."""


MODULI = {"mu": "mu >= 0", "lam": "lam + 2 mu/3 >= 0", "kappa": "kappa >= 0"}
"""Without which a body at rest is unstable."""


def numbers(
    name: str, value: Any, expected: str, *shapes: tuple[int, ...], dtype: torch.dtype | None = None,
    most: float = sys.float_info.max,
) -> Tensor:  # fmt: skip
    """Tensor of finite numbers within `most`, of one of the shapes, if any; of a type, by default float64 where they are given so,
    else float32. Errors: ConfigError naming the argument."""
    try:
        if type(value) not in (int, float) or not abs(value) <= most:  # most are: 20 us less
            found = torch.as_tensor(value)
            odd = found.dtype == torch.bool or found.is_complex()
            if odd or not bool((found.detach().double().abs() <= most).all()):
                raise ValueError
            dtype = dtype or (torch.float64 if found.dtype == torch.float64 else torch.float32)
        result = torch.as_tensor(value, dtype=dtype or torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise ConfigError(f"{name}: expected {expected}, found {str(value)[:120]}") from None
    if shapes and tuple(result.shape) not in shapes:
        raise ConfigError(f"{name}: expected {expected}, found shape {tuple(result.shape)}")
    return result


def vector(name: str, value: Sequence[float] | Tensor) -> Tensor:
    """(3,) tensor. Errors: ConfigError naming the argument."""
    return numbers(name, value, f"three finite numbers within {FASTEST:g}", (3,), most=FASTEST)


def pack_parameters(
    law: Law, parameters: dict[str, Tensor], shape: tuple[int, ...], like: Tensor, *, rotation: Tensor | None = None,
    yield_factor: float = 1.0,
) -> Tensor:  # fmt: skip
    """(N, SLOTS) parameters in the law's order, of particles of `shape`, (N,) or (W, N) of W worlds; type and device as `like`. See
    `Simulator.pack`. yield_factor: on the yield stress of von Mises. Errors: ConfigError naming a parameter."""
    *worlds, particles = shape
    expected = [name for name in law.parameters if name != law.reference]
    if missing := [name for name in expected if name not in parameters]:
        raise ConfigError(
            f"law {law.name!r} needs {', '.join(expected)}; missing: {', '.join(missing)}"
        )
    if unknown := [name for name in parameters if name not in expected]:
        raise ConfigError(
            f"law {law.name!r} takes {', '.join(expected)}; unknown: {', '.join(unknown)}"
        )
    columns = []
    for name, size in law.parameters.items():
        if name == law.reference:
            columns.append(rotation.detach().reshape(*shape, 9))
            continue
        value = parameters[name]
        if not isinstance(value, Tensor):  # a copy from the host would wait for CUDA
            value = numbers(f"parameters.{name}", value, "finite numbers", dtype=like.dtype)
            value = value if value.ndim else like.new_full((), float(value))
        elif not dense(value):
            raise ConfigError(f"parameters.{name}: expected a dense tensor, found {shown(value)}")
        value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
        if name == "yield_stress" and "von_mises" in law.name.split("+"):
            value = value * yield_factor  # the other laws that yield have their radius fixed
        try:
            columns.append((value[..., None] if size == 1 else value).expand(*shape, size))
        except RuntimeError:
            last = f", {size}" * (size > 1)
            each = f", ({worlds[0]}, 1{last}) or ({worlds[0]}, {particles}{last})" if worlds else ""
            raise ConfigError(
                f"parameter {name!r}: expected shape {'()' if size == 1 else f'({size},)'} or ({particles}"
                f"{last or ','}){each}, found {tuple(value.shape)}"
            ) from None
    columns.append(like.new_zeros(*shape, SLOTS - sum(law.parameters.values())))
    return torch.cat(columns, -1).flatten(0, -2)


def check_state(numerics: Numerics, state: ParticleState, volume: Tensor) -> None:
    """Errors: ConfigError naming what has another shape, type or device; x may be float64 in any case."""
    *worlds, n = state.x.shape[:-1]
    if not n:
        raise ConfigError("x: expected one particle at least, found none")
    point, matrix = (*worlds, n, 3), (*worlds, n, 3, 3)
    shapes = {name: point if name in ("x", "v") else matrix for name in State._fields}
    values = {name: (getattr(state, name), shape) for name, shape in shapes.items()} | {
        "volume": (volume, (n,))
    }
    for name, (value, shape) in values.items():
        known = value.dtype == numerics.dtype or (name == "x" and value.dtype == torch.float64)
        if tuple(value.shape) != shape or not known or value.device.type != numerics.device.type:
            raise ConfigError(
                f"{name}: expected shape {shape} of {numerics.dtype} on {numerics.device}, found {tuple(value.shape)} of "
                f"{value.dtype} on {value.device}"
            )


def check_above(planes: np.ndarray, bounds: np.ndarray, x: Tensor) -> None:
    """planes: (P, 4) normals and offsets; bounds: (..., 6) `extent` of x (..., N, 3), all in one frame. Errors: ConfigError for a
    body that lies wholly behind the ground or another plane, which would hold it for ever."""
    normals, offsets = planes[:, None, :3], planes[:, 3, None]
    boxes = bounds.reshape(-1, 6)
    highest = np.maximum(normals * boxes[:, :3], normals * boxes[:, 3:]).sum(-1) - offsets
    askew = np.abs(normals[:, 0]).max(-1) < 1  # there a box reaches farther than the body in it
    if askew.any():
        there = x.detach() @ torch.from_numpy(normals[askew, 0]).to(x).T
        highest[askew] = there.amax(-2).reshape(len(boxes), -1).T.cpu().numpy() - offsets[askew]
    if (highest < 0).any():
        raise ConfigError(
            "x: expected a body above the ground and in front of the other planes, found all of it "
            f"{-float(highest.min()):.3g} m or more behind one"
        )


def checked_density(
    density: float | Tensor, volume: Tensor, law: Law, packed: Tensor, worlds: int | None = None
) -> tuple[float | Tensor, float]:
    """(density, mean mass of a particle [kg]), also checks the volumes and the moduli among the
    packed parameters (N, SLOTS): one look at the host for all. worlds: how many may have their own.

    A number stays one: arithmetic, and so every bit, is that of a body of one material. Errors: ConfigError."""
    if isinstance(density, Tensor):
        density = without_gradients("density", density)
    if not isinstance(density, Tensor) or density.ndim == 0:
        expected = "a positive number [kg/m^3], or one for each particle as a tensor"
        density = float(numbers("density", density, expected, (), dtype=torch.float64))
        if not density > 0:
            raise ConfigError(f"density: expected {expected}, found {density}")
        ends: tuple[Tensor, ...] = tuple(torch.aminmax(volume))
    else:
        shapes = [tuple(volume.shape)] + ([(worlds, *volume.shape)] if worlds else [])
        if density.shape not in shapes or not dense(density):
            said = " or ".join(map(str, shapes))
            raise ConfigError(f"density: expected a number or shape {said}, found {shown(density)}")
        density = density.to(volume)
        ends = (*torch.aminmax(volume), *torch.aminmax(density))
    names = [name for name in law.offsets if name in MODULI]
    # columns from the first modulus to the last: a list of them is copied to a CUDA device, which waits for it
    first = min((law.offsets[name] for name in names), default=0)
    span = packed.detach()[:, first : max((law.offsets[name] + 1 for name in names), default=0)]
    masses = density * volume
    told = torch.cat([torch.stack([*ends, masses.mean()]).to(span), span.amin(0)]).tolist()
    found, mass, least = told[: len(ends)], told[len(ends)], told[len(ends) + 1 :]
    if any(math.isnan(each) for each in least):  # of another law of a mixture
        least = span.nan_to_num().amin(0).tolist()
    own = {name: least[law.offsets[name] - first] for name in names}
    if not (found[0] > 0 and found[1] < math.inf):
        raise ConfigError("volume: expected positive, finite numbers [m^3] for all particles")
    if found[2:] and not (found[2] > 0 and found[3] < math.inf):
        raise ConfigError("density: expected positive numbers [kg/m^3] for all particles")
    if own.get("lam", 0) < 0 and "mu" in names:  # seldom
        mu, lam = (span[:, law.offsets[name] - first].nan_to_num() for name in ("mu", "lam"))
        own["lam"] = float((lam + 2 / 3 * mu).min())
    for name, value in own.items():
        if value < 0:
            raise ConfigError(
                f"parameters.{name}: expected {MODULI[name]} for all particles, found {value:g}"
            )
    return density, mass


def count_of_worlds(state: ParticleState, together: int | None) -> int:
    """Errors: ConfigError."""
    if state.x.ndim != 3:
        raise ConfigError(f"x: expected shape (worlds, particles, 3), found {tuple(state.x.shape)}")
    worlds = len(state.x)
    if together is not None and (together < 1 or worlds % together):
        raise ConfigError(f"together: expected a divisor of the {worlds} worlds, found {together}")
    return worlds


def without_gradients(name: str, value: Tensor) -> Tensor:
    """What no motion has gradients with respect to. Errors: ConfigError where they are wanted."""
    if torch.is_grad_enabled() and value.requires_grad:
        raise ConfigError(
            f"{name}: expected no gradients, which do not reach it: pass its detach()"
        )
    return value.detach()


def gravity_of_worlds(
    gravity: Tensor | Sequence | None, worlds: int, common: tuple[float, float, float]
) -> tuple[tuple[float, float, float], ...]:
    """common: where none is given. Errors: ConfigError."""
    if gravity is None:
        return (common,) * worlds
    shape = (worlds, 3)
    gravity = numbers("gravity", gravity, f"finite numbers {shape}", shape, dtype=torch.float64)
    return tuple(map(tuple, without_gradients("gravity", gravity).tolist()))


def motions_of_worlds(
    motions: Sequence | None, colliders: Sequence[Collider], worlds: int | None
) -> list[Sequence[Motion | Trajectory]]:
    """Of the colliders in every world: those of one for all, by default their own, or a sequence for each. Errors: ConfigError."""
    motions = [collider.motion for collider in colliders] if motions is None else motions
    if worlds is None or not any(isinstance(own, Sequence) for own in motions):
        motions = [motions] * (worlds or 1)
    elif len(motions) != worlds:
        raise ConfigError(
            f"motions: expected {worlds} sequences, one a world, found {len(motions)}"
        )
    for own in motions:
        if len(own) != len(colliders):
            raise ConfigError(
                f"motions: expected one for each of {len(colliders)} colliders, found {len(own)}"
            )
    return list(motions)


def corners(box: Tensor | None, margin: float = 0.0) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(low, high) [m] of the domain (2, 3) that particles may not leave by more than `margin` [m], far away where there is none.
    Errors: ConfigError."""
    if box is None:
        return (-UNBOUNDED,) * 3, (UNBOUNDED,) * 3
    expected = "two corners (2, 3) [m], min < max on every axis"
    box = numbers("box", box, expected, (2, 3), dtype=torch.float64)
    low, high = map(tuple, box.tolist())
    if not all(a < b for a, b in zip(low, high)):
        raise ConfigError(f"box: expected {expected}, found {low} and {high}")
    return tuple(a - margin for a in low), tuple(b + margin for b in high)


def polar_rotation(F: Tensor) -> Tensor:
    """Polar rotation of F (N, 3, 3), without gradient."""
    U, S, Vh = torch.linalg.svd(F.detach().double())
    sign = torch.ones_like(S)
    sign[..., 2] = torch.linalg.det(U @ Vh)
    return ((U * sign[..., None, :]) @ Vh).to(F.dtype)
