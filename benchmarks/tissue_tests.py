"""The measurements of real tissues as csv files for `mosa-material`: heart muscle, knitted fabric, rubber (MOSA_DATA, openpyxl).

python benchmarks/tissue_tests.py FOLDER    writes heart.csv (kPa), fabric.csv, fabric_unloading.csv (kPa), rubber.csv (MPa)

Heart: six shear modes (face normal, then direction) and five biaxial ratios; x fibre, y sheet, z normal. Fabric: loading, mean and
standard deviation of the repeats, along the courses (0) and at 45 degrees; every third row. Rubber: Treloar at 20 degrees.
"""

from __future__ import annotations

import csv
import os
import sys
from pathlib import Path

AXES = {"f": "x", "s": "y", "n": "z"}
SHEARS = {"fs": 0, "fn": 2, "sf": 5, "sn": 7, "nf": 10, "ns": 12}
BIAXIAL = {"1:1": 15, "1:0.75": 20, "0.75:1": 25, "1:0.5": 30, "0.5:1": 35}
RUBBER = {
    "uniaxial": ("uniaxial x", 0, 2),
    "equibiaxial": ("biaxial xy", 3, 5),
    "pure shear": ("biaxial xy", 6, 8),
}
LEAST_SD = 0.05
"""Of a fabric's standard deviation, as a share of the largest: at the first rows all repeats begin at 0."""


def sheet(name: str, title: str, first: int) -> list[tuple]:
    from openpyxl import load_workbook

    folder = Path(os.environ["MOSA_DATA"]) / "real" / "tissue"
    book = load_workbook(folder / f"{name}.xlsx", data_only=True, read_only=True)
    return list(book[title].iter_rows(min_row=first, values_only=True))


def numbers(rows: list[tuple], *columns: int) -> list[list[float]]:
    found = []
    for row in rows:
        cells = [row[c] if c < len(row) else None for c in columns]
        if all(isinstance(v, (int, float)) for v in cells):
            found.append([float(v) for v in cells])
    return found


def heart() -> list[dict]:
    rows = sheet("myocardium_CANNsHEARTdata_shear05", "Sheet1", 5)
    found = [
        {
            "test": f"shear {name}",
            "mode": f"shear {AXES[name[0]]}{AXES[name[1]]}",
            "first": a,
            "stress_1": p,
        }
        for name, c in SHEARS.items()
        for a, p in numbers(rows, c, c + 1)
    ]
    return found + [
        {
            "test": f"biaxial {name}",
            "mode": "biaxial xz",
            "first": a,
            "second": b,
            "stress_1": p,
            "stress_2": q,
        }
        for name, c in BIAXIAL.items()
        for a, p, b, q in numbers(rows, c, c + 1, c + 2, c + 3)
    ]


def fabric(branch: str = "load") -> list[dict]:
    found = []
    for angle, name in ((0, "warp_knit_all_sigmas_0_90"), (45, "warp_knit_all_sigmas_45_135")):
        for title in ("strip_x", "off_x", "equibiax", "off_y", "strip_y"):
            header, *rows = sheet(name, title, 1)
            columns = [header.index(c) for c in ("stretch_x", "stretch_y")]
            for axis in "xy" if angle == 0 else "x":
                columns += [header.index(f"stress_{axis}_{branch}_{c}") for c in ("mean", "std")]
            read = numbers(rows, *columns)[::3]
            least = [LEAST_SD * max(r[c] for r in read) for c in range(3, len(columns), 2)]
            for a, b, *rest in read:
                row = {
                    "test": f"{title} {angle}",
                    "mode": "biaxial xy",
                    "angle": angle,
                    "first": a,
                    "second": b,
                }
                for k, (value, sd) in enumerate(zip(rest[::2], rest[1::2])):
                    row |= {f"stress_{k + 1}": value, f"sd_{k + 1}": max(sd, least[k])}
                found.append(row)
    return found


def rubber() -> list[dict]:
    rows = sheet("rubber_CANNsRUBBERdata", "Sheet1", 5)
    found = []
    for name, (mode, stretch, stress) in RUBBER.items():
        for a, p in numbers(rows, stretch, stress):
            row = {"test": name, "mode": mode, "first": a, "stress_1": p}
            if mode.startswith("biaxial"):
                row["second"] = a if name == "equibiaxial" else 1.0
            found.append(row)
    return found


def write(path: Path, rows: list[dict]) -> None:
    names = ("test", "mode", "angle", "first", "second", "stress_1", "stress_2", "sd_1", "sd_2")
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "heart.csv", heart())
    write(folder / "fabric.csv", fabric())
    write(folder / "fabric_unloading.csv", fabric("unload"))
    write(folder / "rubber.csv", rubber())
