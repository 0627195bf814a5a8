"""Drawn scenes of a few Gaussians in front of a few cameras."""

from types import SimpleNamespace

import torch

from mosa.rendering.cameras import look_at
from mosa.rendering.covariance import covariance_from
from mosa.types import Cameras

NAMES = ("means", "covariances", "opacities", "features")


def ring(
    views: int, width: int, height: int, *, distance: float = 1.0, focal: float = 1.3
) -> Cameras:
    """Cameras around the origin at changing heights, principal point off the centre, focal length in image widths."""
    angle = torch.linspace(0, 2 * torch.pi, views + 1, dtype=torch.float64)[:-1] + 0.3
    eye = distance * torch.stack((angle.cos(), 0.4 * (2 * angle).sin(), angle.sin()), -1)
    w2c = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    f = focal * width
    K = torch.tensor(
        [[f, 0, 0.48 * width], [0, 1.05 * f, 0.53 * height], [0, 0, 1]], dtype=torch.float64
    )
    return Cameras(K.repeat(views, 1, 1), w2c, width, height, tuple(f"c{i}" for i in range(views)))


def draw(
    count: int,
    *,
    states: int = 2,
    images: int = 3,
    channels: int = 3,
    seed: int = 0,
    size: float = 0.06,
):
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
    return torch.autograd.grad(
        objective(*render(scene, function, **leaves, **options)), list(leaves.values())
    )


def dense():
    """Large, nearly opaque Gaussians: alpha reaches its cap and pixels stop early."""
    scene = draw(12, states=2, images=2, size=0.25, seed=11)
    scene.opacities = 0.9 + 0.1 * (scene.opacities - 0.15) / 0.8
    scene.opacities[::3] = 1.0
    return scene


def edge():
    """Some Gaussians behind or beside a camera, where J is evaluated at the clamped direction, yet reaching into
    the image."""
    scene = draw(12, states=1, images=2, size=0.3, seed=2)
    scene.means = 1.6 * scene.means
    eye = -scene.cameras.w2c[0, :3, :3].T @ scene.cameras.w2c[0, :3, 3]
    scene.means[0, 0] = 1.2 * eye
    return scene


CASES = {"sparse": lambda: draw(12, images=2, seed=1), "dense": dense, "edge": edge}


def slopes(function, value):
    """Derivatives of a scalar function of no arguments by the entries of `value`, which it reads: fourth-order differences in
    float64. Zero where an entry does not matter."""
    step = 1e-6 * float(value.abs().mean())
    result = torch.zeros_like(value)
    flat, out = value.view(-1), result.view(-1)
    for i in range(len(flat)):
        start = flat[i].clone()
        sides = []
        for k in (-2, -1, 1, 2):
            flat[i] = start + k * step
            sides.append(function())
        flat[i] = start
        out[i] = (sides[0] - 8 * sides[1] + 8 * sides[2] - sides[3]) / (12 * step)
    return result
