"""Sentences a person reads at the end of a run: what the data determine, what was compared, what is doubtful."""

from __future__ import annotations

import math
from collections.abc import Mapping

from mosa.data.io.forces import FAR
from mosa.evaluation.analysis.tables import UNITS, markdown
from mosa.modules.body.material import ANGLE_MAX, NU_MAX, RELATIVE, unit_of
from mosa.modules.fitting.search.ground import (
    EXPLAINED,
    NEARER,
    alike,
    contact,
    learned_on,
    taken_of,
)
from mosa.modules.fitting.search.parts import WORTH, chosen, named
from mosa.physics.constitutive.damping import DAMPED
from mosa.physics.constitutive.laws import law_named
from mosa.physics.world import World
from mosa.types import RUBBING

KINDS = {
    "von_mises": "a solid that yields", "drucker_prager": "sand", "newtonian": "a liquid",
}  # fmt: skip
UNEXPLAINED = 0.7
"""Share of the observed displacement (`metrics.unexplained`) from which on a law does not explain the motion. README's rabbit has
0.01, the beam 0.14 to 0.23, a fish that topples 0.30, an isotropic law on a disc that rolls as it is anisotropic 0.64. Without its
clamp the beam has 13, a pressed cylinder without the plate that moves 0.73."""
HALF, LOOSE, WIDE = 0.5, 1.0, 0.19
"""Standard deviations: of a modulus's logarithm, from which on a percentage misleads (two of them reach zero), and from which on it
is not determined; of a number with a bounded range, over that range, the latter. Both are 0.7 of the prior's: 1.5 for a logarithm,
and 0.27 of the range that 1.5 is mapped to (`blocks_of`)."""
HIDDEN = 0.4
"""Share of the surface that images do not determine above which the volume is questioned. With 0.35 it was 5 to 12 % too large on
two bodies, with 0.53 by 66 %, on a tube whose hole no camera sees; built-in bodies have at most 0.15."""
SURE_DEGREES = 30.0  # half angle of a direction's 95 % cone above which it counts as not determined
NOTICEABLE = 1.1  # ratio of Young's moduli below which a law counts as isotropic
LISTED = 3  # so many contacts the sentence lists; more are in a table


def ground_table(distances: Mapping[str, float], gains: Mapping[str, float]) -> str:
    """Markdown table of all contacts that were compared, the nearest first; empty where the sentence lists them. distances [m],
    gains: as in `ground_text`."""
    if len(distances) <= LISTED:
        return ""
    header = [
        "a body that ...",
        "calibrated law: distance [mm]",
        "learned law: gain in log likelihood",
    ]
    rows = [[_words(name), f"{1e3 * distances[name]:.2f}" if name in distances else "",
             f"{gains[name]:+.1f}" if name in gains else ""]
            for name in sorted({**distances, **gains}, key=lambda name: distances.get(name, math.inf))]  # fmt: skip
    return markdown(header, rows) if gains else markdown(header[:2], [row[:2] for row in rows])


def ground_text(distances: Mapping[str, float], gains: Mapping[str, float] | None = None) -> str:
    """How the body touches the ground, of distances [m] by contact (`fitting/search/ground.py`), in sentences, and what of it the
    motion does not tell. gains: of other contacts, about the learned law, where those were asked."""
    taken = taken_of(distances)
    touches, said = (learned_on(taken, gains), [_asked(gains)]) if gains else (taken, [])
    # only the isotropic law was asked for its friction
    if touches != "sticky" and (taken == "sticky" or not gains):
        near = ", ".join(f"{friction:.3g}" for friction in alike(distances, contact(touches)[0]))
        said.append(
            "Its friction is *not* determined: the isotropic law comes within a tenth of the "
            f"nearest with {near}, and is wrong itself."
        )
    nearest = sorted(distances, key=distances.get)
    listed = ", ".join(f"{_words(name)} {distances[name] * 1e3:.2f} mm" for name in nearest)
    where = f": {listed}" if len(distances) <= LISTED else " in the table below"
    first = f"Ground: the body {_words(touches)} (mean distance from the training motion after calibration{where})."
    if len(distances) > 1 and NEARER * max(distances.values()) <= min(distances.values()):
        first += " All of them are within a tenth: this film hardly shows how the body slides."
    return " ".join([first, *said])


