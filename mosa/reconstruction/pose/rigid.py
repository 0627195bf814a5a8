"""A rigid body of splats against images: rendering, image levels, and the normal equations of its pose.

The residual is the rendered colour and matte minus the real ones; its Jacobian in the six parameters of a pose
comes from rendered differences, so that twelve renderings replace a backward pass and Gauss-Newton converges in a
few steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.physics.rotations import skew
from mosa.rendering.appearance.lighting import LIGHT, shading
from mosa.rendering.cameras import crop_boxes, crop_cameras, crop_images, project
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import rasterize
from mosa.system.threads import threaded
from mosa.types import Cameras, Splats

HUBER = 0.15
"""Residuals [colour] above count linearly: highlights and shading that do not turn with the body must not pull."""

STEP_PX = 0.3
"""Differences for the Jacobian move the body by this many pixels of the level's images."""

PIXELS_AT_ONCE = 800_000
"""Images are rendered, and poses compared, in batches of at most this many pixels where one is not more."""


@dataclass(frozen=True)
class Poses:
    """K rigid poses. rotation: (K, 3, 3); center: (K, 3) [m]."""

    rotation: Tensor
    center: Tensor

    def moved(self, shift: Tensor, angle: Tensor) -> Poses:
        """Turned by the rotation vectors `angle` (K, 3) [rad] about the centre, in world axes, and shifted (K, 3)
        [m]."""
        return Poses(rotation_exp(angle) @ self.rotation, self.center + shift)

    def take(self, index: Tensor) -> Poses:
        return Poses(self.rotation[index], self.center[index])


@dataclass(frozen=True)
class Level:
    """Images of one resolution, cut to the object. target: (T, V, H, W, 4) colour and matte of T frames on the background (3,), as
    `weighed`; pixel: what a pixel covers at the object [m]; brightness: share with which it counts beside hue and matte."""

    target: Tensor
    cameras: Cameras
    background: Tensor
    pixel: float
    brightness: float = 1.0

    def weighed(self, images: Tensor) -> Tensor:
        """Images (..., 4) with the mean of their colour reduced to its share."""
        if self.brightness == 1:
            return images
        color, matte = images[..., :3], images[..., 3:]
        return torch.cat((color - (1 - self.brightness) * color.mean(-1, keepdim=True), matte), -1)


