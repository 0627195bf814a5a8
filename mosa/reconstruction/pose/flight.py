"""Where a body is in the frames before first contact, as a rigid motion from frame 0: more outlines, seen from other sides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.data.hull import Volume
from mosa.reconstruction.geometry.field import first_crossing, gradient, sample
from mosa.reconstruction.geometry.refinement import blurred, pixel_width
from mosa.reconstruction.motion.observed import Windows
from mosa.reconstruction.pose.registration import matte_centres
from mosa.reconstruction.pose.rigid import rotation_exp
from mosa.rendering.cameras import rays, sample_images
from mosa.types import Scene

BLURS = (3.0, 3.0, 1.5, 1.5, 0.7, 0.4, 0.4)
FACING = 0.6
"""Smallest cosine between surface and direction to the camera: where a surface turns away, a blurred image mixes its parts
differently as it moves."""
POINTS = 1500
"""Points per camera that are followed at most."""


@dataclass(frozen=True)
class Motion:
    """x = rotation (X - centre) + centre + shift. rotation (3, 3), shift (3,) [m], centre (3,) [m]."""

    rotation: Tensor
    shift: Tensor
    centre: Tensor

    def points(self, points: Tensor) -> Tensor:
        return (points - self.centre) @ self.rotation.T + self.centre + self.shift

    def windows(self, views: Windows) -> Windows:
        """The windows with cameras that see the body of frame 0 as theirs see the moved one."""
        w2c = views.cameras.w2c.clone()
        R = w2c[:, :3, :3]
        w2c[:, :3, 3] += R @ (self.centre + self.shift - self.rotation @ self.centre)
        w2c[:, :3, :3] = R @ self.rotation
        return replace(views, cameras=replace(views.cameras, w2c=w2c))


def _sampled(
    image: Tensor, points: Tensor, K: Tensor, w2c: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Values (N, C) of an image at projected points, the points in the camera's frame (N, 3), and x/z, y/z (N, 2)."""
    seen = points @ w2c[:3, :3].T + w2c[:3, 3]
    flat = seen[:, :2] / seen[:, 2:]
    pixel = flat * K.diagonal()[:2] + K[:2, 2]
    return sample_images(image[None], pixel[None])[0].T, seen, flat


