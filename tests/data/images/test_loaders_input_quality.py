"""Input that is readable but odd: depths and palettes of images, holes in mattes, cameras that disagree, raw footage."""

import warnings
from dataclasses import replace

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blocks_film import WORLD, block_scene
from PIL import ExifTags, Image

from mosa.data.checks.cameras import AGREEMENT, lines_of_sight, misses
from mosa.data.checks.validation import validate
from mosa.data.formats.views import read_views
from mosa.data.images.matting import matte_from_plate
from mosa.data.images.reading import fill_holes, read_image
from mosa.data.scene import load_scene
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.errors import DataError
from mosa.rendering.cameras import rays

COLORS = np.random.default_rng(0).integers(0, 256, (5, 6, 3)).astype(np.uint8)


def written(picture, path, **options):
    picture.save(path, **options)
    return read_image(path)


def test_palettes_become_colours_and_keep_transparency(tmp_path):
    picture = Image.fromarray(COLORS).quantize(8)
    wanted = np.asarray(picture.convert("RGB")) / 255
    assert np.allclose(written(picture, tmp_path / "plain.png"), wanted, atol=1e-6)
    found = written(picture, tmp_path / "clear.png", transparency=3)
    assert found.shape == (5, 6, 4)
    assert (
        np.array_equal(found[..., 3], (np.asarray(picture) != 3).astype(np.float32))
        and found[..., 3].min() == 0
    )
    assert np.allclose(found[..., :3], wanted, atol=1e-6)


def test_grey_with_alpha_and_bits(tmp_path):
    found = written(Image.fromarray(COLORS[..., :2], "LA"), tmp_path / "grey.png")
    assert np.allclose(found, COLORS[..., [0, 0, 0, 1]] / 255, atol=1e-6)
    bits = COLORS[..., 0] > 100
    assert np.array_equal(
        written(Image.fromarray(bits), tmp_path / "bits.png")[..., 0], bits.astype(np.float32)
    )


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_are_kept(tmp_path, channels):
    deep = np.random.default_rng(1).integers(0, 65536, (5, 6, channels)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[channels]
    assert np.abs(read_image(tmp_path / "deep.png") - deep[..., order] / 65535).max() < 1e-6


def test_tiff_files_of_imagej(tmp_path):
    """16 bits are big-endian there, which were refused; 32 bits count to 255, of which all above 1 was white."""
    grey = np.linspace(0, 1, 48).reshape(6, 8)
    found = written(Image.fromarray((65535 * grey).astype(">u2")), tmp_path / "a.tif")
    assert found[..., 0] == pytest.approx(grey, abs=1e-4)
    found = written(Image.fromarray(grey.astype("f4")), tmp_path / "b.tif")
    assert found[..., 0] == pytest.approx(grey)
    with pytest.raises(DataError, match=r"c.tif: expected floating point from 0 to 1, .* 255"):
        written(Image.fromarray((255 * grey).astype("f4")), tmp_path / "c.tif")


def test_a_photograph_that_asks_to_be_turned_is_said(tmp_path):
    """Upright masks beside pixels that a viewer turns by 180 degrees have the same size: the colours were those of elsewhere."""
    turned, path = Image.Exif(), tmp_path / "a.jpg"
    turned[ExifTags.Base.Orientation] = 3

    def read():
        calibration = {"phone": (np.eye(3), np.eye(4))}
        read_views(calibration, [0, 1], lambda *_: path, lambda c, f, p: (p, p[..., 0]), "list")

    Image.new("RGB", (32, 24)).save(path, exif=turned)
    with pytest.warns(UserWarning, match="a.jpg: expected pixels .* found EXIF orientation 3"):
        read()
    Image.new("RGB", (32, 24)).save(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read()


def test_truncated_deep_image_is_refused(tmp_path):
    deep = np.random.default_rng(1).integers(0, 65536, (50, 60, 3)).astype(np.uint16)
    file = tmp_path / "deep.png"
    cv2.imwrite(str(file), deep)
    file.write_bytes(file.read_bytes()[:-4000])
    with pytest.raises(DataError, match=r"deep.png: expected a readable image"):
        read_image(file)


def test_a_palette_matte_is_read_as_the_matte_it_is(blocks, pacnerf_folder):
    """One file of a folder saved with a palette: the same scene, up to the palette's colours."""
    file = pacnerf_folder / "data" / "a_1_2.png"
    plain = load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)
    pixels = np.asarray(Image.open(file))
    index = np.where(pixels[..., 3] > 127, 1, 0).astype(np.uint8)
    picture = Image.fromarray(index, "P")
    picture.putpalette([0, 0, 0, 200, 30, 30])
    picture.save(file, transparency=0)
    found = load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)
    assert torch.equal(found.mattes[1, 2], (plain.mattes[1, 2] > 0.5).float())
    assert torch.equal(found.mattes[0], plain.mattes[0])


