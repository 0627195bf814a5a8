"""Measures the checks of docs/verification.md, writes their table (docs/results/verification.md) and plots.

    OMP_NUM_THREADS=1 MOSA_DATA=... python benchmarks/verification.py [--only bar,gradient] [--bar-cells 30]

The measurements are those of the tests in tests/physics_verification, here with their figures instead of a verdict. Results are
kept in outputs/verification.json, so that `--only` renews some rows and leaves the others. About ten CPU-minutes, of which the
bar at 30 cells per metre is most; without MOSA_DATA what needs reference data is left out.
"""

# ruff: noqa: E402
# (the measurements live with the tests, whose folder has to be found first)

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import re
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / "physics_verification"), str(ROOT / "tests" / "helpers")]

import bar as bars
import closed_systems
import elastic_bodies
import incline
import invariance
import lagrangian
import stresses
import unit_figures as units
from bodies import DENSITY, ELASTIC, LAWS, PRECISIONS, E, is_fluid
from energies import ENERGIES
from gradients import Case

IMAGES = ROOT / "docs" / "images"
SINGLE, DOUBLE = PRECISIONS
SOLIDS = [law for law in LAWS if not is_fluid(law)]
LABEL = {SINGLE: "float32", DOUBLE: "float64"}


def save(name: str, axes_list) -> None:
    for axes in axes_list:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure = axes_list[0].figure
    figure.tight_layout()
    IMAGES.mkdir(parents=True, exist_ok=True)
    figure.savefig(IMAGES / f"verification_{name}.png", dpi=80)
    plt.close(figure)


def panels(count: int = 1, width: float = 6.0, height: float = 3.6):
    _, axes = plt.subplots(1, count, figsize=(width * count, height), squeeze=False)
    return list(axes[0])


def worst(values) -> str:
    return f"{max(values):.1e}"


def conservation(_):
    found = {(law, d): closed_systems.conservation(law, d) for law in LAWS for d in PRECISIONS}
    axes = panels(2)
    for ax, name, asked in zip(axes, ("linear", "angular"), ((5e-6, 1e-13), (5e-6, 1e-12))):
        for d, limit, color in zip(PRECISIONS, asked, ("tab:orange", "tab:blue")):
            ax.semilogy(
                LAWS, [found[law, d][name] for law in LAWS], "o", color=color, label=LABEL[d]
            )
            ax.axhline(limit, color=color, ls="--", lw=1)
        ax.set_title(f"{name} momentum, relative change, 1000 substeps, adapter on")
        ax.tick_params(axis="x", rotation=90)
    axes[0].legend(title="dashed: asked")
    save("conservation", axes)
    checks = {"mass": ("1", "grid mass over 1000 substeps, f32 / f64", "1e-6 / 1e-12"),
              "linear": ("2", "linear momentum, adapter on", "5e-6 / 1e-13"),
              "angular": ("3", "angular momentum, adapter on", "5e-6 / 1e-12")}  # fmt: skip
    rows = []
    for name, (check, title, asked) in checks.items():
        reached = " / ".join(worst(found[law, d][name] for law in LAWS) for d in PRECISIONS)
        rows.append([check, f"{title}, worst of {len(LAWS)} laws", asked, reached])
    control = closed_systems.asymmetric_control()
    return [
        *rows,
        [
            "3",
            "angular momentum with an asymmetric stress (control)",
            "> 1e-4",
            f"{control['angular']:.1e}",
        ],
    ]


def stress(_):
    rows, errors = [], []
    for d in PRECISIONS:
        F = stresses.deformations(200, 3).to(d)
        for tau in (f(law, F) for law in LAWS for f in (stresses.stress, stresses.adapted_stress)):
            errors.append((d, float((tau - tau.mT).abs().max() / tau.abs().max())))
    rows.append(["4", "tau symmetric, laws and adapter, f32 / f64", "1e-6 / 1e-13",
                 " / ".join(worst(e for k, e in errors if k == d) for d in PRECISIONS)])  # fmt: skip
    objective = [law for law in LAWS if law != "linear"]
    frame = [stresses.frame_error(law, adapted) for law in objective for adapted in (False, True)]
    rows.append(
        ["5", "frame indifference, 200 rotations, laws and adapted laws", "1e-12", worst(frame)]
    )
    rows.append(
        [
            "5",
            "the same for `linear` (control)",
            "> 1e-2",
            f"{stresses.frame_error('linear', False):.1f}",
        ]
    )
    energies = [law for law in LAWS if law in ENERGIES]
    rows.append(["6", f"tau against the gradient of the energy ({', '.join(energies)})", "1e-12",
                 worst(stresses.energy_error(law) for law in energies)])  # fmt: skip
    rest = [
        [float(stresses.stress(law, torch.eye(3, dtype=d)[None]).abs().max()) / E for law in LAWS]
        for d in PRECISIONS
    ]
    small = []
    for law in LAWS:
        e = 1e-5
        F = torch.eye(3).double().repeat(2, 1, 1)
        F[0, 0, 0] += e
        F[1, 1, 2] += e
        tau, (c11, c44) = stresses.stress(law, F) / e, stresses.moduli(law)
        small += [abs(float(tau[0, 0, 0]) / c11 - 1), abs(float(tau[1, 1, 2]) - c44) / c11]
    rows.append(["7", "C11 and C44 at a strain of 1e-5", "1e-4", worst(small)])
    rows.append(
        ["7", "tau(I), f32 / f64", "1e-5 E / 0", f"{max(rest[0]):.0e} E / {max(rest[1]):.0f}"]
    )
    return rows


