"""Frames at common times from frames at other times, read row by row, against pictures taken at those times."""

import numpy as np
import pytest
from filming import (
    BODY,
    COLOR,
    CONTACT,
    HEIGHT,
    RELEASE,
    WORLD,
    G,
    filmed,
    lifted,
    phones_and_tracks,
)

import mosa.capture.resampling as resampling
from mosa.capture.fall import Fall, Knowledge
from mosa.capture.resampling import between, common_path, common_times, exposure_of, resampled
from mosa.errors import DataError


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A film with its true clock and readout, and the frames of it that the program would mat."""
    films = filmed(size=(240, 180))[1:4]
    film = films[0]
    phones, tracks = phones_and_tracks(films, tmp_path)
    phone, track = phones[0], tracks[0]
    scale, R, shift = WORLD
    high, down = R @ [0, HEIGHT + 0.07, 0] / scale + shift, R @ [0, -G, 0] / scale
    begins, readouts = (
        np.array([getattr(f, name) for f in films]) for name in ("begin", "readout")
    )
    fall = Fall(RELEASE, high, np.zeros(3), down, begins, readouts, np.zeros((3, 2)), (0.15, CONTACT), scale, R[:, 1], 0.1, 1,
                np.zeros(3), np.zeros(3), 0.0, 0.0)  # fmt: skip

    def frames(clip, matting, first, last):
        for k in range(first, last + 1):
            yield k, np.broadcast_to(np.float32(COLOR), (180, 240, 3)), film.mask(k)

    monkeypatch.setattr(resampling, "matted_frames", frames)
    common = common_path(phones, tracks, fall, Knowledge())
    return film, track, exposure_of(0, phone, track, fall, Knowledge(), common)


def right(film, time):
    """The mask that a sensor without rows would take."""
    import cv2

    hull = cv2.convexHull(film.camera.project(BODY + lifted(time)).astype(np.float32))[:, 0]
    big = np.zeros((4 * 180, 4 * 240), np.uint8)
    cv2.fillConvexPoly(big, np.round((4 * hull - 0.5) * 16).astype(np.int32), 255, shift=4)
    return cv2.resize(big, (240, 180), interpolation=cv2.INTER_AREA) > 127


def test_frames_are_brought_to_common_times(made):
    film, track, exposure = made
    times = CONTACT - np.array([0.11, 0.0957, 0.0721, 0.05, 0.0333])
    found = resampled(exposure, track, None, times)[..., 3] > 127
    wanted = [right(film, t) for t in times]
    assert np.mean([(a & b).sum() / (a | b).sum() for a, b in zip(found, wanted)]) > 0.975


def test_a_time_lies_between_the_frames_around_it(made):
    _, _, exposure = made
    own = exposure.own_times
    assert between(exposure, 0.5 * (own[20] + own[21])) == (20, 21)
    assert between(exposure, own[20] + 1e-5) == (20, 20)
    assert between(exposure, own[0] - 0.1) is None and between(exposure, own[-1] + 0.1) is None
    exposure.centres[21] = np.nan
    assert between(exposure, 0.5 * (own[20] + own[21])) is None


def test_common_times_end_where_a_phone_no_longer_sees_the_whole_object(made):
    _, _, exposure = made
    window = (0.15, CONTACT)
    times = common_times([exposure], window, before=0.1, after=0.2, rate=None)
    np.testing.assert_allclose(np.diff(times), 1 / 60, rtol=1e-6)
    assert CONTACT - 0.12 < times[0] < CONTACT - 0.07 and abs(times[-1] - CONTACT - 0.2) < 0.03
    lost = int(np.searchsorted(exposure.own_times, CONTACT + 0.1))
    exposure.centres[lost:] = np.nan
    shorter = common_times([exposure], window, before=0.1, after=0.2, rate=30.0)
    np.testing.assert_allclose(np.diff(shorter), 1 / 30, rtol=1e-6)
    assert CONTACT + 0.05 < shorter[-1] < CONTACT + 0.1
    exposure.centres[:] = np.nan
    with pytest.raises(DataError, match="0 common frames"):
        common_times([exposure], window, before=0.1, after=0.2, rate=None)


def test_the_common_path_sees_an_impact_between_two_frames_of_a_phone(made):
    """At contact the velocity turns over; a phone's own frames miss it by up to 8 ms of the fall, which is 24 mm or 10 px."""
    film, _, exposure = made
    times = CONTACT + np.array([-0.008, -0.004, 0.004, 0.008])
    true = np.array([film.camera.project((BODY.mean(0) + lifted(t))[None])[0] for t in times])
    off = exposure.path(times) - true
    assert np.abs(off - off.mean(0)).max() < 2.5


