"""Colliders from plain containers, and what is wrong with them."""

import math
import re
from pathlib import Path

import pytest
import torch

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import (
    Box,
    Collider,
    HalfSpace,
    Sphere,
    colliders_from_config,
    pack_colliders,
    reach,
)
from mosa.physics.contact.keys import KEYS
from mosa.physics.contact.motion import Motion, exponential
from mosa.physics.contact.overlap import check_clear
from mosa.physics.contact.reference import signed_distance
from mosa.physics.engine.simulator import Simulator


def test_every_type(tmp_path):
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    text = [f"v {x} {y} {z}" for x, y, z in corners] + [
        "f " + " ".join(str(i + 1) for i in f) for f in faces
    ]
    (tmp_path / "cube.obj").write_text("\n".join(text))
    made = colliders_from_config([
        {"type": "plane", "normal": [0, 2, 0], "position": [0, 1, 0], "mode": "separate", "friction": 0.3},
        {"type": "sphere", "radius": 0.1, "motion": {"velocity": [1, 0, 0], "angular_velocity": [0, 0, 1]}},
        {"type": "capsule", "radius": 0.1, "length": 0.4, "rotation": [0, 0, 1, 90]},
        {"type": "cylinder", "radius": 0.3, "length": 0.4, "mode": "touch", "name": "roll"},
        {"type": "box", "size": [1, 2, 2], "motion": {"waypoints": [
            {"time": 0.0, "position": [0, 0, 0]}, {"time": 1.0, "position": [0, 0, 1], "rotation": [1, 0, 0, 90]}]}},
        {"type": "mesh", "path": str(tmp_path / "cube.obj"), "spacing": 0.1, "scale": 2.0, "margin": 0.6},
    ])  # fmt: skip
    pack_colliders(made, torch.float32, torch.device("cpu"))
    plane, sphere, capsule, roll, box, mesh = made
    assert plane.mode == "separate" and plane.friction == 0.3
    up = plane.motion.sample(1, 1, 0.1)[1][0] @ torch.tensor([0.0, 0.0, 1.0]).double()
    torch.testing.assert_close(up, torch.tensor([0.0, 1.0, 0.0]).double(), rtol=0, atol=1e-15)
    assert sphere.shape == Sphere(0.1) and sphere.motion.max_speed(2.0) == pytest.approx(3.0)
    turned = capsule.motion.sample(1, 1, 0.1)[1][0]
    torch.testing.assert_close(
        turned[:, 0], torch.tensor([0.0, 1.0, 0.0]).double(), rtol=0, atol=1e-15
    )
    assert (roll.name, roll.mode) == ("roll", "touch") and reach(roll.shape) == pytest.approx(
        math.hypot(0.3, 0.2)
    )
    assert (
        reach(box.shape) == pytest.approx(1.5)
        and reach(capsule.shape) == pytest.approx(0.3)
        and reach(plane.shape) == 0
    )
    x, R, *_ = box.motion.sample(3, 1, 0.5)
    torch.testing.assert_close(x[1], torch.tensor([0.0, 0.0, 0.5]).double())
    torch.testing.assert_close(
        R[2] @ R[2], torch.diag(torch.tensor([1.0, -1.0, -1.0])).double(), rtol=0, atol=1e-12
    )
    centre = torch.ones(1, 3).double()
    assert float(signed_distance(mesh.shape, centre)) == pytest.approx(-1.0, abs=0.06)
    assert mesh.shape.margin == 0.6


def test_the_page_about_the_twin_lists_every_type_and_key():
    page = (Path(__file__).parents[3] / "docs" / "twin.md").read_text()
    section = page.partition("## Colliders")[2].partition("\n## ")[0]
    rows = dict(re.findall(r"^\| `(\w+)`[^|]*\| (.*?) \|", section, re.MULTILINE))
    own = {"plane": ["normal"], "sphere": ["radius"], "capsule": ["radius", "length"], "cylinder": ["radius", "length"],
           "box": ["size"], "mesh": ["path", "scale", "spacing", "margin"]}  # fmt: skip
    needed = {"radius": 0.1, "length": 0.2, "size": [1, 1, 1]}
    for kind, keys in own.items():
        assert {key for key in KEYS if f"`{key}`" in rows[kind]} - {"rotation"} == set(keys)
        if kind != "mesh":
            given = {"type": kind, **{key: needed[key] for key in keys if key in needed}}
            assert colliders_from_config([given])[0].mode == "sticky"  # needs no other key
    common = set(KEYS) - {key for keys in own.values() for key in keys}
    assert common == set(rows) - set(own) - {"type"}
    turned, facing = colliders_from_config(
        [{"type": "plane", "rotation": [1, 0, 0, -90]}, {"type": "plane", "normal": [0, 1, 0]}]
    )
    poses = [collider.motion.sample(1, 1, 0.1)[1][0] for collider in (turned, facing)]
    torch.testing.assert_close(*poses, rtol=0, atol=1e-15)
    assert turned.shape == HalfSpace()


AT = {"time": 0, "position": [0, 0, 0]}