def unit_checks(_):
    bounds, m, p = (
        units.bounds(),
        units.plastic_return("von_mises"),
        units.plastic_return("drucker_prager"),
    )
    twins = {law: units.twin(law) for law in LAWS}
    known = [law for law, value in twins.items() if value is not None]
    return [
        ["8", "new adapter against the prior, motion with contact, f32 / f64", "bit-equal",
         " / ".join(f"{units.initial_adapter(d):.0f}" for d in PRECISIONS)],
        ["9", "inputs to 1e6, weights to 1e3: det(I + C); largest \\|L\\| over l_max", ">= 0.531; <= 1",
         f"{bounds['det']:.4f}; {bounds['L']:.4f}"],
        ["10", "stepwise against assembled 6x6 operator", "1e-12", f"{units.assembled():.1e}"],
        ["11", "von Mises: excess of yield; second return; det F", "1e-12", "; ".join(f"{v:.0e}" for v in m.values())],
        ["11", "Drucker-Prager: excess of yield; second return", "1e-12", "; ".join(f"{v:.0e}" for v in p.values())],
        ["20", "adjoint of rotation and stretch at rest, equal, nearly singular, inverted values", "1e-6",
         f"{units.polar_gradient():.1e}"],
        ["21", f"torch twin, one substep, {len(known)} laws", "1e-12", worst(twins[law] for law in known)],
        ["21", "CUDA against CPU", "1e-4 after 100 substeps f32", "holds on an H200 (tests/physics/engine/test_cuda.py)"],
    ]  # fmt: skip


