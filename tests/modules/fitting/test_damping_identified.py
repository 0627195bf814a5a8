"""Stiffness and viscosity of a clamped block from its own free vibration."""

from dataclasses import replace

import pytest
import torch
from small_bodies import FREE, NU, E, cues_of, small_body, start, take_of

from mosa.modules.body.material import Material
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.stages import Stage
from mosa.physics.contact.driven import driven_from_config

CLAMP = {"name": "clamp", "type": "plane", "normal": [1, 0, 0], "position": [-0.021, 0, 0]}
HELD = replace(FREE, driven=driven_from_config([CLAMP]))
FRAMES, DAMPING = 10, 20.0


def body_of(E, damping):
    body = small_body(adapter=False)
    body.material = Material(
        "neo_hookean", {"E": E, "nu": NU, "damping": damping}, frozen=["nu"]
    ).double()
    return body


@torch.no_grad()
def test_both_are_found_from_a_vibration():
    begins = replace(start(0.0, speed=0.8), velocity=torch.tensor([0.0, 0.8, 0.3]).double())
    truth = body_of(E, DAMPING)
    take = take_of(truth, begins, FRAMES, HELD)
    take.cues = cues_of(truth.simulate(begins, HELD, FRAMES, take.frame_dt), begins.rotation)
    body = body_of(0.7 * E, 3 * DAMPING)
    settings = IdentificationSettings(grid_error=0.0, threads=1)
    found = Identification(
        body,
        [take],
        HELD,
        Stage(name="prior", iterations=10, lr=0.1),
        Criterion(name="free"),
        settings,
    )
    found.iterate_until_converged(8)
    values = {name: float(value) for name, value in body.material.physical().items()}
    assert values["E"] == pytest.approx(E, rel=0.02)
    assert values["damping"] == pytest.approx(DAMPING, rel=0.1)
    assert values["bulk_damping"] == 0 and values["nu"] == pytest.approx(NU)
