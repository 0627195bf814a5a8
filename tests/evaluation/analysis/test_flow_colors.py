"""Flow pictures: hue is direction, saturation is length."""

import colorsys
import math

import pytest
import torch

from mosa.errors import DataError
from mosa.evaluation.analysis.flow_colors import color_wheel, flow_colors


@pytest.mark.parametrize("angle", [0, 60, 135, 200, 330])
@pytest.mark.parametrize("length", [0.0, 1.0, 2.0, 9.0])
def test_against_colorsys(angle, length):
    vector = length * torch.tensor([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    found = flow_colors(vector.expand(2, 3, 4, 2), largest=4.0)
    wanted = torch.tensor(
        colorsys.hsv_to_rgb(angle / 360, min(length / 4, 1), 1.0), dtype=torch.float32
    )
    torch.testing.assert_close(found, wanted.expand(2, 3, 4, 3), rtol=0, atol=2e-6)


def test_longest_flow_has_full_colour_and_rest_is_white():
    flow = torch.zeros(5, 6, 2)
    assert torch.equal(flow_colors(flow), torch.ones(5, 6, 3))
    flow[2, 3, 0] = 0.25
    found = flow_colors(flow)
    torch.testing.assert_close(found[2, 3], torch.tensor([1.0, 0.0, 0.0]))
    assert torch.equal(found[0], torch.ones(6, 3))


def test_wheel_is_white_in_the_middle_and_outside():
    wheel = color_wheel(65)
    assert wheel.shape == (65, 65, 3)
    assert float(wheel[32, 32].min()) > 0.95 and torch.equal(wheel[0, 0], torch.ones(3))
    assert (
        wheel[32, 63].argmax() == 0 and wheel[32, 1].argmin() == 0
    )  # red to the right, cyan to the left


def test_broken_flow_is_named():
    with pytest.raises(DataError, match="expected finite flow, found 1 NaN"):
        flow_colors(torch.tensor([[[0.0, float("nan")]]]))