def elastic(_):
    affine = {
        d: [max(elastic_bodies.affine_motion(law, d).values()) for law in LAWS] for d in PRECISIONS
    }
    force = {d: [elastic_bodies.interior_force(law, d)[0] for law in LAWS] for d in PRECISIONS}
    fall = {d: [elastic_bodies.free_fall(law, d)[1] for law in LAWS] for d in PRECISIONS}
    y, tau, _ = elastic_bodies.column("corotated")
    slopes = [elastic_bodies.column(law)[2] - 1 for law in SOLIDS]
    axes = panels()
    axes[0].plot(tau, y, ".", ms=4, label="mean of tau_yy over two periods")
    line = torch.linspace(0, 0.32, 2)
    axes[0].plot(-DENSITY * 9.8 * (0.32 - line), line, "k-", lw=1, label="-density g (H - y)")
    axes[0].set(xlabel="tau_yy [Pa]", ylabel="height [m]", title="hydrostatic column, 16 cells")
    axes[0].legend()
    save("column", axes)
    cells = [8, 16, 32, 64]
    errors = {law: [abs(elastic_bodies.wave(law, n)[2] - 1) for n in cells] for law in SOLIDS}
    axes = panels(2)
    t, mode, _ = elastic_bodies.wave("corotated", 16)
    axes[0].plot(t, mode, ".", ms=4, label="16 cells")
    axes[0].plot(
        t,
        torch.cos(math.pi * math.sqrt(1e6 / DENSITY) / 0.32 * t),
        "k-",
        lw=0.8,
        label="cos(pi c t/L)",
    )
    axes[0].set(
        xlabel="time [s]",
        ylabel="amplitude over the first",
        title="first standing wave of a free rod",
    )
    axes[0].legend()
    for law in SOLIDS:
        axes[1].loglog(cells, errors[law], "o-", ms=3, label=law)
    axes[1].loglog(
        cells, [errors["corotated"][0] * (8 / n) ** 2 for n in cells], "k--", lw=1, label="order 2"
    )
    axes[1].set(xlabel="cells", title="relative error of the wave speed, dt with dx")
    axes[1].legend(fontsize=7)
    save("wave", axes)
    order = min(math.log2(a / b) for e in errors.values() for a, b in itertools.pairwise(e))
    laws = ("linear", "neo_hookean", "corotated", "stvk")
    beams = {law: elastic_bodies.cantilever(law, length=30, depth=6) for law in laws}
    axes = panels()
    deflection, ratio = beams["corotated"]
    axes[0].plot(np.linspace(0, 1, len(deflection)), 1e3 * deflection, label="end of the beam")
    axes[0].axhline(1e3 * float(deflection[1:].mean()), color="tab:blue", ls=":", label="its mean")
    axes[0].axhline(
        1e3 * float(deflection[1:].mean()) / ratio, color="k", ls="--", lw=1, label="Timoshenko"
    )
    axes[0].set(
        xlabel="periods", ylabel="deflection [mm]", title="cantilever, 6 x 30 cells, own weight"
    )
    axes[0].legend()
    save("cantilever", axes)

    def both(f):
        return " / ".join(worst(f[d]) for d in PRECISIONS)

    return [
        ["12", "affine v, F, x and C_affine after a substep, f32 / f64", "1e-12 f64", both(affine)],
        ["12", "force inside a regular lattice of one F, f32 / f64", "1e-12 f64", both(force)],
        ["13", "free fall: v, f32 / f64; x above the parabola by g t dt/2", "1e-12 f64", both(fall)],
        ["14", f"slope of the column at 16 cells, worst of {len(SOLIDS)} laws", "2 %", f"{100 * max(map(abs, slopes)):.1f} %"],
        ["15", "error of the wave speed at 8 / 16 / 32 / 64 cells in half a wave", "2 %",
         " / ".join(f"{100 * max(e[i] for e in errors.values()):.2g} %" for i in range(4))],
        ["15", "order under joint refinement", ">= 1", f"{order:.2f}"],
        ["16", "sag of a cantilever under its own weight, 6 x 30 cells, over Timoshenko's: " + ", ".join(laws), "5 %",
         ", ".join(f"{100 * (r - 1):+.1f} %" for _, r in beams.values())],
    ]  # fmt: skip


def friction(_):
    axes, rows = panels(), []
    for value, color in zip((0.2, 0.5, 0.8), ("tab:blue", "tab:orange", "tab:green")):
        steep = math.degrees(math.atan(value))
        angles = [steep + d for d in (-4, -2, -1, 1, 2, 4, 6)]
        axes[0].plot(
            angles,
            [incline.slide(a, value)[0] for a in angles],
            "o",
            color=color,
            label=f"friction {value}",
        )
        sliding = np.linspace(steep, steep + 6, 2)
        axes[0].plot(sliding, [incline.point_mass(a, value) for a in sliding], color=color, lw=1)
        axes[0].axvline(steep, color=color, ls=":", lw=1)
        rows.append(abs(incline.slip_angle(value) - steep))
    axes[0].set(
        xlabel="incline [degrees]",
        ylabel="acceleration [m/s^2]",
        title="block on an incline; lines: point mass",
    )
    axes[0].legend()
    save("friction", axes)
    return [
        [
            "16",
            "angle from which a block slips, friction 0.2, 0.5, 0.8",
            "1 degree",
            f"{max(rows):.3f} degrees",
        ]
    ]


def frames(_):
    found = [invariance.differences(law)[1] for law in LAWS]
    return [["17", f"scene {what}, 200 substeps, contact, full adapter, worst of {len(LAWS)} laws", "1e-10 dx",
             f"{max(f[name][0] for f in found):.1e} dx"]
            for name, what in (("turned", "turned by 90 degrees"), ("moved", "moved by whole cells"))]  # fmt: skip


