"""A film of blocks that move over a few pixels."""

import math

import torch

from mosa.data.checks.free_fall import track_of
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.types import Ground, Scene

BOX = [[-1.0, -0.1, -1.0], [1.0, 1.0, 1.0]]
WORLD = {"gravity": [0, -9.8, 0], "box": BOX, "ground": {"height": 0.0}}


def block_scene(views: int = 3, frames: int = 5, size: int = 32) -> Scene:
    """8-bit colours, mattes with soft borders, 24 frames per second; it falls, in whole pixels of about 27 mm, with gravity's 17 mm
    per frame squared."""
    rng = torch.Generator().manual_seed(3)
    mattes = torch.zeros(views, frames, size, size)
    for v in range(views):
        for t in range(frames):
            top = 8 + (0, 1, 2, 5, 8, 12, 17)[t]
            mattes[v, t, top : top + 10, 10 + v : 22 + v] = 1
            mattes[v, t, top, 10 + v : 22 + v] = round(0.4 * 255) / 255
    color = torch.randint(0, 256, (views, frames, size, size, 3), generator=rng) / 255
    images = color * mattes[..., None] + 1 - mattes[..., None]
    rig = ring_of_cameras(
        views, size, target=(0, 0.2, 0), distance=1.5, elevations=(0.2, 0.6), field=0.3, turn=0.4
    )
    up = torch.tensor([0.0, 1.0, 0.0])
    return Scene(
        "blocks",
        "train",
        images,
        mattes,
        rig,
        torch.arange(frames) / 24,
        -9.8 * up,
        up,
        Ground(0.0),
        torch.tensor(BOX),
        1000.0,
        torch.ones(3),
        True,
    )


def assert_same_footage(found: Scene, expected: Scene) -> None:
    """Equal up to the 8 bits of the files. A half covered pixel keeps its colour to half a level over its coverage."""
    assert torch.allclose(found.mattes, expected.mattes, atol=1e-6)
    assert torch.allclose(found.images, expected.images, atol=0.51 / 255)
    assert torch.allclose(found.cameras.K, expected.cameras.K, atol=1e-4)
    assert torch.allclose(found.cameras.w2c, expected.cameras.w2c, atol=1e-6)
    assert torch.allclose(found.times, expected.times, atol=1e-7)
    assert math.isclose(found.density, expected.density)


def clouds_of(scene: Scene, count: int = 9, frames: int | None = None) -> torch.Tensor:
    """(T, count, 3) [m] drawn particles where the cameras see the object of each frame; of more frames where it is seen last."""
    track = track_of(scene)
    spread = 1.5 * track.radius * (torch.rand(frames or scene.frames, count, 3) - 0.5)
    spread[:, :2] = (
        0.75 * track.radius * torch.tensor([[-1.0], [1.0]])
    )  # the cloud's extent, whatever was drawn
    points = track.points[torch.arange(len(spread)).clamp(max=scene.frames - 1)].float()
    return points[:, None] + spread - spread.mean(1, keepdim=True)
