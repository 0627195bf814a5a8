"""What a run saw and what it learned, side by side in a browser:  python -m mosa.viewer run=outputs/train/<date>/<time>

The observed motion (the reconstruction's splats, of the sequences learned from) and beside it the learned twin. Needs viser: the
extra `viewer`.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch

from mosa.errors import ConfigError, DataError, MosaError
from mosa.modules.observer import deformed_covariances
from mosa.twin import Twin

COLORS = ("appearance", "heterogeneity", "deviation")
DISTANCE = 1.4
"""Between the two bodies, in widths of what they take up together."""
SLOWEST = 5.0
"""Frames per second at which a sequence is played, at most: real time is over before one has looked."""


@dataclass(frozen=True)
class Motion:
    """N splats over T frames: centers (T, N, 3) [m], covariances (T, N, 3, 3) [m^2]."""

    centers: np.ndarray
    covariances: np.ndarray


@dataclass(frozen=True)
class Clip:
    """A sequence of a run. times: (T,) [s]; twin: over all frames; observed: over the frames that were learned from, or None;
    appearance: (N, 3) in [0, 1]; opacities: (N,); factor: (N,) learned stiffness over the mean law's; up: (3,)."""

    name: str
    times: np.ndarray
    twin: Motion
    observed: Motion | None
    appearance: np.ndarray
    opacities: np.ndarray
    factor: np.ndarray
    up: np.ndarray

    @property
    def size(self) -> float:
        """Largest extent of the body at the start [m]."""
        return float(np.ptp(self.twin.centers[0], axis=0).max())

    @property
    def side(self) -> np.ndarray:
        """(3,) shift of the twin beside the observed body [m], horizontal."""
        across = np.eye(3)[np.abs(self.up).argmin()]
        across = across - (across @ self.up) * self.up
        across = across / np.linalg.norm(across)
        moved = self.twin.centers if self.observed is None else np.concatenate([*self.twin.centers, *self.observed.centers])
        return DISTANCE * float(np.ptp(moved @ across)) * across

    def deviation(self, frame: int) -> np.ndarray | None:
        """(N,) distance [m] of the twin's particles from the observed ones; None where nothing was observed."""
        if self.observed is None or frame >= len(self.observed.centers):
            return None
        return np.linalg.norm(self.twin.centers[frame] - self.observed.centers[frame], axis=-1)

    def paint(self, frame: int, by: str) -> np.ndarray:
        """(N, 3) colours in [0, 1]. heterogeneity: blue softer, red stiffer, as far as the most different particle; deviation: dark
        0, yellow a tenth of the body's size, white where nothing was observed. Errors: ConfigError for another name."""
        if by not in COLORS:
            raise ConfigError(f"color: expected {' or '.join(COLORS)}, found {by!r}")
        if by == "appearance":
            return self.appearance
        if by == "heterogeneity":
            span = max(float(np.abs(self.factor - 1).max()), 1e-6)
            return matplotlib.colormaps["coolwarm"](0.5 + 0.5 * (self.factor - 1) / span)[:, :3]
        far = self.deviation(frame)
        if far is None:
            return np.ones_like(self.appearance)
        return matplotlib.colormaps["inferno"](0.9 * (far / (0.1 * self.size)).clip(0, 1))[:, :3]

    def caption(self, frame: int) -> str:
        """One line on a frame."""
        said = f"{self.name}, frame {frame}, {self.times[frame] - self.times[0]:.3f} s"
        far = self.deviation(frame)
        return said if far is None else f"{said}: rms distance {1e3 * float(np.sqrt(np.square(far).mean())):.1f} mm"


@torch.no_grad()
def read_run(folder: str | Path) -> list[Clip]:
    """The sequences of a run, the training one first. Errors: DataError naming the file that is missing or of another run."""
    folder = Path(folder)
    twin = Twin.load(folder / "checkpoints" / "last.ckpt")
    body, rollouts, seen = twin.body, arrays(folder / "rollout.npz"), {}
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
            body.colors.clamp(0, 1).numpy(), body.opacities.numpy(), factor.numpy(), twin.world.up.numpy(),
        ))  # fmt: skip
    if not clips:
        raise DataError(f"{folder / 'rollout.npz'}: expected the rollouts of a run, found none")
    return clips


