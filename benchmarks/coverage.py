"""How often the true E and nu lie within the standard deviations that runs state: a table and a diagram.

python benchmarks/coverage.py PICTURE RUN[=E,nu] ...

RUN: a folder with metrics.json; E [Pa] and nu of the truth where the run does not know them.
"""

import json
import math
import sys
from pathlib import Path

import matplotlib
import numpy as np
from scipy.stats import beta, norm

matplotlib.use("agg")
import matplotlib.pyplot as plt

NAMES = {"E": "E", "nu": "Poisson's ratio"}


def deviations(run: str) -> tuple[str, dict[str, float], dict[str, float]]:
    """(name, errors in stated standard deviations, standard deviations) of a run, by `NAMES`."""
    folder, _, truth = run.partition("=")
    figures = json.loads((Path(folder) / "metrics.json").read_text())
    if truth:
        E, nu = map(float, truth.split(","))
        errors = {"E": figures["id/E"] / E - 1, "nu": figures["id/nu"] - nu}
    else:
        relative = figures["id/nu_relative_error"]
        # |nu - true| / true: of both truths the one nearer to what the prior found
        signs = [figures["id/nu"] / (1 + s * relative) for s in (1, -1)]
        prior = figures["id_prior/nu_relative_error"]
        others = [figures["id_prior/nu"] / (1 + s * prior) for s in (1, -1)]
        nu = min(signs, key=lambda true: min(abs(true - other) for other in others))
        errors = {"E": figures["id/E_ratio"] - 1, "nu": figures["id/nu"] - nu}
    stated = {"E": figures["posterior/E_relative_sd"], "nu": figures["posterior/nu_sd"]}
    return Path(folder).name, {k: errors[k] / stated[k] for k in NAMES}, stated


def interval(inside: int, count: int) -> tuple[float, float]:
    """The 95 % interval of Clopper and Pearson of a share."""
    low = beta.ppf(0.025, inside, count - inside + 1) if inside else 0.0
    return low, beta.ppf(0.975, inside + 1, count - inside) if inside < count else 1.0


def main() -> None:
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    picture, *runs = sys.argv[1:]
    try:
        found = [deviations(run) for run in runs]
    except KeyError as error:
        sys.exit(
            f"metrics.json: expected the figures of fits by Gauss-Newton that learned E and nu, found one without {error}; "
            "where a run does not know the truth, RUN=E,nu"
        )
    for name, z, stated in found:
        print(
            f"| {name} | {z['E']:+.1f} | {100 * stated['E']:.1f} % | {z['nu']:+.1f} | {stated['nu']:.3f} |"
        )
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.2), sharey=True, layout="constrained")
    multiples = np.linspace(0, 3, 61)
    for axis, (key, label) in zip(axes, NAMES.items()):
        z = np.array([abs(each[key]) for _, each, _ in found])
        inside = [int((z <= k).sum()) for k in multiples]
        band = np.array([interval(each, len(z)) for each in inside])
        axis.fill_between(multiples, *band.T, alpha=0.2, label="95 % interval")
        axis.plot(multiples, np.array(inside) / len(z), label="measured")
        axis.plot(multiples, 2 * norm.cdf(multiples) - 1, "k--", label="normal distribution")
        axis.set(xlabel="multiple of the stated standard deviation", title=label, ylim=(0, 1.02))
        for k in (1, 2):
            n = int((z <= k).sum())
            low, high = interval(n, len(z))
            print(f"{key}, {k} sd: {n} of {len(z)} = {n / len(z):.0%} (95 %: {low:.0%} to {high:.0%}), "
                  f"nominal {math.erf(k / 2**0.5):.0%}; median sd {np.median([s[key] for _, _, s in found]):.3f}")  # fmt: skip
    axes[0].set_ylabel("share of runs")
    axes[1].legend(loc="lower right")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main()
