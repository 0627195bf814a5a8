"""Texts of a law in other programs' languages, all generated from one `Energy`."""

from __future__ import annotations

from importlib.resources import files

import sympy as sp
from sympy.printing.fortran import FCodePrinter
from sympy.printing.pycode import PythonCodePrinter

from mosa.export.energies import ENTRIES, STRETCHES, Energy
from mosa.export.source import Source

Assignments = list[tuple[sp.Symbol, sp.Expr]]


def derivatives(
    energy: Energy,
) -> tuple[list[sp.Expr], list[sp.Expr], list[sp.Expr], list[sp.Expr]]:
    """S = 2 dpsi/dC (6) and 2 dS/dC (21, upper triangle row by row) of the part of C's entries, in vech order; of the stretches'
    part s_i = (1/l_i) dpsi/dl_i (3) and (1/l_j) ds_i/dl_j (9)."""
    weights = [2, 2, 2, 1, 1, 1]  # an entry off the diagonal is two of C's
    stress = [w * sp.diff(energy.entries, c) for w, c in zip(weights, ENTRIES)]
    stiff = [weights[j] * sp.diff(stress[i], ENTRIES[j]) for i in range(6) for j in range(i, 6)]
    principal = [sp.diff(energy.stretches, l) / l for l in STRETCHES]
    slopes = [sp.diff(s, l) / l for s in principal for l in STRETCHES]
    return stress, stiff, principal, slopes


class Fortran(FCodePrinter):
    def __init__(self) -> None:
        super().__init__({"source_format": "free", "standard": 95, "precision": 17})

    def _print_ramp(self, expr: sp.Function) -> str:
        return f"max({self._print(expr.args[0])}, 0.0d0)"

    def _print_step(self, expr: sp.Function) -> str:
        return f"merge(1.0d0, 0.0d0, {self._print(expr.args[0])} > 0.0d0)"


class Ufl(PythonCodePrinter):
    """module: what functions belong to; integer, number: how a literal is written."""

    module, logarithm, integer, number = "ufl.", "ln", "{}", "{}"

    def _print_Function(self, expr: sp.Function) -> str:
        name = {"log": self.logarithm, "exp": "exp", "sqrt": "sqrt"}[type(expr).__name__]
        return f"{self.module}{name}({self._print(expr.args[0])})"

    _print_log = _print_exp = _print_Function

    def _print_Integer(self, expr: sp.Integer) -> str:
        return self.integer.format(int(expr))

    def _print_int(self, expr: int) -> str:
        return self.integer.format(expr)

    def _print_Rational(self, expr: sp.Rational) -> str:
        return f"({self.integer.format(expr.p)}/{self.integer.format(expr.q)})"

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        base, exponent = expr.args
        if expr.is_number:
            return self.number.format(repr(float(expr)))
        if exponent == sp.Rational(1, 2):
            return f"{self.module}sqrt({self._print(base)})"
        if exponent == -1:
            return f"({self.integer.format(1)}/({self._print(base)}))"
        if exponent.is_Integer and 2 <= exponent <= 4:
            return "(" + "*".join([f"({self._print(base)})"] * int(exponent)) + ")"
        return self.power(self._print(base), self._print(exponent))

    def power(self, base: str, exponent: str) -> str:
        return f"({base})**({exponent})"

    def _print_ramp(self, expr: sp.Function) -> str:
        part = self._print(expr.args[0])
        return f"ufl.conditional(ufl.gt({part}, 0), {part}, 0)"


class Warp(Ufl):
    module, logarithm, integer, number = "wp.", "log", "wp.float64({}.0)", "wp.float64({})"

    def power(self, base: str, exponent: str) -> str:
        return f"wp.pow({base}, {exponent})"

    def _print_ramp(self, expr: sp.Function) -> str:
        return f"wp.max({self._print(expr.args[0])}, wp.float64(0.0))"

    def _print_step(self, expr: sp.Function) -> str:
        part = self._print(expr.args[0])
        return f"wp.where({part} > wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))"


def reduced(expressions: list[sp.Expr]) -> tuple[Assignments, list[sp.Expr]]:
    """Common subexpressions named w0, w1, ..., and what is left."""
    return sp.cse(expressions, symbols=sp.numbered_symbols("w"), order="none")


