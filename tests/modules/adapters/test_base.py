"""Every adapter that a configuration may name answers what `Adapter` lists, and nobody asks which one it is."""

import copy
import pickle
import re
from pathlib import Path

import pytest
import torch
from drawn_adapters import E_REF, drawn_states, material_state, randomise
from small_bodies import FRAME_DT, WORLD, lattice, small_body, start

import mosa
from mosa.config.build import fitting
from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.penalties import PENALTIES
from mosa.modules.adapters.registry import ADAPTERS, adapter_class
from mosa.modules.adapters.warm_start import drawn_stretches
from mosa.modules.body.material import Material, material_states
from mosa.physics.constitutive.laws import law_named

NU = 0.35
SIZES = {"interaction": {"nodes": 60, "neighbours": 16}}
NAMES = sorted(ADAPTERS)
LAWS = [name for name in NAMES if name != "interaction"]
"""Adapters that answer a law; pair forces move the particles themselves."""


def made(name: str):
    torch.manual_seed(0)
    return adapter_class({"name": name})(**SIZES.get(name, {})).double()


def on(name: str, size: float = 0.0, prepared: bool = False):
    """Switched on. size: of random weights in place of those it begins with, 0 for these; prepared: as its stage begins."""
    adapter = made(name)
    rest = lattice()
    adapter.settle(rest, torch.full((len(rest),), 1e-6).double())
    adapter.switch_on(E_REF, NU)
    if prepared:  # seconds, where networks are fitted to the prior
        adapter.prepare("corotated", prior_states())
    adapter.follow(torch.tensor(NU).double())
    if size:
        randomise(adapter, size)
    return adapter


def prior_states():
    return material_states(
        "corotated", Material("corotated", {"E": E_REF, "nu": NU}).per_particle()
    )


def state():
    return material_state(*drawn_states(5))


@pytest.mark.parametrize("name", NAMES)
def test_it_has_all_that_is_asked(name):
    adapter = made(name)
    assert isinstance(adapter, Adapter)
    assert all(callable(penalty) for penalty in adapter.penalties.values()) and set(
        PENALTIES
    ) <= set(adapter.penalties)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_switched_on_once(name):
    adapter = made(name)
    assert not adapter.is_on
    with pytest.raises(ConfigError):
        adapter(state())
    if not adapter.steady:
        with pytest.raises(
            ConfigError, match=r"expected an evaluation, .* to call `note` .*found none"
        ):
            adapter.statistics()
    adapter.switch_on(E_REF, NU)
    assert adapter.is_on and float(adapter.E_ref) == E_REF and float(adapter.poisson) == NU
    with pytest.raises(ConfigError, match="fixed"):
        adapter.switch_on(2 * E_REF, NU)


@pytest.mark.parametrize("name", LAWS)
def test_it_begins_as_the_prior_and_notes_no_departure(name):
    adapter = on(name, prepared=True)
    answer = adapter(state())
    assert (
        answer.G.shape == (5, 6, 6)
        and answer.h.shape == (5, 6)
        and answer.G.dtype == answer.h.dtype == torch.float64
    )
    if (
        adapter.replaces_law
    ):  # networks that were fitted to the prior's stress, so that the difference is theirs
        here = prior_states()(drawn_stretches(50, 0.1, torch.Generator().manual_seed(0)))
        assert 0 < adapter(here).h.norm() < 0.06 * here.stress.norm()
        return
    assert not answer.G.any() and not answer.h.any()
    assert float(adapter.statistics().mean_square.detach()) == 0


@pytest.mark.parametrize("name", LAWS)
def test_its_answer_departs_its_statistics_say_so_and_its_penalties_can_be_learned_by(name):
    adapter = on(name, 0.3)
    answer, weights = adapter(state()), [p for p in adapter.parameters() if p.requires_grad]
    assert answer.G.abs().sum() + answer.h.abs().sum() > 0
    found = adapter.statistics()
    assert found.mean.shape == found.within.shape and float(found.mean_square.detach()) > 0
    for misfit, penalty in zip((0.01, 0.02), adapter.penalties.values()):
        value = penalty(found, misfit)
        assert value.shape == () and bool(torch.isfinite(value)) and float(value.detach()) >= 0
    adapter.penalties["operator"](found, 0.01).backward()
    assert any(p.grad is not None and float(p.grad.abs().sum()) > 0 for p in weights)


@pytest.mark.parametrize("name", LAWS)
def test_it_is_steady_where_it_says_so(name):
    adapter = on(name, 0.3)
    first, second = (adapter(material_state(*drawn_states(5, seed=seed))) for seed in (0, 1))
    assert adapter.steady == (torch.equal(first.G, second.G) and torch.equal(first.h, second.h))


@pytest.mark.parametrize("name", NAMES)
def test_the_time_step_allows_for_it(name):
    for size in (0.0, 0.3):
        found = on(name, size).stiffening(NU)
        assert isinstance(found, float) and 1 <= found < 100


