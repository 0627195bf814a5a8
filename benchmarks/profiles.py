"""Which parameters of a stand-in its true motion tells, and how closely: profiles of the misfit, without images.

    python benchmarks/profiles.py cat letter --device cuda                  # on the truth's own particles and grid
    python benchmarks/profiles.py cat --device cuda --particles 4000        # on the learner's, as in table_identification

Each parameter is held at multiples of its true value, nu and angles at as many steps of their unconstrained number, while
Gauss-Newton fits all others and the contact height to the true motion, from the true start. The misfit counts 30 data a frame in
units of the cues' noise and of what the best law leaves there. A parameter is told where the misfit rises by `RISE` on both
sides; between these ends is its two-sigma range.
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
STEPS = 4
"""Of Gauss-Newton at each multiple, with one Jacobian."""
SAME_GRID = ["simulation.particles_per_cell=8", "simulation.courant=0.3"]
"""Grid and time step of a learner with the truth's particles, as `synthetic.drop` has them."""
UNBOUND = 10.0
"""Prior standard deviation of a law's unconstrained numbers: none."""


class Misfit:
    """Of free rollouts from the true motion after contact, each frame in units of its `noise` [m]; least: the smallest so far."""

    def __init__(self, case: SimpleNamespace, sd: float, count: float) -> None:
        self.case, self.body, take = case, case.body, case.take
        self.chosen, self.first = (
            sampled(len(self.body.rest), self.body.rest.device),
            take.first_contact,
        )
        # the fall before it is a parabola whatever the law is
        skipped, gravity = max(0, self.first - 2), case.world.gravity.to(self.body.rest)
        t, begun = skipped * take.frame_dt, take.start
        fallen = begun.center + t * begun.velocity + 0.5 * t**2 * gravity
        self.start = replace(begun, center=fallen, velocity=begun.velocity + t * gravity)
        self.first, self.frames = self.first - skipped, len(case.truth) - skipped
        self.true = case.truth[skipped:, self.chosen]
        self.noise, self.count = torch.full_like(self.true[:, 0, 0], 3**0.5 * sd), count
        self.substeps, self.rms_mm = 0, math.nan

    def ready(self, substeps: int | None = None) -> Ready:
        dt = self.case.take.frame_dt
        return self.body.ready(self.start, self.case.world, self.frames, dt, substeps=substeps)

    def whitened(self, x: Tensor) -> Tensor:
        unit = (self.count / len(self.chosen)) ** 0.5 / self.noise
        away = x[:, self.chosen] - self.true
        self.squares = away.square().sum(-1).mean(-1)
        return (away * unit[:, None, None])[self.first :].flatten()

    @torch.no_grad()
    def residuals(self) -> Tensor:
        return self.whitened(self.ready(self.substeps).simulate(self.frames).x)

    def here(self) -> float:
        """With the substeps that the law asks for."""
        self.substeps = self.ready().simulator.substeps
        found = float(self.residuals().square().sum())
        self.rms_mm = 1e3 * float(self.squares[self.first :].mean().sqrt())
        return found

    @torch.no_grad()
    def fitted(self, held: str | None = None, passes: int = 1) -> float:
        """After a fit of all numbers but `held` from where they stand, each pass with the substeps that its law asks for."""
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
        for _ in range(passes):
            self.substeps = self.ready().simulator.substeps
            if newton.iterate(learn=False)["share"] == 0:
                break
        return self.here()

    @property
    def tensors(self) -> list[Tensor]:
        return tensors_of(self.body, adapter=False, heterogeneity=False)


def case_of(name: str, options: argparse.Namespace) -> SimpleNamespace:
    """The learner of a stand-in with the true parameters, and its true motion."""
    body = object_named(name)
    if options.truth:
        count = len(
            calibration.fill(calibration.SHAPES[body.shape], body.spacing, np.random.default_rng(0))
        )
        body = replace(body, spacing=body.spacing * (count / options.truth) ** (1 / 3))
    path = options.out / f"{name}_{options.truth or 'own'}.npz"
    if not path.exists():
        calibration.keep(path, body, body.material, options.seed, device=options.device)
    same = [] if options.particles else SAME_GRID
    values = [f"prior.parameters.{key}={value}" for key, value in body.material.values]
    cfg = calibration.configuration(
        name, ["simulation.max_substeps=5000", *same, *values, *options.set]
    )
    return calibration.learner_of(
        path, body, cfg, options.particles, options.seed, 0.0, options.device
    )


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


