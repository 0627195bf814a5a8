"""Check 32: the decay of a damped rod (`damped_bar`); docs/results/contact.md has all grids and viscosities."""

import pytest
from damped_bar import GRIDS, RATIOS, SPEED, K, decay


@pytest.mark.parametrize("cells", GRIDS[:2])
def test_32_a_damped_rod_decays_as_the_closed_form(cells):
    """Beside what the scheme damps by itself, which falls with the third power of the spacing."""
    own = decay(cells, 0.0)
    for ratio in RATIOS:
        rate = decay(cells, ratio)
        assert (rate - own) / (ratio * K * SPEED) == pytest.approx(1, abs=0.03)
    assert 0 < own < 1e-3 * K * SPEED
