"""An orthotropic law: stress linear in the stretch, in axes fixed to the material. Here to check the
kinematics and the engine with a law that no scene has."""

# ruff: noqa: RUF059
# (Warp: results are unpacked whole)

from dataclasses import dataclass

import torch
import warp as wp
from substep_reference import polar
from torch import Tensor

from mosa.data.synthetic.materials.axes import axes_rotation
from mosa.errors import ConfigError
from mosa.physics.constitutive.kinematics import ROTATION_FLOOR, svd
from mosa.physics.constitutive.laws import LawParameters, register_law

ORTHOTROPIC = "orthotropic_linear"
MODULI = ("C11", "C22", "C33", "C23", "C13", "C12", "C44", "C55", "C66")
"""Stiffnesses [Pa]: B_1 = C11 e_1 + C12 e_2 + C13 e_3, ..., B_23 = 2 C44 e_23, B_13 = 2 C55 e_13, B_12 = 2 C66 e_12."""

_ZERO = wp.constant(wp.float64(0.0))
_TWO = wp.constant(wp.float64(2.0))


@wp.func
def floored(a: wp.float64):
    return wp.max(a, ROTATION_FLOOR)


@wp.func
def lyapunov_value(B: wp.mat33d, S: wp.vec3d, V: wp.mat33d):
    A = wp.transpose(V) * B * V
    s01 = floored(S[0] + S[1])
    s02 = floored(S[0] + S[2])
    s12 = floored(S[1] + S[2])
    X = wp.mat33d(
        A[0, 0] / (_TWO * S[0]), A[0, 1] / s01, A[0, 2] / s02,
        A[1, 0] / s01, A[1, 1] / (_TWO * S[1]), A[1, 2] / s12,
        A[2, 0] / s02, A[2, 1] / s12, A[2, 2] / (_TWO * S[2]),
    )  # fmt: skip
    return V * X * wp.transpose(V)


@wp.func
def lyapunov(W: wp.mat33d, B: wp.mat33d, S: wp.vec3d, V: wp.mat33d):
    """X with W X + X W = B for W = V diag(S) V^T; S, V without gradient (from `svd` of F)."""
    return lyapunov_value(B, S, V)


@wp.func_grad(lyapunov)
def adj_lyapunov(W: wp.mat33d, B: wp.mat33d, S: wp.vec3d, V: wp.mat33d, adj_ret: wp.mat33d):
    # W dX + dX W = dB - dW X - X dW, and the operator on the left is its own adjoint
    X = lyapunov_value(B, S, V)
    Y = lyapunov_value(adj_ret, S, V)
    wp.adjoint[B] += Y
    wp.adjoint[W] += -(Y * wp.transpose(X) + wp.transpose(X) * Y)


