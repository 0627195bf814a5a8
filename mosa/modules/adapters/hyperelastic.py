"""The default adapter: an anisotropic stiffness added to the prior's energy, so that the learned law has an energy at every strain.

psi(F) = beta psi_prior(F) + mu E : (S + (1 - beta) C0) : E, E Green's strain, mu the shear modulus
at the particle. At small strain the prior's stiffness 2 mu C0 becomes 2 mu (C0 + S). S follows from numbers A as

    C0 + S = C0^(1/2) exp(A) C0^(1/2),      A symmetric, orthogonal to the two isotropic tensors,

which is positive definite whatever A is, isotropic only for A = 0, and leaves E and nu their meaning: they carry the isotropic
part.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.microplane import MANDEL, isotropic_stiffness
from mosa.modules.adapters.penalties import OperatorStatistics
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN, acoustic_stiffening
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.physics.constitutive.laws import Law

SHARPNESS = 60.0
"""Of the smoothed smallest eigenvalue: it is above the true one by at most log(6)/60."""
NUMBERS = 19
"""Symmetric 6 x 6 matrices have 21 numbers, of which two are isotropic: the prior's own."""


CONTRASTS = (
    (math.sqrt(1 / 2), -math.sqrt(1 / 2), 0.0),
    (math.sqrt(1 / 6), math.sqrt(1 / 6), -math.sqrt(2 / 3)),
)
"""What parts three numbers from their mean."""


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def anisotropic_basis(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(19, 6, 6) orthonormal symmetric matrices in Mandel scaling, orthogonal to I and to 1x1: no sum of them is isotropic.

    Written out, as a decomposition (of the projector onto them, say) gives another basis on another processor, and the numbers of a
    checkpoint would be another law there."""
    half = math.sqrt(1 / 2)

    def matrix(entries: dict[tuple[int, int], float]) -> Tensor:
        E = torch.zeros(6, 6, dtype=torch.float64)
        for (i, j), value in entries.items():
            E[i, j] = E[j, i] = value if i == j else half * value
        return E

    normal, shear = [(0, 0), (1, 1), (2, 2)], [(3, 3), (4, 4), (5, 5)]
    coupled = [(1, 2), (0, 2), (0, 1)]
    threes = (normal, shear, coupled)
    parts = [dict(zip(three, weights)) for three in threes for weights in CONTRASTS]
    means = {**dict.fromkeys(normal, math.sqrt(2 / 15)), **dict.fromkeys(shear, -math.sqrt(2 / 15)),
             **dict.fromkeys(coupled, -math.sqrt(1 / 15))}  # fmt: skip
    others = [{(i, j): 1.0} for i in range(6) for j in range(max(i + 1, 3), 6)]
    return torch.stack([matrix(entries) for entries in (*parts, means, *others)]).to(device, dtype)


def root_stiffness(poisson: Tensor) -> Tensor:
    """(6, 6) C0^(1/2) in Mandel scaling and units of sqrt(2 mu); poisson: () below 1/2."""
    like: dict[str, Any] = {"dtype": poisson.dtype, "device": poisson.device}
    one = torch.tensor([1.0, 1, 1, 0, 0, 0], **like) / math.sqrt(3)
    bulk = ((1 + poisson) / (1 - 2 * poisson)).sqrt()
    return torch.eye(6, **like) + (bulk - 1) * torch.outer(one, one)


class HyperelasticAdapter(Adapter):
    """A constant anisotropic stiffness with an energy. `numbers`: (19,) coordinates of A in `anisotropic_basis`, 0 at the prior.

    Fluids have no shear modulus that it could be a multiple of: it is left out there."""

    energetic = True
    few_numbers = True

    def __init__(self) -> None:
        super().__init__()
        self.numbers = nn.Parameter(torch.zeros(NUMBERS))
        self._live: Tensor | None = None

    def __getstate__(self) -> dict:
        live = None if self._live is None else self._live.detach()
        return super().__getstate__() | {"_live": live}

    @property
    def steady(self) -> bool:
        return True

    def unsuited(self, law: Law) -> str | None:
        if law.sheared:
            return None
        return (
            f"{law.name} has no shear stiffness that could be anisotropic; the run learns its parameters and stiffness modes "
            "alone (adapter=mosa corrects its stress by networks)"
        )

    def share(self) -> Tensor:
        """beta () float64: how much of the prior's energy the law keeps, 1 at the prior, with its graph.

        The smallest eigenvalue of exp(A), smoothed: what is then added, C0 + S - beta C0, is positive but for 3 %, so that no
        direction loses its stiffness where the strain measure grows faster than the prior (Green's in tension)."""
        values = torch.linalg.eigvalsh(self._matrix())
        return torch.exp(
            (math.log(len(values)) - torch.logsumexp(-SHARPNESS * values, 0)) / SHARPNESS
        )

    def follow(self, poisson: Tensor) -> None:
        """The prior's Poisson number now, (), with its graph: C0 is that of the law in use, so that C0 + S stays positive."""
        self._live = poisson

    def _poisson(self) -> Tensor:
        return self.poisson if self._live is None else self._live.to(self.numbers.device)

    def _matrix(self) -> Tensor:
        """A (6, 6) float64."""
        basis = anisotropic_basis(torch.float64, self.numbers.device)
        return torch.einsum("k,kij->ij", self.numbers.double(), basis)

    def _exponential(self) -> Tensor:
        """exp(A) (6, 6) float64."""
        return torch.linalg.matrix_exp(self._matrix())

    def stiffness(self) -> Tensor:
        """C0 + S (6, 6) float64 in Mandel scaling and units of 2 mu, with its graph; positive definite."""
        root = root_stiffness(self._poisson().double())
        return root @ self._exponential() @ root

    def correction(self, poisson: Tensor | None = None) -> Tensor:
        """S (6, 6) float64, see `stiffness`; exactly 0 where the numbers are. poisson: of C0, () float64, None for the prior's
        now."""
        root = root_stiffness(self._poisson().double() if poisson is None else poisson)
        change = self._exponential() - torch.eye(6, dtype=torch.float64, device=root.device)
        return root @ change @ root

    @torch.no_grad()
    def stiffening(self, poisson: Tensor | float) -> float:
        """Largest acoustic modulus of C0 + S over the prior's, `ADAPTER_MARGIN` at least."""
        if not self.is_on:
            return ADAPTER_MARGIN
        # the prior's number that is asked for, not the one of the last rollout, which may have been another variant's
        poisson = torch.as_tensor(poisson).detach().to(self.numbers.device, torch.float64)
        return max(ADAPTER_MARGIN, acoustic_stiffening(self.relative(poisson).cpu(), poisson.cpu()))

    def relative(self, poisson: Tensor | None = None) -> Tensor:
        """(6, 6) float64 S C0^-1 on vech components: what is added to the prior's stress at small strain. poisson: as
        `correction`."""
        poisson = self._poisson().double() if poisson is None else poisson
        C0 = isotropic_stiffness(poisson)
        scale = torch.tensor(MANDEL, dtype=torch.float64, device=C0.device)
        return (self.correction(poisson) @ torch.linalg.inv(C0)) * scale / scale[:, None]

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        return s.double() @ self.relative().T

    def forward(self, state: MaterialState) -> AdapterOperator:
        """G: C0 + S - beta C0 for every particle, (N, 6, 6) in Mandel scaling and units of 2 mu; h: (beta - 1, 0, ...), see
        `share`; views of one row.

        Errors: ConfigError before `switch_on`."""
        self.check_on()
        n, less = len(state.w), self.share() - 1
        added = self.correction() - less * isotropic_stiffness(self._poisson().double())
        h = torch.cat([less.reshape(1), less.new_zeros(5)])
        return AdapterOperator(added.to(state.w).expand(n, 6, 6), h.to(state.w).expand(n, 6))

    def statistics(self) -> OperatorStatistics:
        """mean_abs_C: mean |entry| of S C0^-1, which is what the paper's C does to the stress at small strain; mean: the
        numbers."""
        return OperatorStatistics(
            self.relative().abs().mean(), self.numbers, torch.zeros_like(self.numbers)
        )
