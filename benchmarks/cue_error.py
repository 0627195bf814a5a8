"""Errors of motion cues against a motion whose truth is known (built-in scenes): rotation, stretch, velocity.

The true deformation gradient at a reconstructed particle is the affine part of the true motion of the nearest true rest
points, fitted by weighted least squares. The truth is sampled more densely than the reconstruction, so the fit
averages over a smaller volume than a cue does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import DataError
from mosa.reconstruction.motion.cues import polar
from mosa.types import MotionCues, Truth

OUTSIDE = 1.5
"""Distance to the nearest true point, in mean distances between true neighbours, beyond which a particle has no truth."""

USUAL_STRETCH = (1.0274, 1.0029, 0.9669)
"""Mean sorted true stretches of the built-in rabbit's training drop after contact: what a cue has to know better."""


@dataclass(frozen=True)
class TrueMotion:
    """The true motion at N points. positions: (T, N, 3) [m]; deformation, rotation: (T, N, 3, 3); stretch: (T, N, 3)
    descending; inside: (N,) bool, False where a point lies outside of the true body and the rest is extrapolated."""

    positions: Tensor
    deformation: Tensor
    rotation: Tensor
    stretch: Tensor
    inside: Tensor


def true_motion(truth: Truth, points: Tensor, *, neighbours: int = 24) -> TrueMotion:
    """The motion of `truth` at rest positions `points` (N, 3) [m] of frame 0 of its sequence. Affine motions are exact.

    Minimises sum_k w_k |x_k - a - F (X_k - X)|^2 over the nearest true points, w = (1 - r^2/r_max^2)^2, r_max 1.2 times the
    distance of the farthest; a is the true position. Errors: DataError where the truth has fewer points than neighbours.
    """
    start = truth.positions[0].double().numpy()
    if len(start) < neighbours:
        raise DataError(
            f"true_motion: expected at least {neighbours} true points, found {len(start)}; ask for fewer neighbours"
        )
    tree, where = cKDTree(start), points.detach().cpu().double().numpy()
    distance, index = tree.query(where, k=neighbours)
    pitch = float(np.median(tree.query(start, k=2)[0][:, 1]))
    offset = start[index] - where[:, None]
    radius = 1.2 * distance[:, -1:]
    root = np.clip(1 - (distance / radius) ** 2, 0, None)
    design = np.concatenate([np.ones_like(offset[..., :1]), offset / radius[..., None]], -1)
    operator = torch.as_tensor(np.linalg.pinv(root[..., None] * design) * root[:, None])
    scale = torch.as_tensor(radius)[..., None]
    moved = truth.positions.double()[:, torch.as_tensor(index)]
    solved = operator @ moved
    deformation = (solved[:, :, 1:] / scale).transpose(-1, -2)
    rotation, stretch = polar(deformation)
    inside = torch.as_tensor(distance[:, 0] < OUTSIDE * pitch)
    return TrueMotion(
        solved[:, :, 0].float(), deformation.float(), rotation.float(), stretch.float(), inside
    )


def rotation_error(found: Tensor, true: Tensor) -> Tensor:
    """Angle (...) [degrees] between rotations (..., 3, 3), from the chord, which is exact for small angles in float32 too."""
    chord = (found.double() - true.double()).square().sum((-1, -2)).sqrt()
    return torch.rad2deg(2 * torch.asin((chord / 8**0.5).clamp(max=1.0)))


def _median_and_90(values: Tensor) -> tuple[float, float]:
    ordered = np.quantile(values.double().numpy(), [0.5, 0.9])
    return float(ordered[0]), float(ordered[1])


def cue_errors(
    cues: MotionCues, true: TrueMotion, times: Tensor, *, first: int = 1
) -> dict[str, float]:
    """Median and 90th percentile of cue errors over particles with truth and weight, frames `first` to the last.

    rotation_deg; stretch: |Lambda - true Lambda| over the three sorted axes; velocity_m_s: norm of the error of
    (x_{t+1} - x_t)/dt, intervals from frame first - 1; position_m: RMS [m]; stretch_rms beside stretch_signal_rms, that of
    true Lambda - 1, which a cue has to stay below to say anything. `known`: share of particles and frames with
    weight; `outside`: share of particles without truth. times: (T,) [s].
    """
    keep = true.inside[None] & (cues.weight > 0)
    keep = keep[first:]
    angle = rotation_error(cues.rotation, true.rotation)[first:][keep]
    stretch = (cues.stretch - true.stretch).abs()[first:][keep].flatten()
    dt = times.diff()[:, None, None]
    speed = (
        ((cues.positions.diff(dim=0) - true.positions.diff(dim=0)) / dt)
        .norm(dim=-1)[first - 1 :, true.inside]
        .flatten()
    )
    squared = (cues.positions - true.positions).square().sum(-1)[first:, true.inside]
    result = {}
    for name, values in (("rotation_deg", angle), ("stretch", stretch), ("velocity_m_s", speed)):
        result[f"{name}_median"], result[f"{name}_p90"] = _median_and_90(values)
    result["stretch_rms"] = float(stretch.square().mean().sqrt())
    result["stretch_signal_rms"] = float((true.stretch - 1)[first:][keep].square().mean().sqrt())
    result["position_rms_m"] = float(squared.mean().sqrt())
    result["known"] = float(keep.float().mean() / true.inside.float().mean())
    result["outside"] = float(1 - true.inside.float().mean())
    return result


def strain_direction_error(
    cues: MotionCues, true: TrueMotion, floor: float, *, first: int = 1
) -> dict[str, float]:
    """Angle [degrees] between Lambda - 1 of cue and truth, all that L_s compares, where the cue's largest |Lambda - 1| is above
    `floor`: median, 90th percentile, and the share of particles and frames that are above.

    Sorted triples resemble each other (isochoric ones are at most 60 degrees apart), so `constant_median_deg` is the error
    of saying USUAL_STRETCH everywhere, over the same particles and frames.
    """
    seen, real = (cues.stretch - 1)[first:], (true.stretch - 1)[first:]
    valid = true.inside[None] & (cues.weight[first:] > 0)
    keep = valid & (seen.abs().amax(-1) > floor)
    if not bool(keep.any()):
        return {"floor": floor, "share": 0.0}
    cosine = torch.nn.functional.cosine_similarity(seen[keep].double(), real[keep].double(), dim=-1)
    median, high = _median_and_90(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))))
    usual = torch.nn.functional.cosine_similarity(
        torch.tensor(USUAL_STRETCH).double() - 1, real[keep].double(), dim=-1
    )
    constant, _ = _median_and_90(torch.rad2deg(torch.acos(usual.clamp(-1, 1))))
    share = float(keep.float().sum() / valid.float().sum())
    return {
        "floor": floor,
        "share": share,
        "median_deg": median,
        "p90_deg": high,
        "constant_median_deg": constant,
    }


def motionless(true: TrueMotion) -> MotionCues:
    """Cues that say nothing: every particle stays as it is. Their error is the size of what is to be measured."""
    identity = torch.eye(3).expand_as(true.rotation)
    positions = true.positions[:1].expand_as(true.positions)
    return MotionCues(
        positions,
        identity,
        torch.ones_like(true.stretch),
        torch.ones_like(true.stretch[..., 0]),
        torch.zeros_like(identity),
    )
