"""Learn a simulator of a deforming object from multi-view video."""

from mosa.caches import settle_caches

__version__ = "0.1.0"
settle_caches()
