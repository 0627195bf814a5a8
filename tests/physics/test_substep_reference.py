"""The Warp simulator against its pure torch twin, value and gradient."""

from dataclasses import replace

import pytest
import substep_reference as reference
import torch

from mosa.errors import ConfigError
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator

MU, LAM, DENSITY, DX, DT = 4e4, 6e4, 1000.0, 0.04, 4e-4
EXTRA = {
    "von_mises": {"yield_stress": 2e3},
    "drucker_prager": {"friction_alpha": 0.3, "cohesion": 0.01},
}
PLANES = [
    Plane((0, 0.02, 0), (0, 1, 0), "separate", 0.4),
    Plane((0.08, 0, 0), (1, 0, 0), "slip"),
    Plane((0, 0, 0), (0, 1, 0)),
]


@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize(
    "law",
    ["linear", "neo_hookean", "corotated", "stvk", "stvk_paper", "von_mises", "drucker_prager"],
)
def test_twin(law, adapted, make_block):
    state = make_block(velocity=(0.5, -1.0, 0.2))
    if (
        law == "drucker_prager"
    ):  # compressed: the tip leaves equal singular values, where the twin has no gradient
        state = replace(state, F=0.94 * state.F)
    twin_parameters = {"reference": reference.polar(state.F)} if law == "linear" else {}
    reference.assert_simulated(
        law, state, {"mu": MU, "lam": LAM, **EXTRA.get(law, {})}, twin_parameters=twin_parameters,
        operator=reference.drawn_operator(len(state.x)) if adapted else None,
        density=DENSITY, dx=DX, dt=DT, gravity=(0.3, -9.8, 0.0), planes=PLANES,
    )  # fmt: skip


def test_densities_per_particle(make_block):
    """Halves of 300 and 3000 kg/m^3: the twin's motion, and the motion that a number gives where all densities are that number."""
    state = make_block(velocity=(0.5, -1.0, 0.2))
    n, steps = len(state.x), 4
    volume = torch.full((n,), 0.02**3, dtype=torch.float64)
    parameters = {
        "mu": torch.tensor(MU, dtype=torch.float64),
        "lam": torch.tensor(LAM, dtype=torch.float64),
    }
    halves = torch.where(state.x[:, 0] > state.x[:, 0].median(), 300.0, 3000.0).double()
    sim = Simulator(
        "neo_hookean",
        dx=DX,
        substeps=steps,
        frame_dt=steps * DT,
        planes=PLANES,
        dtype=torch.float64,
    )

    def final(density):
        return sim.rollout(state, parameters, volume, density, 2, started=True).final

    twin = state
    for _ in range(steps):
        twin = reference.substep("neo_hookean", twin, parameters, volume, halves, dx=DX, dt=DT, gravity=(0.0, -9.8, 0.0),
                                 planes=PLANES)  # fmt: skip
    for name in ("x", "v", "C_affine", "F"):
        value, expected = getattr(final(halves), name), getattr(twin, name)
        assert (value - expected).abs().max() < 1e-12 * steps * max(
            1.0, float(expected.abs().max())
        ), name
    assert torch.equal(final(torch.full((n,), DENSITY, dtype=torch.float64)).x, final(DENSITY).x)
    assert (final(halves).v - final(DENSITY).v).abs().max() > 1e-3


@pytest.mark.parametrize("density, message", [
    (0.0, "positive number"), (torch.ones(3), "expected a number or shape"), (torch.tensor(float("nan")), "positive number"),
    (None, "for all particles"),
])  # fmt: skip
def test_a_density_that_cannot_be(density, message, make_block):
    state = make_block()
    volume = torch.full((len(state.x),), 0.02**3, dtype=torch.float64)
    sim = Simulator("neo_hookean", dx=DX, substeps=4, frame_dt=4 * DT, dtype=torch.float64)
    with pytest.raises(ConfigError, match=message):
        sim.rollout(
            state, {"mu": MU, "lam": LAM}, volume, -volume if density is None else density, 2
        )
