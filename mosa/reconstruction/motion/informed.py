"""The motion once more, informed by a simulation: where images do not say how a body moved, it moved as the law predicts.

The first reconstruction knows no mechanics. Its elastic and bending energies pull every frame towards the body at rest, which is
wrong wherever images are too weak to answer: limbs that truly bend come out straighter, and a law that is identified from them
too stiff. Once a backbone is calibrated, its rollout is the better guess: the motion starts from the predicted shapes, each laid
rigidly onto what was seen of its frame, and the same energies are counted from there. What images do say is followed as before;
what they do not say then tells nothing against the backbone. A prediction that is no body's (flattened, inside out) would hold the
motion where no image is: then the first motion stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mosa.reconstruction.gaussians.uniform_adam import UniformAdam
from mosa.reconstruction.motion.cues import polar
from mosa.reconstruction.motion.dynamic import Objective, Predicted, Scaffold, Target
from mosa.reconstruction.motion.modes import coefficients_of
from mosa.reconstruction.motion.motion import ModalMotion
from mosa.reconstruction.settings import DynamicSettings, InformedSettings
from mosa.rendering.cameras import centers

WORSE, SLACK = 1.2, 0.005
"""A prediction has misled the fit where the loss of images is more than so many times the first motion's, and so much beside. On
the gorilla, whose images tell least, both are 0.017; flattened and inverted predictions of a block end at 0.11 and 0.13."""
COMPARED = 2
"""Views of every frame on which the two are compared."""
AS_IT_IS = 0.8
"""A frame of a prediction stays where it is if its loss of images there is so many times that of the frame laid onto what was seen:
what was seen of a liquid's late frames may be a tenth of a metre off. It is laid all the same if it then ends nearer to the
images: a disc that rolls between plates turns within its shape, and a flat prediction that does not roll is tilted by being laid.
A fit from where it is never turned the disc: what was found of it was 17 mm off in place of 5 (docs/lab/2026-11-discs.md)."""


def laid_onto(predicted: Tensor, seen: Tensor, eye: Tensor | None = None) -> Tensor:
    """Positions (T, N, 3) [m], moved rigidly, frame by frame, to where they are nearest to `seen` (Kabsch's rotation).

    eye: (3,) [m] of the only camera, which does not tell how far the body is: it stays as far as predicted."""
    centre, target = predicted.mean(1, keepdim=True), seen.mean(1, keepdim=True)
    if eye is not None:
        sight, away = target - eye, (centre - eye).norm(dim=-1, keepdim=True)
        target = eye + sight * away / sight.norm(dim=-1, keepdim=True)
    rotation, _ = polar((seen - target).mT @ (predicted - centre))
    return (predicted - centre) @ rotation.mT + target


def project(motion: ModalMotion, scaffold: Scaffold, positions: Tensor) -> None:
    """Set the amplitudes to those whose particles are nearest to positions (T, N, 3) [m], frame by frame."""
    away = positions - scaffold.splats.means - motion.offsets[:, None]
    coefficients = coefficients_of(away, scaffold.modes.values)
    with torch.no_grad():
        motion.amplitude.copy_(coefficients / motion.unit[:, None])


def informed_motion(
    target: Target, predicted: Tensor, seen: Tensor, settings: InformedSettings, dynamic: DynamicSettings, *, seed: int,
    judging: Scaffold | None = None, progress: Callable[[int], None] | None = None,
) -> tuple[ModalMotion, Tensor] | None:  # fmt: skip
    """(motion through all frames of the target's windows, about predicted shapes of the body; those shapes (T, N, 3) [m] where it
    began); else as `fit_motion`. None where it follows the images much worse than `seen` does.

    predicted, seen: (T, N, 3) [m] positions of the particles, a simulation's and those that were found without one; judging: the
    Gaussians by which the two motions are compared in the end, those that were not fitted as `seen` carried them: it would win by
    that alone. None: those of the target."""
    scaffold, windows, every = target.scaffold, target.windows, torch.arange(len(target.offsets))
    every = every.to(target.offsets.device)
    chosen = torch.cat([(windows.frame == t).nonzero()[:COMPARED, 0] for t in every[1:].tolist()])
    compared, alone = windows.select(chosen), dynamic.but(elastic=0.0, bending=0.0)
    weights = dynamic.but(elastic=settings.elastic, bending=settings.bending, bending_scale=0.0)

    @torch.no_grad()
    def at(positions: Tensor) -> ModalMotion:
        motion = target.modal()
        project(motion, scaffold, positions)
        return motion

    @torch.no_grad()
    def losses(of: ModalMotion) -> Tensor:
        """(T,) of images, 0 for the first frame."""
        objective, found = Objective(of, target, alone), [torch.zeros_like(target.offsets[0, 0])]
        for t in every[1:]:
            own = compared.of_frame(int(t))
            found.append(objective(t[None], own, torch.zeros_like(own.frame)))
        return torch.stack(found)

    def followed(
        begun: Tensor, frames: Tensor, progress: Callable[[int], None] | None = None
    ) -> ModalMotion:
        """From these shapes (T, N, 3) [m], the images of these frames."""
        motion = at(begun)
        with torch.no_grad():
            deformation = motion.displacement(every, scaffold.modes)[1]
            about = Predicted(motion.coefficients(every).clone(), torch.linalg.inv(deformation))
        Objective(motion, target, weights, about).minimise(
            UniformAdam(motion.parameters(), lr=settings.lr),
            frames.tolist(),
            settings.iterations,
            settings.views,
            torch.Generator().manual_seed(seed),
            progress,
        )
        return motion

    single = len(windows.view.unique()) == 1
    laid = laid_onto(predicted, seen, centers(windows.cameras)[0] if single else None)
    stays = losses(at(predicted)) < AS_IT_IS * losses(at(laid))
    motion = followed(torch.where(stays[:, None, None], predicted, laid), every[1:], progress)
    if bool(stays.any()):  # what begins nearer to the images may end farther from them
        other = followed(laid, every[stays])
        nearer = stays & (losses(other) < losses(motion))
        motion.amplitude.data[nearer] = other.amplitude.data[nearer]
        stays &= ~nearer
    begun = torch.where(stays[:, None, None], predicted, laid)
    judged = replace(target, carried=judging or target.carried)

    @torch.no_grad()
    def loss(of: ModalMotion) -> float:
        return float(Objective(of, judged, alone)(every, compared, compared.frame))

    return (motion, begun) if loss(motion) < WORSE * loss(at(seen)) + SLACK else None
