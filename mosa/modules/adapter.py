"""Progressive stress adaptation (method.md, section 4): bounded networks that correct a prior stress in the material frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules import microplane
from mosa.physics.rollout import AdapterOperator, MaterialState


@dataclass(frozen=True)
class OperatorStatistics:
    """Of one evaluation, with gradients. mean_abs_C: over particles, the four matrices and all entries; mean_square: of the
    entries of C and of L_pre, L_post; variance: of the same over the particles (a constant operator has none)."""

    mean_abs_C: Tensor
    mean_square: Tensor
    variance: Tensor


def mlp(inputs: int, outputs: int, hidden: int) -> nn.Sequential:
    """Two hidden layers, SiLU."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, outputs))


def zero_rows(layer: nn.Linear, rows: int | None = None) -> None:
    """Zero the first `rows` outputs of a layer: the increment is then exactly 0 at the start."""
    with torch.no_grad():
        layer.weight[:rows].zero_()
        layer.bias[:rows].zero_()


class ProgressiveOperator(nn.Module):
    """Steps 1 to 5 on a dimensionless symmetric tensor s (N, 6) with stretch w (N, 6).

    alpha bounds the entries of the LU factors, l_max those of L_pre and L_post (None: unbounded, the paper's literal form).
    state_dependence: full | constant (the four matrices are learned numbers, not functions of the state).
    """

    def __init__(self, alpha: float, l_max: float | None, input_scale: float, hidden: int, no_C: bool, no_pre: bool, no_post: bool,
                 no_prior_stress: bool, state_dependence: str) -> None:
        super().__init__()
        self.alpha, self.l_max, self.scale = alpha, l_max, input_scale
        self.no_C, self.no_pre, self.no_post, self.no_prior_stress = no_C, no_pre, no_post, no_prior_stress
        self.constant = state_dependence == "constant"
        self.phi = mlp(12, 6, hidden)
        self.psi1 = mlp(12, hidden, hidden)
        self.planes = nn.Linear(hidden, 36)
        self.psi2 = mlp(hidden + 3, 12 + hidden, hidden)
        self.theta = mlp(hidden + 12, 6, hidden)
        for layer, rows in ((self.phi[-1], None), (self.planes, None), (self.psi2[-1], 12), (self.theta[-1], None)):
            zero_rows(layer, rows)
        if self.constant:
            self.free = nn.Parameter(torch.zeros(4, 12))
        unused = [m for m, off in ((self.phi, no_pre and not no_prior_stress), (self.planes, no_C or self.constant),
                                   (self.theta, no_post)) if off]
        for module in unused:
            module.requires_grad_(False)

    def bounded(self, raw: Tensor) -> Tensor:
        return raw if self.l_max is None else self.l_max * torch.tanh(raw)

    def forward(self, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(M (N, 6, 6), L_pre (N, 6), L_post (N, 6), corrections C (N, 4, 3, 3)) with s3 = M (s + L_pre) + L_post."""
        k, n = self.scale, len(w)
        skip_pre = self.no_pre and not self.no_prior_stress
        L_pre = torch.zeros_like(s) if skip_pre else self.bounded(self.phi(torch.cat([k * w, k * s], -1)))
        s1 = L_pre if self.no_prior_stress else s + L_pre
        l1 = self.psi1(torch.cat([k * w, k * s1], -1))
        if self.no_C:
            A = l1.new_zeros(n, 3, 12)
        elif self.constant:
            A = (self.alpha * torch.tanh(self.free[:3])).expand(n, 3, 12)
        else:
            A = self.alpha * torch.tanh(self.planes(l1)).unflatten(-1, (3, 12))
        planes = microplane.correction(A)
        T = microplane.plane_operator(planes)
        normal_stress = (T[:, :3] @ s1[..., None])[..., 0]
        bounded = self.alpha * torch.tanh(self.psi2(torch.cat([l1, k * normal_stress], -1)))
        l2 = bounded[:, 12:]
        a = bounded[:, :12]
        if self.no_C:
            a = torch.zeros_like(a)
        elif self.constant:
            a = (self.alpha * torch.tanh(self.free[3])).expand(n, 12)
        normal = microplane.correction(a)
        M = torch.cat([normal @ T[:, :3], T[:, 3:]], -2)
        if self.no_post:
            L_post = torch.zeros_like(s)
        else:
            s2 = (M @ s1[..., None])[..., 0]
            L_post = self.bounded(self.theta(torch.cat([l2, k * w, k * s2], -1)))
        C = torch.cat([planes, normal[:, None]], 1) - torch.eye(3, dtype=s.dtype, device=s.device)
        return M, L_pre, L_post, C


class StressAdapter(nn.Module):
    """The paper's adapter. `forward` answers the simulator; `increment` is the stepwise form of the same law.

    rest_free: an undeformed body stays stress-free; plastic: a second set of networks corrects the strain in the yield function;
    major_symmetry: (A + C0 A^T C0^-1)/2 in place of A, so that A C0 is symmetric. E_ref [Pa] is set once by `switch_on`.
    Errors: ConfigError for values out of range.
    """

    def __init__(self, alpha: float = 0.1, l_max: float | None = 0.1, input_scale: float = 10.0, hidden: int = 64,
                 rest_free: bool = True, plastic: bool = False, major_symmetry: bool = False, state_dependence: str = "full",
                 no_C: bool = False, no_pre: bool = False, no_post: bool = False, no_prior_stress: bool = False) -> None:
        super().__init__()
        if not 0 < alpha < 1:
            raise ConfigError(f"adapter.alpha: expected a number between 0 and 1, found {alpha}")
        if l_max is not None and not l_max > 0:
            raise ConfigError(f"adapter.l_max: expected a positive number or null, found {l_max}")
        if state_dependence not in ("full", "constant"):
            raise ConfigError(f"adapter.state_dependence: expected full or constant, found {state_dependence!r}")
        if no_prior_stress and no_pre:
            raise ConfigError("adapter: no_prior_stress needs L_pre (no_pre=false): the stress comes from it alone")
        self.rest_free, self.major_symmetry, self.no_prior_stress = rest_free, major_symmetry, no_prior_stress
        bound = None if no_prior_stress else l_max  # without the prior the residuals have to carry the whole stress
        shape = {"input_scale": input_scale, "hidden": hidden, "state_dependence": state_dependence, "no_C": no_C, "no_pre": no_pre,
                 "no_post": no_post}
        self.operator = ProgressiveOperator(alpha, bound, no_prior_stress=no_prior_stress, **shape)
        self.plastic_operator = ProgressiveOperator(alpha, l_max, no_prior_stress=False, **shape) if plastic else None
        self.register_buffer("E_ref", torch.tensor(float("nan")))
        self.register_buffer("poisson", torch.tensor(float("nan")))
        self._statistics: OperatorStatistics | None = None

    def switch_on(self, reference_modulus: Tensor, poisson: Tensor | float = 0.3) -> None:
        """Fix E_ref [Pa] and the Poisson number of C0 to the calibrated prior's; they never change afterwards."""
        self.E_ref.fill_(float(reference_modulus))
        self.poisson.fill_(float(poisson))

    def affine(self, operator: ProgressiveOperator, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """(A - I (N, 6, 6), b (N, 6)) of d(w, s) = (A - I) s + b, the rest term included."""
        zero = torch.zeros_like(w[:1])
        M, pre, post, C = operator(torch.cat([w, zero]), torch.cat([s, zero]))
        if self.major_symmetry:
            M = self.symmetrised(M)
        b = (M @ pre[..., None])[..., 0] + post
        if self.rest_free:
            b = b - b[-1:]
        eye = torch.eye(6, dtype=w.dtype, device=w.device)
        G = -eye.expand_as(M) if operator.no_prior_stress else M - eye
        return G[:-1], b[:-1], (C[:-1], pre[:-1], post[:-1])

    def symmetrised(self, M: Tensor) -> Tensor:
        """(A + C0 A^T C0^-1)/2 in Mandel scaling, C0 = 2 mu I + lam 1x1."""
        nu = self.poisson.to(M)
        D = torch.ones(6).to(M)
        D[3:] = 2**0.5
        one = torch.zeros(6).to(M)
        one[:3] = 1
        C0 = torch.eye(6).to(M) + nu / (1 - 2 * nu) * torch.outer(one, one)  # in units of 2 mu
        A = D[:, None] * M / D
        A = 0.5 * (A + C0 @ A.transpose(-1, -2) @ torch.linalg.inv(C0))
        return A / D[:, None] * D

    def redistribution(self, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """(A (N, 6, 6), b (N, 6)) with d(w, s) = (A - I) s + b, for analysis; w, s: (N, 6) dimensionless."""
        G, b, _ = self.affine(self.operator, w, s)
        return G + torch.eye(6).to(G), b

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        """d(w, s) - [rest_free] d(0, 0), (N, 6), in the paper's order of operations (steps 1 to 6)."""
        zero = torch.zeros_like(w[:1])
        w_, s_ = torch.cat([w, zero]), torch.cat([s, zero])
        _, pre, post, C = self.operator(w_, s_)
        eye = torch.eye(3, dtype=w.dtype, device=w.device)
        s1 = pre if self.no_prior_stress else s_ + pre
        d = microplane.stepwise(s1, C[:, :3] + eye, C[:, 3] + eye) + post - s_
        return d[:-1] - d[-1:] if self.rest_free else d[:-1]

    def forward(self, state: MaterialState) -> AdapterOperator:
        """Operator held by the simulator until it asks again; inputs of any float type, networks in their own."""
        outer, inner = state.w.dtype, self.E_ref.dtype
        w = state.w.to(inner)
        G, b, parts = self.affine(self.operator, w, state.stress.to(inner) / self.E_ref)
        self._statistics = statistics(*parts)
        plastic_G = plastic_h = None
        if self.plastic_operator is not None and state.plastic_strain is not None:
            plastic_G, plastic_h, _ = self.affine(self.plastic_operator, w, state.plastic_strain.to(inner))
            plastic_G, plastic_h = plastic_G.to(outer), plastic_h.to(outer)
        return AdapterOperator(G.to(outer), (self.E_ref * b).to(outer), plastic_G, plastic_h)

    def statistics(self) -> OperatorStatistics:
        """Of the last `forward`."""
        return self._statistics


def statistics(C: Tensor, pre: Tensor, post: Tensor) -> OperatorStatistics:
    """Of the corrections C (N, 4, 3, 3) and the residuals (N, 6)."""
    entries = torch.cat([C.flatten(1), pre, post], 1)
    return OperatorStatistics(C.abs().mean(), entries.square().mean(), entries.var(0, unbiased=False).mean())


class DirectAdapter(nn.Module):
    """Black-box comparison: tau_hat = tau + E_ref R mat(l_max tanh net(w, s)) R^T, without the structure of the paper."""

    def __init__(self, l_max: float = 0.1, input_scale: float = 10.0, hidden: int = 64, rest_free: bool = True) -> None:
        super().__init__()
        self.l_max, self.scale, self.rest_free = l_max, input_scale, rest_free
        self.net = mlp(12, 6, hidden)
        zero_rows(self.net[-1])
        self.register_buffer("E_ref", torch.tensor(float("nan")))
        self._statistics: OperatorStatistics | None = None

    def switch_on(self, reference_modulus: Tensor, poisson: Tensor | float = 0.3) -> None:
        """Fix E_ref [Pa]."""
        self.E_ref.fill_(float(reference_modulus))

    def forward(self, state: MaterialState) -> AdapterOperator:
        outer, inner = state.w.dtype, self.E_ref.dtype
        inputs = self.scale * torch.cat([state.w.to(inner), state.stress.to(inner) / self.E_ref], -1)
        b = self.l_max * torch.tanh(self.net(torch.cat([inputs, torch.zeros_like(inputs[:1])])))
        b = b[:-1] - b[-1:] if self.rest_free else b[:-1]
        self._statistics = statistics(torch.zeros(len(b), 4, 3, 3).to(b), b, torch.zeros_like(b))
        return AdapterOperator(torch.zeros(len(b), 6, 6, dtype=outer, device=b.device), (self.E_ref * b).to(outer))

    def statistics(self) -> OperatorStatistics:
        """Of the last `forward`."""
        return self._statistics
