"""The black-box comparison has the adapter's interface, bounds and start."""

import inspect
from pathlib import Path

import pytest
import torch
from drawn_adapters import E_REF, drawn_states, material_state, randomise
from omegaconf import OmegaConf

from mosa.baselines.direct import DirectAdapter
from mosa.modules.adapters.registry import adapter_class
from mosa.modules.adapters.stress import StressAdapter

CONF = Path(__file__).parents[2] / "conf" / "adapter"


def test_it_starts_as_the_prior_and_is_bounded_and_stress_free_at_rest():
    adapter = DirectAdapter()
    adapter.switch_on(E_REF)
    w, s = drawn_states(30, size=1e3, dtype=torch.float32)
    assert torch.equal(adapter(material_state(w, s)).h, torch.zeros(30, 6))
    randomise(adapter, 10.0)
    answer = adapter(material_state(w, s))
    assert torch.equal(answer.G, torch.zeros(30, 6, 6))
    assert (
        0 < answer.h.abs().max() <= 2 * 0.1 * E_REF
    )  # within l_max, and the same of what it subtracts at rest
    zero = torch.zeros(30, 6)
    assert torch.equal(adapter(material_state(zero, zero)).h, zero)


def test_increment_and_answer_say_the_same():
    adapter = DirectAdapter().double()
    randomise(adapter)
    adapter.switch_on(E_REF)
    w, s = drawn_states(10)
    h = adapter(material_state(w, s)).h
    torch.testing.assert_close(h, E_REF * adapter.increment(w, s), rtol=1e-13, atol=0)


@pytest.mark.parametrize(("name", "kind"), [("mosa", StressAdapter), ("direct", DirectAdapter)])
def test_the_file_lists_the_arguments_with_their_defaults(name, kind):
    """One YAML = one class with explicit keyword arguments."""
    keys = OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml"))
    keys = keys.get("adapter", keys)  # mosa.yaml sets a loss weight beside the adapter
    assert adapter_class(keys) is kind and keys.pop("name")
    arguments = {n: p.default for n, p in inspect.signature(kind).parameters.items()}
    assert keys == {n: arguments[n] for n in keys}
    assert set(arguments) == set(keys)