@dataclass(frozen=True)
class RigidBody:
    """Splats about their rest centre. arm: (N, 3) [m]; radius: root mean square distance from the centre [m]; normals: (N, 3) of
    the surface at rest, where the light shall be told from the colours."""

    arm: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    radius: float
    normals: Tensor | None = None

    @staticmethod
    def of(splats: Splats, rest_center: Tensor, normals: Tensor | None = None) -> RigidBody:
        means, scales, rotations, opacities, colors = (
            part.detach().float() for part in vars(splats).values()
        )
        arm = means - rest_center.to(means)
        radius = float(arm.square().sum(-1).mean().sqrt())
        normals = None if normals is None else normals.to(arm)
        return RigidBody(
            arm, covariance_from(scales, rotations), opacities, colors, radius, normals
        )

    def thinned(self, count: int, seed: int) -> RigidBody:
        """About `count` of the splats, swollen so that they still cover the body."""
        total = len(self.arm)
        if total <= count:
            return self
        order = torch.randperm(total, generator=torch.Generator().manual_seed(seed))
        index = order[:count].to(self.arm.device)
        parts = self.arm, self.covariances, self.opacities, self.colors
        arm, covariances, opacities, colors = (part[index] for part in parts)
        normals = None if self.normals is None else self.normals[index]
        swollen = (total / count) ** (2 / 3) * covariances
        return RigidBody(arm, swollen, opacities, colors, self.radius, normals)

    @torch.no_grad()
    def render(
        self, poses: Poses, cameras: Cameras, background: Tensor, light: Tensor | None = None
    ) -> Tensor:
        """Colour and alpha of every pose in every view, (K, V, H, W, 4). light: (8,) that stays while
        the body turns (`lighting.py`), None where the colours go along."""
        views, pixels = len(cameras), len(cameras) * cameras.width * cameras.height
        count = max(1, PIXELS_AT_ONCE // pixels)

        @torch.no_grad()  # a thread has its own switch
        def part(k: int) -> Tensor:
            R, c = (t[k : k + count] for t in vars(poses).values())
            colors = self.colors[None]
            means = self.arm @ R.transpose(1, 2) + c[:, None]
            covariances = R[:, None] @ self.covariances @ R[:, None].transpose(-1, -2)
            batch = cameras.select(list(range(views)) * len(R))
            index = torch.arange(len(R), device=c.device).repeat_interleave(views)
            if light is not None:
                shades = shading(light, self.normals, R[:, None])
                colors = (self.colors * shades[..., None]).repeat_interleave(views, 0)
            image, alpha = rasterize(
                means, covariances, self.opacities, colors, batch, index, background
            )
            return torch.cat((image, alpha[..., None]), -1).unflatten(0, (len(R), views))

        each = threaded if self.arm.is_cpu else map
        return torch.cat(list(each(part, range(0, len(poses.center), count))))


def rotation_exp(vectors: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return torch.linalg.matrix_exp(skew(vectors))


def left_jacobian(v: Tensor) -> Tensor:
    """J with exp(v + d) = exp(J d) exp(v) to first order in d, (..., 3, 3): integral of exp(s v) over s from 0 to
    1."""
    S = skew(v)
    angle = v.norm(dim=-1)[..., None, None]
    small = angle < 1e-4
    safe = torch.where(small, torch.ones_like(angle), angle)
    a = torch.where(small, 0.5 - angle**2 / 24, (1 - safe.cos()) / safe**2)
    b = torch.where(small, 1 / 6 - angle**2 / 120, (safe - safe.sin()) / safe**3)
    return torch.eye(3).to(S) + a * S + b * (S @ S)


def make_level(
    images: Tensor, mattes: Tensor, cameras: Cameras, background: Tensor, center: Tensor, target_px: float | None = None,
    brightness: float = 1.0,
) -> Level:  # fmt: skip
    """Images (V, T, H, W, 3) and mattes (V, T, H, W) cut to the object, its window reduced to about `target_px`
    (None: kept)."""
    margin = round(0.12 * max(crop_boxes(mattes, margin=0)[2:])) + 2
    x0, y0, width, height = crop_boxes(mattes, margin=margin)
    factor = 1 if target_px is None else max(1, round(max(width, height) / target_px))
    x0, y0, width, height = crop_boxes(mattes, margin=margin, multiple=factor)
    width, height = width - width % factor, height - height % factor
    stack = torch.cat((images, mattes[..., None]), -1).float()
    stack = crop_images(stack, x0, y0, width, height, axis=2)
    views, frames = mattes.shape[:2]
    if factor > 1:
        flat = stack.flatten(0, 1).permute(0, 3, 1, 2)
        stack = F.avg_pool2d(flat, factor).permute(0, 2, 3, 1).unflatten(0, (views, frames))
    cut = crop_cameras(cameras, x0, y0, width, height)
    cut.K[:, :2] /= factor
    cut = replace(cut, width=width // factor, height=height // factor)
    depth = project(center[None].to(cut.K), cut)[1].clamp(min=1e-3)
    pixel = float((depth[:, 0] / cut.K[:, 0, 0]).median())
    level = Level(stack.transpose(0, 1).contiguous(), cut, background, pixel, brightness)
    return replace(level, target=level.weighed(level.target))


def huber(residual: Tensor) -> tuple[Tensor, Tensor]:
    """Cost and weight of residuals."""
    size = residual.abs()
    cost = torch.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER))
    return cost, HUBER / size.clamp(min=HUBER)


def pose_columns(
    body: RigidBody, level: Level, poses: Poses, *, central: bool, light: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """What K poses look like, (K, P), and its derivative (K, 6, P) in their numbers: shift, then angle
    times the body's radius [m]; light: as of `RigidBody.render`.

    One-sided differences (`central` false) cost half and move the optimum a little: good enough on the way, not at the end."""
    count, h = len(poses.center), STEP_PX * level.pixel
    sides = (torch.zeros(1, 6), torch.eye(6), -torch.eye(6))[: 3 if central else 2]
    steps = h * torch.cat(sides).to(poses.center)
    shift, angle = steps[:, :3].repeat(count, 1), steps[:, 3:].repeat(count, 1) / body.radius
    around = poses.take(torch.arange(count).repeat_interleave(len(steps)).to(shift.device))
    moved = around.moved(shift, angle)
    seen = level.weighed(body.render(moved, level.cameras, level.background, light))
    here, *sides = seen.view(count, len(steps), -1).split((1, *(6,) * (len(steps) // 6)), 1)
    columns = (sides[0] - sides[1]) / (2 * h) if central else (sides[0] - here) / h
    return here[:, 0], columns


def equations(residual: Tensor, columns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (K,), gradient (K, D) and Gauss-Newton matrix (K, D, D) of residuals (K, P) with derivatives (K, D, P), each residual
    weighted by Huber's rule."""
    cost, weight = huber(residual)
    cost = cost.sum(-1)  # before there is more in memory
    weighted = columns * weight[:, None]
    gradient = (weighted @ residual[..., None])[..., 0]
    return cost, gradient, weighted @ columns.transpose(1, 2)


def normal_equations(
    body: RigidBody, level: Level, poses: Poses, frame: Tensor, *, central: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """`equations` of K poses against the frames (K,) of the level, in the numbers of `pose_columns`."""
    count = max(1, PIXELS_AT_ONCE // ((13 if central else 7) * level.target[0, ..., 0].numel()))
    seen = level.target.new_empty(len(frame), level.target[0].numel())
    columns = seen.new_empty(len(frame), 6, seen.shape[1])
    for some in torch.arange(len(frame)).split(count):
        seen[some], columns[some] = pose_columns(body, level, poses.take(some), central=central)
    return equations(seen - level.target[frame].flatten(1), columns)


def damped(gradient: Tensor, matrix: Tensor, damping: Tensor) -> Tensor:
    """Levenberg-Marquardt step (K, P); the ridge keeps a direction the images say nothing about at rest."""
    diagonal = torch.diagonal(matrix, dim1=-2, dim2=-1)
    ridge = damping[:, None] * diagonal + 1e-9 * diagonal.amax(-1, keepdim=True) + 1e-12
    system = (matrix + torch.diag_embed(ridge)).double()
    return -torch.linalg.solve(system, gradient.double()[..., None])[..., 0].to(gradient)


def choose(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """`new` where the mask (K,) is set, else `old`, both (K, ...)."""
    return torch.where(mask.view(-1, *[1] * (new.dim() - 1)), new, old)


def descend_each(
    evaluate: Callable[[Any], tuple[Tensor, ...]], moved: Callable[[Any, Tensor], Any], start: Any, *, iterations: int,
    most: Callable[[Any], Tensor], small: Callable[[Tensor, Tensor], bool], free: slice = slice(None),
) -> tuple[Any, Tensor]:  # fmt: skip
    """As `descend`, of K numbers each for itself, a dataclass of tensors (K, ...), with their costs (K,). most: (K,) longest steps;
    small: whether steps (K, D), of at most that, are the last."""
    damping, best, trial, state = torch.full_like(start.center[:, 0], 1e-2), start, start, None
    for _ in range(iterations):
        found = evaluate(trial)
        if state is None:
            state = found
        else:
            better = found[0] < state[0]
            damping = torch.where(better, damping / 3, damping * 6)
            pairs = zip(vars(trial).values(), vars(best).values())
            best = type(start)(*(choose(better, new, old) for new, old in pairs))
            state = tuple(choose(better, new, old) for new, old in zip(found, state))
        step, longest = torch.zeros_like(state[1]), most(best)
        step[:, free] = damped(state[1][:, free], state[2][:, free, free], damping)
        length = step.norm(dim=-1).clamp(min=1e-12)
        step = step * (longest / length).clamp(max=1)[:, None]
        trial = moved(best, step)
        if small(step, longest):
            break
    assert state is not None
    return best, state[0]


def descend(
    evaluate: Callable[[Any], tuple[Tensor, ...]], moved: Callable[[Any, Tensor], Any], start: Any, *, damping: float,
    iterations: int, small: Callable[[Tensor, float], bool], free: slice = slice(None),
) -> tuple[Any, tuple[Tensor, ...]]:  # fmt: skip
    """(best numbers, what `evaluate` gave of them) after Levenberg-Marquardt steps from `start`.

    evaluate: cost (), gradient (D,), Gauss-Newton matrix (D, D), and anything else; moved: numbers a step (D,) further; small:
    whether a step, under a damping, is the last one; free: numbers that are fitted."""
    best, trial, state = start, start, None
    for _ in range(iterations):
        found = evaluate(trial)
        if state is None or found[0] < state[0]:
            best, state, damping = trial, found, damping / 3
        else:
            damping = damping * 6
        step, factor = torch.zeros_like(state[1]), torch.full((1,), damping).to(state[1])
        step[free] = damped(state[1][None, free], state[2][None, free, free], factor)[0]
        trial = moved(best, step)
        if small(step, damping):
            break
    assert state is not None
    return best, state


LIGHT_STEP = 0.02
"""Differences for the Jacobian change a number of the light by this."""
LIGHT_RIDGE = 1e-3
"""Of the mean of the light's own diagonal: what pulls it to the light that was known before. One pose hardly tells some of its
numbers."""
TOLD = 30
"""Independent data that a frame's misfit counts as, beside a light whose numbers are known to within
1 before: a body that hardly turned does not tell its light, which shows once it turns further."""


def light_columns(body: RigidBody, level: Level, pose: Poses, light: Tensor) -> Tensor:
    """(8, P) derivative of the level's first frame in the numbers of the light, at one pose."""
    frames = [body.render(pose, level.cameras, level.background, each).flatten()
              for each in (light, *(light + LIGHT_STEP * torch.eye(LIGHT).to(light)))]  # fmt: skip
    return (torch.stack(frames[1:]) - frames[0]) / LIGHT_STEP


def lit_equations(
    body: RigidBody, level: Level, pose: Poses, light: Tensor, before: Tensor, columns: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (), gradient (14,) and Gauss-Newton matrix (14, 14) of one pose and a light (8,) against the level's first frame; the
    pose's numbers as of `pose_columns`. before: (8,) what the ridge pulls to; columns: of `light_columns`, near by."""
    # a bright side does not go along with a turn, also where its size is asked for
    seen, moved = pose_columns(body, level, pose, central=True, light=light)
    every = torch.cat((moved, columns[None]), 1)
    found = equations(seen - level.target[:1].flatten(1), every)
    cost, gradient, matrix = (part[0] for part in found)
    ridge = LIGHT_RIDGE * matrix.diagonal()[6:].mean() + 2 * cost / TOLD
    matrix[6:, 6:] += ridge * torch.eye(LIGHT).to(light)
    gradient[6:] += ridge * (light - before)
    return cost + 0.5 * ridge * (light - before).square().sum(), gradient, matrix
