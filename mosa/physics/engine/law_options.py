"""How a law is taken: what the paper leaves open and public simulators do in ways of their own."""

from dataclasses import dataclass

from mosa.physics.constitutive.plasticity import YIELD_CONVENTIONS
from mosa.schema import FLAG, WEIGHT, check_knobs, knob, one_of


@dataclass(frozen=True)
class LawOptions:
    """yield_convention: paper | sqrt23, of von Mises. norm_eps: under the root of yield norms. rebuild: write U S V^T back also
    where nothing yielded (PAC-NeRF does). on_inversion: warn | ignore | error for det F <= 0 where the law has a value there; it is
    an error where it has none. init_affine: `spin` takes a start's C_affine, `zero` replaces it by 0. mass_cutoff: node mass [kg]
    above which a node has a velocity (None: 0 in float64, 1e-12 of a particle's in float32), no key of a configuration.
    Errors: ConfigError naming the field."""

    yield_convention: str = knob("paper", one_of(*YIELD_CONVENTIONS))
    norm_eps: float = knob(0.0, WEIGHT)
    rebuild: bool = knob(False, FLAG)
    on_inversion: str = knob("warn", one_of("warn", "ignore", "error"))
    init_affine: str = knob("spin", one_of("spin", "zero"))
    mass_cutoff: float | None = None

    def __post_init__(self) -> None:
        check_knobs(self, "prior.options")


AS_USUAL = LawOptions()
