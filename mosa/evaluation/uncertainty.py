"""How sure a learned law is: draws of its posterior rolled out, the spread of what they predict, and what the data determined."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Ordered
from typing import TypeVar

import torch
from torch import Tensor

from mosa.errors import MosaError
from mosa.evaluation.analysis.stiffness import cone, stiffest
from mosa.evaluation.evaluate import Sequence, true_motion
from mosa.modules.body.body import Body, World
from mosa.modules.body.material import FORMS as RANGES
from mosa.modules.body.material import RELATIVE, STIFFNESS, Form, Material
from mosa.modules.body.ready import Ready
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.identification import PARTICLES_TOGETHER
from mosa.modules.fitting.parameters import as_rival, each_law, limits_of
from mosa.reconstruction.marker_body import cues_of_markers
from mosa.system.progress import tqdm
from mosa.system.threads import apart

DRAWS, OF_CONE = 12, 400
"""Of the posterior: those that are rolled out, and those for the cone about the stiffest direction."""
INFLATION = 1.75
"""Factor of the standard deviation of the numbers that are said, and of predictions where a law has no rivals. Frames of a motion
are less independent than the likelihood takes them to be; chosen on the held-out drops of rabbit, chick1, mandarin and peanut."""
DRAWN = 0.3
"""Factor of the draws' standard deviation in predictions where the law has rivals. What these predict otherwise is most of the
error; chosen on the same drops under two backbones: 95 % of the errors lie within two standard deviations on average."""
FORMS = 0.7  # factor of the standard deviation among the forms of a law
GRID = 0.025
"""Relative standard deviation of a stiffness that a film does not lower: the learner's grid is as wrong in every frame. Chosen on
rabbit and mandarin."""
ELSEWHERE = 3.0
"""By so much more than on the drops that it was learned from a law is wrong on another one, beside what draws and forms say. Both
were chosen on the held-out drops of these four bodies under two backbones; those of other bodies, and films by other programs, hold
what docs/lab/2026-11-identification.md#what-is-sure says."""
LEAST_DRAWS = 4  # of those that could be simulated: fewer say nothing about a spread
QUANTILES = 400  # of a normal distribution, where its image under a bounded map is asked for


