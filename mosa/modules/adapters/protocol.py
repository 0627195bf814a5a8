"""What an adapter is asked by the rest of the program, in one place: whatever answers this can be named in a configuration.

The simulator asks for operators, the fit for penalties and for what the time step has to allow, the analysis for what the law is
like. Nobody asks which adapter it is. `mosa.modules.adapters.base.Adapter` answers all of it but the operator itself, so that a new
adapter writes what is different about it; no adapter at all is `None`, the prior alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from torch import Tensor

from mosa.modules.adapters.penalties import OperatorStatistics, Penalty
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.physics.constitutive.laws import Law


class AdapterProtocol(Protocol):
    """A correction of the prior's law, a `torch.nn.Module` whose keyword arguments are the keys of its YAML.

    It starts at the prior, bounds what it adds, and works in the material frame, where stresses are R^T tau R and vech order is
    xx, yy, zz, yz, zx, xy. N is the number of particles asked about.
    """

    E_ref: Tensor
    """() [Pa], the unit of its stress, fixed by `switch_on`; not a number before."""
    poisson: Tensor
    """() Poisson number of the prior at that moment."""
    energetic: bool
    """Whether G is a stiffness, of an energy in Green's strain; else it acts on the prior's stress."""
    few_numbers: bool
    """Whether all that it learns is one parameter, `numbers`, of so few numbers that Gauss-Newton can learn them."""
    replaces_law: bool
    """Whether nothing of the prior is left in the answer: its stage then holds the prior's parameters, which would only drift."""
    own_dynamics: bool
    """Whether it moves the particles itself, without a law and a grid (`simulator`)."""
    penalties: Mapping[str, Penalty]
    """Terms of the loss that it brings, by name; their weights are `losses.<name>`."""
    flow: Callable[[Tensor, float], Tensor] | None
    """F (N, 3, 3) after plastic flow for a time [s], in place of the law's return mapping; None where that stays."""

    @property
    def is_on(self) -> bool:
        """Whether `switch_on` was called, here or in the run that the weights come from."""

    @property
    def steady(self) -> bool:
        """Whether the operator is the same in every state, so that one evaluation serves a whole rollout."""

    # ---------------------------------------------------------------- before its stage
    def unsuited(self, law: Law) -> str | None:
        """Why it can correct nothing of a body of this law: it is left out then, with this as a warning. None where it can."""

    def settle(self, rest: Tensor, volume: Tensor) -> None:
        """Told once about the body: rest (N, 3) [m], volume (N,) [m^3]. Errors: ConfigError."""

    def switch_on(self, reference_modulus: Tensor | float, poisson: Tensor | float = 0.3) -> None:
        """Fix E_ref [Pa] and the Poisson number of C0 to those of the calibrated prior. Errors: ConfigError for others later."""

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        """Called once after `switch_on`, when its stage begins: networks that stand in for the prior start from it.

        law: the prior's name; states: of `mosa.modules.body.material.material_states`, at its calibrated parameters.
        Errors: ConfigError where it cannot be used with this law."""

    # ---------------------------------------------------------------- in a rollout
    def follow(self, poisson: Tensor) -> None:
        """Told before every rollout: the prior's Poisson number at that moment, (), with its graph."""

    def stiffening(self, poisson: Tensor | float) -> float:
        """Modulus over the prior's that the time step allows for, at least 1; poisson: the prior's."""

    def __call__(self, state: MaterialState) -> AdapterOperator:
        """The operator at N states, held until it is asked again: G (N, 6, 6), h (N, 6) [Pa], of the states' type and device.

        Errors: ConfigError before `switch_on`."""

    def statistics(self) -> OperatorStatistics:
        """Of the last evaluation, with its graph. Errors: ConfigError before the first, unless it is `steady`."""

    def simulator(self, density: float, world: Any, frame_dt: float) -> Any:
        """What rolls its own dynamics out, with the `rollout` of `Simulator`; None where a law on the grid is simulated.

        density [kg/m^3], world: `mosa.physics.world.World`, frame_dt [s]. Errors: ConfigError."""

    # ---------------------------------------------------------------- in the analysis
    def in_double(self) -> AdapterProtocol:
        """A copy in float64 on the CPU, without gradients of its weights. Errors: ConfigError where it is not on."""

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        """(N, 6) stress that is added to the prior's s (N, 6), both in units of E_ref, at stretches w (N, 6) = vech(W - I), with
        gradients in both; of a stiffness, to first order in the strain."""

    def stiffness(self) -> Tensor | None:
        """(6, 6) float64 of the learned law at rest, in Mandel scaling and units of 2 mu, where the operator is a stiffness; None
        where it acts on the prior's stress."""
