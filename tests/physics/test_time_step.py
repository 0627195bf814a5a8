"""The bound on the time step."""

import pytest

from mosa.errors import ConfigError
from mosa.physics.time_step import courant_number, required_substeps, wave_speed


def test_bounds():
    arguments = {"modulus_max": 4e5, "density": 1000.0, "frame_dt": 0.02, "dx": 0.03}
    assert wave_speed(4e5, 1000.0) == 20.0
    count = required_substeps(**arguments, v_max=1.0)
    assert courant_number(4e5, 1000.0, 0.02 / count, 0.03) <= 0.6 < courant_number(4e5, 1000.0, 0.02 / (count - 1), 0.03)
    assert required_substeps(**arguments, v_max=1.0, factor=4.0) in (2 * count - 1, 2 * count)
    fast = required_substeps(**arguments, v_max=1e3)
    assert 1e3 * 0.02 / fast <= 0.5 * 0.03 < 1e3 * 0.02 / (fast - 1)


@pytest.mark.parametrize(
    "changes, match",
    [
        ({"limit": 10}, "substeps per frame needed.*limit is 10"),
        ({"density": 0.0}, "density"),
        ({"modulus_max": float("nan")}, "modulus_max"),
        ({"v_max": float("inf")}, "v_max"),
        ({"dx": -1.0}, "dx"),
    ],
)
def test_errors(changes, match):
    arguments = {"modulus_max": 4e5, "density": 1000.0, "frame_dt": 0.02, "dx": 0.03, "v_max": 1.0}
    with pytest.raises(ConfigError, match=match):
        required_substeps(**{**arguments, **changes})
