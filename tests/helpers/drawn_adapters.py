"""Adapters with random weights and random states, for the tests of this folder."""

import torch

from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.adapters.interface import MaterialState

E_REF = 2e5


def randomise(module: torch.nn.Module, size: float = 0.3, seed: int = 0) -> None:
    """Gaussian weights in place of all initial ones, the zeroed last layers included."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in module.parameters():
            p.copy_(size * torch.randn(p.shape, generator=generator, dtype=torch.float64))


def drawn_adapter(
    seed: int = 0, size: float = 0.3, dtype: torch.dtype = torch.float64, **options
) -> StressAdapter:
    adapter = StressAdapter(**options).to(dtype)
    randomise(adapter, size, seed)
    adapter.switch_on(E_REF, 0.3)
    return adapter


def drawn_states(
    count: int, seed: int = 0, size: float = 0.1, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, ...]:
    """(w, s), each (count, 6), dimensionless."""
    generator = torch.Generator().manual_seed(1000 + seed)
    return tuple(
        size * torch.randn(count, 6, generator=generator, dtype=torch.float64).to(dtype)
        for _ in range(2)
    )


def material_state(w: torch.Tensor, s: torch.Tensor) -> MaterialState:
    """What the simulator would hand over; half of w stands for the plastic strain."""
    return MaterialState(w, E_REF * s, 0.5 * w)
