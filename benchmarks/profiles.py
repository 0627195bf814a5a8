"""Which parameters of a stand-in its true motion tells, and how closely: profiles of the misfit, without images.

    python benchmarks/profiles.py cat letter --device cuda                  # on the truth's own particles and grid
    python benchmarks/profiles.py cat --device cuda --particles 4000        # on the learner's, as in table_identification

Each parameter is held at multiples of its true value, nu and angles at as many steps of their unconstrained number, while
Gauss-Newton fits all others and the contact height to the true motion, from the true start. The misfit counts `COUNT` data a frame
in units of the cues' noise, or of what the best law leaves if that is more. A parameter is told where the misfit rises by `RISE`
on both sides; between these ends is its two-sigma range. A motion that `calibration.py make` has written is read.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import calibration
import numpy as np
import torch
from torch import Tensor

from mosa.data.synthetic.bodies.objects import object_named
from mosa.errors import MosaError
from mosa.modules.body.ready import Ready
from mosa.modules.fitting.gauss_newton import GaussNewton, Seat
from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.modules.fitting.parameters import blocks_of, tensors_of
from mosa.modules.fitting.residuals import sampled

MULTIPLES = (0.1, 0.2, 0.32, 0.5, 0.71, 0.84, 0.95, 1.0, 1.05, 1.19, 1.41, 2.0, 3.2, 5.0, 10.0)
RISE, ENOUGH = 4.0, 40.0
"""Of the misfit, twice minus a logarithm of the likelihood: at two standard deviations; beyond it no further multiple is tried."""
COUNT = 30.0  # independent data of a frame
STEPS = 4
"""Of Gauss-Newton at each multiple, with one Jacobian."""
SAME_GRID = ["simulation.particles_per_cell=8", "simulation.courant=0.3"]
"""Grid and time step of a learner with the truth's particles, as `synthetic.drop` has them."""
UNBOUND = 10.0
"""Prior standard deviation of a law's unconstrained numbers: none."""


class Misfit:
    """Of free rollouts from the true motion after contact, in units of the cues' noise, `sd` [m] a component."""

    def __init__(self, case: SimpleNamespace, sd: float) -> None:
        self.case, self.body, take = case, case.body, case.take
        self.chosen = sampled(len(self.body.rest), self.body.rest.device)
        gravity, begun, skipped = case.world.gravity.to(self.body.rest), take.start, 0

        def fallen(frame: int) -> Tensor:  # before contact: a parabola whatever the law is
            t = frame * take.frame_dt
            return t * begun.velocity + 0.5 * t**2 * gravity

        away = lambda k: float((case.truth[k] - case.truth[0] - fallen(k)).abs().max())  # noqa: E731
        while skipped + 2 < take.first_contact and away(skipped + 2) <= 1e-3 * self.body.size:
            skipped += 1
        velocity = begun.velocity + skipped * take.frame_dt * gravity
        self.start = replace(begun, center=begun.center + fallen(skipped), velocity=velocity)
        self.first, self.frames = take.first_contact - skipped, len(case.truth) - skipped
        self.true = case.truth[skipped:, self.chosen]
        self.noise, self.counted = 3**0.5 * sd, COUNT * (self.frames - self.first)
        self.rms_mm = math.nan
        self.least = self.substeps = self.ready().simulator.substeps

    def ready(self, substeps: int | None = None) -> Ready:
        dt = self.case.take.frame_dt
        return self.body.ready(self.start, self.case.world, self.frames, dt, substeps=substeps)

    def whitened(self, x: Tensor) -> Tensor:
        unit = (COUNT / len(self.chosen)) ** 0.5 / self.noise
        return unit * (x[:, self.chosen] - self.true)[self.first :].flatten()

    @torch.no_grad()
    def residuals(self) -> Tensor:
        return self.whitened(self.ready(self.substeps).simulate(self.frames).x)

    def over(self, least: float) -> float:
        """How often a misfit counts the variance of its noise, where the best law leaves more than that: the grid's errors."""
        return max(1.0, least / self.counted)

    def here(self) -> float:
        """With the substeps of the true law, or what this one asks for: more of them act like another stiffness."""
        self.substeps = max(self.least, self.ready().simulator.substeps)
        found = float(self.residuals().square().sum())
        self.rms_mm = 1e3 * self.noise * (found / self.counted) ** 0.5
        return found

    @torch.no_grad()
    def fitted(self, held: str) -> float:
        """After a fit of all numbers but `held` from where they stand."""
        blocks = blocks_of(self.body, adapter=False, heterogeneity=False, settings=IdentificationSettings(),
                           ground=self.case.world.ground, free=True, calibrating=True)  # fmt: skip
        for block in blocks:
            if block.name != "contact":
                block.sd = torch.full_like(block.sd, UNBOUND)
        kept = [i for i, block in enumerate(blocks) if block.name != held]
        seat = Seat([self.tensors[i] for i in kept], self.residuals, self.ready)

        def many(rows: Tensor) -> Tensor:
            parts = []
            for row in rows:
                seat.write(row)
                parts.append(self.ready(self.substeps))
            worlds = Ready.stack(parts).simulate(self.frames).worlds()
            return torch.stack([self.whitened(world.x) for world in worlds])

        together = many if self.body.rest.is_cuda else None
        newton = GaussNewton([blocks[i] for i in kept], [seat], steps=STEPS, many=together)
        before, numbers = self.here(), seat.read()
        newton.iterate(learn=False)
        if (after := self.here()) > before:  # in the substeps of its end
            seat.write(numbers)
            return self.here()
        return after

    @property
    def tensors(self) -> list[Tensor]:
        return tensors_of(self.body, adapter=False, heterogeneity=False)


