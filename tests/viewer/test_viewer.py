"""What the viewer shows of a run: read from its folder, painted, placed; and, where viser is installed, served."""

import math
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import torch

from mosa.cli.view import main as view
from mosa.config.build import build_world
from mosa.errors import ConfigError, DataError
from mosa.modules.body.body import Body, SimulationSettings, Start
from mosa.modules.body.heterogeneity import HeterogeneityField, HeterogeneitySettings
from mosa.modules.body.material import Material
from mosa.physics.contact.colliders import colliders_from_config, domain_walls
from mosa.rendering.appearance.carried_splats import CarriedSplats
from mosa.twin.rollout_file import save_observed, save_rollout
from mosa.twin.twin import Twin
from mosa.types import Appearance, MotionCues, Rollout, Splats
from mosa.viewer import recorded as viewer
from mosa.viewer.clips import GRAY, Arrays, Scale, covariances, read_run
from mosa.viewer.pages import FIELD_OF_VIEW, beside_panel, own_page, view_of

N, T, SEEN = 27, 5, 3
GROUND = -0.2
LOAD = Twin.load


def rollout(shift: float) -> Rollout:
    """A small cube that falls and is squashed along y in the second half."""
    axis = torch.tensor([0.0, 0.05, 0.1])
    rest = torch.cartesian_prod(axis, axis, axis)
    x = torch.stack([rest + torch.tensor([shift, 0.5 - 0.1 * t, 0.0]) for t in range(T)])
    F = torch.eye(3).expand(T, N, 3, 3).clone()
    F[3:, :, 1, 1] = 0.5
    return Rollout(
        x=x,
        v=torch.zeros_like(x),
        F=F,
        F_tot=F,
        times=torch.arange(T) / 50,
        final=None,
        counts=[8] * (T - 1),
    )


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run folder: one sequence that was observed for three frames, and a held-out one."""
    tensors = {"rest": rollout(0).x[0], "volume": torch.full((N,), 1e-4), "colors": torch.full((N, 3), 0.25),
               "opacities": torch.full((N,), 0.9), "covariances": 1e-4 * torch.eye(3).expand(N, 3, 3).clone()}  # fmt: skip
    world = {
        "ground": {"height": GROUND},
        "gravity": [0, -9.8, 0],
        "up": [0, 1, 0],
        "box": [[-1, -1, -1], [1, 1, 1]],
    }
    field = HeterogeneityField(
        tensors["rest"].amin(0), tensors["rest"].amax(0), HeterogeneitySettings(hidden=8)
    )
    material = Material("neo_hookean", {"E": 1e5, "nu": 0.3})
    body = Body(
        **tensors,
        density=1000.0,
        material=material,
        heterogeneity=field,
        adapter=None,
        settings=SimulationSettings(dx=0.1),
    )
    with torch.no_grad():
        for p in body.heterogeneity.parameters():
            p.copy_(
                torch.randn(p.shape, generator=torch.Generator().manual_seed(0))
                if p.dim() == 2
                else torch.zeros_like(p)
            )
    twin = Twin(
        body,
        build_world(world),
        0.02,
        None,
        Start(torch.eye(3), torch.zeros(3), torch.zeros(3), torch.zeros(3)),
    )
    monkeypatch.setattr(Twin, "load", lambda path: twin)
    (tmp_path / "checkpoints").mkdir()
    save_rollout(tmp_path / "rollout.npz", {"train": rollout(0), "test/test_60": rollout(0.2)})
    save_rollout(tmp_path / "prior.npz", {"train": rollout(-0.03), "test/test_60": rollout(0.2)})
    seen = rollout(0.01)
    cues = MotionCues(
        seen.x[:SEEN],
        *(torch.zeros(SEEN, N, 3, 3) for _ in range(2)),
        torch.ones(SEEN, N),
        2e-4 * seen.F[:SEEN],
    )
    save_observed(tmp_path / "observed.npz", {"train": cues})
    np.savez(
        tmp_path / "truth.npz",
        **{"train/x": seen.x.numpy(), "test/test_60/x": turned(seen.x.numpy())},
    )
    return tmp_path


def turned(x: np.ndarray) -> np.ndarray:
    """About the vertical by 90 degrees, and stretched to double along it."""
    return x @ np.array([[0, 0, -1.0], [0, 2, 0], [1, 0, 0]], np.float32)


def test_a_run_is_read_with_what_it_observed(run):
    train, test = read_run(run)
    assert (train.name, test.name) == ("train", "test/test_60") and len(train.times) == T
    assert (list(train.bodies), list(test.bodies)) == (
        ["observed", "prior", "learned"],
        ["truth", "prior", "learned"],
    )
    assert (train.reference, test.reference) == ("observed", "truth") and train.models == [
        "prior",
        "learned",
    ]
    assert train.bodies["observed"].centers.shape == (SEEN, N, 3) and test.bodies[
        "truth"
    ].centers.shape == (T, N, 3)
    assert np.allclose(train.bodies["prior"].centers, rollout(-0.03).x)
    # A = F A_0 F^T: squashed to half, a covariance is a quarter along y
    assert np.allclose(train.learned.covariances[4, 0], np.diag([1e-4, 0.25e-4, 1e-4]))
    assert np.allclose(
        test.bodies["truth"].covariances[0, 0], np.diag([1e-4, 4e-4, 1e-4]), atol=1e-7
    )  # by the fit to positions
    assert (
        train.deviation(0) == pytest.approx(np.full(N, 0.01), rel=1e-4)
        and train.deviation(SEEN) is None
    )
    assert train.deviation(0, "prior") == pytest.approx(np.full(N, 0.04), rel=1e-4)
    far = np.linalg.norm(rollout(0.2).x[4].numpy() - turned(rollout(0.01).x.numpy())[4], axis=-1)
    assert test.deviation(4) == pytest.approx(far, rel=1e-5) == test.deviation(4, "prior")
    assert "**train**, frame 1, 0.020 s" in train.caption(
        1
    ) and "Not observed in this frame" in train.caption(4)
    assert "rms distance to the observed motion: prior 40.0 mm, learned 10.0 mm" in train.caption(1)
    both = 1e3 * np.sqrt(np.mean(far**2))
    assert (
        f"rms distance to the true motion: prior {both:.1f} mm, learned {both:.1f} mm"
        in test.caption(4)
    )
    assert "Ground grid: 100 mm" in train.caption(1) and "Not drawn" not in train.caption(1)
    walled = replace(train, world=replace(train.world, planes=domain_walls(train.world.box)))
    assert "Not drawn: walls (6)" in walled.caption(1)


def test_a_run_of_fewer_files_is_read(run):
    """As older runs left them, and those of captures, whose true motion is not known."""
    (run / "prior.npz").unlink()
    train, test = read_run(run)
    assert list(train.bodies) == ["observed", "learned"] and list(test.bodies) == [
        "truth",
        "learned",
    ]
    assert (
        train.caption(1)
        .splitlines()[1]
        .endswith("rms distance to the observed motion: learned 10.0 mm  ")
    )
    assert viewer.layouts(train) == ("side by side", "learned over observed", "observed", "learned")
    (run / "truth.npz").unlink()
    test = read_run(run)[1]
    assert (
        list(test.bodies) == ["learned"]
        and viewer.layouts(test) == ("learned",)
        and "deviation" not in test.scales
    )
    assert (
        test.paint(0, "deviation") == GRAY
    ).all() and "No observed and no true motion" in test.caption(1)
    save_rollout(run / "prior.npz", {"train": rollout(0), "test/test_60": rollout(0.1)})
    (run / "observed.npz").unlink()
    train = read_run(run)[0]
    assert list(train.bodies) == ["prior", "learned"] and train.reference is None
    assert viewer.layouts(train) == ("side by side", "learned over prior", "prior", "learned")


def test_tracked_points_are_read_and_said(run):
    """5 mm apart; of a file of other frames its entry is named."""
    (run / "observed.npz").unlink()
    (run / "truth.npz").unlink()
    predicted = np.zeros((T, 2, 3), np.float32)
    measured = predicted + np.array([0.003, 0, 0.004])
    measured[1, 1], measured[2] = np.nan, np.nan
    np.savez(run / "markers.npz", **{"train/measured": measured, "train/predicted": predicted})
    train, test = read_run(run)
    assert train.points.shape == (2, T, 2, 3) and test.points is None
    said = [train.caption(frame).splitlines()[1].split("(mm): ")[1].strip() for frame in range(3)]
    assert said == ["5.0, 5.0", "5.0", "not seen in this frame"]
    np.savez(run / "markers.npz", **{"train/measured": measured[1:], "train/predicted": predicted})
    with pytest.raises(
        DataError, match=r"markers\.npz: train/measured: expected .* of shape \(5, any, 3\)"
    ):
        read_run(run)


def test_splats_that_the_particles_carry_are_shown(run):
    """In each frame's place and light; by a quantity they have the colour of the particle nearest at rest."""
    body = Twin.load("").body
    means = body.rest[[0, 13]] + 0.001
    upright = torch.tensor([1.0, 0, 0, 0]).repeat(2, 1)
    splats = Splats(
        means, torch.full((2, 3), 0.02), upright, torch.full((2,), 0.7), torch.full((2, 3), 0.5)
    )
    body.splats = CarriedSplats(Appearance(splats, torch.zeros(2, 1, 3)), body.rest)
    try:
        train, test = read_run(run)
        centers, shapes, colors, opacities = train.splats("learned", 4, "appearance")
        assert (
            np.allclose(centers, train.learned.centers[4][[0, 13]] + 0.001, atol=1e-3)
            and (opacities == 0.7).all()
        )
        assert shapes.shape == (2, 3, 3) and np.allclose(colors, 0.5)
        assert np.allclose(
            train.splats("learned", 4, "deviation")[2], train.paint(4, "deviation")[[0, 13]]
        )
        assert np.allclose(train.splats("observed", 1, "deviation")[2], 0.5)
        stretched = test.splats("truth", 0, "appearance")[
            1
        ]  # to double along y, by positions alone; squashed bodies rest so
        assert np.allclose(stretched[0], 4e-4 * np.diag([1, 4, 1]), rtol=1e-3)
    finally:
        body.splats = None
    assert read_run(run)[0].splats("learned", 0, "appearance")[0].shape == (N, 3)


