"""The corrected law in the world: symmetric and frame indifferent for all weights (checks 4 and 5 of docs/verification.md)."""

import pytest
import substep_reference as reference
import torch
from drawn_adapters import E_REF, drawn_adapter, randomise

from mosa.baselines.direct import DirectAdapter
from mosa.modules.body.material import material_states
from mosa.physics.adapters.interface import MaterialState

MU, LAM = 0.8e5, 1.1e5
LAWS = {"neo_hookean": {}, "corotated": {}, "stvk": {}, "von_mises": {"yield_stress": 5e3},
        "drucker_prager": {"friction_alpha": 0.3, "cohesion": 0.0}}  # fmt: skip


def rotations(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    Q = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    return Q * torch.linalg.det(Q)[:, None, None]


def deformations(count: int, seed: int) -> torch.Tensor:
    """F with stretches between 0.4 and 2.5."""
    generator = torch.Generator().manual_seed(seed)
    S = torch.exp(0.9 * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1))
    return rotations(count, seed + 1) @ torch.diag_embed(S) @ rotations(count, seed + 2)


def corrected_stress(adapter, law: str, F: torch.Tensor, frame: str = "material") -> torch.Tensor:
    """tau_hat (N, 3, 3) [Pa] of the paper's eq. 3; frame `world` leaves the rotation out (the negative control)."""
    p = {"mu": torch.tensor(MU).double(), "lam": torch.tensor(LAM).double()}
    R = reference.polar(F) if frame == "material" else torch.eye(3).double().expand_as(F)
    W = reference.polar(F).mT @ F
    tau = reference.stress(law, F, p)
    s = reference.vech(R.mT @ tau @ R)
    answer = adapter(MaterialState(reference.vech(W - reference.EYE), s))
    return tau + R @ reference.unvech((answer.G @ s[..., None])[..., 0] + answer.h) @ R.mT


def direct() -> DirectAdapter:
    adapter = DirectAdapter().double()
    randomise(adapter)
    adapter.switch_on(E_REF)
    return adapter


KINDS = {
    "full": lambda: drawn_adapter(),
    "literal": lambda: drawn_adapter(l_max=None, rest_free=False),
    "major symmetry": lambda: drawn_adapter(major_symmetry=True),
    "constant": lambda: drawn_adapter(state_dependence="constant"),
    "no prior stress": lambda: drawn_adapter(no_prior_stress=True),
    "direct": direct,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", ["neo_hookean", "corotated", "stvk"])
def test_corrected_stress_is_symmetric_and_turns_with_the_body(kind, law):
    adapter, Q, F = KINDS[kind](), rotations(200, 1), deformations(200, 10)
    tau = corrected_stress(adapter, law, F)
    scale = tau.abs().max()
    assert (tau - tau.mT).abs().max() <= 1e-13 * scale
    prior = reference.stress(law, F, {"mu": torch.tensor(MU), "lam": torch.tensor(LAM)})
    assert (tau - prior).abs().max() > 1e-2 * E_REF  # there is something to turn
    turned = corrected_stress(adapter, law, Q @ F)
    assert (turned - Q @ tau @ Q.mT).abs().max() <= 1e-12 * scale


def test_a_correction_in_the_world_frame_would_not_turn_with_the_body():
    adapter, Q, F = drawn_adapter(), rotations(200, 1), deformations(200, 10)
    tau, turned = (corrected_stress(adapter, "neo_hookean", X, frame="world") for X in (F, Q @ F))
    assert (turned - Q @ tau @ Q.mT).abs().max() > 1e-2 * tau.abs().max()


def test_a_direction_of_the_material_stays_in_the_material():
    """Two stretches of equal size along different material axes give different stress: the correction is anisotropic."""
    adapter, Q = drawn_adapter(), rotations(1, 3)
    F = torch.diag_embed(torch.tensor([[1.2, 1.0, 1.0]], dtype=torch.float64))
    turned_material = corrected_stress(
        adapter, "neo_hookean", F @ Q
    )  # the body was turned before it was stretched
    prior = reference.stress("neo_hookean", F, {"mu": torch.tensor(MU), "lam": torch.tensor(LAM)})
    assert (
        turned_material - corrected_stress(adapter, "neo_hookean", F)
    ).abs().max() > 1e-2 * prior.abs().max()


@pytest.mark.parametrize("law", LAWS)
def test_what_the_simulator_hands_over_is_the_material_frame(law):
    """`material_states` against the torch twin, and unchanged by a rotation in front."""
    states = material_states(law, {"mu": MU, "lam": LAM, **LAWS[law]})
    F, Q = deformations(50, 20), rotations(50, 4)
    state, turned = states(F), states(Q @ F)
    R = reference.polar(F)
    tau = reference.stress(law, F, {"mu": torch.tensor(MU), "lam": torch.tensor(LAM)})
    expected = [reference.vech(R.mT @ F - reference.EYE), reference.vech(R.mT @ tau @ R)]
    if "yield_stress" in LAWS[law] or "cohesion" in LAWS[law]:
        expected.append(reference.vech(reference.deviator(reference.hencky_material(F))))
    else:
        assert state.plastic_strain is None
    for mine, theirs, again in zip(state, expected, turned):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-11 * float(theirs.abs().max()))
        torch.testing.assert_close(again, mine, rtol=0, atol=1e-11 * float(theirs.abs().max()))
