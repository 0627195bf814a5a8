"""Figures of evaluation.md."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure


def interpolate_motion(rest: Tensor, positions: Tensor, query: Tensor, neighbours: int = 8) -> Tensor:
    """True motion at rest positions `query` (N, 3): (T, N, 3) [m] from truth rest (M, 3) and positions (T, M, 3), by inverse
    distance over the nearest true rest points."""
    distance, index = cKDTree(rest.cpu().numpy()).query(query.cpu().numpy(), k=min(neighbours, len(rest)))
    weight = 1 / np.maximum(distance, 1e-9)
    weight = torch.as_tensor(weight / weight.sum(1, keepdims=True)).to(positions)
    displaced = positions - rest.to(positions)
    moved = (displaced[:, torch.as_tensor(index)] * weight[None, ..., None]).sum(2)
    return query.cpu().to(positions) + moved


def rms(x: Tensor, target: Tensor) -> float:
    """Root mean square distance [m] of (T, N, 3) and (T, N, 3)."""
    return float((x.double() - target.double()).square().sum(-1).mean().sqrt())


def subsample(points: Tensor, count: int, seed: int) -> np.ndarray:
    """At most `count` points without replacement."""
    points = points.detach().cpu().numpy()
    if len(points) <= count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]


def _nearest(a: Tensor, b: Tensor, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    a, b = subsample(a, samples, seed), subsample(b, samples, seed + 1)
    return cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]


def chamfer_squared(a: Tensor, b: Tensor, *, samples: int = 8192, seed: int = 0) -> float:
    """Two-sided sum of mean squared nearest distances [m^2]."""
    ab, ba = _nearest(a, b, samples, seed)
    return float((ab**2).mean() + (ba**2).mean())


def chamfer(a: Tensor, b: Tensor, *, samples: int = 8192, seed: int = 0) -> float:
    """Two-sided sum of mean nearest distances [m]."""
    ab, ba = _nearest(a, b, samples, seed)
    return float(ab.mean() + ba.mean())


def emd(a: Tensor, b: Tensor, *, samples: int = 2048, seed: int = 0) -> float:
    """Mean distance [m] of the exact assignment between equal random subsets."""
    count = min(samples, len(a), len(b))
    cost = cdist(subsample(a, count, seed), subsample(b, count, seed + 1))
    rows, columns = linear_sum_assignment(cost)
    return float(cost[rows, columns].mean())


def psnr(rendered: Tensor, real: Tensor) -> float:
    """Mean over images (T, H, W, 3) in [0, 1] of the PSNR [dB]."""
    return float(peak_signal_noise_ratio(rendered.movedim(-1, 1), real.movedim(-1, 1), data_range=1.0, reduction="elementwise_mean",
                                         dim=(1, 2, 3)))


def ssim(rendered: Tensor, real: Tensor) -> float:
    """Mean over images (T, H, W, 3) in [0, 1] of the SSIM: 11x11 Gaussian window, sigma 1.5."""
    return float(structural_similarity_index_measure(rendered.movedim(-1, 1), real.movedim(-1, 1), data_range=1.0, sigma=1.5,
                                                     kernel_size=11))
