"""Least squares of a law's numbers to stress-strain tests: starts, noise, posterior, tests left out.

The numbers are the law's unconstrained parameters, as a fit to films learns them (`Material.raw`), and those of the learned
stiffness, each with a normal prior of one standard deviation that the evidence chooses (MacKay 1992), as in `identification`."""

from __future__ import annotations

import copy
import logging
import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares

from mosa.errors import SimulationDiverged
from mosa.evaluation.analysis.law_stress import in_double
from mosa.material_tests.measurements import Measurements, strained
from mosa.material_tests.specimen import Specimens
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import Direction, Material
from mosa.modules.fitting.gauss_newton import Posterior

log = logging.getLogger(__name__)

ORTHOTROPIC = 7  # numbers of `anisotropic_basis` that keep the planes as mirrors
SPREAD = 0.7  # of the starts, in unconstrained numbers
LOOKED_AT, FAR = 64, 2.0  # further starts, of which only stresses are computed, and their spread
RELATIVE, FLOOR, EXACT, ALIKE = 0.05, 0.003, 0.02, 0.02
"""Where readings of stress are compared: standard deviation of a stress, relative to itself (also its noise where nothing tells
it) and to the largest; so many of them are no difference; and the largest logarithm of a stretch at which true and nominal stress
are the same."""
UNKNOWN = 100.0  # standard deviation of an unconstrained number that the tests do not determine
HOPELESS = 1e3  # residual (rms stresses) where the law has no equilibrium
UNSURE, ANY = 3.0, math.pi / math.sqrt(12)
"""Standard deviation above which a number is not determined: unconstrained, and of an angle [rad], of lines of any direction."""
CHANCE = 2.5  # standard deviations below which a correlation of residuals is by chance
LEAST = 1e-5  # noise, in the unit of the residuals: of a test that a law meets exactly
SIGMA, LOOKS, FEWEST, MOST = 0.5, 8, 1e-3, 3.0
"""Standard deviation of the stiffness' numbers at first; how often the evidence looks again; the range in which it is chosen."""


@dataclass(frozen=True)
class Fit:
    """theta: (k,) numbers by `names`, unconstrained; covariance (k, k); noise: factor on the given standard deviations, or [Pa];
    sigma: of the stiffness' numbers; effective: how many numbers the tests determine; predicted: (m,) [Pa]; simulated: of a fit
    with a pressure, (m,) [Pa] of the same numbers without it, as simulations and exports have them; NaN without an equilibrium;
    true: whether the stresses are Cauchy's; other: what `Fitting.other_reading` finds; together: what `Fitting.together` finds."""

    names: tuple[str, ...]
    theta: np.ndarray
    covariance: np.ndarray
    noise: float
    sigma: float
    effective: float
    predicted: np.ndarray
    simulated: np.ndarray | None = None
    true: bool = False
    other: float | None = None
    together: float = 0.0


class Law:
    """A law whose numbers are fitted: `material`, and the learned stiffness `adapter` or None.

    symmetry: full | orthotropic, of the stiffness."""

    def __init__(self, material: Material, adapter: HyperelasticAdapter | None, symmetry: str):
        self.material, self.adapter = in_double(material), adapter
        self.count = 0
        if adapter is not None:
            self.count = ORTHOTROPIC if symmetry == "orthotropic" else len(adapter.numbers)
            adapter.double()
        own = tuple(f"stiffness_{k + 1}" for k in range(self.count))
        self.names = (*material.learned, *own)
        angles = {a for name in material.directions for a in Direction.coordinates(name)}
        self.unsure = np.array([ANY if name in angles else UNSURE for name in self.names])

    def get(self) -> np.ndarray:
        """(k,) numbers."""
        raws = [float(self.material.raw[name].detach()) for name in self.material.learned]
        own = [] if self.adapter is None else self.adapter.numbers[: self.count].tolist()
        return np.array([*raws, *own])

    def set(self, theta: np.ndarray) -> Law:
        with torch.no_grad():
            for name, value in zip(self.names, theta):
                if name in self.material.raw:
                    self.material.raw[name].fill_(float(value))
            if self.adapter is not None:
                own = torch.as_tensor(theta[len(theta) - self.count :])
                self.adapter.numbers[: self.count] = own
        return self