@torch.no_grad()
def predicted_spread(
    body: Body,
    posterior: Posterior,
    sequences: Ordered[Sequence],
    world: World,
    known: Mapping[str, Tensor] | None = None,
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """(figures, standard deviation (T, N) [m] of every particle's position by the sequence's prefix).

    The variance of a position, summed over its three components, is that of the draws (times `DRAWN`^2), that among the forms of
    the law (`Posterior.rivals`, times `FORMS`^2), and the square of what the model gets wrong on the training sequence itself
    (`Posterior.model_error`), which is `ELSEWHERE` times as much on a sequence that was not learned from. Draws and rivals that
    cannot be simulated are left out and counted; sequences on which the law itself cannot are left out. known: positions (T, N, 3)
    [m] that the law itself predicts, by the sequence's prefix, where they are at hand. Figures: posterior/draws, posterior/rivals,
    posterior/<prefix>/sd_m and, after first contact and where the true motion is known, posterior/<prefix>/coverage: the share of
    the particles' errors within two standard deviations."""
    base: dict[str, Tensor] = dict(known or {})
    for s in sequences:
        try:
            if s.prefix not in base:
                base[s.prefix] = _positions(body, s, world)
        except MosaError:  # `evaluate` has said so
            continue
    sequences = [s for s in sequences if s.prefix in base]
    if not sequences:  # of no draw would anything be simulated
        return {
            "posterior/draws": 0.0,
            "posterior/rivals": 0.0,
            "posterior/model_error_m": posterior.model_error,
        }, {}

    def positions(own: Body) -> dict[str, Tensor]:
        return {s.prefix: _positions(own, s, world) for s in sequences}

    numbers = posterior.draws(DRAWS)
    drawn: list[dict[str, Tensor]] = []
    if body.rest.is_cuda:
        with contextlib.suppress(MosaError):  # of one of them, which is left out below
            drawn = side_by_side(body, numbers, sequences, world)
    if not drawn:
        laws = [(body.material.law, each) for each in numbers]
        drawn = motions_under(body, laws, positions, quiet=False)
    others = motions_under(body, list(posterior.rivals.items()), positions)
    figures: dict[str, float] = {
        "posterior/draws": float(len(drawn)),
        "posterior/rivals": float(len(others)),
        "posterior/model_error_m": posterior.model_error,
    }
    spreads: dict[str, Tensor] = {}
    if len(drawn) < LEAST_DRAWS:
        return figures, spreads
    for s in sequences:
        own, *others_here = (each[s.prefix] for each in (base, *others))
        sd = spread_of(own, [each[s.prefix] for each in drawn], others_here, posterior, s)
        spreads[s.prefix] = sd.cpu()
        figures[f"posterior/{s.prefix}/sd_m"] = float(sd[s.contact :].square().mean().sqrt())
        target = true_motion(body, s.scene)
        if s.scene.markers is not None:
            cues = cues_of_markers(s.scene, body.rest.cpu())
            own, *others_here = (cues.seen(x.cpu()) for x in (own, *others_here))
            seen = [cues.seen(each[s.prefix].cpu()) for each in drawn]
            sd, target = spread_of(own, seen, others_here, posterior, s), cues.positions
        if target is not None:
            error = (own.cpu() - target).norm(dim=-1)[s.contact :]
            within = (error <= 2 * sd.cpu()[s.contact :])[torch.isfinite(error)]
            figures[f"posterior/{s.prefix}/coverage"] = float(within.double().mean())
    return figures, spreads


def spread_of(
    own: Tensor, drawn: Ordered[Tensor], others: Ordered[Tensor], posterior: Posterior, s: Sequence
) -> Tensor:
    """`total_spread` on a sequence of points (T, N, 3) [m] that the law, its draws and its rivals predict."""
    forms = among_forms(own, others)
    return total_spread(torch.stack([*drawn]), posterior.model_error, forms, seen=s.learned)


Predicted = TypeVar("Predicted")


@torch.no_grad()
def motions_under(
    body: Body, laws: Ordered[tuple[str, Tensor]], predict: Callable[[Body], Predicted], *, quiet: bool = True
) -> list[Predicted]:  # fmt: skip
    """What predict(body) says as each of the laws (name, numbers (D,)), `apart`; those that cannot be simulated are left out."""

    def tried(own: Body, law: tuple[str, Tensor]) -> Predicted | None:
        with as_rival(own, *law):
            try:
                return predict(own)
            except MosaError:
                return None

    bar = tqdm(
        apart(body, laws, tried),
        "draws of the posterior",
        total=len(laws),
        leave=False,
        disable=quiet,
    )
    return [found for found in bar if found is not None]


@torch.no_grad()
def side_by_side(
    body: Body, numbers: Tensor, sequences: Ordered[Sequence], world: World
) -> list[dict[str, Tensor]]:
    """Positions (T, N, 3) [m] in each sequence, by its prefix, under laws of the body's form with numbers (K, D): so many worlds,
    which all take the substeps of the stiffest. Errors: MosaError where one of them cannot be simulated, or not as a world."""
    found: list[dict[str, Tensor]] = [{} for _ in numbers]
    for s in sequences:
        frames = s.scene.frames
        ready = functools.partial(body.ready, s.start, world, frames, s.scene.frame_dt)
        substeps = max(ready().simulator.substeps for _ in each_law(body, numbers))
        together = max(1, PARTICLES_TOGETHER // len(body.rest))
        for first in range(0, len(numbers), together):
            some = each_law(body, numbers[first : first + together])
            worlds = Ready.stack([ready(substeps=substeps).answered() for _ in some])
            each = worlds.simulate(frames, world.solids).worlds()
            for own, rollout in zip(found[first:], each):
                own[s.prefix] = rollout.x
    return found


def among_forms(base: Tensor, others: Ordered[Tensor]) -> Tensor | None:
    """(T, N) [m^2] mean square distance from positions `base` (T, N, 3) of those that a law and its rivals predict, each form as
    likely as the others; None without rivals."""
    if not others:
        return None
    return torch.stack([(x - base).square().sum(-1) for x in others]).sum(0) / (len(others) + 1)


def total_spread(
    drawn: Tensor, model_error: float, forms: Tensor | None = None, *, seen: bool = False
) -> Tensor:
    """(T, N) standard deviation [m] of positions (D, T, N, 3) under drawn laws, of the law's form (`among_forms`, [m^2]), and of
    what no law explains. seen: the law was learned from this very motion."""
    own = drawn.var(0).sum(-1)
    known = INFLATION**2 * own if forms is None else DRAWN**2 * own + FORMS**2 * forms
    return (known + (model_error if seen else ELSEWHERE * model_error) ** 2).sqrt()


def _positions(body: Body, s: Sequence, world: World) -> Tensor:
    return body.simulate(s.start, world, s.scene.frames, s.scene.frame_dt).x


def physical_sd(name: str, raw: Tensor, sd: float) -> float:
    """Standard deviation of a global parameter in its own unit, of its unconstrained number `raw` () and that one's.

    By the slope of its map; where its range is bounded on both sides, the root mean square distance from what was found of a normal
    distribution that is cut off at the limits of the fit. The slope vanishes at the bounds, and would say that a Poisson number of
    0.02 is known to 0.05 where 0.3 explains the motion as well."""
    raw = raw.detach().double().cpu().requires_grad_(True)
    with torch.enable_grad():
        value = Material.physical_of(name, raw)
        slope = torch.autograd.grad(value, raw)[0]
    if not isinstance(RANGES.get(name), Form) or math.isinf(RANGES[name].high):
        return sd * float(slope.abs())
    low, high = limits_of(name)
    middle, sd = raw.detach().clamp(low, high), min(max(sd, 1e-9), 1e9)
    ends = torch.tensor([low, high], dtype=torch.float64)
    below, within = torch.special.ndtr((ends - middle) / sd).tolist()
    middles = (torch.arange(QUANTILES, dtype=torch.float64) + 0.5) / QUANTILES
    shares = below + (within - below) * middles
    drawn = (middle + sd * torch.special.ndtri(shares)).clamp(low, high)
    return float((Material.physical_of(name, drawn) - value.detach()).square().mean().sqrt())


@torch.no_grad()
def determined(body: Body, posterior: Posterior) -> dict[str, float]:
    """What the data say about the law: standard deviations of the global parameters (`posterior/<name>_sd`, relative for moduli;
    the spread over other forms of the law that explain the data is part of them), how many of the operator's numbers and of the
    stiffness modes they determine, and the 95 % cone about the stiffest direction: of draws about every form of the law that
    explains the data, each form as likely as the others."""
    figures: dict[str, float] = {}
    mean = posterior.mean
    forms = torch.stack([mean, *(n.to(mean) for n in posterior.rivals.values())])
    blocks: dict[str, list[int]] = {}
    for i, name in enumerate(posterior.names):
        blocks.setdefault(name.split("[")[0], []).append(i)
    for name, index in blocks.items():
        if name in body.material.raw:
            raw = posterior.mean[index[0]]
            variance = INFLATION**2 * posterior.covariance[index[0], index[0]]
            variance += FORMS**2 * forms[:, index[0]].var(correction=0)
            sd = physical_sd(name, raw, float(variance.sqrt()))
            if name in RELATIVE:
                value = float(body.material.physical_of(name, raw))
                grid = GRID if name in STIFFNESS else 0.0
                figures[f"posterior/{name}_relative_sd"] = math.hypot(sd / value, grid)
            else:
                figures[f"posterior/{name}_sd"] = sd
        elif name in ("operator", "stiffness"):
            figures[f"posterior/{name}_numbers"] = float(len(index))
            figures[f"posterior/{name}_determined"] = float(posterior.determined[index].sum())
    if body.adapter is not None and body.adapter.is_on and body.adapter.stiffness() is not None:
        generator = torch.Generator().manual_seed(1)
        axis, _ = stiffest(body.adapter.stiffness().cpu())
        stiffnesses = []
        # wider draws than the likelihood's own
        away = INFLATION * (posterior.draws(OF_CONE, generator) - posterior.mean)
        for _ in each_law(body, forms[torch.arange(OF_CONE) % len(forms)] + away):
            body.adapter.follow(body.material.poisson())
            stiffnesses.append(body.adapter.stiffness().cpu())
        body.adapter.follow(body.material.poisson())
        axes, ratios = stiffest(torch.stack(stiffnesses))
        figures["posterior/stiffest_cone_deg"] = cone(axis, axes)
        figures["posterior/stiffness_ratio_sd"] = float(ratios.std())
    return figures
