"""A 3DGS file becomes a body without any video: filled, given a law, dropped, exported, and read again."""

import math
import warnings
from dataclasses import replace

import cv2
import forked
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from strangers import ROOT, checkpoint

from mosa.config.leaf_settings import SplatsSettings
from mosa.data.formats.scene_from_footage import check_density
from mosa.data.io.gaussian_ply import save_ply
from mosa.errors import ConfigError, DataError
from mosa.reconstruction.geometry.filling import body_volume
from mosa.reconstruction.geometry.shell import blocked, solid_of
from mosa.splats.objects import object_twin, read_object, save_twin
from mosa.training.preflight import check_splats
from mosa.twin.twin import Twin
from mosa.types import Appearance, Splats
from mosa.viewer.clips import read_run

RADIUS = 0.1
BALL = 4 / 3 * math.pi * RADIUS**3
LAW = {"seed": 0, "prior": {"law": "neo_hookean", "parameters": {"E": 5e4, "nu": 0.3}, "frozen": []},
       "simulation": {"stride": 8, "max_substeps": 400, "courant": 0.6, "precision": 32, "contact_offset": True},
       "heterogeneity": {"enabled": False}, "adapter": {"name": None}}  # fmt: skip


def settings(particles: int, **keys) -> SplatsSettings:
    """Of an object that falls onto a ground that it sticks to, unless these keys say otherwise."""
    simulation = {**LAW["simulation"], "particles": particles}
    ground = {"mode": "sticky", "friction": 0.0}
    return SplatsSettings.read(
        {**LAW, "ply": "", "ground": ground, "simulation": simulation, **keys}
    )


def ball(count: int = 1500, scale: float = 0.004, open_at: float | None = None) -> Appearance:
    """Flat Gaussians on a sphere, harmonics of degree 1; open_at: none below this height."""
    g = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    if open_at is not None:
        normal = normal[RADIUS * normal[:, 1] > open_at]
    axis = torch.linalg.cross(torch.tensor([0.0, 0, 1]).expand_as(normal), normal)
    turns = Rotation.from_rotvec(
        (torch.nn.functional.normalize(axis, dim=1) * normal[:, 2:].clamp(-1, 1).acos()).numpy()
    )
    rotations = torch.as_tensor(turns.as_quat(scalar_first=True)).float()
    scales = scale * torch.tensor([1.0, 1, 0.3]).expand_as(normal)
    harmonics = 0.2 * torch.randn(len(normal), 4, 3, generator=g)
    colors = 0.5 + 0.28209479 * harmonics[:, 0]
    return Appearance(
        Splats(RADIUS * normal, scales, rotations, torch.full((len(normal),), 0.9), colors),
        harmonics,
    )


def test_a_line_is_blocked_where_it_meets_the_shell():
    shell = np.zeros((5, 6, 7), bool)
    shell[3, 4, 5] = True
    assert np.argwhere(blocked(shell, (1, 1, 1))).tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert np.argwhere(blocked(shell, (0, 0, -1))).tolist() == [[3, 4, 6]]
    assert np.argwhere(blocked(shell, (-1, 1, 0))).tolist() == [[4, 3, 5]]


@pytest.mark.parametrize(("resolution", "error"), [(40, 0.12), (80, 0.08)])
def test_a_shell_is_filled(resolution, error):
    assert body_volume(solid_of(ball().splats, resolution=resolution)) == pytest.approx(
        BALL, rel=error
    )


def test_an_open_underside_is_closed_where_that_is_said():
    opened = ball(open_at=-0.06).splats
    cap = math.pi * 0.04**2 * (3 * RADIUS - 0.04) / 3
    volume = body_volume(solid_of(opened, resolution=48, up=torch.tensor([0.0, 1, 0])))
    assert volume == pytest.approx(BALL - cap, rel=0.12)


def test_what_encloses_nothing_is_named(tmp_path):
    point = ball().splats
    with pytest.raises(DataError, match="extent 0"):
        solid_of(replace(point, means=torch.zeros_like(point.means)))
    path = save_ply(tmp_path / "a.ply", ball().splats)
    with pytest.raises(
        DataError,
        match=r"a\.ply: expected at least 100 Gaussians .* in the box, found 0 of 1500; the file spans",
    ):
        read_object(path, box=[[1, 1, 1], [2, 2, 2]])
    with pytest.raises(ConfigError, match="box: expected two corners"):
        read_object(path, box=[[1, 1, 1], [0, 2, 2]])


def test_a_file_in_other_units_gets_its_size(tmp_path, caplog):
    caplog.set_level("INFO")
    source = ball()
    path = save_ply(tmp_path / "a.ply", source.splats, source.harmonics)
    found = read_object(path, size=0.5)
    extent = (found.splats.means.amax(0) - found.splats.means.amin(0)).max()
    assert float(extent) == pytest.approx(0.5) and torch.allclose(found.harmonics, source.harmonics)
    factor = 0.5 / float((source.splats.means.amax(0) - source.splats.means.amin(0)).max())
    assert torch.allclose(found.splats.scales, factor * source.splats.scales, rtol=1e-5)
    assert f"1 unit of the file is {factor:.6g} m" in caplog.text


