"""How a law is taken: what the paper leaves open and public simulators do in ways of their own."""

from __future__ import annotations

from typing import ClassVar, Literal

from mosa.settings import Settings, Weight


class LawOptions(Settings):
    """The section `prior.options`. Errors: ConfigError naming the field."""

    where: ClassVar[str] = "prior.options"

    yield_convention: Literal["paper", "sqrt23"] = "paper"
    """what yield_stress is in von_mises: paper: the largest norm of dev tau; sqrt23: the uniaxial yield
    stress, sqrt(3/2) times that norm (PAC-NeRF)"""
    friction_cone: Literal["klar", "printed"] = "klar"
    """Drucker-Prager's slope of an angle phi: klar: sqrt(2/3) 2 sin phi/(3 - sin phi); printed: the
    root over all of it, as the paper prints"""
    norm_eps: Weight = 0.0
    """number added under the root of yield norms"""
    rebuild: bool = False
    """write U S V^T back also where nothing yielded (PAC-NeRF does)"""
    on_inversion: Literal["warn", "ignore", "error"] = "warn"
    """reaction to det F <= 0 in laws that have a stress there; in others it is an error"""
    init_affine: Literal["spin", "zero"] = "spin"
    """spin takes a start's C_affine, zero replaces it by 0"""
    mean_volume: bool = False
    """the stress takes the mean change of volume around a particle in place of its own: a nearly
    incompressible body or liquid does not lock"""
    mass_cutoff: float | None = None
    """node mass [kg] above which a node has a velocity; null: 0 in float64, 1e-12 of a particle's
    in float32"""


AS_USUAL = LawOptions()
