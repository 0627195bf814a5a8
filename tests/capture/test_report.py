"""The page of a capture."""

import pytest

from mosa.capture.report import page


@pytest.mark.parametrize(("sd", "said"), [(None, "given"), (0.42, "0.42 degrees")])
def test_an_up_that_was_given_has_no_degrees(sd, said):
    phone = {"name": "a", "fps": 30.0, "seen": 9, "frames": 9, "offset": 0.0, "offset_sd": 0.0, "readout": 0.0, "readout_sd": 0.0,
             "scan": "down", "shift": (0.0, 0.0), "gain": None}  # fmt: skip
    found = {"fall": {"window": (0.1, 0.3), "acceleration": 9.81, "centres": 9, "noise_px": 0.1}, "warnings": [],
             "ground": {"from": "ground", "sd": None, "tilt_degrees": None}, "phones": [phone], "command": "", "scale": 1.0,
             "scale_sd": None, "up": (0.0, 1.0, 0.0), "up_sd_degrees": sd, "radius": 0.1, "frames": 9, "free_frames": 5,
             "rate": 30.0}  # fmt: skip
    (row,) = (line for line in page(found).splitlines() if line.startswith("| up in"))
    assert row.endswith(f"| {said} |")