@pytest.mark.parametrize(
    "item, match",
    [
        ({"type": "blob"}, r"world\.colliders\[0\]\.type: expected one of plane, sphere.*'blob'"),
        ({"type": "sphere"}, "a sphere needs radius"),
        ({"type": "sphere", "radius": 1, "length": 2}, "unknown: length"),
        ({"type": "sphere", "radius": "wide"}, r"\[0\]\.radius: expected a number above 0.*, found 'wide'"),
        ({"type": "box", "size": 3.0}, r"\[0\]\.size: expected three lengths above 0"),
        ({"type": "plane", "normal": [0, 0, 0]}, "normal: expected a non-zero"),
        ({"type": "plane", "normal": [0, 0, 1], "rotation": [0, 0, 1, 3]}, "one of them"),
        ({"type": "sphere", "radius": 1, "rotation": [0, 0, 0, 90]}, "rotation: expected"),
        ({"type": "sphere", "radius": 1, "motion": {"speed": 1}}, r"motion\.speed: unknown key; expected one of velocity"),
        ({"type": "sphere", "radius": 1, "motion": {"waypoints": [AT, AT], "velocity": [0, 0, 0]}}, "stand alone"),
        ({"type": "mesh", "path": "absent.obj"}, r"colliders\[0\]: mesh: no file"),
        ({"type": ["sphere"]}, r"\[0\]\.type"),
        ({"type": "sphere", "radius": True}, r"\[0\]\.radius"),
        ({"type": "sphere", "radius": math.inf}, r"\[0\]\.radius"),
        ({"type": "sphere", "radius": 1e300}, r"\[0\]\.radius"),
        ({"type": "box", "size": [1, 1]}, r"\[0\]\.size"),
        ({"type": "box", "size": [1, 1, 0]}, r"\[0\]\.size"),
        ({"type": "box", "size": "111"}, r"\[0\]\.size"),
        ({"type": "sphere", "radius": 1, "thickness": 0.02}, r"\[0\]: unknown: thickness; a sphere takes radius, name, mode"),
        ({"type": "sphere", "radius": 1, "friction": math.inf, "mode": "separate"}, r"\[0\]\.friction"),
        ({"type": "sphere", "radius": 1, "friction": 0.5}, r"\[0\]: friction: acts on modes separate and touch"),
        ({"type": "sphere", "radius": 1, "mode": ["slip"]}, r"\[0\]\.mode"),
        ({"type": "sphere", "radius": 1, "position": [0, math.nan, 0]}, r"\[0\]\.position"),
        ({"type": "sphere", "radius": 1, "position": [0, True, 0]}, r"\[0\]\.position"),
        ({"type": "sphere", "radius": 1, "motion": 5}, r"\[0\]\.motion: expected a section"),
        ({"type": "sphere", "radius": 1, "motion": {"velocity": "abc"}}, r"\[0\]\.motion\.velocity"),
        ({"type": "sphere", "radius": 1, "motion": {"velocity": [1, 2]}}, r"\[0\]\.motion\.velocity"),
        ({"type": "sphere", "radius": 1, "motion": {"velocity": [1, 0, 0], "times": [1, 0]}}, r"motion\.times"),
        ({"type": "sphere", "radius": 1, "motion": {"waypoints": []}}, r"motion\.waypoints: expected two poses"),
        ({"type": "sphere", "radius": 1, "motion": {"waypoints": [5, 6]}}, r"motion\.waypoints"),
        ({"type": "sphere", "radius": 1, "motion": {"waypoints": [{"time": "a", "position": [0, 0, 0]}] * 2}}, r"\[0\]\.time"),
    ],
)  # fmt: skip
def test_errors_of_a_configuration(item, match):
    with pytest.raises(ConfigError, match=match):
        colliders_from_config([item])


@pytest.mark.parametrize(
    "collider, match",
    [
        (lambda: Collider(Sphere(0.0)), "collider 0: Sphere: expected positive"),
        (lambda: Collider(Sphere(1.0), "bouncy", name="ball"), "collider ball: mode.*'bouncy'"),
        (lambda: Collider(Sphere(1.0), "slip", 0.2), "separate and touch only"),
        (lambda: Collider(Sphere(1.0), "touch", -1.0), "friction"),
        (lambda: Collider(Sphere(1.0), "touch", math.inf), "friction"),
        (lambda: Collider(Sphere(math.inf)), "positive lengths"),
        (lambda: Collider("sphere"), "shape: expected one of HalfSpace"),
    ],
)
def test_packing_errors(collider, match):
    with pytest.raises(ConfigError, match=match):
        pack_colliders([collider()], torch.float64, torch.device("cpu"))


def test_motions_of_another_number(make_block):
    simulator = Simulator(
        "corotated",
        dx=0.04,
        substeps=5,
        frame_dt=0.01,
        colliders=[Collider(Sphere(0.1))],
        dtype=torch.float64,
    )
    with pytest.raises(ConfigError, match="one for each of 1 colliders, found 2"):
        simulator.rollout(
            make_block(),
            {"mu": 4e4, "lam": 5e4},
            torch.full((64,), 8e-6).double(),
            1e3,
            2,
            motions=[Motion()] * 2,
        )


@pytest.mark.parametrize("turn, place", [(0.0, 0.0), (0.4, 0.0), (0.0, 0.0255), (0.0, 0.3)])
def test_a_plate_between_the_particles_is_inside_of_the_body(turn, place):
    """1 mm thick among particles 10 mm apart, none of which it contains; one beside the body is not."""
    axis, turned = 0.01 * (torch.arange(4).double() - 1.5), torch.tensor([0.0, 0.0, turn]).double()
    plate = Collider(Box((0.001, 0.5, 0.5)), motion=Motion((place, 0.0, 0.0), turned))
    x = torch.cartesian_prod(axis, axis, axis) @ exponential(turned).T
    if place:
        check_clear([plate], x, "the body", spacing=0.01)
        return
    with pytest.raises(ConfigError, match=r"world\.colliders\[0\]: .* outside of, found 50% of"):
        check_clear([plate], x, "the body", spacing=0.01)
