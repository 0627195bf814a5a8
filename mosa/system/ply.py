"""What a PLY file says it holds is compared with its size before a reader asks for that much memory."""

from __future__ import annotations

from pathlib import Path

from mosa.errors import DataError

BEGINNINGS = {
    b"version https://git-lfs": "a pointer of Git LFS; git lfs pull fetches the file itself",
    b"\x1f\x8b": "a gzip file, as .spz is; export it as a 3DGS .ply that is not compressed",
    b"PK\x03\x04": "a zip file, as .sog is; export it as a 3DGS .ply that is not compressed",
    b"<": "a web page or XML; download the file itself",
    b"{": "a text in JSON; give the file that it describes",
}
"""Of files that lie where another one is expected."""
HEADER = 1 << 16  # bytes that a header may have


def named(path: Path) -> str:
    """What a file is that is not what its reader expects, with the way out; without a known beginning, damaged or another one."""
    with path.open("rb") as file:
        head = file.read(64)
    if path.suffix == ".splat":
        return "a .splat file; export it as a 3DGS .ply that is not compressed"
    found = next((told for start, told in BEGINNINGS.items() if head.startswith(start)), None)
    return (
        found or f"a damaged or other one of {path.stat().st_size} bytes; copy or export it again"
    )


def check_ply(path: Path) -> None:
    """Errors: DataError where the file has no header of a PLY, or claims more elements than it has bytes."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER)
    header, end, _ = head.partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise DataError(
            f"{path}: expected a PLY file, which has a header from ply to end_header, found {named(path)}"
        )
    element, properties = b"", 0
    for line in header.splitlines():
        words = line.split()
        if words[:1] == [b"element"]:
            element, properties = (line, 0)
        else:
            element, properties = (element, properties + (words[:1] == [b"property"]))
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
