"""Whether a body yields: its film ends in a shape that an elastic law does not predict.

After an impact an elastic body oscillates about its shape at rest, so that the mean of its later
shapes is near that. A body that has yielded keeps most of its largest change of shape.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from mosa.modules.body.body import Body, World
from mosa.physics.constitutive.laws import law_named
from mosa.physics.contact.colliders import reach
from mosa.reconstruction.motion.cues import polar
from mosa.types import MarkerCues

LASTS = 0.6
"""Share of the largest change of shape from which laws that yield are compared as well.

True motions of twelve elastic bodies keep at most 0.43 of it (a fish that topples; 0.22 without
it), those of four bodies that yield at least 0.82; this is about the geometric mean of both."""
NEAR = 0.9
"""Of the largest change of shape: the frames after the first that has so much tell what lasts."""
LEAST, FEWEST = 0.01, 8
"""Of the body's size: a smaller change of shape is within the error of the cues. And frames of a film
whose end tells something."""


@torch.no_grad()
def lasting(body: Body, takes: Sequence, world: World) -> float:
    """Share of the largest change of shape that the later frames keep on the mean and that free
    rollouts of the backbone as it stands do not explain; the largest of several takes. 0 where it
    is within the error of the cues, where the film ends before, and of a body that is held, driven
    or pressed: it does not come to rest in a shape of its own."""
    if world.driven or any(c.motion.max_speed(reach(c.shape)) for c in world.colliders):
        return 0.0
    shares, model = [], body.model().only(heterogeneity=False, adapter=False)
    for take in takes:
        cues, frames = take.cues, len(take.cues.positions)
        found = body.simulate(take.start, world, frames, take.frame_dt, model=model).x
        # a single camera's shapes grow with their unseen distance: those nearest to the rollout's
        seen = found - cues.away(found) if cues.single else cues.positions
        if isinstance(cues, MarkerCues):
            whole = torch.isfinite(seen).all(-1).all(0)
            seen, found = seen[:, whole], cues.seen(found)[:, whole]
        change = changed(seen)
        sizes = change.square().sum(-1).mean(-1).sqrt()
        # what flows to the end is near its largest change of shape before
        near = int((sizes >= NEAR * sizes.max()).nonzero()[0])
        late = (near + 1 + frames) // 2
        # a body that leans against the ground keeps some, and one that topples elsewhere than
        # predicted differs from the rollout: one that has yielded does both
        unexplained = change - changed(found)
        kept = min(c[late:].mean(0).square().sum(-1).mean().sqrt() for c in (change, unexplained))
        if frames >= FEWEST and late < frames and kept > LEAST * body.size:
            shares.append(float(kept / sizes.max()))
    return max(shares, default=0.0)


def changed(x: Tensor) -> Tensor:
    """(T, N, 3) [m] of points x (T, N, 3) from where they were in the first frame, without the
    rigid motion of the body."""
    arms = x - x.mean(1, keepdim=True)
    rotation, _ = polar(arms.mT @ arms[0])
    return arms @ rotation - arms[0]


def warn_of_yielding(body: Body, takes: Sequence, world: World) -> None:
    """A warning where the backbone is elastic and the body stays deformed."""
    law = body.material.law
    if not law_named(law).plastic and (share := lasting(body, takes, world)) > LASTS:
        warnings.warn(
            f"prior: the body keeps {share:.0%} of its largest change of shape to the end of the "
            f"film, which the elastic law {law} does not predict: it may yield, and then all numbers are "
            "wrong, or it leans or topples otherwise than predicted; prior=auto compares a law that yields "
            "too (prior=von_mises)",
            stacklevel=2,
        )
