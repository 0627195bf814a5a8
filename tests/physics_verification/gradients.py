"""Gradient of rollouts with the full adapter against differences (check 18), and in float32 against float64 (check 19)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from bodies import (
    DENSITY,
    NU,
    VALUES,
    E,
    agitated,
    is_fluid,
    parameters_of,
    random_adapter,
    uniform_volume,
)
from torch import Tensor

from mosa.physics.constitutive.elasticity import lame
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground

DX, SPACING, DT = 0.04, 0.02, 2e-4
STEPS = {"E": 20.0, "nu": 2e-4, "mu": 1e-3, "kappa": 50.0, "yield_stress": 0.2, "viscosity": 1e-2, "friction_alpha": 1e-4,
         "cohesion": 1e-6, "v0": 1e-3, "weights": 2e-4, "second_share": 1e-3, "yeoh_2": 1e-2, "yeoh_3": 1e-1, "alpha_1": 1e-3,
         "alpha_2": 1e-3, "alpha_3": 1e-3, "share_2": 1e-3, "share_3": 1e-3, "fibre_stiffness": 5.0, "second_fibre_stiffness": 5.0,
         "fibre_exponent": 2e-2, "dispersion": 1e-4, "fibre": 1e-4, "second_fibre": 1e-4}  # fmt: skip
"""Steps h of the fourth-order difference (8 (f(h) - f(-h)) - f(2h) + f(-2h))/(12 h): error h^4 f^(5)/30 + 1e-16 f/h."""


class Comparison(NamedTuple):
    """error: of the gradient against the difference at h, relative; spread: of the differences at h and 10 h, None if not made."""

    error: float
    spread: float | None


class Case:
    """A block with the full adapter, random last layers and E_ref fixed; the loss reads x, v and F_tot at the end.

    contact: falls onto a sticky ground and a wall with friction; otherwise it flies and vibrates, which is a smooth path.
    """

    def __init__(self, law: str, substeps: int, *, contact: bool = False, stride: int = 5, dtype=torch.float64,
                 adapted: bool = True, friction: float = 0.3, recompute: bool = False) -> None:  # fmt: skip
        self.law, self.stride = law, stride
        self.state = agitated(
            4,
            SPACING,
            (0.11, 0.012 if contact else 0.5, 0.07),
            dtype=dtype,
            strain=0.01,
            jitter=0.2,
        )
        self.volume = uniform_volume(self.state, SPACING)
        ground = Ground(0.0, "separate", friction) if contact else None
        self.sim = Simulator(
            law, dx=DX, substeps=substeps, frame_dt=substeps * DT, ground=ground, dtype=dtype
        )
        self.adapter = None
        if adapted:
            self.adapter = random_adapter(
                size=0.1, dtype=dtype, plastic=self.sim.law.plastic, recompute=recompute
            )
        names = [name for name in parameters_of(law) if name not in ("mu", "lam", "kappa")]
        elastic = (
            {"mu": parameters_of(law)["mu"], "kappa": VALUES["kappa"]}
            if is_fluid(law)
            else {"E": E, "nu": NU}
        )
        values = {**elastic, **{name: VALUES[name] for name in names}, "v0": (0.0, 0.0, 0.0)}
        self.leaves = {
            k: torch.as_tensor(v).to(dtype, copy=True).requires_grad_() for k, v in values.items()
        }
        g = torch.Generator().manual_seed(9)
        n = len(self.state.x)
        shapes = {"x": (n, 3), "v": (n, 3), "F_tot": (n, 3, 3)}
        self.probes = {
            k: torch.randn(*s, generator=g, dtype=torch.float64).to(dtype)
            for k, s in shapes.items()
        }

    def loss(self, leaves: dict[str, Tensor] | None = None) -> Tensor:
        leaves = leaves or self.leaves
        wanted = self.sim.law.parameters
        values = {k: v for k, v in leaves.items() if k in wanted}
        if "E" in leaves:
            mu, lam = lame(leaves["E"], leaves["nu"])
            moduli = {"mu": mu, "lam": lam, "kappa": lam + 2 * mu / 3}
            values |= {k: v for k, v in moduli.items() if k in wanted}
        start = replace(self.state, v=self.state.v + leaves["v0"])
        final = self.sim.rollout(
            start, values, self.volume, DENSITY, 2, adapter=self.adapter, stride=self.stride
        ).final
        return sum((probe * getattr(final, name)).sum() for name, probe in self.probes.items())

    def weights(self) -> list[Tensor]:
        return (
            []
            if self.adapter is None
            else [p for p in self.adapter.parameters() if p.requires_grad]
        )

    def gradient(self) -> dict[str, Tensor]:
        """By name; `weights`: all of the networks' in one vector."""
        found = torch.autograd.grad(self.loss(), [*self.leaves.values(), *self.weights()])
        result = dict(zip(self.leaves, found))
        if self.weights():
            result["weights"] = torch.cat([g.flatten() for g in found[len(self.leaves) :]])
        return result

    def difference(self, name: str, direction: Tensor, h: float) -> float:
        def at(s: float) -> float:
            with torch.no_grad():
                if name != "weights":
                    return float(
                        self.loss({**self.leaves, name: self.leaves[name] + s * direction})
                    )
                parts = direction.split([w.numel() for w in self.weights()])
                for w, d in zip(self.weights(), parts):
                    w.add_(s * d.view_as(w))
                value = float(self.loss())
                for w, d in zip(self.weights(), parts):
                    w.sub_(s * d.view_as(w))
                return value

        return (8 * (at(h) - at(-h)) - at(2 * h) + at(-2 * h)) / (12 * h)

    def compare(
        self, *, both_steps: bool, names: tuple[str, ...] | None = None, scale: float = 1.0
    ) -> dict[str, Comparison]:
        """Per parameter, along one random direction. scale: factor on `STEPS`; both_steps: also the difference at 10 h."""
        g = torch.Generator().manual_seed(4)
        result = {}
        for name, gradient in self.gradient().items():
            direction = torch.randn(gradient.shape, generator=g, dtype=torch.float64)
            if names is not None and name not in names:
                continue
            h = scale * STEPS[name]
            value = float((gradient * direction).sum())
            fine = self.difference(name, direction, h)
            error, spread = abs(value - fine) / max(abs(fine), 1e-300), None
            if both_steps:
                coarse = self.difference(name, direction, 10 * h)
                spread = abs(coarse - fine) / max(abs(fine), 1e-300)
            result[name] = Comparison(error, spread)
        return result