def gradient(_):
    horizons, axes, rows = [1, 5, 20, 50, 200, 500, 1500], panels(2), []
    for ax, contact in zip(axes, (False, True)):
        results = [Case("corotated", n, stride=10, contact=contact).compare(both_steps=True, scale=0.0003 if contact else 0.05)
                   for n in horizons]  # fmt: skip
        for name in results[0]:
            ax.loglog(
                horizons,
                [max(r[name].error, 1e-16) for r in results],
                "o-",
                ms=3,
                label=f"dL/d({name})",
            )
        if contact:
            spread = [max(10 * max(c.spread for c in r.values()), 1e-5) for r in results]
            ax.loglog(horizons, spread, "k--", lw=1, label="max(1e-5, 10 x two steps)")
        else:
            ax.axhline(1e-6, color="k", ls="--", lw=1, label="asked")
        ax.set(
            xlabel="substeps", title="through contact with friction" if contact else "smooth path"
        )
        ax.legend(fontsize=7)
        reached = results[-1]
        rows.append(["18", f"full adapter, 1500 substeps, {'through contact' if contact else 'smooth path'}",
                     "1e-3" if contact else "1e-6",
                     ", ".join(f"{k} {c.error:.0e}" for k, c in reached.items())])  # fmt: skip
    save("gradient", axes)
    smooth = [
        c.error
        for law in ELASTIC
        for n in (1, 50, 200)
        for c in Case(law, n).compare(both_steps=False).values()
    ]
    rows.insert(
        0,
        [
            "18",
            "smooth laws, 1, 50, 200 substeps: E, nu, v0, network weights",
            "1e-6",
            worst(smooth),
        ],
    )
    for law in (law for law in LAWS if law not in ELASTIC):
        found = Case(law, 200, contact=True).compare(both_steps=True, scale=0.003)
        rows.append(["18", f"{law}, 200 substeps, contact with friction", "max(1e-5, 10 x two steps)",
                     ", ".join(f"{k} {c.error:.0e}" for k, c in found.items())])  # fmt: skip
    single = []
    for law in ("corotated", "neo_hookean", "von_mises"):
        a, b = (Case(law, 800, dtype=d, stride=20).gradient() for d in PRECISIONS)
        single.append(max(float((a[k].double() - b[k]).abs().max() / b[k].abs().max()) for k in b))
    rows.append(
        [
            "19",
            "float32 against float64 gradient, 800 substeps, full adapter",
            "1e-3",
            worst(single),
        ]
    )
    a, b = (Case("corotated", 60, recompute=r).gradient() for r in (False, True))
    equal = all(torch.equal(a[k], b[k]) for k in a)
    rows.append(
        [
            "19",
            "recomputed networks against plain backward",
            "bit-equal",
            "bit-equal" if equal else "NOT equal",
        ]
    )
    return rows


def vibration(_):
    axes, rows = panels(), []
    for symmetric in (True, False):
        ratios = []
        for seed in range(8):
            maxima = closed_systems.vibration(seed=seed, major_symmetry=symmetric)
            ratios.append(max(b / a for a, b in itertools.pairwise(maxima)))
            axes[0].semilogy(
                np.array(maxima) / maxima[0], color="tab:blue" if symmetric else "tab:red", lw=1
            )
        rows.append(ratios)
    axes[0].set(
        xlabel="period", title="kinetic maximum: major symmetry (blue), literal operator (red)"
    )
    save("vibration", axes)
    grown = sum(r > 1 for r in rows[1])
    return [["26", "8 random constant operators with major symmetry: largest growth in a period", "<= 1", f"{max(rows[0]):.3f}"],
            ["26", "the same without (control): largest growth; operators that grow", "-",
             f"{max(rows[1]):.3f}; {grown} of 8"]]  # fmt: skip


def probes(data):
    if data is None:
        return []
    axes, rows = panels(), []
    for law in units.PROBES:
        errors = units.probe(data, law)
        axes[0].semilogy(torch.sort(errors).values.clamp_min(1e-18), label=law)
        rows.append(
            [
                "oracle",
                f"{units.PROBES[law]}: stress",
                "1e-13" if law == "neo_hookean" else "1e-9",
                worst(errors.tolist()),
            ]
        )
    axes[0].set(
        xlabel="particle, sorted", title="relative error of the stress against the peers' probes"
    )
    axes[0].legend()
    save("probes", axes)
    for name, (_, _, asked) in units.TRAJECTORIES.items():
        rows.append(
            [
                "oracle",
                f"{name}: x over 8 frames",
                f"{asked:.0e} m",
                f"{units.trajectory(data, name):.1e} m",
            ]
        )
    return rows


