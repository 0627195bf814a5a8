"""Bodies of different laws in one grid: a law `a+b+...` whose particles each follow one of the laws a, b, ...

A mixture is a law like any other, so rollouts, gradients, adapters and checkpoints know nothing of it. Its parameters are those of
all its laws by name, shared where names agree, and `law`: the particle's place in the list, 0, 1, ... What a particle's own law
does not take is not read, whatever its value.
"""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change, and results are unpacked whole)

from collections.abc import Callable, Sequence

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import (
    SLOTS,
    Law,
    LawParameters,
    register_composition,
    register_law,
)

INDEX = "law"
"""Name of the parameter that says which law a particle follows."""


def register_mixture(name: str, laws: Sequence[Law]) -> Law:
    """The mixture of `laws`, registered as `name`. Errors: ConfigError if names clash in size or need more than 12 numbers."""
    parameters: dict[str, int] = {}
    for law in laws:
        for key, size in law.parameters.items():
            if parameters.setdefault(key, size) != size:
                raise ConfigError(
                    f"law {name!r}: parameter {key} has {parameters[key]} numbers in one law and {size} in another"
                )
    parameters[INDEX] = 1
    slot = sum(parameters.values()) - 1
    references = {law.reference for law in laws} - {None}
    if len(references) > 1:
        raise ConfigError(
            f"law {name!r}: expected one name for the start's rotation, found {', '.join(sorted(references))}"
        )
    gathers = [_gather(law, parameters) for law in laws]
    stress, mapping = _stress(laws[-1].stress, gathers[-1]), None
    for i in reversed(range(len(laws) - 1)):
        stress = _chosen_stress(_stress(laws[i].stress, gathers[i]), stress, slot, i)
    if any(law.plastic for law in laws):
        mapping = _mapping(laws[-1].return_map or _unmapped, gathers[-1])
        for i in reversed(range(len(laws) - 1)):
            mapping = _chosen_mapping(
                _mapping(laws[i].return_map or _unmapped, gathers[i]), mapping, slot, i
            )
    return register_law(
        name, stress, parameters, return_map=mapping, uses_rotation=any(law.uses_rotation for law in laws),
        reference=next(iter(references), None), needs_positive_J=any(law.needs_positive_J for law in laws),
        modulus=_by_law(laws, Law.wave_modulus), viscosity=_by_law(laws, Law.explicit_viscosity),
    )  # fmt: skip


def _by_law(laws: Sequence[Law], quantity: Callable) -> Callable:
    """quantity (law, its parameters) of each particle's own law, as a function of the mixture's parameters."""

    def chosen(**parameters: Tensor) -> Tensor:
        index = torch.as_tensor(parameters[INDEX])
        taken = [{k: parameters[k] for k in law.parameters if k in parameters} for law in laws]
        parts = [quantity(law, values) for law, values in zip(laws, taken)]
        result = torch.zeros(
            torch.broadcast_shapes(index.shape, *(p.shape for p in parts)), dtype=parts[0].dtype
        )
        result = result.to(parts[0].device)
        for i, part in enumerate(parts):
            result = torch.where(index == i, part, result)
        return result

    return chosen


def _gather(law: Law, parameters: dict[str, int]) -> Callable:
    """Warp function from the mixture's parameters to those of one law, in its own order."""
    starts, total = {}, 0
    for key, size in parameters.items():
        starts[key], total = total, total + size
    places = [starts[key] + k for key, size in law.parameters.items() for k in range(size)]
    # what is left over is read by nobody
    a, b, c, d, e, f, g, h, i, j, k, m = places + [SLOTS - 1] * (SLOTS - len(places))

    @wp.func
    def gathered(p: LawParameters):
        return LawParameters(p[a], p[b], p[c], p[d], p[e], p[f], p[g], p[h], p[i], p[j], p[k], p[m])

    return gathered


def _stress(law_stress: Callable, gathered: Callable) -> Callable:
    @wp.func
    def stress(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
        return law_stress(F, R, C_affine, gathered(p))

    return stress


def _chosen_stress(own: Callable, other: Callable, slot: int, number: int) -> Callable:
    @wp.func
    def stress(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
        T = wp.mat33d()
        if int(p[slot]) == number:
            T = own(F, R, C_affine, p)
        else:
            T = other(F, R, C_affine, p)
        return T

    return stress


@wp.func
def _unmapped(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d,
              H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters, dt: wp.float64):  # fmt: skip
    # 1: nothing is to be rebuilt for an elastic particle
    yielded = int(1)
    return F, yielded


def _mapping(law_map: Callable, gathered: Callable) -> Callable:
    @wp.func
    def mapping(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d,
                H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters, dt: wp.float64):  # fmt: skip
        A, yielded = law_map(F, before, C_affine, R, U, S, V, H, n2, norm_eps, gathered(p), dt)
        return A, yielded

    return mapping


def _chosen_mapping(own: Callable, other: Callable, slot: int, number: int) -> Callable:
    @wp.func
    def mapping(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d,
                H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters, dt: wp.float64):  # fmt: skip
        A = wp.mat33d()
        yielded = int(0)
        if int(p[slot]) == number:
            A, yielded = own(F, before, C_affine, R, U, S, V, H, n2, norm_eps, p, dt)
        else:
            A, yielded = other(F, before, C_affine, R, U, S, V, H, n2, norm_eps, p, dt)
        return A, yielded

    return mapping


register_composition("+", register_mixture)
