"""The code of docs/robots.md: a gripper of a URDF file lifts a body and carries its weight."""

import re
from pathlib import Path

import numpy as np
import pytest

from mosa.physics.contact.mesh import read_mesh

PAGE = (Path(__file__).parents[2] / "docs" / "robots.md").read_text()


def test_every_shape_of_a_link_is_a_collider(tmp_path):
    pytest.importorskip("yourdfpy")
    trimesh = pytest.importorskip("trimesh")
    for folder in ("meshes", "urdf"):
        (tmp_path / folder).mkdir()
    trimesh.creation.box((20, 40, 60)).export(tmp_path / "meshes" / "a.dae")
    arm = """<robot name="arm"><link name="a"><collision><geometry>
    <mesh filename="package://robot/meshes/a.dae" scale="0.001 0.001 0.001"/></geometry></collision></link>
    <link name="b"><collision>
    <origin xyz="0 0 0.1"/><geometry><cylinder radius="0.02" length="0.2"/></geometry></collision>
    </link><joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""
    (tmp_path / "urdf" / "arm.urdf").write_text(arm)
    names: dict = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.S)[0], names)
    robot = names["Links"](tmp_path / "urdf" / "arm.urdf")
    mesh, solid = robot.colliders({"j": np.pi / 2})
    assert np.ptp(read_mesh(Path(mesh["path"]))[0], 0) == pytest.approx([0.02, 0.04, 0.06])
    assert mesh["position"] == [0, 0, 0]
    assert solid["position"] == pytest.approx([0, -0.1, 0]) and solid["length"] == 0.2
    assert solid["rotation"] == pytest.approx([1, 0, 0, 90])
    with pytest.raises(ValueError, match=r"^j: expected -3.0 to 3.0 rad or m, found 45"):
        robot.action({"j": 45})
    pose = robot.action({"j": np.pi / 2})["b"]
    assert np.allclose(pose["rotation"], [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


WHEEL = """<robot name="wheel"><link name="a"/><link name="b"><collision>
<geometry><cylinder radius="0.02" length="0.2"/></geometry></collision>
</link><joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/></joint></robot>"""


def test_a_wheel_turns_on_and_degrees_and_shapes_to_look_at_are_refused(tmp_path):
    pytest.importorskip("yourdfpy")
    names: dict = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.S)[0], names)
    (tmp_path / "wheel.urdf").write_text(WHEEL)
    robot = names["Links"](tmp_path / "wheel.urdf")
    assert robot.colliders({"j": 3})[0]["type"] == "cylinder"  # whole numbers, as others
    for value in (6, 9, 6, 7.5):
        turned = robot.action({"j": value})["b"]["rotation"]
        assert turned[1][1] == pytest.approx(np.cos(value))
    with pytest.raises(
        ValueError, match=r"^j: expected a step of at most pi rad, found 7.5 to 30: deg"
    ):
        robot.action({"j": 30})
    robot.colliders({"j": 30})  # where it begins
    shape = WHEEL[WHEEL.index("<collision>") : WHEEL.index("</link><joint")]
    (tmp_path / "two.urdf").write_text(WHEEL.replace(shape, 2 * shape))
    with pytest.raises(ValueError, match=r"expected one <collision> in a link, found .*'b': 2"):
        names["Links"](tmp_path / "two.urdf")
    more = '<link name="c"/><joint name="k" type="continuous"><parent link="b"/><child link="c"/>'
    follower = f'{more}<mimic joint="j"/></joint></robot>'
    (tmp_path / "mimic.urdf").write_text(WHEEL.replace("</robot>", follower))
    with pytest.raises(ValueError, match="k: follows j: expected the value of that joint alone"):
        names["Links"](tmp_path / "mimic.urdf").colliders({"j": 1, "k": 2})
    (tmp_path / "seen.urdf").write_text(WHEEL.replace("collision>", "visual>"))
    with pytest.raises(
        ValueError, match=r"seen\.urdf: expected links with <collision>, found none"
    ):
        names["Links"](tmp_path / "seen.urdf")
