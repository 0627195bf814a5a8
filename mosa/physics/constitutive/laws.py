"""Registry of constitutive laws: a law is one Warp function for the stress and, where it yields, one for the return mapping.

Elastic laws are in `elasticity`, yielding ones in `plasticity`, those that flow at a rate in `viscosity`, bodies of different laws
in one grid in `mixture`; the package imports these, and they register themselves. Another module adds its own with `register_law`.
"""

import ast
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError

SLOTS = 12
"""Numbers a law can take per particle."""

LawParameters = wp.types.vector(length=SLOTS, dtype=wp.float64)


@dataclass(frozen=True)
class Law:
    """A constitutive law.

    stress: `wp.func (F: mat33d, R: mat33d, C_affine: mat33d, p: LawParameters) -> mat33d`, the Kirchhoff stress [Pa]. R is the
    polar rotation of F with its differential if `uses_rotation`, else unspecified; everything is float64.
    parameters: name -> how many numbers (1 for a scalar, 3 for a vector, ...); p holds them in this order.
    return_map: `wp.func (F, before, C_affine, R, U, S, V, H, n2, norm_eps, p, dt) -> (F, yielded: int)` or None, see
    `plasticity`.
    reference: name of a 9-number parameter that the simulator fills with the rotation of the start's F, or None.
    needs_positive_J: the law has no value at det F <= 0, which is then an error.
    modulus: torch function (**parameters) -> P wave modulus M at rest [Pa] for the time step, elementwise; None: lam + 2 mu or
    kappa + 4 mu/3, whichever the parameters give.
    viscosity: torch function (**parameters) -> viscosity mu [Pa s] of a stress mu J sym(C_affine), for the time step, elementwise;
    None: the stress does not take C_affine, or a flow that is integrated implicitly."""

    name: str
    stress: Callable
    parameters: dict[str, int]
    return_map: Callable | None = None
    uses_rotation: bool = False
    reference: str | None = None
    needs_positive_J: bool = False
    modulus: Callable | None = None
    viscosity: Callable | None = None
    offsets: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        offsets, total = {}, 0
        for name, size in self.parameters.items():
            offsets[name] = total
            total += size
        if total > SLOTS:
            raise ConfigError(f"law {self.name!r}: expected at most {SLOTS} numbers, found {total}")
        object.__setattr__(self, "offsets", offsets)

    @property
    def sheared(self) -> bool:
        """Whether mu is a shear modulus: of a fluid it is a viscosity."""
        return "mu" in self.offsets and (self.viscosity is None or self.damped)

    @property
    def moduli_slots(self) -> tuple[int, int, int]:
        """Places of mu, lam and kappa among the parameters, -1 for one there is not, all -1 for a
        fluid: for the mean change of volume. Errors: ConfigError where volume has to be each
        particle's own."""
        if {"law", "friction_alpha"} & set(self.parameters):
            raise ConfigError(
                f"prior.options.mean_volume: expected one law whose yielding does not depend on volume, found {self.name!r} "
                "(a mixture, or friction between grains): leave it out"
            )
        if not self.sheared:
            return -1, -1, -1
        mu, lam, kappa = (self.offsets.get(name, -1) for name in ("mu", "lam", "kappa"))
        return mu, lam, kappa

    @property
    def damped(self) -> bool:
        """Whether the law has a viscous branch (`damping`), whose stress is per rest volume."""
        return "damping" in self.parameters

    @property
    def plastic(self) -> bool:
        """Whether the law has a return mapping, so that F and F_tot differ."""
        return self.return_map is not None

    @property
    def elastic(self) -> bool:
        """Whether the body returns to its shape at rest: the law neither yields nor flows."""
        return not self.plastic and (self.viscosity is None or self.damped)

    def wave_modulus(self, parameters: dict[str, Tensor]) -> Tensor:
        """P wave modulus M at rest [Pa], of the parameters' shape. Errors: ConfigError if it does not follow from them."""
        if self.modulus is not None:
            return self.modulus(**parameters)
        if "mu" in parameters and "lam" in parameters:
            return parameters["lam"] + 2 * parameters["mu"]
        if "mu" in parameters and "kappa" in parameters:
            return parameters["kappa"] + 4 * parameters["mu"] / 3
        raise ConfigError(
            f"law {self.name!r}: expected parameters mu and lam, or mu and kappa, found {', '.join(parameters)}; register the "
            "law with `modulus`"
        )

    def explicit_viscosity(self, parameters: dict[str, Tensor]) -> Tensor:
        """Viscosity [Pa s] that bounds the time step, of the parameters' shape, 0 where the law has none. Physical values."""
        if self.viscosity is None:
            return torch.as_tensor(next(iter(parameters.values()))).new_zeros(())
        return self.viscosity(**parameters)


