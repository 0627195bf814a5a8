"""What a run's files become for the viewer: motions, what is measured between them, and its colours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from mosa.config.checkpoints import given_as
from mosa.errors import ConfigError, DataError
from mosa.modules.body.body import World
from mosa.physics.contact.colliders import Shape
from mosa.reconstruction.motion.cues import neighbourhood
from mosa.rendering.appearance.carried_splats import seen
from mosa.rendering.observer import deformed_covariances
from mosa.system.npz import Arrays
from mosa.twin.rollout_file import shape_of
from mosa.twin.shown_body import FILE, ShownBody
from mosa.twin.twin import Twin
from mosa.viewer.pages import cell, horizontal

BODIES = ("observed", "truth", "prior", "learned")
"""What a clip can have, from left to right: the motion learned from, or where none was the true one, and the two models'."""
COLORS = ("appearance", "heterogeneity", "deviation", "uncertainty")
MOTIONS = {"observed": "observed", "truth": "true"}  # what they are called
DISTANCE = 1.4  # from one body to the next, in their largest common width
GRAY = 0.6  # of what has no value, and of a body under another one
FAINT = 0.25  # opacity of a body under another one, relative to its own


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
        shares = (values - self.low) / (self.high - self.low)
        return matplotlib.colormaps[self.colors](shares)[:, :3]

    def legend(self) -> np.ndarray:
        """(H, W, 3) picture of the colour bar, 8 bit."""
        figure = Figure(figsize=(3.2, 0.7), dpi=200, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        shown = ScalarMappable(Normalize(self.low, self.high), self.colors)
        bar = figure.colorbar(
            shown, cax=figure.add_subplot(), orientation="horizontal", extend=self.beyond
        )
        bar.set_label(self.label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def stiffness_scale(factor: np.ndarray) -> Scale:
    """Of stiffness factors (N,), about 1: what differs by less than 1 % shall not look like a contrast."""
    span = max(float(np.abs(factor - 1).max()), 0.01)
    label = r"stiffness factor $1 + a\,\tanh\,\eta$ [-]"
    return Scale(label, "coolwarm", 1 - span, 1 + span)


@dataclass(frozen=True)
class ShownSplats:
    """M splats that a body's particles carry, over T frames: centers (T, M, 3) [m], covariances (T, M, 3, 3) [m^2], colors
    (T, M, 3) in [0, 1], in the light of each frame."""

    centers: np.ndarray
    covariances: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class ShownMotion:
    """N particles over T frames: centers (T, N, 3) [m], covariances (T, N, 3, 3) [m^2]; carried: the splats that they carry."""

    centers: np.ndarray
    covariances: np.ndarray
    carried: ShownSplats | None = None


@dataclass(frozen=True)
class Clip:
    """A sequence of a run. times: (T,) [s]; bodies: by name, in the order of BODIES: learned always, over all frames; prior, the
    calibrated law's without adapter and heterogeneity, where the run left it; one of observed, over the frames that were learned
    from, and truth, or neither; appearance: (N, 3) in [0, 1]; opacities: (N,); factor: (N,) 1 + a tanh eta, by which a particle's
    stiffness differs from the law's; spread: (T, N) [m] predicted standard deviation of the learned positions, None where the run
    left none; points: (2, T, M, 3) [m] of tracked points, measured and predicted, None where there are
    none; splat_opacities: (M,), splat_particles: (M,) nearest particles of the splats that all bodies carry, where the run has
    them; solids: shapes of K colliders, None for those that are not drawn; solid_poses: their
    positions (T, K, 3) [m] and rotations (T, K, 3, 3)."""

    name: str
    times: np.ndarray
    bodies: dict[str, ShownMotion]
    appearance: np.ndarray
    opacities: np.ndarray
    factor: np.ndarray
    world: World
    spread: np.ndarray | None = None
    points: np.ndarray | None = None
    splat_opacities: np.ndarray | None = None
    splat_particles: np.ndarray | None = None
    solids: tuple[Shape | None, ...] = ()
    solid_poses: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def learned(self) -> ShownMotion:
        return self.bodies["learned"]

    @property
    def reference(self) -> str | None:
        """What the models are compared with: observed, truth, or None."""
        return next((name for name in ("observed", "truth") if name in self.bodies), None)

    @property
    def models(self) -> list[str]:
        """prior, where it is there, and learned."""
        return [name for name in self.bodies if name != self.reference]

    @property
    def overlays(self) -> dict[str, tuple[str, str]]:
        """By what they are called, the pairs (above, below) that can lie over each other: each model over what it is compared
        with, or learned over prior where that is nothing."""
        if self.reference is not None:
            pairs = [(model, self.reference) for model in reversed(self.models)]
        else:
            pairs = [("learned", below) for below in self.models[:-1]]
        return {f"{above} over {below}": (above, below) for above, below in pairs}

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
        """(3,) horizontal unit vector, from each body to the next."""
        return horizontal(self.up)

    @property
    def moved(self) -> np.ndarray:
        """(M, 3) all positions of all bodies [m]."""
        return np.concatenate([motion.centers.reshape(-1, 3) for motion in self.bodies.values()])

    @cached_property
    def side(self) -> np.ndarray:
        """(3,) shift of a body beside the one before it [m]."""
        along = [motion.centers @ self.across for motion in self.bodies.values()]
        frames = ([x[t] for x in along if t < len(x)] for t in range(len(self.times)))
        widths = [np.ptp(np.concatenate(each)) for each in frames]
        return DISTANCE * float(max(widths)) * self.across

    def deviation(self, frame: int, model: str = "learned") -> np.ndarray | None:
        """(N,) distance [m] of a model's particles from those of the reference; None where it has no such frame."""
        if self.reference is None or frame >= len(right := self.bodies[self.reference].centers):
            return None
        return np.linalg.norm(self.bodies[model].centers[frame] - right[frame], axis=-1)

    @cached_property
    def scales(self) -> dict[str, Scale]:
        """Of each quantity, one for all frames and models: a colour means one value while the sequence plays, in both bodies."""
        found = {"heterogeneity": stiffness_scale(self.factor)}
        if self.reference is not None:
            frames = range(len(self.bodies[self.reference].centers))
            far = (self.deviation(t, model) for t in frames for model in self.models)
            high = max(1e3 * max(float(np.quantile(each, 0.99)) for each in far), 1e-3)
            label = f"distance to the {MOTIONS[self.reference]} motion [mm]"
            found["deviation"] = Scale(label, "viridis", 0, high, "max")
        if self.spread is not None:
            high = max(1e3 * float(np.quantile(self.spread, 0.99, axis=1).max()), 1e-3)
            label = "predicted standard deviation [mm]"
            found["uncertainty"] = Scale(label, "magma", 0, high, "max")
        return found

    def paint(self, frame: int, by: str, model: str = "learned") -> np.ndarray:
        """(N, 3) colours in [0, 1] of a model's body. heterogeneity: blue softer, red stiffer, the prior has none; deviation: up
        to the 99th percentile of the sequence's worst frame, gray where there is nothing to compare with; uncertainty: likewise, of
        the learned body. Errors: ConfigError for another name."""
        if by not in COLORS:
            raise ConfigError(f"color: expected {' or '.join(COLORS)}, found {by!r}")
        if by == "appearance":
            return self.appearance
        if by == "heterogeneity":
            factor = self.factor if model == "learned" else np.ones_like(self.factor)
            return self.scales[by].paint(factor)
        far = self.deviation(frame, model)
        if by == "uncertainty":
            far = self.spread[frame] if self.spread is not None and model == "learned" else None
        return (
            np.full_like(self.appearance, GRAY) if far is None else self.scales[by].paint(1e3 * far)
        )

    def splats(self, name: str, frame: int, by: str) -> tuple[np.ndarray, ...]:
        """Centers (M, 3) [m], covariances (M, 3, 3) [m^2], colours (M, 3) and opacities (M,) of a body's splats: those it carries,
        where it carries some, painted as the particles nearest to them at rest; else the particles themselves."""
        motion = self.bodies[name]
        plain = by == "appearance" or name == self.reference
        colors = self.appearance if plain else self.paint(frame, by, name)
        if motion.carried is None:
            return motion.centers[frame], motion.covariances[frame], colors, self.opacities
        colors = motion.carried.colors[frame] if plain else colors[self.splat_particles]
        carried = motion.carried
        return carried.centers[frame], carried.covariances[frame], colors, self.splat_opacities

    def caption(self, frame: int) -> str:
        """What a frame is, and what the scene leaves out."""
        said = f"**{self.name}**, frame {frame}, {self.times[frame] - self.times[0]:.3f} s  \n"
        if self.points is not None:
            square = np.square(self.points[0, frame] - self.points[1, frame]).sum(-1)
            far = [1e3 * float(each) ** 0.5 for each in square if np.isfinite(each)]
            said += "Points, red measured, blue predicted, are apart by (mm): "
            said += ", ".join(f"{each:.1f}" for each in far) or "not seen in this frame"
        elif self.reference is None:
            said += "No observed and no true motion to compare with."
        elif self.deviation(frame) is None:
            said += "Not observed in this frame."
        else:
            squares = {model: np.square(self.deviation(frame, model)) for model in self.models}
            said += f"rms distance to the {MOTIONS[self.reference]} motion: "
            said += ", ".join(
                f"{model} {1e3 * np.sqrt(e.mean()):.1f} mm" for model, e in squares.items()
            )
        if self.world.ground is not None:
            said += f"  \nGround grid: {1e3 * cell(self.size):g} mm"
        solids = len(self.world.colliders) if self.solid_poses is None else self.solids.count(None)
        hidden = {"walls": len(self.world.planes), "colliders": solids}
        if left_out := [f"{kind} ({count})" for kind, count in hidden.items() if count]:
            said += f"  \nNot drawn: {', '.join(left_out)}"
        return said


@torch.no_grad()
def read_run(folder: str | Path, checkpoint: str | Path | None = None) -> list[Clip]:
    """The sequences of a run, the training one first, or the motion of a folder that `Twin.export` or eval.py wrote. prior.npz,
    observed.npz and truth.npz may be missing: older runs left fewer files, captures have no truth. checkpoint: of the run, None for
    the folder's own, or else its body.npz. Errors: DataError naming the file that is missing or of another run."""
    folder = Path(folder)
    if not folder.is_dir():
        wanted = "a finished run (run=outputs/train/<date>/<time>), or of an exported motion"
        raise DataError(f"run: expected the folder of {wanted}, found no folder {folder}")
    learned = Arrays.of(folder / "rollout.npz")
    if not learned.path.is_file():  # what a run that has not ended lacks
        raise DataError(
            f"{learned.path}: file not found; expected the folder of a finished run (run=outputs/train/<date>/<time>); "
            "train.py writes this file at its end; it resumes with ckpt_path=<run folder>/checkpoints/last.ckpt"
        )
    body = shown_body(folder, checkpoint)
    files = {kind: Arrays.of(folder / f"{kind}.npz") for kind in BODIES[:-1]} | {"learned": learned}
    spreads, tracked = Arrays.of(folder / "uncertainty.npz"), Arrays.of(folder / "markers.npz")
    clips, count = [], len(body.rest)
    for name in (key.removesuffix("/x") for key in learned.stored if key.endswith("/x")):
        x = learned.entry(f"{name}/x", None, count, 3)
        frames, bodies = len(x), {}
        times = learned.entry(f"{name}/times", frames)
        if times is None or not frames or (np.diff(times) <= 0).any():
            raise DataError(f"{learned.path}: {name}/times: expected {frames} increasing times")
        for kind, file in files.items():
            seen = kind == "observed"
            x = file.entry(f"{name}/x", None if seen else frames, count, 3)
            if x is None or (kind == "truth" and "observed" in bodies):
                continue
            if len(x) > frames:
                raise DataError(
                    f"{file.path}: {name}/x: expected at most {frames} frames, found {len(x)}"
                )
            bodies[kind] = ShownMotion(x, covariances(file, name, x, body), carried_by(body, x))
        spread = spreads.entry(f"{name}/sd", frames, count)
        if spread is not None and spread.min() < 0:
            raise DataError(
                f"{spreads.path}: {name}/sd: expected standard deviations of at least 0"
            )
        points = [tracked.entry(f"{name}/{kind}", frames, None, 3, holes=True)
                  for kind in ("measured", "predicted")]  # fmt: skip
        clips.append(Clip(
            name, times, bodies, body.colors.clamp(0, 1).numpy(), body.opacities.numpy(), body.factor.numpy(), body.world, spread,
            points_of(tracked.path, name, *points), **splat_keys(body), **solids_of(learned, name, frames),
        ))  # fmt: skip
    if not clips:
        raise DataError(f"{learned.path}: expected the rollouts of a run, found none")
    return clips


def shown_body(folder: Path, checkpoint: str | Path | None) -> ShownBody:
    """The body whose motions a folder has. Errors: DataError where nothing says what it looks like."""
    path = Path(checkpoint) if checkpoint is not None else folder / "checkpoints" / "last.ckpt"
    if checkpoint is None and not path.is_file() and (folder / FILE).is_file():
        return ShownBody.read(folder / FILE)
    if checkpoint is None and not folder.joinpath("checkpoints").is_dir():
        raise DataError(
            f"{folder}: expected checkpoints/last.ckpt of a run, or body.npz of an exported motion, found neither; "
            "checkpoint=<run folder>/checkpoints/last.ckpt names the run's"
        )
    with given_as("run" if checkpoint is None else "checkpoint"):
        twin = Twin.load(path)
    return ShownBody.of(twin.body, twin.world)


def solids_of(file: Arrays, name: str, frames: int) -> dict[str, Any]:
    """What a clip has of the colliders that the file has the shapes of. Errors: DataError naming file and entry."""
    shapes = file.entry(f"{name}/collider_shape", None, 4)
    if shapes is None:
        return {}
    poses = [file.entry(f"{name}/collider_position", frames, len(shapes), 3),
             file.entry(f"{name}/collider_rotation", frames, len(shapes), 3, 3)]  # fmt: skip
    if any(pose is None for pose in poses):
        raise DataError(f"{file.path}: {name}: expected collider_position and collider_rotation")
    solid = shapes[:, 0] >= 0
    return {
        "solids": tuple(map(shape_of, shapes[solid])),
        "solid_poses": tuple(pose[:, solid] for pose in poses),
    }


def carried_by(body: ShownBody, x: np.ndarray) -> ShownSplats | None:
    """The body's splats with its particles at (T, N, 3) [m]; None where it has none."""
    if body.splats is None:
        return None
    shown = seen(body, torch.from_numpy(x).to(body.rest), None)
    return ShownSplats(
        *(value.numpy() for value in (shown.means, shown.covariances, shown.colors()))
    )


def splat_keys(body: ShownBody) -> dict[str, np.ndarray]:
    """What clips say of the splats that the body carries."""
    if body.splats is None:
        return {}
    nearest = cKDTree(body.rest.numpy()).query(body.splats.means.numpy())[1]
    return {"splat_opacities": body.splats.opacities.numpy(), "splat_particles": nearest}


def points_of(path: Path, name: str, measured: np.ndarray | None, predicted: np.ndarray | None) -> np.ndarray | None:  # fmt: skip
    """(2, T, M, 3) [m] of points, None without any. Errors: DataError where one of both is missing, or of other points."""
    if measured is None and predicted is None:
        return None
    if measured is None or predicted is None or measured.shape != predicted.shape:
        raise DataError(f"{path}: {name}/measured, {name}/predicted: expected the same points")
    return np.stack([measured, predicted]).astype(np.float32)


def covariances(file: Arrays, name: str, x: np.ndarray, body: ShownBody) -> np.ndarray:
    """(T, N, 3, 3) [m^2] of a motion's splats: the stored ones; else those at rest, deformed by the stored F_tot, or where there
    are positions alone by a local fit to them."""
    shape = (*x.shape, 3)
    if (known := file.entry(f"{name}/covariances", *shape)) is not None:
        return known
    if (stored := file.entry(f"{name}/F_tot", *shape)) is not None:
        F = torch.from_numpy(stored)
    else:
        around = neighbourhood(body.rest)
        F = torch.stack([around.deformation(each) for each in torch.from_numpy(x)])
        F[:, around.weight == 0] = torch.eye(3)  # neighbours in a plane say nothing: as at rest
    return deformed_covariances(F, body.covariances).numpy()
