"""Each exported text against the program's own kernels, at drawn deformations."""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
import warp as wp
from torch import Tensor

from mosa.errors import DataError
from mosa.evaluation.analysis.law_stress import deformations, kirchhoff, tangent
from mosa.export.source import Source
from mosa.physics.launching import launch

Pair = tuple[Tensor, Tensor]
STRAINS = 0.2, 0.1, 0.05, 0.025
"""Of the deformations, the first at which the law itself is finite: fibres of a large exponent are not at large strains."""
ABAQUS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def relative(found: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest entry, of each deformation; the largest of all."""
    away = (found - expected).abs().flatten(1).amax(1)
    return float((away / expected.abs().flatten(1).amax(1)).max())


def expected(found: Source, F: Tensor) -> Pair:
    """Kirchhoff stress (n, 3, 3) and its derivative d tau/dF (n, 3, 3, 3, 3) [Pa], by the kernels."""
    parts = found.material, found.adapter, F
    return kirchhoff(*parts), tangent(*parts)


def jaumann(derivative: Tensor, F: Tensor) -> Tensor:
    """(n, 6, 6) in Abaqus' order: d tau of the stretching D, for rates F' = D F without spin, over J."""
    J = torch.linalg.det(F)
    columns = []
    for k, l in ABAQUS:
        D = torch.zeros(3, 3, dtype=torch.float64)
        D[k, l] += 0.5
        D[l, k] += 0.5
        moved = torch.einsum("nijkl,nkl->nij", derivative, D @ F)
        columns.append(torch.stack([moved[:, i, j] for i, j in ABAQUS], 1))
    return torch.stack(columns, 2) / J[:, None, None]


def umat_of(found: Source, text: str, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(SSE (n,) [J/m^3], stress (n, 6) [Pa], tangent (n, 6, 6)) of the text, compiled by gfortran.
    Errors: DataError where it does not compile."""
    n = len(F)
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "umat.f90", Path(folder) / "umat.so"
        source.write_text(text)
        run = subprocess.run(
            ["gfortran", "-O1", "-shared", "-fPIC", "-J", folder, "-o", str(library), str(source)],
            capture_output=True, text=True,
        )  # fmt: skip
        if run.returncode:
            raise DataError(f"export: gfortran does not compile umat.f90: {run.stderr[-500:]}")
        call = ctypes.CDLL(str(library)).mosa_check
        props = np.array([found.values[name] for name in found.energy.names])
        results = np.empty(n), np.empty((n, 6)), np.empty((n, 6, 6))
        gradients = np.ascontiguousarray(F.mT.numpy())  # Fortran's columns
        double = ctypes.POINTER(ctypes.c_double)
        arrays = [a.ctypes.data_as(double) for a in (gradients, props, *results)]
        call(n, arrays[0], len(props), *arrays[1:])
    stored, stress, tangent = map(torch.from_numpy, results)
    return stored, stress, tangent.mT


def check_umat(
    found: Source, text: str, F: Tensor, truth: tuple[Tensor, Tensor], psi: Tensor
) -> tuple[float, float, float]:
    """Relative differences of stress, tangent and SSE. psi: (n,) [J/m^3] per rest volume."""
    (stored, stress, tangent), (tau, derivative) = umat_of(found, text, F), truth
    J = torch.linalg.det(F)
    sigma = tau / J[:, None, None]
    asked = torch.stack([sigma[:, i, j] for i, j in ABAQUS], 1)
    energy = relative(stored[:, None], (psi / J)[:, None])
    return relative(stress, asked), relative(tangent, jaumann(derivative, F)), energy


class Entries:
    """A batch of 3 x 3 matrices as UFL writes one."""

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __getitem__(self, place: tuple[int, int]) -> Tensor:
        return self.values[:, place[0], place[1]]


LIKE_UFL = SimpleNamespace(
    ln=torch.log, exp=torch.exp, sqrt=torch.sqrt, cos=torch.cos, atan2=torch.atan2, conditional=torch.where, gt=torch.gt,
    dot=lambda A, B: Entries(A.values @ B.values), transpose=lambda A: Entries(A.values.mT),
)  # fmt: skip
"""The functions of UFL that a text calls, on batches."""


def energy_of(text: str, F: Tensor) -> Tensor:
    """(n,) [J/m^3] per rest volume, by the text for FEniCSx."""
    scope: dict = {"ufl": LIKE_UFL}
    exec(compile(text.replace("\nimport ufl\n", "\n"), "law_ufl.py", "exec"), scope)
    return scope["energy"](Entries(F))


def check_ufl(text: str, F: Tensor, truth: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """Relative differences of stress and tangent: first and second derivatives of the text's energy."""
    tau, derivative = truth
    F = F.clone().requires_grad_()
    psi = energy_of(text, F)
    (P,) = torch.autograd.grad(psi.sum(), F, create_graph=True)
    found = P @ F.mT
    sums = (found[:, i, j].sum() for i in range(3) for j in range(3))
    rows = [torch.autograd.grad(each, F, retain_graph=True)[0] for each in sums]
    slopes = torch.stack(rows, 1).unflatten(1, (3, 3))
    return relative(found.detach(), tau), relative(slopes, derivative)


def check_warp(text: str, F: Tensor, truth: Pair) -> float:
    """Relative difference of the stress, in a kernel."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "law_warp.py"
        path.write_text(text)
        specification = importlib.util.spec_from_file_location("law_warp", path)
        assert specification is not None and specification.loader is not None
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
        function = module.kirchhoff_stress

        @wp.kernel(module="unique", enable_backward=False)
        def stress_of_text(F: wp.array(dtype=wp.mat33d), tau: wp.array(dtype=wp.mat33d)):  # type: ignore[valid-type]
            i = wp.tid()
            tau[i] = function(F[i])

        tau = torch.zeros_like(F)
        arrays = [wp.from_torch(t, dtype=wp.mat33d) for t in (F.contiguous(), tau)]
        launch(stress_of_text, len(F), arrays, arrays[0].device)
    return relative(tau, truth[0])


def check_all(found: Source, texts: dict[str, str], count: int) -> dict[str, float]:
    """Relative differences at `count` deformations, by text; of the UMAT only where there is a gfortran."""
    for strain in STRAINS:
        F = deformations(count, strain=strain)
        truth = expected(found, F)
        if all(bool(each.isfinite().all()) for each in truth):
            break
    result: dict[str, float] = {}
    if shutil.which("gfortran"):
        names, psi = ("stress", "tangent", "energy"), energy_of(texts["law_ufl.py"], F)
        differences = check_umat(found, texts["umat.f90"], F, truth, psi)
        result |= {f"umat {name}": value for name, value in zip(names, differences)}
    result["ufl stress"], result["ufl tangent"] = check_ufl(texts["law_ufl.py"], F, truth)
    result["warp stress"] = check_warp(texts["law_warp.py"], F, truth)
    return result
