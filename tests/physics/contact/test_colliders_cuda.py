"""Colliders on CUDA against CPU: motion, reactions and gradients, through captured graphs."""

import pytest
import torch

from mosa.physics.contact.colliders import Box, Capsule, Collider, Cylinder, HalfSpace, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

pytestmark = pytest.mark.gpu
SHAPES = [
    HalfSpace(),
    Sphere(0.12),
    Capsule(0.07, 0.15),
    Cylinder(0.09, 0.3),
    Box((0.3, 0.1, 0.25)),
]


def run(state, shape, device, dtype):
    names = ("x", "v", "C_affine", "F", "F_tot")
    state = ParticleState(*(getattr(state, name).to(device=device, dtype=dtype) for name in names))
    velocity = torch.tensor([0.2, 0.6, 0.0], device=device, dtype=dtype, requires_grad=True)
    rotation = torch.tensor(
        [0.2 - torch.pi / 2, -0.1, 0.3], device=device, dtype=dtype, requires_grad=True
    )
    mu = torch.full((), 4e4, device=device, dtype=dtype, requires_grad=True)
    height = (
        0.0 if isinstance(shape, HalfSpace) else -0.05
    )  # of a plane that reaches the block, or of a solid's middle
    motion = Motion((0.15, height, 0.11), rotation, velocity, (1.0, 0.0, 2.0))
    colliders = [
        Collider(shape, "separate", 0.3, motion),
        Collider(Sphere(0.05), "slip", motion=Motion((0.15, 0.13, 0.1))),
    ]
    simulator = Simulator(
        "corotated",
        dx=0.04,
        substeps=10,
        frame_dt=4e-3,
        dtype=dtype,
        device=device,
        colliders=colliders,
    )
    volume = torch.full((len(state.x),), 8e-6, device=device, dtype=dtype)
    result = simulator.rollout(
        state, {"mu": mu, "lam": 5e4}, volume, 1000.0, 4
    )  # the third segment replays a graph
    loss = (result.x**2).sum() + 1e-3 * result.reactions.sum()
    gradients = torch.autograd.grad(loss, [velocity, rotation, mu])
    return [t.detach().cpu().double() for t in (result.x, result.F, result.reactions, *gradients)]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_cuda_against_cpu(shape, make_block):
    state = make_block(n=6, velocity=(0.0, -0.8, 0.0))
    results = [run(state, shape, device, torch.float64) for device in ("cuda", "cpu")]
    assert float(results[1][2][..., :3].norm(dim=-1).amax((0, 1)).min()) > 1
    for found, expected in zip(*results):
        assert (found - expected).abs().max() <= 1e-9 * max(1.0, float(expected.abs().max()))
