"""Typed errors: every mistake of a user ends in one of these, with a message that says what to do."""

from __future__ import annotations

LONGEST = 2000  # characters of a message; what was found may be a file's worth of text


class MosaError(Exception):
    """Base of every error this package raises on purpose. `train.py` and `eval.py` print it without a traceback."""

    def __str__(self) -> str:
        message = " ".join(super().__str__().splitlines())  # one line, whatever was found
        if len(message) <= LONGEST:
            return message
        return f"{message[: LONGEST - 500]} ... {message[-500:]}"


class DataError(MosaError):
    """A file or folder is missing, malformed, or contradicts another."""


class ConfigError(MosaError):
    """A configuration value is unknown, out of range, or contradicts another."""


class SimulationDiverged(MosaError):
    """The simulation left the domain of its law or its grid, or produced non-finite numbers."""
