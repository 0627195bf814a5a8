"""What the configuration says of a body beside its grid: the prior, its variation in space, the world it moves in."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from mosa.settings import Entries, Names, Section, Settings, Text, Width


class HeterogeneitySettings(Settings):
    """Stiffness over the body: P(X) = P_global (1 + amplitude tanh eta(X)) (paper, section 3.1)."""

    where: ClassVar[str] = "heterogeneity"
    needs: ClassVar[dict[str, str]] = {
        "amplitude kind": "enabled=true",
        "wavelength most": "enabled=true, kind=modes",
        "hidden frequencies": "enabled=true, kind=network",
    }

    enabled: bool = True
    """learn how the stiffness varies over the body"""
    amplitude: float = Field(0.5, gt=0, lt=1)
    """largest relative deviation; the paper's network: 0.2"""
    kind: Literal["modes", "network"] = "modes"
    """modes: a sum of smooth waves, for Gauss-Newton; network: the paper's coordinate network"""
    wavelength: float = Field(0.33, ge=0.02, le=2)
    """modes: shortest wavelength, as a share of the body's longest side"""
    most: Width = 50
    """modes: number of waves, at most, the longest first"""
    hidden: Width = 32
    """network: width of its layers"""
    frequencies: int = Field(2, ge=0, le=32)
    """network: sines and cosines of pi 2^k x that it reads beside x"""


class PriorSection(Settings):
    """The section `prior`: the law, and where its parameters start."""

    where: ClassVar[str] = "prior"

    law: Text
    """name of the law, which `prior=<law>` sets (docs/choosing.md); auto: chosen among `candidates`"""
    parameters: Section
    """parameters of the law by name, in SI units: where a fit starts; the material of mosa-splats"""
    frozen: Names | None = None
    """parameters that are not learned"""
    modulated: Names | None = None
    """parameters that the heterogeneity multiplies; null: the stiffness"""
    candidates: Names | None = None
    """with law=auto: the laws that are calibrated and compared; those that yield or flow only where the body stays deformed"""
    options: Section | None = None
    """options of the law (below); their keys begin with + if its file has none"""


class WorldSection(Settings):
    """The section `world`: what stands in the world beside the scene's ground, gravity and box."""

    where: ClassVar[str] = "world"

    walls: Section | None = None
    """{mode: separate, friction: 0.1}, of the six sides of the box; null: none"""
    colliders: Entries | None = []
    """rigid solids, such as {type: sphere, radius: 0.1, position: [0, 0, 0], mode: separate,
    friction: 0.3, motion: {velocity: [1, 0, 0]}} (docs/twin.md)"""
    driven: Entries | None = []
    """sets of the body's particles that are held, moved or loaded, such as {name: clamp, type: box,
    size: [0.1, 0.1, 0.1], position: [0, 0, 0]} (docs/driven.md)"""
    forces: Entries | None = []
    """forces measured on colliders and driven sets, such as {of: clamp, file: force.csv, sd: 0.02} (docs/driven.md)"""


def names(values: Any) -> tuple[str, ...]:
    """A list of names, or none, as a tuple."""
    return tuple(values or ())
