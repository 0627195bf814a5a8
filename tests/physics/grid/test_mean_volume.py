"""The mean change of volume in the stress: its average, gradients, launches, objectivity, and what it does to a beam."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import law_named
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.law_options import AS_USUAL, LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.engine.workspace import Workspace
from mosa.physics.grid.mean_volume import OWN, OWN_FLUID, SPREAD
from mosa.types import ParticleState

MEAN = LawOptions(mean_volume=True)
DX, DT, DENSITY = 0.04, 2e-4, 1000.0
PARAMETERS = {
    "neo_hookean": {"mu": 4e4, "lam": 6e5},
    "herschel_bulkley_hencky": {"mu": 4e4, "kappa": 5e5, "yield_stress": 2e3, "viscosity": 10.0},
    "newtonian": {"mu": 20.0, "kappa": 2e5},
}


def volumes(state):
    """Of different sizes, which are the weights of the average."""
    n = len(state.x)
    return 8e-6 * (1 + 0.5 * torch.rand(n, generator=torch.Generator().manual_seed(2)).double())


def simulator(law, substeps=10, options=MEAN, **others):
    return Simulator(law, dx=DX, substeps=substeps, frame_dt=substeps * DT, dtype=torch.float64, options=options,
                     **others)  # fmt: skip


def rolled(sim, state, parameters, frames=2, volume=None):
    volume = volumes(state) if volume is None else volume
    return sim.rollout(state, parameters, volume, DENSITY, frames, started=True).final


@pytest.mark.parametrize("law", ["neo_hookean", "newtonian"])
def test_the_average_is_that_of_hat_functions(law, make_block):
    """All pairs of particles and nodes, one by one."""
    state, values = make_block(jitter=0.4), PARAMETERS[law]
    n, volume, spacing = len(state.x), volumes(state), SPREAD * DX
    nodes = torch.cartesian_prod(*(torch.arange(-1, 9).double() * spacing,) * 3)
    away = (state.x[:, None] - nodes).abs() / spacing
    weights = (1 - away).clamp(min=0).prod(-1)
    J, share = torch.linalg.det(state.F), 1 - OWN_FLUID
    below = weights.T @ volume
    q = torch.where(below > 0, (weights.T @ (volume * (J - 1))) / below.clamp(min=1e-30), 0.0)
    if law == "neo_hookean":
        share = 1 - OWN * values["mu"] / (values["lam"] + 2 / 3 * values["mu"])
    expected = ((1 + weights @ q) / J)[:, None, None] ** (share / 3) * state.F

    sim = simulator(law)
    work = Workspace(sim.numerics, n, 1, adapted=False, plastic_adapted=False, with_adjoint=False)
    packed = sim.pack({k: torch.tensor(v).double() for k, v in values.items()}, n)
    work.set_window(np.array([-1, -2, -2]), np.array([14, 13, 15]))
    work.load(
        (state.x, state.v, state.C_affine, state.F, state.F),
        {"parameters": packed},
        volume,
        volume,
        0.0,
    )
    found = wp.to_torch(work._averaged(0)).view(n, 3, 3)
    assert (found - expected).abs().max() < 1e-13
    assert (expected - state.F).abs().max() > 1e-3


@pytest.mark.parametrize("law", PARAMETERS)
def test_gradients_are_those_of_differences(law, make_block):
    state = make_block()
    if law == "newtonian":  # a fluid's F is a number times a rotation
        F = torch.linalg.det(state.F)[:, None, None] ** (1 / 3) * torch.eye(3).double()
        state = replace(state, F=F, F_tot=F)
    g = torch.Generator().manual_seed(1)
    probes = {
        k: torch.randn(getattr(state, k).shape, generator=g).double() for k in ("x", "v", "F_tot")
    }
    leaves = {"x": state.x, "v": state.v, "C_affine": state.C_affine, "F": state.F}
    leaves |= {k: torch.tensor(v).double() for k, v in PARAMETERS[law].items()}
    leaves = {k: t.clone().requires_grad_() for k, t in leaves.items()}
    sim = simulator(law)

    def loss(leaves):
        start = ParticleState(*(leaves[k] for k in ("x", "v", "C_affine", "F", "F")))
        final = rolled(sim, start, {k: leaves[k] for k in PARAMETERS[law]})
        return sum((probe * getattr(final, k)).sum() for k, probe in probes.items())

    found = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values()))))
    steps = {"x": 1e-7, "v": 1e-3, "C_affine": 1e-2, "F": 1e-6}
    for name, leaf in leaves.items():
        direction = torch.randn(leaf.shape, generator=g, dtype=torch.float64)
        h = steps.get(name, 1e-4 * float(leaf.detach().abs().max()))
        with torch.no_grad():
            at = [float(loss({**leaves, name: leaf + s * h * direction})) for s in (1, -1, 2, -2)]
        difference = (8 * (at[0] - at[1]) - at[2] + at[3]) / (12 * h)
        assert float((found[name] * direction).sum()) == pytest.approx(difference, rel=1e-5), name


def test_it_launches_nothing_unless_it_is_wanted(make_block, monkeypatch):
    names, run = [], Workspace.run

    def counted(self, kernel, *arguments):
        names.append(kernel.key)
        run(self, kernel, *arguments)

    monkeypatch.setattr(Workspace, "run", counted)
    launched = {}
    for options in (AS_USUAL, MEAN):
        names.clear()
        rolled(simulator("neo_hookean", 1, options), make_block(), PARAMETERS["neo_hookean"])
        launched[options] = [name.split("__locals__")[-1] for name in names]
    usual, more = launched[AS_USUAL], launched[MEAN]
    assert usual == ["clear", "stress_of_particles", "p2g", "grid_update", "g2p"]
    assert more == ["clear", "clear", "collect", "average", *usual[1:]]


def test_a_compressible_body_moves_as_without_it(make_block):
    """All of a bulk modulus below `OWN` shear moduli is the particle's own."""
    values = {"mu": 4e4, "lam": 5e4}
    ends = [
        rolled(simulator("neo_hookean", options=o), make_block(), values) for o in (MEAN, AS_USUAL)
    ]
    assert (ends[0].x - ends[1].x).abs().max() < 1e-14
    assert (ends[0].F - ends[1].F).abs().max() < 1e-13


