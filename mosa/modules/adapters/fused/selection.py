"""Whether the fused kernels can take the place of the torch modules. Imports no Triton: it exists on few platforms."""

from __future__ import annotations

import importlib.util
import os

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters.progressive import ProgressiveOperator


def interpreted() -> bool:
    """Whether Triton's kernels run on CPU tensors, slowly, in its interpreter: for tests."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def why_not(operator: ProgressiveOperator, w: Tensor) -> str | None:
    """What keeps the kernels from evaluating `operator` on w (N, 6); None where they can."""
    hidden = operator.psi1[0].out_features
    ablations = "constant", "no_C", "no_pre", "no_post", "no_prior_stress"
    if any(getattr(operator, name) for name in ablations):
        return "the kernels have all four networks, and no ablation of them"
    if operator.major_symmetry:
        return "the kernels have no major_symmetry"
    if hidden not in (16, 32, 64, 128):
        return f"the kernels need hidden = 16, 32, 64 or 128, found {hidden}"
    if w.dtype != torch.float32:
        return f"the kernels compute in float32, found networks of {w.dtype}"
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    if not w.is_cuda and not interpreted():
        return f"the kernels run on CUDA, found tensors on {w.device}"
    return None


def chosen(fused: bool | str, operator: ProgressiveOperator, w: Tensor) -> bool:
    """auto: on CUDA, where the kernels can. Errors: ConfigError where fused is true and they cannot."""
    if fused is False or (fused == "auto" and not w.is_cuda):
        return False
    reason = why_not(operator, w)
    if reason is not None and fused is True:
        raise ConfigError(f"adapter.fused=true: {reason}; take adapter.fused=auto")
    return reason is None


def weights_of(operator: ProgressiveOperator) -> list[nn.Parameter]:
    """The 26 weights in the kernels' order."""
    modules = (operator.phi, operator.psi1, operator.planes, operator.psi2, operator.theta)
    return [p for module in modules for p in module.parameters()]