def punch(folder):
    """A hole of one pixel in the matte of camera 1, frame 2, whose block is at rows 12 to 22, columns 11 to 23."""
    file = folder / "data" / "a_1_2.png"
    pixels = np.array(iio.imread(file))
    pixels[17, 15, 3] = 0
    iio.imwrite(file, pixels)


def test_a_hole_is_said_and_filled_where_asked_for(blocks, pacnerf_folder, recwarn):
    whole = load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)
    assert not recwarn.list
    punch(pacnerf_folder)
    with pytest.warns(
        UserWarning,
        match=r"1 small enclosed holes in 1 of 15 mattes, the largest of 1 px in camera 1, frame 2.*fill_holes",
    ):
        load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)
    recwarn.clear()
    filled = load_scene(format="pacnerf", path=str(pacnerf_folder), fill_holes=1, **WORLD)
    assert not recwarn.list
    assert torch.equal(filled.mattes, whole.mattes) and torch.equal(filled.images, whole.images)


def test_only_small_enclosed_holes_are_filled():
    matte = np.ones((20, 20), np.float32)
    matte[0, 5:8] = 0  # a bay of the border
    matte[5:7, 5:7] = 0.2
    matte[12:16, 12:16] = 0
    found = fill_holes(matte, 4)
    assert (
        (found[5:7, 5:7] == 1).all()
        and (found[12:16, 12:16] == 0).all()
        and (found[0, 5:8] == 0).all()
    )
    assert fill_holes(matte, 0) is matte


def ball_scene(views=6, at=((0.0, 0.0, 0.0),), radius=0.15):
    """A ball of 0.15 m radius that falls from (0.1, 0.3, 0), seen by a ring of cameras; five frames, 24 per second.

    at, radius: or some balls [m]."""
    scene = block_scene(views)
    rig = ring_of_cameras(
        views, 32, target=(0.0, 0.3, 0), distance=1.5, elevations=(0.2, 0.6), field=0.6, turn=0.4
    )
    origins, directions = rays(rig)
    mattes = []
    for t in range(5):
        center = torch.tensor([0.1, 0.3 - 4.9 * (t / 24) ** 2, 0.0])
        matte = torch.zeros(directions.shape[:-1])
        for ball in torch.tensor(at):
            arm = center + ball - origins[:, None, None]
            distance = (arm - (arm * directions).sum(-1, keepdim=True) * directions).norm(dim=-1)
            matte[distance < radius] = 1
        mattes.append(matte)
    mattes = torch.stack(mattes, 1)
    return replace(
        scene,
        cameras=rig,
        mattes=mattes,
        images=1 - 0.5 * mattes[..., None].expand(-1, -1, -1, -1, 3),
    )


def posed(scene, camera, w2c):
    poses = scene.cameras.w2c.clone()
    poses[camera] = w2c
    return replace(scene, cameras=replace(scene.cameras, w2c=poses))


def test_the_camera_that_does_not_fit_is_named():
    scene = ball_scene()
    assert validate(scene) is scene
    turn = torch.eye(4)
    angle = torch.tensor(0.15)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = (
        angle.cos(),
        angle.sin(),
        -angle.sin(),
        angle.cos(),
    )
    shown = r"camera 4 does not fit the others: they see the object at \[0.1.*, 0.3.*\] m in frame 0, .* passes 0.2"
    with pytest.raises(DataError, match=shown):
        validate(posed(scene, 4, turn @ scene.cameras.w2c[4]))
    flip = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(DataError, match=r"camera 2 does not fit the others.*looks away from it"):
        validate(posed(scene, 2, flip @ scene.cameras.w2c[2]))


def test_a_bent_slender_body_is_one_object():
    """Centroids of its views do not meet: by the radius of a disc of its area the lines of sight miss it by 0.66."""
    turns = np.linspace(-1.2, 1.2, 40)
    arc = 0.25 * np.stack([0 * turns, np.sin(turns), 1 - np.cos(turns)], 1)
    scene = ball_scene(at=arc.astype(np.float32).tolist(), radius=0.025)
    chosen, *lines = lines_of_sight(scene, 0)
    assert len(chosen) == 6 and float(misses(*lines)[1].max()) > AGREEMENT
    assert validate(scene) is scene
    swapped = posed(posed(scene, 1, scene.cameras.w2c[3]), 3, scene.cameras.w2c[1])
    with pytest.raises(DataError, match="do not see one object in frame 0"):
        validate(swapped)


def test_two_exchanged_cameras_are_both_listed():
    scene = ball_scene()
    swapped = posed(posed(scene, 1, scene.cameras.w2c[3]), 3, scene.cameras.w2c[1])
    with pytest.raises(DataError, match=r"do not see one object in frame 0: .*1 by .*3 by"):
        validate(swapped)


