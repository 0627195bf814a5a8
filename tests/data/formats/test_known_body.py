"""What `scene.body` and few cameras may say."""

import pytest

from mosa.data.formats.scene_from_footage import held_out_cameras, known_body
from mosa.errors import ConfigError, DataError


def test_a_body_is_its_file_and_scale(tmp_path):
    path = tmp_path / "scan.obj"
    path.write_text("v 0 0 0")
    found = known_body({"shape": str(path), "scale": 0.01})
    assert found is not None and (found.shape, found.scale) == (str(path), 0.01)
    path.write_text("v 0 0 1")
    other = known_body({"shape": str(path), "scale": 0.01})
    assert other is not None and other.fingerprint != found.fingerprint
    assert known_body(None) is None and known_body({"shape": None, "scale": None}) is None


@pytest.mark.parametrize(
    "keys, error, said",
    [
        ({"scale": 0.1}, ConfigError, r"scene\.body\.scale: expected scene\.body\.shape beside it"),
        ({"shape": "missing.ply"}, DataError, r"scene\.body\.shape: .* found missing\.ply"),
        ({"shape": "a" * 5000 + ".obj"}, DataError, r"scene\.body\.shape: .* found aaa"),
        ({"shape": __file__}, DataError, r"expected a file \.ply, \.obj, \.stl"),
        ({"shape": "a.ply", "scale": -1.0}, ConfigError, r"scene\.body\.scale"),
        ({"shape": "a.ply", "size": 1.0}, ConfigError, r"scene\.body\.size"),
        ("a.ply", ConfigError, r"scene\.body: expected a section"),
    ],
)
def test_other_keys_are_refused(keys, error, said):
    with pytest.raises(error, match=said):
        known_body(keys)


def test_one_camera_is_enough_for_a_known_body_alone():
    names = ("0", "1", "2")
    assert held_out_cameras([1, 2], names, 1) == (1, 2)
    with pytest.raises(ConfigError, match=r"at least two cameras .*scene\.body\.shape"):
        held_out_cameras([1, 2], names)
