"""Spatial variation of the stiffness: none at the start, bounded always."""

import pytest
import torch
from drawn_adapters import randomise

from mosa.errors import ConfigError
from mosa.modules.body.heterogeneity import HeterogeneityField, HeterogeneitySettings

LOW, HIGH = torch.tensor([-0.1, 0.0, 0.2]), torch.tensor([0.1, 0.4, 0.5])


def places(count: int = 200) -> torch.Tensor:
    return LOW + (HIGH - LOW) * torch.rand(count, 3, generator=torch.Generator().manual_seed(0))


def test_it_starts_at_one_exactly():
    field = HeterogeneityField(LOW, HIGH)
    assert torch.equal(field(places()), torch.zeros(200))
    assert torch.equal(field.factor(places()), torch.ones(200))


@pytest.mark.parametrize("size", [0.3, 30.0])
def test_the_factor_stays_within_its_amplitude_and_varies_in_space(size):
    field = HeterogeneityField(LOW, HIGH, HeterogeneitySettings(amplitude=0.2))
    randomise(field, size)
    factor = field.factor(places())
    assert factor.min() >= 0.8 - 1e-6 and factor.max() <= 1.2 + 1e-6 and factor.std() > 1e-3
    torch.testing.assert_close(factor, 1 + 0.2 * torch.tanh(field(places())))


def test_it_sees_positions_relative_to_the_object():
    field, moved = HeterogeneityField(LOW, HIGH), HeterogeneityField(3 * LOW + 1, 3 * HIGH + 1)
    randomise(field)
    moved.net.load_state_dict(field.net.state_dict())
    torch.testing.assert_close(moved(3 * places() + 1), field(places()), rtol=1e-4, atol=1e-4)


def test_the_network_reads_coordinates_between_minus_one_and_one():
    field, seen = HeterogeneityField(LOW, HIGH), []
    field.net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    field(torch.stack([LOW, HIGH, (LOW + HIGH) / 2]))
    torch.testing.assert_close(seen[0][:, :3], torch.tensor([-1.0, 1, 0])[:, None].expand(3, 3))
    assert seen[0].shape == (3, 15) and seen[0].abs().max() <= 1 + 1e-6


def test_its_last_layer_learns_from_the_first_step():
    field = HeterogeneityField(LOW, HIGH)
    (field.factor(places()) * places()[:, 0]).sum().backward()
    assert field.net[-1].weight.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"amplitude": 1.0}, "amplitude"),
        ({"frequencies": -1}, "frequencies"),
        ({"hidden": 0}, "hidden"),
    ],
)
def test_a_value_out_of_range_is_named(options, message):
    with pytest.raises(ConfigError, match=message):
        HeterogeneityField(LOW, HIGH, HeterogeneitySettings(**options))


def test_a_flat_box_is_refused():
    with pytest.raises(ConfigError, match="no volume"):
        HeterogeneityField(LOW, LOW)
