"""Results of the reconstruction's stages on disk, with a picture of each."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor

from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.appearance.lighting import LIGHT
from mosa.rendering.appearance.spherical_harmonics import degree_of
from mosa.system.whole_files import written_whole

log = logging.getLogger(__name__)
SPLATS = {"means": (3,), "scales": (3,), "rotations": (4,), "opacities": (), "colors": (3,)}
RESULTS: dict[str, dict[str, tuple[int, ...]]] = {
    "static": SPLATS, "particles": SPLATS | {"volume": ()}, "motion": {"positions": (3,), "covariances": (3, 3)},
    "carried": SPLATS | {"normals": (3,)},
}  # fmt: skip
"""Tensors of a stage, with their last dimensions."""
LEADING = {"static": 1, "particles": 1, "motion": 2, "carried": 1}
"""How many dimensions are before those, the same in all tensors of a stage."""


def check_result(name: str, result: Any, leading: tuple[int, ...] | None) -> None:
    """Errors: ValueError where a stored result is not one of that stage; names that are not in the table are not looked at."""
    for key, last in RESULTS.get(name, {}).items():
        found = tuple(result[key].shape)
        leading = found[: LEADING[name]] if leading is None else leading
        if found != (*leading, *last) or 0 in found or not bool(torch.isfinite(result[key]).all()):
            raise ValueError(f"{key} of shape {found}, expected {(*leading, *last)} finite numbers")
    if name == "carried":
        light, harmonics = result["light"], result["harmonics"]
        degree_of(harmonics)
        finite = bool(torch.isfinite(light).all() and torch.isfinite(harmonics).all())
        if not finite or light.shape != (LIGHT,) or len(harmonics) != leading[0]:
            raise ValueError(f"expected a light and {leading[0]} splats' harmonics, finite numbers")


class StageCache:
    """Stage results in one folder per (data, settings, spacing, seed); files appear complete or not at all."""

    def __init__(self, root: Path | None, key: Mapping[str, Any]) -> None:
        self.folder = None
        if root is not None:
            digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]
            name = f"{key['scene'].replace('/', '_')[:80]}-{digest}"
            self.folder = Path(root) / "reconstruction" / name
            self.folder.mkdir(parents=True, exist_ok=True)
            file, text = self.folder / "key.json", json.dumps(key, indent=1, sort_keys=True)
            # a cache that has all may be one that is only read
            if not file.is_file() or file.read_bytes() != text.encode():
                with written_whole(file) as partial:
                    partial.write_text(text)

    def stage(
        self, name: str, compute: Callable[[], Any], leading: tuple[int, ...] | None = None
    ) -> Any:
        """The stored result of a stage, or `compute()` stored. A damaged file, or one that holds something else, is computed again.
        leading: lengths that the first dimensions of its tensors have, where they are known."""
        if self.folder is None:
            return compute()
        path = self.folder / f"{name}.pt"
        if path.exists():
            try:
                with zipfile.ZipFile(path) as archive:  # torch does not compare the sums
                    if archive.testzip() is not None:
                        raise ValueError("other bytes than were written")
                result = torch.load(path, map_location="cpu", weights_only=True)
                check_result(name, result, leading)
                return result
            except Exception as error:
                log.warning("%s: cannot be read (%s); this stage is computed again", path, error)
        result = compute()
        try:
            with written_whole(path) as partial, open(partial, "wb") as file:
                torch.save(result, file)
        except RuntimeError as error:  # what torch makes of a disk that is full
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        return result

    def strip(self, name: str, windows: Windows, rendered: Tensor, columns: int = 8) -> None:
        """Real above rendered, one picture per stage."""
        if self.folder is None:
            return
        chosen = np.unique(np.linspace(0, len(windows) - 1, columns).astype(int))
        rows = [torch.cat(list(images[chosen].cpu()), 1) for images in (windows.images, rendered)]
        picture = (torch.cat(rows).clamp(0, 1).numpy() * 255).round().astype(np.uint8)
        with written_whole(self.folder / f"{name}.png") as partial:
            imageio.imwrite(partial, picture, extension=".png")
