"""The numbers that a fit ends with: at the end of a range they say that the law is not the body's."""

import warnings

import pytest
import torch

from mosa.modules.body.material import FORMS, Material
from mosa.modules.fitting.parameters import warn_of_ends

SAND = {"E": 1e5, "nu": 0.3, "friction_angle": 40.0, "cohesion": 0.0}
ELASTIC = {"E": 1e5, "nu": 0.4}


@pytest.mark.parametrize("law, begins, ends, said", [
    ("drucker_prager", SAND, {"friction_angle": 88.9}, "friction_angle = 88.9 degrees: at the end"),
    ("drucker_prager", SAND, {"friction_angle": 88.99, "nu": 0.0201}, "nu = 0.0201, friction_angle = 89 degrees: at"),
    ("drucker_prager", SAND, {"friction_angle": 0.1}, "friction_angle = 0.1 degrees"),
    ("neo_hookean", ELASTIC, {"nu": 0.48}, "nu = 0.48: at the end of what the law neo_hookean allows"),
    ("drucker_prager", SAND, {"friction_angle": 60.0, "E": 1e9, "nu": 0.1}, None), ("neo_hookean", ELASTIC, {"nu": 0.47}, None),
    ("neo_hookean", ELASTIC | {"nu": 0.489}, {}, None),  # where the user put it
])  # fmt: skip
def test_a_fit_that_ends_at_the_end_of_a_range_is_said(law, begins, ends, said):
    material = Material(law, begins)
    with torch.no_grad():
        for name, value in ends.items():
            material.raw[name].fill_(FORMS[name].inverse(value))
    if said is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_of_ends(material)
    else:
        with pytest.warns(UserWarning, match=f"^prior.parameters: {said}"):
            warn_of_ends(material)
