"""What a run's files become for the viewer: motions, what is measured between them, and its colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from mosa.errors import ConfigError, DataError
from mosa.modules.body import World
from mosa.modules.observer import deformed_covariances
from mosa.twin import Twin

COLORS = ("appearance", "heterogeneity", "deviation")
DISTANCE = 1.4
"""Between the two bodies, in widths of what they take up together."""
GRAY = 0.6
"""Of what has no value, and of the observed body where it lies over the learned one: white would not be seen on viser's white."""


@dataclass(frozen=True)
class Scale:
    """Colours of a quantity: `colors` (of matplotlib) over low to high, in the unit that `label` names. beyond: max where values
    can lie above high, which the legend then shows."""

    label: str
    colors: str
    low: float
    high: float
    beyond: str = "neither"

    def paint(self, values: np.ndarray) -> np.ndarray:
        """(N, 3) colours in [0, 1] of (N,) values."""
        return matplotlib.colormaps[self.colors]((values - self.low) / (self.high - self.low))[:, :3]

    def legend(self) -> np.ndarray:
        """(H, W, 3) picture of the colour bar, 8 bit."""
        figure = Figure(figsize=(3.2, 0.7), dpi=200, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        shown = ScalarMappable(Normalize(self.low, self.high), self.colors)
        bar = figure.colorbar(shown, cax=figure.add_subplot(), orientation="horizontal", extend=self.beyond)
        bar.set_label(self.label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@dataclass(frozen=True)
class Motion:
    """N splats over T frames: centers (T, N, 3) [m], covariances (T, N, 3, 3) [m^2]."""

    centers: np.ndarray
    covariances: np.ndarray


@dataclass(frozen=True)
class Clip:
    """A sequence of a run. times: (T,) [s]; learned: over all frames; observed: over the frames that were learned from, or None;
    appearance: (N, 3) in [0, 1]; opacities: (N,); factor: (N,) 1 + a tanh eta, by which a particle's stiffness
    differs from the law's."""

    name: str
    times: np.ndarray
    learned: Motion
    observed: Motion | None
    appearance: np.ndarray
    opacities: np.ndarray
    factor: np.ndarray
    world: World

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector."""
        return self.world.up.numpy()

    @property
    def size(self) -> float:
        """Largest extent of the body at the start [m]."""
        return float(np.ptp(self.learned.centers[0], axis=0).max())

    @property
    def across(self) -> np.ndarray:
        """(3,) horizontal unit vector, from the observed body to the learned one."""
        across = np.eye(3)[np.abs(self.up).argmin()]
        across = across - (across @ self.up) * self.up
        return across / np.linalg.norm(across)

    @property
    def moved(self) -> np.ndarray:
        """(M, 3) all positions of both [m]."""
        both = [self.learned.centers] if self.observed is None else [self.learned.centers, self.observed.centers]
        return np.concatenate([motion.reshape(-1, 3) for motion in both])

    @property
    def side(self) -> np.ndarray:
        """(3,) shift of the learned body beside the observed one [m]."""
        return DISTANCE * float(np.ptp(self.moved @ self.across)) * self.across

    def deviation(self, frame: int) -> np.ndarray | None:
        """(N,) distance [m] of the learned body's particles from the observed ones; None where nothing was observed."""
        if self.observed is None or frame >= len(self.observed.centers):
            return None
        return np.linalg.norm(self.learned.centers[frame] - self.observed.centers[frame], axis=-1)

    @cached_property
    def scales(self) -> dict[str, Scale]:
        """Of each quantity, the same for all frames: a colour means one value while the sequence plays."""
        span = max(float(np.abs(self.factor - 1).max()), 0.01)  # what differs by less than 1 % shall not look like a contrast
        found = {"heterogeneity": Scale(r"stiffness factor $1 + a\,\tanh\,\eta$ [-]", "coolwarm", 1 - span, 1 + span)}
        if self.observed is not None:
            high = max(float(np.quantile(self.deviation(t), 0.99)) for t in range(len(self.observed.centers)))
            found["deviation"] = Scale("distance learned - observed [mm]", "viridis", 0, max(1e3 * high, 1e-3), "max")
        return found

    def paint(self, frame: int, by: str) -> np.ndarray:
        """(N, 3) colours in [0, 1] of the learned body. heterogeneity: blue softer, red stiffer; deviation: up to the 99th
        percentile of the sequence's worst frame, gray where nothing was observed. Errors: ConfigError for another name."""
        if by not in COLORS:
            raise ConfigError(f"color: expected {' or '.join(COLORS)}, found {by!r}")
        if by == "appearance":
            return self.appearance
        if by == "heterogeneity":
            return self.scales[by].paint(self.factor)
        far = self.deviation(frame)
        return np.full_like(self.appearance, GRAY) if far is None else self.scales[by].paint(1e3 * far)

    def caption(self, frame: int) -> str:
        """What a frame is, and what the scene leaves out."""
        said = f"**{self.name}**, frame {frame}, {self.times[frame] - self.times[0]:.3f} s  \n"
        far = self.deviation(frame)
        if self.observed is None:
            said += "No observed motion: the learned body alone."
        elif far is None:
            said += "Not observed in this frame."
        else:
            said += f"rms distance learned - observed {1e3 * float(np.sqrt(np.square(far).mean())):.1f} mm"
        if self.world.ground is not None:
            said += f"  \nGround grid: {1e3 * cell(self.size):g} mm"
        hidden = {"walls": len(self.world.planes), "colliders": len(self.world.colliders)}
        if any(hidden.values()):
            said += "  \nNot drawn: " + ", ".join(f"{kind} ({count})" for kind, count in hidden.items() if count)
        return said


def cell(size: float) -> float:
    """Width [m] of a ground cell for a body of that size: the power of ten below it."""
    return 10.0 ** math.floor(math.log10(size))


@torch.no_grad()
def read_run(folder: str | Path) -> list[Clip]:
    """The sequences of a run, the training one first. Errors: DataError naming the file that is missing or of another run."""
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"run: expected the folder of a finished run (run=outputs/train/<date>/<time>), found no folder {folder}")
    rollouts, seen = arrays(folder / "rollout.npz"), {}  # first: it is what a run that has not ended lacks
    twin = Twin.load(folder / "checkpoints" / "last.ckpt")
    body = twin.body
    if (folder / "observed.npz").is_file():  # runs of before it was written, and those of eval.py, have none
        seen = arrays(folder / "observed.npz")
    factor = body.factor(body.heterogeneity)
    clips = []
    for name in (key.removesuffix("/x") for key in rollouts if key.endswith("/x")):
        if rollouts[f"{name}/x"].shape[1] != len(body.rest):
            raise DataError(f"{folder / 'rollout.npz'}: {name}: expected the checkpoint's {len(body.rest)} particles, found "
                            f"{rollouts[f'{name}/x'].shape[1]}; both must be of one run")
        shapes = deformed_covariances(torch.from_numpy(rollouts[f"{name}/F_tot"]), body.covariances)
        observed = None
        if f"{name}/x" in seen:
            observed = Motion(seen[f"{name}/x"], seen[f"{name}/covariances"])
        clips.append(Clip(
            name, rollouts[f"{name}/times"], Motion(rollouts[f"{name}/x"], shapes.numpy()), observed,
            body.colors.clamp(0, 1).numpy(), body.opacities.numpy(), factor.numpy(), twin.world,
        ))  # fmt: skip
    if not clips:
        raise DataError(f"{folder / 'rollout.npz'}: expected the rollouts of a run, found none")
    return clips


def arrays(path: Path) -> dict[str, np.ndarray]:
    """Contents of an npz file. Errors: DataError naming it."""
    if not path.is_file():
        raise DataError(f"{path}: file not found; expected the folder of a finished run (run=outputs/train/<date>/<time>); "
                        "train.py writes this file at its end; it resumes with ckpt_path=<run folder>/checkpoints/last.ckpt")
    try:
        with np.load(path) as stored:
            return {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise DataError(f"{path}: expected a readable npz file, found a damaged one ({error})") from error
