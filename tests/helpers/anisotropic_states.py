"""Deformation gradients, rotations and evaluations shared by the tests of the anisotropic truth laws."""

import torch
from substep_reference import polar, unvech

from mosa.physics.engine.material_operations import first_advance
from mosa.physics.engine.simulator import Simulator


def drawn_rotations(count: int, seed: int) -> torch.Tensor:
    """(count, 3, 3) float64."""
    generator = torch.Generator().manual_seed(seed)
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * torch.sign(R.diagonal(dim1=-2, dim2=-1))[:, None, :]
    return Q * torch.linalg.det(Q)[:, None, None]


def drawn_states(seed: int = 0) -> torch.Tensor:
    """(M, 3, 3) float64 with J > 0: F = I, equal and two equal singular values, simple shears, generic ones."""
    generator = torch.Generator().manual_seed(seed)
    eye = torch.eye(3, dtype=torch.float64)
    shear = eye.repeat(3, 1, 1)
    for i, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        shear[i, a, b] = 0.4
    U, V = drawn_rotations(6, seed + 1), drawn_rotations(6, seed + 2)
    values = torch.tensor(
        [
            [1.2, 1.2, 1.2],
            [1.3, 0.8, 0.8],
            [1.1, 1.1 + 1e-9, 0.9],
            [1.5, 1.1, 0.6],
            [1.0, 1.0, 0.7],
            [1.6, 1, 1],
        ]
    )
    spectral = U @ torch.diag_embed(values.double()) @ V.mT
    generic = eye + 0.25 * torch.randn(40, 3, 3, generator=generator, dtype=torch.float64)
    generic = generic[torch.linalg.det(generic) > 0.3]
    return torch.cat([eye[None], shear, spectral, generic])


def simulator(law: str) -> Simulator:
    return Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=torch.float64)


def stress(law: str, F: torch.Tensor, parameters: dict) -> torch.Tensor:
    """Kirchhoff stress (N, 3, 3) through the simulator's own kernel, differentiable; F: (N, 3, 3) with J > 0."""
    R = polar(F)
    return (
        R @ unvech(simulator(law).material_state(F, torch.zeros_like(F), parameters).stress) @ R.mT
    )


def mapped(law: str, F: torch.Tensor, parameters: dict) -> torch.Tensor:
    """Return mapping of trial gradients F (N, 3, 3)."""
    sim = simulator(law)
    return first_advance(sim.numerics, F, torch.zeros_like(F), sim.pack(parameters, len(F)))


def check_gradients(
    function, leaves: dict[str, torch.Tensor], seed: int, steps: tuple[float, float] = (4e-4, 1e-4)
) -> None:
    """Gradients of function(**leaves) (one number per particle) against differences, rtol 1e-6 per particle.

    A particle whose two differences disagree lies within a step of a switch, where there is no derivative to compare with.
    """
    generator = torch.Generator().manual_seed(seed)
    inputs = {name: value.clone().requires_grad_() for name, value in leaves.items()}
    gradients = torch.autograd.grad(function(**inputs).sum(), list(inputs.values()))
    for (name, value), gradient in zip(leaves.items(), gradients, strict=True):
        n = len(value)
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        direction = direction / direction.reshape(n, -1).norm(dim=1).reshape(
            n, *[1] * (value.ndim - 1)
        )

        def difference(h, name=name, value=value, direction=direction):
            f = lambda s: function(**{**leaves, name: value + s * direction}).detach()  # noqa: E731
            return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

        coarse, fine = (difference(h) for h in steps)
        scale = gradient.reshape(n, -1).norm(dim=1).clamp_min(1.0)
        smooth = (coarse - fine).abs() < 1e-6 * scale
        assert smooth.double().mean() > 0.8, name
        error = ((gradient * direction).reshape(n, -1).sum(1) - fine).abs() / scale
        assert error[smooth].max() < 1e-6, (name, int(error.argmax()), float(error[smooth].max()))
        assert gradient.abs().max() > 0, name