@pytest.mark.parametrize("carrying", [False, True])
def test_an_exported_motion_is_shown_without_its_run(run, tmp_path, carrying, monkeypatch):
    twin = Twin.load("")
    if carrying:
        upright = torch.tensor([1.0, 0, 0, 0]).repeat(2, 1)
        splats = Splats(
            twin.body.rest[[0, 13]],
            torch.full((2, 3), 0.02),
            upright,
            torch.full((2,), 0.7),
            torch.full((2, 3), 0.5),
        )
        monkeypatch.setattr(
            twin.body,
            "splats",
            CarriedSplats(Appearance(splats, torch.zeros(2, 1, 3)), twin.body.rest),
        )
    wanted = read_run(run)[0]
    folder = twin.export(rollout(0), tmp_path / "falling", video=False)
    monkeypatch.setattr(
        Twin, "load", lambda path: (_ for _ in ()).throw(AssertionError(f"{path} was read"))
    )
    (clip,) = read_run(folder)
    assert (
        clip.name == "simulation"
        and list(clip.bodies) == ["learned"]
        and clip.world.ground.height == pytest.approx(GROUND)
    )
    assert clip.up.tolist() == [0, 1, 0] and np.array_equal(clip.factor, wanted.factor)
    for one, other in zip(
        clip.splats("learned", 3, "appearance"), wanted.splats("learned", 3, "appearance")
    ):
        assert len(one) == (2 if carrying else N) and np.allclose(one, other, atol=1e-6)
    assert (
        viewer.first_view(clip)[0] != viewer.first_view(wanted)[0]
    ).any() and "**simulation**" in clip.caption(0)
    stored = dict(np.load(folder / "body.npz"))
    for part, broken in (
        ("up", np.zeros(3, np.float32)),
        ("factor", stored["factor"][:3]),
        ("rest", np.full((N, 3), np.nan)),
    ):
        np.savez(folder / "body.npz", **stored | {part: broken})
        with pytest.raises(DataError, match=rf"^[^:]*body\.npz: .*{part}"):
            read_run(folder)
    (folder / "body.npz").unlink()
    with pytest.raises(
        DataError,
        match=r"falling: expected checkpoints/last\.ckpt of a run, or body\.npz .* checkpoint=",
    ):
        read_run(folder)
    monkeypatch.setattr(Twin, "load", lambda path: twin)
    assert np.array_equal(read_run(folder, "last.ckpt")[0].factor, wanted.factor)


