"""Which frames a start is fitted to: those before the contact that it predicts itself."""

from types import SimpleNamespace

import pytest
import torch

from mosa.errors import DataError
from mosa.reconstruction.pose import starts
from mosa.types import Ground

GRAVITY, FPS, HEIGHT, SPEED = (
    -9.8,
    50.0,
    0.20,
    2.0,
)  # the lowest point is at 0.1: contact between frames 2 and 3


def drop(monkeypatch, seen_wrongly, frames=9, last_free_frame=None, height=HEIGHT):
    """A cube of half width 0.1 that falls and then lies; velocities by least squares from the heights of its centre, of which some
    are seen wrongly: {frame: error [m]}. Returns (sequence_start of it, the numbers of frames asked for)."""
    t = torch.arange(frames) / FPS
    heights = (height - SPEED * t + 0.5 * GRAVITY * t**2).clamp(min=0.1)
    for frame, error in seen_wrongly.items():
        heights[frame] += error
    corners = torch.cartesian_prod(*[torch.tensor([-0.1, 0.1])] * 3)
    rest = corners + torch.tensor([0.0, height, 0.0])
    body = SimpleNamespace(rest=rest, center=rest.mean(0), volume=torch.full((8,), 1e-12))
    scene = SimpleNamespace(name="cube", sequence="train", markers=None, frames=frames, times=t,
                            gravity=torch.tensor([0, GRAVITY, 0]),
                            up=torch.tensor([0.0, 1, 0]), ground=Ground(0.0), last_free_frame=last_free_frame, start="falling",
                            training_cameras=[0], images=torch.zeros(1, frames, 1, 1, 3), mattes=torch.zeros(1, frames, 1, 1),
                            cameras=SimpleNamespace(select=lambda _: None), background=torch.ones(3))  # fmt: skip
    asked = []

    def fitted(splats, pose, images, mattes, views, *, times, **_):
        asked.append(len(times))
        fallen = heights[: len(times)] - heights[0] - 0.5 * GRAVITY * times**2
        return torch.tensor(
            [0.0, float((times @ fallen) / times.square().sum()), 0.0]
        ), torch.zeros(3)

    monkeypatch.setattr(starts, "initial_velocity", fitted)
    return (
        lambda: starts.sequence_start(body, SimpleNamespace(splats=None), scene, register=False),
        asked,
        body,
        scene,
    )


def test_two_frames_that_say_too_little_speed_are_corrected(monkeypatch):
    """Frame 1 seen 2 cm too high says 1 m/s, and that frames 0 to 3 are free; a fit to these puts frame 3 after the contact."""
    start, asked, body, scene = drop(monkeypatch, {1: 0.02})
    found = start()
    assert starts.first_contact(body, found, scene) >= asked[-1], (
        "fitted to frames after its own contact"
    )
    assert asked == [2, 4, 3]
    assert float(found.velocity[1]) == pytest.approx(-SPEED, abs=0.25)


@pytest.mark.parametrize("error", [-0.02, -0.01, 0.0, 0.01, 0.02, 0.03])
@pytest.mark.parametrize("height", [0.17, 0.2, 0.3, 0.5])
def test_no_start_reads_frames_after_its_own_contact(monkeypatch, error, height):
    start, asked, body, scene = drop(monkeypatch, {1: error, 2: -error / 2}, height=height)
    found = start()
    assert 2 <= asked[-1] <= min(starts.first_contact(body, found, scene), starts.MOST_FRAMES)
    assert len(asked) <= 6


def test_free_frames_that_are_known_or_many_are_used_at_once(monkeypatch):
    start, asked, *_ = drop(monkeypatch, {}, last_free_frame=3)
    start()
    assert asked == [2, 4]
    start, asked, *_ = drop(monkeypatch, {}, height=2.0, frames=20)
    start()
    assert asked == [2, starts.MOST_FRAMES]


def test_contact_before_the_second_frame_is_an_error(monkeypatch):
    start, *_ = drop(monkeypatch, {}, height=0.12)
    with pytest.raises(
        DataError, match="cube/train: the object touches the ground before the second frame"
    ):
        start()


def test_a_film_that_starts_at_rest_has_no_velocity_and_asks_for_no_flight(monkeypatch):
    start, asked, body, scene = drop(monkeypatch, {}, height=0.1, last_free_frame=0)
    with pytest.raises(DataError, match=r"scene\.start=rest"):
        start()
    asked.clear()
    scene.start = "rest"
    found = start()
    assert asked == [] and starts.first_contact(body, found, scene) == 1
    assert not found.velocity.any() and not found.angular_velocity.any()
