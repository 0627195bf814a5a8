"""How much memory a rollout may take between its forward and its backward pass."""

import torch

from mosa.physics.engine.numerics import Numerics
from mosa.system.limits import machine_memory

KEPT_SHARE = 0.25
"""Of a GPU's free memory, for the states of all substeps of a rollout, where that is enough for them."""
KEPT_ON_CPU = 2**30
"""Bytes, for the same on a CPU: 4000 particles in 20 000 nodes over 900 substeps."""


def substep_bytes(numerics: Numerics, particles: int) -> int:
    """What the backward pass reads of a substep: 33 numbers a particle (42 where the law yields) and 8 a node, of which there is
    about one a particle."""
    return particles * (50 if numerics.law.plastic else 41) * torch.finfo(numerics.dtype).bits // 8


def free_memory(device: torch.device) -> int:
    """Bytes of a GPU that torch can still allocate."""
    free = torch.cuda.mem_get_info(device)[0]
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def room(device: torch.device, wanted: int, worlds: int = 1, idle: int = 0) -> float:
    """Bytes that a rollout which could use `wanted` may keep between the passes: on a GPU all or nothing, so that a long rollout of
    many particles stays small; on a CPU as much for each of its worlds as a rollout of one, within a share of the memory. idle:
    bytes of such states that the last rollout has left for the next."""
    if device.type != "cuda":
        return (
            KEPT_ON_CPU if worlds == 1 else min(worlds * KEPT_ON_CPU, KEPT_SHARE * machine_memory())
        )
    available = KEPT_SHARE * (free_memory(device) + idle)
    return available if wanted < available else 0
