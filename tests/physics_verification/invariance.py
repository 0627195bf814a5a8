"""Check 17: the scene turned by 90 degrees (F_0 = Q), or moved by whole cells, moves the same."""

import torch
from bodies import DENSITY, agitated, parameters_of, random_adapter, uniform_volume

from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState, Rollout

DX, SPACING = 0.04, 0.02
TURN = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()
EYE = torch.eye(3).double()
SHIFT = DX * torch.tensor([3.0, -2.0, 5.0]).double()


def run(law: str, Q: torch.Tensor, shift: torch.Tensor) -> Rollout:
    """200 substeps, through contact with the ground; gravity, ground and body turned by Q and moved by shift."""
    state = agitated(velocity=(0.3, -1.0, 0.1), origin=(0.11, 0.012, 0.07), strain=0.0, jitter=0.2)
    n = len(state.x)
    F = Q.expand(n, 3, 3).contiguous()  # undeformed: turned, not I
    start = ParticleState(state.x @ Q.T + shift, state.v @ Q.T, Q @ state.C_affine @ Q.T, F, F)
    up = Q @ torch.tensor([0.0, 1.0, 0.0]).double()
    sim = Simulator(law, dx=DX, substeps=100, frame_dt=0.02, gravity=-9.8 * up, up=up, dtype=torch.float64,
                    ground=Ground(float(shift @ up), "separate", 0.3))  # fmt: skip
    adapter = random_adapter(size=0.1, plastic=sim.law.plastic)
    with torch.no_grad():
        return sim.rollout(
            start,
            parameters_of(law),
            uniform_volume(start, SPACING),
            DENSITY,
            3,
            adapter=adapter,
            stride=5,
        )


def differences(law: str) -> tuple[Rollout, dict[str, tuple[float, float]]]:
    """The plain rollout; {turned, moved}: largest difference of x [dx] and of F_tot at its end. x -> Q x + d, F -> Q F."""
    plain, found = run(law, EYE, 0 * SHIFT), {}
    for name, Q, d in (("turned", TURN, 0 * SHIFT), ("moved", EYE, SHIFT)):
        other = run(law, Q, d)
        found[name] = (float((other.x[-1] - (plain.x[-1] @ Q.T + d)).abs().max()) / DX,
                       float((other.F_tot[-1] - Q @ plain.F_tot[-1]).abs().max()))  # fmt: skip
    return plain, found