def arrays(path: Path) -> dict[str, np.ndarray]:
    """Contents of an npz file. Errors: DataError naming it."""
    if not path.is_file():
        raise DataError(f"{path}: file not found; expected the folder of a finished run (run=outputs/train/<date>/<time>)")
    try:
        with np.load(path) as stored:
            return {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise DataError(f"{path}: expected a readable npz file, found a damaged one ({error})") from error


class Viewer:
    """A viser server that plays clips. host: 127.0.0.1 shows to this machine alone. Errors: ConfigError without viser."""

    def __init__(self, clips: Sequence[Clip], *, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser
        except ImportError as error:
            raise ConfigError("viewer: expected the package viser, found none: pip install -e '.[viewer]'") from error
        self.clips, self.ended, self.drawing = {clip.name: clip for clip in clips}, threading.Event(), threading.RLock()
        self.server = viser.ViserServer(host=host, port=port, label="MoSA", verbose=False)
        self.server.scene.set_up_direction(tuple(float(u) for u in clips[0].up))
        gui, first = self.server.gui, clips[0]
        self.sequence = gui.add_dropdown("sequence", list(self.clips), initial_value=first.name)
        self.frame = gui.add_slider("frame", 0, len(first.times) - 1, 1, 0)
        self.play = gui.add_checkbox("play", False)
        self.color = gui.add_dropdown("color", COLORS, initial_value=COLORS[0])
        self.points = gui.add_checkbox("particles in place of splats", False)
        self.beside = gui.add_checkbox("side by side", True)
        self.caption = gui.add_markdown("")
        self.sequence.on_update(lambda _: self.choose())
        for handle in (self.frame, self.color, self.points, self.beside):
            handle.on_update(lambda _: self.draw())
        self.draw()
        self.player = threading.Thread(target=self.run, daemon=True)
        self.player.start()

    @property
    def clip(self) -> Clip:
        return self.clips[self.sequence.value]

    def choose(self) -> None:
        """Another sequence, from its start."""
        with self.drawing:
            self.frame.max, self.frame.value = len(self.clip.times) - 1, 0
            self.draw()

    def draw(self) -> None:
        """The current frame."""
        with self.drawing, self.server.atomic():
            clip = self.clip
            frame = min(int(self.frame.value), len(clip.times) - 1)
            beside = clip.side if self.beside.value and clip.observed is not None else np.zeros(3)
            self.body("twin", clip, clip.twin, frame, clip.paint(frame, self.color.value), beside)
            self.body("observed", clip, clip.observed, frame, clip.appearance, np.zeros(3))
            self.caption.content = clip.caption(frame)

    def body(self, name: str, clip: Clip, motion: Motion | None, frame: int, colors: np.ndarray, shift: np.ndarray) -> None:
        """One of the two, or nothing where it has no such frame."""
        scene = self.server.scene
        for kind in ("splats", "points"):
            scene.remove_by_name(f"/{name}/{kind}")
        if motion is None or frame >= len(motion.centers):
            return
        centers = (motion.centers[frame] + shift).astype(np.float32)
        if self.points.value:
            spacing = 0.5 * float(clip.size / len(centers) ** (1 / 3))
            scene.add_point_cloud(f"/{name}/points", centers, (255 * colors).astype(np.uint8), point_size=spacing)
        else:
            scene.add_gaussian_splats(f"/{name}/splats", centers, motion.covariances[frame].astype(np.float32),
                                      colors.astype(np.float32), clip.opacities[:, None].astype(np.float32))

    def run(self) -> None:
        """Advances the slider while `play` is on, until `stop`."""
        while True:
            times = self.clip.times
            if self.ended.wait(max(1 / SLOWEST, float(times[1] - times[0]))):
                return
            if self.play.value:
                self.frame.value = (int(self.frame.value) + 1) % len(times)  # draws

    def stop(self) -> None:
        """Ends the player and the server."""
        self.ended.set()
        self.player.join(timeout=5)
        self.server.stop()


def options(arguments: Sequence[str]) -> dict[str, str]:
    """run=, host=, port= of the command line. Errors: ConfigError naming what is wrong."""
    known = {"run": None, "host": "127.0.0.1", "port": "8080"}
    for argument in arguments:
        key, mark, value = argument.partition("=")
        if not mark or key not in known:
            raise ConfigError(f"viewer: expected run=<run folder>, host=<address>, port=<number>, found {argument!r}")
        known[key] = value
    if known["run"] is None:
        raise ConfigError("run: expected the folder of a finished run, found none; python -m mosa.viewer run=<run folder>")
    if not known["port"].isdigit() or not 0 < int(known["port"]) < 65536:
        raise ConfigError(f"port: expected a number from 1 to 65535, found {known['port']!r}")
    return known


def main(arguments: Sequence[str]) -> None:
    try:
        chosen = options(arguments)
        viewer = Viewer(read_run(chosen["run"]), host=chosen["host"], port=int(chosen["port"]))
    except MosaError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"http://{chosen['host']}:{viewer.server.get_port()} shows {', '.join(viewer.clips)}; Ctrl-C ends it")
    try:
        viewer.ended.wait()
    except KeyboardInterrupt:
        viewer.stop()


if __name__ == "__main__":
    main(sys.argv[1:])
