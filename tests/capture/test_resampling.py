"""Frames at common times from frames at other times, read row by row, against pictures taken at those times."""

import numpy as np
import pytest
from filming import BODY, COLOR, CONTACT, HEIGHT, RELEASE, WORLD, G, filmed, lifted, phones_and_tracks

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
    begins, readouts = (np.array([getattr(f, name) for f in films]) for name in ("begin", "readout"))
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
    overlap = {}
    for kind in resampling.KINDS:
        found = resampled(exposure, track, None, times, kind)[..., 3] > 127
        wanted = [right(film, t) for t in times]
        overlap[kind] = np.mean([(a & b).sum() / (a | b).sum() for a, b in zip(found, wanted)])
    assert overlap["none"] < 0.92 and min(overlap["shift"], overlap["flow"]) > 0.975, overlap


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
