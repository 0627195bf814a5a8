"""The film of tracked points beside the predicted body."""

from types import SimpleNamespace

import numpy as np
import torch
from small_bodies import small_body

from mosa.evaluation.analysis.marker_figures import MEASURED, PREDICTED, SIZE, film, write_markers
from mosa.system.npz import read_npz
from mosa.types import Markers, Rollout


def test_points_are_drawn_where_they_are():
    """A block seen along its shortest level axis, z: measured points 4 cm beside it and at the same
    height, the predicted one 2 cm lower; a point that was not seen is left out."""
    body = small_body(adapter=False, counts=(8, 3, 2)).float()
    x = body.rest[None].expand(2, -1, -1)
    F = torch.eye(3).expand(2, len(body.rest), 3, 3)
    rollout = Rollout(x=x, v=0 * x, F=F, F_tot=F, times=torch.arange(2) / 50, final=None, counts=[8])  # fmt: skip
    middle = 0.5 * (body.rest.amin(0) + body.rest.amax(0)).numpy()
    edge = body.rest[:, 0].amax().numpy() - middle[0] + 0.04
    measured = np.tile(middle + np.array([[edge, 0, 0], [-edge, 0, 0]]), (2, 1, 1))
    predicted = measured - [0, 0.02, 0]
    measured[1, 1] = np.nan
    scene = SimpleNamespace(up=torch.tensor([0.0, 1.0, 0.0]), background=torch.ones(3))
    images = film(body, scene, rollout, measured, predicted)
    assert images.shape == (2, SIZE[1], SIZE[0], 3) and images.dtype == np.uint8

    def places(image, color):
        rows, columns = np.nonzero((image == color).all(-1))
        right = columns > SIZE[0] / 2
        return [(columns[side].mean(), rows[side].mean()) for side in (right, ~right) if side.any()]

    reds, blues = places(images[0], MEASURED), places(images[0], PREDICTED)
    assert len(reds) == len(blues) == 2 and len(places(images[1], MEASURED)) == 1
    scale = abs(reds[0][0] - reds[1][0]) / (2 * edge)  # px/m
    for red, blue in zip(reds, blues):
        assert abs(blue[0] - red[0]) < 1.5 and abs(blue[1] - red[1] - 0.02 * scale) < 1.5


def test_the_file_of_points_is_one_that_the_viewer_reads(tmp_path):
    """The body stays where it is, the points move by 1 cm."""
    body = small_body(adapter=False, counts=(8, 3, 2)).float()
    x = body.rest[None].expand(3, -1, -1)
    F = torch.eye(3).expand(3, len(body.rest), 3, 3)
    rollout = Rollout(x=x, v=0 * x, F=F, F_tot=F, times=torch.arange(3) / 50, final=None, counts=[8])  # fmt: skip
    rest = body.rest[[0, 20, -1]]
    moved = torch.tensor([0.0, -0.01, 0.0]) * torch.arange(3)[:, None, None] / 2
    markers = Markers(("a", "b", "c"), rest, rest + moved, None)
    scene = SimpleNamespace(
        up=torch.tensor([0.0, 1.0, 0.0]), background=torch.ones(3), markers=markers, name="block",
        sequence="train", times=torch.arange(3) / 50,
    )  # fmt: skip
    sequence = SimpleNamespace(prefix="train", scene=scene)
    write_markers(tmp_path, body, [sequence], {"train": {"adapted": rollout}}, video=False)
    assert not (tmp_path / "video.mp4").exists() and (tmp_path / "strip.png").is_file()
    write_markers(tmp_path, body, [sequence], {"train": {"adapted": rollout}}, video=True)
    found = read_npz(tmp_path / "markers.npz")
    assert set(found) == {"train/measured", "train/predicted", "train/times"}
    away = found["train/predicted"] - found["train/measured"]
    assert np.abs(away[2] - [0, 0.01, 0]).max() < 1e-5
    assert {path.name for path in tmp_path.iterdir()} == {"markers.npz", "markers.png", "strip.png", "video.mp4"}  # fmt: skip