def visible_points(distance: Volume, views: Windows) -> list[Tensor]:
    """For each window the points (at most POINTS, 3) [m] where rays of its matte meet the surface."""
    found = []
    centres, directions = rays(views.cameras)
    slopes = gradient(distance.values, distance.pitch)
    for centre, direction, matte in zip(centres, directions, views.mattes):
        ray = direction[matte > 0.5]
        ray = ray[:: max(1, len(ray) // POINTS)]
        way = first_crossing(distance, centre.expand_as(ray), ray)
        points = (centre + way[:, None] * ray)[way.isfinite()]
        normal = F.normalize(sample(slopes, (points - distance.origin) / distance.pitch), dim=-1)
        facing = -(normal * F.normalize(points - centre, dim=-1)).sum(-1)
        found.append(points[facing > FACING])
    return found


def _channels(views: Windows, sigma: float) -> Tensor:
    """Colour and matte (B, 12, h, w), each with its slopes: 0 to 3 values, 4 to 7 along columns, 8 to 11 along rows."""
    found = blurred(views, sigma)
    rows, columns = torch.gradient(found[:, 9:], dim=(2, 3))
    return torch.cat([found[:, :3], found[:, 9:], found[:, 3:6], columns, found[:, 6:9], rows], 1)


def follow_rigidly(
    first: Windows, other: Windows, points: list[Tensor], start: Motion
) -> tuple[Motion, float]:
    """Motion from the first windows to others of the same cameras, and the root mean square difference of colour and matte that
    is left; points: of each window, as seen in `first`. Gauss-Newton on six numbers, coarse to fine, with robust weights."""
    motion, left = start, float("inf")
    radius = float(torch.cat(points).sub(start.centre).norm(dim=1).mean())
    for sigma in BLURS:
        before, after = _channels(first, sigma), _channels(other, sigma)
        matrix, vector = torch.zeros(6, 6).to(start.centre), torch.zeros(6).to(start.centre)
        total, count = 0.0, 0.0
        for b, own in enumerate(points):
            wanted = _sampled(before[b], own, first.cameras.K[b], first.cameras.w2c[b])[0][:, :4]
            moved = motion.points(own)
            K, w2c = other.cameras.K[b], other.cameras.w2c[b]
            found, seen, flat = _sampled(after[b], moved, K, w2c)
            residual = found[:, :4] - wanted
            slope = torch.stack([found[:, 4:8] * K[0, 0], found[:, 8:12] * K[1, 1]], -1)
            depth = -(slope * flat[:, None]).sum(-1, keepdim=True)
            # (N, 4, 3) by a shift of the point
            pull = torch.cat([slope, depth], -1) / seen[:, 2:, None] @ w2c[:3, :3]
            arm = moved - motion.centre - motion.shift
            turned = torch.linalg.cross(arm[:, None].expand_as(pull), pull) / radius
            J = torch.cat([pull, turned], -1)
            weight = 1 / (1 + residual.square().sum(1) / 0.03)
            matrix += torch.einsum("n,nci,ncj->ij", weight, J, J)
            vector += torch.einsum("n,nci,nc->i", weight, J, residual)
            total += float((weight * residual.square().mean(1)).sum())
            count += float(weight.sum())
        damping = 1e-4 * matrix.diagonal().mean() * torch.eye(6).to(matrix)
        step = -torch.linalg.solve((matrix + damping).double(), vector.double()).to(vector)
        turn = rotation_exp(step[3:] / radius)
        motion = Motion(turn @ motion.rotation, motion.shift + step[:3], motion.centre)
        left = (total / max(count, 1e-9)) ** 0.5
    return motion, left


def free_motions(scene: Scene, distance: Volume, frames: list[Windows]) -> list[Motion]:
    """Motions from frame 0 to frames 1, 2, ... as long as the body flies freely; frames: windows of consecutive frames from 0, on
    any device; distance: of the body in frame 0, negative inside [m].

    A frame is free where the scene says so; else where the moved body ends above the ground, falls as the frames before it say,
    to a pixel, and looks as rigid as it did in frame 1. Of two frames or less nothing is known but the ground."""
    device = distance.values.device
    up, gravity = scene.up.to(device), scene.gravity.to(device)
    points = visible_points(distance, frames[0])
    everywhere = distance.points()[distance.values < 0]
    centre, width = everywhere.mean(0), pixel_width(distance, frames[0])
    times = (scene.times - scene.times[0]).tolist()
    views = scene.training_cameras
    mattes, cameras = scene.mattes[views][:, : len(frames)], scene.cameras.select(views)
    centres = matte_centres(mattes, cameras).to(device)
    motions, first_left, velocity = [], float("inf"), None
    for t in range(1, len(frames)):
        if scene.last_free_frame is not None and t > scene.last_free_frame:
            break
        start = Motion(torch.eye(3, device=device), centres[t] - centres[0], centre)
        if velocity is not None:
            shift = velocity * times[t] + 0.5 * gravity * times[t] ** 2
            start = Motion(motions[-1].rotation, shift, centre)
        ground = scene.ground.height if scene.ground is not None else -float("inf")
        if float((start.points(everywhere) @ up).min()) < ground:
            break
        motion, left = follow_rigidly(frames[0], frames[t], points, start)
        away = float((motion.shift - start.shift).norm())
        if scene.last_free_frame is None and (
            float((motion.points(everywhere) @ up).min()) < ground
            or (velocity is not None and away > width)
            or left > 1.5 * first_left + 0.01
        ):
            break
        motions.append(motion)
        first_left = min(first_left, left)
        velocity = (motion.shift - 0.5 * gravity * times[t] ** 2) / times[t]
    return motions