class Fitting:
    """`law` against `data`. seed: of the starts; known: what another experiment said of some of the
    numbers (the stiffness' by the names operator[k]), which is their prior; true: the data are
    Cauchy's stresses; evidence: whether the stiffness' numbers have a prior. Errors: SimulationDiverged
    where no start can be evaluated."""

    def __init__(
        self, law: Law, data: Measurements, incompressible: bool, *, starts: int, seed: int,
        known: Posterior | None = None, true: bool = False, evidence: bool = True,
    ) -> None:  # fmt: skip
        self.law, self.data, self.starts, self.seed = law, data, starts, seed
        self.evidence = evidence
        self.begin = law.get()
        self.specimens = Specimens(data, incompressible, true)
        self.unit = float(np.sqrt(np.mean(data.value**2)))
        self.sd = np.where(np.isnan(data.sd), self.unit, data.sd)
        self.own = np.arange(len(law.names)) >= len(law.names) - law.count
        self.root, self.mean = np.zeros((0, len(law.names))), law.get()
        if known is not None:
            names = [*law.material.learned, *(f"operator[{k}]" for k in range(law.count))]
            known = known.only(names)
            at = [names.index(name) for name in known.names]
            self.root = np.zeros((len(at), len(names)))
            self.root[:, at] = np.linalg.cholesky(np.linalg.inv(known.covariance.numpy())).T
            self.mean[at] = known.mean.numpy()
            self.own[at] = False

    def predicted(self, theta: np.ndarray) -> np.ndarray:
        """(m,) [Pa]. Errors: SimulationDiverged."""
        self.law.set(theta)
        return self.specimens.predict(self.law.material, self.law.adapter)

    def among(self, stresses: np.ndarray) -> Fitting:
        """The same, of those `stresses` (m,) bool alone."""
        found = copy.copy(self)
        found.data, found.sd = self.data.only(stresses), self.sd[stresses]
        found.specimens = Specimens(found.data, self.specimens.incompressible, self.specimens.true)
        return found

    def fit(self, whole: bool = True) -> Fit:
        """The best of all starts; whole: also of those farther away, and with `Fit.simulated`."""
        noise, sigma, count = 0.1, SIGMA if self.evidence else UNKNOWN, len(self.data.value)

        def residuals(theta: np.ndarray, noise: float, sigma: float) -> np.ndarray:
            try:
                misfit = (self.predicted(theta) - self.data.value) / self.sd
                misfit = np.clip(misfit, -HOPELESS, HOPELESS)
            except SimulationDiverged:
                misfit = np.full(count, HOPELESS)
            prior = self.root @ (theta - self.mean)
            return np.concatenate([misfit / noise, theta[self.own] / sigma, prior])

        def solve(theta: np.ndarray, evaluations: int):
            ends = {"diff_step": 1e-6, "ftol": 1e-7, "xtol": 1e-7, "max_nfev": evaluations}
            return least_squares(residuals, theta, args=(noise, sigma), **ends)

        best = min((solve(theta, 60) for theta in self.drawn()), key=lambda found: found.cost)
        near = best.cost
        for theta in self.looked_at() if whole else ():
            if (residuals(theta, noise, sigma) ** 2).sum() < 2 * best.cost:
                best, self.begin = solve(theta, 60), theta
        if best.cost < near:
            log.info("prior.parameters: a start far from there leads nearer to the tests")
        if best.cost >= 0.5 * count * (HOPELESS / noise) ** 2:
            where = "in these tests at any start; start prior.parameters elsewhere"
            raise SimulationDiverged(f"the law has no stress {where}")
        for _ in range(LOOKS):
            before = noise, sigma
            J, misfit = best.jac[:count] * noise, best.fun[:count] * noise
            prior = np.diag(self.own / sigma**2) + self.root.T @ self.root
            known = J.T @ J / noise**2 + prior
            covariance = np.linalg.inv(known + UNKNOWN**-2 * np.eye(len(prior)))
            shares = 1 - np.diag(covariance @ prior)
            determined, effective = shares[self.own], float(shares.sum())
            spare = len(misfit) - effective
            noise = float(np.sqrt((misfit**2).sum() / max(spare, 1.0) + LEAST**2))
            # as many numbers as stresses: a law that meets them all says nothing of their noise
            if spare < 1:
                noise = max(noise, RELATIVE if np.isnan(self.data.sd).any() else 1.0)
            if self.own.any() and self.evidence:
                own = (best.x[self.own] ** 2).sum() / max(determined.sum(), 1e-3)
                sigma = float(np.clip(np.sqrt(own), FEWEST, MOST))
            best = solve(best.x, 100)
            if max(abs(np.log(np.array(before) / (noise, sigma)))) < 0.02:
                break
        together = self.together(misfit)
        known = J.T @ J / noise**2 * (1 - together) / (1 + together) + prior
        covariance = np.linalg.inv(known + UNKNOWN**-2 * np.eye(len(prior)))
        effective = float(shares[np.sqrt(np.diag(covariance)) < self.law.unsure].sum())
        scale = noise if not np.isnan(self.data.sd).any() else noise * self.unit
        told = self.law.names, best.x, covariance, scale, sigma, effective, self.predicted(best.x)
        own, free = self.specimens, None
        if own.incompressible and whole:
            try:
                free = Specimens(self.data, False, own.true).predict(
                    self.law.material, self.law.adapter
                )
            except SimulationDiverged:
                free = np.full(len(self.data.value), np.nan)
        return Fit(*told, free, own.true, together=together)

    def together(self, misfit: np.ndarray) -> float:
        """Correlation of neighbouring residuals (m,) along the curves, in the order of the file; 0 where chance explains it. An
        error of the law or an offset of the file makes them alike: (1 + r)/(1 - r) of them then count as one."""
        curve = 2 * self.data.test[self.data.row] + self.data.component
        order = np.argsort(curve, kind="stable")
        pairs = np.stack([misfit[order][:-1], misfit[order][1:]])[:, np.diff(curve[order]) == 0]
        found = 2 * pairs.prod(0).sum() / ((pairs**2).sum() + LEAST**2)
        length = len(misfit) / len(np.unique(curve))  # one residual of each curve counts at least
        chance = CHANCE > found * np.sqrt(pairs.shape[1])
        return 0.0 if chance else float(min(found, (length - 1) / (length + 1)))

    def scaled(self, theta: np.ndarray) -> np.ndarray:
        """With its moduli scaled to the tests, where they then have the sign of the tests."""
        moduli = ("E", "mu", "kappa", "fibre_stiffness")
        names = enumerate(self.law.names)
        stiff = [i for i, n in names if n in moduli[:3] or n.startswith(moduli[3])]
        try:
            found = self.predicted(theta) / self.sd
        except SimulationDiverged:
            return theta
        with np.errstate(over="ignore", invalid="ignore"):  # of an exponential law far away
            factor = found @ (self.data.value / self.sd) / (found @ found)
        theta = theta.copy()
        theta[stiff] += np.log(factor) if 0 < factor < math.inf else 0.0
        return theta

    def drawn(self) -> list[np.ndarray]:
        """Starts: the configured one with its stiffness scaled to the tests, and others about it."""
        theta = self.scaled(self.begin)
        generator = np.random.default_rng(self.seed)
        spread = np.where(self.own, 0.1, SPREAD)
        drawn = (generator.standard_normal(len(theta)) for _ in range(self.starts - 1))
        return [theta, *(theta + spread * each for each in drawn)]

    def looked_at(self) -> list[np.ndarray]:
        """Starts farther away, each scaled: a fit goes on from one only if that is better than all that the others led to."""
        draws = np.random.default_rng(self.seed).standard_normal((LOOKED_AT, len(self.begin)))
        theta = self.begin + np.where(self.own, 0.1, FAR) * draws
        return [self.scaled(each) for each in theta]

    def other_reading(self) -> float | None:
        """How many times as far from the tests the law ends where they are read as true stress in place of nominal, or the
        reverse. Each stress counts relative to itself. None where both are nearly the same."""
        data, own, errors = self.data, self.specimens, []
        if strained(data) < ALIKE:
            return None
        again = copy.copy(self)
        again.sd = np.hypot(RELATIVE * data.value, FLOOR * np.abs(data.value).max())
        for true in (own.true, not own.true):
            again.specimens = Specimens(data, own.incompressible, true)
            try:
                off = (again.fit().predicted - data.value) / again.sd
                errors.append(float(np.sqrt(np.mean(off**2))) + EXACT)
            except SimulationDiverged:
                errors.append(math.inf)
        return errors[1] / errors[0]

    def left_out(self) -> dict[str, np.ndarray]:
        """By test: its stresses (m_test,) [Pa] as predicted by a fit to all others, which knows nothing of it, nor whether the law
        has a stress there; NaN where it, or the others' fit, has none."""
        result = {}
        for k, name in enumerate(self.data.names):
            rows = self.data.without(k)
            try:
                theta = self.among(rows).fit(whole=False).theta
                result[name] = self.among(~rows).predicted(theta)
            except SimulationDiverged:
                result[name] = np.full(int((~rows).sum()), np.nan)
        return result
