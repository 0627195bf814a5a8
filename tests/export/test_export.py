"""Laws as text: each against the program's own stress and tangent at drawn deformations (1,000 of them: docs/law_export.md)."""

import json
import shutil

import numpy as np
import pytest
import sympy as sp
import torch
from energies import ENERGIES as ENERGY_OF
from small_bodies import FRAME_DT, STICKY, small_body, start

from mosa.cli.export_law import main
from mosa.errors import ConfigError, DataError
from mosa.export.checking import (
    check_ufl,
    check_umat,
    check_warp,
    deformations,
    energy_of,
    expected,
    umat_of,
)
from mosa.export.energies import ENERGIES, ENTRIES, STRETCHES, energy
from mosa.export.source import as_json, read_material, read_source, source
from mosa.export.texts import ufl_text, umat, warp_text
from mosa.material_tests.measurements import measurements
from mosa.material_tests.specimen import Specimens
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import Material
from mosa.twin.twin import Twin

FIBRES = {"fibre_stiffness": 2e4, "fibre_exponent": 1.5, "dispersion": 0.1, "fibre": [1, 0.4, 0.2]}
LAWS = {
    "neo_hookean": {}, "corotated": {}, "stvk": {}, "mooney_rivlin": {"second_share": 0.3},
    "yeoh": {"yeoh_2": 0.1, "yeoh_3": 0.02}, "hgo": FIBRES,
    "ogden": {"alpha_1": 2.5, "share_2": 0.2, "alpha_2": -4.0, "share_3": 0.3, "alpha_3": 6.0},
    "hgo_two": FIBRES | {"second_fibre_stiffness": 1e4, "second_fibre": [0.5, -1, 0]},
}  # fmt: skip


def exported(law: str, learned: bool):
    adapter = None
    if learned:
        adapter = HyperelasticAdapter()
        with torch.no_grad():
            adapter.numbers.copy_(0.3 * torch.randn(19, generator=torch.Generator().manual_seed(1)))
        adapter.switch_on(1e5, 0.4)
    return source(Material(law, {"E": 1e5, "nu": 0.4} | LAWS[law]), adapter)


def test_every_energy_that_is_exported_is_named():
    assert set(ENERGIES) == set(LAWS)


@pytest.mark.parametrize("law", LAWS)
def test_the_symbolic_energy_is_the_law_s(law):
    """Against the torch function that the verification suite holds the kernels to."""
    found, F = exported(law, False), deformations(50, seed=3)
    form = energy(law, tuple(found.values), False)
    f = sp.lambdify(
        [*ENTRIES, *STRETCHES, *sp.symbols(form.names, real=True)],
        form.entries + form.stretches,
        [{"ramp": lambda e: e.clip(0)}, "numpy"],
    )
    C, S = F.mT @ F, torch.linalg.svdvals(F)
    inputs = [C[:, i, j].numpy() for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))]
    psi = torch.as_tensor(f(*inputs, *S.T.numpy(), *found.values.values()))
    values = {k: v.detach().double() for k, v in found.material.per_particle().items()}
    expected_psi = ENERGY_OF[law](F, **values)
    assert (psi - expected_psi).abs().max() < 1e-12 * expected_psi.max()


@pytest.mark.parametrize("law, learned", [("hgo", True), ("ogden", False)])
def test_texts_agree_with_the_kernels(law, learned):
    found, F = exported(law, learned), deformations(100)
    truth = expected(found, F)
    stress, tangent = check_ufl(ufl_text(found), F, truth)
    assert stress < 1e-10 and tangent < 1e-6
    assert check_warp(warp_text(found), F, truth) < 1e-10
    other = expected(exported(law, not learned), F)  # the check can fail
    assert check_ufl(ufl_text(found), F, other)[0] > 1e-3


@pytest.mark.parametrize("law, learned", [("hgo", True), ("ogden", False)])
def test_umat_agrees_with_the_kernels(law, learned):
    if shutil.which("gfortran") is None:
        pytest.skip("no gfortran here")
    found, F = exported(law, learned), deformations(1000)
    F[0] = torch.eye(3)  # equal stretches, at rest and away from it
    F[1] = 1.1 * torch.eye(3)
    truth = expected(found, F)
    truth[0][0] = 0  # exactly
    text = umat(found)
    assert max(map(len, text.splitlines())) <= 132
    psi = energy_of(ufl_text(found), F)
    stress, tangent, energy = check_umat(found, text, F[1:], tuple(t[1:] for t in truth), psi[1:])
    assert stress < 1e-10 and tangent < 1e-6 and energy < 1e-10
    rest = check_umat(found, text, F[:1], (torch.ones(1, 3, 3).double(), truth[1][:1]), 1 + psi[:1])
    assert rest[1] < 1e-6


