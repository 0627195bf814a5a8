"""Check 17 of docs/verification.md with the full adapter: the scene turned by 90 degrees (F_0 = Q), the scene moved by whole cells.

tests/physics/engine/test_rollout.py does both at once with a linear operator.
"""

import pytest
from bodies import LAWS
from invariance import EYE, differences


@pytest.mark.parametrize("law", LAWS)
def test_17_turned_by_90_degrees_and_moved_by_whole_cells(law):
    """The grid maps onto itself, so only rounding differs (1e-10 dx)."""
    plain, found = differences(law)
    for x, F in found.values():
        assert x < 1e-10
        assert F < 1e-9
    assert float(plain.v[-1][:, 1].mean()) > -0.9  # slowed by the ground: 1.4 m/s in free fall
    assert float((plain.F_tot[-1] - EYE).abs().max()) > 1e-2
