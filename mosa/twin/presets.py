"""Known materials to try a twin with: values at room temperature, each with its source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mosa.errors import ConfigError


@dataclass(frozen=True)
class Preset:
    """law, parameters: of `Material`, SI units; density [kg/m^3]; source: where the values come
    from, and what was assumed."""

    law: str
    parameters: Mapping[str, float]
    density: float
    source: str


PRESETS: dict[str, Preset] = {
    "jelly": Preset(
        "neo_hookean",
        {"E": 4.3e3, "nu": 0.45},
        1010.0,
        "gelatine with 20 parts of water: 4.34 +- 0.64 kPa, instantaneous, in compression (Bonavia "
        "2025, arXiv:2512.20502); nu is below the true 0.5; the density was assumed",
    ),
    "silicone_10A": Preset(
        "neo_hookean",
        {"E": 4.1e5, "nu": 0.45},
        1070.0,
        "Gent's relation between Shore A hardness and E, at 10 A (Gent 1958, Rubber Chem. Technol. "
        "31, 896; 0.28 to 0.56 MPa at 5 to 15 A); nu is below the true 0.5; the density is that of "
        "common platinum-cure silicones",
    ),
    "natural_rubber": Preset(
        "neo_hookean",
        {"E": 1.1e6, "nu": 0.45},
        930.0,
        "shear modulus 0.39 MPa of vulcanised rubber (Treloar 1944, Trans. Faraday Soc. 40, 59); "
        "nu is below the true 0.5, which would take ever smaller time steps",
    ),
    "clay": Preset(
        "von_mises",
        {"E": 5.1e6, "nu": 0.45, "yield_stress": 2.4e4},
        1900.0,
        "undrained shear strength 17 kPa at a liquidity index of 0.5 (Wroth and Wood 1978, Can. "
        "Geotech. J. 15, 137; 1.7 to 170 kPa from liquid to plastic limit), times sqrt(2) as this "
        "law measures yield; E is 300 times the strength, a usual ratio",
    ),
    "honey": Preset(
        "newtonian",
        {"mu": 38.0, "kappa": 2e4},
        1420.0,
        "19 Pa s, as clover honey with 16 % water at 20 C (honeys: 1.7 to 270 Pa s at 10 to 30 C, "
        "Ramzi et al., J. Food Biosci. Technol.); mu is twice that, as this law counts it; kappa is "
        "far below the true 2 GPa",
    ),
    "dry_sand": Preset(
        "drucker_prager",
        {"E": 3.5e5, "nu": 0.3, "friction_angle": 33.0, "cohesion": 0.0},
        1600.0,
        "friction angle and bulk density of loose to medium dry sand (Lambe and Whitman 1969, Soil "
        "Mechanics); E of simulated sand (Klar et al. 2016, ACM Trans. Graph. 35, 103), softer than "
        "true sand",
    ),
}


def preset(name: str) -> Preset:
    """Errors: ConfigError naming the known ones."""
    if name not in PRESETS:
        raise ConfigError(f"preset: expected one of {', '.join(PRESETS)}, found {name!r}")
    return PRESETS[name]
