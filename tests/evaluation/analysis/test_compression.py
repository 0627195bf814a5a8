"""A specimen between plates answers with Young's modulus of its law in the direction it is pressed in."""

import pytest
import torch

from mosa.data.synthetic.bodies.objects import CYLINDER
from mosa.evaluation.analysis.anisotropy import directional_modulus, directions_in_plane
from mosa.evaluation.analysis.compression import press, rotation_to
from mosa.evaluation.analysis.stiffness import directional_moduli
from mosa.modules.adapters.hyperelastic import NUMBERS, HyperelasticAdapter
from mosa.modules.body.material import Material, material_states

E, NU = 2e5, 0.3


def test_a_direction_is_turned_to_the_axis():
    for n in ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, -0.8, 0.0], [0.48, 0.6, -0.64]):
        Q = rotation_to(torch.tensor(n))
        torch.testing.assert_close(
            Q @ torch.tensor(n).double(), torch.tensor([0.0, 0.0, 1.0]).double(), rtol=0, atol=1e-6
        )
        torch.testing.assert_close(Q @ Q.T, torch.eye(3).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("law", ["neo_hookean", "corotated"])
def test_an_isotropic_law_has_its_modulus(law):
    found = press(
        law,
        Material(law, {"E": E, "nu": NU}).per_particle(),
        torch.tensor([0.3, 0.5, 0.8]),
        modulus=E,
        poisson=NU,
    )
    assert found.modulus == pytest.approx(E, rel=0.015)
    assert found.force.shape == found.strain.shape and float(found.strain[-1]) == pytest.approx(
        0.05, abs=0.01
    )


def test_a_material_with_fibres_has_its_modulus_in_every_direction():
    one = {k: (v[0] if v.ndim else v) for k, v in CYLINDER.parameters(torch.zeros(1, 3)).items()}
    _, n = directions_in_plane(CYLINDER.fibre, (0.0, 1.0, 0.0), 5)
    expected = directional_modulus(material_states(CYLINDER.law, one), None, n)
    assert expected[0] > 1.7 * expected[2]
    for direction, modulus in zip(n[:4], expected):
        found = press(
            CYLINDER.law,
            one,
            direction,
            modulus=CYLINDER.wave_modulus(),
            poisson=NU,
            stiffening=1.0,
        )
        assert found.modulus == pytest.approx(float(modulus), rel=0.015)


def test_a_learned_stiffness_has_its_modulus():
    material = Material("neo_hookean", {"E": E, "nu": NU})
    adapter = HyperelasticAdapter()
    adapter.switch_on(E, NU)
    with torch.no_grad():
        adapter.numbers.copy_(
            0.15 * torch.randn(NUMBERS, generator=torch.Generator().manual_seed(2))
        )
    _, n = directions_in_plane((1, 0, 0), (0, 1, 0), 3)
    expected = directional_moduli(
        2 * material.per_particle()["mu"].detach().double() * adapter.stiffness().detach(), n
    )
    assert (expected[0] / expected[1] - 1).abs() > 0.05
    for direction, modulus in zip(n[:2], expected):
        found = press(
            "neo_hookean",
            material.per_particle(),
            direction,
            modulus=E,
            poisson=NU,
            adapter=adapter,
        )
        # between plates the ends stay flat, which holds back the shear that a general anisotropy would add
        assert found.modulus == pytest.approx(float(modulus), rel=0.05)
