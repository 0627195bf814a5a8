"""Energies per rest volume of all laws that have one, as symbols: what every exported text is generated from.

An energy has two parts: one of the entries of C = F^T F, and one of the principal stretches l_1, l_2, l_3. The same
energies as torch functions are in `tests/helpers/energies.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import sympy as sp
from sympy import Expr, Rational, Symbol, log, sqrt

C11, C22, C33, C23, C13, C12 = ENTRIES = sp.symbols("C11 C22 C33 C23 C13 C12", real=True)
"""Of C, in the order of vech; an entry off the diagonal stands for both."""
STRETCHES = sp.symbols("l1 l2 l3", positive=True)
C = sp.Matrix([[C11, C12, C13], [C12, C22, C23], [C13, C23, C33]])
I1, DET = C.trace(), C.det()
I2 = (I1**2 - (C * C).trace()) / 2
ZERO = sp.Integer(0)
Parts = tuple[Expr, Expr]


class step(sp.Function):  # type: ignore[misc]
    """1 above 0, else 0."""

    def fdiff(self, argindex: int = 1) -> Expr:
        return ZERO


class ramp(sp.Function):  # type: ignore[misc]
    """max(e, 0)."""

    def fdiff(self, argindex: int = 1) -> Expr:
        return step(self.args[0])


@dataclass(frozen=True)
class Energy:
    """names: of the parameters, in the order of the exported texts; entries, stretches: the two parts [J/m^3]."""

    names: tuple[str, ...]
    entries: Expr
    stretches: Expr


def p(name: str) -> Symbol:
    return Symbol(name, real=True)


mu, lam = p("mu"), p("lam")
VOLUMETRIC = (lam + Rational(2, 3) * mu) / 2 * ((DET - 1) / 2 - log(DET) / 2)
J1, J2 = DET ** Rational(-1, 3) * I1, DET ** Rational(-2, 3) * I2  # isochoric invariants of C


def neo_hookean() -> Parts:
    return mu / 2 * (I1 - 3) - mu * log(DET) / 2 + lam / 8 * log(DET) ** 2, ZERO


def corotated() -> Parts:
    return lam / 2 * (sqrt(DET) - 1) ** 2, mu * sum((l - 1) ** 2 for l in STRETCHES)


def stvk() -> Parts:
    return lam / 8 * log(DET) ** 2, mu * sum(log(l) ** 2 for l in STRETCHES)


def mooney_rivlin() -> Parts:
    s = p("second_share")
    return mu / 2 * ((1 - s) * (J1 - 3) + s * (J2 - 3)) + VOLUMETRIC, ZERO


def yeoh() -> Parts:
    x = J1 - 3
    return mu / 2 * (x + p("yeoh_2") * x**2 + p("yeoh_3") * x**3) + VOLUMETRIC, ZERO


def ogden() -> Parts:
    rest, J = mu * (1 - p("share_2")), STRETCHES[0] * STRETCHES[1] * STRETCHES[2]
    shares = rest * (1 - p("share_3")), mu * p("share_2"), rest * p("share_3")
    stored = ZERO
    for k, m in enumerate(shares):
        a = p(f"alpha_{k + 1}")
        stored += 2 * m / a**2 * (J ** (-a / 3) * sum(l**a for l in STRETCHES) - 3)
    return VOLUMETRIC, stored


def family(which: str) -> Expr:
    a = sp.Matrix([p(f"{which}fibre_{k}") for k in (1, 2, 3)])
    k1, k2, d = p(f"{which}fibre_stiffness"), p("fibre_exponent"), p("dispersion")
    e = d * I1 + (1 - 3 * d) * (a.T * C * a)[0] - 1
    return k1 / (2 * k2) * (sp.exp(k2 * ramp(e) ** 2) - 1)


def hgo() -> Parts:
    return mu / 2 * (J1 - 3) + VOLUMETRIC + family(""), ZERO


def hgo_two() -> Parts:
    return mu / 2 * (J1 - 3) + VOLUMETRIC + family("") + family("second_"), ZERO


ENERGIES: dict[str, Callable[[], Parts]] = {
    law.__name__: law
    for law in (neo_hookean, corotated, stvk, mooney_rivlin, yeoh, ogden, hgo, hgo_two)
}
STIFFNESS = tuple(f"g{i}{j}" for i in range(1, 7) for j in range(i, 7))
"""Names of the learned stiffness' 21 numbers: the upper triangle, in Mandel scaling and units of 2 mu."""


def energy(law: str, parameters: tuple[str, ...], learned: bool) -> Energy:
    """Of `law`, whose scalars are `parameters` (a direction is three of them); learned: times `kept`, plus mu E : G : E of Green's
    strain E (`hyperelastic.py`)."""
    entries, stretches = ENERGIES[law]()
    if not learned:
        return Energy(parameters, entries, stretches)
    root = sqrt(2)
    E = [(C11 - 1) / 2, (C22 - 1) / 2, (C33 - 1) / 2, C23 / root, C13 / root, C12 / root]
    stored = ZERO
    for name in STIFFNESS:
        i, j = int(name[1]) - 1, int(name[2]) - 1
        stored += (1 if i == j else 2) * mu * p(name) * E[i] * E[j]
    kept = p("kept")
    return Energy((*parameters, "kept", *STIFFNESS), kept * entries + stored, kept * stretches)