@wp.func
def orthotropic_linear(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """B = C : (W - I) in the material axes Q, tau = F X F^T with W X + X W = 2 B, the stress of the energy (W - I):C:(W - I)/2.

    W = R^T F the right stretch; B is the Biot stress, X the second Piola-Kirchhoff one. C isotropic gives
    tau = R B F^T with B = 2 mu (W - I) + lam tr(W - I) I. J > 0 only. p: the nine of MODULI [Pa], r of the axes (3).
    """
    Q = axes_rotation(wp.vec3d(p[9], p[10], p[11]))
    U, S, V = svd(F)
    W = wp.transpose(R) * F
    e = wp.transpose(Q) * (W - wp.identity(n=3, dtype=wp.float64)) * Q
    b11 = p[0] * e[0, 0] + p[5] * e[1, 1] + p[4] * e[2, 2]
    b22 = p[5] * e[0, 0] + p[1] * e[1, 1] + p[3] * e[2, 2]
    b33 = p[4] * e[0, 0] + p[3] * e[1, 1] + p[2] * e[2, 2]
    b23 = p[6] * (e[1, 2] + e[2, 1])
    b13 = p[7] * (e[0, 2] + e[2, 0])
    b12 = p[8] * (e[0, 1] + e[1, 0])
    B = Q * wp.mat33d(b11, b12, b13, b12, b22, b23, b13, b23, b33) * wp.transpose(Q)
    return F * lyapunov(W, _TWO * B, S, V) * wp.transpose(F)


def orthotropic_energy(F: Tensor, axes: Tensor, **moduli: Tensor) -> Tensor:
    """(W - I):C:(W - I)/2 [J/m^3]; F: (N, 3, 3) with det F > 0, axes: (N, 3), moduli by the names of MODULI."""
    W = polar(F).mT @ F
    Q = axes_matrix(axes)
    e = Q.mT @ (W - torch.eye(3, dtype=F.dtype, device=F.device)) @ Q
    d, m = e.diagonal(dim1=-2, dim2=-1), moduli
    normal = m["C11"] * d[..., 0] ** 2 + m["C22"] * d[..., 1] ** 2 + m["C33"] * d[..., 2] ** 2
    coupled = (
        m["C23"] * d[..., 1] * d[..., 2]
        + m["C13"] * d[..., 0] * d[..., 2]
        + m["C12"] * d[..., 0] * d[..., 1]
    )
    shear = (
        m["C44"] * e[..., 1, 2] ** 2 + m["C55"] * e[..., 0, 2] ** 2 + m["C66"] * e[..., 0, 1] ** 2
    )
    return 0.5 * normal + coupled + 2 * shear


def orthotropic_modulus(axes: Tensor, **moduli: Tensor) -> Tensor:
    """Upper bound of the P wave modulus [Pa]: the largest row sum of |C|, which no eigenvalue exceeds (shears count twice)."""
    m = moduli
    rows = [
        m["C11"].abs() + m["C12"].abs() + m["C13"].abs(), m["C12"].abs() + m["C22"].abs() + m["C23"].abs(),
        m["C13"].abs() + m["C23"].abs() + m["C33"].abs(), 2 * m["C44"], 2 * m["C55"], 2 * m["C66"],
    ]  # fmt: skip
    return torch.stack(torch.broadcast_tensors(*rows)).amax(0)


register_law(
    ORTHOTROPIC, orthotropic_linear, {**dict.fromkeys(MODULI, 1), "axes": 3}, uses_rotation=True, needs_positive_J=True,
    modulus=orthotropic_modulus,
)  # fmt: skip


@dataclass(frozen=True)
class OrthotropicMaterial:
    """Engineering constants at small strain. E: (E1, E2, E3) [Pa]; nu: (nu23, nu13, nu12), nu_ij = contraction along j under a
    pull along i; G: (G23, G13, G12) [Pa]; axes: rotation (3, 3) whose columns are the axes 1, 2, 3 at rest, None for x, y, z.

    Errors: ConfigError when the stiffness is not positive definite.
    """

    E: tuple[float, float, float]
    nu: tuple[float, float, float]
    G: tuple[float, float, float]
    axes: Tensor | None = None

    def __post_init__(self) -> None:
        values = torch.linalg.eigvalsh(self._compliance())
        if float(values[0]) <= 0 or min(self.G) <= 0:
            raise ConfigError(
                f"orthotropic material: expected constants of a positive definite stiffness, found E {self.E}, nu {self.nu}, "
                f"G {self.G}; lower the Poisson numbers"
            )

    def _compliance(self) -> Tensor:
        (E1, E2, E3), (nu23, nu13, nu12) = self.E, self.nu
        if min(self.E) <= 0:
            raise ConfigError(
                f"orthotropic material: E: expected positive numbers [Pa], found {self.E}"
            )
        rows = [
            [1 / E1, -nu12 / E1, -nu13 / E1],
            [-nu12 / E1, 1 / E2, -nu23 / E2],
            [-nu13 / E1, -nu23 / E2, 1 / E3],
        ]
        return torch.tensor(rows, dtype=torch.float64)

    def parameters(self) -> dict[str, Tensor]:
        """What the law `orthotropic_linear` takes: the nine of MODULI, () each, and axes (3,)."""
        C = torch.linalg.inv(self._compliance())
        values = {
            "C11": C[0, 0],
            "C22": C[1, 1],
            "C33": C[2, 2],
            "C23": C[1, 2],
            "C13": C[0, 2],
            "C12": C[0, 1],
        }
        values |= {
            name: torch.tensor(g, dtype=torch.float64)
            for name, g in zip(("C44", "C55", "C66"), self.G, strict=True)
        }
        axes = torch.eye(3, dtype=torch.float64) if self.axes is None else self.axes
        return {**values, "axes": axes_parameter(axes)}


def axes_matrix(r: Tensor) -> Tensor:
    """(..., 3, 3) rotation of r (..., 3), as `axes_rotation`; differentiable."""
    zero = torch.zeros_like(r[..., 0])
    rows = [zero, -r[..., 2], r[..., 1], r[..., 2], zero, -r[..., 0], -r[..., 1], r[..., 0], zero]
    K = torch.stack(rows, -1).reshape(*r.shape[:-1], 3, 3)
    return (
        torch.eye(3, dtype=r.dtype, device=r.device)
        + 2 * (K + K @ K) / (1 + (r * r).sum(-1))[..., None, None]
    )


def axes_parameter(axes: Tensor) -> Tensor:
    """(3,) r of `axes_rotation` for a rotation matrix (3, 3) whose columns are the material axes 1, 2, 3 at rest.

    Where the angle is 180 degrees, r would be infinite: two of the axes are then turned round, which is the same orthotropy.
    Errors: ConfigError if axes is no rotation.
    """
    axes = axes.double()
    eye = torch.eye(3, dtype=torch.float64)
    if (
        axes.shape != (3, 3)
        or (axes.mT @ axes - eye).abs().max() > 1e-6
        or torch.linalg.det(axes) < 0
    ):
        raise ConfigError(f"axes: expected a rotation matrix (3, 3), found {axes.tolist()}")
    # 1 + trace = 4 cos^2(angle/2) is at least 1 for one of the four equivalent choices
    signs = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
    choices = axes * signs[:, None, :]
    best = choices[choices.diagonal(dim1=1, dim2=2).sum(1).argmax()]
    skew = torch.stack([best[2, 1] - best[1, 2], best[0, 2] - best[2, 0], best[1, 0] - best[0, 1]])
    return skew / (1 + best.trace())
