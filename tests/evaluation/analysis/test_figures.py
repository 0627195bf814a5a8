"""Pictures of a run."""

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from mosa.evaluation.analysis.figures import (
    LEFT,
    SMALLEST,
    bar,
    fitted,
    text_width,
    write_strip,
    write_video,
)


def test_a_strip_takes_rows_of_different_sizes(tmp_path):
    """Two sequences, of 20 x 30 and 20 x 50 px and 9 and 5 frames: five frames each, the narrower row filled up in white."""
    rows = {"first": torch.zeros(9, 20, 30, 3), "second": torch.full((5, 20, 50, 3), 0.5)}
    picture = write_strip(tmp_path / "strip.png", rows, frames=5)
    assert np.array_equal(picture, imageio.imread(tmp_path / "strip.png"))
    height = picture.shape[0] // 2
    assert picture.shape[1] == 5 * 50
    assert (picture[height - 1, : 5 * 30] == 0).all() and (
        picture[height - 1, 5 * 30 :] == 255
    ).all()
    assert (abs(picture[-1].astype(int) - 128) <= 1).all()


def test_a_video_and_a_strip_are_whole_or_not_there(tmp_path):
    frames = [np.full((41, 60, 3), 40 * k, np.uint8) for k in range(5)]
    write_strip(tmp_path / "a.png", {"x": np.stack(frames)})
    found = cv2.VideoCapture(str(write_video(tmp_path / "a.mp4", frames, fps=6)))
    assert found.get(cv2.CAP_PROP_FRAME_COUNT) == 5 and found.get(cv2.CAP_PROP_FRAME_HEIGHT) == 42
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.mp4", "a.png"]


@pytest.mark.parametrize("program", ["exit 1", "cat > /dev/null", "head -c 99 > /dev/null"])
def test_an_ffmpeg_that_writes_nothing_is_said(tmp_path, monkeypatch, program):
    """On a full disk ffmpeg ends, and imageio does not look at how: the run had half a film under its name."""
    other = tmp_path / "ffmpeg"
    other.write_text(f"#!/bin/sh\n{program}\n")
    other.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(other))
    with pytest.raises(
        OSError, match=r"(ffmpeg has ended while it wrote|of 5 pictures are in it).*a\.mp4"
    ):
        write_video(tmp_path / "a.mp4", [np.zeros((400, 600, 3), np.uint8)] * 5)
    assert [file.name for file in tmp_path.iterdir()] == ["ffmpeg"]


@pytest.mark.parametrize(
    "text",
    ["real", "adapted (learned law): distance to the true motion, blue 0, yellow 20 mm", "x" * 300],
)
def test_a_caption_fits_into_its_share(text):
    """Three columns of 230 px, as in the rabbit's strip: no caption ends in its neighbour's or beyond the picture."""
    shown, scale = fitted(text, 230 - 2 * LEFT)
    assert text_width(shown, scale) <= 230 - 2 * LEFT and scale >= SMALLEST
    assert shown == text or (shown.endswith("...") and text.startswith(shown[:-3]))
    alone = bar(690, ["", text, ""])
    assert (
        (alone[:, :230] == 245).all()
        and (alone[:, 460:] == 245).all()
        and (alone[:, 230:460] < 245).any()
    )
