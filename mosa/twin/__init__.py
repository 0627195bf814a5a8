"""The learned twin in use: `from mosa.twin import Twin`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mosa.twin.twin import Twin

__all__ = ["Twin"]


def __getattr__(name: str) -> type[Twin]:
    """The module is imported when the class is asked for: others of the package are needed by what it imports."""
    if name == "Twin":
        from mosa.twin.twin import Twin

        return Twin
    raise AttributeError(f"module 'mosa.twin' has no attribute {name!r}")