def test_what_is_to_be_shown_is_asked_for_on_the_command_line(run, monkeypatch):
    live = viewer.options([str(run), "--live", "device=cpu"])
    assert live["live"] == "true" and live["run"] == str(run)
    with pytest.raises(
        DataError, match=r"run: expected .* a checkpoint, found no file .*last\.ckpt; .*checkpoint="
    ):
        viewer.checkpoint_of(live["run"], None)
    file = run / "checkpoints" / "last.ckpt"
    file.write_bytes(b"")
    assert viewer.checkpoint_of(str(run), None) == viewer.checkpoint_of(str(file), None) == file
    assert viewer.options([str(file), "live=true"])["run"] == str(file)
    assert viewer.options([f"checkpoint={file}", "--live"])["run"] == str(file)
    with pytest.raises(ConfigError, match=r"run: expected a folder, found the file .*--live"):
        viewer.options([str(file)])
    with pytest.raises(ConfigError, match="live: expected true or false, found 'yes'"):
        viewer.options([str(run), "live=yes"])
    pytest.importorskip("viser")
    twin = Twin.load("")
    monkeypatch.setattr(Twin, "load", LOAD)
    for given, argument in (([str(file)], "run"), ([f"checkpoint={file}"], "checkpoint")):
        with pytest.raises(
            DataError, match=rf"^{argument}: .*last\.ckpt: not a readable checkpoint"
        ):
            viewer.opened(viewer.options([*given, "--live"]))
    for given, argument in ((None, "run"), (file, "checkpoint")):
        with pytest.raises(
            DataError, match=rf"^{argument}: .*last\.ckpt: not a readable checkpoint"
        ):
            read_run(run, given)
    monkeypatch.setattr(Twin, "load", lambda path, device="cpu": twin)
    monkeypatch.setattr(
        twin, "training_start", replace(twin.training_start, center=torch.tensor([0.0, 0.2, 0.0]))
    )
    shown = viewer.opened(live | {"port": "0"})
    try:
        assert "drop" in shown.buttons and shown.live.twin is twin
    finally:
        shown.stop()


