"""Gauss-Newton against linear algebra: the regularised solution in one step, bounds, evidence, seats, failures, draws."""

import itertools
import math
import threading
from dataclasses import fields

import pytest
import torch
from scipy.optimize import minimize_scalar

from mosa.errors import ConfigError, SimulationDiverged
from mosa.modules.fitting.gauss_newton import (
    ROWS,
    Block,
    GaussNewton,
    Posterior,
    Seat,
    normal_equations,
)


def drawn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def linear(blocks, A, b, seats=1, start=None, watch=None):
    """A problem with residuals A x - b. watch: called with every x that is asked for."""

    def seat():
        tensors = [torch.zeros(block.size, dtype=torch.float64) for block in blocks]

        def residuals():
            x = torch.cat(tensors)
            if watch is not None:
                watch(x)
            return A @ x - b

        return Seat(tensors, residuals)

    newton = GaussNewton(blocks, [seat() for _ in range(seats)])
    newton.seats[0].write(newton.mean() if start is None else start)
    return newton


def two_blocks(**options):
    return [Block("a", drawn(3, seed=1), 0.5 + drawn(3, seed=2).abs(), 0.02, **options),
            Block("b", torch.tensor([0.3]), torch.tensor([2.0]), 0.1)]  # fmt: skip


def test_one_iteration_solves_a_linear_problem_and_knows_its_covariance():
    """The textbook: x = (A^T A + P)^-1 (A^T b + P m), covariance (A^T A + P)^-1; fewer data than unknowns are no trouble."""
    for rows in (40, 2):
        A, b, blocks = drawn(rows, 4, seed=3), drawn(rows, seed=4), two_blocks()
        newton = linear(blocks, A, b, start=drawn(4, seed=5))
        report = newton.iterate(learn=False)
        mean = torch.cat([block.mean for block in blocks])
        P = torch.diag(1 / torch.cat([block.sd for block in blocks]).square())
        expected = torch.linalg.solve(A.T @ A + P, A.T @ b + P @ mean)
        posterior = newton.posterior()
        assert (
            report["share"] == pytest.approx(1.0, abs=1e-14) and report["after"] < report["before"]
        )
        # one-sided differences of a linear function are wrong by its rounding over the step, 1e-15/0.02, times the condition
        assert torch.allclose(newton.seats[0].read(), expected, rtol=0, atol=1e-11)
        assert torch.equal(posterior.mean, newton.seats[0].read()) and posterior.names == [
            "a[0]",
            "a[1]",
            "a[2]",
            "b",
        ]
        covariance = torch.linalg.inv(A.T @ A + P)
        assert torch.allclose(posterior.covariance, covariance, rtol=0, atol=1e-11)
        assert torch.allclose(
            posterior.determined, 1 - covariance.diagonal() * P.diagonal(), rtol=0, atol=1e-11
        )
        r = A @ expected - b
        cost = 0.5 * (r @ r + (expected - mean) @ P @ (expected - mean))
        assert report["after"] == pytest.approx(float(cost), rel=1e-12)
        again = newton.iterate(learn=False)
        assert again["length"] < 1e-9 and again["after"] <= report["after"] * (1 + 1e-14)


def test_what_the_data_do_not_see_stays_where_the_prior_has_it():
    A = drawn(30, 4, seed=3)
    A[:, 2] = 0
    newton = linear(two_blocks(), A, drawn(30, seed=4), start=drawn(4, seed=5))
    newton.iterate(learn=False)
    posterior = newton.posterior()
    assert float(posterior.mean[2] - newton.mean()[2]) == pytest.approx(0, abs=1e-12)
    assert (
        float(posterior.determined[2]) == pytest.approx(0, abs=1e-12)
        and float(posterior.determined[0]) > 0.9
    )
    assert float(posterior.covariance[2, 2]) == pytest.approx(
        float(newton.blocks[0].sd[2]) ** 2, rel=1e-12
    )


