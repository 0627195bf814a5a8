"""A twin that is played with: the motion it makes, what the ball does to it, its colours, and what goes wrong; and the page."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mosa.config.build import build_world
from mosa.modules.body.body import Body, SimulationSettings, Start
from mosa.modules.body.material import Material
from mosa.twin.twin import Twin
from mosa.viewer.live import COURANT, FASTEST, Live

SPACING, DX, DT = 0.02, 0.04, 0.01
START = 0.05
"""Height of the training's start above the ground [m]."""


def twin(**settings) -> Twin:
    """A cube of 0.1 m above the ground at 0, in a box of 1.2 m; nothing was learned, and no posterior kept."""
    axis = SPACING * torch.arange(5.0) + 0.5 * SPACING
    rest = torch.cartesian_prod(axis, axis, axis) - 0.05
    n = len(rest)
    tensors = {"rest": rest, "volume": torch.full((n,), SPACING**3), "colors": torch.full((n, 3), 0.25),
               "opacities": torch.full((n,), 0.9), "covariances": 1e-4 * torch.eye(3).expand(n, 3, 3).clone()}  # fmt: skip
    world = {
        "ground": {"height": 0.0},
        "gravity": [0, -9.8, 0],
        "up": [0, 1, 0],
        "box": [[-0.6, -0.1, -0.6], [0.6, 1.1, 0.6]],
    }
    body = Body(**tensors, density=1000.0, material=Material("neo_hookean", {"E": 2e4, "nu": 0.3}), heterogeneity=None,
                adapter=None, settings=SimulationSettings(dx=DX, **settings))  # fmt: skip
    start = Start(
        torch.eye(3),
        torch.tensor([0.0, 0.04 + START, 0.0]),
        torch.tensor([0.0, -1.0, 0.0]),
        torch.zeros(3),
    )
    return Twin(body.eval(), build_world(world), DT, None, start)


def test_it_begins_where_the_training_did_and_drops_as_it_is_told():
    live = Live(twin())
    assert (
        live.drop_as.height == pytest.approx(START, abs=1e-6)
        and not live.running
        and live.message == ""
    )
    live.change(height=0.2, tilt=90, speed=0.5, spin=0.25)
    assert live.drop() and live.running
    x = live.positions.numpy()
    assert x[:, 1].min() == pytest.approx(0.2, abs=1e-5)
    # tilted by a right angle to the right: what was on top is at the right
    top = live.arms[:, 1] > 0.03
    assert x[top, 0].mean() > x[~top, 0].mean() + 0.04
    before = x.mean(0)
    for _ in range(5):
        assert live.step()
    moved = live.positions.numpy().mean(0) - before
    assert moved == pytest.approx([0.5 * 5 * DT, -0.5 * 9.8 * (5 * DT) ** 2, 0], abs=2e-4)
    assert live.time == pytest.approx(5 * DT) and "0.050 s" in live.caption()
    assert live.reset() and not live.running and live.time == 0
    assert np.allclose(live.positions.numpy(), x)  # of the last drop, not of the training


def test_a_heading_turns_where_it_goes():
    live = Live(twin())
    live.change(height=0.2, speed=1.0, heading=90)
    live.drop()
    before = live.positions.numpy().mean(0)
    live.step()
    moved = live.positions.numpy().mean(0) - before
    assert abs(moved[2]) == pytest.approx(DT, rel=1e-3) and abs(moved[0]) < 1e-5


def test_the_ball_goes_to_its_target_no_faster_than_a_step_allows_and_pushes_the_body():
    live = Live(twin())
    live.change(height=0.0)
    live.drop()
    still = live.positions.numpy()[:, 0].mean()
    waits = live.hand_position.copy()
    live.step()
    assert np.allclose(live.hand_position, waits) and np.linalg.norm(live.force) == 0
    live.target = np.array([0.5, waits[1], 0.0])  # a mouse that jumps through the body
    speed = np.linalg.norm(live.pull())
    most = COURANT * DX * live.twin.episode.substeps / DT
    assert speed == pytest.approx(min(most, FASTEST * live.size)) and speed < 0.6 / DT
    live.target = live.hand_position + np.array([0.25, 0, 0])
    forces = []
    for _ in range(120):
        assert live.step()
        forces.append(live.force[0])
    assert np.allclose(live.hand_position, live.target, atol=1e-9)
    assert live.positions.numpy()[:, 0].mean() > still + 0.02
    assert min(forces) < -0.1  # the body pushes back
    assert live.reset() and np.allclose(live.hand_position, waits)


