"""What the curves of a fit are: the tags that loggers get, each with its unit and a sentence.

TensorBoard shows them beside the curves (`mosa.training.loggers`), and docs/figures.md has the table that `table` makes of them."""

from __future__ import annotations

import re
from typing import NamedTuple

from mosa.modules.body.material import unit_of


class Curve(NamedTuple):
    """tag: with <...> for what differs; unit: `-` for a number without one; what: a sentence without it."""

    tag: str
    unit: str
    what: str


CURVES = (
    Curve(
        "loss/total",
        "-",
        "the quantity that the step descends. Adam: sum of all weighted terms, mean over "
        "training sequences. Gauss-Newton: cost (minus the logarithm of the posterior) after "
        "the step; the first four iterations on several drops count a part of the data",
    ),
    Curve(
        "loss_raw/<term>",
        "-",
        "a term of the loss (`mosa/modules/fitting/losses.py`) before its weight",
    ),
    Curve("loss_weighted/<term>", "-", "a term of the loss times its weight in `losses`"),
    Curve(
        "id/contact_offset",
        "m",
        "height above the ground at which the grid stops the body, after the step",
    ),
    Curve("id/<p>", "SI, degrees", "parameter p after the step, without eta"),
    Curve("adapter/mean_abs_C", "-", "mean of |C| in the step, once the adapter is fitted"),
    Curve(
        "gradient_norm/<group>",
        "-",
        "norm of the gradient of a group of parameters; of networks before clipping",
    ),
    Curve("lr/<group>", "-", "Adam: learning rate of the group"),
    Curve("time/step_s", "s", "wall time of the step"),
    Curve(
        "fit/stage", "-", "0, 1, 2: prior, prior_eta, joint, without stages that the run leaves out"
    ),
    Curve(
        "fit/frames",
        "-",
        "frames that the step simulated; the first stage begins with those around first contact",
    ),
    Curve("fit/inverted", "-", "particles with det F <= 0, summed over frames"),
    Curve(
        "fit/distance_m",
        "m",
        "Gauss-Newton: mean distance of free rollouts from the motion cues after frame 0",
    ),
    Curve(
        "newton/share",
        "-",
        "Gauss-Newton: distance that the iteration's steps went, over the length of its "
        "first; 0 if no step improved the cost",
    ),
    Curve(
        "newton/length",
        "-",
        "Gauss-Newton: length of the iteration's first step, in posterior standard deviations",
    ),
    Curve(
        "newton/sd/<block>",
        "-",
        "Gauss-Newton: mean prior standard deviation of a kind of numbers, by the evidence so far",
    ),
    Curve(
        "epoch",
        "-",
        "epochs before this one: iterations of Gauss-Newton, passes over the views by Adam",
    ),
    Curve(
        "final/<figure>",
        "as above",
        "figure of `metrics.json` (its `id/E` includes eta), once, beside the configuration (TensorBoard: HPARAMS)",
    ),
)


def table() -> str:
    """The curves in Markdown, as docs/figures.md has them."""
    rows = [
        f"| `{curve.tag}` | {curve.unit} | {curve.what.replace('|', chr(92) + '|')} |"
        for curve in CURVES
    ]
    return "\n".join(["| tag | unit | meaning |", "|---|---|---|", *rows])


def described(tag: str, law: str) -> str | None:
    """What a logged tag is, with its unit; None for one that the table does not have. law: of the prior, which says what its
    parameters are measured in. Errors: ConfigError for an unknown law."""
    for curve in CURVES:
        if re.fullmatch(re.sub(r"<\w+>", ".+", curve.tag), tag):
            unit = unit_in(tag, law) if "<" in curve.tag else curve.unit
            name = tag.partition("/")[2]
            named = curve.what.replace("parameter p ", f"parameter {name} ").replace(
                "figure of ", f"figure {name} of "
            )
            return named if unit in ("", "-") else f"{named} [{unit}]"
    return None


FIGURES = {r".*_relative_error|.*_ratio": "", r".*_m": "m", r".*/psnr_\w+": "dB", r".*_deg": "degrees", r".*/v0_[xyz]": "m/s",
           r".*/omega0_[xyz]": "rad/s"}  # fmt: skip
"""Units of figures that are no parameters, by patterns of their names."""


def unit_in(tag: str, law: str) -> str:
    """Of a tag with a name in it: a parameter's, or a figure's; empty for none."""
    for pattern, unit in FIGURES.items():
        if re.fullmatch(pattern, tag):
            return unit
    kind, _, name = tag.removeprefix("final/").partition("/")
    return unit_of(law, name) if law and kind in ("id", "id_prior") else ""