@pytest.mark.parametrize("name", LAWS)
def test_what_it_adds_is_its_answer_at_that_state(name):
    adapter = on(name, 0.3)
    w, s = drawn_states(5)
    s.requires_grad_(True)
    added = adapter.increment(w, s)
    assert added.shape == (5, 6) and torch.autograd.grad(added.sum(), s)[0].shape == (5, 6)
    if not adapter.energetic:
        answer = adapter(material_state(w, s))
        torch.testing.assert_close(
            E_REF * added,
            (answer.G @ (E_REF * s)[..., None])[..., 0] + answer.h,
            rtol=1e-9,
            atol=1e-6,
        )


@pytest.mark.parametrize("name", LAWS)
def test_a_stiffness_is_one_and_says_of_which_strain(name):
    adapter = on(name, 0.3)
    found = adapter.stiffness()
    assert (found is not None) == adapter.energetic
    if found is not None:
        assert (
            found.shape == (6, 6)
            and found.dtype == torch.float64
            and torch.allclose(found, found.T)
        )
        assert torch.linalg.eigvalsh(found).min() > 0


@pytest.mark.parametrize("name", NAMES)
def test_few_numbers_are_one_parameter(name):
    adapter = made(name)
    learned = [key for key, p in adapter.named_parameters() if p.requires_grad]
    assert not adapter.few_numbers or learned == ["numbers"]
    assert learned


@pytest.mark.parametrize("name", NAMES)
def test_a_plastic_flow_takes_no_effect_in_no_time(name):
    adapter, F = on(name), torch.eye(3).double().expand(5, 3, 3) * 1.1
    assert adapter.flow is None or torch.equal(adapter.flow(F, 0.0), F)


@pytest.mark.parametrize("name", NAMES)
def test_its_copy_in_double_precision_is_a_copy(name):
    adapter = on(name, 0.3).float()
    held = adapter.in_double()
    assert (
        held.is_on and held is not adapter and not any(p.requires_grad for p in held.parameters())
    )
    assert {p.dtype for p in held.parameters()} == {torch.float64} and {
        p.dtype for p in adapter.parameters()
    } == {torch.float32}
    assert any(p.requires_grad for p in adapter.parameters())
    with pytest.raises(ConfigError, match="switch_on"):
        made(name).in_double()


@pytest.mark.parametrize("name", LAWS)
def test_it_can_be_copied_and_pickled_after_an_evaluation_with_a_graph(name):
    adapter = on(name, 0.3)
    adapter.follow(torch.tensor(NU).double().requires_grad_(True) * 1.0)
    expected = adapter(state())
    for other in (copy.deepcopy(adapter), pickle.loads(pickle.dumps(adapter))):
        assert torch.equal(other(state()).G, expected.G) and torch.equal(
            other(state()).h, expected.h
        )


@pytest.mark.parametrize("name", NAMES)
def test_a_body_is_simulated_with_it(name):
    """By the simulator of its law, or by one of its own, which only it brings."""
    body = small_body(adapter=False)
    body.adapter = adapter = on(name, 0.1)
    adapter.settle(body.rest, body.volume)
    own = adapter.simulator(body.density, WORLD, FRAME_DT)
    assert (own is not None) == adapter.own_dynamics and (own is None or own.substeps >= 1)
    collected = []
    rollout = body.simulate(start(), WORLD, 3, FRAME_DT, collect=collected.append)
    assert rollout.x.shape == (3, len(body.rest), 3) and bool(torch.isfinite(rollout.x).all())
    assert collected and bool(torch.isfinite(collected[-1].mean_abs_C))


def test_only_what_has_nothing_to_correct_is_left_out():
    for name in NAMES:
        adapter = made(name)
        assert adapter.unsuited(law_named("corotated")) is None
        assert (adapter.unsuited(law_named("newtonian")) is not None) == (adapter.energetic)
    with pytest.warns(UserWarning, match="newtonian has no shear stiffness"):
        assert fitting(made("hyperelastic"), "newtonian") is None
    assert fitting(None, "newtonian") is None


def test_nobody_asks_which_adapter_it_is():
    """Beside the adapters themselves; the engine takes any function that answers an operator, and may look what else it has."""
    root = Path(mosa.__file__).parent
    own = {
        "registry.py",
        *(place.partition(":")[0].rpartition(".")[2] + ".py" for place in ADAPTERS.values()),
    }
    classes = "|".join(place.partition(":")[2] for place in ADAPTERS.values())
    asks = re.compile(
        rf"(has|get)attr\([\w.]*adapter\b|isinstance\([\w.]*adapter\b|\b({classes})\b"
    )
    found = [str(path.relative_to(root)) for path in root.rglob("*.py")
             if not (path.parent.name in ("adapters", "baselines") and path.name in own) and "physics" not in path.parts
             and asks.search("\n".join(line for line in path.read_text().splitlines() if "`" not in line))]  # fmt: skip
    # a part of one, and packages whose subject is the energy that one has
    own_subject = re.compile(r"warm_start\.py$|^(material_tests|export)/|law_stress\.py$")
    assert not [name for name in found if not own_subject.search(name)]
