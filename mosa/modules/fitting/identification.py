"""Identification of a body's few numbers by Gauss-Newton: what is compared, and what was found.

The numbers are those of `learned_numbers`; what is compared are the motion cues (`residuals`), in the rollouts that the criterion
asks for (`Ready.simulate`)."""

from __future__ import annotations

import copy
import itertools
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mosa.data.io.forces import columns_of, curves_of, force_residuals
from mosa.errors import ConfigError, MosaError, SimulationDiverged
from mosa.modules.body.body import Body, Ready, World
from mosa.modules.body.material import RIVALS
from mosa.modules.fitting import residuals
from mosa.modules.fitting.gauss_newton import Block, GaussNewton, Posterior, Seat
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.parameters import blocks_of, is_learned, tensors_of
from mosa.modules.fitting.search.backbone import OFFSET_STEPS, search
from mosa.modules.fitting.search.parts import FOLDS, PARTS, held_back
from mosa.modules.fitting.stages import Stage
from mosa.physics.constitutive.laws import law_named
from mosa.system.threads import apart, cores, threaded
from mosa.types import MarkerCues, Rollout

COUNTED_AT_FIRST = 100 / 30
"""Of a calibration's data over a later stage's, frame by frame: it has few numbers, and no model of its own error in its noise."""
NOISE_ITERATIONS = 3
"""Iterations in which the noise is found again; later its scale stays, so that costs can be compared."""
EVIDENCE_ITERATIONS = 5
"""Iterations in which the sizes of the blocks are found again, later they stay. Two sizes of the stiffness modes can each bear
themselves out: a large one saturates the field, and what is saturated says nothing against it. On two drops of the rabbit the size
fell to a twentieth in the ninth iteration, where the fit was done, and began again from a cost 20 times as large."""
SOFTLY = (0.05, 0.1, 0.25, 0.5)
"""Shares of the data that the first iterations on several drops count. Counted in full from the start, a few drops are explained by
sizes that later ones do not bear out, and the fit is half done when its iterations are over: see
docs/lab/2026-11-identification.md."""
SERVES = 3
"""Passes with one Jacobian, which costs as many rollouts as there are numbers, in the stage `prior_eta`, which is a comparison
alone. In the joint stage fewer Jacobians cost accuracy: docs/lab/2026-11-performance.md."""
FLAT = 0.5
"""Of minus the logarithm of the posterior: an iteration of the joint stage that lowers it by less, with the sizes settled, is the
last. Numbers that still move then lie on a floor that the data do not tell apart."""
COARSER = 1.25
"""Spacing of the second grid, on which the same numbers are rolled out to see what the first one gets wrong."""
MOST_THREADS = 8
PARTICLES_TOGETHER = 400_000
"""Of all worlds in one launch: more no longer make a GPU's substep cheaper for each."""
CLEAR = 2.0
"""Cells above the ground from which on nothing of a body meets it: a particle's weights reach 1.5."""
ROUNDED = 8
"""Substeps are held fixed within an iteration, at a multiple of this above what the time step bound asks for at its start."""
FINE, LOWER = 24, 0.5
"""Substeps from which on free rollouts of a law that flows or yields have exactly those of their numbers: 10 % more
move a von Mises cat farther than 20 % more stiffness. And how much lower a number is where its own are asked for."""
REMEMBERED = 8
"""Predictions that are kept, as an iteration begins where a step of the last one ended: of its steps, and of where it began."""
RIVAL_STEPS = 2
"""With the fitted law's Jacobian, from its numbers on: then their costs are within a tenth of the fitted law's mostly."""
IMPLAUSIBLE = 3.0
"""A rival whose cost is more than so many times the fitted law's does not explain the data."""