_LAWS: dict[str, Law] = {}
_COMPOSED: dict[str, Callable[[str, list[Law]], Law]] = {}
"""What makes a law of several whose names are joined by a sign, by that sign."""


def register_composition(sign: str, make: Callable[[str, list[Law]], Law]) -> None:
    """make(name, laws) registers the law called `a<sign>b<sign>...`."""
    _COMPOSED[sign] = make


def register_law(
    name: str, stress: Callable, parameters: dict[str, int] | tuple[str, ...], **options
) -> Law:
    """Make a law known to `Simulator` by `name`; see `Law` for the arguments. Registering the same functions again is a no-op.

    Example: a fibre family a (rest direction), tau = mu (F F^T - I) + lam log(J) I + 2 kf (I4 - 1) (F a)(F a)^T, takes
    `parameters={"mu": 1, "lam": 1, "kf": 1, "a": 3}` and reads `wp.vec3d(p[3], p[4], p[5])`.
    Errors: ConfigError if `name` is taken by another law, or if the stress reads what it is not registered with."""
    if not isinstance(parameters, dict):
        parameters = dict.fromkeys(parameters, 1)
    law = Law(name, stress, dict(parameters), **options)
    check_reads(law)
    known = _LAWS.get(name)
    if known is not None and known != law:
        raise ConfigError(
            f"law {name!r} is registered already with other functions or parameters; choose another name"
        )
    _LAWS[name] = law
    return law


def reads(function: wp.Function, place: int) -> bool:
    """Whether a wp.func reads its argument at this place, or hands it on to one that does."""
    source, nodes = vars(function)["func"], list(ast.walk(function.adj.tree))
    name, scope = list(inspect.signature(source).parameters)[place], inspect.getclosurevars(source)
    known = {**scope.globals, **scope.nonlocals}

    def named(node: ast.AST) -> Any:
        if isinstance(node, ast.Attribute):
            return getattr(named(node.value), node.attr, None)
        return known.get(node.id) if isinstance(node, ast.Name) else None

    loaded = [n for n in nodes if isinstance(n, ast.Name) and n.id == name and isinstance(n.ctx, ast.Load)]  # fmt: skip
    calls = [(named(n.func), n.args) for n in nodes if isinstance(n, ast.Call)]
    handed = [(to, k) for to, given in calls if getattr(to, "adj", None) is not None
              for k, each in enumerate(given) if each in loaded]  # fmt: skip
    return len(loaded) > len(handed) or any(reads(*each) for each in handed)


def check_reads(law: Law) -> None:
    """A law says what its stress reads: R is F otherwise, and no time step allows for a viscosity. Errors: ConfigError."""
    if not isinstance(law.stress, wp.Function):
        raise ConfigError(f"law {law.name!r}: expected a wp.func of its stress, found {law.stress}")
    told = law.uses_rotation, law.viscosity is not None or law.plastic
    keys = "uses_rotation=True", "viscosity, a function of its parameters"
    for place, known, key in zip((1, 2), told, keys):
        if not known and reads(law.stress, place):
            argument = "R" if place == 1 else "C_affine"
            raise ConfigError(
                f"law {law.name!r}: expected register_law with {key}, as its stress reads {argument}, found none"
            )


def law_named(name: str) -> Law:
    """The law of that name; `a+b` is the mixture of the laws a and b (see `mixture`), `a~damped`
    the law a with a viscous branch (see `damping`). Errors: ConfigError naming the known ones."""
    for sign, make in _COMPOSED.items():
        if sign in name and name not in _LAWS:
            make(name, [law_named(part) for part in name.split(sign) if part])
    if name not in _LAWS:
        raise ConfigError(
            f"law: expected one of {', '.join(law_names())}, found {name!r}; one of another package is known once "
            "that is imported (extensions)"
        )
    return _LAWS[name]


def law_names() -> list[str]:
    """Names of all registered laws, without those that are composed of them."""
    return sorted(name for name in _LAWS if not any(sign in name for sign in _COMPOSED))
