"""Bodies of different laws in one grid."""

import pytest
import torch

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import law_named, law_names
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

LAWS = ["corotated", "drucker_prager", "newtonian"]
MIXTURE = "+".join(LAWS)
OWN = {
    "corotated": {"mu": 3e4, "lam": 4e4},
    "drucker_prager": {"mu": 4e4, "lam": 6e4, "friction_alpha": 0.3, "cohesion": 0.002},
    "newtonian": {"mu": 20.0, "kappa": 5e4},
}
STEPS = 40
FIELDS = ("x", "v", "C_affine", "F", "F_tot")


def simulator(law):
    return Simulator(law, dx=0.04, substeps=STEPS, frame_dt=STEPS * 4e-4, dtype=torch.float64)


def merged(parts, gap):
    """One state of several bodies side by side, a whole number of cells apart."""
    shifted = []
    for i, part in enumerate(parts):
        shifted.append({name: getattr(part, name) for name in FIELDS})
        shifted[-1]["x"] = part.x + torch.tensor([i * gap, 0.0, 0.0], dtype=torch.float64)
    return ParticleState(*(torch.cat([s[name] for s in shifted]) for name in FIELDS))


def packed(counts, values, order=LAWS):
    """Parameters of the mixture: each body its own values, NaN where its law takes none."""
    names = sorted({name for law in order for name in values[law]})
    result = {}
    for name in names:
        columns = [values[law].get(name, torch.tensor(float("nan"))) for law in LAWS]
        result[name] = torch.cat(
            [torch.as_tensor(c).double().expand(n) for c, n in zip(columns, counts)]
        )
    result["law"] = torch.cat(
        [torch.full((n,), float(order.index(law))).double() for law, n in zip(LAWS, counts)]
    )
    return result


@pytest.fixture
def bodies(make_block):
    blocks = [make_block(seed=i, velocity=(0.1, -1.0 - i, 0.2)) for i in range(3)]
    return blocks


def test_distant_bodies_move_as_alone_with_their_gradients(bodies):
    counts = [len(b.x) for b in bodies]
    leaves = {
        law: {k: torch.tensor(v).double().requires_grad_() for k, v in OWN[law].items()}
        for law in LAWS
    }
    flat = [p for law in LAWS for p in leaves[law].values()]
    together = merged(bodies, gap=25 * 0.04)
    volume = torch.full((sum(counts),), 0.02**3, dtype=torch.float64)
    weights = torch.randn(sum(counts), 3, generator=torch.Generator().manual_seed(0)).double()
    rollout = simulator(MIXTURE).rollout(together, packed(counts, leaves), volume, 1000.0, 2)
    gradients = torch.autograd.grad((weights * rollout.x[-1]).sum(), flat)
    alone, expected = 0, []
    for i, law in enumerate(LAWS):
        part = merged([bodies[i]], 0.0)
        part = ParticleState(
            together.x[alone : alone + counts[i]], part.v, part.C_affine, part.F, part.F_tot
        )
        single = simulator(law).rollout(part, leaves[law], volume[: counts[i]], 1000.0, 2)
        for name in ("x", "v", "F", "F_tot"):
            found = getattr(rollout, name)[-1, alone : alone + counts[i]]
            assert (found - getattr(single, name)[-1]).abs().max() < 1e-12, (law, name)
        loss = (weights[alone : alone + counts[i]] * single.x[-1]).sum()
        expected += torch.autograd.grad(loss, list(leaves[law].values()))
        alone += counts[i]
    for found, value in zip(gradients, expected):
        torch.testing.assert_close(found, value, rtol=1e-9, atol=1e-20)
    assert all(float(g.abs()) > 0 for g in gradients)


def test_the_order_of_the_names_is_only_a_numbering(bodies):
    counts = [len(b.x) for b in bodies]
    together, volume = (
        merged(bodies, gap=0.08),
        torch.full((sum(counts),), 0.02**3, dtype=torch.float64),
    )
    results = []
    for order in (LAWS, LAWS[::-1]):
        p = packed(counts, OWN, order)
        results.append(simulator("+".join(order)).rollout(together, p, volume, 1000.0, 2).x[-1])
    assert torch.equal(*results)


def test_touching_bodies_exchange_momentum_and_lose_none(make_block):
    left, right = (
        make_block(seed=0, velocity=(1.0, 0.0, 0.0)),
        make_block(seed=1, velocity=(-1.0, 0.0, 0.0)),
    )
    law = "stvk+von_mises"
    sim = Simulator(
        law, dx=0.04, substeps=200, frame_dt=0.04, dtype=torch.float64, gravity=(0, 0, 0)
    )
    state = merged([left, right], gap=0.085)
    n = len(left.x)
    p = {
        "mu": 3e4,
        "lam": 4e4,
        "yield_stress": 500.0,
        "law": torch.arange(2).repeat_interleave(n).double(),
    }
    rollout = sim.rollout(state, p, torch.full((2 * n,), 0.02**3, dtype=torch.float64), 1000.0, 2)
    before, after = state.v.sum(0), rollout.v[-1].sum(0)
    assert (before - after).abs().max() < 1e-12 * state.v.norm(dim=1).sum()
    assert (rollout.v[-1, :n].sum(0) - state.v[:n].sum(0)).norm() > 0.1 * state.v[:n].sum(0).norm()
    plastic = (rollout.F[-1] - rollout.F_tot[-1]).abs().amax((1, 2))
    assert (
        plastic[:n].max() < 1e-13 and plastic[n:].max() > 1e-2
    )  # the elastic one keeps no plastic strain


def test_registration():
    law = law_named("neo_hookean+linear")
    assert (
        law.parameters == {"mu": 1, "lam": 1, "reference": 9, "law": 1}
        and law.reference == "reference"
    )
    assert law.needs_positive_J and not law.plastic and law_named("neo_hookean+linear") is law
    assert not any("+" in name for name in law_names())
    modulus = law_named(MIXTURE).wave_modulus(packed([1, 1, 1], OWN))
    assert modulus.tolist() == [10e4, 14e4, 35e4]
    with pytest.raises(ConfigError, match="at most 12"):
        law_named("linear+von_mises")
    with pytest.raises(ConfigError, match="found 'jelly'"):
        law_named("stvk+jelly")