def template(name: str) -> str:
    return files("mosa.export").joinpath("templates", name).read_text()


def filled(name: str, found: Source, **parts: str) -> str:
    """A template with `@LAW@`, `@COUNT@` and the given parts put in."""
    text = template(name)
    values = {"law": found.material.law, "count": str(len(found.energy.names))} | parts
    for key, value in values.items():
        text = text.replace(f"@{key.upper()}@", value)
    return text


def umat(found: Source) -> str:
    """Fortran 95, free form: an Abaqus UMAT with its consistent tangent, and a check's entry that C can call."""
    printer = Fortran()
    entries: list[str] = []
    principal: list[str] = []
    stress, stiff, along, slopes = derivatives(found.energy)
    names = [
        "psi",
        *(f"S({k + 1})" for k in range(6)),
        *(f"CC({i + 1},{j + 1})" for i in range(6) for j in range(i, 6)),
    ]
    for into, targets, expressions in (
        (entries, names, [found.energy.entries, *stress, *stiff]),
        (principal, ["psi", *(f"s({k + 1})" for k in range(3)),
                     *(f"ds({i + 1},{j + 1})" for i in range(3) for j in range(3))],
         [found.energy.stretches, *along, *slopes]),
    ):  # fmt: skip
        steps, rest = reduced(expressions)
        into += [f"double precision :: {name}" for name, _ in steps]
        lines = [(str(name), value) for name, value in steps] + list(zip(targets, rest))
        into += [
            line for name, value in lines for line in wrap(f"{name} = {printer.doprint(value)}")
        ]
    props = [f"{name} = props({k + 1})" for k, name in enumerate(found.energy.names)]
    declared = [f"double precision :: {name}" for name in found.energy.names]

    def block(lines: list[str]) -> str:
        first = [line for line in lines if line.startswith("double precision")]
        later = [line for line in lines if not line.startswith("double precision")]
        return "\n  ".join([*declared, *first, *props, *later])

    listed = "\n".join(
        f"!   {k + 1:2d}  {name} = {found.values[name]!r}"
        for k, name in enumerate(found.energy.names)
    )
    spectral = ".true." if found.energy.stretches != 0 else ".false."
    return filled(
        "umat.f90",
        found,
        props=listed,
        entries=block(entries),
        principal=block(principal),
        spectral=spectral,
    )


def wrap(line: str) -> list[str]:
    """Free-form Fortran: at most 132 columns a line, continued by &."""
    flat, pieces = " ".join(line.replace("&\n", " ").replace("&", " ").split()), []
    while len(flat) > 110:
        cut = flat.rfind(" ", 0, 110)
        pieces.append(flat[:cut] + " &")
        flat = flat[cut + 1 :]
    return [*pieces, flat]


def ufl_text(found: Source) -> str:
    """Python for FEniCSx: the energy of F as a UFL expression."""
    printer = Ufl()
    steps, (value,) = reduced([found.energy.entries + found.energy.stretches])
    lines = [f"{name} = {printer.doprint(part)}" for name, part in [*steps, ("psi", value)]]
    return filled("law_ufl.txt", found, values=named(found), names=unpacked(found), lines="\n    ".join(lines), stretched=(
        "l1, l2, l3 = stretches(C)" if found.energy.stretches != 0 else "# no principal stretches"))  # fmt: skip


def warp_text(found: Source) -> str:
    """Python for Warp: the Kirchhoff stress of F in float64 as a function of a kernel."""
    printer = Warp()
    stress, _, along, _ = derivatives(found.energy)
    steps, rest = reduced([*stress, *along])
    names = ["S11", "S22", "S33", "S23", "S13", "S12", "s1", "s2", "s3"]
    lines = [f"{name} = {printer.doprint(part)}" for name, part in [*steps, *zip(names, rest)]]
    constants = "\n".join(
        f"{n} = wp.constant(wp.float64({found.values[n]!r}))" for n in found.energy.names
    )
    return filled("law_warp.txt", found, constants=constants, lines="\n    ".join(lines))


def named(found: Source) -> str:
    return "\n".join(f'    "{name}": {found.values[name]!r},' for name in found.energy.names)


def unpacked(found: Source) -> str:
    return "\n    ".join(f'{name} = parameters["{name}"]' for name in found.energy.names)