@pytest.mark.parametrize("law", ["corotated", "newtonian"])
def test_a_turned_scene_moves_as_the_other(law, make_block):
    """By 90 degrees about an edge of the grid, with the ground and gravity."""
    values = PARAMETERS.get(law, PARAMETERS["neo_hookean"])
    Q = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).double()
    state, down = make_block(), torch.tensor([0.0, -9.8, 0.0]).double()
    turned = ParticleState(
        state.x @ Q.T, state.v @ Q.T, Q @ state.C_affine @ Q.T, Q @ state.F, Q @ state.F
    )
    ends = []
    for each, axis in ((state, torch.eye(3).double()), (turned, Q)):
        plane = Plane((0.0, 0.0, 0.0), tuple((axis @ -down / 9.8).tolist()), "sticky")
        sim = simulator(law, 50, planes=[plane], gravity=axis @ down)
        ends.append(rolled(sim, each, values))
    assert (ends[0].x @ Q.T - ends[1].x).abs().max() < 1e-10 * DX
    assert (Q @ ends[0].F - ends[1].F).abs().max() < 1e-9


def test_worlds_and_precisions_agree(make_block):
    """Two worlds at once against each alone; float32 against float64."""
    states = [make_block(seed=seed) for seed in (0, 1)]
    values, volume = PARAMETERS["neo_hookean"], volumes(states[0])
    both = ParticleState(*(torch.stack([getattr(s, k) for s in states]) for k in
                           ("x", "v", "C_affine", "F", "F_tot")))  # fmt: skip
    together = simulator("neo_hookean").rollout(
        both, values, volume, DENSITY, 2, started=True, together=2
    )
    for k, state in enumerate(states):
        alone = rolled(simulator("neo_hookean"), state, values, volume=volume)
        assert (together.final.x[k] - alone.x).abs().max() < 1e-14
        low = ParticleState(
            *(getattr(state, name).float() for name in ("x", "v", "C_affine", "F", "F_tot"))
        )
        single = Simulator("neo_hookean", dx=DX, substeps=10, frame_dt=10 * DT, options=MEAN)
        found = rolled(single, low, values, volume=volume.float())
        assert (found.x.double() - alone.x).abs().max() < 1e-6


@pytest.mark.parametrize("law", ["drucker_prager", "neo_hookean+newtonian"])
def test_laws_whose_volume_is_each_particles_own_are_refused(law):
    with pytest.raises(ConfigError, match=r"mean_volume.*leave it out"):
        simulator(law)


def test_an_adapter_that_reads_the_state_is_refused(make_block):
    state = make_block()
    with pytest.raises(ConfigError, match=r"mean_volume.*adapter=operator"):
        simulator("neo_hookean").rollout(
            state, PARAMETERS["neo_hookean"], volumes(state), DENSITY, 2, adapter=lambda state: None
        )


def test_places_of_moduli():
    assert law_named("neo_hookean").moduli_slots[:2] == (0, 1)
    assert law_named("herschel_bulkley").moduli_slots[::2] == (0, 1)
    assert law_named("newtonian").moduli_slots == (-1, -1, -1)
    assert math.isclose(OWN * (1 - 2 * 2 / 7) * 1.5, 1 + 2 / 7)  # kappa = OWN mu at nu = 2/7
