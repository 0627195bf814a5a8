"""A step of Adam after which the body cannot be simulated is taken back, and the next ones are half as long."""

import pytest
import torch

from mosa.errors import DataError
from mosa.modules.fitting.retreat import MOST_HALVINGS, Retreat


@pytest.fixture
def stepped():
    """(numbers, Adam after one step of 0.1, the retreat that was told of it)."""
    numbers = torch.nn.Parameter(torch.zeros(3))
    optimizer, retreat = torch.optim.Adam([numbers], lr=0.1), Retreat()
    numbers.square().sum().add(numbers.sum()).backward()
    retreat.note([numbers])
    optimizer.step()
    return numbers, optimizer, retreat


def test_a_step_is_undone_with_its_momentum_and_halved(stepped):
    numbers, optimizer, retreat = stepped
    assert numbers.abs().min() > 0.09 and retreat.share == 1
    assert retreat.back(optimizer, [numbers])
    assert torch.equal(numbers, torch.zeros(3)) and retreat.share == 0.5
    assert (
        not optimizer.state[numbers]["exp_avg"].any()
        and optimizer.state[numbers]["exp_avg_sq"].all()
    )


def test_nothing_is_undone_where_no_step_was_made_or_too_many_were_undone(stepped):
    numbers, optimizer, retreat = stepped
    assert not Retreat().back(optimizer, [numbers])
    assert all(
        retreat.back(optimizer, [numbers]) for _ in range(MOST_HALVINGS)
    ) and not retreat.back(optimizer, [numbers])


def test_it_is_written_and_read_for_the_same_numbers_alone(stepped):
    numbers, optimizer, retreat = stepped
    retreat.back(optimizer, [numbers])
    again = Retreat()
    again.read(retreat.written(), [numbers])
    assert again.halvings == 1 and torch.equal(again.before[0], torch.zeros(3))
    again.read(None, [numbers])  # of a checkpoint that knew none
    assert again.halvings == 0 and again.before is None
    with pytest.raises(
        DataError,
        match=r"mosa\.retreat\.before: expected tensors of shapes \[\(4,\)\], found \[\(3,\)\]",
    ):
        again.read(retreat.written(), [torch.zeros(4)])
