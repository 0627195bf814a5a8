"""Gauss-Newton for the few numbers of a law: it moves what the data determine and leaves the rest where the prior has it.

Minimises 1/2 |r(theta)|^2 + 1/2 sum ((theta - mean)/sd)^2 with columns of the Jacobian by one-sided differences. The standard
deviations of whole blocks are found from the data (MacKay, Bayesian interpolation, Neural Computation 4, 1992), and the inverse of
the last matrix is the Laplace approximation of the posterior.

A Jacobian costs a rollout for every number, a step one. So several steps are taken with one Jacobian, which each of them puts right
along its own direction (Broyden, A class of methods for solving nonlinear simultaneous equations, 1965): where columns are a little
wrong and residuals are not small, Gauss-Newton alone stops short of the minimum."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mosa.errors import MosaError, SimulationDiverged
from mosa.system.limits import counted
from mosa.types import in_brief

SHORTER, SHORTEST = 0.4, 0.05
"""A step that does not improve is tried again so much shorter; one of fewer standard deviations of the posterior is not tried."""
KNOWN = 1e-6
"""Standard deviation of numbers that a model does without, which draws of a posterior need."""
ROWS = 65_536
"""Of a Jacobian that are in float64 at a time."""
EVIDENCE_PASSES = 20
"""Of the fixed point for the sizes of the blocks: each costs one inverse of a matrix of all numbers."""
NEWTON_STEPS = 12
"""For one of these sizes: from the lower limit they end within 1e-9 of the root."""


@dataclass
class Block:
    """Numbers of one kind. mean, sd: of their prior, (n,); step: of differences; bounds: they are held within; learned: whether
    evidence finds the common factor of the sd, within `limits`; spread: prior standard deviation of that factor's logarithm;
    nuisance: they are no part of the model, and the posterior is that of the others whatever these are."""

    name: str
    mean: Tensor
    sd: Tensor
    step: float
    learned: bool = False
    bounds: tuple[float, float] = (-math.inf, math.inf)
    limits: tuple[float, float] = (0.03, 5.0)
    spread: float = math.inf
    factor: float = 1.0
    nuisance: bool = False

    def __post_init__(self) -> None:
        self.mean, self.sd = (t.detach().double().cpu().flatten() for t in (self.mean, self.sd))

    @property
    def size(self) -> int:
        return len(self.mean)

    def fitted(self, squares: float, determined: float) -> float:
        """The factor f where the evidence and f's own prior balance: squares/f^2 - determined = log(f)/spread^2. squares: of the
        numbers over their sd; determined: how many of them the data determine."""
        if not (self.learned and determined > 1e-6 and squares > 0):
            return self.factor
        logarithm = max(0.5 * math.log(squares / determined), math.log(self.limits[0]))
        if math.isfinite(self.spread):
            # The left side less the right one is convex and falls: from below, Newton's steps stay below the root.
            logarithm, precision = min(logarithm, 0.0), self.spread**-2
            for _ in range(NEWTON_STEPS):
                own = squares * math.exp(-2 * logarithm)
                logarithm += (own - determined - precision * logarithm) / (2 * own + precision)
        return min(max(math.exp(logarithm), self.limits[0]), self.limits[1])


@dataclass
class Seat:
    """A model that can be moved and asked. tensors: its parameters, one for each block; residuals: a vector, of the numbers that
    stand in them; it may raise MosaError, and so may possible, where a fit must not stay at these numbers; moved: residuals for a
    column, where they can be had for less. Seats share nothing that either writes to: each has a thread of its own."""

    tensors: Sequence[Tensor]
    residuals: Callable[[], Tensor]
    possible: Callable[[], object] | None = None
    moved: Callable[[], Tensor] | None = None

    def read(self) -> Tensor:
        """(D,) float64 on the CPU."""
        return torch.cat([t.detach().double().cpu().flatten() for t in self.tensors])

    @torch.no_grad()
    def write(self, numbers: Tensor) -> None:
        parts = numbers.split([t.numel() for t in self.tensors])
        for tensor, part in zip(self.tensors, parts):
            tensor.copy_(part.reshape(tensor.shape).to(tensor))


@dataclass
class Posterior:
    """mean (D,), covariance (D, D) float64 of the numbers of `names`; `determined` (D,) in [0, 1]: the share of each number's
    precision that comes from the data and not from its prior; model_error [m]: distance of the identified model from what was seen;
    rivals: numbers (D,) at which laws of another form explain the data too, by name."""

    __repr__ = in_brief

    names: list[str]
    mean: Tensor
    covariance: Tensor
    determined: Tensor
    model_error: float = 0.0
    rivals: dict[str, Tensor] = field(default_factory=dict)

    def written(self) -> dict:
        """Plain containers, fit for a checkpoint; `read` gives the same numbers."""
        return vars(self) | {"names": list(self.names), "rivals": dict(self.rivals)}

    @classmethod
    def read(cls, written: dict) -> Posterior:
        tensors = (written[name].double() for name in ("mean", "covariance", "determined"))
        rivals = {name: numbers.double() for name, numbers in written.get("rivals", {}).items()}
        return cls(list(written["names"]), *tensors, float(written["model_error"]), rivals)

    def only(self, names: Sequence[str]) -> Posterior:
        """Of those of its numbers that are among `names`, whatever the others are."""
        kept = [i for i, name in enumerate(self.names) if name in names]
        names, covariance = [self.names[i] for i in kept], self.covariance[kept][:, kept]
        mean, determined = self.mean[kept], self.determined[kept]
        return Posterior(names, mean, covariance, determined, self.model_error)

    def among(self, names: Sequence[str]) -> Posterior:
        """The same numbers among `names`, of which the others are 0 and not learned."""
        place = [names.index(name) for name in self.names]

        def spread(numbers: Tensor) -> Tensor:
            whole = torch.zeros(len(names), dtype=numbers.dtype)
            whole[place] = numbers
            return whole

        covariance = torch.diag(torch.full((len(names),), KNOWN**2, dtype=torch.float64))
        covariance[torch.tensor(place)[:, None], torch.tensor(place)] = self.covariance
        rivals = {name: spread(numbers) for name, numbers in self.rivals.items()}
        mean, determined = spread(self.mean), spread(self.determined)
        return Posterior(list(names), mean, covariance, determined, self.model_error, rivals)

    def draws(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """(count, D) float64. generator: of the random numbers; None: one with seed 0, so that the same draws come every time."""
        counted("draws", (count, len(self.mean)), "take fewer", each=3 * 8)
        generator = torch.Generator().manual_seed(0) if generator is None else generator
        L = torch.linalg.cholesky(self.covariance)
        z = torch.randn(count, len(self.mean), generator=generator, dtype=torch.float64)
        return self.mean + z @ L.T


def _length(step: Tensor, matrix: Tensor) -> float:
    """Of a step (D,), in standard deviations of the posterior with that matrix (D, D)."""
    return float((step @ matrix @ step).clamp(min=0).sqrt())


def normal_equations(J: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """(J^T J, J^T r) of J (R, D) and r (R,), float64 on the host and summed in float64.

    Sums in float32 lose what films tell beside a measured force, whose residuals are thousands of times as steep: J^T J then has
    negative eigenvalues, and there is no posterior."""
    H = J.new_zeros(J.shape[1], J.shape[1], dtype=torch.float64)
    g = H.new_zeros(J.shape[1])
    for rows, residuals in zip(J.split(ROWS), r.split(ROWS)):
        wide = rows.double()
        H += wide.T @ wide
        g += wide.T @ residuals.double()
    return H.cpu(), g.cpu()


@dataclass
class GaussNewton:
    """One or more seats of the same model; the first one holds the result. steps: tried with one Jacobian at most; progress: called
    after every column; many: (K, R) residuals of K rows of numbers (K, D) at once, where the columns of a Jacobian shall not be
    asked for one by one; known: of some of the numbers, their prior in place of the blocks'."""

    blocks: list[Block]
    seats: list[Seat]
    steps: int = 6
    progress: Callable[[], None] | None = None
    many: Callable[[Tensor], Tensor] | None = None
    known: Posterior | None = None
    borne: float = 1.0
    """Share of the data's precision that a posterior will count. The known numbers weigh more by its
    inverse while they are fitted, so that what is found is the mean of that posterior."""
    matrix: Tensor | None = field(default=None, init=False)
    data: Tensor | None = field(default=None, init=False)
    columns: Tensor | None = field(default=None, init=False)
    """The last iteration's Jacobian (R, D), as its steps have put it right."""

    def _vector(self, get: Callable[[Block], Tensor | float]) -> Tensor:
        return torch.cat(
            [torch.as_tensor(get(b), dtype=torch.float64).expand(b.size) for b in self.blocks]
        )

    def mean(self) -> Tensor:
        """(D,) of the prior."""
        mean = self._vector(lambda b: b.mean)
        if self.known is not None:
            mean[self._places()] = self.known.mean.double()
        return mean

    def precision(self, borne: float | None = None) -> Tensor:
        """(D, D) of the prior. borne: share that the known numbers are weighed for, None for the fit's;
        1.0: as the other experiment has them."""
        precision = torch.diag(1 / self._vector(lambda b: b.sd * b.factor).square())
        if self.known is not None:
            at = self._places()
            known = torch.linalg.inv(self.known.covariance.double())
            precision[at[:, None], at] = known / (self.borne if borne is None else borne)
        return precision

    def _places(self) -> Tensor:
        """Of the known numbers."""
        names = self.names()
        return torch.tensor([names.index(name) for name in self.known.names])

    def clamped(self, numbers: Tensor) -> Tensor:
        """Within the blocks' bounds."""
        low, high = (self._vector(lambda b, i=i: b.bounds[i]) for i in (0, 1))
        return torch.minimum(torch.maximum(numbers, low), high)

    def cost(self, numbers: Tensor, r: Tensor) -> float:
        """Minus the logarithm of the posterior, up to a constant."""
        away = numbers - self.mean()
        return 0.5 * float(r.square().sum()) + 0.5 * float(away @ self.precision() @ away)

    def jacobian(self, numbers: Tensor, r: Tensor) -> Tensor:
        """(R, D) of the type and on the device of r (R,): one residual vector per column, the columns shared among the seats."""
        steps, highest = self._vector(lambda b: b.step), self._vector(lambda b: b.bounds[1])
        steps = torch.where(numbers + steps > highest, -steps, steps)
        if self.many is not None:
            try:
                return ((self.many(numbers + torch.diag(steps)) - r) / steps.to(r)[:, None]).T
            finally:
                self.seats[0].write(numbers)
        J = torch.empty(len(numbers), len(r), dtype=r.dtype, device=r.device)
        # the grid's multiple, the last, needs no rollout while the prediction here is remembered
        left, lock = iter(reversed(range(len(numbers)))), threading.Lock()
        over = threading.Event()

        def work(seat: Seat) -> None:
            while True:
                with lock:
                    i = next(left, None)
                if i is None or over.is_set():
                    return
                moved = numbers.clone()
                moved[i] += steps[i]
                seat.write(moved)
                J[i] = ((seat.moved or seat.residuals)() - r) / float(steps[i])
                if self.progress is not None:
                    with lock:
                        self.progress()

        try:
            if len(self.seats) == 1:
                work(self.seats[0])
            else:
                with ThreadPoolExecutor(len(self.seats)) as pool:
                    try:
                        for future in [pool.submit(work, seat) for seat in self.seats]:
                            future.result()
                    finally:  # after an error or Ctrl-C the others end with the column they are at
                        over.set()
        finally:
            for seat in self.seats:
                seat.write(numbers)
        return J.T

    @torch.no_grad()
    def iterate(
        self, learn: bool = True, settled: bool = True, r: Tensor | None = None, J: Tensor | None = None
    ) -> dict[str, float]:  # fmt: skip
        """One iteration from where the first seat stands. learn: update the blocks' factors by the evidence first; settled: whether
        what is compared stays as it is, so that steps after the first that improves are worth their while; r: (R,) the residuals
        there, where they are known; J: (R, D) a Jacobian that serves again, None for a new one.

        Returns cost before and after, the way that was gone over the length of the first step (0: no step improved), that length in
        standard deviations of the posterior, and each learned block's factor. Errors: SimulationDiverged where a column fails."""
        seat = self.seats[0]
        numbers = seat.read()
        for other in self.seats[1:]:
            other.write(numbers)
        r = seat.residuals() if r is None else r
        self.columns = J  # None before the next are made: one Jacobian is in memory at a time
        J = self.columns = self.jacobian(numbers, r) if J is None else J
        H, g = normal_equations(J, r)
        if not bool(torch.isfinite(H).all()):
            raise SimulationDiverged("Gauss-Newton: no finite Jacobian; start from another prior")
        away = numbers - self.mean()
        if learn:
            self._evidence(away, H, g)
        precision, begun = self.precision(), numbers
        before = after = self.cost(numbers, r)
        first = M = H + precision
        length, trust = 0.0, 1.0
        for i in range(self.steps):
            direction = torch.linalg.solve(M, -(g + precision @ (numbers - self.mean())))
            proposed = _length(direction, M)
            length = proposed if i == 0 else length
            moved = self.clamped(numbers + trust * direction)
            step = moved - numbers
            if trust * proposed < SHORTEST or not bool(step.any()):
                break
            seat.write(moved)
            try:
                if seat.possible is not None:
                    seat.possible()
                there = seat.residuals()
            except MosaError:
                there = None
            if there is None or not math.isfinite(cost := self.cost(moved, there)):
                trust *= SHORTER
                continue
            improved = cost < after
            if improved and not settled:
                numbers, after = moved, cost
                break
            weights = M @ step
            # in place: an outer product by itself would be as large as the Jacobian
            J.addr_(there - r - J @ step.to(r), (weights / (step @ weights)).to(r))
            if improved:
                numbers, r, after, trust = moved, there, cost, min(1.0, 2 * trust)
            else:
                trust *= SHORTER
            H, g = normal_equations(J, r)
            M = H + precision
        seat.write(numbers)
        self.matrix, self.data = M, H
        share = _length(numbers - begun, first) / length if length > 0 else 0.0
        return {"before": before, "after": after, "share": share, "length": length} | {
            f"sd/{b.name}": b.factor * float(b.sd.mean()) for b in self.blocks if b.learned
        }

    @torch.no_grad()
    def transferred(self, steps: int, seat: Seat) -> tuple[Tensor, float]:
        """(numbers (D,), cost) at which a model that moves with its numbers much as this one does explains the data, after `steps`
        with the last iteration's Jacobian. seat: of that other model, left where it stands.

        Errors: ValueError before the first iteration; what the model raises where it stands."""
        if self.matrix is None or self.columns is None:
            raise ValueError("transferred: expected an iteration before it is asked for")
        precision, mean = self.precision(), self.mean()
        begun = numbers = seat.read()
        best: tuple[float, Tensor] | None = None
        try:
            r = seat.residuals()
            for _ in range(steps):
                gradient = (self.columns.T @ r).double().cpu() + precision @ (numbers - mean)
                numbers = self.clamped(numbers - torch.linalg.solve(self.matrix, gradient))
                seat.write(numbers)
                r = seat.residuals()
                cost = self.cost(numbers, r)
                if best is None or cost < best[0]:
                    best = (cost, numbers)
        except MosaError:
            if best is None:
                raise
        finally:
            seat.write(begun)
        return best[1], best[0]

    def _evidence(self, away: Tensor, H: Tensor, g: Tensor) -> None:
        """MacKay's fixed point of each learned block's factor (`Block.fitted`).

        theta is where the linear problem leads under the factors, not where the iteration stands, and the search begins at 1: a
        block that has not moved yet, or that an earlier noise had closed, is judged by what the data say now."""
        sizes = [b.size for b in self.blocks]
        for b in self.blocks:
            b.factor = 1.0 if b.learned else b.factor
        for _ in range(EVIDENCE_PASSES):
            precision = self.precision()
            covariance = torch.linalg.inv(H + precision)
            theta = away - covariance @ (g + precision @ away)
            variance = covariance.diagonal()
            for b, spread, moved in zip(self.blocks, variance.split(sizes), theta.split(sizes)):
                determined = float((1 - spread / (b.sd * b.factor) ** 2).sum())
                b.factor = b.fitted(float((moved / b.sd).square().sum()), determined)

    def names(self) -> list[str]:
        """Of the numbers of a posterior, which has no nuisances."""
        return [f"{b.name}[{i}]" if b.size > 1 else b.name
                for b in self.blocks if not b.nuisance for i in range(b.size)]  # fmt: skip

    def posterior(self, share: float = 1.0, wrong: Tensor | None = None) -> Posterior:
        """Laplace's, from the last iteration's matrix. share: of the data's precision, where they are fewer than they were counted;
        wrong: residuals (R,) that model and truth may differ by whatever the numbers are, and that they were found without: how far
        it would have moved them is one more standard deviation along that way. Errors: ValueError before the first iteration."""
        if self.matrix is None or self.data is None or self.columns is None:
            raise ValueError("posterior: expected an iteration before it is asked for")
        precision = self.precision(1.0)
        covariance = torch.linalg.inv(share * self.data + precision)
        covariance = 0.5 * (covariance + covariance.T)
        determined = (1 - (covariance @ precision).diagonal()).clamp(0, 1)
        if wrong is not None:
            moved = covariance @ (share * (self.columns.T @ wrong.to(self.columns)).double().cpu())
            covariance = covariance + torch.outer(moved, moved)
        nuisance = self._vector(lambda b: float(b.nuisance)).tolist()
        kept = [i for i, is_one in enumerate(nuisance) if not is_one]
        return Posterior(
            self.names(), self.seats[0].read()[kept], covariance[kept][:, kept], determined[kept]
        )
