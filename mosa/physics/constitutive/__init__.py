"""What a particle's material does: laws, return mappings, kinematics, and the kernels that evaluate them.

Importing it registers the built-in laws."""

from mosa.physics.constitutive import (  # noqa: F401  each registers its laws
    damping,
    elasticity,
    fibres,
    mixture,
    plasticity,
    rubber,
    viscosity,
)
