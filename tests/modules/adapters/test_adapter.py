"""The stress adapter: the prior at initialisation, the paper's steps in one operator, bounds, rest, switches, statistics."""

import copy
import itertools
import pickle

import pytest
import torch
from drawn_adapters import E_REF, drawn_adapter, drawn_states, material_state, randomise
from hypothesis import given, settings
from hypothesis import strategies as st
from stepwise import increment, stepwise

from mosa.baselines.direct import DirectAdapter
from mosa.errors import ConfigError
from mosa.modules.adapters.penalties import pool, statistics
from mosa.modules.adapters.stress import StressAdapter

OPTIONS = {
    "paper's form": {},
    "literal": {"l_max": None, "rest_free": False},
    "major symmetry": {"major_symmetry": True},
    "constant": {"state_dependence": "constant"},
    "constant without residuals": {"state_dependence": "constant", "no_pre": True, "no_post": True},
    "no C": {"no_C": True},
    "no pre": {"no_pre": True},
    "no post": {"no_post": True},
    "only C": {"no_pre": True, "no_post": True},
    "plastic": {"plastic": True},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_initialisation_it_is_the_prior_bit_for_bit(options, dtype):
    """Check 8 of docs/verification.md: G and h are exactly 0, and so is the increment, far from rest too."""
    torch.manual_seed(3)
    adapter = StressAdapter(**options)
    adapter.switch_on(E_REF)
    w, s = drawn_states(50, size=10.0, dtype=dtype)
    answer = adapter(material_state(w, s))
    assert answer.G.dtype == dtype and answer.h.dtype == dtype
    for value in answer:
        assert value is None or torch.equal(value, torch.zeros_like(value))
    assert (answer.plastic_G is not None) == options.get("plastic", False)
    for found in (
        adapter.increment(w.float(), s.float()),
        increment(adapter, w.float(), s.float()),
    ):
        assert torch.equal(found, torch.zeros(50, 6))


def test_without_any_part_it_is_the_prior_whatever_the_weights():
    adapter = drawn_adapter(no_C=True, no_pre=True, no_post=True, plastic=True)
    for value in adapter(material_state(*drawn_states(20))):
        assert torch.equal(value, torch.zeros_like(value))


@pytest.mark.parametrize(
    "options",
    [*OPTIONS.values(), {"no_prior_stress": True}],
    ids=[*OPTIONS.keys(), "no prior stress"],
)
def test_the_operator_is_the_steps_of_the_paper(options):
    """Check 10 of docs/verification.md: d = (A - I) s + b, and what the simulator gets, in Pa."""
    adapter = drawn_adapter(**options)
    w, s = drawn_states(40)
    d = increment(adapter, w, s)
    assert d.abs().max() > 1e-3
    torch.testing.assert_close(adapter.increment(w, s), d, rtol=0, atol=1e-12)
    answer = adapter(material_state(w, s))
    stress = E_REF * s
    torch.testing.assert_close(
        (answer.G @ stress[..., None])[..., 0] + answer.h, E_REF * d, rtol=0, atol=1e-12 * E_REF
    )


def test_major_symmetry_is_a_property_of_the_operator_the_simulator_gets():
    w, s = drawn_states(10)
    plain, symmetric = (
        drawn_adapter(major_symmetry=on)(material_state(w, s)).G for on in (False, True)
    )
    scale = torch.tensor([1, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64)
    one = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    C0 = torch.eye(6).double() + 0.3 / 0.4 * torch.outer(one, one)
    off = [((K := scale[:, None] * G / scale @ C0) - K.mT).abs().max() for G in (plain, symmetric)]
    assert off[0] > 1e-2 and off[1] < 1e-13


@pytest.mark.parametrize("no_prior_stress", [False, True])
@pytest.mark.parametrize("count", [1, 3, 1001])
def test_a_body_at_rest_is_stress_free_exactly(no_prior_stress, count):
    adapter = drawn_adapter(dtype=torch.float32, no_prior_stress=no_prior_stress)
    zero = torch.zeros(count, 6)
    assert torch.equal(adapter(material_state(zero, zero)).h, zero)
    w, s = drawn_states(count, dtype=torch.float32)
    assert (adapter(material_state(w, s)).h != 0).any(-1).all()
    w[0] = s[0] = 0  # one at rest among moving ones
    h = adapter(material_state(w, s)).h
    assert torch.equal(h[0], zero[0]) and (count == 1 or (h[1:] != 0).any(-1).all())


def test_the_literal_form_has_stress_at_rest():
    zero = torch.zeros(2, 6).double()
    assert drawn_adapter(rest_free=False)(material_state(zero, zero)).h.abs().min() > 1e-3 * E_REF


@pytest.mark.parametrize("at_rest", [False, True])
@pytest.mark.parametrize("options", [{}, {"major_symmetry": True}, {"no_prior_stress": True}])
def test_gradients_against_differences(at_rest, options):
    """Of the increment the simulator applies, in state and weights; at rest too, where the value is pinned to 0."""
    adapter = drawn_adapter(hidden=5, **options)
    w, s = (torch.zeros(2, 6).double() if at_rest else a for a in drawn_states(2))
    direction = torch.randn(2, 12, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    parameters = [p for p in adapter.parameters() if p.requires_grad]
    generator = torch.Generator().manual_seed(7)
    weights = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]
    probe = torch.randn(2, 6, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def value(t: float) -> torch.Tensor:
        with torch.no_grad():
            for p, d in zip(parameters, weights):
                p.add_(t * d)
            a, b = w + t * direction[:, :6], s + t * direction[:, 6:]
            G, offset, _ = adapter.affine(adapter.operator, a, b)
            result = (probe * ((G @ b[..., None])[..., 0] + offset)).sum()
            for p, d in zip(parameters, weights):
                p.sub_(t * d)
        return result

    a, b = w.clone().requires_grad_(), s.clone().requires_grad_()
    G, offset, _ = adapter.affine(adapter.operator, a, b)
    result = (probe * ((G @ b[..., None])[..., 0] + offset)).sum()
    grads = torch.autograd.grad(result, [a, b, *parameters], allow_unused=True)
    directions = [direction[:, :6], direction[:, 6:], *weights]
    slope = sum((g * d).sum() for g, d in zip(grads, directions) if g is not None)
    h = 1e-4
    difference = (8 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (
        12 * h
    )  # fourth order
    assert abs(slope) > 1e-3
    torch.testing.assert_close(slope, difference, rtol=1e-6, atol=0)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.floats(-6, 6),
    st.floats(-3, 3),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_bounds_hold_for_any_input_and_any_weights(seed, input_power, weight_power, dtype):
    """Check 9 of docs/verification.md: inputs to 1e6, weights to 1e3."""
    alpha, l_max = 0.1, 0.1
    adapter = drawn_adapter(seed, size=10.0**weight_power, dtype=dtype, alpha=alpha, l_max=l_max)
    w, s = drawn_states(8, seed, size=10.0**input_power / 4, dtype=dtype)
    with torch.no_grad():
        _, pre, post, C = adapter.operator(w.clamp(-1e6, 1e6), s.clamp(-1e6, 1e6))
    assert torch.isfinite(C).all() and torch.isfinite(pre).all() and torch.isfinite(post).all()
    assert max(pre.abs().max(), post.abs().max()) <= l_max * (1 + 1e-6)
    det = torch.linalg.det(torch.eye(3).double() + C.double())
    assert (det >= (1 - alpha) ** 6 * (1 - 1e-4)).all()
    assert (
        C.abs().max() <= 2 * alpha + 3 * alpha**2 + 1e-6
    )  # of (I + L)(I + U) - I with entries within alpha


@pytest.mark.parametrize(("switch", "part"), [("no_C", 0), ("no_pre", 1), ("no_post", 2)])
def test_a_switch_removes_its_part_and_no_other(switch, part):
    w, s = drawn_states(10)
    parts = [drawn_adapter(**{switch: on}).operator(w, s) for on in (False, True)]
    for name, index in (("G", 0), ("pre", 1), ("post", 2)):
        full, ablated = parts[0][index], parts[1][index]
        assert full.abs().max() > 1e-4
        assert torch.equal(ablated, torch.zeros_like(ablated)) == (index == part), name


@pytest.mark.parametrize(
    "switches",
    [{}, {"no_C": True}, {"no_pre": True}, {"no_post": True}, {"no_C": True, "no_post": True}],
)
def test_every_weight_that_is_learned_has_an_effect(switches):
    adapter = drawn_adapter(**switches)
    adapter(material_state(*drawn_states(10)))
    G, b, _ = adapter.affine(adapter.operator, *drawn_states(10))
    (G.square().sum() + b.square().sum()).backward()
    dead = [
        n
        for n, p in adapter.named_parameters()
        if p.requires_grad and (p.grad is None or not p.grad.abs().sum() > 0)
    ]
    assert dead == []


def test_a_constant_operator_is_one_for_all_states_and_learns_at_the_rate_of_a_network():
    adapter = drawn_adapter(state_dependence="constant")
    answer = adapter(material_state(*drawn_states(30)))
    assert torch.equal(answer.G, answer.G[:1].expand_as(answer.G)) and answer.G.abs().max() > 1e-3
    fresh = StressAdapter(state_dependence="constant", no_pre=True, no_post=True)
    fresh.switch_on(E_REF)
    optimizer = torch.optim.Adam([p for p in fresh.parameters() if p.requires_grad], lr=2e-3)
    w, s = drawn_states(30, dtype=torch.float32)
    for _ in range(80):  # as many steps as a joint stage takes
        optimizer.zero_grad()
        (-fresh(material_state(w, s)).G[:, 0, 0].mean()).backward()
        optimizer.step()
    assert fresh(material_state(w, s)).G[0, 0, 0] > 0.3  # of about 0.46 that alpha = 0.1 allows


def test_networks_that_come_later_begin_at_the_learned_numbers():
    adapter = StressAdapter(state_dependence="later", major_symmetry=True).double()
    adapter.switch_on(E_REF, 0.3)
    numbers = 0.02 * torch.randn(4, 12, generator=torch.Generator().manual_seed(0))
    adapter.operator.free.data.copy_(numbers)
    state = material_state(*drawn_states(10))
    constant, learned = adapter(state), copy.deepcopy(adapter)
    assert adapter.steady and adapter.few_numbers and constant.G.abs().max() > 1e-2
    assert [n for n, p in adapter.named_parameters() if p.requires_grad] == ["numbers"]
    adapter.vary()
    begun = adapter(state)
    # the numbers' bound is a float32
    assert torch.allclose(begun.G, constant.G, rtol=0, atol=1e-8) and not begun.h.any()
    assert (
        not adapter.steady and not adapter.few_numbers and not adapter.operator.free.requires_grad
    )
    with torch.no_grad():
        adapter.operator.planes.weight.fill_(0.01)
    assert (adapter(state).G - constant.G).abs().max() > 1e-4
    # what is loaded says by itself whether its networks have begun
    pickled = pickle.loads(pickle.dumps(learned))
    for each, of in ((pickled, adapter), (copy.deepcopy(learned), adapter), (copy.deepcopy(adapter), learned)):  # fmt: skip
        each.load_state_dict(of.state_dict())
        assert torch.equal(each(state).G, of(state).G) and each.steady == of.steady


def test_plastic_part_corrects_the_strain_and_is_bounded_too():
    adapter = drawn_adapter(plastic=True)
    w, s = drawn_states(20)
    answer = adapter(material_state(w, s))
    e = 0.5 * w
    zero = torch.zeros(1, 6).double()
    expected = stepwise(adapter.plastic_operator, w, e)
    expected = expected - stepwise(adapter.plastic_operator, zero, zero)
    corrected = e + (answer.plastic_G @ e[..., None])[..., 0] + answer.plastic_h
    torch.testing.assert_close(corrected, expected, rtol=0, atol=1e-12)
    assert adapter(material_state(w, s)._replace(plastic_strain=None)).plastic_G is None


@pytest.mark.parametrize("plastic", [False, True])
def test_recomputing_changes_nothing_but_memory(plastic):
    results = []
    for recompute in (False, True):
        adapter = drawn_adapter(dtype=torch.float32, recompute=recompute, plastic=plastic)
        w, s = (a.requires_grad_() for a in drawn_states(30, dtype=torch.float32))
        answer = adapter(material_state(w, s))
        loss = (
            sum(a.square().sum() for a in answer if a is not None)
            + adapter.statistics().mean_square
        )
        loss.backward()
        values = [a.detach() for a in answer if a is not None]
        results.append([*values, w.grad, s.grad, *(p.grad for p in adapter.parameters())])
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_statistics_are_those_of_the_outputs_and_pool_over_evaluations():
    adapter = drawn_adapter()
    w, s = drawn_states(40)
    adapter(material_state(w, s))
    whole = adapter.statistics()
    with torch.no_grad():
        part = adapter.operator(w, s)
    assert float(whole.mean_abs_C.detach()) == pytest.approx(float(part.C.abs().mean()), rel=1e-12)
    entries = torch.cat([part.C.flatten(1), part.pre, part.post], 1)
    assert float(whole.mean_square.detach()) == pytest.approx(
        float(entries.square().mean()), rel=1e-12
    )
    assert float(whole.variance.detach()) == pytest.approx(
        float(entries.var(0, unbiased=False).mean()), rel=1e-12
    )
    halves = []
    for chosen in (slice(0, 20), slice(20, 40)):
        adapter(material_state(w[chosen], s[chosen]))
        halves.append(adapter.statistics())
    pooled = pool(halves)
    for name in ("mean_abs_C", "mean_square", "variance"):
        mine, theirs = (float(getattr(a, name).detach()) for a in (pooled, whole))
        assert mine == pytest.approx(theirs, rel=1e-12), name
    assert (
        torch.stack([h.variance for h in halves]).mean() < 0.999 * pooled.variance
    )  # time counts as well
    pooled.variance.backward()
    assert all(p.grad.abs().sum() > 0 for p in adapter.operator.planes.parameters())


def test_a_constant_correction_has_no_variance():
    C, L = (
        torch.randn(1, 4, 3, 3).double().expand(9, 4, 3, 3),
        torch.randn(1, 6).double().expand(9, 6),
    )
    assert statistics(C, L, L).variance < 1e-30


def test_the_unit_of_stress_is_fixed_once_and_travels_with_the_weights():
    adapter = StressAdapter()
    with pytest.raises(ConfigError, match="switch_on"):
        adapter(material_state(*drawn_states(2)))
    with pytest.raises(
        ConfigError, match=r"expected an evaluation, .* to call `note` .*found none"
    ):
        adapter.statistics()
    adapter.switch_on(E_REF, 0.3)
    adapter.switch_on(E_REF, 0.3)  # again the same, as on a resumed run
    with pytest.raises(ConfigError, match=r"E_ref is fixed at 200000 already, found 100000"):
        adapter.switch_on(1e5, 0.3)
    other = StressAdapter()
    other.load_state_dict(adapter.state_dict())
    w, s = drawn_states(5, dtype=torch.float32)
    assert other.is_on and torch.equal(
        other(material_state(w, s)).G, adapter(material_state(w, s)).G
    )


@pytest.mark.parametrize("kind", [StressAdapter, DirectAdapter])
def test_it_can_be_copied_and_pickled_while_a_graph_is_alive(kind):
    adapter = kind()
    randomise(adapter)
    adapter.switch_on(E_REF)
    w, s = drawn_states(5, dtype=torch.float32)
    answer = adapter(material_state(w, s))
    for twin in (copy.deepcopy(adapter), pickle.loads(pickle.dumps(adapter))):
        assert torch.equal(twin(material_state(w, s)).h, answer.h)
    assert adapter.statistics().mean_square > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"alpha": 0.0}, "adapter.alpha"), ({"alpha": 1.0}, "adapter.alpha"), ({"l_max": 0.0}, "adapter.l_max"),
        ({"input_scale": -1.0}, "adapter.input_scale"), ({"hidden": 0}, "adapter.hidden"),
        ({"state_dependence": "some"}, "expected full or constant or later"),
        ({"state_dependence": "later", "no_C": True}, "later begins with the matrices C"),
        ({"no_prior_stress": True, "no_pre": True}, "no_pre=false"),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_named(options, message):
    with pytest.raises(ConfigError, match=message):
        StressAdapter(**options)


def test_all_combinations_of_switches_evaluate():
    w, s = drawn_states(3)
    names = (
        "no_C",
        "no_pre",
        "no_post",
        "no_prior_stress",
        "rest_free",
        "major_symmetry",
        "plastic",
    )
    for values in itertools.product((False, True), repeat=len(names)):
        options = dict(zip(names, values))
        if options["no_pre"] and options["no_prior_stress"]:
            continue
        for dependence in ("full", "constant"):
            answer = drawn_adapter(hidden=4, state_dependence=dependence, **options)(
                material_state(w, s)
            )
            assert torch.isfinite(answer.G).all() and torch.isfinite(answer.h).all(), options


@pytest.mark.parametrize("dependence", ["full", "constant"])
def test_the_matrix_between_the_planes_has_a_bound_of_its_own(dependence):
    """The paper's two alphas: entries of a product of LU factors within alpha are within 3 alpha (1 + alpha) of the identity's."""
    w, s = drawn_states(40)
    largest = []
    for bound in (None, 0.01, 0.2):
        adapter = drawn_adapter(
            size=30.0, alpha=0.1, alpha_normal=bound, state_dependence=dependence
        )  # every tanh at its end
        C = adapter.affine(adapter.operator, w, s)[2].C.detach()
        largest.append((float(C[:, :3].abs().max()), float(C[:, 3].abs().max())))
    assert largest[0][0] == largest[1][0] == largest[2][0]
    assert largest[1][1] <= 0.01 * 3 * 1.01 < largest[0][1] < largest[2][1]
    with pytest.raises(ConfigError, match=r"adapter\.alpha_normal"):
        drawn_adapter(alpha_normal=1.5)
