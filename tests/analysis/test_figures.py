"""Pictures of a run."""

import imageio.v3 as imageio
import torch

from mosa.analysis.figures import write_strip


def test_a_strip_takes_rows_of_different_sizes(tmp_path):
    """Two sequences, of 20 x 30 and 20 x 50 px and 9 and 5 frames: five frames each, the narrower row filled up in white."""
    rows = {"first": torch.zeros(9, 20, 30, 3), "second": torch.full((5, 20, 50, 3), 0.5)}
    picture = imageio.imread(write_strip(tmp_path / "strip.png", rows, frames=5))
    height = picture.shape[0] // 2
    assert picture.shape[1] == 5 * 50
    assert (picture[height - 1, : 5 * 30] == 0).all() and (picture[height - 1, 5 * 30 :] == 255).all()
    assert (abs(picture[-1].astype(int) - 128) <= 1).all()
