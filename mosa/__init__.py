"""Learn a simulator of a deforming object from multi-view video."""

__version__ = "0.1.0"