class Identification:
    """One stage's. takes: with start, cues, frame_dt; kinds: which of position, rotation, stretch are compared.

    The stage `prior` learns the backbone alone from positions, `prior_eta` also the stiffness modes, `joint` the adapter too. All
    compare predictions of the criterion; the calibration of a law that flows or yields, or with adaptive substeps, compares free
    rollouts.

    Errors of the grid must not be taken for the law's. The two later stages roll the same numbers out on a grid `COARSER` times as
    coarse too. The difference, frame by frame, is noise that no frame is trusted beyond, and its direction is free: a share of it,
    known to within `grid_error`, is identified beside the numbers and then dropped (a nuisance, marginalised out).

    parts: those of `search.parts` that the law may have; known: what another experiment said of its numbers, in place of the prior
    of those that are learned; progress: called after every column of a Jacobian; seats: rollouts side by side; None: as many as the
    machine has room for."""

    def __init__(
        self, body: Body, takes: Sequence, world: World, stage: Stage, criterion: Criterion, settings: IdentificationSettings,
        kinds: tuple[bool, bool, bool] = (True, True, True), progress: Callable[[], None] | None = None,
        seats: int | None = None, parts: Sequence[str] = PARTS,
        known: Posterior | None = None,
    ) -> None:  # fmt: skip
        self.body, self.takes, self.world, self.settings = body, list(takes), world, settings
        self.calibrating, self.iterations = stage.calibrates, stage.iterations
        self.compares = not stage.calibrates and not stage.learns_adapter
        self.adapter = stage.learns_adapter and is_learned(body.adapter) and "operator" in parts
        self.heterogeneity = (
            not self.calibrating and is_learned(body.heterogeneity) and "stiffness" in parts
        )
        marked = any(take is not None and isinstance(take.cues, MarkerCues) for take in self.takes)
        free = self.calibrating and (law_named(body.material.law).plastic or body.settings.adaptive)
        # a few points say neither where all the particles are nor how they are strained, and a
        # single camera does not see how they are along its lines of sight
        self.gains = (0.0,) if free or marked else criterion.gains
        self._free, self.follows = free and not body.settings.adaptive, False
        cues = [take.cues for take in self.takes if take is not None]
        self.few = residuals.fewer(cues)
        self.silhouettes = stage.silhouettes
        self.edges = [
            residuals.outlines(t.observations.mattes) for t in self.takes if stage.silhouettes
        ]
        alone = (self.calibrating or marked or any(each.single for each in cues)) and kinds[0]
        self.kinds = (True, False, False) if alone or stage.silhouettes else kinds
        if not any(self.kinds) and not world.forces:
            raise ConfigError(
                "losses: identification compares motion cues, and the weights of position, rotation and stretch are "
                "all 0; use fit=adam, which learns from images too"
            )
        columns_of(world.forces, world.solids)
        compared = self.takes[0].cues.positions.shape[1] if marked else len(body.rest)
        self.chosen = residuals.sampled(compared, body.rest.device)
        blocks = blocks_of(
            body, adapter=self.adapter, heterogeneity=self.heterogeneity, settings=settings, ground=world.ground,
            free=not any(self.gains), calibrating=self.calibrating,
        )  # fmt: skip
        self.gains = (0.0,) if self.silhouettes else self.gains
        seats = self.threads(sum(b.size for b in blocks)) if seats is None else seats
        bodies = [body][:seats] + [copy.deepcopy(body) for _ in range(seats - 1)]
        self.iteration, self.noise, self.substeps = 0, None, None
        self._remembered: OrderedDict[tuple, list[residuals.Fields]] = OrderedDict()
        self._lock = threading.Lock()
        self._flown: dict[tuple[int, float], tuple[Tensor, Rollout]] = {}
        # of every pair, on the coarser grid from those on the body's own
        self.grid_difference: list[residuals.Fields] | None = None
        if self.two_grids:
            sd = torch.full((1,), float(settings.grid_error))
            blocks.append(Block("grid", torch.zeros(1), sd, 0.2, nuisance=True))
        many = self._many if body.rest.is_cuda and not body.settings.adaptive else None
        own = [self._seat(each) for each in bodies]
        self.newton = GaussNewton(blocks, own, progress=progress, many=many)
        if known is not None and (shared := known.only(self.newton.names())).names:
            self.newton.known = shared
        self.converged = False
        self.report: dict[str, float] = {}
        # at the numbers as they stand, between `prepare` and `iterate`
        self._residuals: Tensor | None = None
        # (R, D) of the first pass, where another stage has made it (`NewtonSteps.share_columns`)
        self.first: Tensor | None = None

    def threads(self, numbers: int) -> int:
        """Rollouts side by side, of as many numbers."""
        if self.body.rest.is_cuda:
            return 1
        return max(1, min(self.settings.threads or min(cores(), MOST_THREADS), numbers))

    def _seat(self, body: Body) -> Seat:
        share = torch.zeros(1, dtype=torch.float64)
        tensors = tensors_of(body, adapter=self.adapter, heterogeneity=self.heterogeneity)
        if self.two_grids:
            tensors.append(share)
        return Seat(
            tensors,
            lambda: self._whitened(body, float(share)),
            None if body.settings.adaptive else lambda: self._asked(body),
            lambda: self._whitened(body, float(share), flown=True),
        )

    def _asked(self, body: Body) -> list[int]:
        """Substeps of each take. Errors: ConfigError where the numbers ask for more than `max_substeps`. An iteration that holds
        those of its beginning would not see it; the next one, and whoever simulates the law, could not go on."""
        return [self.ready(body, i).simulator.substeps for i in range(len(self.takes))]

    @property
    def parts(self) -> list[str]:
        """Those of `search.parts` that are learned here."""
        return [part for part, on in zip(PARTS, (self.adapter, self.heterogeneity)) if on]

    @property
    def two_grids(self) -> bool:
        """Whether there is a second grid, and with it a last number: the share of their difference."""
        return self.settings.grid_error > 0 and not self.calibrating

    @property
    def softly(self) -> tuple[float, ...]:
        """Shares of the data that the first iterations count, all of it afterwards. A calibration, one drop, and a stage too short
        for it count in full."""
        long = self.iterations >= 2 * len(SOFTLY)
        return SOFTLY if len(self.takes) > 1 and not self.calibrating and long else ()

    @property
    def pairs(self) -> list[tuple[int, float]]:
        """(take, gain) of every rollout that is compared."""
        return [(i, gain) for i in range(len(self.takes)) for gain in self.gains]

    @torch.no_grad()
    def ready(self, body: Body, index: int, substeps: int | None = None) -> Ready:
        """The body at the start of a take, with what is learned here."""
        take = self.takes[index]
        model = body.model().only(heterogeneity=self.heterogeneity, adapter=self.adapter)
        frames, frame_dt = len(take.cues.positions), take.frame_dt
        return body.ready(take.start, self.world, frames, frame_dt, model=model, substeps=substeps)

    @torch.no_grad()
    def rollout(self, body: Body, index: int, gain: float = 0.0, substeps: int | None = None):
        return self._simulated(self.ready(body, index, substeps), self.takes[index], gain)

    def _simulated(
        self, ready: Ready, take, gain: float, frames: int | None = None, begun: Rollout | None = None
    ) -> Rollout:  # fmt: skip
        """frames: how many, None for all; begun: see `Ready.simulate`."""
        seen, solids = take.cues.positions[:frames], self.world.solids
        unseen = residuals.unseen(take.cues, take.response)
        observed = seen if gain else None
        return ready.simulate(
            len(seen), solids, observed=observed, gain=gain, unseen=unseen, begun=begun
        )

    @torch.no_grad()
    def _flights(self) -> dict[tuple[int, float], tuple[Tensor, Rollout]]:
        """By pair: the contact's offset (3,) [m], and the frames in which the body is seen more than `CLEAR` cells above the
        ground. The law's numbers hardly change these, so rollouts for a Jacobian begin after them. Empty where something else than
        the ground may be met, and where columns are rolled out as so many worlds."""
        world, flights = self.world, {}
        alone = world.ground is not None and not (world.planes or world.solids or world.driven)
        if not alone or self.newton.many is not None or self.body.settings.adaptive:
            return flights
        for i, gain in self.pairs:
            take, clear = self.takes[i], CLEAR * self.body.settings.dx
            if isinstance(take.cues, MarkerCues) or take.start.loads:
                continue
            high = (take.cues.positions @ world.up.to(take.cues.positions)).amin(1)
            low = (high < world.ground.height + clear).nonzero()
            frames = int(low[0]) if len(low) else len(high)
            if frames > 1:
                ready = self.ready(self.body, i, self.substeps[i])
                flights[i, gain] = ready.lift, self._simulated(ready, take, gain, frames)
        return flights

    @torch.no_grad()
    def _many(self, rows: Tensor) -> Tensor:
        """(K, R) whitened residuals of numbers (K, D): rolled out side by side, as so many worlds."""
        seat, together = self.newton.seats[0], max(1, PARTICLES_TOGETHER // len(self.body.rest))
        found: list[list[residuals.Fields]] = [[] for _ in rows]
        for first in range(0, len(rows), together):
            some = rows[first : first + together]
            for i, gain in self.pairs:
                take, parts = self.takes[i], []
                for row in some:
                    seat.write(row)
                    parts.append(self.ready(self.body, i, self.substeps[i]).answered())
                rollout = self._simulated(Ready.stack(parts), take, gain)
                for k, own in enumerate(rollout.worlds()):
                    found[first + k].append(self._differences(own, i))
        shares = rows[:, -1].tolist() if self.two_grids else [0.0] * len(rows)
        return torch.stack([self._compared(own, share) for own, share in zip(found, shares)])

    def _fields(self, body: Body, flown: bool = False) -> list[residuals.Fields]:
        """Of every pair; those that were found last are remembered. flown: from the end of the `_flights` on."""
        numbers = tensors_of(body, adapter=self.adapter, heterogeneity=self.heterogeneity)
        place = torch.cat([t.detach().double().cpu().flatten() for t in numbers]).tolist()
        own = self.follows and not flown and body.settings.dx == self.body.settings.dx
        substeps = self._asked(body) if own else self.substeps
        key = (body.material.law, body.settings.dx, *substeps, *place)
        with self._lock:
            found = self._remembered.get(key)
        if found is None:
            found = []
            for i, gain in self.pairs:
                ready, take = self.ready(body, i, substeps[i]), self.takes[i]
                lift, begun = self._flown.get((i, gain), (None, None)) if flown else (None, None)
                if lift is None or not torch.equal(lift, ready.lift):
                    begun = None
                rollout = self._simulated(ready, take, gain, begun=begun)
                found.append(self._differences(rollout, i))
            with self._lock:
                self._remembered[key] = found
                while len(self._remembered) > REMEMBERED:
                    self._remembered.popitem(last=False)
        return found

    def _differences(self, rollout: Rollout, index: int) -> residuals.Fields:
        """Of a rollout from what was seen of take `index`, and from the forces measured there."""
        take = self.takes[index]
        if self.silhouettes:
            return residuals.silhouettes(
                rollout.x, self.body.spacing, take.observations, self.edges[index]
            )
        curves, turn = curves_of(self.world.forces, take.name, index == 0), take.start.rotation
        found = residuals.fields(rollout, take.cues, turn, self.chosen, take.response)
        if not curves:
            return found
        force = force_residuals(rollout, curves, self.world, take.frame_dt)
        return replace(found, force=force)

    def _whitened(self, body: Body, grid_share: float, flown: bool = False) -> Tensor:
        # torch's switch is a thread's own, and these may be other threads than the one that switched it
        with torch.no_grad():
            return self._compared(self._fields(body, flown), grid_share)

    def _share(self) -> float:
        """Independent data that a frame counts as, of each kind."""
        counted = COUNTED_AT_FIRST if self.calibrating else 1
        return self.settings.count / len(self.gains) * counted * self._soft()

    def _soft(self) -> float:
        """Share of the data that this iteration counts."""
        return self.softly[self.iteration] if self.iteration < len(self.softly) else 1.0

    def _compared(self, found: list[residuals.Fields], grid_share: float) -> Tensor:
        counts = [tuple(self._share() * on for on in self.kinds)] * len(self.pairs)
        forces = self._soft() / len(self.gains)
        return residuals.whitened(self._along(found, grid_share), self.noise, counts, forces)

    def _along(self, found: list[residuals.Fields], grid_share: float) -> list[residuals.Fields]:
        difference = self.grid_difference
        return found if difference is None else residuals.along(found, difference, grid_share)

    def grid_share(self) -> float:
        """Of the difference between the two grids, which is identified beside the numbers; 0 where none is."""
        return float(self.newton.seats[0].tensors[-1]) if self.two_grids else 0.0

    def _coarser(self) -> Body:
        """A copy of the body on a coarser grid."""
        body = copy.deepcopy(self.body)
        body.settings = body.settings.but(dx=COARSER * body.settings.dx)
        return body

    @torch.no_grad()  # a thread has its own switch
    def _predicted(self, body: Body) -> list[residuals.Fields] | None:
        """Of the body, or of its copy on a coarser grid; None where that cannot simulate the numbers."""
        try:
            return self._fields(body)
        except SimulationDiverged:
            if body is self.body:
                raise
            return None

    def _floors(self, cells: float) -> tuple[float, float, float]:
        return residuals.floors(self.body.settings.dx, cells, self.few)

    @torch.no_grad()
    def _measure_noise(self) -> None:
        """Noise and what the grid gets wrong, at the numbers in use."""
        bodies = [self.body, self._coarser()] if self.two_grids else [self.body]
        found, *others = (threaded if self.body.rest.is_cpu else map)(self._predicted, bodies)
        if others and others[0] is not None:
            self.grid_difference = residuals.difference(found, others[0])
        model_error = 0.0 if self.calibrating else self.settings.model_error
        least = self._floors(model_error)
        wrong = self.grid_difference and [
            residuals.Fields(*(self.settings.grid_error * field for field in each))
            for each in self.grid_difference
        ]
        self.noise = residuals.spread(self._along(found, self.grid_share()), least, wrong)

    @property
    def offsets(self) -> tuple[float | None, ...]:
        """Contact offsets [cells] of the search's grid; None: keep it, as its prior is narrow."""
        contact = self.body.contact
        dx, free = self.body.settings.dx, not any(self.gains)
        sd, (low, high) = contact.prior(self.world.ground, dx, free)
        if not contact.enabled or sd <= contact.NARROW:
            return (None,)
        return tuple(cells for cells in OFFSET_STEPS if low <= cells <= high)

    def search(self) -> float:
        """Start a calibration near its end (`search.backbone`); the score [m] there. Errors: SimulationDiverged."""
        return search(self)

    @torch.no_grad()
    def score(self, gains: Sequence[float] | None = None, body: Body | None = None) -> float:
        """Error of the predictions [m] with these gains, by default the stage's own, of the body or a copy: the geometric mean over
        the frames after the first of the root mean square distance over particles, above the floor of the noise.

        This is the likelihood of the positions where each frame has an unknown noise of its own, so that frames which no law
        predicts do not decide. Of free rollouts it is `distance`."""
        gains = gains or self.gains
        body = self.body if body is None else body
        if not any(gains):
            return self.distance(body)
        least = 3 * self._floors(self.settings.model_error)[0] ** 2
        logarithms = []
        for i, gain in itertools.product(range(len(self.takes)), gains):
            away = self.takes[i].cues.away(self.rollout(body, i, gain).x)
            square = away[1:].square().sum(-1).mean(-1).double() + least
            logarithms.append(0.5 * float(square.log().mean()))
        return math.exp(sum(logarithms) / len(logarithms))

    @torch.no_grad()
    def distance(self, body: Body | None = None) -> float:
        """Mean distance [m] of free rollouts from the cues after frame 0, of the body or a copy."""
        body = self.body if body is None else body
        found = [take.cues.away(self.rollout(body, i).x) for i, take in enumerate(self.takes)]
        return sum(float(d[1:].norm(dim=-1).mean()) for d in found) / len(found)

    def _hold_substeps(self) -> None:
        """Substeps are a step function of the numbers: held fixed, differences are those of a smooth function."""
        body = self.body
        if body.settings.adaptive:  # then only a rollout tells how many it takes
            asked = [self.rollout(body, i).substeps for i in range(len(self.takes))]
        else:
            asked = self._asked(body)
        self.follows = self._free and min(asked) >= FINE
        rounded = [-(-int(1.05 * count) // ROUNDED) * ROUNDED for count in asked]
        self.substeps = asked if self.follows else rounded

    def _following(self, r: Tensor) -> Tensor:
        """(R, D) the Jacobian at residuals r (R,), with what the numbers do through their substeps."""
        newton, seat, held = self.newton, self.newton.seats[0], self.substeps
        numbers, newton.columns = seat.read(), None
        J, slopes = newton.jacobian(numbers, r), []
        for lower in numbers - LOWER * torch.eye(len(numbers)):
            seat.write(lower)
            slopes.append(sum(math.log(n / k) for n, k in zip(held, self._asked(self.body))))
        seat.write(numbers)
        self.substeps = [n + ROUNDED * (1 + n // 100) for n in held]
        more = LOWER * sum(math.log(k / n) for n, k in zip(held, self.substeps))
        effect = self._whitened(self.body, self.grid_share(), flown=True) - r
        self.substeps = held
        return J.addr_(effect, J.new_tensor(slopes) / more)

    @torch.no_grad()
    def prepare(self) -> float:
        """What the next iteration holds fixed (substeps, noise), and the cost at the numbers as they stand."""
        self._hold_substeps()
        if self.iteration < NOISE_ITERATIONS or self.noise is None:
            self._measure_noise()
        if self.calibrating and not self.silhouettes and self.newton.known is not None:
            self.newton.borne = self.independent()
        self._flown = self._flights()
        seat = self.newton.seats[0]
        self._residuals = seat.residuals()
        return self.newton.cost(seat.read(), self._residuals)

    @torch.no_grad()
    def columns(self) -> Tensor:
        """(R, D) the Jacobian of the first pass."""
        self.prepare()
        return self.newton.jacobian(self.newton.seats[0].read(), self._residuals)

    @torch.no_grad()
    def iterate(self) -> dict[str, float]:
        """One iteration of Gauss-Newton: a pass, or, in the stage `prior_eta`, `SERVES` with one Jacobian, each under its own
        noise. Returns the last one's report (`GaussNewton.iterate`). `prepare` comes before it, or is done here."""
        first, self.first = self.first, None
        report = self._pass(first)
        for _ in range(SERVES - 1 if self.compares else 0):
            if self.converged or report["share"] == 0:
                break
            report = self._pass(self._served())
        return report

    def _served(self) -> Tensor:
        """The last pass's Jacobian under the noise of the next one, for which all is prepared."""
        ones = [
            residuals.Fields(
                *map(torch.ones_like, each),
                None if each.force is None else torch.ones_like(each.force),
            )
            for each in self._fields(self.body)
        ]

        def units() -> Tensor:
            return residuals.whitened(ones, self.noise, [(1.0, 1.0, 1.0)] * len(ones))

        before, J = units(), self.newton.columns
        self.prepare()
        J *= (units() / before)[:, None]
        if self.two_grids:  # residuals are linear in the share of their difference
            there = self._compared(self._fields(self.body), self.grid_share() + 1)
            J[:, -1] = there - self._residuals
        return J

    def _pass(self, J: Tensor | None = None) -> dict[str, float]:
        """Steps with one Jacobian (R, D), None for a new one."""
        if self._residuals is None:
            self.prepare()
        r, self._residuals = self._residuals, None
        learn = 1 <= self.iteration < EVIDENCE_ITERATIONS
        settled = self.iteration >= NOISE_ITERATIONS and not self.calibrating
        J = self._following(r) if J is None and self.follows else J
        report = self.report = self.newton.iterate(learn=learn, r=r, settled=settled, J=J)
        self.iteration += 1
        step = report["length"] * report["share"]
        small = self.iteration > NOISE_ITERATIONS and step < self.settings.tolerance
        gained = report["before"] - report["after"]
        flat = self.iteration > EVIDENCE_ITERATIONS and not self.calibrating and gained < FLAT
        whole = not self.softly or self.iteration > len(self.softly) + 1
        self.converged = whole and (small or flat or report["share"] == 0)
        return report

    def iterate_until_converged(self, most: int) -> None:
        """At most so many iterations; `report` is that of the last one."""
        for _ in range(most):
            self.iterate()
            if self.converged:
                break

    def state(self) -> dict:
        """Plain containers and tensors: what going on from a checkpoint needs beside the body."""
        return {
            "iteration": self.iteration,
            "factors": [b.factor for b in self.newton.blocks],
            "noise": self.noise and [[t.cpu() for t in each] for each in self.noise],
            "multiple": self.grid_share(),
            "grid": self.grid_difference
            and [[t.cpu() for t in each] for each in self.grid_difference],
        }

    def restore(self, state: dict) -> None:
        """As after the iterations that `state` was taken from, but for whether the last of them ended it."""
        self.iteration, self.converged = int(state["iteration"]), False
        for block, factor in zip(self.newton.blocks, state["factors"], strict=True):
            block.factor = float(factor)
        device = self.body.rest.device
        found = state["noise"]
        self.noise = found and [tuple(t.to(device) for t in each) for each in found]
        if state.get("grid") is not None:
            self.grid_difference = [
                residuals.Fields(*(t.to(device) for t in each)) for each in state["grid"]
            ]
        if self.two_grids:
            self.newton.seats[0].tensors[-1].fill_(float(state.get("multiple", 0.0)))

    @torch.no_grad()
    def posterior(self) -> Posterior:
        """Laplace's approximation at what was found, with the root mean square distance of free rollouts from the cues after first
        contact as the model's error.

        Of a calibration the data count for no more than its residuals say (see `independent`). What the grid gets wrong moves what
        it finds, as its search leaves that out: how far, the coarser grid says."""
        found = []
        for i, take in enumerate(self.takes):
            away = take.cues.away(self.rollout(self.body, i).x)
            found.append(float(away[take.first_contact :].square().sum(-1).mean()))
        share, wrong = 1.0, None
        if self.calibrating and self.noise is not None:
            there = self._fields(self.body)
            share, wrong = self.independent(there), self._grids_part(there)
        posterior = self.newton.posterior(share, wrong)
        error = (sum(found) / len(found)) ** 0.5
        return replace(posterior, model_error=error, rivals=self.rivals())

    def _grids_part(self, there: list[residuals.Fields]) -> Tensor | None:
        """Of a calibration: `grid_error` times the difference of `there`, its residuals where it stands, from those on the coarser
        grid, whitened as these are. None without a second grid."""
        coarser = self._predicted(self._coarser()) if self.settings.grid_error > 0 else None
        if coarser is None:
            return None
        return self.settings.grid_error * self._compared(residuals.difference(there, coarser), 0.0)

    @torch.no_grad()
    def rivals(self) -> dict[str, Tensor]:
        """Numbers (D,) of the laws of another form that explain the data about as well, by name: two steps from what was found,
        with the same Jacobian. None beside laws that are not of `RIVALS`, and none of a calibration."""
        own, newton = self.body.material.law, self.newton
        if self.calibrating or own not in RIVALS:
            return {}
        numbers = newton.seats[0].read()
        kept = len(numbers) - self.two_grids  # the share of the grids is last
        own_cost = self.cost()

        def tried(body: Body, law: str) -> Tensor | None:
            body.material.law = law
            seat = self._seat(body)
            seat.write(numbers)
            try:
                found, cost = newton.transferred(RIVAL_STEPS, seat)
            except MosaError:  # it cannot be simulated there
                return None
            finally:
                body.material.law = own
            return found[:kept] if cost < IMPLAUSIBLE * own_cost else None

        others = [law for law in RIVALS if law != own]
        found = zip(others, apart(self.body, others, tried))
        return {law: each for law, each in found if each is not None}

    @torch.no_grad()
    def held_back(self) -> dict[str, float]:
        """Error of held-back frames [m] of the law and of each law with fewer of its parts, see `search.parts`. Measured forces are
        never held back. Empty before the first iteration, and where forces alone are compared."""
        newton, seat = self.newton, self.newton.seats[0]
        if newton.columns is None or self.noise is None or not any(self.kinds):
            return {}
        columns, r = newton.columns, seat.residuals()[:, None].to(newton.columns)
        squares: list[Tensor] = []
        positions: list[tuple[Tensor, float, float | None]] = []
        stretches: list[list[int]] = [[] for _ in range(FOLDS * len(self.takes))]
        kind = 0 if self.kinds[0] else self.kinds.index(True)
        width, first = 3 * len(self.chosen), 0
        felt = [each.force for each in self._fields(self.body)]
        forces: list[Tensor] = []

        def gram(first: int, count: int) -> Tensor:
            rows = slice(first, first + count)
            table = torch.cat([columns[rows], r[rows]], 1).double()
            return (table.mT @ table).cpu()

        for k, ((i, _), scales) in enumerate(zip(self.pairs, self.noise)):
            frames = len(scales[0])
            wrong = self._between_grids(k, kind)
            # the rows of a field's frame after each other; those of the forces follow, as in `whitened`
            every = [gram(first + width * n, width) for n in range(3 * frames)]
            first += 3 * frames * width
            if (force := felt[k]) is not None:
                forces.append(gram(first, len(force)))
                first += len(force)
            for frame in range(frames):
                grams = every[frame::frames]
                after = frame - (self.takes[i].first_contact - 1)
                if after >= 0:
                    late = frames - self.takes[i].first_contact + 1
                    stretches[FOLDS * i + FOLDS * after // late].append(len(squares))
                count = self._share() * self.kinds[kind]
                unit = float(scales[kind][frame]) / count**0.5
                between = None if wrong is None else float(wrong[frame])
                positions.append((grams[kind], unit, between))
                squares.append(grams[0] + grams[1] + grams[2])
        told = squares + forces
        compared = {k: (len(told) + k, *lengths) for k, (_, *lengths) in enumerate(positions)}
        owners = [block.name for block in newton.blocks for _ in range(block.size)]
        return held_back(
            told + [gram for gram, *_ in positions], owners, seat.read(), newton.mean(), newton.precision(),
            [stretch for stretch in stretches if stretch], compared,
        )  # fmt: skip

    def _between_grids(self, pair: int, kind: int) -> Tensor | None:
        """(frames,) root mean square distance over particles between the predictions on two grids,
        `grid_error` times, and how much farther off the cues of few cameras are; None without a second grid."""
        if self.grid_difference is None:
            return None
        field = self.settings.grid_error * list(self.grid_difference[pair])[kind]
        cues = 3 * residuals.CUE_ERRORS[kind] ** 2 * (self.few**2 - 1)
        return (field.square().sum(-1).mean(-1) + cues).sqrt()

    def cost(self) -> float:
        """Minus the logarithm of the posterior at the numbers in use, but for a constant, under the noise in use."""
        seat = self.newton.seats[0]
        return self.newton.cost(seat.read(), seat.residuals())

    def independent(self, there: list[residuals.Fields] | None = None) -> float:
        """Share of the data that a calibration counts which its residuals bear out, in (0, 1]. there: these residuals, where they
        are known.

        What a free rollout leaves beyond the cues' own noise is what grid, contact and the law's form get wrong: a few smooth
        patterns in all the frames together (`residuals.patterns`), and not `count` independent errors in every one of them."""
        each = COUNTED_AT_FIRST * self.settings.count / len(self.gains)
        cues = 3 * self._floors(0.0)[0] ** 2
        counted, wrong, late = 0.0, 0.0, []
        share = 1 / len(self.pairs)
        for (i, _), scales, found in zip(self.pairs, self.noise, there or self._fields(self.body)):
            frames = slice(min(self.takes[i].first_contact, len(scales[0])) - 1, None)
            wrong += share * (1 - cues / float(scales[0][frames].square().mean()))
            counted += each * len(scales[0][frames])
            late.append(residuals.Fields(*(field[frames] for field in found)))
        borne = len(late) * max(1.0, residuals.patterns(late))
        return 1 / (1 + max(0.0, wrong) * max(0.0, counted / borne - 1))