def bar(data, cells: int = 30):
    if data is None:
        return []
    reference = bars.finite_elements(data)
    axes, rows = panels(2), []
    axes[0].plot(*reference, "k-", lw=2, label="finite elements")
    own = lagrangian.elements(16)
    axes[1].plot(
        own[0],
        own[1] - np.interp(own[0], *reference),
        "k--",
        lw=1,
        label="own finite elements, 16 per metre",
    )
    what = "RMS distance to the finite-element bar"
    rows.append(
        [
            "bar",
            f"{what}, own finite elements, 16 per metre",
            "-",
            f"{bars.distance(*own, reference):.4f} m",
        ]
    )
    for n in (10, 20, cells):
        times, tip = bars.bar(n)
        rms = bars.distance(times, tip, reference)
        axes[0].plot(times, tip, lw=1, label=f"{n} cells per metre, {rms:.4f} m")
        axes[1].plot(times, tip - np.interp(times, *reference), lw=1)
        asked = "0.05 m" if n == 30 else f"{bars.held_face_bound(n, reference):.3f} m (derived)"
        beside = f"RMS distance from our own finite elements, {n} cells per metre"
        rows += [["bar", f"{what}, {n} cells per metre", asked, f"{rms:.4f} m"],
                 ["bar", beside, "-", f"{bars.distance(times, tip, own):.4f} m"]]  # fmt: skip
    axes[1].legend(fontsize=7)
    axes[0].set(xlabel="time [s]", ylabel="displacement of the corner [m]", title="hanging bar")
    axes[1].set(xlabel="time [s]", ylabel="difference [m]", title="difference to finite elements")
    axes[0].legend(fontsize=7)
    save("bar", axes)
    return rows


PARTS = {
    f.__name__: f
    for f in (
        conservation,
        stress,
        unit_checks,
        elastic,
        friction,
        frames,
        gradient,
        vibration,
        probes,
        bar,
    )
}


def number(row: list[str]) -> tuple[int, str]:
    return (int(row[0]) if row[0].isdigit() else 100, row[0])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", default=",".join(PARTS), help=f"comma-separated parts of {', '.join(PARTS)}"
    )
    parser.add_argument("--bar-cells", type=int, default=30)
    options = parser.parse_args()
    if unknown := [name for name in options.only.split(",") if name not in PARTS]:
        parser.error(f"--only: expected names among {', '.join(PARTS)}, found {unknown[0]!r}")
    torch.set_num_threads(1)
    data = Path(os.environ["MOSA_DATA"]) if "MOSA_DATA" in os.environ else None
    store = ROOT / "outputs" / "verification.json"
    store.parent.mkdir(exist_ok=True)
    results = json.loads(store.read_text()) if store.is_file() else {}
    for name in options.only.split(","):
        results[name] = bar(data, options.bar_cells) if name == "bar" else PARTS[name](data)
        store.write_text(json.dumps(results, indent=1))
        print(name, *(" | ".join(row) for row in results[name]), sep="\n  ", flush=True)
    publish(results, ROOT / "docs" / "results" / "verification.md")


def single(row: list[str]) -> list[list[str]]:
    """The row, or one row for each of the figures that its last cell lists."""
    check, subject, bound, found = row
    if re.fullmatch(r"\w[\w ]* [-+.\de]+(, \w[\w ]* [-+.\de]+)+", found):
        pairs = [each.rsplit(" ", 1) for each in found.split(", ")]
        return [[check, f"{subject}: {name}", bound, value] for name, value in pairs]
    mark = next((mark for mark in (" / ", "; ", ", ") if mark in found), None)
    if mark is None:
        return [row]
    values = found.split(mark)
    if mark == " / ":
        subject = subject if mark in subject else f"{subject}, f32 / f64"
        (names,) = re.findall(r"[\w.]+(?: / [\w.]+)+", subject)
        subject = subject.replace(names, "{}")
        named = [
            each.replace("f32", "float32").replace("f64", "float64") for each in names.split(mark)
        ]
        subjects = [subject.replace("{}", each) for each in named]
    else:
        head, _, names = subject.partition(": ")
        subjects = [f"{head}: {each}" for each in names.split(mark)]
    bounds = bound.split(mark) if mark in bound else [bound] * len(values)
    if bound.endswith(" f64"):
        bounds = ["-", bound.removesuffix(" f64")]
    return [
        list(each) for each in zip([check] * len(values), subjects, bounds, values, strict=True)
    ]


def publish(results: dict[str, list[list[str]]], page: Path) -> None:
    """The table into the page; printed instead where a part has not been measured, whose rows the page would lose."""
    rows = sorted(
        (each for part in results.values() for row in part for each in single(row)), key=number
    )
    table = "\n".join(
        [
            "| check | subject | bound | measured |",
            "|---|---|---|---|",
            *(f"| {' | '.join(row)} |" for row in rows),
        ]
    )
    missing = [name for name in PARTS if not results.get(name)]
    if missing or not page.is_file():
        print(
            f"{table}\n\n{page} is left as it is: not measured: {', '.join(missing) or 'no such page'}"
        )
        return
    before, rest = page.read_text().split("<!-- table -->\n")[:2]
    page.write_text(
        before + "<!-- table -->\n" + table + "\n<!-- end -->\n" + rest.split("<!-- end -->\n")[1]
    )


if __name__ == "__main__":
    main()
