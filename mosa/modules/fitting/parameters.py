"""The few numbers of a body that Gauss-Newton learns: which they are, their prior, and a body as the law of other numbers.

They are the prior's global parameters, the contact offset, the adapter's numbers and the stiffness modes', in this order."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from mosa.modules.body.body import Body, ContactOffset
from mosa.modules.body.material import FORMS, NU_MAX, Form, Material, unit_of
from mosa.modules.fitting.gauss_newton import Block, Seat
from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.types import Ground

FINER = 0.25
"""Steps of the joint stage's differences over those of a calibration, which begins further from its end. What one-sided differences
get wrong falls with their step, and on two drops it had stopped the fit: the rabbit's ended at a cost of 675, with these steps at
585, and its held-out error fell from 0.56 to 0.51 of the prior's (docs/lab/2026-11-identification.md)."""

STIFFNESS_SPREAD = 0.3
"""Of the logarithm of the factor that the evidence gives to `stiffness_sd`. Without a prior of its own the evidence makes the field
too even on bodies that tell little of it, and contact height and nu then explain what the field should: chick1 is off by 6.7 mm
on held-out drops, 4.5 mm with it (docs/lab/2026-11-readme.md)."""

END = 0.005
"""Of a parameter's range: nearer to its end, a fit ended there."""


def few_numbers(module: torch.nn.Module | None) -> bool:
    """Whether Gauss-Newton can learn a part of a body: an adapter or a heterogeneity field."""
    return module is None or module.few_numbers


def limits_of(name: str) -> tuple[float, float]:
    """Of a global parameter's unconstrained number, within which it is learned: beyond those of nu a rollout no longer tells
    another one."""
    if name == "nu":
        return FORMS[name].inverse(0.02), FORMS[name].inverse(0.98 * NU_MAX)
    return -math.inf, math.inf


def warn_of_ends(material: Material) -> None:
    """A warning for numbers that a fit took to the end of their range, as it does where a body has another law."""
    ends = []
    for name, raw in material.raw.items():
        form, raw = FORMS.get(name), raw.detach()
        moved = not math.isclose(float(raw), material.begins[name], rel_tol=1e-6)
        if not (moved and isinstance(form, Form) and math.isfinite(form.high)):
            continue
        low, high = map(form.physical, map(torch.tensor, limits_of(name)))
        value, room = float(form.physical(raw)), END * float(high - low)
        if not low + room < value < high - room:
            ends.append(f"{name} = {value:.3g} {unit_of(material.law, name)}".strip())
    if ends:
        warnings.warn(
            f"prior.parameters: {', '.join(ends)}: at the end of what the law {material.law} allows; the film probably "
            "shows a body of another law, and then the other numbers are wrong as well (prior=auto compares laws)",
            stacklevel=2,
        )


def blocks_of(
    body: Body, *, adapter: bool, heterogeneity: bool, settings: IdentificationSettings,
    ground: Ground | None = None, free: bool = False, calibrating: bool = False,
) -> list[Block]:  # fmt: skip
    """The numbers that are learned, in the order of `tensors_of`. ground: what the body falls on; free: whether only free rollouts
    are compared."""
    blocks, step = [], 0.02 if calibrating else 0.02 * FINER
    for name in body.material.learned:
        start = body.material.begins[name]
        wider = 2.5 if name == "nu" else 1.0
        mean, sd = torch.tensor([start]), torch.tensor([1.5])
        blocks.append(Block(name, mean, sd, wider * step, bounds=limits_of(name)))
    if body.contact.enabled:
        sd, bounds = body.contact.prior(ground, body.settings.dx, free)
        mean = torch.tensor([ContactOffset.START])
        blocks.append(Block("contact", mean, torch.tensor([sd]), step, bounds=bounds))
    if adapter:
        zero = torch.zeros(body.adapter.numbers.numel())
        sd = zero + settings.operator_sd
        blocks.append(Block("operator", zero, sd, step, learned=True))
    if heterogeneity:
        falls = (1 + (body.heterogeneity.size / 2) ** 2) ** -0.5
        sd, step = settings.stiffness_sd * falls, step / body.heterogeneity.settings.amplitude
        blocks.append(
            Block("stiffness", 0 * falls, sd, step, learned=True, spread=STIFFNESS_SPREAD)
        )
    return blocks


def tensors_of(body: Body, *, adapter: bool, heterogeneity: bool) -> list[Tensor]:
    """The parameters of `blocks_of`."""
    tensors: list[Tensor] = [body.material.raw[name] for name in body.material.learned]
    tensors += [body.contact.cells] if body.contact.enabled else []
    tensors += [body.adapter.numbers] if adapter else []
    return tensors + ([body.heterogeneity.coefficients] if heterogeneity else [])


def _seat(body: Body) -> Seat:
    learned = {"adapter": is_learned(body.adapter), "heterogeneity": is_learned(body.heterogeneity)}
    return Seat(tensors_of(body, **learned), torch.empty)


def write_numbers(body: Body, numbers: Tensor) -> None:
    """Set a learned body to numbers (D,) of its joint stage's posterior, a draw of it for instance."""
    _seat(body).write(numbers)


def read_numbers(body: Body) -> Tensor:
    """What `write_numbers` sets, (D,)."""
    return _seat(body).read()


def each_law(body: Body, numbers: Tensor) -> Iterator[Tensor]:
    """Goes through laws (D, numbers): at each turn `body` is that law; afterwards, whatever happens, what it was before."""
    kept = read_numbers(body)
    try:
        for law in numbers:
            write_numbers(body, law)
            yield law
    finally:
        write_numbers(body, kept)


def is_learned(module) -> bool:
    return module is not None and few_numbers(module)


@contextmanager
def as_rival(body: Body, law: str, numbers: Tensor) -> Iterator[None]:
    """`body` as a rival of its posterior, and afterwards, whatever happens, what it was before."""
    kept = body.material.law
    body.material.law = law
    try:
        for _ in each_law(body, numbers[None]):
            yield
    finally:
        body.material.law = kept