def squashed(when: np.ndarray, radius: float = 30.0) -> np.ndarray:
    """(160, 160, 4) premultiplied: a coloured disc, squashed and stretched along y with a period of five frames of 1/120 s, line
    y as it is at when[y] [s]."""
    x, y = np.meshgrid(np.arange(160) + 0.5 - 80, np.arange(160) + 0.5 - 80)
    scale = 1 + 0.2 * np.cos(2 * np.pi * when * 120 / 5)[:, None]
    u, v = x / radius, y / (radius * scale)
    alpha = np.clip(radius * (1 - np.hypot(u, v)) + 0.5, 0, 1)
    color = np.stack(
        [
            0.5 + 0.4 * np.sin(7 * u) * np.cos(6 * v),
            0.5 + 0.3 * np.cos(9 * v),
            0.4 + 0.3 * np.sin(8 * u + 5 * v),
        ],
        -1,
    )
    return np.concatenate([color * alpha[..., None], alpha[..., None]], -1).astype(np.float32)


def test_a_deformation_is_read_line_by_line_and_bends_between_frames():
    """A body that vibrates as it is read: its outline at a common time, from its neighbours as they were read; taken as read at one
    time and even between two frames, it is wrong by more than twice as much."""
    readout, time = 0.02, 0.0043
    lines = readout * ((np.arange(160) + 0.5) / 160 - 0.5)
    frames = np.arange(-1, 3) / 120
    when = frames[:, None] + lines
    pictures = [squashed(w) for w in when]
    true = squashed(np.full(160, time))

    def wrong(found):
        return np.abs(found[..., 3] - true[..., 3]).sum()

    middle = np.array([80.0, 80.0])
    whole = resampling.blended(pictures, when, [1, 2], time, 1, middle, 30.0)
    plain = resampling.blended(
        pictures[1:3], np.repeat(frames[1:3, None], 160, 1), [0, 1], time, 1, middle, 30.0
    )
    across = [np.ascontiguousarray(p.transpose(1, 0, 2)) for p in pictures]
    turned = resampling.blended(across, when, [1, 2], time, 0, middle, 30.0).transpose(1, 0, 2)
    assert wrong(whole) < 0.45 * wrong(plain) and wrong(turned) < 0.45 * wrong(plain), (
        wrong(whole),
        wrong(turned),
        wrong(plain),
    )
    # a time that is one of the frames' own: its centre line stays, the others are brought to it
    own = resampling.blended(pictures[:3], when[:3], [1], 0.0, 1, middle, 30.0)
    still = squashed(np.zeros(160))
    assert np.abs(own - still)[..., 3].sum() < 0.55 * np.abs(pictures[1] - still)[..., 3].sum()


def test_weights_of_a_polynomial_through_frames():
    nodes = np.array([[-1.0, -1.2], [0.0, 0.1], [1.0, 1.0], [2.5, 2.0]])
    weights = resampling.lagrange(nodes, 0.4)
    np.testing.assert_allclose(weights.sum(0), 1)
    np.testing.assert_allclose((weights * nodes**3).sum(0), 0.4**3)
    np.testing.assert_allclose(resampling.lagrange(nodes, 0.0)[:, 0], [0, 1, 0, 0], atol=1e-12)


def test_a_hole_that_moving_has_made_is_closed_and_an_opening_is_not():
    still = resampling.straight(squashed(np.zeros(160)))
    opened = still.copy()
    opened[78:81, 90:93] = 0
    opened[60:100, 60:85, 3] = 0  # a handle's
    found = resampling.without_tunnels(opened)
    assert (found[78:81, 90:93, 3] == 255).all() and (found[60:100, 60:85, 3] == 0).all()
    assert np.abs(found[78:81, 90:93, :3].astype(float) - still[78:81, 90:93, :3]).mean() < 12
    untouched = np.ones((160, 160), bool)
    untouched[78:81, 90:93] = False
    np.testing.assert_array_equal(found[untouched], opened[untouched])
    assert resampling.without_tunnels(still) is still
