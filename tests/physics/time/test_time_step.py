"""The bound on the time step."""

import math

import pytest
import torch

from mosa.errors import ConfigError, SimulationDiverged
from mosa.modules.body.material import Material
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import VISCOUS_NUMBER, required_substeps, wave_speed


def test_bounds():
    arguments = {"modulus_max": 4e5, "density": 1000.0, "frame_dt": 0.02, "dx": 0.03}
    assert wave_speed(4e5, 1000.0) == 20.0
    count = required_substeps(**arguments, v_max=1.0)
    assert (
        20.0 * 0.02 / count / 0.03 <= 0.6 < 20.0 * 0.02 / (count - 1) / 0.03
    )  # the Courant number c dt/dx
    assert required_substeps(**arguments, v_max=1.0, factor=4.0) in (2 * count - 1, 2 * count)
    fast = required_substeps(**arguments, v_max=1e3)
    assert 1e3 * 0.02 / fast <= 0.5 * 0.03 < 1e3 * 0.02 / (fast - 1)


@pytest.mark.parametrize(
    "changes, match",
    [
        ({"limit": 10}, "substeps per frame needed.*limit is 10"),
        ({"density": 1.0, "limit": 90}, "density 1 kg/m.*, a softer or denser body, or raise"),
        ({"v_max": 1e3, "limit": 90}, "speed 1e.03 m/s.*, a slower start or slower solids, fewer"),
        ({"density": 0.0}, "density"),
        ({"modulus_max": float("nan")}, "modulus_max"),
        ({"v_max": float("inf")}, "v_max"),
        ({"viscosity": -1.0}, "viscosity"),
        ({"viscosity": 1e6}, r"viscosity 1e\+06 Pa s.*limit is 10000"),
        ({"dx": -1.0}, "dx"),
    ],
)
def test_errors(changes, match):
    arguments = {"modulus_max": 4e5, "density": 1000.0, "frame_dt": 0.02, "dx": 0.03, "v_max": 1.0}
    with pytest.raises(ConfigError, match=match):
        required_substeps(**{**arguments, **changes})


def test_a_viscous_fluid_needs_the_viscous_bound(make_block):
    """Noise on a fluid of 1 kPa s: it decays at the bound's step, and grows without limit at that of the sound speed alone."""
    state = make_block(velocity=(0.0, 0.0, 0.0))
    dx, frame_dt, mu, kappa, density = 0.04, 0.05, 1e3, 1e2, 1000.0
    bound = {
        "modulus_max": 7 * kappa,
        "density": density,
        "frame_dt": frame_dt,
        "dx": dx,
        "v_max": 1.0,
    }
    sound, both = required_substeps(**bound), required_substeps(**bound, viscosity=mu)
    waves = wave_speed(7 * kappa, density) / (0.6 * dx)
    assert (
        both == math.ceil(frame_dt * (waves + mu / (VISCOUS_NUMBER * density * dx**2))) > 5 * sound
    )
    speeds = {}
    for count in (sound, both):
        sim = Simulator(
            "newtonian",
            dx=dx,
            substeps=count,
            frame_dt=frame_dt,
            gravity=(0, 0, 0),
            dtype=torch.float64,
        )
        F = torch.eye(3, dtype=torch.float64).expand_as(state.F).contiguous()
        start = type(state)(state.x, state.v, 0 * state.C_affine, F, F)
        volume = torch.full((len(state.x),), 0.02**3, dtype=torch.float64)
        try:
            with torch.no_grad():
                v = sim.rollout(start, {"mu": mu, "kappa": kappa}, volume, density, 5).v
            speeds[count] = float((v[-1] - v[-1].mean(0)).abs().max())
        except SimulationDiverged:
            speeds[count] = math.inf
    noise = float((state.v - state.v.mean(0)).abs().max())
    assert speeds[both] < noise < speeds[sound]


def test_materials_give_the_step_physical_values():
    """The fluid's viscosity bounds the step, times the heterogeneity; that of Herschel-Bulkley is integrated implicitly."""
    fluid = Material("newtonian", {"mu": 100.0, "kappa": 1e5})
    assert float(fluid.max_viscosity()) == pytest.approx(100.0, rel=1e-6)
    assert float(fluid.max_viscosity(torch.tensor([0.8, 1.2]))) == pytest.approx(120.0, rel=1e-6)
    paste = Material(
        "herschel_bulkley", {"mu": 3e4, "kappa": 2e5, "yield_stress": 2e3, "viscosity": 10.0}
    )
    assert float(paste.max_viscosity()) == 0.0
    assert float(paste.max_modulus()) == pytest.approx(2.4e5, rel=1e-6)
