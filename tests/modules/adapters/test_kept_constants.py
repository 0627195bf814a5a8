"""Constants that are made once serve gradients, also where the first to ask was an evaluation (Lightning's inference mode)."""

from __future__ import annotations

import pytest
import torch

from mosa.modules.adapters.hyperelastic import anisotropic_basis
from mosa.modules.adapters.microplane import _constants, _entries, _placement
from mosa.rendering.appearance.spherical_harmonics import _projections

CPU = torch.device("cpu")


@pytest.mark.parametrize("made, arguments", [
    (anisotropic_basis, (torch.float64, CPU)), (_entries, (CPU,)), (_placement, (torch.float64, CPU)),
    (_constants, (torch.float64, CPU)), (_projections, ()),
])  # fmt: skip
def test_what_an_evaluation_made_can_be_differentiated_through(made, arguments):
    made.cache_clear()
    with torch.inference_mode():
        found = made(*arguments)
    first = found[0] if isinstance(found, tuple) else found
    assert not first.is_inference()
    weight = torch.ones(first.shape[-1], dtype=torch.float64, requires_grad=True)
    torch.autograd.grad((first * weight).sum(), weight)
    assert made(*arguments) is found  # kept
