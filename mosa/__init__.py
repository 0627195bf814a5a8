"""Learn a simulator of a deforming object from multi-view video.

Public names, each imported when it is first asked for:

    compose           a run's configuration, as the command line composes it
    SceneDataModule   the data of a scene under Lightning: films, reconstruction, batches of frames with their motion cues
    LitMosa           the LightningModule: a body in its world, fitted in stages
    Twin              a learned body, to simulate from new starts
    check_law         whether a law of one's own is objective, symmetric and has an energy"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mosa.system.caches import settle_caches

__version__ = "0.2.0"
settle_caches()

_PLACES = {
    "compose": "mosa.config.composition",
    "SceneDataModule": "mosa.training.datamodule",
    "LitMosa": "mosa.training.lit_mosa",
    "Twin": "mosa.twin",
    "check_law": "mosa.evaluation.analysis.law_stress",
}
__all__ = ["LitMosa", "SceneDataModule", "Twin", "__version__", "check_law", "compose"]

if TYPE_CHECKING:
    from mosa.config.composition import compose
    from mosa.evaluation.analysis.law_stress import check_law
    from mosa.training.datamodule import SceneDataModule
    from mosa.training.lit_mosa import LitMosa
    from mosa.twin.twin import Twin


def __getattr__(name: str) -> Any:
    """`import mosa` takes no second: what needs torch and Warp is imported by its name."""
    if name in _PLACES:
        return getattr(importlib.import_module(_PLACES[name]), name)
    raise AttributeError(f"module 'mosa' has no attribute {name!r}")
