"""What the configuration says of an identification: which prior the learned numbers have, and the noise."""

from __future__ import annotations

from dataclasses import dataclass

from mosa.schema import FLAG, POSITIVE, WEIGHT, check_knobs, knob, number, whole


@dataclass(frozen=True)
class IdentificationSettings:
    """count: independent data in a frame; grid_error: what the grid gets wrong, in differences from a grid `COARSER` times as
    coarse (`Identification`), 0 for none; model_error: what is wrong beside that, in cells; operator_sd, stiffness_sd: prior
    standard deviations of the operator's numbers and of the stiffness modes before the evidence finds their factor; smoothness:
    power with which that of the modes falls with their wave number; evidence: whether it is found; tolerance: of the last step, in
    posterior standard deviations; threads: rollouts side by side on a CPU, 0 for one a core. Errors: ConfigError naming the key."""

    count: float = knob(30.0, POSITIVE)
    grid_error: float = knob(1.0, number(0, 10))
    model_error: float = knob(0.02, number(0, 1))
    operator_sd: float = knob(0.1, POSITIVE)
    stiffness_sd: float = knob(0.12, POSITIVE)
    smoothness: float = knob(1.0, WEIGHT)
    evidence: bool = knob(True, FLAG)
    tolerance: float = knob(0.3, POSITIVE)
    threads: int = knob(0, whole(0, 256))

    def __post_init__(self) -> None:
        check_knobs(self, "identification")
