"""Results of the reconstruction's stages on disk, with a picture of each."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor

from mosa.reconstruction.observed import Windows

log = logging.getLogger(__name__)


class StageCache:
    """Stage results in one folder per (data, settings, spacing, seed); files appear complete or not at all."""

    def __init__(self, root: Path | None, key: Mapping[str, Any]) -> None:
        self.folder = None
        if root is not None:
            digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]
            self.folder = Path(root) / "reconstruction" / f"{key['scene']}-{digest}"
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "key.json").write_text(json.dumps(key, indent=1, sort_keys=True))

    def stage(self, name: str, compute: Callable[[], Any]) -> Any:
        """The stored result of a stage, or `compute()` stored. A damaged file is computed again."""
        if self.folder is None:
            return compute()
        path = self.folder / f"{name}.pt"
        if path.exists():
            try:
                return torch.load(path, map_location="cpu", weights_only=True)
            except Exception as error:
                log.warning("%s: cannot be read (%s); this stage is computed again", path, error)
        result = compute()
        partial = path.with_suffix(f".{os.getpid()}.tmp")
        torch.save(result, partial)
        os.replace(partial, path)
        return result

    def strip(self, name: str, windows: Windows, rendered: Tensor, columns: int = 8) -> None:
        """Real above rendered, one picture per stage."""
        if self.folder is None:
            return
        chosen = np.unique(np.linspace(0, len(windows) - 1, columns).astype(int))
        rows = [torch.cat(list(images[chosen].cpu()), 1) for images in (windows.images, rendered)]
        imageio.imwrite(self.folder / f"{name}.png", (torch.cat(rows).clamp(0, 1).numpy() * 255).round().astype(np.uint8))