def test_a_curved_problem_ends_at_its_minimum():
    """a exp(-k t) and priors: the gradient of the cost, by central differences of a formula of its own, vanishes there."""
    t = torch.linspace(0, 3, 40, dtype=torch.float64)
    data = 2 * torch.exp(-1.3 * t) + 0.01 * drawn(40, seed=1)
    one = torch.ones(1)
    blocks = [Block("a", one, one, 1e-6), Block("k", 0.3 * one, 0.5 * one, 1e-6)]
    tensors = [torch.ones(1).double(), torch.tensor([0.3]).double()]
    newton = GaussNewton(
        blocks, [Seat(tensors, lambda: (tensors[0] * torch.exp(-tensors[1] * t) - data) / 0.01)]
    )
    costs = [newton.iterate(learn=False) for _ in range(12)]
    assert all(c["after"] <= c["before"] for c in costs) and costs[-1]["length"] < 1e-3

    def cost(a, k):
        r = (a * torch.exp(-k * t) - data) / 0.01
        return (
            0.5 * float(r @ r)
            + 0.5 * (a - 1) ** 2
            + 0.5 * ((k - float(torch.tensor(0.3))) / 0.5) ** 2
        )

    a, k = newton.seats[0].read().tolist()
    curvature, h = newton.matrix.diagonal().sqrt().tolist(), 1e-6
    # in units of the posterior's deviations
    assert abs(cost(a + h, k) - cost(a - h, k)) / (2 * h) / curvature[0] < 1e-2
    assert abs(cost(a, k + h) - cost(a, k - h)) / (2 * h) / curvature[1] < 1e-2
    assert k == pytest.approx(1.3, abs=0.03)


def decay(step):
    """a exp(-k t) against data of another form, so that residuals stay large; columns by differences over `step`."""
    t = torch.linspace(0, 3, 40, dtype=torch.float64)
    data = 2 * torch.exp(-1.3 * t) + 0.4 * torch.sin(3 * t)
    one, tensors = torch.ones(1), [torch.ones(1).double(), torch.tensor([0.3]).double()]
    asked = []

    def residuals():
        asked.append(torch.cat(tensors))
        return (tensors[0] * torch.exp(-tensors[1] * t) - data) / 0.05

    return GaussNewton(
        [Block("a", one, 3 * one, step), Block("k", 0.3 * one, 3 * one, step)],
        [Seat(tensors, residuals)],
    ), asked


def test_further_steps_with_one_jacobian_do_the_work_of_several():
    """Columns over a step of 0.3 are wrong. Eight Jacobians with one step each stay above the cost that one of them and six
    corrected steps reach; and along the last step the columns say what it did, better than fresh differences do."""
    single, _ = decay(0.3)
    costs = [single.iterate(learn=False, settled=False)["after"] for _ in range(8)]
    newton, asked = decay(0.3)
    report = newton.iterate(learn=False)
    assert (
        len(asked) <= 3 + newton.steps
        and min(costs[:2]) > report["after"] + 1
        and costs[-1] > report["after"]
    )
    steps = torch.stack(asked[2:])  # the last column's numbers, then those of the steps
    at = newton.seats[0].read()
    tried = steps[1:]
    # the residuals of the last two tries, asked again
    newton.seats[0].write(tried[-1])
    last = newton.seats[0].residuals()
    near = min(tried[:-1], key=lambda x: float((x - tried[-1]).norm()))
    newton.seats[0].write(near)
    other = newton.seats[0].residuals()
    newton.seats[0].write(at)
    predicted, true = newton.columns @ (tried[-1] - near), last - other
    fresh = newton.jacobian(at, newton.seats[0].residuals()) @ (tried[-1] - near)
    assert float((predicted - true).norm()) < 0.5 * float((fresh - true).norm())


def test_steps_that_go_on_never_raise_the_cost():
    for step in (0.01, 0.1, 0.3, 1.0):
        newton, _ = decay(step)
        reports = [newton.iterate(learn=False) for _ in range(6)]
        assert all(r["after"] <= r["before"] for r in reports)
        assert all(b["before"] <= a["after"] * (1 + 1e-12) for a, b in itertools.pairwise(reports))


def test_bounds_hold_for_what_is_found_and_for_all_that_is_asked():
    """Without coupling the bounded minimum is the free one, clamped; differences step inwards at the upper bound."""
    asked = []
    blocks = [Block("a", torch.zeros(4), 10 * torch.ones(4), 0.05, bounds=(-1.0, 0.5))]
    b = torch.tensor([0.2, 3.0, -3.0, 0.49])
    newton = linear(
        blocks, torch.eye(4).double(), b.double(), watch=lambda x: asked.append(x.clone())
    )
    for _ in range(3):
        newton.iterate(learn=False)
    free = b.double() / (1 + 0.01)
    assert torch.allclose(newton.seats[0].read(), free.clamp(-1.0, 0.5), rtol=0, atol=1e-12)
    assert torch.stack(asked).max() <= 0.5 and torch.stack(asked).min() >= -1.0
    assert len(asked) >= 3 * 6


