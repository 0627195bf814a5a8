"""Whether another film shows the body that was found, and whether a film shows enough of what it is learned from."""

import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mosa.data.scene import load_scene
from mosa.evaluation.same_body import body_match, warn_of_other_bodies
from mosa.modules.body.body import Start
from mosa.physics.contact.colliders import Collider, HalfSpace
from mosa.physics.contact.motion import Motion
from mosa.rendering.appearance.carried_splats import seen
from mosa.training.preflight import warn_of_little
from mosa.types import Ground


def block(shape=(0.2, 0.14, 0.1), color=(0.7, 0.4, 0.3), spacing=0.01):
    """What of a body is looked at: particles that fill a box, with isotropic splats."""
    axes = [torch.arange(spacing / 2, length, spacing) - length / 2 for length in shape]
    rest = torch.cartesian_prod(*axes)
    n = len(rest)
    return SimpleNamespace(rest=rest, center=rest.mean(0), volume=torch.full((n,), spacing**3), splats=None,
                           covariances=(0.6 * spacing) ** 2 * torch.eye(3).expand(n, 3, 3), opacities=torch.full((n,), 0.95),
                           colors=torch.tensor(color).expand(n, 3))  # fmt: skip


def at(degrees, height=0.4):
    angle = math.radians(degrees)
    turn = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    return Start(turn.float(), torch.tensor([0.0, height, 0.0]), torch.zeros(3), torch.zeros(3))


@pytest.fixture(scope="module")
def cameras():
    return load_scene(format="builtin", name="tiny", scale=0.5)


def film(scene, body, start, factor=1.0):
    """One that shows a body at a start in its first frame, in other light."""
    x = (body.rest - body.center) @ start.rotation.T + start.center
    shown = seen(body, x[None], start.rotation.expand(1, len(x), 3, 3))
    black, white = (shown.images(scene.cameras, torch.full((3,), value)) for value in (0.0, 1.0))
    mattes = 1 - (white - black).mean(-1)
    frames = scene.frames
    images = factor * black + (1 - mattes)[..., None] * scene.background
    return replace(
        scene,
        images=images.expand(-1, frames, -1, -1, -1).clone(),
        mattes=mattes.expand(-1, frames, -1, -1).clone(),
    )


def told(*given):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_other_bodies(*given)
    return [str(each.message) for each in found]


def test_a_body_fills_its_own_outlines_in_its_own_colours(cameras):
    body = block()
    found = body_match(body, at(40), film(cameras, body, at(40)))
    assert found.outline > 0.999
    assert float(found.color.abs().max()) < 1e-3


@pytest.mark.parametrize(("change", "said"), [
    ({}, None),
    ({"factor": 0.9}, None),
    ({"factor": 0.6}, r"test/h: .* mean colour is not the body's \(red -0.28, green -0.16, blue -0.12\)"),
    ({"body": block((0.16, 0.16, 0.16))}, r"test/h: .* fills \d\d% of the outlines, .* 100% of its own: another body"),
    ({"body": block(color=(0.3, 0.4, 0.7))}, r"red -0.40, green \+0.00, blue \+0.40"),
    ({"start": 75}, r"fills \d\d% of the outlines"),
])  # fmt: skip
def test_another_body_light_or_pose_is_said(cameras, change, said):
    body, own = block(), film(cameras, block(), at(0))
    other = film(cameras, change.get("body", body), at(40), change.get("factor", 1.0))
    found = told(body, {"train": at(0), "test/h": at(change.get("start", 40))}, [own, other])
    assert len(found) == (said is not None), found
    if said:
        with pytest.warns(UserWarning, match=said):
            warn_of_other_bodies(
                body, {"train": at(0), "test/h": at(change.get("start", 40))}, [own, other]
            )


def test_without_the_training_film_a_body_is_compared_with_what_is_usual(cameras):
    """eval.py on another scene."""
    body = block()
    assert told(body, {"test/h": at(40)}, [film(cameras, body, at(40))]) == []
    assert (
        len(told(body, {"test/h": at(40)}, [film(cameras, block((0.16, 0.16, 0.16)), at(40))])) == 1
    )


@pytest.mark.parametrize(
    ("speed", "start", "forces", "warns"),
    [(0.1, "rest", (), True), (0.1, "rest", ("cell",), False), (0.1, "falling", (), False), (0.0, "rest", (), False)],
)  # fmt: skip
def test_given_motions_without_a_force_are_said(speed, start, forces, warns):
    plate = Collider(
        HalfSpace(), "slip", motion=Motion((0.0, 1.0, 0.0), velocity=(0.0, -speed, 0.0))
    )
    world = SimpleNamespace(colliders=(plate,), planes=(), driven=(), forces=forces)
    scenes = [SimpleNamespace(start=start), SimpleNamespace(start="falling")]
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_little(world, block(), {"train": at(0), "test/h": at(0)}, scenes)
    assert [str(each.message)[:12] for each in found] == ["world.forces"] * warns


@pytest.mark.parametrize(("frames", "held_out", "colliders", "said"), [
    (9, (), (), None), (5, (), (), 2), (9, (5, 6, 7, 8), (), 2), (5, (), ("solid",), None), (3, (), (), 1),
])  # fmt: skip
def test_a_film_that_ends_at_the_contact_is_said(frames, held_out, colliders, said):
    """The block falls from 0.1 m above the ground at 2 m/s: contact between frames 2 and 3 of 50 a second."""
    body = block()
    start = replace(at(0, height=0.17), velocity=torch.tensor([0.0, -2.0, 0.0]))
    scene = SimpleNamespace(frames=frames, times=torch.arange(frames) / 50.0, gravity=torch.tensor([0, -9.8, 0]), name="b",
                            up=torch.tensor([0.0, 1, 0]), ground=Ground(0.0), last_free_frame=None, sequence="train",
                            start="falling", training_frames=[t for t in range(frames) if t not in held_out])  # fmt: skip
    world = SimpleNamespace(colliders=colliders, planes=(), driven=())
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_little(world, body, {"train": start, "test/h": start}, [scene, scene])
    assert [str(each.message)[:9] for each in found] == ([f"train: {said} "] if said else [])
