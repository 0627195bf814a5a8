"""Whether a body yields: its film ends in a shape that an elastic law does not predict.

After an impact an elastic body oscillates about its shape at rest, so that the mean of its later shapes is near that. A body that
has yielded keeps most of its largest change of shape."""

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

LASTS = 0.7
"""Share of the largest change of shape from which laws that yield or flow are compared as well.

Chosen between two motions from images: of an elastic fish that topples (0.65) and of gorilla_v2, which yields (0.83; 0.73
unexplained). True motions keep at most 0.50 of it in fifteen elastic bodies, at least 0.84 in ten that yield or flow."""
NEAR = 0.9
"""Of the largest change of shape: the frames after the first that has so much tell what lasts."""
LEAST, FEWEST = 0.01, 8
"""Of the body's size: a smaller change of shape is within the error of the cues. And frames of a film whose end tells something."""


@torch.no_grad()
def lasting(body: Body, takes: Sequence, world: World, unexplained: bool = False) -> float:
    """Share of the largest change of shape that the later frames keep on the mean; the largest of
    several takes. 0 where it is within the error of the cues, where the film ends before, and of a
    body that is held, driven or pressed: it does not come to rest in a shape of its own.

    unexplained: at most what free rollouts of the backbone as it stands do not explain. Very soft
    elastic laws explain a body that flows: a film ends before such a law takes its shape back."""
    if world.driven or any(c.motion.max_speed(reach(c.shape)) for c in world.colliders):
        return 0.0
    shares, model = [], body.model().only(heterogeneity=False, adapter=False)
    for take in takes:
        cues, seen, frames = take.cues, take.cues.positions, len(take.cues.positions)
        if unexplained or cues.single:
            found = body.simulate(take.start, world, frames, take.frame_dt, model=model).x
            # a single camera's shapes grow with their unseen distance: those nearest to the rollout's
            seen = found - cues.away(found) if cues.single else seen
        whole = torch.isfinite(seen).all(-1).all(0)  # of tracked points
        if not whole.any():  # each was lost somewhere
            continue
        changes = [change := changed(seen[:, whole])]
        if unexplained:
            found = cues.seen(found) if isinstance(cues, MarkerCues) else found
            # a body that leans against the ground keeps some, and one that topples elsewhere than
            # predicted differs from the rollout: one that has yielded does both
            changes.append(change - changed(found[:, whole]))
        sizes = change.square().sum(-1).mean(-1).sqrt()
        # what flows to the end is near its largest change of shape before
        near = int((sizes >= NEAR * sizes.max()).nonzero()[0])
        late = (near + 1 + frames) // 2
        kept = min(each[late:].mean(0).square().sum(-1).mean().sqrt() for each in changes)
        if frames >= FEWEST and late < frames and kept > LEAST * body.size:
            shares.append(float(kept / sizes.max()))
    return max(shares, default=0.0)


def changed(x: Tensor) -> Tensor:
    """(T, N, 3) [m] of points x (T, N, 3) from where they were in the first frame, without the rigid motion of the body."""
    arms = x - x.mean(1, keepdim=True)
    rotation, _ = polar(arms.mT @ arms[0])
    return arms @ rotation - arms[0]


def warn_of_yielding(body: Body, takes: Sequence, world: World) -> None:
    """A warning where the backbone is elastic and the body stays deformed."""
    law = body.material.law
    if law_named(law).elastic and (share := lasting(body, takes, world, unexplained=True)) > LASTS:
        warnings.warn(
            f"prior: the body keeps {share:.0%} of its largest change of shape to the end of the "
            f"film, which the elastic law {law} does not predict: it probably yields or flows, and then all "
            "numbers are wrong, or it leans or topples otherwise than predicted; prior=auto compares solids "
            "that yield, liquids and sand too (von_mises, newtonian, drucker_prager)",
            stacklevel=2,
        )
