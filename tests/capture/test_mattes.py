"""Whole objects among hands and mistakes, exposures that change, masks of other programs."""

import warnings

import cv2
import numpy as np
import pytest
from filming import filmed

from mosa.capture.mattes import centre_of, follow, matting_of, same_exposure, whole_object
from mosa.capture.videos import Clip, find_videos, open_clip, plate_of
from mosa.errors import ConfigError, DataError


def scene_of_pieces() -> np.ndarray:
    matte = np.zeros((80, 100), np.float32)
    matte[30:50, 40:60] = 1  # the object
    matte[38:41, 48:51] = 0  # a hole in it
    return matte


def test_a_hand_at_the_border_is_no_object_and_small_holes_are_covered():
    matte = scene_of_pieces()
    matte[0:25, 10:40] = 1  # a hand that has let go
    matte[70:72, 90:92] = 1  # a speck
    found = whole_object(matte)
    expected = np.zeros_like(matte)
    expected[30:50, 40:60] = 1
    hole = expected - scene_of_pieces()
    assert np.array_equal(found + hole * (found == 0), expected) and found[:25].max() == 0
    np.testing.assert_allclose(centre_of(expected)[0], [50, 40])
    matte[20:32, 35:45] = 1  # as long as it holds the object there is no whole one
    assert whole_object(matte).max() == 0


def test_of_two_large_pieces_the_one_nearest_to_the_last_is_followed():
    matte = np.zeros((80, 100), np.float32)
    matte[10:30, 10:30], matte[50:68, 60:78] = 1, 1
    assert whole_object(matte)[20, 20] == 1 and whole_object(matte)[60, 70] == 0
    assert whole_object(matte, near=np.array([68.0, 58.0]))[60, 70] == 1


def test_nothing_has_no_centre():
    centre, radius = centre_of(np.zeros((10, 10), np.float32))
    assert np.isnan(centre).all() and radius == 0


def test_a_changed_exposure_is_undone_where_the_background_is():
    rng = np.random.default_rng(0)
    plate = rng.uniform(0.2, 0.6, (60, 80, 3)).astype(np.float32)
    picture = plate * [1.3, 0.9, 1.1]
    picture[20:40, 20:50] = 0.9  # the object covers less than half
    found = same_exposure(picture.astype(np.float32), plate)
    np.testing.assert_allclose(found[:20], plate[:20], rtol=1e-5)


def test_plates_and_masks_are_asked_for_by_name(tmp_path):
    clip = Clip(tmp_path / "phone1.mp4", np.arange(10) / 60, (80, 60), 0, 0.0)
    with pytest.raises(DataError, match=r"phone1\.mp4: no background plate: expected phone1\.png"):
        plate_of(tmp_path, clip, None)
    with pytest.raises(ConfigError, match="plate_seconds: expected times within"):
        plate_of(None, clip, (3.0, 4.0))
    with pytest.raises(ConfigError, match="masks: expected the folder"):
        matting_of("masks", clip, plates=None, plate_seconds=None, masks=None)
    with pytest.raises(DataError, match="expected videos"):
        find_videos(tmp_path)
    (tmp_path / "phone1.mp4").write_bytes(b"no video")
    with pytest.raises(DataError, match=r"phone1\.mp4: expected a video"):
        open_clip(tmp_path / "phone1.mp4")


def test_a_plate_in_the_folder_wins_over_plate_seconds_and_says_so(tmp_path):
    clip = Clip(tmp_path / "phone1.mp4", np.arange(10) / 60, (80, 60), 0, 0.0)
    cv2.imwrite(str(tmp_path / "phone1.png"), np.full((60, 80, 3), 51, np.uint8))
    with pytest.warns(
        UserWarning, match=r"^plate_seconds: has no effect on phone1\.mp4, .*phone1\.png"
    ):
        found = plate_of(tmp_path, clip, (0.0, 0.1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(plate_of(tmp_path, clip, None), found) and np.allclose(found, 0.2)


def test_mask_videos_are_read_with_their_frames(tmp_path):
    import imageio.v2 as iio

    film = filmed()[0]
    for folder, of in (("videos", lambda m: 0.4 + 0.4 * m), ("masks", lambda m: m)):
        (tmp_path / folder).mkdir()
        with iio.get_writer(
            tmp_path / folder / "phone0.mp4", fps=60, codec="libx264", quality=8, macro_block_size=2
        ) as writer:
            for k in range(12):
                writer.append_data(
                    np.repeat(np.round(255 * of(film.mask(k + 20)))[..., None], 3, -1).astype(
                        np.uint8
                    )
                )
    clip = open_clip(tmp_path / "videos" / "phone0.mp4")
    assert clip.size == film.camera.size and np.allclose(np.diff(clip.times), 1 / 60)
    track = follow(
        clip, matting_of("masks", clip, plates=None, plate_seconds=None, masks=tmp_path / "masks")
    )
    true = np.array([centre_of(film.mask(k + 20))[0] for k in range(12)])
    np.testing.assert_allclose(track.centres, true, atol=0.15)
    assert all(track.shows(5, true[5:6])) and not any(track.shows(5, true[5:6] + 60))