def test_flat_bodies_keep_the_truth_s_splats(run):
    """Where neighbours lie in a plane no deformation can be fitted: the fit says 0, and a splat of that is not seen."""
    clouds = rollout(0).x[0] * torch.tensor([1.0, 1.0, 0.0])
    body = SimpleNamespace(rest=clouds + torch.linspace(0, 1e-3, N)[:, None] * torch.tensor([1.0, 0.5, 0.0]),
                           covariances=1e-4 * torch.eye(3).expand(N, 3, 3))  # fmt: skip
    found = covariances(Arrays(Path("a.npz"), {}), "test", body.rest[None].numpy(), body)
    assert np.allclose(found, body.covariances, atol=1e-9)


def test_the_bodies_stand_beside_each_other_on_the_ground(run):
    train, _ = read_run(run)
    assert train.across @ train.up == 0 and np.linalg.norm(train.across) == pytest.approx(1)
    moving = (
        np.arange(T)[:, None, None] * train.across
    )  # by ten widths a frame: what they take up is that of one frame
    bodies = {
        name: replace(body, centers=body.centers + moving[: len(body.centers)])
        for name, body in train.bodies.items()
    }
    flying = replace(train, bodies=bodies)
    assert np.allclose(flying.side, train.side) and 0.1 < np.linalg.norm(train.side) < 0.3
    for frame in range(SEEN):
        along = [
            (body.centers[frame] + place * flying.side) @ flying.across
            for place, body in enumerate(bodies.values())
        ]
        assert along[0].max() < along[1].min() and along[1].max() < along[2].min()