def test_an_object_outside_of_the_box_is_said():
    """Poses in millimetres: everything agrees, a thousand times too far away."""
    scene = ball_scene()
    poses = scene.cameras.w2c.clone()
    poses[:, :3, 3] *= 1000
    far = replace(scene, cameras=replace(scene.cameras, w2c=poses))
    with pytest.raises(
        DataError,
        match=r"scene.box: expected the object inside .*found it at \[10[0-9].*, 30[0-9].*the box, or the unit",
    ):
        validate(far)


def painted(shadow=0.6):
    """A red disc in front of a textured wall, on which it throws a shadow: image, plate, coverage."""
    y, x = np.mgrid[0:60, 0:80] + 0.5
    grain = np.random.default_rng(2).normal(0, 0.01, (60, 80, 3))
    plate = np.clip(
        np.stack([0.5 + 0.004 * x, 0.45 + 0.002 * y, 0.4 + 0.1 * np.sin(x / 3)], -1) + grain, 0, 1
    ).astype(np.float32)
    cover = np.clip(15.5 - np.hypot(x - 36, y - 28), 0, 1)[..., None].astype(np.float32)
    dark = np.where(np.hypot((x - 50) / 20, (y - 45) / 8) < 1, shadow, 1)[..., None]
    disc = np.array([0.8, 0.25, 0.2], np.float32)
    image = (
        cover * disc
        + (1 - cover) * plate * dark
        + np.random.default_rng(3).normal(0, 0.005, (60, 80, 3))
    )
    return np.clip(image, 0, 1).astype(np.float32), plate, cover[..., 0], disc


def test_matte_from_a_plate_ignores_the_shadow():
    image, plate, cover, disc = painted()
    color, matte = matte_from_plate(image, plate)
    both = ((matte > 0.5) & (cover > 0.5)).sum() / ((matte > 0.5) | (cover > 0.5)).sum()
    assert both > 0.98
    assert abs(matte.sum() / cover.sum() - 1) < 0.02
    # noise of 0.005 in a residual of about 0.3 is a coverage off by 5 % at three sigma, of colours 0.5 apart
    error = np.abs(color[cover == 1] - disc)
    assert error.max() < 0.1 and error.mean() < 0.01
    assert (
        np.abs(color[(matte > 0.3) & (cover < 1)] - disc).mean() < 0.05
    )  # the wall is taken out of the rim
    nothing = matte_from_plate(plate, plate)[1]
    assert nothing.max() == 0


def test_raw_footage_is_matted_from_its_plates(blocks, pacnerf_folder, caplog):
    """The exported mattes and colours come back from images in front of a wall and the wall alone."""
    caplog.set_level("INFO", "mosa")
    plain = load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)
    wall = (255 * painted()[1][:32, :32]).round().astype(np.uint8)
    for file in sorted((pacnerf_folder / "data").glob("a_*.png")):
        pixels = np.array(iio.imread(file))
        color = np.where(pixels[..., 3:] > 0, np.array([210, 40, 60], np.uint8), wall)
        iio.imwrite(file.with_name(file.name.replace("a_", "r_")), color)
        file.unlink()
    for v in range(3):
        iio.imwrite(pacnerf_folder / "data" / f"r_{v}_-1.png", wall)
    found = load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)
    assert "matted from the background plates" in caplog.text
    there = plain.mattes > 0
    wrong = ((found.mattes > 0.5) != there).float().sum() / there.sum()
    assert wrong < 0.02  # corners of the blocks
    inside = found.mattes == 1
    assert torch.allclose(found.images[inside], torch.tensor([210.0, 40.0, 60.0]) / 255, atol=1e-4)


def test_plates_of_the_real_bird(reference_data):
    """Camera 0 of PAC-NeRF's bird with the plate that is kept: against the mattes of the data set, binary and about half a
    pixel smaller."""
    folder = reference_data / "pacnerf" / "bird" / "data"
    if not (folder / "r_0_-1.png").is_file():
        pytest.skip("no background plate of pacnerf/bird in the reference data")
    plate = read_image(folder / "r_0_-1.png")
    for frame in (0, 7):
        color, matte = matte_from_plate(read_image(folder / f"r_0_{frame}.png"), plate)
        given = read_image(folder / f"a_0_{frame}.png")
        ours, theirs = matte > 0.5, given[..., 3] > 0.5
        assert (ours & theirs).sum() / (ours | theirs).sum() > 0.98
        assert matte.sum() / theirs.sum() == pytest.approx(1, abs=0.015)
        assert np.abs(color[theirs] - given[..., :3][theirs]).mean() < 0.005
