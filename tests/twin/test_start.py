"""Starts of a twin among solids: what is refused, and what is warned of."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_bodies import FRAME_DT, WORLD, small_body, start

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import colliders_from_config
from mosa.twin.start import warn_of_unmet
from mosa.twin.twin import Twin

STILL = {"velocity": (0, 0, 0), "angular_velocity": (0, 0, 0)}
FLOOR = {"type": "box", "size": [1, 0.1, 1], "position": [0, 0.05, 0], "mode": "separate"}


def twin(E=3e4) -> Twin:
    """A block of 0.12 x 0.1 x 0.08 m of particles 20 mm apart."""
    body = small_body(adapter=False, precision=32, E=E)
    return Twin(body, WORLD, FRAME_DT, None, start(height=0.3, speed=0.0, dtype=torch.float32))


@pytest.mark.parametrize(
    "turn", [(0.7071, 0, 0, 0.7071), (0, 0, 0.383, 0.924), (0.1, 0.7, 0.1, -0.7)]
)
def test_a_quaternion_is_no_axis_with_an_angle_in_degrees(turn):
    waypoints = [{"time": t, "position": [0, 0, 0], "rotation": turn} for t in (0, 1)]
    for given in (
        {"rotation": turn},
        {"rotation": torch.tensor(turn)},
        {"colliders": [{**FLOOR, "rotation": turn}]},
        {"colliders": [{"type": "sphere", "radius": 1, "motion": {"waypoints": waypoints}}]},
    ):
        with pytest.raises(
            ConfigError, match=r"rotation: expected \(ax, ay, az, deg.*a quaternion"
        ):
            twin().reset(**given)


@pytest.mark.parametrize("turn", [(1, 0, 0, 0), (0, 1, 0, 0.05), (0, 0.02, 0, 1), (0.6, 0, 0, 0.9)])
def test_a_small_angle_about_any_axis_is_one(turn):
    found = twin().reset(rotation=turn, **STILL).F[0].double()
    axis = np.array(turn[:3]) / np.linalg.norm(turn[:3])
    skew = [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]
    turned = torch.matrix_exp(np.deg2rad(turn[3]) * torch.tensor(skew, dtype=torch.float64))
    assert torch.allclose(found, turned, atol=1e-6)


def test_a_body_that_starts_in_the_contact_of_a_floor_is_warned_of_and_half_a_spacing_higher_is_calm():
    made, forces = twin(), []
    assert made.body.spacing == pytest.approx(0.02)
    for above in (0.0, 0.5 * made.body.spacing):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            made.reset(height=0.1 + above, **STILL, colliders=[FLOOR], control_dt=0.01)
        forces.append(-float(made.step().reactions[0, 0, 1]))
        said = [str(each.message) for each in told]
        assert ["found it 10 mm deep in a contact" in each for each in said] == [True] * (not above)
    weight = 9.8 * 1000 * float(made.body.volume.sum())
    assert forces[0] > 20 * weight and abs(forces[1]) < 0.1 * weight


def test_a_plane_that_faces_another_way_and_a_mesh_in_millimetres_are_named(tmp_path):
    made, box = twin(), tmp_path / "box.obj"
    with pytest.raises(ConfigError, match=r"inside of it .*; a plane fills all below its xy plane"):
        made.reset(
            colliders=[{"type": "plane", "position": [0, 0.1, 0], "rotation": [1, 0, 0, 90]}]
        )
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces = [(1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2), (3, 4, 8), (3, 8, 7), (1, 3, 7), (1, 7, 5),
             (2, 6, 8), (2, 8, 4)]  # fmt: skip
    rows = ["v %g %g %g" % tuple(30 * c for c in corner) for corner in corners]  # noqa: UP031
    box.write_text("\n".join(rows + ["f {} {} {}".format(*face) for face in faces]))
    solid = {"type": "mesh", "path": str(box), "spacing": 10}
    with pytest.raises(ConfigError, match=r"its mesh is 6\d m long \(scale: 0.001"):
        made.reset(colliders=[solid])
    with pytest.warns(
        UserWarning, match=r"^colliders\[0\]: expected a mesh about as large as .* 6\d m"
    ):
        made.reset(colliders=[{**solid, "position": [100, 0, 0]}])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made.reset(
            colliders=[{**solid, "position": [0.2, 0.3, 0], "scale": 0.001, "spacing": 0.01}]
        )


@pytest.mark.parametrize(
    "given, said",
    [
        ({"rotation": (0, 1, 0, 1.57)}, r"found 1.57, which is 90 degrees in radians"),
        ({"colliders": [{**FLOOR, "rotation": (1, 0, 0, -3.1416)}]}, r"180 degrees in radians"),
        ({"rotation": (0.7071, 0, 0.7071, 0)}, r"^rotation: .* turns by 0 degrees: was it a quat"),
        ({"colliders": [{**FLOOR, "rotation": (0.924, 0.383, 0, 0)}]}, r"was it a quaternion\?"),
        ({"height": 200}, r"^height: expected metres above the ground, found 200 m for a body of"),
        (
            {"colliders": [{"type": "sphere", "radius": 0.1, "position": [-325, 100, 0]}]},
            r"^colliders\[0\]: expected a solid within reach .* found it 340 m away: .* metres",
        ),
        (
            {"colliders": [{"type": "sphere", "radius": 5, "position": [-5.5, 0.3, 0]}]},
            r"^colliders\[0\]: .* body of 0.\d+ m, found one 10 m thick: lengths are in metres",
        ),
    ],
)
def test_radians_and_millimetres_are_asked_about(given, said):
    with pytest.warns(UserWarning, match=said):
        twin().reset(**STILL | given)


def told(run) -> list[str]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        run()
    return [str(each.message) for each in said if issubclass(each.category, UserWarning)]


@pytest.mark.parametrize("solid, said", [
    ({"position": [0.6, 0.05, 0]}, "found ball never nearer than 0.5 m"),
    ({"position": [0.6, 0.05, 0], "motion": {"velocity": [-3.0, 0, 0]}}, ""),
    ({"position": [0.1, 0.05, 0]}, ""), ({"position": [0.12, 0.05, 0]}, ""),  # met, and missed by 2 cm
    ({"position": [0, -0.2, 0]}, "found its highest point 0.15 m below"),
    ({"position": [0, -0.04, 0]}, ""),
])  # fmt: skip
def test_a_solid_that_a_whole_motion_does_not_come_near_is_named_once(solid, said):
    ball = {"type": "sphere", "name": "ball", "radius": 0.05, "mode": "separate", **solid}
    found = told(lambda: twin().simulate(frames=12, height=0.1, **STILL, colliders=[ball]))
    assert len(found) == bool(said) and said in "".join(found)


def test_a_solid_that_actions_do_not_bring_near_is_named_with_the_film_of_the_steps(tmp_path):
    made = twin()
    ball = {"type": "sphere", "name": "ball", "radius": 0.05, "position": [0.6, 0.35, 0]}
    wall = {"type": "plane", "normal": [1, 0, 0], "position": [-3, 0, 0]}  # is for safety

    def stepped(speed: float) -> None:
        states = [made.reset(**STILL, colliders=[ball, wall], gravity=(0, 0, 0), control_dt=0.02)]
        states += [made.step({"ball": (speed, 0, 0)}).state for _ in range(10)]
        made.export(states, tmp_path, video=False)

    assert told(lambda: stepped(-2.4)) == []
    assert "found ball never nearer than 0.5 m" in told(lambda: stepped(2.4))[0]


def test_a_solid_that_one_of_several_recordings_meets_is_none_to_name():
    made, ball = twin(), {"type": "sphere", "radius": 0.05, "position": [0.6, 0.05, 0]}
    met, missed = (
        made.simulate(frames=10, height=0.1, **STILL | {"velocity": (v, 0, 0)}, colliders=[ball])
        for v in (4, 0)
    )
    solids = colliders_from_config([ball], "colliders")
    assert told(lambda: warn_of_unmet([missed, met], solids, made.body, made.world)) == []
    (said,) = told(lambda: warn_of_unmet([missed], solids, made.body, made.world))
    assert "found colliders[0] never nearer than 0.5 m" in said


def test_a_mesh_far_away_has_a_distance(tmp_path):
    path = tmp_path / "tetrahedron.obj"
    path.write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    far = {"type": "mesh", "path": str(path), "position": [1, 0.3, 0]}
    (said,) = told(lambda: twin().simulate(frames=2, **STILL, colliders=[far]))
    away = float(said.partition("found colliders[0] never nearer than ")[2].removesuffix(" m"))
    assert 0.7 < away < 0.95


def test_a_solid_in_millimetres_that_holds_the_body_is_named():
    with pytest.raises(
        ConfigError, match=r"it reaches 86.6 m from its origin \(lengths are in metre"
    ):
        twin().reset(colliders=[{"type": "box", "size": [100, 100, 100], "position": [0, 0.1, 0]}])
    with pytest.raises(ConfigError, match=r"inside of it .* it reaches 5 m .*in metres\)$"):
        twin().reset(colliders=[{"type": "sphere", "radius": 5, "position": [0, 0.1, 0]}])


def test_a_solid_of_the_twin_s_run_that_holds_the_body_says_so():
    made = twin()
    ball = {"type": "sphere", "radius": 0.1, "position": [0, 0.3, 0]}
    made.world = replace(made.world, colliders=colliders_from_config([ball]))
    whose = (
        r"^world\.colliders\[0\]: .*; it comes with the twin's run: colliders=\[\] leaves it out$"
    )
    with pytest.raises(ConfigError, match=whose):
        made.simulate(frames=2, position=(0, 0.3, 0))
    assert len(made.simulate(frames=2, position=(0, 0.3, 0), colliders=[]).x) == 2


@pytest.mark.parametrize("mode, speed", [("separate", 20), ("sticky", 35)])
def test_a_grip_slides_about_as_fast_as_it_is_warned_of(mode, speed):
    """g dt H/(3 s) of friction, g dt H/(1.75 s) of sticky, with dt = 1/800 s."""
    made = twin(E=6e4)
    jaws = [{"type": "box", "name": str(side), "size": [0.06, 0.12, 0.16], "position": [0.1 * side, 0.3, 0], "mode": mode,
             "friction": 0.8 * (mode == "separate")} for side in (-1, 1)]  # fmt: skip

    def slides(substeps) -> float:
        made.reset(**STILL, colliders=jaws, control_dt=0.01, substeps=substeps)
        heights = []
        for k in range(45):
            at = 0.1 - 0.017 * min(1, (k + 1) / 10)
            action = {str(side): {"position": (at * side, 0.3, 0)} for side in (-1, 1)}
            heights.append(float(made.step(action).state.positions[:, 1].mean()))
        return 1e3 * (heights[20] - heights[44]) / 0.24

    with pytest.warns(
        UserWarning,
        match=rf"about {speed}\.?\d* mm/s with 8 substeps by its weight alone; subs.*=\d+ giv",
    ):
        found = slides(8)
    assert 0.6 * speed < found < 1.2 * speed
    with pytest.warns(UserWarning, match=f"about {speed}"):
        made.worlds(2).reset(STILL, colliders=jaws, control_dt=0.01, substeps=8)
    if mode == "separate":
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert slides(33) < 6


def test_jaws_that_close_through_each_other_are_named_once():
    plates = [{"type": "box", "name": name, "size": [0.04, 0.1, 0.1], "position": [x, 0.6, 0]}
              for name, x in (("left", -0.05), ("right", 0.05))]  # fmt: skip
    also = {"type": "box", "name": "wrist", "size": [0.02, 0.3, 0.1], "position": [-0.06, 0.6, 0]}

    def told(run) -> list[str]:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            run()
        return [str(each.message) for each in said if "inside each other" in str(each.message)]

    def stepped(to):
        made = twin()
        made.reset(**STILL, colliders=[*plates, also], control_dt=0.01, substeps=100)
        for k in range(4):
            x = 0.05 - (0.05 - to) * (k + 1) / 4
            made.step({"left": {"position": (-x, 0.6, 0)}, "right": {"position": (x, 0.6, 0)}})

    assert told(lambda: stepped(0.021)) == []
    (found,) = told(lambda: stepped(0.012))
    assert "found left and right 16 mm inside each other" in found
    moving = [
        {**each, "motion": {"velocity": [-10 * each["position"][0], 0, 0]}} for each in plates
    ]
    assert len(told(lambda: twin().simulate(frames=6, **STILL, colliders=moving))) == 1


def test_a_turn_in_degrees_is_asked_about():
    made = twin()
    made.reset(**STILL, colliders=[{**FLOOR, "name": "floor"}], control_dt=0.01)
    with pytest.raises(ConfigError, match=r"use more substeps .*radians"):
        made.step({"floor": {"rotation": (0, 0, 90)}})


def test_a_rollout_takes_as_many_substeps_as_it_is_told():
    made = twin()
    assert made.simulate(frames=3, substeps=64, **STILL).counts == (64, 64)
    with pytest.raises(ConfigError, match="substeps"):
        made.simulate(frames=3, substeps=1, **STILL)


def test_another_gravity_is_that_of_the_fall():
    made, pull = twin(), (0.5, -1.62, 0.0)
    state = made.reset(gravity=pull, **STILL)
    first = state.positions.mean(0)
    for _ in range(4):
        state = made.step().state
    fallen = 0.5 * torch.tensor(pull) * (4 * FRAME_DT) ** 2
    torch.testing.assert_close(state.positions.mean(0) - first, fallen, rtol=0, atol=1e-5)
    x = made.simulate(gravity=pull, frames=5, **STILL).x[-1]
    torch.testing.assert_close(x, state.positions, rtol=0, atol=1e-6)
    assert float(made.world.gravity[1]) == pytest.approx(-9.8)
    with pytest.warns(UserWarning, match=r"^gravity: \[0.0, 9.8, 0.0\] m/s\^2 points up"):
        made.reset(gravity=(0, 9.8, 0), **STILL)
    for wrong in (-1.62, (0, -1.62), "moon"):
        with pytest.raises(ConfigError, match=r"^gravity: expected three finite numbers"):
            made.reset(gravity=wrong)


def test_a_value_of_the_material_is_named_as_it_was_set():
    with pytest.raises(ConfigError, match=r"^E: expected a number, found"):
        twin().material.E = "2e4"


def test_a_law_in_megapascals_is_asked_about_in_worlds_too():
    made = twin()
    for begin in (
        lambda: made.worlds(2, laws=[{"E": 0.03}, {}]),
        lambda: made.material.set(E=0.03),
    ):
        with pytest.warns(UserWarning, match=r"^E: 0.03 Pa does not carry the body's weight"):
            begin()
