"""Clocks, readouts, scale and down from outlines of a fall, against the numbers it was made with."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from filming import CONTACT, RELEASE, WORLD, G, filmed, phones_and_tracks

from mosa.capture.alignment import coarse_offsets, disagreement
from mosa.capture.fall import Knowledge, fit_fall, longest_parabola, without_release
from mosa.capture.impact import through_impact
from mosa.capture.making import found_fall
from mosa.capture.outline import shifted, without_common
from mosa.errors import DataError

SCALE, R, _ = WORLD


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    films = filmed(size=(320, 240))
    phones, tracks = phones_and_tracks(films, tmp_path_factory.mktemp("films"))
    return films, phones, tracks, coarse_offsets(phones, tracks, 0.6)


def angle(fall) -> float:
    return float(np.degrees(np.arccos(np.clip(fall.up @ R[:, 1], -1, 1))))


def test_rough_clocks_are_right_to_a_frame(made):
    films, _, _, offsets = made
    true = np.array([film.begin for film in films]) - films[0].begin
    assert (
        np.abs(offsets - true).max() < 1 / 60
    )  # readouts, half a frame and more, are not known here


def test_the_fall_says_clocks_scale_and_down(made):
    films, phones, tracks, offsets = made
    knowledge = Knowledge(gravity=G)
    fall = fit_fall(phones, tracks, offsets, knowledge)
    begin, end = np.array(fall.window) + films[0].begin
    assert (
        RELEASE - 1 / 60 < begin < RELEASE + 2.5 / 60
        and CONTACT - 2.5 / 60 < end < CONTACT + 1 / 60
    )
    better, *_ = found_fall(phones, tracks, knowledge, 0.6)
    true = np.array([film.begin for film in films]) - films[0].begin
    off = better.offsets - true
    assert (
        np.abs(off - off.mean()).max() < 1.4e-3
    )  # a twelfth of a frame; which time is zero nothing says
    assert abs(better.scale / SCALE - 1) < 0.01 and angle(better) < 0.4
    assert np.abs(better.readouts - [film.readout for film in films]).max() < 3e-3
    # a cone's outline is seen from below, then from above: without its hull the scale is wrong by more
    assert abs(better.scale / SCALE - 1) < abs(fall.scale / SCALE - 1)


def test_what_is_known_is_kept_and_the_rest_is_found(made):
    films, phones, tracks, offsets = made
    known = Knowledge(
        gravity=G,
        scale=SCALE,
        up=R[:, 1],
        readout={f"phone{i}": film.readout for i, film in enumerate(films)},
    )
    fall = fit_fall(phones, tracks, offsets, known)
    assert fall.scale == SCALE and angle(fall) < 1e-5
    np.testing.assert_allclose(fall.readouts, [film.readout for film in films], atol=1e-4)
    assert (
        abs(np.linalg.norm(fall.acceleration) * SCALE / G - 1) < 0.03
    )  # a cone's outline is no better


def test_a_readout_that_is_ignored_spoils_the_scale(made):
    _, phones, tracks, offsets = made
    blind = fit_fall(phones, tracks, offsets, Knowledge(gravity=G, readout=0.0))
    assert abs(blind.scale / SCALE - 1) > 0.03


def test_an_object_at_rest_is_no_fall():
    times = np.arange(20) / 60
    rest = np.tile([0.1, 0.2, 0.3], (20, 1))
    with pytest.raises(DataError, match=r"no free fall.*bends off a straight line"):
        longest_parabola(times, rest, 0.01)
    falling = rest + 0.5 * np.outer(np.maximum(times - 0.1, 0) ** 2, [0, -G, 0])
    first, last = longest_parabola(times, falling, 1e-4)
    assert last == 19 and 5 <= first <= 8


def test_a_phone_that_does_not_fit_is_named(made):
    _, phones, tracks, _ = made
    wrong = replace(
        phones[2],
        camera=replace(phones[2].camera, w2c=phones[4].camera.w2c @ np.diag([1, -1, -1, 1.0])),
    )
    with pytest.raises(DataError, match=r"phone2\.mp4.*at no offset"):
        coarse_offsets([*phones[:2], wrong, *phones[3:]], tracks, 0.6)


def test_a_phone_that_sees_nothing_is_named(made):
    _, phones, tracks, _ = made
    empty = replace(tracks[1], centres=np.full_like(tracks[1].centres, np.nan))
    with pytest.raises(
        DataError, match=r"phone1\.mp4.*whole object in 0 of .* its mask \(white where"
    ):
        coarse_offsets(phones, [tracks[0], empty, *tracks[2:]], 0.6)


def test_disagreement_is_least_at_the_true_offset(made):
    films, phones, tracks, _ = made
    around = np.array([-0.1, -0.03, 0.0, 0.03, 0.1])
    cost = disagreement(
        (phones[0], phones[2]), (tracks[0], tracks[2]), films[2].begin - films[0].begin + around
    )
    assert cost.argmin() == 2 and cost[2] < 0.1 < cost[[0, 1, 3, 4]].min()


def test_phones_that_face_each_other_are_placed_by_the_others(made):
    """Lines of sight of the first two meet at any offset: they lie in one vertical plane."""
    films, phones, tracks, _ = made
    order = [0, 3, 1, 4]
    true = np.array([films[i].begin for i in order]) - films[0].begin
    cost = disagreement(
        (phones[0], phones[3]), (tracks[0], tracks[3]), true[1] + np.array([-0.05, 0.0, 0.05])
    )
    assert cost.max() < 0.1
    offsets = coarse_offsets([phones[i] for i in order], [tracks[i] for i in order], 0.6)
    assert np.abs(offsets - true).max() < 1 / 60


def test_a_beginning_that_may_still_hang_is_left_out():
    """As long as it takes to fall by what is noticed: 3.5 px of 1 px noise are 7 mm at 2 m and 1000 px, 38 ms of fall."""
    phone = SimpleNamespace(camera=SimpleNamespace(K=np.diag([1000.0, 1000.0, 1.0])))
    problem = SimpleNamespace(
        phones=[phone, phone],
        depth=2.0,
        rough=np.array([[0, 0, 0], [0, 0, 0], [0, -9.8, 0]], float),
    )
    assert without_release(problem, 1.0, (0.1, 0.5), 1 / 60) == pytest.approx(
        (0.1 + (2 * 0.007 / 9.8) ** 0.5, 0.5)
    )
    assert without_release(problem, 1.0, (0.1, 0.22), 1 / 60) == (0.1, 0.22)


def test_an_impact_is_one_moment_for_phones_whose_poses_are_a_little_off(made):
    """Focal lengths off by 0.8 %, which in a fall alone pass for clocks."""
    films, phones, tracks, offsets = made
    knowledge = Knowledge(gravity=G)
    off = [
        replace(p, camera=replace(p.camera, K=p.camera.K @ np.diag([f, f, 1])))
        for p, f in zip(phones, (1.008, 0.992) * 3)
    ]
    fall = fit_fall(off, tracks, offsets, knowledge)
    better = through_impact(off, tracks, fall, knowledge)
    true = np.array([film.begin for film in films]) - films[0].begin
    before, after = (float(np.std(found.offsets - true)) for found in (fall, better))
    assert after < 0.5 * before and before > 0.4e-3, (before, after)


def test_without_an_impact_the_fall_stays_as_it_is(made):
    _, phones, tracks, offsets = made
    knowledge = Knowledge(gravity=G)
    fall = fit_fall(phones, tracks, offsets, knowledge)
    late = tracks[1].times + fall.offsets[1] > fall.window[1] + 0.01
    blind = replace(tracks[1], centres=np.where(late[:, None], np.nan, tracks[1].centres))
    assert through_impact(phones, [tracks[0], blind, *tracks[2:]], fall, knowledge) is fall


def test_phones_whose_poses_are_a_little_off_are_turned_to_where_they_see_the_body(made):
    """By 2 px, which is 3 % of the cone's radius."""
    _, phones, tracks, _ = made
    wrong = np.random.default_rng(0).normal(size=(6, 2)) * 2
    _, turned, _ = found_fall(
        [shifted(p, d) for p, d in zip(phones, wrong)], tracks, Knowledge(gravity=G), 0.6
    )
    spot = (R @ [0.0, 0.3, 0.0] / SCALE + WORLD[2])[None]
    left = np.array(
        [(t.camera.project(spot) - p.camera.project(spot))[0] for t, p in zip(turned, phones)]
    )
    fall = SimpleNamespace(position=spot[0], shifts=left)
    start = SimpleNamespace(position=spot[0], shifts=wrong)
    before, after = (
        np.sqrt(np.square(without_common(phones, found)).mean()) for found in (start, fall)
    )
    assert after < 0.5 * before, (before, after)