def profile(misfit: Misfit, name: str, best: Tensor) -> list[tuple[float, float, float]]:
    """(shift of the unconstrained number from the truth, misfit, rms [mm]) of one parameter, outwards from the truth."""
    raw, true = misfit.body.material.raw[name], misfit.body.material.begins[name]
    middle, found, least = MULTIPLES.index(1.0), [], math.inf
    for side in (MULTIPLES[middle:], MULTIPLES[middle - 1 :: -1]):
        Seat(misfit.tensors, torch.empty).write(best)
        for multiple in side:
            with torch.no_grad():
                raw.fill_(true + math.log(multiple))
            try:
                found.append((math.log(multiple), misfit.fitted(name), misfit.rms_mm))
            except MosaError as error:
                print(f"  {name} times {multiple}: {error}")
                break
            least = min(least, found[-1][1])
            if found[-1][1] > least + ENOUGH:
                break
    return sorted(found)


@torch.no_grad()
def profiles(name: str, options: argparse.Namespace) -> None:
    began = time.perf_counter()
    case = case_of(name, options)
    height = float(case.body.rest[:, 1].max() - case.body.rest[:, 1].min())
    misfit, material = Misfit(case, options.noise * height, options.count), case.body.material
    lift = case.object.meeting.lift * case.object.dx / case.record.dx
    case.body.contact.cells.fill_(lift)
    misfit.here()
    truly = misfit.rms_mm
    misfit.fitted(passes=4)
    if options.particles:  # what the grid gets wrong at the best law is noise too
        misfit.noise = (misfit.noise.square() + misfit.squares).sqrt()
    least = misfit.here()
    best = Seat(misfit.tensors, torch.empty).read()
    values = " ".join(f"{k} {float(v):.4g}" for k, v in material.physical().items())
    print(f"\n{name}: {len(case.body.rest)} particles, dx {1e3 * case.record.dx:.2f} mm (truth {1e3 * case.object.dx:.2f}), cues "
          f"{1e3 * options.noise * height:.2f} mm off; {truly:.2f} mm at the true parameters, {misfit.rms_mm:.2f} mm at the best: "
          f"{values} contact {float(case.body.contact.cells):.2f}", flush=True)  # fmt: skip
    known = [each for each in material.learned if each in case.object.material.known]
    found = {each: profile(misfit, each, best) for each in known}
    least = min(least, *(row[1] for rows in found.values() for row in rows))
    for each, rows in found.items():
        shifts, rises = [row[0] for row in rows], [row[1] - least for row in rows]

        def physical(shift: float, each: str = each) -> float:
            return float(material.physical_of(each, torch.tensor(material.begins[each] + shift)))

        sides = ends(shifts, rises)
        told = ("not told", "told on one side", "told")[sum(map(math.isfinite, sides))]
        low, high = (f"{physical(end):.3g}" if math.isfinite(end) else "beyond" for end in sides)
        print(f"  {each} = {physical(0.0):.4g}: {told}, two sigma {low} to {high}")
        print("    " + "; ".join(f"{physical(shift):.3g}: {rise:.1f} ({mm:.2f} mm)"
                                 for shift, rise, (*_, mm) in zip(shifts, rises, rows)))  # fmt: skip
    print(f"  {time.perf_counter() - began:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="names of stand-ins")
    parser.add_argument(
        "--particles", type=int, default=0, help="of the learner; 0: the truth's own, on its grid"
    )
    parser.add_argument(
        "--truth", type=int, default=0, help="particles of the truth; 0: as the scene has them"
    )
    parser.add_argument(
        "--noise", type=float, default=calibration.NOISE, help="of the cues over the body's height"
    )
    parser.add_argument("--count", type=float, default=30.0, help="independent data of a frame")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--out", type=Path, default=Path("motions"), help="folder of the true motions"
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--set", nargs="*", default=[], help="overrides of the law and its simulation"
    )
    options = parser.parse_args()
    for name in options.scenes:
        profiles(name, options)


if __name__ == "__main__":
    main()
