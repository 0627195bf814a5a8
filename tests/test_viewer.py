"""What the viewer shows of a run: read from its folder, painted, placed; and, where viser is installed, served."""

import sys
import time

import numpy as np
import pytest
import torch

from mosa import viewer
from mosa.config import build_world
from mosa.errors import ConfigError, DataError
from mosa.modules.body import Body, SimulationSettings, Start
from mosa.modules.heterogeneity import HeterogeneityField
from mosa.modules.material import Material
from mosa.twin import Twin, save_observed, save_rollout
from mosa.types import MotionCues, Rollout

N, T, SEEN = 27, 5, 3


def rollout(shift: float) -> Rollout:
    """A small cube that falls and is squashed along y in the second half."""
    axis = torch.tensor([0.0, 0.05, 0.1])
    rest = torch.cartesian_prod(axis, axis, axis)
    x = torch.stack([rest + torch.tensor([shift, 0.5 - 0.1 * t, 0.0]) for t in range(T)])
    F = torch.eye(3).expand(T, N, 3, 3).clone()
    F[3:, :, 1, 1] = 0.5
    return Rollout(x=x, v=torch.zeros_like(x), F=F, F_tot=F, times=torch.arange(T) / 50, final=None, counts=[8] * (T - 1))


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run folder: one sequence that was observed for three frames, and a held-out one."""
    tensors = {"rest": rollout(0).x[0], "volume": torch.full((N,), 1e-4), "colors": torch.full((N, 3), 0.25),
               "opacities": torch.full((N,), 0.9), "covariances": 1e-4 * torch.eye(3).expand(N, 3, 3).clone()}  # fmt: skip
    world = {"ground": None, "gravity": [0, 0, -9.8], "up": [0, 0, 1], "box": [[-1, -1, -1], [1, 1, 1]]}
    field = HeterogeneityField(tensors["rest"].amin(0), tensors["rest"].amax(0), hidden=8)
    material = Material("neo_hookean", {"E": 1e5, "nu": 0.3})
    body = Body(**tensors, density=1000.0, material=material, heterogeneity=field, adapter=None,
                settings=SimulationSettings(dx=0.1))
    with torch.no_grad():
        for p in body.heterogeneity.parameters():
            p.copy_(torch.randn(p.shape, generator=torch.Generator().manual_seed(0)) if p.dim() == 2 else torch.zeros_like(p))
    twin = Twin(body, build_world(world), 0.02, {}, Start(torch.eye(3), torch.zeros(3), torch.zeros(3), torch.zeros(3)))
    monkeypatch.setattr(viewer.Twin, "load", lambda path: twin)
    save_rollout(tmp_path / "rollout.npz", {"train": rollout(0), "test/test_60": rollout(0.2)})
    seen = rollout(0.01)
    cues = MotionCues(seen.x[:SEEN], *(torch.zeros(SEEN, N, 3, 3) for _ in range(2)), torch.ones(SEEN, N), 2e-4 * seen.F[:SEEN])
    save_observed(tmp_path / "observed.npz", {"train": cues})
    return tmp_path


def test_a_run_is_read_with_what_it_observed(run):
    train, test = viewer.read_run(run)
    assert (train.name, test.name) == ("train", "test/test_60") and len(train.times) == T
    assert train.observed.centers.shape == (SEEN, N, 3) and test.observed is None
    # A = F A_0 F^T: squashed to half, a covariance is a quarter along y
    assert np.allclose(train.twin.covariances[4, 0], np.diag([1e-4, 0.25e-4, 1e-4]))
    assert train.deviation(0) == pytest.approx(np.full(N, 0.01), rel=1e-4) and train.deviation(SEEN) is None
    assert "rms distance 10.0 mm" in train.caption(1) and train.caption(4) == "train, frame 4, 0.080 s"
    (run / "observed.npz").unlink()
    assert viewer.read_run(run)[0].observed is None


def test_the_bodies_stand_beside_each_other_on_the_ground(run):
    train, _ = viewer.read_run(run)
    assert train.side @ train.up == 0
    along = train.side / np.linalg.norm(train.side)
    assert (train.twin.centers @ along).min() + np.linalg.norm(train.side) > (train.observed.centers @ along).max()


def test_colours_say_what_they_are_by(run):
    train, test = viewer.read_run(run)
    assert (train.paint(0, "appearance") == 0.25).all()
    by_stiffness = train.paint(0, "heterogeneity")
    softest, stiffest = by_stiffness[train.factor.argmin()], by_stiffness[train.factor.argmax()]
    assert train.factor.max() > 1 > train.factor.min()
    assert softest[2] > softest[0] and stiffest[0] > stiffest[2]  # blue, red
    by_deviation = train.paint(0, "deviation")
    assert by_deviation.shape == (N, 3) and np.ptp(by_deviation, axis=0).max() < 1e-3 and 0.02 < by_deviation.mean() < 0.9
    assert (train.paint(SEEN, "deviation") == 1).all() and (test.paint(0, "deviation") == 1).all()
    with pytest.raises(ConfigError, match="color: expected appearance or heterogeneity or deviation, found 'speed'"):
        train.paint(0, "speed")


def test_what_is_missing_or_mistyped_is_named(run, monkeypatch, capsys):
    for arguments, message in (([], "run: expected the folder"), (["folder"], "found 'folder'"), (["run=x", "a=2"], "found 'a=2'"),
                               (["run=x", "port=no"], "port: expected a number .*, found 'no'")):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            viewer.options(arguments)
    clips = viewer.read_run(run)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "viser", None)
        with pytest.raises(ConfigError, match=r"expected the package viser, found none: pip install -e '\.\[viewer\]'"):
            viewer.Viewer(clips)
        with pytest.raises(SystemExit) as ended:
            viewer.main([f"run={run}"])
        assert ended.value.code == 2 and "ConfigError: viewer" in capsys.readouterr().err
    save_rollout(run / "rollout.npz", {"train": Rollout(**{**vars(rollout(0)), "x": rollout(0).x[:, :9]})})
    with pytest.raises(DataError, match=r"rollout\.npz: train: expected the checkpoint's 27 particles, found 9"):
        viewer.read_run(run)
    (run / "rollout.npz").write_bytes(b"no zip")
    with pytest.raises(DataError, match=r"rollout\.npz: expected a readable npz file"):
        viewer.read_run(run)
    (run / "rollout.npz").unlink()
    with pytest.raises(DataError, match=r"rollout\.npz: file not found; expected the folder of a finished run"):
        viewer.read_run(run)


def test_the_server_plays_and_ends(run):
    pytest.importorskip("viser")
    from urllib.request import urlopen

    shown = viewer.Viewer(viewer.read_run(run), port=18080)
    try:
        with urlopen(f"http://127.0.0.1:{shown.server.get_port()}", timeout=10) as page:
            assert page.status == 200
        shown.frame.value = 2
        assert "frame 2" in shown.caption.content
        shown.color.value, shown.points.value = "deviation", True
        shown.frame.value = 4  # past what was observed
        assert "rms" not in shown.caption.content
        shown.sequence.value = "test/test_60"
        assert "test/test_60, frame 0" in shown.caption.content
        shown.play.value = True
        until = time.time() + 10
        while "frame 0" in shown.caption.content and time.time() < until:
            time.sleep(0.05)
        assert "frame 0" not in shown.caption.content
    finally:
        shown.stop()
    assert not shown.player.is_alive()
