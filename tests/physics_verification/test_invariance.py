"""Check 17 of verification.md with the full adapter: the scene turned by 90 degrees (F_0 = Q), the scene moved by whole cells.

tests/physics/test_rollout.py does both at once with a linear operator.
"""

import pytest
import torch
from bodies import DENSITY, LAWS, agitated, parameters_of, random_adapter, uniform_volume

from mosa.physics.rollout import Simulator
from mosa.types import Ground, ParticleState

DX, SPACING = 0.04, 0.02
TURN = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()
EYE = torch.eye(3).double()


def run(law: str, Q: torch.Tensor, shift: torch.Tensor):
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
        return sim.rollout(start, parameters_of(law), uniform_volume(start, SPACING), DENSITY, 3, adapter=adapter, stride=5)


@pytest.mark.parametrize("law", LAWS)
def test_17_turned_by_90_degrees_and_moved_by_whole_cells(law):
    """x -> Q x + d, F -> Q F: the grid maps onto itself, so only rounding differs (1e-10 dx)."""
    shift = DX * torch.tensor([3.0, -2.0, 5.0]).double()
    plain = run(law, EYE, 0 * shift)
    for Q, d in ((TURN, 0 * shift), (EYE, shift)):
        other = run(law, Q, d)
        assert (other.x[-1] - (plain.x[-1] @ Q.T + d)).abs().max() < 1e-10 * DX
        assert (other.F_tot[-1] - Q @ plain.F_tot[-1]).abs().max() < 1e-9
    assert float(plain.v[-1][:, 1].mean()) > -0.9  # slowed by the ground: 1.4 m/s in free fall
    assert float((plain.F_tot[-1] - EYE).abs().max()) > 1e-2
