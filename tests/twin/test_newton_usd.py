"""A twin for other simulators: its numbers, and a body that newton loads and drops."""

import json

import numpy as np
import pytest
import torch
from small_bodies import DX, FRAME_DT, NU, STICKY, E, small_body, start

from mosa.errors import ConfigError
from mosa.system.npz import read_npz
from mosa.twin.newton_usd import STEP
from mosa.twin.twin import Twin

SUBSTEPS = 32
"""Of a frame, in newton: longer steps of its implicit integration damp the rebound."""


def twin(height=0.12, **options):
    return Twin(
        small_body(**options), STICKY, FRAME_DT, None, start(height=height, speed=-1.0, turn=0.4)
    )


def varied():
    made = twin(modes=True)
    with torch.no_grad():
        made.body.heterogeneity.coefficients.normal_(generator=torch.Generator().manual_seed(0))
    return made


def test_numbers_of_every_particle_and_what_they_leave_out(tmp_path):
    made = varied()
    made.body.adapter.numbers.data[0] = 0.1
    made.material.damping = 4.0
    made.export_material(tmp_path)
    known = json.loads((tmp_path / "material.json").read_text())
    assert known["E_Pa"] == pytest.approx(E) and known["damping_Pa_s"] == pytest.approx(4)
    assert np.shape(known["stiffness_Pa"]) == (6, 6) and "anisotropy" in known["not_in_E_and_nu"][0]
    found = read_npz(tmp_path / "particles.npz")
    assert found["mass"].sum() == pytest.approx(1000 * float(made.body.volume.sum()))
    assert found["E"] == pytest.approx(E * made.material.field.numpy())
    assert np.ptp(found["E"]) > 0.01 * E
    begun = made.reset(frames=2).positions
    assert found["points"] == pytest.approx(begun.numpy(), abs=1e-6)
    with pytest.raises(
        ConfigError, match="expected a list of some of json, npz, newton_usd, mujoco, obj, found"
    ):
        made.export_material(tmp_path, ["urdf"])


@pytest.mark.slow
def test_newton_loads_points_masses_and_moduli(tmp_path):
    pytest.importorskip("pxr")
    newton = pytest.importorskip("newton")
    made = varied()
    made.material.damping = 4.0
    path = made.export_material(tmp_path, ["newton_usd"]) / "newton.usda"
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.add_usd(str(path))
    model = builder.finalize(device="cpu")
    n = len(made.body.rest)
    assert model.particle_count == n
    begun = made.reset(frames=2)
    assert np.allclose(model.particle_q.numpy(), begun.positions.numpy(), atol=1e-6)
    assert np.allclose(model.particle_mass.numpy(), (made.body.volume * 1000).numpy(), rtol=1e-5)
    moduli = made.material.E * made.material.field.numpy()
    assert np.allclose(model.mpm.young_modulus.numpy(), moduli, rtol=STEP)
    assert np.allclose(model.mpm.poisson_ratio.numpy(), NU)
    expected = 2 * (1 + NU) * 4.0 / moduli
    assert np.allclose(model.mpm.damping.numpy(), expected, rtol=STEP)


def fall_in_newton(newton, path, times):
    """(T,) height of the centre of mass [m] of the file's body over a ground at 0, on a CPU."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.add_usd(str(path))
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    config = newton.solvers.SolverImplicitMPM.Config()
    config.voxel_size, config.grid_type = DX, "dense"
    solver = newton.solvers.SolverImplicitMPM(model, config)
    now, then, control = model.state(), model.state(), model.control()
    heights, time, dt = [], 0.0, FRAME_DT / SUBSTEPS
    for wanted in times:
        while time < wanted - 0.5 * dt:
            solver.step(now, then, control, None, dt)
            now, then, time = then, now, time + dt
        heights.append(float(now.particle_q.numpy()[:, 1].mean()))
    return np.array(heights)


@pytest.mark.slow
def test_newton_drops_an_isotropic_body(tmp_path):
    """Its centre is where ours is to 10 % of the rebound, from contact to 0.3 s after it, and
    rebounds as high to 10 % (docs/simulators.md). newton's contact begins up to half a cell higher:
    its motion is compared later by at most the time that the body takes for that way."""
    pytest.importorskip("pxr")
    newton = pytest.importorskip("newton")
    made = twin(adapter=False, height=0.16)
    rollout = made.simulate(frames=24)
    path = made.export_material(tmp_path, ["newton_usd"]) / "newton.usda"
    times = rollout.times.numpy()
    heights = fall_in_newton(newton, path, times.tolist())
    ours = rollout.x[:, :, 1].mean(1).numpy()
    # backward Euler is ahead of the parabola by g t dt/2
    ahead = 9.8 * times * (FRAME_DT / SUBSTEPS) / 2
    assert (np.abs(heights - ours) < ahead + 1e-3)[:4].all()
    low = int(ours.argmin())
    rebound = ours[low:].max() - ours.min()
    assert heights[low:].max() - heights.min() == pytest.approx(rebound, rel=0.1)
    speed = (ours[3] - ours[4]) / FRAME_DT
    delays = np.linspace(0, 0.5 * DX / speed, 20)
    away = [np.abs(np.interp(times, times + d, heights) - ours)[4:23].max() for d in delays]
    assert min(away) < 0.1 * rebound