def _asked(gains: Mapping[str, float]) -> str:
    """What the learned law says of the best of the contacts that it was asked for, and what is left open."""
    best, gain = max(gains.items(), key=lambda each: each[1])
    better = f"{'better' if gain > 0 else 'worse'} by {abs(gain):.1f}"
    said = (
        f"With the learned law, a body that {_words(best)} explains the motion {better} of the "
        "logarithm of the likelihood."
    )
    if -EXPLAINED < gain <= EXPLAINED:
        said += f" Which of the two it is, is *not* determined: that takes {EXPLAINED:g}."
    return said


def form_text(errors: Mapping[str, float], positions: float = 1.0) -> str:
    """Which parts the learned law has, and why. errors: [m] of held-back frames, by `parts.named`; positions: losses.position."""
    words = {"isotropic": "isotropic and the same everywhere", "operator": "anisotropic",
             "stiffness": "of a stiffness that varies over the body",
             "operator+stiffness": "anisotropic, of a stiffness that varies over the body"}  # fmt: skip
    listed = "; ".join(f"{words[name]}: {1e3 * error:.2f} mm" for name, error in errors.items())
    taken = chosen(errors)
    said = (
        f"The learned law is {words[taken]}. Error of frames that were held back from the fit, "
        f"plus the error of the grid: {listed}."
    )
    if taken == named(()) and len(errors) > 1:
        said += (
            f" A richer law is only learned where this error is below {WORTH:g} of the isotropic "
            "one, because errors of contact and cues can look like slight anisotropy."
        )
    if taken == named(()) and positions:
        said += " Cues of rotation and stretch had no part in this law's numbers."
    return said


def _part(figures: Mapping[str, float], prefix: str, suffix: str = "_m") -> dict[str, float]:
    """The figures with a prefix and a suffix, by what is between the two."""
    named = {
        key: v for key, v in figures.items() if key.startswith(prefix) and key.endswith(suffix)
    }
    return {key.removeprefix(prefix).removesuffix(suffix): value for key, value in named.items()}


def _words(name: str) -> str:
    """A contact by `named` in words; both modes with friction leave the ground freely, so the mode is said as well."""
    mode, friction = contact(name)
    freely = f"leaves it freely, friction {friction:.3g} ({mode})"
    return freely if mode in RUBBING else "sticks to it"


def _backbones(law: str, compared: Mapping[str, float], gained: Mapping[str, float]) -> str:
    """How the backbones compare. law: the run's; compared: error [m] after calibration; gained: how much better than the one that
    was nearest then others explain the motion once the adapter is learned."""
    nearest = sorted(compared, key=compared.get)
    listed = ", ".join(f"{name} {compared[name] * 1e3:.2f} mm" for name in nearest)
    said = f"Error of the isotropic laws after calibration: {listed}."
    elastic = [name for name in nearest if law_named(name).elastic]
    others = [name for name in nearest if name not in elastic]
    if elastic and others:
        said += " The body stays deformed, which no elastic law predicts: laws that yield or flow were compared."
    near = [name for name in others if name != law and WORTH * compared[name] < compared[law]]
    for name in (each.removesuffix(DAMPED) for each in near):
        said += f" {name} predicts about as well: the body may be {KINDS.get(name, name)} (prior={name})."
    if {"von_mises", "newtonian"} <= {law, *near}:
        said += " Between both are pastes: prior=herschel_bulkley, which was not compared."
    if gained:
        each = ", ".join(f"{name} {gain:+.1f}" for name, gain in gained.items())
        said += f" With what was learned about {elastic[0]}, the logarithm of the likelihood changes by: {each}."
    return said


