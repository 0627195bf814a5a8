"""Check 31: a held beam (`driven_beam`), coarse; docs/driven.md has its convergence."""

import pytest
from driven_beam import beam


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_31_a_clamp_is_stiff_wherever_its_face_is_in_a_cell(offset):
    found = beam(20, offset=offset, frames=41)
    assert found.sag == pytest.approx(1, abs=0.04)
    assert found.frequency == pytest.approx(1, abs=0.02)
    assert found.reaction == pytest.approx(1, abs=0.01)
    assert found.torque == pytest.approx(1, abs=0.01)
    assert found.drift < 1e-4