def test_sse_is_the_work_of_the_stress():
    """SSE times J against the kernels' stress along a straight path from rest, by Gauss's rule."""
    if shutil.which("gfortran") is None:
        pytest.skip("no gfortran here")
    found, (_, stretches, V) = exported("ogden", True), torch.linalg.svd(deformations(20))
    one, F = torch.eye(3).double(), V.mT @ torch.diag_embed(stretches) @ V
    work = torch.zeros(20).double()
    for place, weight in zip(*np.polynomial.legendre.leggauss(24)):
        at = one + 0.5 * (1 + place) * (F - one)
        P = expected(found, at)[0] @ torch.linalg.inv(at).mT
        work += 0.5 * weight * (P * (F - one)).sum((1, 2))
    stored, _, _ = umat_of(found, umat(found), F)
    assert (stored * torch.linalg.det(F) - work).abs().max() < 1e-9 * work.max()


def test_the_text_is_ufl():
    """UFL itself takes the energy, derives it and evaluates the stress of one deformation."""
    ufl = pytest.importorskip("ufl")
    from ufl.algorithms import compute_form_data  # noqa: F401  not every release has what follows
    from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
    from ufl.algorithms.apply_derivatives import apply_derivatives

    found = exported("mooney_rivlin", False)
    scope: dict = {}
    exec(compile(ufl_text(found), "law_ufl.py", "exec"), scope)
    F = deformations(1, seed=5)
    gradient = ufl.variable(ufl.as_matrix(F[0].tolist()))
    P = apply_derivatives(apply_algebra_lowering(ufl.diff(scope["energy"](gradient), gradient)))
    value = torch.tensor(
        [[float(P[i, j](())) for j in range(3)] for i in range(3)], dtype=torch.float64
    )
    tau, _ = expected(found, F)
    assert (value @ F[0].T - tau[0]).abs().max() < 1e-10 * tau.abs().max()


def test_the_command_writes_reads_and_checks(tmp_path, capsys):
    found = exported("neo_hookean", True)
    (tmp_path / "material.json").write_text(as_json(found))
    material, adapter = read_material(tmp_path / "material.json")
    assert source(material, adapter).values == pytest.approx(found.values, rel=1e-6)
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "material.json"), str(tmp_path / "law"), "--check", "20"])
    assert ended.value.code == 0 and "warp stress" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "law").iterdir()) == [
        "law.json",
        "law_ufl.py",
        "law_warp.py",
        "umat.f90",
    ]
    assert json.loads((tmp_path / "law" / "law.json").read_text())["values"]["kept"] < 1
    with pytest.raises(SystemExit):
        main([str(tmp_path / "material.json"), str(tmp_path / "law" / "law.json"), "--check", "0"])
    assert "export: expected a folder that can be written" in capsys.readouterr().err


def test_a_law_is_exported_as_nearly_incompressible():
    """mu stays, lam is 2 mu nu/(1 - 2 nu). To a stretch of 5 the uniaxial stress is within 1 % of that
    of a specimen whose volume a pressure keeps; at nu = 0.49 it is 7 % off."""
    law = {"E": 1e5, "nu": 0.45}
    found = source(Material("mooney_rivlin", law | LAWS["mooney_rivlin"]), None, 0.49999)
    mu = 1e5 / 2 / 1.45
    assert found.values["mu"] == pytest.approx(mu) and found.values["lam"] == pytest.approx(
        2 * mu * 0.49999 / 2e-5
    )
    assert json.loads(as_json(found))["parameters"]["nu"] == 0.49999
    F = deformations(50)
    truth = expected(found, F)
    assert check_ufl(ufl_text(found), F, truth)[0] < 1e-10
    states = [{"test": "t", "mode": "uniaxial x", "first": l, "stress_1": 1.0} for l in (1.5, 5.0)]
    data = measurements(states, "Pa", "here")
    kept, free = (Specimens(data, s).predict(found.material, None) for s in (True, False))
    usual = source(Material("mooney_rivlin", law | LAWS["mooney_rivlin"]), None, 0.49).material
    assert free == pytest.approx(kept, rel=0.01)
    assert Specimens(data, False).predict(usual, None) != pytest.approx(kept, rel=0.05)
    with pytest.raises(ConfigError, match="nu: expected a number of at least 0 and below"):
        source(Material("neo_hookean", law), None, 0.5)
    isotropic, learned = HyperelasticAdapter(), HyperelasticAdapter()
    with torch.no_grad():
        learned.numbers[0] = 0.1
    for adapter in (isotropic, learned):
        adapter.switch_on(1e5, 0.45)
    kept = source(Material("neo_hookean", law), isotropic, 0.499)
    assert kept.values == source(Material("neo_hookean", law), None, 0.499).values
    with pytest.raises(ConfigError, match="found a learned stiffness"):
        source(Material("neo_hookean", law), learned, 0.499)