@pytest.mark.parametrize("up", [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
def test_the_first_view_holds_all_bodies_and_the_ground(run, up):
    clip = read_run(run)[0]
    clip = replace(clip, world=replace(clip.world, up=torch.tensor(up)))
    eye, target = viewer.first_view(clip)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, clip.up)
    assert right @ clip.across > 0.99 * np.linalg.norm(
        right
    )  # the learned body, shifted along `across`, is to the right
    upward = np.cross(right / np.linalg.norm(right), forward)
    points = np.concatenate([clip.moved + place * clip.side for place in range(3)])
    points = np.concatenate([points, points + np.outer(GROUND - points @ clip.up, clip.up)]) - eye
    tangent = (
        np.abs(points @ np.stack([right / np.linalg.norm(right), upward], axis=1))
        / (points @ forward)[:, None]
    )
    inside = tangent / np.tan(FIELD_OF_VIEW / 2)  # 1 at the rim of a square window
    assert 0.5 < inside.max() < 1 and forward @ clip.up < 0


def test_the_panel_covers_nothing_of_the_first_view():
    """A row of bodies in a window of 1280 x 800, whose right 335 px are under viser's panel."""
    across, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    row = np.random.default_rng(0).uniform([-0.5, 0.0, -0.1], [0.5, 0.3, 0.1], (500, 3))

    def pixels(eye, target):
        forward = (target - eye) / np.linalg.norm(target - eye)
        return 640 + 400 * ((row - eye) @ across) / ((row - eye) @ forward) / np.tan(
            FIELD_OF_VIEW / 2
        )

    view = view_of(row, up, across, 0.0)
    assert pixels(*view).max() > 1280 - 335
    moved = pixels(*beside_panel(*view, up))
    assert 0 < moved.min() and moved.max() < 1280 - 335


def test_colours_say_what_they_are_by(run):
    train, test = read_run(run)
    assert (train.paint(0, "appearance") == 0.25).all()
    by_stiffness = train.paint(0, "heterogeneity")
    softest, stiffest = by_stiffness[train.factor.argmin()], by_stiffness[train.factor.argmax()]
    assert train.factor.max() > 1 > train.factor.min()
    assert softest[2] > softest[0] and stiffest[0] > stiffest[2]  # blue, red
    scale = train.scales["heterogeneity"]
    assert (scale.low + scale.high) / 2 == 1 and scale.high == pytest.approx(
        1 + np.abs(train.factor - 1).max()
    )
    even = replace(train, factor=np.full(N, 1.001))
    assert (even.scales["heterogeneity"].low, even.scales["heterogeneity"].high) == pytest.approx(
        (0.99, 1.01)
    )
    assert (
        train.paint(0, "heterogeneity", "prior") == matplotlib.colormaps["coolwarm"](0.5)[:3]
    ).all()  # it has one stiffness
    # one scale for both: up to the prior's 40 mm, of which the learned body's 10 mm are a quarter
    assert train.scales["deviation"].high == pytest.approx(40, rel=1e-3)
    for model, share in (("prior", 1.0), ("learned", 0.25)):
        assert np.allclose(
            train.paint(0, "deviation", model),
            matplotlib.colormaps["viridis"](share)[:3],
            atol=0.01,
        )
    assert (train.paint(SEEN, "deviation") == GRAY).all()
    assert train.scales["deviation"].label == "distance to the observed motion [mm]"
    assert test.scales["deviation"].label == "distance to the true motion [mm]"
    thrown = train.learned.centers + 0.02 * (np.arange(T) == 1)[:, None, None]
    worst = replace(
        train,
        bodies=train.bodies
        | {"learned": replace(train.learned, centers=thrown + np.array([0, 0.05, 0]))},
    )
    assert worst.scales["deviation"].high == pytest.approx(
        1e3 * worst.deviation(1).max(), rel=1e-3
    )  # of the worst frame
    with pytest.raises(
        ConfigError,
        match="color: expected appearance or heterogeneity or deviation or uncertainty, found 'speed'",
    ):
        train.paint(0, "speed")


def test_the_legend_goes_through_the_scale_s_colours():
    picture = Scale("distance [mm]", "viridis", 0, 5).legend()
    assert picture.dtype == np.uint8 and picture.shape[1] > 4 * picture.shape[0]
    row = picture[picture.shape[0] // 5].astype(float) / 255
    inside = row[
        (row.min(1) < 0.9) & (np.ptp(row, axis=1) > 0.1)
    ]  # the bar: neither white nor its black frame
    ends = matplotlib.colormaps["viridis"]([0.0, 1.0])[:, :3]
    assert len(inside) > 0.8 * len(row) and np.allclose(inside[[3, -4]], ends, atol=0.05)


def test_what_is_missing_or_mistyped_is_named(run, monkeypatch, capsys):
    for arguments, message in (([], "run: expected the folder"), (["folder"], "run: expected .*, found no folder 'folder'"),
                               (["run=x", "folder"], "expected the folder of a run, .*found 'folder'"),
                               (["--lives"], "expected the folder of a run, .*found '--lives'"), (["run=x", "a=2"], "found 'a=2'"),
                               (["run=x", "port=no"], "port: expected a number .*, found 'no'")):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            viewer.options(arguments)
    clips = read_run(run)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "viser", None)
        with pytest.raises(
            ConfigError,
            match=r"expected the package viser, found none: pip install -e '\.\[viewer\]'",
        ):
            viewer.Viewer(clips)
        with pytest.raises(SystemExit) as ended:
            viewer.main([f"run={run}"])
        assert ended.value.code == 2 and "ConfigError: viewer" in capsys.readouterr().err
    save_rollout(
        run / "rollout.npz", {"train": Rollout(**{**vars(rollout(0)), "x": rollout(0).x[:, :9]})}
    )
    with pytest.raises(
        DataError,
        match=r"rollout\.npz: train/x: expected .* of shape \(any, 27, 3\), found float32 \(5, 9, 3\)",
    ):
        read_run(run)
    save_rollout(run / "rollout.npz", {"train": rollout(0)})
    save_rollout(
        run / "prior.npz", {"train": Rollout(**{**vars(rollout(0)), "x": rollout(0).x[:4]})}
    )
    with pytest.raises(
        DataError,
        match=r"prior\.npz: train/x: expected .* of shape \(5, 27, 3\), found float32 \(4, 27",
    ):
        read_run(run)
    (run / "rollout.npz").write_bytes(b"no zip")
    with pytest.raises(DataError, match=r"rollout\.npz: expected a readable npz file"):
        read_run(run)
    (run / "rollout.npz").unlink()
    with pytest.raises(
        DataError,
        match=r"rollout\.npz: file not found; expected the folder of a finished run.*ckpt_path=",
    ):
        read_run(run)
    with pytest.raises(
        DataError, match=r"run: expected the folder of a finished run .*, found no folder .*nowhere"
    ):
        read_run(run / "nowhere")


def test_an_interrupt_before_the_page_is_open_ends_quietly(run, monkeypatch, capsys):
    def interrupted(chosen):
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "opened", interrupted)
    monkeypatch.setattr(sys, "argv", ["mosa-view", str(run)])
    view()
    assert capsys.readouterr() == ("", "")