def test_evidence_finds_the_size_of_a_block_and_that_another_is_nothing():
    """60 numbers of size 0.25 where the prior says 0.1, and 60 that are zero. The noise is half of what it is said to be: noise
    alone then explains what is seen of them, and the factor ends at its lower limit. A block that is not learned stays."""
    A = 20 * torch.linalg.qr(drawn(400, 130, seed=7)).Q
    truth = torch.cat([0.25 * drawn(60, seed=8), torch.zeros(60).double(), drawn(10, seed=9)])
    b = A @ truth + 0.5 * drawn(400, seed=10)
    blocks = [
        Block(name, torch.zeros(n), sd * torch.ones(n), 0.02, learned=learned)
        for name, n, sd, learned in (
            ("sized", 60, 0.1, True),
            ("nothing", 60, 0.1, True),
            ("plain", 10, 0.1, False),
        )
    ]
    newton = linear(blocks, A, b)
    for _ in range(40):
        report = newton.iterate()
    size = float(truth[:60].square().mean().sqrt())
    # found from estimates with a deviation of 0.5/20 each
    assert report["sd/sized"] == pytest.approx(size, rel=0.03)
    assert blocks[1].factor == blocks[1].limits[0] and report["sd/nothing"] == pytest.approx(0.003)
    assert blocks[2].factor == 1.0 and "sd/plain" not in report
    posterior = newton.posterior()
    assert posterior.determined[:60].min() > 0.9 and posterior.determined[60:120].max() < 0.01
    assert posterior.mean[60:120].abs().max() < 1e-3


def test_evidence_stops_at_the_upper_limit():
    blocks = [Block("a", torch.zeros(20), 0.1 * torch.ones(20), 0.02, learned=True)]
    newton = linear(blocks, 20 * torch.eye(20).double(), 20 * 30 * torch.ones(20).double())
    for _ in range(5):
        newton.iterate()
    assert blocks[0].factor == blocks[0].limits[1] == 5.0


