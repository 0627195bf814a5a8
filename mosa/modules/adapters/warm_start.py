"""Start of the ablation without prior stress: L_pre reproduces the prior, or the body would begin without stiffness."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.physics.adapters.interface import MaterialState

SMALLEST_STRAIN = 1e-3


def drawn_stretches(count: int, largest: float, generator: torch.Generator) -> Tensor:
    """(M, 3, 3) float64 right stretches exp(H), |H| log-uniform between 1e-3 and `largest`, all directions alike."""
    A = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    H = 0.5 * (A + A.mT)
    size = SMALLEST_STRAIN * (largest / SMALLEST_STRAIN) ** torch.rand(
        count, generator=generator, dtype=torch.float64
    )
    return torch.matrix_exp(H * (size / H.norm(dim=(1, 2)))[:, None, None])


@torch.no_grad()
def warm_start(
    adapter: Adapter, states: Callable[[Tensor], MaterialState], *, strain: float = 0.3,
    samples: int = 8192, seed: int = 0,
) -> float:  # fmt: skip
    """Fit the last layer of Phi to the prior's stress over random Hencky strains up to `strain`; (relative RMS error left).

    adapter: a `StressAdapter`, which calls this; states: of `mosa.modules.body.material.material_states`. Linear least squares of
    relative errors, so that the stiffness at rest counts as much as that at large strain, with L_pre(0, 0) = 0. To be called after
    `switch_on`, before any training.
    Errors: ConfigError for an adapter that has the prior stress or no E_ref."""
    if not adapter.operator.no_prior_stress:
        raise ConfigError("warm_start: expected an adapter with no_prior_stress=true")
    adapter.check_on()
    generator = torch.Generator().manual_seed(seed)
    network, k = adapter.operator.phi, adapter.operator.scale
    inner, device = adapter.E_ref.dtype, adapter.E_ref.device

    def draw() -> tuple[Tensor, Tensor, Tensor]:
        state = states(drawn_stretches(samples, strain, generator))
        s = state.stress / adapter.E_ref.double().cpu()
        inputs = k * torch.cat([state.w, s], -1)
        rest = network.features(torch.zeros(1, 12, dtype=inner, device=device))
        features = network.features(inputs.to(device, inner)) - rest
        return features.double().cpu(), s, rest.double().cpu()

    features, s, rest = draw()
    weight = 1 / s.norm(dim=1, keepdim=True).clamp(min=SMALLEST_STRAIN / 10)
    rows = weight * features
    ridge = 1e-10 * rows.square().sum() / rows.shape[1]
    normal = rows.T @ rows + ridge * torch.eye(rows.shape[1], dtype=rows.dtype)
    solution = torch.linalg.solve(normal, rows.T @ (weight * s))  # (hidden, 6)
    network[-1].weight.copy_(solution.T)
    network[-1].bias.copy_(-(rest @ solution)[0])
    features, s, _ = draw()
    error = (features @ solution - s).norm(dim=1) / s.norm(dim=1).clamp(min=SMALLEST_STRAIN / 10)
    return float(error.square().mean().sqrt())