def test_the_server_plays_and_ends(run):
    pytest.importorskip("viser")
    from urllib.request import urlopen

    clips = read_run(run)
    with pytest.raises(ConfigError, match=r"host: expected 127\.0\.0\.1, .*found '203\.0\.113\.7'"):
        viewer.Viewer(clips, host="203.0.113.7")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        shown = viewer.Viewer(clips, port=taken.getsockname()[1])
        assert shown.server.get_port() != taken.getsockname()[1]
    try:
        with urlopen(f"http://127.0.0.1:{shown.server.get_port()}", timeout=10) as page:
            assert page.status == 200
        assert shown.server.scene.get_handle_by_name("/ground").position @ clips[
            0
        ].up == pytest.approx(GROUND)
        (seen, _, _), (splats, points, label) = shown.nodes["observed"], shown.nodes["learned"]
        calibrated = shown.nodes["prior"][0]
        shown.frame.value = 2
        assert (
            "frame 2" in shown.caption.content
            and seen.visible
            and splats.visible
            and not points.visible
        )
        assert np.allclose(
            seen.centers * shown.unit, clips[0].bodies["observed"].centers[2], atol=1e-6
        )
        assert np.allclose(
            splats.centers * shown.unit, clips[0].learned.centers[2] + 2 * clips[0].side, atol=1e-6
        )
        assert np.allclose(
            calibrated.centers * shown.unit,
            clips[0].bodies["prior"].centers[2] + clips[0].side,
            atol=1e-6,
        )
        # float16 as viser keeps them: to 2^-11, which in m^2 they would not be
        assert np.allclose(
            splats.covariances * shown.unit**2,
            clips[0].learned.covariances[2],
            rtol=2**-11,
            atol=1e-12,
        )
        shown.layout.value = "prior over observed"
        assert calibrated.visible and seen.visible and not splats.visible
        shown.layout.value = "learned over observed"
        assert splats.visible and seen.visible and not calibrated.visible
        assert np.allclose(splats.centers * shown.unit, clips[0].learned.centers[2], atol=1e-6)
        assert (seen.rgbs == round(255 * GRAY)).all() and shown.nodes["observed"][
            2
        ].text == "observed (gray)"
        shown.layout.value = "observed"
        assert seen.visible and not splats.visible and not label.visible and not calibrated.visible
        shown.layout.value = "side by side"
        assert not shown.legend.visible
        shown.color.value, shown.geometry.value = "deviation", "particles"
        assert shown.legend.visible and points.visible and not splats.visible
        assert np.allclose(
            points.points, clips[0].learned.centers[2] + 2 * clips[0].side, atol=1e-6
        )
        shown.frame.value = 4  # past what was observed
        assert "rms" not in shown.caption.content and not shown.nodes["observed"][1].visible
        shown.layout.value = "prior over observed"
        shown.sequence.value = "test/test_60"
        assert (
            "**test/test_60**, frame 0" in shown.caption.content
            and shown.layout.value == "prior over truth"
        )
        assert (
            shown.nodes["truth"][1].visible
            and not shown.nodes["observed"][1].visible
            and not points.visible
        )
        shown.layout.value = "side by side"
        assert np.allclose(
            points.points, clips[1].learned.centers[0] + 2 * clips[1].side, atol=1e-6
        )
        shown.play.value, shown.rate.value = True, 30
        until = time.time() + 10
        while "frame 0" in shown.caption.content and time.time() < until:
            time.sleep(0.01)
        assert "frame 0" not in shown.caption.content
    finally:
        shown.stop()
    assert not shown.player.is_alive()


