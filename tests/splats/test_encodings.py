"""Files of Gaussians as other programs write them: encodings are known by the numbers, the object's extent by the object."""

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from test_splat_objects import BALL, RADIUS, ball, settings

from mosa.data.io.gaussian_ply import load_ply, save_ply
from mosa.errors import ConfigError, DataError
from mosa.splats.objects import fill_object, read_object


def written(path, change=None, comments=(), double=False):
    """The ball's file with its columns changed."""
    made = ball()
    save_ply(path, made.splats, made.harmonics)
    data = PlyData.read(path)["vertex"].data
    columns = {name: np.array(data[name], float) for name in data.dtype.names}
    columns = change(columns) if change else columns
    array = np.empty(
        len(columns["x"]), dtype=[(name, "f8" if double else "f4") for name in columns]
    )
    for name, values in columns.items():
        array[name] = values
    PlyData([PlyElement.describe(array, "vertex")], byte_order="<", comments=list(comments)).write(
        path
    )
    return path


def plain_scales(d):
    return d | {f"scale_{i}": np.exp(d[f"scale_{i}"]) for i in range(3)}


def plain_opacities(d):
    g = np.random.default_rng(0)
    return d | {"opacity": g.uniform(0.4, 1, len(d["x"]))}


def times(factor):
    """The same file in another unit, its scales logarithms of larger numbers."""
    return lambda d: (
        d
        | {k: factor * d[k] for k in "xyz"}
        | {f"scale_{i}": d[f"scale_{i}"] + np.log(factor) for i in range(3)}
    )


@pytest.mark.parametrize("change, said", [
    (plain_scales, "scales as lengths"), (plain_opacities, "opacities as they are"),
    (lambda d: plain_opacities(plain_scales(d)), "scales as lengths, not their logarithms and opacities"),
    (lambda d: plain_scales(times(30.0)(d)), "scales as lengths"), (lambda d: plain_scales(times(1e-3)(d)), "scales as lengths"),
])  # fmt: skip
def test_encodings_are_known_by_their_numbers(tmp_path, change, said):
    with pytest.warns(UserWarning, match=said):
        splats, _ = load_ply(written(tmp_path / "a.ply", change))
    factor = float(splats.means.norm(dim=1).mean()) / RADIUS
    assert torch.allclose(splats.scales / factor, ball().splats.scales, rtol=1e-3)
    assert 0.1 < float(splats.opacities.min()) and float(splats.opacities.max()) <= 1


@pytest.mark.parametrize("factor", [1.0, 1e-3, 30.0, 1000.0, 1e5])
def test_logarithms_stay_logarithms_in_any_unit(tmp_path, recwarn, factor):
    splats, _ = load_ply(written(tmp_path / "a.ply", times(factor)))
    assert torch.allclose(splats.scales / factor, ball().splats.scales, rtol=1e-3)
    assert torch.allclose(splats.opacities, ball().splats.opacities) and not recwarn.list


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    splats, _ = load_ply(
        written(tmp_path / "a.ply", lambda d: d | {"filter_3D": 0 * d["x"] + 0.003})
    )
    wide = (ball().splats.scales.square() + 0.003**2).sqrt()
    assert torch.allclose(splats.scales, wide)
    assert torch.allclose(splats.opacities, 0.9 * (ball().splats.scales / wide).prod(1))


@pytest.mark.parametrize(
    "up, warns", [((0, 1, 0), True), ((0, 0, 1), False), ((0, 0, -1), False), (None, False)]
)
def test_the_headers_vertical_axis_is_compared(tmp_path, recwarn, up, warns):
    read_object(written(tmp_path / "a.ply", comments=["Vertical Axis: z"]), up=up)
    assert warns == any("its header says that z is vertical" in str(w.message) for w in recwarn)


@pytest.mark.parametrize("offset", [1e3, 4e5, (4e5, 5e6, 0), -1e6, 1e8])
def test_an_object_far_from_the_origin_keeps_its_shape(tmp_path, offset):
    offset = np.broadcast_to(offset, 3).astype(float)
    moved = written(
        tmp_path / "a.ply", lambda d: d | {k: d[k] + o for k, o in zip("xyz", offset)}, double=True
    )
    found = read_object(moved, box=[(offset - 0.2).tolist(), (offset + 0.2).tolist()])
    assert len(found.splats.means) == len(ball().splats.means)
    home, here = (x - x.median(0).values for x in (ball().splats.means, found.splats.means))
    assert torch.allclose(home, here, atol=1e-6 if np.abs(offset).max() < 1e7 else 1e-5)


def strays(places, colors=0.0):
    places = np.atleast_2d(np.array(places, float))

    def change(d):
        more = {k: np.repeat(v[:1], len(places)) for k, v in d.items()}
        return {
            k: np.r_[v, places[:, "xyz".index(k)] if k in "xyz" else more[k]] for k, v in d.items()
        }

    return change


@pytest.mark.parametrize("places", [
    [[1, 0, 0]], [[30, 0, 0], [0, -50, 0]], [[0.3, 0.3, 0.3], [-0.4, 0, 0]], np.random.default_rng(0).uniform(-9, 9, (10, 3)),
    [[2, 2, 2], [2.01, 2, 2], [2, 2.01, 2]], [[1e6, 0, 0]],
])  # fmt: skip
def test_strays_are_no_part_of_the_object(tmp_path, places):
    found = read_object(written(tmp_path / "a.ply", strays(places)), size=0.3)
    side = found.splats.means.amax(0) - found.splats.means.amin(0)
    assert len(found.splats.means) == 1500 and float(side.max()) == pytest.approx(0.3, rel=1e-5)


