"""Kernels of laws without their adjoints, for files that ask for no gradients: they compile in half the time."""

from functools import cache, partial
from unittest.mock import patch

import pytest
import torch
import warp as wp

from mosa.physics.constitutive import material_kernels

FORWARD = (
    "test_closed_systems.py",
    "test_elastic_bodies.py",
    "test_invariance.py",
    "test_stress.py",
)
ADAPTED = {"stress_kernel": 3, "return_kernel": 2}
"""Place among the arguments of a maker of kernels: whether an adapter acts."""

SELDOM = ("state_kernel",)
"""Launched once for ten or more substeps: what Clang's -O0 (the same bits) saves of their compilation is more than they then
take longer. Of the kernels of every substep it is not."""


def forward(name: str):
    """In place of a maker of `material_kernels`. What an adapter needs in float64 test_rollout_gradients.py compiles for every
    law with its adjoint: that is shared."""
    made = getattr(material_kernels, name)
    alone = cache(made.__wrapped__)

    def kernel(*words):
        if wp.float64 in words and (name not in ADAPTED or words[ADAPTED[name]]):
            return made(*words)
        options = {"module_options": {"optimization_level": 0}} if name in SELDOM else {}
        with patch.object(wp, "kernel", partial(wp.kernel, enable_backward=False, **options)):
            return alone(*words)

    return kernel


KERNELS = {name: forward(name) for name in ("stress_kernel", "return_kernel", "state_kernel")}


@pytest.fixture(autouse=True, scope="module")
def adjoints(request):
    if request.path.name in FORWARD and not torch.cuda.is_available():
        with patch.multiple(material_kernels, **KERNELS):
            yield
    else:
        yield