@pytest.mark.parametrize("spread", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("true_size", [0.02, 0.3])
def test_the_size_is_where_the_evidence_times_its_own_prior_is_largest(true_size, spread):
    """Of a linear model, whose evidence is a Gaussian in closed form: a search over its logarithm and the program's fixed point
    end at the same size, in between 1 and what the evidence alone would give."""
    A, noise = 6 * torch.linalg.qr(drawn(80, 30, seed=3)).Q, drawn(80, seed=5)
    b = A @ (true_size * drawn(30, seed=4)) + noise
    blocks = [
        Block("sized", torch.zeros(30), 0.1 * torch.ones(30), 0.02, learned=True, spread=spread)
    ]
    newton = linear(blocks, A, b)
    for _ in range(3):
        newton.iterate()

    def minus(logarithm):
        covariance = (0.1 * math.exp(logarithm)) ** 2 * A @ A.T + torch.eye(80).double()
        fit = b @ torch.linalg.solve(covariance, b) + torch.linalg.slogdet(covariance).logabsdet
        return float(0.5 * fit) + 0.5 * (logarithm / spread) ** 2

    low, high = blocks[0].limits
    best = minimize_scalar(minus, bounds=(math.log(low), math.log(high)), method="bounded").x
    assert math.log(blocks[0].factor) == pytest.approx(best, abs=0.02)


@pytest.mark.parametrize("seats", [2, 3, 7])
def test_several_seats_give_the_jacobian_of_one(seats):
    A, b, counted = drawn(50, 4, seed=3), drawn(50, seed=4), []
    one, many = (linear(two_blocks(), A, b, count, start=drawn(4, seed=5)) for count in (1, seats))
    many.progress = lambda: counted.append(threading.get_ident())
    for newton in (one, many):
        newton.iterate(learn=False)
    assert torch.equal(one.seats[0].read(), many.seats[0].read()) and torch.equal(
        one.data, many.data
    )
    assert len(counted) == 4
    assert all(torch.equal(seat.read(), many.seats[1].read()) for seat in many.seats[1:])


class Limited:
    """Residuals 10 (x - 1) that cannot be had above `limit`, or at the numbered calls."""

    def __init__(self, limit=math.inf, fails=(), error=SimulationDiverged):
        self.limit, self.fails, self.error, self.calls = limit, fails, error, 0
        self.x = torch.zeros(2, dtype=torch.float64)
        self.newton = GaussNewton(
            [Block("x", torch.zeros(2), 1e3 * torch.ones(2), 0.01)],
            [Seat([self.x], self.residuals)],
        )

    def residuals(self):
        self.calls += 1
        if self.calls in self.fails or bool((self.x > self.limit).any()):
            if self.error is None:
                return torch.full((2,), math.nan).double()
            raise self.error("burst")
        return 10 * (self.x - 1)


def test_a_step_that_cannot_be_simulated_is_shortened():
    problem = Limited(limit=0.5)
    report = problem.newton.iterate(learn=False, settled=False)
    assert report["share"] == pytest.approx(0.4, abs=1e-12) and torch.allclose(
        problem.x, torch.full((2,), 0.4).double(), atol=1e-5
    )
    short = Limited(limit=0.0101)  # just above the step of the differences
    report = short.newton.iterate(learn=False)
    assert report["share"] == 0.0 and report["after"] == report["before"] and (short.x == 0).all()
    refused = Limited(fails=(4,), error=ConfigError)  # the time step is bounded
    assert refused.newton.iterate(learn=False, settled=False)["share"] == pytest.approx(
        0.4, abs=1e-12
    )
    nothing = Limited(limit=0.5, error=None)  # residuals that are not numbers, in place of an error
    assert nothing.newton.iterate(learn=False, settled=False)["share"] == pytest.approx(
        0.4, abs=1e-12
    )
    assert torch.isfinite(nothing.newton.columns).all()
    further = Limited(
        limit=0.5
    )  # once steps go on, they come nearer to the limit and stay below it
    assert (
        0.4 < further.newton.iterate(learn=False)["share"] <= 0.5
        and (further.x <= 0.5).all()
        and (further.x > 0.45).all()
    )


def test_a_column_that_cannot_be_simulated_ends_the_fit_and_leaves_the_numbers():
    problem = Limited(fails=(3,))
    with pytest.raises(SimulationDiverged, match="burst"):
        problem.newton.iterate(learn=False)
    assert (problem.x == 0).all()
    mistake = Limited(fails=(4,), error=ZeroDivisionError)
    with pytest.raises(
        ZeroDivisionError
    ):  # no simulation's failure: it is not hidden in a shorter step
        mistake.newton.iterate(learn=False)
    several = [Limited(), Limited(limit=0.0)]
    newton = GaussNewton(several[0].newton.blocks, [p.newton.seats[0] for p in several])
    gate, main = threading.Barrier(2), threading.current_thread()

    def together(own):
        def residuals():
            if threading.current_thread() is not main:
                gate.wait(30)  # each takes one of the two columns
            return own()

        return residuals

    for problem, seat in zip(several, newton.seats, strict=True):
        seat.residuals = together(problem.residuals)
    with pytest.raises(SimulationDiverged, match="burst"):
        newton.iterate(learn=False)
    assert all((p.x == 0).all() for p in several)


def test_a_column_that_is_not_finite_is_named():
    x = torch.zeros(2, dtype=torch.float64)
    newton = GaussNewton(
        [Block("x", torch.zeros(2), torch.ones(2), 0.01)],
        [Seat([x], lambda: x / (x.abs() < 0.005))],
    )
    with pytest.raises(SimulationDiverged, match="no finite Jacobian"):
        newton.iterate()
    assert (x == 0).all()


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_what_the_model_gets_wrong_is_a_standard_deviation_where_it_moves_the_numbers(share):
    """With the wrong in the data the numbers are found elsewhere: that way is added to the covariance, and nothing across it."""
    A, b, blocks, wrong = drawn(40, 4, seed=3), drawn(40, seed=4), two_blocks(), drawn(40, seed=6)
    newton, other = linear(blocks, A, b), linear(blocks, A * share**0.5, (b + wrong) * share**0.5)
    same = linear(blocks, A * share**0.5, b * share**0.5)
    for each in (newton, other, same):
        each.iterate(learn=False)
    way = other.seats[0].read() - same.seats[0].read()
    alone, found = newton.posterior(share), newton.posterior(share, wrong)
    assert torch.allclose(
        found.covariance, alone.covariance + torch.outer(way, way), rtol=0, atol=1e-11
    )
    assert torch.equal(found.mean, alone.mean) and torch.equal(found.determined, alone.determined)
    assert torch.equal(newton.posterior(share, 0 * wrong).covariance, alone.covariance)


def test_no_posterior_before_an_iteration():
    with pytest.raises(ValueError, match="expected an iteration"):
        linear(two_blocks(), drawn(5, 4), drawn(5)).posterior()


def test_a_posterior_survives_a_checkpoint(tmp_path):
    newton = linear(two_blocks(), drawn(50, 4, seed=3), drawn(50, seed=4))
    newton.iterate(learn=False)
    posterior = newton.posterior()
    torch.save(posterior.written(), tmp_path / "posterior.pt")
    found = Posterior.read(torch.load(tmp_path / "posterior.pt", weights_only=True))
    for field in fields(Posterior):
        mine, its = getattr(posterior, field.name), getattr(found, field.name)
        assert torch.equal(mine, its) if isinstance(mine, torch.Tensor) else mine == its


def test_draws_have_the_moments_of_the_posterior():
    """Of n draws a mean is off by sd/sqrt(n) and a covariance by sqrt((c_ii c_jj + c_ij^2)/n); five of either."""
    newton = linear(two_blocks(), drawn(6, 4, seed=3), drawn(6, seed=4))
    newton.iterate(learn=False)
    posterior, n = newton.posterior(), 40_000
    found = posterior.draws(n, torch.Generator().manual_seed(1))
    C = posterior.covariance
    assert found.shape == (n, 4)
    assert ((found.mean(0) - posterior.mean).abs() < 5 * (C.diagonal() / n).sqrt()).all()
    allowed = 5 * ((C.diagonal()[:, None] * C.diagonal() + C.square()) / n).sqrt()
    assert ((torch.cov(found.T) - C).abs() < allowed).all()
    assert (C - torch.diag(C.diagonal())).abs().max() > 0.05 * C.diagonal().min()
    assert torch.equal(found, posterior.draws(n, torch.Generator().manual_seed(1)))
    assert torch.equal(
        posterior.draws(3), posterior.draws(3, torch.Generator().manual_seed(0))
    )  # without a generator


def test_two_halves_of_the_data_say_what_the_whole_says():
    """What one half says of the shared numbers, correlated as they are, is the prior of the other;
    a number that only the first half has is integrated out."""
    A, b = drawn(60, 4, seed=3), drawn(60, seed=4)
    A[:30, 3], A[30:, 3] = 0.0, 0.5 * A[30:, 0]
    whole, second = linear(two_blocks(), A, b), linear(two_blocks(), A[30:], b[30:])
    first = linear(two_blocks()[:1], A[:30, :3], b[:30])
    for newton in (whole, first):
        newton.iterate(learn=False)
    second.known = first.posterior()
    second.seats[0].write(second.mean())
    second.iterate(learn=False)
    found, expected = second.posterior(), whole.posterior()
    assert torch.allclose(found.mean, expected.mean, rtol=0, atol=1e-11)
    assert torch.allclose(found.covariance, expected.covariance, rtol=0, atol=1e-11)
    alone, three = linear(two_blocks()[:1], A[:30, :3], b[:30]), whole.posterior()
    alone.known = three.only(["a[0]", "a[1]", "a[2]"])
    at = torch.linalg.inv(three.covariance[:3, :3])
    assert torch.allclose(alone.precision(), at, rtol=1e-9) and alone.known.names == first.names()


def test_a_model_that_moves_alike_is_transferred_to_in_one_step():
    """Of r = A x - b and another b the minimum is reached with the first one's columns; the seat stays where it stands."""
    A, b, other = drawn(50, 4, seed=3), drawn(50, seed=4), drawn(50, seed=5)
    newton = linear(two_blocks(), A, b)
    newton.iterate(learn=False)
    here = newton.seats[0].read()
    newton.seats[0].residuals = linear_residuals(newton, A, other)
    found, cost = newton.transferred(1, newton.seats[0])
    away = found - newton.mean()
    gradient = A.T @ (A @ found - other) + newton.precision() @ away
    assert gradient.abs().max() < 1e-6 * (A.T @ other).abs().max()
    assert cost == pytest.approx(
        0.5 * float((A @ found - other).square().sum() + away @ newton.precision() @ away)
    )
    assert torch.equal(newton.seats[0].read(), here) and not torch.allclose(found, here, atol=1e-3)


def test_nothing_is_transferred_before_an_iteration():
    newton = linear(two_blocks(), drawn(5, 4), drawn(5))
    with pytest.raises(ValueError, match="expected an iteration"):
        newton.transferred(1, newton.seats[0])


def linear_residuals(newton, A, b):
    return lambda: A @ newton.seats[0].read() - b


def test_what_few_residuals_tell_stays_beside_steep_ones():
    """Two numbers of which a measured force tells the sum 1e5 times as well as a film the difference."""
    generator = torch.Generator().manual_seed(0)
    count = ROWS + 1000
    force, film = torch.randn(2, count, generator=generator)
    J = torch.stack([1e5 * force + film, 1e5 * force - film], 1)
    H, g = normal_equations(J, film)
    exact = J.double().T @ J.double()
    assert float((H - exact).abs().max()) < 1e-12 * float(exact.max())
    assert float(torch.linalg.eigvalsh(H).min()) == pytest.approx(2 * count, rel=0.02)
    in_float32 = float(torch.linalg.eigvalsh((J.T @ J).double()).min())
    assert abs(in_float32 - 2 * count) > 100 * count  # of either sign
    torch.testing.assert_close(g, J.double().T @ film.double())