def test_the_volume_is_the_objects_whatever_lies_around_and_however_it_is_written(tmp_path):
    change = lambda d: plain_scales(strays([[30, 0, 0], [0, -9, 0]])(d))  # noqa: E731
    with pytest.warns(UserWarning, match="scales as lengths"):
        found = read_object(written(tmp_path / "a.ply", change), size=2 * RADIUS)
    tensors, _, _ = fill_object(found, settings(400))
    assert float(tensors["volume"].sum()) == pytest.approx(BALL, rel=0.1)


def test_an_object_of_two_parts_stays_whole(tmp_path):
    two = lambda d: {k: np.r_[v, v + 0.5 * (k == "x")] for k, v in d.items()}  # noqa: E731
    assert len(read_object(written(tmp_path / "a.ply", two)).splats.means) == 3000


@pytest.mark.parametrize("content, said", [
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n", "a pointer of Git LFS; git lfs pull"),
    (b"\x1f\x8b\x08\x00rest", "a gzip file, as .spz is"), (b"PK\x03\x04rest", "a zip file, as .sog is"),
    (b"<!DOCTYPE html><html>", "a web page"), (b'{"means": 1}', "a text in JSON"), (b"", "damaged or other one of 0 bytes"),
])  # fmt: skip
def test_other_files_are_called_by_what_they_are(tmp_path, content, said):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(DataError, match=said):
        load_ply(tmp_path / "a.ply")


def test_other_layouts_are_called_by_what_they_are(tmp_path):
    packed = lambda d: {"packed_position": d["x"]} | {k: d[k] for k in "xyz"}  # noqa: E731
    with pytest.raises(DataError, match="found a compressed one; export it uncompressed"):
        load_ply(written(tmp_path / "a.ply", packed))
    points = lambda d: {k: d[k] for k in "xyz"} | {k: d["x"] for k in ("red", "green", "blue")}  # noqa: E731
    with pytest.raises(DataError, match="a point cloud or mesh cannot be used; train 3DGS"):
        load_ply(written(tmp_path / "a.ply", points))
    prefixed = lambda d: {k if k in "xyz" else f"scalar_{k}": v for k, v in d.items()}  # noqa: E731
    assert torch.allclose(
        load_ply(written(tmp_path / "a.ply", prefixed))[0].scales, ball().splats.scales
    )


def test_a_comment_in_any_language_is_no_damage(tmp_path):
    path = written(tmp_path / "a.ply", comments=["made by X"])
    path.write_bytes(path.read_bytes().replace(b"made by X", "für Ω".encode()))
    assert len(load_ply(path)[0].means) == 1500


@pytest.mark.parametrize("change", [
    lambda v: np.exp(2 * v), lambda v: v / np.log(10), lambda v: np.exp(-v), lambda v: 0 * v, np.expm1,
])  # fmt: skip
def test_scales_in_an_encoding_that_nobody_knows_are_refused(tmp_path, change):
    """Variances, decadic logarithms, inverses, none, and differences from 1: wider than the object they show."""
    scales = lambda d: d | {f"scale_{i}": change(d[f"scale_{i}"]) for i in range(3)}  # noqa: E731
    with pytest.raises(DataError, match=r"scale_\*: expected logarithms .* another encoding"):
        read_object(written(tmp_path / "a.ply", scales))


@pytest.mark.parametrize("size, said", [(200.0, "large"), (0.001, "small"), (0.2, None)])
def test_an_unlikely_size_is_one_warning(tmp_path, recwarn, size, said):
    read_object(written(tmp_path / "a.ply"), size=size)
    assert [str(w.message).split(" unusually ")[1][:5] for w in recwarn] == [said] * bool(said)


@pytest.mark.parametrize("factor", [14.0, 1000.0, 0.01])
def test_the_size_is_asked_for_where_metres_are_implausible(tmp_path, factor):
    large = written(tmp_path / "a.ply", times(factor))
    with pytest.raises(ConfigError, match=r"^size: .*a\.ply has no unit, .* m long; .*size=0\.2"):
        read_object(large)


def test_opacities_in_per_cent_and_an_object_of_no_extent_are_refused(tmp_path):
    g = np.random.default_rng(0)
    change = lambda d: d | {"opacity": g.uniform(40, 100, len(d["x"]))}  # noqa: E731
    with pytest.raises(
        DataError, match=r"field opacity: expected logits, found 4.* per cent or bytes"
    ):
        load_ply(written(tmp_path / "a.ply", change))
    with pytest.raises(DataError, match=r"field scale_.*: expected logarithms .* an object of 0"):
        read_object(written(tmp_path / "a.ply", lambda d: d | {k: 0 * d[k] for k in "xyz"}))
    with pytest.raises(ConfigError, match=r"^size: expected a number above 0"):
        read_object(tmp_path / "a.ply", size=-1)


def test_colours_as_bytes_are_refused(tmp_path):
    change = lambda d: d | {f"f_dc_{i}": 0 * d["x"] + 90 + i for i in range(3)}  # noqa: E731
    with pytest.raises(DataError, match=r"field f_dc_\*: .*found half of them beyond 91: .*bytes"):
        load_ply(written(tmp_path / "a.ply", change))