def case_of(name: str, options: argparse.Namespace) -> SimpleNamespace:
    """The learner of a stand-in with the true parameters, and its true motion."""
    path, true = options.out / f"{name}.npz", object_named(name).material.values
    if not path.exists():
        calibration.make(name, options.out, options.seed, options.device)
    more = [] if options.particles else SAME_GRID
    more = ["simulation.max_substeps=5000", *more, *(f"prior.parameters.{k}={v}" for k, v in true)]
    given = options.particles, [*more, *options.set], options.seed, 0.0, options.device
    return calibration.case_of(path, *given)


def ends(shifts: Sequence[float], rises: Sequence[float]) -> tuple[float, float]:
    """Where a profile crosses `RISE` on both sides of its lowest place, linearly between its places; infinite where it does not."""
    low = int(np.argmin(rises))

    def crossing(order: range) -> float:
        for i, j in pairwise(order):
            if rises[j] > RISE:
                part = (RISE - rises[i]) / (rises[j] - rises[i])
                return shifts[i] + part * (shifts[j] - shifts[i])
        return math.inf

    left, right = crossing(range(low, -1, -1)), crossing(range(low, len(shifts)))
    return (-math.inf if left == math.inf else left), right


def profile(misfit: Misfit, name: str) -> dict[float, tuple[float, str]]:
    """(misfit, what was found) by multiples of one parameter: outwards from the truth, and back from each end, as a fit that
    begins at its neighbour's may stay in another valley."""
    material, middle = misfit.body.material, MULTIPLES.index(1.0)
    true = Seat(misfit.tensors, torch.empty).read()
    found: dict[float, tuple[float, str]] = {}

    def fitted(multiple: float) -> float:
        with torch.no_grad():
            material.raw[name].fill_(material.begins[name] + math.log(multiple))
        value = misfit.fitted(name)
        if value < found.get(multiple, (math.inf,))[0]:
            others = " ".join(
                f"{k} {float(v.detach()):.3g}" for k, v in material.physical().items()
            )
            contact = float(misfit.body.contact.cells.detach())
            found[multiple] = value, f"{misfit.rms_mm:.2f} mm, {others} contact {contact:.2f}"
        return value

    for side in (MULTIPLES[middle:], MULTIPLES[middle::-1]):
        Seat(misfit.tensors, torch.empty).write(true)
        reached = []
        for multiple in side:
            try:
                value = fitted(multiple)
            except MosaError as error:
                print(f"  {name} times {multiple}: {error}")
                break
            reached.append(multiple)
            least = min(each[0] for each in found.values())
            if value > least + ENOUGH * misfit.over(least):
                break
        for multiple in reached[-2::-1]:
            fitted(multiple)
    Seat(misfit.tensors, torch.empty).write(true)
    return dict(sorted(found.items()))


@torch.no_grad()
def profiles(name: str, options: argparse.Namespace) -> None:
    began = time.perf_counter()
    case = case_of(name, options)
    rest, material, dx = case.body.rest, case.body.material, case.record.dx
    sd = options.noise * float(rest[:, 1].max() - rest[:, 1].min())
    misfit = Misfit(case, sd)
    case.body.contact.cells.fill_(case.object.meeting.lift * case.object.dx / dx)
    misfit.here()
    print(f"\n{name}: {len(rest)} particles, dx {1e3 * dx:.2f} mm (truth {1e3 * case.object.dx:.2f}), cues {1e3 * sd:.2f} mm off, "
          f"{misfit.rms_mm:.2f} mm at the true parameters", flush=True)  # fmt: skip
    asked = options.only or case.object.material.known
    found = {each: profile(misfit, each) for each in material.learned if each in asked}
    least = min(value for rows in found.values() for value, _ in rows.values())
    for each, rows in found.items():
        shifts = list(map(math.log, rows))
        rises = [(value - least) / misfit.over(least) for value, _ in rows.values()]
        sides = ends(shifts, rises)
        told = ("not told", "told on one side", "told")[sum(map(math.isfinite, sides))]
        places = torch.tensor([material.begins[each] + shift for shift in (0.0, *sides, *shifts)])
        true, *values = material.physical_of(each, places).tolist()
        low, high = (f"{v:.3g}" if math.isfinite(s) else "beyond" for v, s in zip(values, sides))
        print(f"  {each} = {true:.4g}: {told}, two sigma {low} to {high}")
        for value, rise, (_, said) in zip(values[2:], rises, rows.values()):
            print(f"    {value:9.3g}: {rise:7.1f}  {said}")
    print(f"  {time.perf_counter() - began:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="names of stand-ins")
    parser.add_argument("--only", nargs="*", help="parameters; all that are published without it")
    parser.add_argument("--out", type=Path, default="motions", help="folder of the true motions")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--set", nargs="*", default=[], help="overrides of the configuration")
    calibration.add_options(parser)
    parser.set_defaults(particles=0)  # the truth's own
    options = parser.parse_args()
    for name in options.scenes:
        profiles(name, options)


if __name__ == "__main__":
    main()
