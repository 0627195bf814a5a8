"""Differentiable MLS-MPM in NVIDIA Warp behind torch operations.

`constitutive`: laws; `grid`: transfers; `contact`: planes that nodes of a grid meet, planes and solids that particles meet;
`engine`: what advances a body with them, for a user `engine.simulator.Simulator`; `reference`: the pure-torch float64 twin of a
substep; `launching`: what all kernels are launched with; `memory_sums`: sums on a GPU that no thread waits for. A part imports
those that it needs below it, never one above it (tests/physics/engine/test_engine_parts.py).
"""

from mosa.system.warp_start import start_warp

start_warp()

from mosa.physics import constitutive  # noqa: E402, F401  the built-in laws register themselves
