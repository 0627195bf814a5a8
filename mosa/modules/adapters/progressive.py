"""Steps 1 to 5 of the progressive stress adaptation (paper, section 3.1): the four networks on one symmetric tensor.

1: L_pre (eq. 4). 2: C_x, C_y, C_z (eq. 7). 3: what they make of the stress on each plane, shears averaged (eq. 5).
4: C_xyz on the normal components (eq. 7). 5: L_post (eq. 8).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mosa.modules.adapters import microplane
from mosa.modules.adapters.networks import TwoHiddenLayers, zero_outputs


class Correction(NamedTuple):
    """What corrects s (N, 6): s3 = (I + G)(s + pre) + post. G: (N, 6, 6); pre, post: (N, 6);
    C: (N, 4, 3, 3), the corrections C_x, C_y, C_z, C_xyz."""

    G: Tensor
    pre: Tensor
    post: Tensor
    C: Tensor


class ProgressiveOperator(nn.Module):
    """Four networks on a dimensionless symmetric tensor s (N, 6) and the stretch w = vech(W - I) (N, 6).

    alpha: bound of the entries of the LU factors; alpha_normal: of those of C_xyz and of l2, None: alpha;
    l_max: of L_pre and L_post, None leaves them linear (the paper's form);
    factors: residual | printed, see `microplane.CORRECTIONS`;
    state_dependence: full | constant (the four matrices are learned numbers, not functions of the state) | later (the same, and
    without L_pre and L_post, until `vary`);
    major_symmetry: (A + C0 A^T C0^-1)/2 in place of A, needs `poisson` of C0;
    no_prior_stress: s1 = L_pre instead of s + L_pre.
    The output is exactly 0 at initialisation; with printed factors it is 1e-4 of the stress there."""

    def __init__(
        self, *, alpha: float, l_max: float | None, input_scale: float, hidden: int, no_C: bool, no_pre: bool, no_post: bool,
        state_dependence: str = "full", major_symmetry: bool = False, no_prior_stress: bool = False,
        alpha_normal: float | None = None, factors: str = "residual",
    ) -> None:  # fmt: skip
        super().__init__()
        self.alpha, self.l_max, self.scale = alpha, l_max, input_scale
        self.factors, self.correction = factors, microplane.CORRECTIONS[factors]
        self.alpha_normal = alpha if alpha_normal is None else alpha_normal
        self.no_C, self.no_prior_stress = no_C, no_prior_stress
        self.major_symmetry, self.later = major_symmetry, state_dependence == "later"
        self.left_out = no_pre, no_post
        self.phi = TwoHiddenLayers(12, 6, hidden)
        self.psi1 = TwoHiddenLayers(12, hidden, hidden)
        self.planes = nn.Linear(hidden, 36)
        self.psi2 = TwoHiddenLayers(hidden + 3, 12 + hidden, hidden)
        self.theta = TwoHiddenLayers(hidden + 12, 6, hidden)
        for layer in (self.phi[-1], self.planes, self.theta[-1]):
            zero_outputs(layer)
        zero_outputs(self.psi2[-1], 12)
        constant = state_dependence != "full"
        self.free = nn.Parameter(torch.zeros(4, 12)) if constant and not no_C else None
        if self.later:
            self.register_buffer("varies", torch.tensor(False))
            # a hook of a method would keep a copied operator's original
            self.register_load_state_dict_post_hook(settle_as_loaded)
        self.settle(constant)

    def settle(self, constant: bool) -> None:
        """Which networks there are: with matrices that are learned numbers, or with functions of the state."""
        waits = self.later and constant
        self.constant = constant
        self.no_pre, self.no_post = (out or waits for out in self.left_out)
        self.adaptive = not (self.no_C or constant)
        for module, used in (
            (self.phi, not self.no_pre), (self.psi1, self.adaptive or not self.no_post), (self.planes, self.adaptive),
            (self.psi2, self.adaptive or not self.no_post), (self.theta, not self.no_post),
        ):  # fmt: skip
            module.requires_grad_(used)
        if self.free is not None:
            self.free.requires_grad_(constant)

    @torch.no_grad()
    def vary(self) -> None:
        """From now on all are functions of the state that begin as the learned numbers: these become biases of the last layers."""
        raw = self.scale * self.free
        self.planes.bias.copy_(raw[:3].flatten())
        self.psi2[-1].bias[:12].copy_(raw[3])
        self.varies.fill_(True)
        self.settle(False)

    def residual(self, network: nn.Module, *inputs: Tensor) -> Tensor:
        """L_pre, L_post: (N, 6), within l_max."""
        raw = network(torch.cat(inputs, -1))
        return raw if self.l_max is None else self.l_max * torch.tanh(raw)

    def first(self, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Step 1: (L_pre, s1, scaled w), each (N, 6)."""
        k = self.scale
        pre = torch.zeros_like(s) if self.no_pre else self.residual(self.phi, k * w, k * s)
        return pre, pre if self.no_prior_stress else s + pre, k * w

    def plane_corrections(self, kw: Tensor, s1: Tensor) -> tuple[Tensor, Tensor | None]:
        """Step 2: (C_x, C_y, C_z (N, 3, 3, 3), l1 (N, hidden) or None where nothing reads it)."""
        n = len(s1)
        l1 = None
        if self.adaptive or not self.no_post:
            l1 = self.psi1(torch.cat([kw, self.scale * s1], -1))
        if self.no_C:
            return s1.new_zeros(n, 3, 3, 3), l1
        if self.constant:
            return self.constant_corrections(s1)[:3].expand(n, 3, 3, 3), l1
        return self.correction(self.alpha * torch.tanh(self.planes(l1)).unflatten(-1, (3, 12))), l1

    def constant_corrections(self, like: Tensor) -> Tensor:
        """(4, 3, 3). The numbers are learned in units of 1/input_scale: the networks' learning rate then fits them too."""
        # filled where they are used: a copy from the host would wait for all that a GPU has still to do
        bound = torch.full((4, 1), self.alpha, device=like.device)
        bound[3:].fill_(self.alpha_normal)
        bound = bound.to(like)
        return self.correction(bound * torch.tanh(self.scale * self.free).to(like))

    def constant_operator(self) -> Tensor:
        """(6, 6) A - I of the constant matrices, before the projection to major symmetry."""
        C = self.constant_corrections(self.free)
        return microplane.redistribution(C[:3], C[3])

    def normal_correction(self, l1: Tensor | None, n: Tensor) -> tuple[Tensor, Tensor | None]:
        """Step 4: (C_xyz (N, 3, 3), l2 (N, hidden) or None where nothing reads it); n: (N, 3) normals after the planes."""
        numbers = l2 = None
        if l1 is not None:
            bounded = self.alpha_normal * torch.tanh(self.psi2(torch.cat([l1, self.scale * n], -1)))
            numbers, l2 = bounded[:, :12], bounded[:, 12:]
        if self.no_C:
            return n.new_zeros(len(n), 3, 3), l2
        if self.constant:
            return self.constant_corrections(n)[3].expand(len(n), 3, 3), l2
        return self.correction(numbers), l2

    def last(self, l2: Tensor | None, kw: Tensor, s2: Tensor) -> Tensor:
        """Step 5: L_post (N, 6)."""
        if self.no_post:
            return torch.zeros_like(s2)
        return self.residual(self.theta, l2, kw, self.scale * s2)

    def forward(self, w: Tensor, s: Tensor, poisson: Tensor | None = None) -> Correction:
        """The assembled form. w, s: (N, 6); poisson: () of the prior, for major_symmetry."""
        pre, s1, kw = self.first(w, s)
        planes, l1 = self.plane_corrections(kw, s1)
        T = microplane.plane_operator(planes)
        normal, l2 = self.normal_correction(l1, s1[:, :3] + apply(T[:, :3], s1))
        G = microplane.with_normal(T, normal)
        if self.major_symmetry:
            G = microplane.major_symmetric(G, poisson)
        post = self.last(l2, kw, s1 + apply(G, s1)) if not self.no_post else torch.zeros_like(s)
        return Correction(G, pre, post, torch.cat([planes, normal[:, None]], 1))


def settle_as_loaded(operator: ProgressiveOperator, _: object) -> None:
    """A hook: what is loaded says by itself whether its networks have begun."""
    operator.settle(not bool(operator.varies))


def apply(G: Tensor, s: Tensor) -> Tensor:
    """G s per particle: (N, k) from (N, k, 6) and (N, 6)."""
    return (G @ s[..., None])[..., 0]
