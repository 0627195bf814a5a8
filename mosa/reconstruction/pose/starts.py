"""Where a sequence starts: pose of frame 0 and velocity of the frames before first contact, from images alone.

The training sequence starts in the rest pose, every other in the pose that its first frame shows. The fit does not move them.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation

from mosa.errors import DataError
from mosa.physics.world import Start
from mosa.reconstruction.marker_body import start_at_rest
from mosa.reconstruction.pose.known import known_start
from mosa.reconstruction.pose.outlines import Similarities
from mosa.reconstruction.pose.registration import initial_velocity, register_pose
from mosa.reconstruction.rest_shape import RestShape
from mosa.rendering.appearance.lighting import LIGHT, shading, surface_normals
from mosa.rendering.appearance.spherical_harmonics import constant_coefficients
from mosa.rendering.covariance import scales_and_rotations
from mosa.types import REST, Appearance, Scene, Splats

MOST_FRAMES = 6
"""Frames of free flight that a velocity is fitted to at most: more take longer and say little more."""

FINER = 2
"""Splats for each particle up to which they are what a body is looked for by: with more, a start takes longer than the coarse body
that is simulated from it is worth."""


def splats_of(body: RestShape) -> Splats:
    """The body's particles as (isotropic or not) splats with axes from their covariances."""
    scales, rotations = (x.to(body.rest) for x in scales_and_rotations(body.covariances.double()))
    return Splats(body.rest, scales, rotations, body.opacities, body.colors)


def lowest(body: RestShape, start: Start, scene: Scene, time: float) -> float:
    """Height [m] above the ground of the lowest rest particle after `time` [s] of free flight."""
    up, gravity = scene.up.to(body.rest), scene.gravity.to(body.rest)
    spin = Rotation.from_rotvec((start.angular_velocity * time).cpu().numpy()).as_matrix()
    R = torch.as_tensor(spin).to(body.rest) @ start.rotation.to(body.rest)
    arm = (body.rest - body.center) @ R.T
    center = start.center + start.velocity * time + 0.5 * gravity * time**2
    ground = scene.ground.height if scene.ground is not None else -torch.inf
    return float(((arm + center) @ up).min()) - ground


def first_contact(body: RestShape, start: Start, scene: Scene) -> int:
    """Index of the first frame after first contact: given by the scene, or where free flight would have touched the ground."""
    if scene.last_free_frame is not None:
        return min(scene.last_free_frame + 1, scene.frames - 1)
    # particles lie half a spacing below the surface
    surface = 0.5 * float(body.volume.mean()) ** (1 / 3)
    for t, time in enumerate((scene.times - scene.times[0]).tolist()):
        if t > 0 and lowest(body, start, scene, time) < surface:
            return t
    return scene.frames - 1


def appearance_of(body: RestShape) -> Appearance:
    """What a body is looked for by: the splats that it carries, which all training frames were fitted to; its particles where it
    has no such splats or is far coarser than they are. With the normals of its surface."""
    if body.splats is not None and len(body.splats) <= FINER * len(body.rest):
        found = body.splats.appearance
    else:
        splats = splats_of(body)
        found = Appearance(splats, constant_coefficients(splats.colors))
    if found.light is None or not bool(found.light.any()):
        means = found.splats.means
        normals, light = surface_normals(means, body.rest), means.new_zeros(LIGHT)
        found = replace(found, normals=normals, light=light)
    return found


def sequence_start(
    body: RestShape, appearance: Appearance, scene: Scene, *, register: bool,
    place: Similarities | None = None,
) -> Start:  # fmt: skip
    """Pose and velocity of `scene`. register: find the pose by rendering (held-out sequences), in the light that it shows; else the
    rest shape's own. A film that starts at rest has no velocity. appearance: at rest, of `appearance_of`; place: of a body of known
    shape in frame 0 of the training sequence, whose outlines then give what their rendering hardly tells from a single camera.

    The free frames are found on the way: a rough velocity from the first two frames predicts the contact, the frames before it
    give the final one. Where that one puts the contact earlier, into the frames it was fitted to, they are fewer: no velocity is
    kept that frames after its own contact went into. Errors: DataError where contact comes before the second frame."""
    if scene.markers is not None:
        return start_at_rest(scene, body.center)
    cameras = scene.training_cameras
    images, mattes = scene.images[cameras], scene.mattes[cameras]
    views = scene.cameras.select(cameras)
    rotation, center, splats = torch.eye(3), body.center.cpu(), appearance.splats
    if register:
        rotation, center, light = register_pose(
            splats, images[:, 0], mattes[:, 0], views, background=scene.background, rest_center=body.center,
            normals=appearance.normals, light=appearance.light,
        )  # fmt: skip
        lit = shading(light, appearance.normals.to(light), rotation)
        splats = replace(splats, colors=splats.colors * lit.to(splats.colors)[:, None])
    still = torch.zeros(3)
    start = Start(*(x.to(body.rest) for x in (rotation, center, still, still)))
    if scene.start == REST:
        return start
    if place is not None and scene.body is not None:
        rest_center = body.center.cpu()
        near = place.turned(rotation.cpu(), center.cpu(), rest_center)
        turn, middle, velocity, spin = known_start(
            scene, near, place, rest_center, register=register
        )
        if register:
            rotation, center = turn, middle
        return Start(*(x.to(body.rest) for x in (rotation, center, velocity, spin)))
    count, most, exact = 2, MOST_FRAMES, False
    while True:
        velocity, spin = initial_velocity(
            splats, (rotation, center), images[:, :count], mattes[:, :count], views, times=scene.times[:count],
            gravity=scene.gravity, background=scene.background, rest_center=body.center, exact=exact,
        )  # fmt: skip
        start = Start(start.rotation, start.center, velocity.to(body.rest), spin.to(body.rest))
        free = first_contact(body, start, scene)
        if free < 2 and exact:
            raise DataError(
                f"{scene.name}/{scene.sequence}: the object touches the ground before the second frame; at least two "
                "frames of free flight are needed (scene.frames, scene.last_free_frame); of a film that starts at "
                "rest say scene.start=rest"
            )
        if not exact:
            count, exact = max(2, min(free, most)), True
            continue
        if free < count:
            most = count - 1  # so that the loop ends
        elif count == min(free, most):
            return start
        count = min(free, most)