def test_a_ball_inside_of_the_body_goes_home():
    live = Live(twin())
    live.target = np.array([0.0, START + 0.04, 0.0])
    assert live.drop() and live.message == ""
    assert (
        np.linalg.norm(live.positions.numpy() - live.hand_position, axis=1).min() > live.radius + DX
    )
    assert np.allclose(live.hand_position, live.home())


def test_a_motion_that_diverges_stops_with_a_message_and_the_next_drop_goes_on():
    live = Live(twin())
    live.change(speed=8.0, height=0.3)
    live.drop()
    reached = 0
    while live.running and reached < 60:
        shown = live.positions.numpy()
        reached += live.step()
    assert 3 < reached < 60 and not live.running
    assert (
        live.message.startswith("The simulation diverged at 0.")
        and "Drop the body again" in live.message
    )
    assert np.array_equal(live.positions.numpy(), shown) and np.isfinite(shown).all()
    assert not live.step() and "diverged" in live.message
    live.change(speed=0.0)
    assert live.drop() and live.message == "" and live.step()


def test_a_start_that_cannot_be_is_said_and_what_was_there_stays():
    live = Live(twin())
    live.change(height=float("nan"))
    assert (
        not live.drop()
        and live.message.startswith("ConfigError: height: expected")
        and not live.running
    )
    live.change(height=START)
    assert live.drop() and live.message == ""


