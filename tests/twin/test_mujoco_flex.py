"""A body as a mesh for other simulators: its volume and masses, and a flex that MuJoCo drops."""

import numpy as np
import pytest
import torch
from small_bodies import FRAME_DT, NU, E, small_body, start
from small_bodies import STICKY as GROUND

from mosa.errors import ConfigError
from mosa.twin.mujoco_flex import meshed, save_mujoco, save_surface, tetrahedra
from mosa.twin.twin import Twin


def twin(turn=0.0, spin=(0.0, 0.0, 0.0), stiff=E) -> Twin:
    """A block of 6 x 4 x 4 cells, as wide as high, at rest above the ground."""
    body = small_body(adapter=False, counts=(12, 8, 8), contact=True, E=stiff)
    begun = start(height=0.24, speed=0.0, turn=turn, spin=spin)
    return Twin(body, GROUND, FRAME_DT, None, begun)


def values_of(made: Twin) -> dict:
    from mosa.twin.material_files import particles

    return particles(made)


def test_a_mesh_fills_the_body_and_moves_as_it_does():
    made = twin(turn=0.7, spin=(1.0, 2.0, 3.0))
    points, velocities, elements = meshed(made, values_of(made))
    edges = points[elements[:, 1:]] - points[elements[:, :1]]
    volumes = np.linalg.det(edges) / 6
    assert volumes.min() > 0 and volumes.sum() == pytest.approx(float(made.body.volume.sum()))
    begun = made.training_start
    arm = points - begun.center.numpy()
    expected = begun.velocity.numpy() + np.cross(begun.angular_velocity.numpy(), arm)
    assert velocities == pytest.approx(expected)


def test_cells_less_than_half_full_are_left_out():
    places = torch.cartesian_prod(*[torch.arange(n) + 0.5 for n in (6, 4, 4)]).numpy()
    lone = np.vstack([places, [[7.5, 0.5, 0.5]]])  # an eighth of a cell of side 2
    for given in (places, lone):
        nodes, elements = tetrahedra(given, np.ones(len(given)), 2.0)
        volumes = np.linalg.det(nodes[elements[:, 1:]] - nodes[elements[:, :1]]) / 6
        assert len(elements) == 6 * 3 * 2 * 2 and volumes.sum() == pytest.approx(6 * 4 * 4)
    with pytest.raises(ConfigError, match="fills cells of 2 m at least by half"):
        tetrahedra(places[::5], np.ones(len(places[::5])) * 0.3, 2.0)


def test_the_surface_is_closed(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    made = twin(turn=0.7)
    surface = trimesh.load(save_surface(tmp_path / "surface.obj", made, values_of(made)))
    assert surface.is_watertight and surface.is_winding_consistent
    assert surface.volume == pytest.approx(float(made.body.volume.sum()), rel=1e-5)
    assert surface.center_mass == pytest.approx(made.training_start.center.numpy(), abs=1e-5)


def test_a_law_without_E_is_refused(tmp_path):
    made = twin()
    made.material.preset("honey")
    with pytest.raises(ConfigError, match="mujoco needs a law with E and nu, found newtonian"):
        save_mujoco(tmp_path / "mujoco.xml", made, values_of(made))


def test_what_the_file_cannot_hold_is_said(tmp_path):
    made = twin()
    made.material.preset("dry_sand")
    with pytest.warns(UserWarning, match="hold E and nu alone, without the law drucker_prager"):
        made.export_material(tmp_path, ["mujoco"])


def test_mujoco_drops_the_body(tmp_path):
    """Free fall as ours; then MuJoCo's nodes lose their velocity at contact: its rebound is 9 %
    lower, its centre up to 25 % of that away within 0.3 s of contact (docs/simulators.md)."""
    mujoco = pytest.importorskip("mujoco")
    made = twin(stiff=1e5)
    made.material.damping = 1e-3
    path = made.export_material(tmp_path, ["mujoco"]) / "mujoco.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    mass = model.body_mass[1:]
    assert mass.sum() == pytest.approx(1000 * float(made.body.volume.sum()), rel=1e-5)
    assert model.flex_damping[0] == pytest.approx(2 * (1 + NU) * 1e-3 / 1e5, rel=1e-5)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    rollout = made.simulate(frames=29)
    ours, heights = rollout.x[:, :, 1].mean(1).numpy(), []
    for time in rollout.times.tolist():
        while data.time < time - 0.5 * model.opt.timestep:
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        heights.append(float(data.subtree_com[0, 1]))
    assert heights[-1] == pytest.approx(mass @ data.xipos[1:, 1] / mass.sum())
    contact = 10
    assert np.abs(heights - ours)[:contact].max() < 1e-3
    low = int(ours.argmin())
    rebound = ours[low:].max() - ours.min()
    assert max(heights[low:]) - min(heights) == pytest.approx(rebound, rel=0.1)
    assert np.abs(heights - ours)[contact:].max() < 0.28 * rebound
