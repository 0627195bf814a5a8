"""Checks 12 and 14 to 16 of docs/verification.md: motions with a closed solution. Free fall (13) is here too, for every law."""

import itertools
import math

import pytest
import torch
from bodies import LAWS, PRECISIONS, is_fluid
from elastic_bodies import affine_motion, cantilever, column, free_fall, interior_force, wave
from elements_on_incline import released_elements
from incline import bounced, point_mass, released, slide, slip_angle
from locking import over_theory
from plates import squeezed

from mosa.physics.constitutive.laws import law_named

SOLIDS = [law for law in LAWS if not is_fluid(law)]


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", LAWS)
def test_12_affine_motion_is_reproduced(law, dtype):
    """v = a + B x is what APIC transfers exactly, on particles at random places: C_affine = B, F = I + dt B, x + dt v.

    Rounding: the sums of 27 terms, of C_affine times |v|/(dx |B|), which is about 100 here.
    """
    eps = torch.finfo(dtype).eps
    errors = affine_motion(law, dtype)
    assert max(errors["v"], errors["x"], errors["F_tot"]) < 20 * eps
    assert errors["C_affine"] < 1000 * eps < (1e-12 if dtype == torch.float64 else 1e-3)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", LAWS)
def test_12_uniform_stress_on_a_regular_lattice_has_no_force_inside(law, dtype):
    """sum_p V tau grad w = 0 at nodes whose cells are full; the surface, which moves, is the control."""
    inside, surface = interior_force(law, dtype)
    assert inside < (1e-12 if dtype == torch.float64 else 1e-5)
    assert surface > 1e-1


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", LAWS)
def test_13_free_fall(law, dtype):
    """v = v0 + g t; x = x0 + v0 t + (g t^2/2)(1 + dt/t), symplectic Euler's sum; F stays I."""
    final, error = free_fall(law, dtype)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    assert error < tolerance
    assert (
        final.F.double() - torch.eye(3)
    ).abs().max() < 1e2 * tolerance  # sums C_affine dt of 100 substeps


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", SOLIDS)
def test_14_hydrostatic_column(law, dtype):
    """Mean of tau_yy over two periods = -density g (H - y): slope within 2 % at 16 cells.

    The strain is density g H/E = 0.3 % at the foot, of which finite-strain laws differ by as much; half a cell at the ground
    and one of 16 at the free face carry the rest.
    """
    assert column(law, dtype)[2] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("law", SOLIDS)
def test_15_wave_speed_and_order(law):
    """c = sqrt(M/density) within 2 % at 8 cells per half wave already, and order >= 1 when dx and dt are halved together.

    Fibres are slack in one half of every period, so that a wave of them has two speeds: of these laws the 2 % alone."""
    errors = [abs(wave(law, cells)[2] - 1) for cells in (8, 16, 32)]
    assert errors[0] < 0.02
    if "fibre" not in law_named(law).parameters:
        assert min(math.log2(a / b) for a, b in itertools.pairwise(errors)) > 1
    assert abs(wave(law, 16, torch.float32)[2] - 1) < 0.02


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", ["linear", "neo_hookean", "corotated", "stvk"])
def test_16_cantilever_against_timoshenko(law, dtype):
    """Deflection under its own weight within 5 %: of 24 cells of length a third of one, at the clamp, would be that much."""
    deflection, ratio = cantilever(law, dtype, depth=4, length=24)
    assert float(deflection.max()) < 0.05 * 24 * 0.02  # small, as the theory asks
    assert ratio == pytest.approx(1.0, abs=0.05)


def test_33_a_nearly_incompressible_cantilever_does_not_lock():
    """nu = 0.499, two cells deep: 0.65 with each particle's own volume; by finite elements, whose clamp keeps the root from
    narrowing as this one does, 0.954."""
    assert over_theory(0.499, 2, 10, 1, True) == pytest.approx(0.954, abs=0.02)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("friction", [0.2, 0.5, 0.8])
def test_16_a_block_slips_at_the_friction_angle(friction, dtype):
    """atan(friction) within 1 degree: from sliding, and a degree below it the block is slowed or rests, above it gains speed."""
    angle = math.degrees(math.atan(friction))
    assert slip_angle(friction, dtype) == pytest.approx(angle, abs=1.0)
    below, above = slide(angle - 1, friction, dtype, seconds=0.8), slide(angle + 1, friction, dtype)
    assert below[0] < 0 or abs(below[1]) < 1e-3
    assert above[0] == pytest.approx(point_mass(angle + 1, friction), rel=0.05)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("angle, friction", [(35, 0.8), (25, 0.5)])
def test_16_a_block_that_is_released_suddenly_below_the_friction_angle_stays(
    angle, friction, turned
):
    """It moves by what its own strain and the closing of the contact take, less than a fiftieth of a cell, and rests."""
    way, speed = released(angle, friction, turned=turned)
    assert abs(way) < 0.02 * 0.04 and abs(speed) < 1e-3


def test_16_without_its_thickness_the_contact_lets_the_block_creep():
    """The undamped model's own motion, which finite elements show too; damped ones stay, by as much as the block above."""
    assert released(35, 0.8, thickness=0.0)[1] > 0.03
    assert released_elements(35, 0.8)[1] > 0.03
    way, speed = released_elements(35, 0.8, damping=1e-3, courant=0.05)
    assert way < 0.02 * 0.04 and abs(speed) < 1e-4


def test_16_an_impact_bounces_as_without_the_thickness():
    """With a contact that fades in at any speed it kept seven tenths of its speed."""
    assert bounced(None) == pytest.approx(bounced(0.0), rel=0.02)


@pytest.mark.parametrize("angle", [0.0, 20.0])
def test_29_plates_feel_the_force_of_their_stroke_on_any_grid(angle):
    """A cylinder of 6 and 9 cells, squeezed by 30 %: both within 3 % of the uniaxial force."""
    coarse, fine = squeezed(6, angle=angle), squeezed(9, angle=angle)
    assert coarse == pytest.approx(1.0, abs=0.03) and fine == pytest.approx(1.0, abs=0.03)
    assert 0.8 < squeezed(6, angle=angle, mode="touch") < 0.9  # the softer contact of films
