"""Drawn scenes of a few Gaussians in front of a few cameras."""

from types import SimpleNamespace

import torch

from mosa.rendering.cameras import look_at
from mosa.rendering.covariance import covariance_from
from mosa.types import Cameras

NAMES = ("means", "covariances", "opacities", "features")


def ring(views: int, width: int, height: int, *, distance: float = 1.0, focal: float = 1.3) -> Cameras:
    """Cameras around the origin at changing heights, principal point off the centre, focal length in image widths."""
    angle = torch.linspace(0, 2 * torch.pi, views + 1, dtype=torch.float64)[:-1] + 0.3
    eye = distance * torch.stack((angle.cos(), 0.4 * (2 * angle).sin(), angle.sin()), -1)
    w2c = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    f = focal * width
    K = torch.tensor([[f, 0, 0.48 * width], [0, 1.05 * f, 0.53 * height], [0, 0, 1]], dtype=torch.float64)
    return Cameras(K.repeat(views, 1, 1), w2c, width, height, tuple(f"c{i}" for i in range(views)))


def draw(count: int, *, states: int = 2, images: int = 3, channels: int = 3, seed: int = 0, size: float = 0.06):
    """Means, anisotropic covariances, opacities from 0.15 to 0.95 and features, float64, with cameras and
    background."""
    g = torch.Generator().manual_seed(seed)
    scales = size * (0.3 + torch.rand(states, count, 3, generator=g, dtype=torch.float64))
    rotations = torch.randn(states, count, 4, generator=g, dtype=torch.float64)
    return SimpleNamespace(
        means=0.25 * torch.randn(states, count, 3, generator=g, dtype=torch.float64),
        covariances=covariance_from(scales, rotations),
        opacities=0.15 + 0.8 * torch.rand(count, generator=g, dtype=torch.float64),
        features=torch.rand(images, count, channels, generator=g, dtype=torch.float64),
        background=torch.rand(channels, generator=g, dtype=torch.float64),
        cameras=ring(images, 24, 20),
        state_index=torch.arange(images) * states // images,
    )


def render(scene, function, **options):
    """`function` on the drawn scene: rasterize or its reference."""
    values = [options.pop(name, getattr(scene, name)) for name in NAMES]
    return function(*values, scene.cameras, scene.state_index, scene.background, **options)


def objective(image, alpha):
    """A fixed random linear function of both outputs, scalar."""
    g = torch.Generator().manual_seed(3)
    weights = (torch.randn(x.shape, generator=g, dtype=torch.float64).to(x) for x in (image, alpha))
    return sum((x * w).sum() for x, w in zip((image, alpha), weights))


def gradients(scene, function, **options):
    """Gradients of `objective` with respect to the four differentiable inputs."""
    leaves = {name: getattr(scene, name).detach().clone().requires_grad_() for name in NAMES}
    return torch.autograd.grad(objective(*render(scene, function, **leaves, **options)), list(leaves.values()))