def determined_text(figures: Mapping[str, float], law: str, tracked: bool = False) -> str:
    """What the data determine and what they do not, in sentences; empty where a run kept no posterior. law: of the prior, which
    says what its parameters are measured in; tracked: of points in place of films, which are compared from their release on."""
    lines = []
    if compared := _part(figures, "id_prior/compared/"):
        gained = _part(figures, "id_prior/gain/", "")
        lines = [f"Backbone: {law}. {_backbones(law, compared, gained)}", ""]
    if distances := _part(figures, "id_prior/ground/"):
        gains = _part(figures, "id_prior/ground/", "_gain")
        for part in filter(None, (ground_text(distances, gains), ground_table(distances, gains))):
            lines += [part, ""]
    if held_back := _part(figures, "held_back/"):
        lines += [form_text(held_back, figures.get("held_back/position_weight", 1.0)), ""]
    if "posterior/draws" not in figures:
        return "\n".join(lines[:-1])
    lines += ["What the data determine:", ""]
    for of, off in _part(figures, "forces/", "/rms_share").items():
        if off > FAR * (allowed := figures[f"forces/{of}/allowed_share"]):
            lines.append(
                f"- The force on {of} is **not met**: off by {off:.0%} of the largest measured, allowed are {allowed:.1%}. "
                "Do not use these numbers: check its sign, axes, times and unit (N)."
            )
    if figures.get("id/contact_at_limit"):
        height = 1e3 * figures["id/contact_offset_m"]
        lines.append(
            f"- The contact height ended **at the limit** of what a fit may take ({height:.1f} mm from the stated ground), and "
            "the moduli compensate for the rest: their true error may be larger than stated. Check scene.ground.height and "
            "accuracy, and how the ground is touched (scene.ground.mode=auto finds it)."
        )
    says = "with a standard deviation of"
    for name in RELATIVE:
        if (sd := figures.get(f"posterior/{name}_relative_sd")) is not None:
            spread = f"{sd:.1%}" if sd <= HALF else f"{sd:.2g} in its natural logarithm"
            found = f"{figures[f'id/{name}']:.4g} {unit_of(law, name)}, {says} {spread}"
            if HALF < sd <= LOOSE:
                found += f": known to a factor of {math.exp(sd):.2g}"
            lines.append(_number(name, found, sd <= LOOSE))
    if (sd := figures.get("posterior/friction_angle_sd")) is not None:
        found = f"{figures['id/friction_angle']:.3g} degrees, {says} {sd:.2g}"
        lines.append(_number("friction angle", found, sd <= WIDE * ANGLE_MAX))
    if (sd := figures.get("posterior/nu_sd")) is not None:
        found = f"{figures['id/nu']:.3f} with a standard deviation of {sd:.3f}"
        lines.append(_number("nu", found, sd <= WIDE * NU_MAX))
    # a part that the choice of the law left out was not measured
    taken = chosen(held_back) if held_back else "operator+stiffness"
    left_out = {"operator", "stiffness"} - set(taken.split("+"))
    if "posterior/stiffest_cone_deg" in figures and "operator" not in left_out:
        ratio, half = figures["id/stiffness_ratio"], figures["posterior/stiffest_cone_deg"]
        axis = ", ".join(f"{figures[f'id/stiffest_{n}']:.2f}" for n in "xyz")
        spread = f"{ratio:.2f} +- {figures['posterior/stiffness_ratio_sd']:.2f}"
        if ratio < NOTICEABLE:
            said = f"No anisotropy: largest over smallest Young's modulus {spread}; the law predicts as "
            said += "its prior."
        elif half > SURE_DEGREES:
            said = (
                f"Some anisotropy (largest over smallest Young's modulus {spread}), but its "
                f"direction is *not* determined: the 95 % cone about ({axis}) has a half angle of "
                f"{half:.0f} degrees."
            )
        else:
            said = (
                f"The stiffest direction is ({axis}), within {half:.0f} degrees (95 %); the "
                f"largest over the smallest Young's modulus is {spread}."
            )
        lines.append(f"- {said}")
    numbers = {
        "operator": "numbers of the anisotropic stiffness",
        "stiffness": "modes of the stiffness over the body",
    }
    for name, what in numbers.items():
        if (count := figures.get(f"posterior/{name}_numbers")) is not None and name not in left_out:
            known = figures[f"posterior/{name}_determined"]
            lines.append(
                f"- Of {count:.0f} {what} the data determine {known:.1f}; the others keep their "
                "prior values."
            )
    if (sd := figures.get("posterior/test/sd_m")) is not None:
        sure = figures.get("posterior/test/coverage", math.nan)
        covered = f"; {sure:.0%} of the errors lie within two such deviations, where 95% should"
        lines.append(
            f"- Held-out positions after {'the release' if tracked else 'contact'} have a predicted standard deviation "
            f"(not an error) of {sd * 1e3:.1f} mm (rms){'' if math.isnan(sure) else covered}."
        )
    return "\n".join(lines)


def _number(name: str, found: str, known: bool) -> str:
    """The line of one of the law's numbers, with its value and standard deviation."""
    return f"- {name} = {found}." if known else f"- {name} is *not* determined ({found})."