def test_the_object_falls_and_can_be_read_again(tmp_path):
    """It bounces on its ground, the Gaussians stay on its surface, and its checkpoint gives the same motion."""
    ground = {"mode": "separate", "friction": 0.3}
    twin = object_twin(ball(), settings(300, height=0.1, up=[0, 0, 2.0], ground=ground))
    assert 250 < len(twin.body.rest) < 380 and torch.allclose(
        twin.world.gravity, torch.tensor([0.0, 0, -9.81])
    )
    assert float(twin.body.volume.sum()) == pytest.approx(BALL, rel=0.1)
    rollout = twin.simulate(frames=10)
    lowest = rollout.x[:, :, 2].amin(1) - twin.world.ground.height
    assert (
        float(lowest[0]) == pytest.approx(0.1, abs=1e-5)
        and 0 < float(lowest.min()) < twin.body.settings.dx
    )
    carried = twin.body.splats.carry(rollout.x)
    far = torch.cdist(carried.means[-1], rollout.x[-1]).amin(1)
    assert float(far.max()) < 0.05
    folder = twin.export(rollout, tmp_path, video=False, formats=("ply",))
    vertex = PlyData.read(folder / "splats" / "ply" / "009.ply")["vertex"]
    assert len(vertex) == len(twin.body.splats) and np.allclose(
        vertex["z"], carried.means[-1, :, 2].numpy()
    )
    again = Twin.load(save_twin(twin, tmp_path / "checkpoints" / "last.ckpt"))
    assert torch.equal(again.simulate(frames=10).x, rollout.x)
    clip = read_run(tmp_path)[0]
    assert clip.name == "simulation" and clip.splats("learned", 9, "appearance")[0].shape == (
        len(twin.body.splats),
        3,
    )


def test_it_falls_on_an_obstacle_that_its_checkpoint_keeps(tmp_path):
    """Placed below its middle in a scene whose origin is there, whatever the file's origin and up."""
    source = ball()
    far = replace(source.splats, means=source.splats.means + torch.tensor([3.0, -2.0, 5.0]))
    table = {"type": "box", "size": [0.4, 0.4, 0.1], "position": [0, 0, -0.05], "mode": "sticky"}
    more = {"height": 0.15, "up": [0, 0, -2.0], "resolution": 40, "recentre": True}
    twin = object_twin(replace(source, splats=far), settings(150, colliders=[table], **more))
    assert twin.world.ground.height == pytest.approx(0.0, abs=1e-5)
    middle = twin.body.splats.means.mean(0)
    assert torch.allclose(middle, torch.tensor([0.0, 0.0, -0.15 - RADIUS]), atol=0.02)
    rollout = twin.simulate(frames=8)
    assert float(rollout.reactions[..., 2].max()) > 1.0  # N, downwards: along +z here
    assert float((-rollout.x[:, :, 2]).min()) > 0.07
    again = Twin.load(save_twin(twin, tmp_path / "last.ckpt"))
    assert torch.equal(again.simulate(frames=8).x, rollout.x)


def test_particles_can_be_shown_in_place_of_splats(tmp_path):
    twin = object_twin(ball(600, 0.007), settings(100, resolution=32, appearance="particles"))
    assert twin.body.splats is None
    again = Twin.load(save_twin(twin, tmp_path / "last.ckpt"))
    assert again.body.splats is None and torch.equal(again.body.colors, twin.body.colors)


def test_an_obstacle_below_the_ground_is_said():
    made = {"up": [0, -1, 0], "resolution": 32, "recentre": True}
    ends = [{"type": "sphere", "radius": 0.05, "position": [0, y, 0]} for y in (-0.05, 0.05, 0.06)]
    twin = object_twin(ball(600, 0.007), settings(100, colliders=ends, **made))
    with pytest.warns(
        UserWarning,
        match=r"\[2\]: .* above the ground, found its highest point 0.01\d* m below it: up is \[0.0, -1",
    ) as said:
        twin.simulate(frames=2)
    assert len([each for each in said if "below it" in str(each.message)]) == 1


def test_a_density_of_nothing_is_refused_and_an_unlikely_one_is_said():
    for density in (0.01, 1e-9, 1e6):
        with pytest.raises(ConfigError, match=r"^density: expected a number of at least 0\.1"):
            object_twin(ball(), settings(100, density=density))
    with pytest.warns(UserWarning, match=r"^density: 1 kg/m\^3 is lighter .* in g/cm\^3"):
        check_density("density", 1.0)


def test_a_learned_law_is_taken_over(tmp_path):
    """Material, contact and operator, not the stiffness field of another body's places."""

    def stiffer(stored):
        state = stored["state_dict"]
        name = next(
            key for key in state if key.startswith("body.material") and state[key].ndim == 0
        )
        state[name] = state[name] + 0.7

    learned = Twin.load(checkpoint(tmp_path / "a.ckpt", change=stiffer))
    twin = object_twin(ball(), settings(200), learned)
    for name, value in learned.body.material.physical().items():
        assert twin.body.material.physical()[name].item() == pytest.approx(value.item())
    assert twin.body.heterogeneity is None and twin.body.density == learned.body.density
    assert type(twin.body.adapter) is type(learned.body.adapter)
    assert len(twin.simulate(frames=2).x) == 2


