"""The code of docs/robots.md: a gripper of a URDF file lifts a body and carries its weight."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from small_bodies import FRAME_DT, WORLD, small_body, start

from mosa.physics.contact.mesh import read_mesh
from mosa.twin.twin import Twin

PAGE = (Path(__file__).parents[2] / "docs" / "robots.md").read_text()
JAW = """<link name="{name}"><collision>
<geometry><box size="0.06 0.12 0.16"/></geometry></collision></link>
<joint name="{name}_slide" type="prismatic"><parent link="lift"/><child link="{name}"/>
<origin xyz="{x} 0 0"/><axis xyz="{side} 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>"""
GRIPPER = """<robot name="gripper"><link name="root"/><link name="lift"/>
<joint name="up" type="prismatic"><parent link="root"/><child link="lift"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>{jaws}</robot>"""


def test_a_gripper_lifts_a_body_and_carries_its_weight(tmp_path, monkeypatch):
    pytest.importorskip("yourdfpy")
    jaws = JAW.format(name="left", x=-0.1, side=1) + JAW.format(name="right", x=0.1, side=-1)
    (tmp_path / "gripper.urdf").write_text(GRIPPER.format(jaws=jaws))
    monkeypatch.chdir(tmp_path)
    body = small_body(adapter=False, precision=32, E=6e4)
    begun = start(height=0.04, speed=0.0, dtype=torch.float32)
    made = Twin(body, WORLD, FRAME_DT, None, begun)
    monkeypatch.setattr(Twin, "load", lambda path: made)
    links, use = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    carried = []
    use += "    carried.append(float(forces[:, 1].sum()))\n"
    names = {"carried": carried}
    exec(links + use, names)
    assert float(names["state"].positions[:, 1].mean()) > 0.12
    weight = 9.8 * 1000 * float(body.volume.sum())
    assert -np.mean(carried[-20:]) == pytest.approx(weight, rel=0.03)


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