def worse_text(figures: Mapping[str, float]) -> str:
    """That the learned law predicts what was held out worse than its prior, with both figures; empty where it does not."""
    for name, least in (("rms_m", 1.01), ("psnr_crop", 0.998)):
        own, prior = (figures.get(f"{model}test/{name}", math.nan) for model in ("", "prior/"))
        label, scale, digits = UNITS[name]
        if own > least * prior if least > 1 else own < least * prior:
            return (
                f"**The learned law predicts held-out recordings worse than its prior** ({label}: {own * scale:.{digits}f} "
                f"against {prior * scale:.{digits}f}): use the prior "
                "(adapter=none heterogeneity.enabled=false), or learn from more recordings."
            )
    return ""


def unexplained_text(figures: Mapping[str, float], world: World) -> str:
    """What to look for where the learned law does not follow the motion that it was learned from; empty where it does."""
    far = [
        f"`{name}`: {1e3 * figures[f'unexplained/{name}/off_m']:.3g} mm (rms), {share:.0%} of how far the body moves"
        for name, share in _part(figures, "unexplained/", "/share").items()
        if share > UNEXPLAINED
    ]
    has = (
        f"{len(world.driven) or 'no'} driven sets (world.driven), {len(world.colliders) or 'no'} "
        f"colliders, {len(world.planes) or 'no'} walls, {'a' if world.ground else 'no'} ground"
    )
    return bool(far) * (
        "**The learned law does not explain the motion: do not use the numbers below.** Distance from "
        f"the observed motion after first contact: {'; '.join(far)}. Is everything there that holds, "
        f"drives or touches the body (this run has {has}), and in the right place? Are lengths in metres, "
        "times in seconds (scene.fps), and gravity along the right axis (scene.gravity)? If so, the law "
        "cannot follow (prior), or the fit began too far away (prior.parameters)."
    )


def force_lines(figures: Mapping[str, float]) -> str:
    """A line for each measured force: how far the learned law's is off."""
    return "\n".join(
        f"- Force on {of}: the predicted one is off by {off:.1%} (rms) of the largest measured, "
        f"{figures[f'forces/{of}/measured_N']:.4g} N, where {figures[f'forces/{of}/predicted_N']:.4g} N are predicted. "
        f"Allowed standard deviation: {figures[f'forces/{of}/allowed_share']:.1%}."
        for of, off in _part(figures, "forces/", "/rms_share").items()
        if f"forces/{of}/allowed_share" in figures
    )


def geometry_lines(figures: Mapping[str, float]) -> str:
    """Sentences on the body that was filled: how surely its surface is known, and against the true shape where that is known."""
    lines, get = [], lambda name: figures.get(f"geometry/{name}")
    if get("registered_iou") is not None:
        lines.append(
            f"Geometry: the given rest shape, registered at {get('registered_scale'):.5g} m per unit of its file, with a standard "
            f"deviation of {get('registered_scale_deviation'):.2%}; its silhouettes and the mattes have an intersection over union "
            f"of at least {get('registered_iou'):.3f}; the next best pose fits {get('registered_rival'):.1f} times as badly."
        )
    elif get("uncertain_share") is not None:
        lines.append(
            f"Geometry: {get('carved_share'):.1%} of the visual hull is air. {get('uncertain_share'):.1%} of the surface is not "
            "determined by the images to 0.7 particle spacings and is interpolated between outlines; "
            f"{get('free_frames'):.0f} free frames were used."
        )
        if get("uncertain_share") > HIDDEN:
            lines.append(
                "So much of the surface may hide holes, hollows or an underside. Mass and moduli are those of a body of "
                f"{1e6 * get('volume_m3'):.4g} cm^3, and **are wrong if the real volume is another**: compare it (weigh the body), "
                "film the body from more sides, or give its shape (scene.body.shape)."
            )
    elif get("carved_share") is not None:
        lines.append(
            f"Geometry: the visual hull, {get('carved_share'):.1%} of it left out; no refinement by colours."
        )
    if true := _part(figures, "floor/geometry/", ""):
        lines.append(
            f"Against the true shape: {true['outside_share']:.2%} of the particles outside, {true['missing_share']:.2%} of the "
            f"body missing, volume {true['volume_error']:+.2%}, centre of mass {true['center_error_m'] * 1e3:.2f} mm off."
        )
    return "\n".join(lines)