@pytest.mark.parametrize("origin, asked, own", [
    (None, "127.0.0.1:80", True), ("http://127.0.0.1:80", "127.0.0.1:80", True), ("http://localhost:9", "localhost:9", True),
    ("https://[::1]:80", "[::1]:80", True), ("http://machine.lab:80", "machine.lab:80", True), (None, "machine.lab:80", True),
    ("http://127.0.0.1:81", "127.0.0.1:80", False), ("http://stranger.example", "127.0.0.1:80", False),
    ("http://localhost:80", "127.0.0.1:80", False), ("null", "127.0.0.1:80", False), ("", "127.0.0.1:80", False),
    ("file://", "127.0.0.1:80", False), ("http://127.0.0.1:80@stranger.example", "127.0.0.1:80", False),
    ("http://stranger.example:80", "stranger.example:80", False), (None, "stranger.example:80", False), (None, None, False),
    ("http://127.0.0.1.stranger.example:80", "127.0.0.1.stranger.example:80", False), (None, "[::1", False), (None, "", False),
])  # fmt: skip
def test_a_page_is_the_server_s_own(origin, asked, own):
    """Also where a stranger's name is said to be this machine's address."""
    assert own_page(origin, asked, "machine.lab") is own


def test_no_message_ends_the_player_and_no_foreign_page_connects(run):
    viser = pytest.importorskip("viser")
    import msgspec
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    shown = viewer.Viewer(read_run(run), port=0)
    try:
        port = shown.server.get_port()
        options = {
            "uri": f"ws://127.0.0.1:{port}",
            "subprotocols": [f"viser-v{viser.__version__}"],
            "max_size": None,
        }
        for origin in ("http://stranger.example", f"http://127.0.0.1:{port + 1}", "null"):
            with pytest.raises(InvalidStatus) as refused:
                connect(**options, origin=origin)
            assert refused.value.response.status_code == 403
        inputs = {
            name: getattr(shown, name)
            for name in ("sequence", "layout", "frame", "rate", "geometry", "color", "play")
        }
        with connect(**options, origin=f"http://127.0.0.1:{port}") as page:
            for said in (
                math.nan,
                -math.inf,
                1e300,
                -(10**18),
                10**18,
                "abc",
                None,
                [],
                {"a": 1},
                0,
                True,
            ):
                for handle in inputs.values():
                    message = {
                        "type": "GuiUpdateMessage",
                        "uuid": handle._impl.uuid,
                        "updates": {"value": said},
                    }
                    page.send(msgspec.msgpack.encode(message))
            until = time.time() + 10
            while (
                not (shown.play.value is True and shown.color.value == "True")
                and time.time() < until
            ):
                time.sleep(0.01)
        assert shown.color.value == "True" and shown.rate.value == 1 and shown.play.value is True
        assert (
            viewer.offered(shown.color) == "appearance"
            and viewer.offered(shown.sequence) == "train"
        )
        shown.rate.value = 0
        shown.layout.value, shown.frame.value, shown.rate._impl.value = "side by side", 0, 30
        until = time.time() + 10
        while "frame 3" not in shown.caption.content and time.time() < until:
            time.sleep(0.01)
        assert "frame 3" in shown.caption.content and shown.player.is_alive()
    finally:
        shown.stop()


@pytest.mark.parametrize("value, used", [
    (0, 1), (-3, 1), (math.nan, 1), (math.inf, 30), (-math.inf, 1), (1e300, 30), (10**400, 30), (5, 5), (29.5, 29.5),
])  # fmt: skip
def test_numbers_of_the_page_are_within_its_limits(value, used):
    assert viewer.offered(SimpleNamespace(min=1, max=30, value=value)) == used