def test_errors_that_are_no_mistake_of_a_user_go_through(monkeypatch):
    live = Live(twin())
    monkeypatch.setattr(live.twin, "step", lambda action: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        live.step()


def test_colours_are_by_stretch_and_stiffness():
    live = Live(twin())
    colors, scale = live.paint("appearance")
    assert (colors == 0.25).all() and scale is None
    state = live.twin.state
    F = torch.eye(3).expand(len(live.arms), 3, 3).clone()
    F[:, 0, 0], F[:10, 1, 1], F[:, 2, 2] = 0.5, 1.3, 1.04
    live.state = SimpleNamespace(F_tot=F, positions=state.positions, time=0.0)
    assert live.stretch()[:10] == pytest.approx(0.3, abs=1e-6) and live.stretch()[
        10:
    ] == pytest.approx(0.04, abs=1e-6)
    colors, scale = live.paint("stretch")
    assert scale.high == 50 and scale.beyond == "max" and not np.allclose(colors[0], colors[-1])
    live.state = SimpleNamespace(
        F_tot=torch.eye(3).expand_as(F), positions=state.positions, time=0.0
    )
    assert live.paint("stretch")[1].high == 50  # it does not flicker
    assert live.paint("heterogeneity")[1].low == 0.99  # nothing was learned: no contrast


def test_the_page_drops_steps_pushes_and_outlives_a_divergence():
    pytest.importorskip("viser")
    import time
    from urllib.request import urlopen

    from mosa.viewer.live_viewer import LiveViewer

    live = Live(twin())
    shown = LiveViewer(live, port=0)
    try:
        with urlopen(f"http://127.0.0.1:{shown.server.get_port()}", timeout=10) as page:
            assert page.status == 200
        assert shown.server.scene.get_handle_by_name("/ground") is not None
        assert shown.splats.visible and not shown.points.visible
        assert np.allclose(shown.splats.centers * shown.unit, live.positions.numpy(), atol=1e-6)
        assert shown.sliders["height"].value == pytest.approx(START, abs=1e-6)
        shown.step()
        assert (
            live.time == pytest.approx(DT)
            and not live.running
            and shown.buttons["pause"].label == "go on"
        )
        shown.geometry.value, shown.color.value = "particles", "stretch"
        assert shown.points.visible and not shown.splats.visible and shown.legend.visible
        assert np.allclose(shown.points.points, live.positions.numpy(), atol=1e-6)
        shown.sliders["height"].value, shown.sliders["tilt"].value = 0.25, 30
        shown.stiffness.value = 4.0
        shown.drop()
        assert live.twin.material.E == pytest.approx(1e4)
        with shown.busy:
            assert live.drop_as.height == 0.25 and live.drop_as.tilt == 30 and live.running
        until = time.time() + 30
        while live.time < 3 * DT and time.time() < until:
            time.sleep(0.01)
        assert live.time >= 3 * DT  # by itself
        shown.pause()
        at = live.time
        time.sleep(0.05)
        assert live.time == at and not live.running
        shown.pushed((0.1, 0.2, 0.3))
        for place in (
            (math.nan, 0, 0),
            (math.inf, 0, 0),
            (1e300, 0, 0),
            (1, 2),
            3.0,
            None,
            ((1, 2, 3),),
        ):
            shown.pushed(place)  # which no message may make the ball's
        assert live.target == pytest.approx([0.1, 0.2, 0.3])
        assert shown.draggable  # by the viser that the tests ask for
        here = live.hand_position.copy()
        shown.dragged(
            SimpleNamespace(start_position=(0.0, 0.0, 0.0), end_position=(0.003, 0.0, 0.0))
        )
        assert live.target == pytest.approx(here + np.array([0.003, 0, 0])) and np.allclose(
            shown.gizmo.position, live.target
        )
        shown.step()
        assert (
            np.allclose(shown.ball.position, here + np.array([0.003, 0, 0]))
            and "on the ball" in shown.caption.content
        )
        shown.reset()
        assert live.time == 0 and np.allclose(shown.gizmo.position, live.home())
        shown.sliders["speed"].value = shown.sliders["speed"].max
        shown.drop()
        until = time.time() + 60
        while "diverged" not in shown.message.content and time.time() < until:
            time.sleep(0.02)
        assert "**The simulation diverged at" in shown.message.content and shown.player.is_alive()
        shown.sliders["speed"].value = 0.0
        live.twin.step, stepped = (lambda action: 1 / 0), live.twin.step
        shown.drop()
        until = time.time() + 10
        while "ZeroDivisionError" not in shown.message.content and time.time() < until:
            time.sleep(0.02)
        assert "ZeroDivisionError" in shown.message.content and shown.player.is_alive()
        live.twin.step = stepped
        for speed in (0.0, math.nan, -1.0, 1e300):
            shown.slowdown.value = speed
            time.sleep(0.02)
        assert shown.player.is_alive()
        shown.slowdown.value = 1.0
        shown.drop()
        shown.step()
        assert shown.message.content == "" and live.time > 0
    finally:
        shown.stop()
    assert not shown.player.is_alive()


@pytest.mark.gpu
def test_it_is_played_with_on_a_gpu_as_on_a_cpu():
    """Dropped, pushed by the ball, coloured and drawn, and put back; and what stays where no drop could be made."""
    ends = {}
    for device in ("cpu", "cuda"):
        made = twin()
        made.body.to(device)
        live = Live(made)
        live.change(height=0.02)
        assert live.drop(), live.message
        live.target = live.hand_position + np.array([0.3, 0.0, 0.0])
        for _ in range(20):
            assert live.step(), live.message
        ends[device] = live.positions.cpu().numpy(), live.hand_position
        for by in ("appearance", "stretch", "heterogeneity"):
            colors, _ = live.paint(by)
            assert np.isfinite(colors).all() and all(
                np.isfinite(part).all() for part in live.splats(by, colors)
            )
        assert live.poses() == [] and "Force on the ball" in live.caption()
        assert live.reset() and not live.running
        live.state = None
        assert live.positions.shape == (125, 3)
    np.testing.assert_allclose(ends["cuda"][0], ends["cpu"][0], atol=1e-4)
    np.testing.assert_allclose(ends["cuda"][1], ends["cpu"][1], atol=1e-6)