def test_a_wrong_checkpoint_is_named_by_the_command_s_argument(tmp_path):
    with pytest.raises(DataError, match=r"^source: .*gone\.ckpt: no such file"):
        read_source(tmp_path / "gone.ckpt")


def test_an_energy_of_another_package_is_exported(tmp_path, monkeypatch, capsys):
    form = "from mosa.export.energies import ENERGIES, neo_hookean\nENERGIES['stvk_paper'] = neo_hookean"
    (tmp_path / "own_energy.py").write_text(form)
    monkeypatch.syspath_prepend(tmp_path)
    law = {"law": "stvk_paper", "parameters": {"E": 1e5, "nu": 0.3}, "stiffness": None}
    (tmp_path / "material.json").write_text(json.dumps(law))

    def code(*words) -> int:
        with pytest.raises(SystemExit) as ended:
            main([str(tmp_path / "material.json"), str(tmp_path / "law"), "--check", "0", *words])
        return ended.value.code

    try:
        assert code() == 2 and "by a module of --extensions" in capsys.readouterr().err
        assert code("--extensions", "own_enrgy") == 2
        assert "extensions: expected a module" in capsys.readouterr().err
        assert code("--extensions", "own_energy") == 0
        assert 'Law "stvk_paper"' in (tmp_path / "law" / "umat.f90").read_text()
    finally:
        ENERGIES.pop("stvk_paper", None)


def test_a_difference_that_is_no_number_fails_and_stiff_fibres_are_compared(tmp_path, monkeypatch, capsys):  # fmt: skip
    """k2 of an artery's adventitia (Gasser, Ogden, Holzapfel 2006): exp(k2 e^2) overflows at the usual strains."""
    artery = {"fibre_stiffness": 9.966e5, "fibre_exponent": 524.6, "dispersion": 0.226, "fibre": [1, 0.5, 0]}  # fmt: skip
    law = {"law": "hgo", "parameters": {"E": 2.3e4, "nu": 0.49} | artery, "stiffness": None}
    (tmp_path / "material.json").write_text(json.dumps(law))

    def code() -> int:
        with pytest.raises(SystemExit) as ended:
            main([str(tmp_path / "material.json"), str(tmp_path / "law"), "--check", "1000"])
        return ended.value.code

    assert code() == 0 and "nan" not in capsys.readouterr().out
    monkeypatch.setattr("mosa.export.checking.STRAINS", (0.4,))
    assert code() == 1 and "nan" in capsys.readouterr().out


def test_a_stiffness_field_that_the_texts_lack_is_told(monkeypatch, recwarn):
    body = small_body(modes=True)
    monkeypatch.setattr(Twin, "load", lambda path: Twin(body, STICKY, FRAME_DT, None, start()))
    read_source("last.ckpt")
    assert not recwarn
    with torch.no_grad():
        body.heterogeneity.coefficients[0] = 1.0
        factor = body.factor(body.heterogeneity)
    read_source("last.ckpt")
    told = f"moduli are {float(factor.min()):.2f} to {float(factor.max()):.2f} times as large"
    assert [told in str(each.message) for each in recwarn] == [True]


def test_a_law_without_an_energy_is_refused(tmp_path):
    yielding = Material("von_mises", {"E": 1e5, "nu": 0.3, "yield_stress": 1e3})
    with pytest.raises(ConfigError, match="found von_mises"):
        source(yielding, None)
    (tmp_path / "material.json").write_text('{"law": "stvk"}')
    with pytest.raises(DataError, match=r"material\.json: expected a material\.json .*of a twin: its checkpoint"):  # fmt: skip
        read_material(tmp_path / "material.json")
