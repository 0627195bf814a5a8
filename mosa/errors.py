"""Typed errors: every mistake of a user ends in one of these, with a message that says what to do."""

from __future__ import annotations


class MosaError(Exception):
    """Base of every error this package raises on purpose. `train.py` and `eval.py` print it without a traceback."""


class DataError(MosaError):
    """A file or folder is missing, malformed, or contradicts another."""


class ConfigError(MosaError):
    """A configuration value is unknown, out of range, or contradicts another."""


class SimulationDiverged(MosaError):
    """The simulation left the domain of its law or its grid, or produced non-finite numbers."""
