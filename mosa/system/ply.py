"""What a PLY file says it holds is compared with its size before a reader asks for that much memory."""

from __future__ import annotations

from pathlib import Path

from mosa.errors import DataError

HEADER = 1 << 16
"""Bytes that a header may have."""


def check_ply(path: Path) -> None:
    """Errors: DataError where the file has no header of a PLY, or claims more elements than it has bytes."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER)
    header, end, _ = head.partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise DataError(
            f"{path}: expected a PLY file, found none (no header from ply to end_header in its first {HEADER} bytes)"
        )
    element, properties = b"", 0
    for line in header.splitlines():
        words = line.split()
        element, properties = (
            (line, 0)
            if words[:1] == [b"element"]
            else (element, properties + (words[:1] == [b"property"]))
        )
        words = element.split()  # each of its properties takes a byte at least
        if words and (
            len(words) != 3
            or not words[2].isdigit()
            or len(words[2]) > 18
            or int(words[2]) * max(properties, 1) > size
        ):
            raise DataError(
                f"{path}: expected a PLY file whose elements fit into its {size} bytes, found "
                f"{element[:80].decode(errors='replace')!r}"
            )
