"""Masks as other programs write them: what is read as one, and what is named."""

import numpy as np
import pytest
from PIL import Image

from mosa.data.images.reading import faintless, matte_of, read_image
from mosa.errors import DataError


def disc(value: int) -> np.ndarray:
    """(40, 40) with a disc of that value on 0."""
    y, x = np.mgrid[:40, :40]
    return np.where((x - 20) ** 2 + (y - 18) ** 2 < 100, value, 0).astype(np.uint8)


def palette(mask: np.ndarray) -> Image.Image:
    made = Image.fromarray((mask > 0).astype(np.uint8), "P")
    made.putpalette([0, 0, 0, 128, 0, 0] + [0] * 762)
    return made


@pytest.mark.parametrize(("mask", "message"), [
    (Image.fromarray(disc(1)), r"white \(255\) where the object is, found 1 at most: the number of a label"),
    (Image.fromarray(disc(126)), "found 126 at most: .* half transparent"),
    (palette(disc(255)), "grey mask, white = object, found colours"),
    (Image.fromarray(np.stack([0 * disc(1), disc(255), 0 * disc(1)], -1)), "found colours"),
    (Image.fromarray(np.stack([disc(90), disc(90), disc(90), disc(255)], -1)), "found an alpha channel that differs"),
])  # fmt: skip
def test_masks_of_labels_colours_and_alpha_are_named(tmp_path, mask, message):
    """Of colours the first channel was taken for the mask, and a label of 1 for a matte of 0.4 %."""
    mask.save(tmp_path / "mask.png")
    with pytest.raises(DataError, match=rf"mask\.png: expected .*{message}"):
        matte_of(tmp_path / "mask.png", read_image(tmp_path / "mask.png"))


@pytest.mark.parametrize("mask", [Image.fromarray(disc(255)), Image.fromarray(np.stack([disc(255)] * 3, -1)),
                                  Image.fromarray(np.stack([disc(255)] * 3 + [np.full((40, 40), 255, np.uint8)], -1)),
                                  Image.fromarray(disc(255) > 0)])  # fmt: skip
def test_grey_masks_are_read_in_whatever_they_are_written(tmp_path, mask):
    mask.save(tmp_path / "mask.png")
    matte = matte_of(tmp_path / "mask.png", read_image(tmp_path / "mask.png"))
    assert np.array_equal(matte, (disc(255) > 0).astype(np.float32))
    edge = np.zeros((40, 40), np.float32)
    edge[:10, 0] = 0.05  # an object that is nearly out of the picture
    assert faintless(tmp_path / "mask.png", edge) is edge


def test_an_animation_is_no_picture(tmp_path):
    """Its first frame was read without a word."""
    first, second = Image.fromarray(disc(255)), Image.fromarray(disc(200))
    for kind in ("PNG", "GIF"):
        first.save(tmp_path / "a.png", kind, save_all=True, append_images=[second])
        with pytest.raises(
            DataError, match=r"a\.png: expected one picture, found an animation of 2"
        ):
            read_image(tmp_path / "a.png")
    first.save(
        tmp_path / "a.png", "TIFF", save_all=True, append_images=[second]
    )  # pages: a small copy beside the picture
    assert read_image(tmp_path / "a.png").shape == (40, 40, 1)
