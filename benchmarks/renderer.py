"""Speed of the rasteriser, forward and backward, beside gsplat where it runs.

    python benchmarks/renderer.py [--repeats 7] [--counts 10000 50000] [--device cpu|cuda] [--views 12]

CPU: one 400 x 400 image, three colours and alpha, CPU-seconds on one thread. CUDA: 12 views of 400 x 400 in one batch, colour,
alpha and Gaussian flow (nine channels), milliseconds and peak memory. Gradients to means, covariances, opacities and features.
Two scenes: `object`, a ball filled with particles as the reconstruction leaves them (0.35 spacings wide, opacity 0.8), which
covers a third of the image, and `cloud`, Gaussians of 1 to 4 px all over the image. Cost follows the (pixel, Gaussian) pairs:
the last column counts them. The first run compiles kernels; it is not counted.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time

import torch
import warp as wp

from mosa.rendering import gsplat_backend
from mosa.rendering.cameras import look_at
from mosa.rendering.covariance import covariance_from, project_gaussians
from mosa.rendering.flow import flow_features
from mosa.rendering.rasterizer import rasterize
from mosa.types import Cameras

SIZE, FOCAL, DISTANCE = 400, 500.0, 2.0


def ring(views: int) -> Cameras:
    """Cameras on a circle around the origin, [m]."""
    angle = 2 * torch.pi * torch.arange(views) / views + 0.3
    eye = DISTANCE * torch.stack((angle.cos(), torch.full_like(angle, 0.25), angle.sin()), -1)
    w2c = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    return Cameras(K.repeat(views, 1, 1), w2c, SIZE, SIZE, tuple(map(str, range(views))))


def scene(kind: str, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means (1, N, 3), covariances (1, N, 3, 3) and opacities (N,) of a named scene."""
    g = torch.Generator().manual_seed(0)
    direction = torch.randn(count, 3, generator=g)
    direction = direction / direction.norm(dim=1, keepdim=True)
    stretch = 0.8 + 0.4 * torch.rand(count, 3, generator=g)
    rotations = torch.randn(count, 4, generator=g)
    if kind == "object":
        radius = 0.52
        means = radius * torch.rand(count, 1, generator=g) ** (1 / 3) * direction
        spacing = radius * (4 / 3 * torch.pi / count) ** (1 / 3)
        scales, opacities = 0.35 * spacing * stretch, torch.full((count,), 0.8)
    else:
        means = 1.6 * (torch.rand(count, 3, generator=g) - 0.5)
        pixels = 1 + 3 * torch.rand(count, 1, generator=g)
        scales, opacities = pixels * DISTANCE / FOCAL * stretch, 0.15 + 0.8 * torch.rand(count, generator=g)
    return means[None], covariance_from(scales, rotations)[None], opacities


def step(kind: str, count: int, views: int, channels: int, device: str, backend: str):
    """A function that renders and differentiates once."""
    means, covariances, opacities = (x.to(device) for x in scene(kind, count))
    cameras = ring(views).to(device)
    index = torch.zeros(views, dtype=torch.long, device=device)
    g = torch.Generator().manual_seed(1)
    features = torch.rand(1, count, 3, generator=g).to(device)
    if channels == 9:
        moved = 1.01 * means + 0.01
        motion = flow_features(
            means.expand(views, -1, -1), covariances.expand(views, -1, -1, -1),
            moved.expand(views, -1, -1), covariances.expand(views, -1, -1, -1), cameras,
        )  # fmt: skip
        features = torch.cat((features.expand(views, -1, -1), motion), -1)
    leaves = [x.clone().requires_grad_() for x in (means, covariances, opacities, features)]
    weight = torch.rand(views, SIZE, SIZE, channels, generator=g).to(device)

    def run() -> None:
        image, alpha = rasterize(*leaves, cameras, index, backend=backend)
        torch.autograd.grad((image * weight).sum() + alpha.sum(), leaves)

    return run


def pairs(kind: str, count: int) -> float:
    """Gaussians whose alpha reaches 1/255 at a pixel of the first view, mean over the image: areas of their ellipses. A pixel that
    is opaque after the first few composites fewer."""
    means, covariances, opacities = scene(kind, count)
    centers, M = project_gaussians(means, covariances, ring(1))
    inside = ((centers[0] > 0) & (centers[0] < SIZE)).all(1)
    root_det = (M[0, :, 0] * M[0, :, 2] - M[0, :, 1] ** 2).sqrt()
    return float((2 * torch.pi * torch.log(255 * opacities) * root_det)[inside].sum()) / SIZE**2


def spread(values: list[float], unit: str) -> str:
    return f"{statistics.median(values):8.3f} {unit} ({min(values):.3f} to {max(values):.3f})"


def on_cpu(counts: list[int], repeats: int) -> None:
    torch.set_num_threads(1)
    print(f"\nCPU, 1 image of {SIZE}x{SIZE}, 3 channels, forward + backward, one thread, median (least to most) of {repeats}")
    for kind in ("object", "cloud"):
        for count in counts:
            run = step(kind, count, 1, 3, "cpu", "warp")
            run()
            figures = []
            for _ in range(repeats):
                began = time.process_time()
                run()
                figures.append(time.process_time() - began)
            print(f"  {kind:7s} {count:8d}  warp   {spread(figures, 'CPU-s')}  pairs/px {pairs(kind, count):.1f}")


def on_cuda(counts: list[int], repeats: int, views: int) -> None:
    backends = ["warp"] + (["gsplat"] if gsplat_backend.why_unavailable() is None else [])
    print(
        f"\nCUDA, {views} images of {SIZE}x{SIZE} in one batch, 9 channels, forward + backward, median (least to most) of {repeats}"
    )
    if len(backends) == 1:
        print(f"  gsplat is left out: {gsplat_backend.why_unavailable()}")
    for kind in ("object", "cloud"):
        for count in counts:
            for backend in backends:
                run = step(kind, count, views, 9, "cuda", backend)
                for _ in range(3):
                    run()
                torch.cuda.synchronize()
                torch.cuda.reset_peak_memory_stats()
                figures = []
                for _ in range(repeats):
                    began = time.perf_counter()
                    run()
                    torch.cuda.synchronize()
                    figures.append(1e3 * (time.perf_counter() - began))
                memory = torch.cuda.max_memory_allocated() / 2**30
                print(
                    f"  {kind:7s} {count:8d}  {backend:6s} {spread(figures, 'ms')}  peak {memory:.2f} GiB  "
                    f"pairs/px {pairs(kind, count):.1f}"
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--counts", type=int, nargs="*")
    parser.add_argument("--device", choices=("cpu", "cuda"), help="default: both where there is CUDA")
    options = parser.parse_args()
    cuda = torch.cuda.is_available()
    print(f"{platform.processor() or platform.machine()}, torch {torch.__version__}, warp {wp.__version__}", end="")
    print(f", {torch.cuda.get_device_name()}, CUDA {torch.version.cuda}" if cuda else ", no CUDA device")
    if options.device != "cuda":
        on_cpu(options.counts or [10_000, 50_000], options.repeats)
    if cuda and options.device != "cpu":
        on_cuda(options.counts or [30_000, 100_000, 1_000_000], options.repeats, options.views)


if __name__ == "__main__":
    main()
