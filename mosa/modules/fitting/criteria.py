"""What a fit compares with the motion that was seen: a free rollout, a prediction that is corrected by it, or both.

In a free rollout the errors of grid and contact accumulate through the bounce, and a law is bent to undo them. A prediction error
method (Ljung, System Identification, chapter 3) asks less: from what was seen up to a frame, predict the next. Here the observer
is Luenberger's with a fixed gain on the velocities; positions and deformation gradients stay those of the simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mosa.modules.fitting.identification_settings import Criterion
from mosa.types import Rollout

__all__ = ["Criterion", "corrected_rollout"]


def corrected_rollout(
    roll: Callable[..., Rollout], state, observed: Tensor, gain: float, frame_dt: float,
    unseen: Callable[[Tensor, int], Tensor] | None = None,
) -> Rollout:  # fmt: skip
    """Frames predicted one by one: after each, v += gain (x_seen - x)/frame_dt. Its positions are those before the correction.

    roll: a simulator's rollout with everything but state, frames and times given; observed: (T, N, 3) [m] with its frame 0;
    frame_dt [s]; unseen: of positions [m] in a frame, what would not have been observed of them, and is no distance then.
    Differentiable.
    """
    parts: list[Rollout] = []
    current = state
    for frame in range(1, len(observed)):
        part = roll(current, frames=2, started=frame > 1, start_time=(frame - 1) * frame_dt)
        parts.append(part)
        away = observed[frame] - part.final.x
        if unseen is not None:
            away = away + unseen(part.final.x, frame)
        current = replace(part.final, v=part.final.v + ((gain / frame_dt) * away).to(part.final.v))
    if not parts:
        return roll(state, frames=1)
    stacked = {
        name: torch.cat([getattr(parts[0], name), *(getattr(part, name)[1:] for part in parts[1:])])
        for name in ("x", "v", "F", "F_tot")
    }
    reactions = (
        None if parts[0].reactions is None else torch.cat([part.reactions for part in parts])
    )
    times = frame_dt * torch.arange(
        len(observed), dtype=parts[0].times.dtype, device=parts[0].times.device
    )
    return Rollout(
        **stacked, times=times, final=parts[-1].final, inverted=sum(part.inverted for part in parts), reactions=reactions,
        counts=tuple(count for part in parts for count in part.counts),
    )  # fmt: skip
