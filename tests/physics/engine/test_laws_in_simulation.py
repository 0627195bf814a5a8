"""Laws that flow at a rate, inside the simulator: against the torch twin, against differences, in both precisions."""

from dataclasses import replace

import pytest
import substep_reference as reference
import torch

from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

DENSITY, DX, DT = 1000.0, 0.04, 4e-4
RATE = {"mu": 3e4, "kappa": 8e4, "yield_stress": 1.5e3, "viscosity": 8.0}
PARAMETERS = {
    "herschel_bulkley": RATE,
    "herschel_bulkley_hencky": RATE,
    "newtonian": {"mu": 20.0, "kappa": 5e4},
}
PLANES = [Plane((0, 0.02, 0), (0, 1, 0), "separate", 0.4)]


def start(state, law):
    """A fluid starts from F = J^(1/3) R."""
    if law != "newtonian":
        return state
    F = torch.linalg.det(state.F)[:, None, None] ** (1 / 3) * reference.polar(state.F)
    return replace(state, F=F, F_tot=F)


def leaves_of(law):
    return {
        k: torch.tensor(v, dtype=torch.float64, requires_grad=True)
        for k, v in PARAMETERS[law].items()
    }


@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize("law", PARAMETERS)
def test_twin(law, adapted, make_block):
    state = start(make_block(velocity=(0.5, -1.0, 0.2)), law)
    reference.assert_simulated(
        law, state, PARAMETERS[law], operator=reference.drawn_operator(len(state.x)) if adapted else None,
        density=DENSITY, dx=DX, dt=DT, gravity=(0.0, -9.8, 0.0), planes=PLANES,
    )  # fmt: skip


def rolled(law, state, parameters, dtype=torch.float64, substeps=50):
    state = ParticleState(
        *(getattr(state, k).to(dtype) for k in ("x", "v", "C_affine", "F", "F_tot"))
    )
    sim = Simulator(
        law, dx=DX, substeps=substeps, frame_dt=substeps * DT, planes=PLANES, dtype=dtype
    )
    volume = torch.full((len(state.x),), 0.02**3, dtype=dtype)
    return sim.rollout(state, {k: p.to(dtype) for k, p in parameters.items()}, volume, DENSITY, 2)


@pytest.mark.parametrize("law", PARAMETERS)
def test_gradient_over_50_substeps_in_contact(law, make_block):
    """Against central differences, to max(1e-5, 10 x the disagreement of two steps) (verification 18); float32 to 1e-3 (19)."""
    state = start(make_block(), law)
    generator = torch.Generator().manual_seed(5)
    wx, wv = (
        torch.randn(state.x.shape, generator=generator, dtype=torch.float64) for _ in range(2)
    )

    def loss(parameters, shift, dtype=torch.float64):
        rollout = rolled(law, replace(state, v=state.v + shift), parameters, dtype)
        return (wx * rollout.x[-1]).sum() + (wv * rollout.v[-1]).sum()

    leaves = {**leaves_of(law), "v": torch.zeros(3, dtype=torch.float64, requires_grad=True)}

    def gradients(dtype):
        total = loss({k: v for k, v in leaves.items() if k != "v"}, leaves["v"], dtype)
        return dict(zip(leaves, torch.autograd.grad(total, list(leaves.values()))))

    found, single = gradients(torch.float64), gradients(torch.float32)
    direction = torch.tensor([0.4, -0.8, 0.45]).double()

    def difference(name, h):
        def shifted(s):
            values = {k: v.detach() for k, v in leaves.items()}
            values[name] = values[name] + s * (direction if name == "v" else values[name])
            with torch.no_grad():
                return loss({k: v for k, v in values.items() if k != "v"}, values["v"])

        return float((shifted(h) - shifted(-h)) / (2 * h))

    for name, leaf in leaves.items():
        along = direction if name == "v" else leaf.detach()
        value, other = (
            float((found[name] * along).sum()),
            float((single[name].double() * along).sum()),
        )
        fine, coarse = difference(name, 1e-6), difference(name, 1e-5)
        tolerance = max(1e-5, 10 * abs(fine - coarse) / abs(fine))
        assert tolerance < 1e-2, (name, fine, coarse)
        assert abs(value - fine) < tolerance * abs(fine), (name, value, fine, coarse)
        assert abs(value - other) < 1e-3 * abs(value), (name, value, other)
