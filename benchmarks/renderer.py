"""Speed of the rasteriser, forward and backward, beside gsplat where it runs.

    python benchmarks/renderer.py [--repeats 7] [--counts 10000 50000] [--device cpu|cuda] [--views 12]
    python benchmarks/renderer.py --parts     the CUDA kernels' share, stage by stage
    python benchmarks/renderer.py --parity    differences from gsplat on the scene of tests/rendering/test_backends.py

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
import sys
import time
from functools import partial
from pathlib import Path

import gsplat_adapter
import torch
import warp as wp

from mosa.rendering import splatting
from mosa.rendering.cameras import look_at
from mosa.rendering.covariance import covariance_from, project_gaussians
from mosa.rendering.flow import flow_features
from mosa.rendering.rasterizer import rasterize
from mosa.types import Cameras

SIZE, FOCAL, DISTANCE = 400, 500.0, 2.0
WAYS = {"warp": rasterize, "gsplat": gsplat_adapter.splat}


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
        scales, opacities = (
            pixels * DISTANCE / FOCAL * stretch,
            0.15 + 0.8 * torch.rand(count, generator=g),
        )
    return means[None], covariance_from(scales, rotations)[None], opacities


def inputs(
    kind: str, count: int, views: int, channels: int, device: str
) -> tuple[tuple[torch.Tensor, ...], Cameras]:
    """Means, covariances, opacities and features (three colours, with nine channels the six of flow too), and cameras."""
    means, covariances, opacities = (x.to(device) for x in scene(kind, count))
    cameras = ring(views).to(device)
    features = torch.rand(1, count, 3, generator=torch.Generator().manual_seed(1)).to(device)
    if channels == 9:
        moved = 1.01 * means + 0.01
        motion = flow_features(
            means.expand(views, -1, -1), covariances.expand(views, -1, -1, -1),
            moved.expand(views, -1, -1), covariances.expand(views, -1, -1, -1), cameras,
        )  # fmt: skip
        features = torch.cat((features.expand(views, -1, -1), motion), -1)
    return (means, covariances, opacities, features), cameras


def step(kind: str, count: int, views: int, channels: int, device: str, backend: str):
    """A function that renders and differentiates once."""
    values, cameras = inputs(kind, count, views, channels, device)
    leaves = [x.clone().requires_grad_() for x in values]
    index = torch.zeros(views, dtype=torch.long, device=device)
    weight = torch.rand(views, SIZE, SIZE, channels, generator=torch.Generator().manual_seed(2)).to(
        device
    )

    def run() -> None:
        image, alpha = WAYS[backend](*leaves, cameras, index)
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
    print(
        f"\nCPU, 1 image of {SIZE}x{SIZE}, 3 channels, forward + backward, one thread, median (least to most) of {repeats}"
    )
    for kind in ("object", "cloud"):
        for count in counts:
            run = step(kind, count, 1, 3, "cpu", "warp")
            run()
            figures = []
            for _ in range(repeats):
                began = time.process_time()
                run()
                figures.append(time.process_time() - began)
            print(
                f"  {kind:7s} {count:8d}  warp   {spread(figures, 'CPU-s')}  pairs/px {pairs(kind, count):.1f}"
            )


def on_cuda(counts: list[int], repeats: int, views: int) -> None:
    backends = ["warp"] + (["gsplat"] if gsplat_adapter.why_unavailable() is None else [])
    print(
        f"\nCUDA, {views} images of {SIZE}x{SIZE} in one batch, 9 channels, forward + backward, median (least to most) of {repeats}"
    )
    if len(backends) == 1:
        print(f"  gsplat is left out: {gsplat_adapter.why_unavailable()}")
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


@torch.no_grad()
def parts(kind: str, count: int, views: int) -> tuple[dict, int]:
    """The stages of one forward and backward pass as functions of no arguments, by name, and the entries of the tile lists."""
    (means, covariances, opacities, features), cameras = inputs(kind, count, views, 9, "cuda")
    index = torch.zeros(views, dtype=torch.int32, device="cuda")
    g = splatting.Geometry(index, SIZE, SIZE, "tile")
    splatting.start_warp()
    gaussians = (means, covariances, opacities, cameras.K, cameras.w2c)
    records, depths = splatting.project(*gaussians, g)
    lists = splatting.depth_lists(depths.clone(), records, g)
    image, transmittance, ends = splatting.composite(lists, records, features, g)
    state = (ends, transmittance, torch.rand_like(image), torch.ones_like(transmittance))
    moments, _ = splatting.composite_backward(lists, records, features, *state, g)
    return {
        "projection": lambda: splatting.project(*gaussians, g),
        "sorting + lists": lambda: splatting.depth_lists(depths.clone(), records, g),
        "compositing": lambda: splatting.composite(lists, records, features, g),
        "compositing, backward": lambda: splatting.composite_backward(
            lists, records, features, *state, g
        ),
        "projection, backward": lambda: splatting.project_backward(*gaussians, records, moments, g),
    }, len(lists[0])


def device_time(stage, repeats: int, calls: int = 5) -> float:
    """Milliseconds of one call, the longer of host and device where they overlap: median of `repeats` rows of calls."""
    figures = []
    for _ in range(repeats + 1):
        began, ended = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        began.record()
        with splatting.warp_stream(torch.device("cuda")):
            for _ in range(calls):
                stage()
        ended.record()
        ended.synchronize()
        figures.append(began.elapsed_time(ended) / calls)
    return statistics.median(figures[1:])


def print_parts(counts: list[int], repeats: int, views: int) -> None:
    print(
        f"\nCUDA, {views} images of {SIZE}x{SIZE}, 9 channels, stage by stage, median of {repeats} [ms]\n"
    )
    names = None
    for kind in ("object", "cloud"):
        for count in counts:
            stages, entries = parts(kind, count, views)
            if names is None:
                names = list(stages)
                print(
                    f"| scene | Gaussians | {' | '.join(names)} | entries |\n|{'---|' * (len(names) + 3)}"
                )
            figures = [f"{device_time(stage, repeats):.3f}" for stage in stages.values()]
            print(f"| {kind} | {count} | {' | '.join(figures)} | {entries} |")


def print_parity() -> None:
    """Both backends on the scene that tests/rendering/test_backends.py compares, on CUDA; without gsplat, the two orders of
    work of this package."""
    tests = Path(__file__).parents[1] / "tests"
    sys.path[:0] = [str(tests / "rendering"), str(tests / "helpers")]
    from test_backends import NAMES, outcome, parity_scene

    drawn, clear = parity_scene()
    if torch.cuda.is_available():
        for name in (*NAMES, "background", "state_index", "cameras"):
            setattr(drawn, name, getattr(drawn, name).to("cuda"))
        clear = clear.to("cuda")
    reason = gsplat_adapter.why_unavailable()
    ways = WAYS
    if reason:
        print(f"gsplat is left out: {reason}")
        ways = {
            "pixel by pixel": partial(rasterize, scan="tile"),
            "Gaussian by Gaussian": partial(rasterize, scan="gaussian"),
        }
    (image, alpha, gradients), (wanted, wanted_alpha, wanted_gradients) = (
        outcome(drawn, clear, way) for way in ways.values()
    )
    share = float(clear.float().mean())
    print(
        f"\n{' against '.join(ways)}, at {share:.1%} of the pixels, those off the rims, where alpha is 1/255\n"
    )
    print(
        "| what | largest difference | of the largest value | norm of the difference / norm |\n|---|---|---|---|"
    )
    rows = {"image": (image[clear], wanted[clear]), "alpha": (alpha[clear], wanted_alpha[clear])}
    rows |= {f"gradient, {name}": (gradients[name], wanted_gradients[name]) for name in gradients}
    for name, (ours, theirs) in rows.items():
        off = (ours - theirs).abs()
        figures = (off.max(), off.max() / theirs.abs().max(), off.norm() / theirs.norm())
        print(f"| {name} | {' | '.join(f'{float(x):.1e}' for x in figures)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--counts", type=int, nargs="*")
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), help="default: both where there is CUDA"
    )
    parser.add_argument("--parts", action="store_true", help="the stages on CUDA, nothing else")
    parser.add_argument(
        "--parity", action="store_true", help="differences from gsplat, nothing else"
    )
    options = parser.parse_args()
    cuda = torch.cuda.is_available()
    if not cuda and (options.device == "cuda" or options.parts or options.parity):
        parser.error(
            "--device cuda, --parts and --parity need a CUDA device, and torch finds none on this machine"
        )
    print(
        f"{platform.processor() or platform.machine()}, torch {torch.__version__}, warp {wp.__version__}",
        end="",
    )
    print(
        f", {torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"
        if cuda
        else ", no CUDA device"
    )
    if options.parity:
        return print_parity()
    if options.parts:
        return print_parts(
            options.counts or [30_000, 100_000, 1_000_000], options.repeats, options.views
        )
    if options.device != "cuda":
        on_cpu(options.counts or [10_000, 50_000], options.repeats)
    if cuda and options.device != "cpu":
        on_cuda(options.counts or [30_000, 100_000, 1_000_000], options.repeats, options.views)


if __name__ == "__main__":
    main()
