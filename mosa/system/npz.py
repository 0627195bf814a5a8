"""npz files of a run: written whole or not at all, and read with their sizes checked before memory is asked for."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosa.errors import DataError
from mosa.system.limits import counted
from mosa.system.whole_files import written_whole

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """The arrays, compressed: beside the target first, so that a full disk or a kill leaves no half file under its name."""
    with written_whole(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # numpy declares allow_pickle beside them


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Numbers by name. Errors: DataError naming the file: damaged, of objects, or larger than it says."""
    if not path.is_file():  # a device would be read without end
        raise DataError(f"{path}: expected an npz file, found none")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            size = [sum(entry.file_size for entry in entries)]
            counted(f"{path}: bytes", size, "more than is read", each=1, error=DataError)
            for entry in entries:
                check_entry(archive, entry, path)
        with np.load(path, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except DataError:
        raise
    except Exception as error:  # whatever zip, zlib and numpy find: it is not what its name says
        found = f"a damaged one ({type(error).__name__}: {error})"
        raise DataError(f"{path}: expected a readable npz file, found {found}") from error


def check_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path) -> None:
    """An array has as many bytes as its header says: numpy would believe the header, and ask for that much. Errors: DataError."""
    where = f"{path}: {entry.filename}"
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        if version not in HEADERS:
            raise DataError(
                f"{where}: expected an array of numbers, found one of version {version}"
            )
        shape, _, dtype = HEADERS[version](file)
        if dtype.kind not in "fiub":
            raise DataError(f"{where}: expected numbers, found {dtype}: nothing else is read")
        size = file.tell() + math.prod(shape) * dtype.itemsize
        if min(shape, default=1) < 0 or size != entry.file_size:
            found = f"a header of shape {shape} over {entry.file_size} bytes"
            raise DataError(f"{where}: expected as many numbers as are stored, found {found}")


@dataclass(frozen=True)
class Arrays:
    """What an npz file holds, which may come from a stranger."""

    path: Path
    stored: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, path: Path) -> Arrays:
        """Empty where there is no file. Errors: DataError naming a damaged one."""
        return cls(path, read_npz(path) if path.is_file() else {})

    def entry(self, key: str, *shape: int | None, holes: bool = False) -> np.ndarray | None:
        """Numbers of this shape (None: of any length), None where there are none. holes: NaN may be among them. Errors: DataError
        naming file and entry."""
        found = self.stored.get(key)
        if found is None:
            return None
        fits = len(shape) == found.ndim and all(a in (None, b) for a, b in zip(shape, found.shape))
        if not fits or found.dtype.kind != "f" or not (holes or np.isfinite(found).all()):
            said = ", ".join("any" if each is None else str(each) for each in shape)
            raise DataError(
                f"{self.path}: {key}: expected finite floating point numbers of shape ({said}), found {found.dtype} "
                f"{found.shape}; all files must be of one run"
            )
        return found
