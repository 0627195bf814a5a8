"""What of a body and its world is needed to show a motion, and `body.npz`, which keeps it beside an exported one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mosa.config.checkpoints import TENSORS, check_tensors
from mosa.config.record import SplatsRecord
from mosa.errors import DataError, MosaError
from mosa.modules.body.body import Body, World
from mosa.rendering.appearance.carried_splats import CarriedSplats
from mosa.system.npz import Arrays, read_npz, write_npz
from mosa.types import Ground

FILE = "body.npz"
SPLATS = "splats/"  # before the names of the carried splats' tensors in the file


@dataclass(frozen=True)
class ShownBody:
    """rest: (N, 3) [m]; colors: (N, 3) in [0, 1]; opacities: (N,); covariances: (N, 3, 3) [m^2] at rest; factor: (N,) by which a
    particle's stiffness differs from the law's; splats: what the particles carry, None where they are what is shown."""

    rest: Tensor
    colors: Tensor
    opacities: Tensor
    covariances: Tensor
    factor: Tensor
    splats: CarriedSplats | None
    world: World

    @classmethod
    def of(cls, body: Body, world: World) -> ShownBody:
        with torch.no_grad():
            factor = body.factor(body.heterogeneity)
        return cls(
            body.rest, body.colors, body.opacities, body.covariances, factor, body.splats, world
        )

    @classmethod
    def read(cls, path: Path) -> ShownBody:
        """Of a file that `save_body` wrote, as plain numbers. Its world has a ground and a vertical, no solids and no pull.
        Errors: DataError naming file and part."""
        file = Arrays(path, read_npz(path))
        found = {name: torch.from_numpy(array) for name, array in file.stored.items()}
        written = {
            name.removeprefix(SPLATS): t for name, t in found.items() if name.startswith(SPLATS)
        }
        try:
            check_tensors({name: found.get(name) for name in TENSORS})
            known = SplatsRecord.read(written, "splats").plain() if written else None
        except MosaError as error:
            raise DataError(f"{path}: {error}") from error
        splats = None if known is None else CarriedSplats.read(known, found["rest"])
        factor, up = file.entry("factor", len(found["rest"])), file.entry("up", 3)
        ground = file.entry("ground")
        if factor is None or up is None or not up.any():
            raise DataError(f"{path}: factor, up: expected both, and a direction that is not 0")
        vertical = torch.from_numpy(up).float()
        met = None if ground is None else Ground(float(ground))
        world = World(met, torch.zeros(3), vertical / vertical.norm(), torch.zeros(2, 3))
        parts = (
            found[name].float() for name in ("rest", "colors", "opacities", "covariances", "factor")
        )
        return cls(*parts, splats, world)


def save_body(path: str | Path, body: Body, world: World) -> None:
    """npz of the tensors of a body (rest [m], volume [m^3], colors, opacities, covariances [m^2]), factor (N,), up (3,), ground ()
    [m] where there is one, and of the splats that it carries under `splats/`."""
    shown = ShownBody.of(body, world)
    tensors = {name: getattr(body, name) for name in TENSORS} | {
        "factor": shown.factor,
        "up": world.up.float(),
    }
    if world.ground is not None:
        tensors["ground"] = torch.tensor(float(world.ground.height))
    if body.splats is not None:
        tensors |= {SPLATS + name: value for name, value in body.splats.written().items()}
    write_npz(path, {name: value.detach().cpu().numpy() for name, value in tensors.items()})