def test_the_command_makes_all_of_it(tmp_path):
    source = ball(count=600, scale=0.007)
    path = save_ply(tmp_path / "ball.ply", source.splats, source.harmonics)
    arguments = [f"ply={path}", "simulation.particles=150", "frames=3", "resolution=32", "formats=[ply]",
                 "recentre=true", "colliders=[{type:sphere,radius:0.05,position:[0,0.05,0]}]",
                 "velocity=[60,0,0]",  # farther than any box around the object
                 "preset=jelly", "film={size:[96,64],fps:30,shadow:false,caption:false}",
                 "film.view=[[1,0.3,0],[0,0.3,1]]",
                 f"hydra.run.dir={tmp_path / 'run'}"]  # fmt: skip
    done = forked.call("mosa/splats/__main__.py", *arguments)
    assert done.returncode == 0, done.stderr[-2000:]
    for name in (
        "splats/ply/002.ply",
        "simulation.mp4",
        "rollout.npz",
        "checkpoints/last.ckpt",
    ):
        assert (tmp_path / "run" / name).is_file(), name
    dropped = Twin.load(tmp_path / "run" / "checkpoints" / "last.ckpt").material
    assert (dropped.E, dropped.density) == pytest.approx((4.3e3, 1010.0))
    film = cv2.VideoCapture(str(tmp_path / "run" / "simulation.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_WIDTH) == 96 and film.get(cv2.CAP_PROP_FPS) == 30
    assert film.get(cv2.CAP_PROP_FRAME_HEIGHT) == 64  # no caption
    said = done.stdout + done.stderr
    assert "no size given: 1 unit is 1 m;" in said and "600 Gaussians, 0.2 m long; " in said
    assert "ground at 0.0 m along it" in said and "film: 100% 3/3" in said


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("share", 2, "share: expected a number above 0 and at most 1, found 2"),
        (
            "formats",
            ["obj"],
            "formats: expected a list of some of ply, gltf, sog, usd, rrd .to other",
        ),
        ("box", [[0, 0, 0]], "box: expected two corners"),
        ("up", [0, 1], "up: expected three"),
        ("preset", "rubber", "preset: expected one of jelly, "),
        ("colliders", [{"type": "sphere"}], "colliders"),
        ("film", {"view": [0, 2, 0]}, r"^film\.view: expected a direction that is not up or down"),
        (
            "film",
            {"view": [[1, 0, 0], [0, 2, 0]]},
            r"^film\.view: expected a direction that is not",
        ),
        ("film", {"view": []}, r"^film\.view: expected three numbers, or a list of such, or null"),
        ("film", {"zoom": 30}, r"^film\.zoom: expected a number above 0 and at most 20, or a list"),
        ("film", {"size": [160, 90, 3]}, r"^film\.size: expected a whole number .*, or two such"),
    ],
)
def test_a_wrong_value_is_named(key, value, message):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        values = OmegaConf.to_container(compose("splats", overrides=["ply=a.ply"]), resolve=True)
    with pytest.raises(ConfigError, match=message):
        check_splats(values | {key: value})


def test_a_view_from_below_is_said():
    values = {**LAW, "ply": "a.ply"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_splats(values | {"film": {"size": [160, 90], "view": [[1, 0.3, 1], [1, 0, 0]]}})
    with pytest.warns(UserWarning, match=r"^film\.view: .* from below the object, as up is \[0"):
        check_splats(values | {"up": [0, -1, 0], "film": {"view": [1, 0.3, 1]}})


@pytest.mark.parametrize(
    "words",
    [["prior.parameters.E=1e6"], ["prior=corotated", "adapter=operator"], ["ckpt_path=a.ckpt"]],
)
def test_a_preset_beside_another_law_is_refused(words):
    values = {**LAW, "ply": "a.ply", "preset": "jelly"}
    check_splats(values, ["preset=jelly", "simulation.particles=100"])
    with pytest.raises(
        ConfigError, match=f"^preset: jelly sets .*, found {' '.join(words)}; leave"
    ):
        check_splats(values, ["preset=jelly", *words])


def test_a_law_that_changes_nothing_is_said():
    """An adapter without a checkpoint is the prior; beside one the prior's and the adapter's keys are not read."""
    values, operator = {**LAW, "ply": "a.ply"}, {"adapter": {"name": "hyperelastic"}}
    learned = {"ckpt_path": "a.ckpt"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_splats(values, ["prior=corotated"])
        check_splats(values | learned, ["ckpt_path=a.ckpt"])
    with pytest.warns(UserWarning, match="^adapter: no effect here: .* ckpt_path="):
        check_splats(values | operator, ["adapter=operator"])
    with pytest.warns(UserWarning, match="^adapter=operator: no effect here: .* ckpt_path$"):
        check_splats(values | operator | learned, ["ckpt_path=a.ckpt", "adapter=operator"])
