"""Differentiable MLS-MPM in NVIDIA Warp behind torch operations; `reference` is its pure-torch float64 twin."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # lines on every small module compiled would drown the program's own
wp.init()

from mosa.physics import elasticity, mixture, plasticity, viscosity  # noqa: E402, F401  the built-in laws register themselves