def test_the_server_shows_a_learned_body_alone(run):
    pytest.importorskip("viser")
    for name in ("prior.npz", "truth.npz"):
        (run / name).unlink()
    shown = viewer.Viewer(read_run(run))
    try:
        assert (
            shown.layout.value == "side by side"
            and "truth" not in shown.nodes
            and "prior" not in shown.nodes
        )
        shown.color.value, shown.layout.value = "deviation", "observed"
        shown.sequence.value = "test/test_60"
        assert (
            shown.layout.value == "learned" and shown.layout.disabled and not shown.legend.visible
        )
        assert shown.nodes["learned"][0].visible and not shown.nodes["observed"][0].visible
        assert shown.nodes["learned"][2].text == "test/test_60"  # a preset's was not learned
        shown.sequence.value = "train"
        assert (
            shown.layout.value == "side by side"
            and not shown.layout.disabled
            and shown.nodes["observed"][0].visible
        )
    finally:
        shown.stop()


def test_the_solids_of_a_motion_move_beside_every_body(run):
    pytest.importorskip("viser")
    moved = [
        {"type": "box", "size": [0.1, 0.2, 0.3], "motion": {"velocity": [0, 1.0, 0]}},
        {"type": "cylinder", "radius": 0.05, "length": 0.4},
        {"type": "plane"},
    ]
    solids = colliders_from_config(moved)
    save_rollout(run / "rollout.npz", {"train": rollout(0), "test/test_60": rollout(0.2)}, solids)
    clips = read_run(run)
    assert clips[0].solids == (*(each.shape for each in solids[:2]), None)
    assert "Not drawn: colliders (1)" in clips[0].caption(0)
    shown = viewer.Viewer(clips)
    try:
        shown.frame.value = 2
        nodes = [shown.solids["train", place] for place in range(3)]
        for place, (box, cylinder, plane) in enumerate(nodes):
            assert box.visible and cylinder.visible and plane is None
            assert np.allclose(box.position, place * clips[0].side + [0, 0.04, 0], atol=1e-6)
        assert not shown.solids["test/test_60", 0][0].visible
        shown.layout.value = "learned"
        assert nodes[0][0].visible and not nodes[1][0].visible
    finally:
        shown.stop()
    broken = dict(np.load(run / "rollout.npz"))
    broken["train/collider_position"] = broken["train/collider_position"][1:]
    np.savez(run / "rollout.npz", **broken)
    with pytest.raises(DataError, match="train/collider_position: expected finite"):
        read_run(run)


def test_the_server_shows_tracked_points_on_the_learned_body(run):
    pytest.importorskip("viser")
    predicted = np.full((T, 2, 3), 0.1, np.float32)
    measured = predicted + np.float32(0.01)
    measured[1, 1] = np.nan
    np.savez(run / "markers.npz", **{"train/measured": measured, "train/predicted": predicted})
    shown = viewer.Viewer(read_run(run))
    try:
        red, blue = shown.points
        shown.frame.value = 1
        assert red.visible and blue.visible
        side = 2 * shown.clip.side
        assert np.allclose(red.points, measured[1, :1] + side) and np.allclose(blue.points, predicted[1] + side)  # fmt: skip
        shown.layout.value = "prior"
        assert not red.visible
        shown.layout.value, shown.sequence.value = "learned", "test/test_60"
        assert not blue.visible
    finally:
        shown.stop()


def test_the_spread_of_the_prediction_is_a_colour_of_the_learned_body_alone(run):
    sd = np.linspace(0.001, 0.02, T * N, dtype=np.float32).reshape(T, N)
    np.savez(run / "uncertainty.npz", **{"train/sd": sd})
    train, test = read_run(run)
    assert (
        np.array_equal(train.spread, sd)
        and test.spread is None
        and "uncertainty" not in test.scales
    )
    high = 1e3 * float(np.quantile(sd[-1], 0.99))
    assert train.scales["uncertainty"].high == pytest.approx(high, rel=1e-6)
    expected = matplotlib.colormaps["magma"](1e3 * sd[2] / high)[:, :3]
    assert np.allclose(train.paint(2, "uncertainty"), expected, atol=0.01)
    assert (train.paint(2, "uncertainty", "prior") == GRAY).all() and (
        test.paint(2, "uncertainty") == GRAY
    ).all()
    np.savez(run / "uncertainty.npz", **{"train/sd": -sd})
    with pytest.raises(DataError, match="train/sd: expected"):
        read_run(run)
