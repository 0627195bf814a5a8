"""Differentiable MLS-MPM in NVIDIA Warp behind torch operations.

`constitutive`: laws; `grid`: transfers; `contact`: planes and colliders; `engine`: what advances a body, from which `Simulator` is
what a user starts with; `reference`: the pure-torch float64 twin of a substep.
"""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # lines on every small module compiled would drown the program's own
wp.init()

from mosa.physics import constitutive  # noqa: E402, F401  the built-in laws register themselves
