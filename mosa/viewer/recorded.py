"""What a run saw, calibrated and learned, side by side in a browser:  python -m mosa.viewer run=outputs/train/<date>/<time>

With --live its twin, to be dropped and pushed (`mosa.viewer.live_viewer`).

The observed motion (the reconstruction's, of the sequences learned from) or, of other sequences, the true one where it is
known; beside it the calibrated prior's and the learned body's. Needs viser: the extra `viewer`."""

from __future__ import annotations

import logging
import re
import threading
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mosa.config.checkpoints import given_as
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.marker_figures import MEASURED, PREDICTED
from mosa.system.console import begin_log
from mosa.system.limits import named_device
from mosa.system.machine_errors import one_message
from mosa.twin.twin import Twin
from mosa.viewer.clips import BODIES, COLORS, FAINT, GRAY, Clip, read_run
from mosa.viewer.live import Live
from mosa.viewer.live_viewer import LiveViewer
from mosa.viewer.pages import (
    add_ground,
    add_points,
    add_solid,
    aim,
    beside_panel,
    offered,
    open_server,
    splat_parts,
    turn,
    view_of,
)  # fmt: skip

GEOMETRY = ("splats", "particles")


def first_view(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """((3,) camera, (3,) point looked at) [m]: a clip's motions side by side, seen from the front and a little above."""
    seen = np.concatenate([clip.moved, clip.moved + (len(clip.bodies) - 1) * clip.side])
    height = None if clip.world.ground is None else clip.world.ground.height
    return view_of(seen, clip.up, clip.across, height)


def layouts(clip: Clip) -> tuple[str, ...]:
    """All bodies side by side, two of them over each other, or one alone."""
    if len(clip.bodies) > 1:
        return ("side by side", *clip.overlays, *clip.bodies)
    return tuple(clip.bodies)


class Viewer:
    """A viser server that plays clips. host: 127.0.0.1 shows to this machine alone; port: the next free one where it is taken.
    Errors: ConfigError without viser, or for a host that is no address of this machine."""

    def __init__(self, clips: Sequence[Clip], *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.clips = {clip.name: clip for clip in clips}
        self.ended = threading.Event()
        self.drawing = threading.RLock()
        self.server = open_server(host, port)
        first = clips[0]
        gui = self.server.gui
        self.sequence = gui.add_dropdown("sequence", list(self.clips), initial_value=first.name)
        self.place(clips)
        self.layout = gui.add_dropdown("layout", layouts(first), disabled=len(first.bodies) == 1)
        self.frame = gui.add_slider("frame", 0, len(first.times) - 1, 1, 0)
        self.play = gui.add_checkbox("play", False)
        self.rate = gui.add_slider("frames per second", 1, 30, 1, 5)
        self.geometry = gui.add_dropdown("geometry", GEOMETRY, initial_value=GEOMETRY[0])
        hint = "of the prior and the learned body"
        self.color = gui.add_dropdown("color", COLORS, initial_value=COLORS[0], hint=hint)
        self.legend = gui.add_image(np.full((1, 1, 3), 255, np.uint8), format="png", visible=False)
        self.caption = gui.add_markdown("")
        self.sequence.on_update(lambda _: self.choose())
        self.color.on_update(lambda _: self.explain())
        for handle in (self.frame, self.color, self.geometry, self.layout):
            handle.on_update(lambda _: self.draw())
        self.draw()
        self.player = threading.Thread(target=self.run, daemon=True)
        self.player.start()

    def place(self, clips: Sequence[Clip]) -> None:
        """What does not move: ground, first view, and the bodies' nodes, which `draw` fills."""
        scene, clip = self.server.scene, clips[0]
        scene.set_up_direction(tuple(float(u) for u in clip.up))
        target = first_view(clip)[1]
        self.look(self.server.initial_camera)
        if clip.world.ground is not None:
            far = max(float(np.linalg.norm(first_view(each)[0] - target)) for each in clips)
            height = clip.world.ground.height
            add_ground(scene, clip.up, clip.across, height, clip.size, target, far)
        whole = clip.splats("learned", 0, "appearance")
        self.unit = float(np.sqrt(np.linalg.eigvalsh(whole[1]).max()))
        self.nodes, centers = {}, clip.learned.centers[0]
        for name in (name for name in BODIES if any(name in clip.bodies for clip in clips)):
            parts = splat_parts(1.0, *whole)
            spacing = 0.5 * clip.size / len(centers) ** (1 / 3)
            self.nodes[name] = (
                scene.add_gaussian_splats(f"/{name}/splats", *parts, scale=self.unit, visible=False),
                add_points(scene, f"/{name}/particles", centers, clip.appearance.astype(np.float32), spacing, visible=False),
                scene.add_label(f"/{name}/label", name, anchor="bottom-center", visible=False),
            )  # fmt: skip

        places = [(each.name, place) for each in clips for place in range(len(each.bodies))]
        self.solids: dict[tuple[str, int], list[Any]] = {each: [] for each in places}
        for (name, place), nodes in self.solids.items():
            for k, shape in enumerate(self.clips[name].solids):
                nodes.append(add_solid(scene, f"/solids/{name}/{place}/{k}", shape, visible=False))
        none, size = np.zeros((1, 3)), 0.02 * clip.size
        self.points = [add_points(scene, f"/points/{kind}", none, color, size, visible=False)
                       for kind, color in (("measured", MEASURED), ("predicted", PREDICTED))]  # fmt: skip

    def look(self, *cameras) -> None:
        """The current sequence's first view, for what viser calls cameras."""
        aim(*beside_panel(*first_view(self.clip), self.clip.up), *cameras)

    @property
    def clip(self) -> Clip:
        return self.clips[offered(self.sequence)]

    def choose(self) -> None:
        """Another sequence, from its start, and where it is seen."""
        with self.drawing:
            known, chosen = layouts(self.clip), self.layout.options.index(offered(self.layout))
            alike = len(known) == len(self.layout.options)  # the same layouts, of other bodies
            self.layout.options, self.layout.disabled = known, len(known) == 1
            self.layout.value = known[chosen if alike else 0]
            self.frame.max, self.frame.value = len(self.clip.times) - 1, 0
            self.explain()
            self.draw()
            clients = self.server.get_clients().values()
            self.look(self.server.initial_camera, *(client.camera for client in clients))

    def explain(self) -> None:
        """The colours' legend."""
        scale = self.clip.scales.get(offered(self.color))
        self.legend.visible = scale is not None
        if scale is not None:
            self.legend.image = scale.legend()

    def draw(self) -> None:
        """The current frame."""
        with self.drawing, self.server.atomic():
            clip, layout = self.clip, offered(self.layout)
            frame = min(int(offered(self.frame)), len(clip.times) - 1)
            above, below = clip.overlays.get(layout, (layout, None))
            for name, nodes in self.nodes.items():
                shown = name in clip.bodies and (layout == "side by side" or name in (above, below))
                shown = shown and frame < len(clip.bodies[name].centers)
                kind = offered(self.geometry)
                for node, wanted in zip(nodes, (kind == "splats", kind == "particles", True)):
                    node.visible = shown and wanted
                if shown:
                    place = list(clip.bodies).index(name) if layout == "side by side" else 0
                    self.body(name, frame, place * clip.side, under=name == below)
            for (name, place), solids in self.solids.items():
                shown = name == clip.name and (place == 0 or layout == "side by side")
                for k, node in enumerate(solids):
                    if node is not None:
                        node.visible = shown
                    if node is not None and shown:
                        at, turned = (part[frame, k] for part in clip.solid_poses)
                        node.position, node.wxyz = at + place * clip.side, turn(turned)
            place = list(clip.bodies).index("learned") if layout == "side by side" else 0
            for k, node in enumerate(self.points):
                learned = layout == "side by side" or "learned" in (above, below)
                node.visible = clip.points is not None and learned
                if node.visible:
                    places = clip.points[k, frame]
                    places = places[np.isfinite(places).all(-1)] + place * clip.side
                    node.points = places.astype(np.float32)
            self.caption.content = clip.caption(frame)

    def body(self, name: str, frame: int, shift: np.ndarray, under: bool) -> None:
        """One of the bodies. under: gray, its splats faint, its label above that of the body over it."""
        clip, (splats, points, label) = self.clip, self.nodes[name]
        centers = clip.bodies[name].centers[frame] + shift
        if splats.visible:
            means, covariances, colors, opacities = clip.splats(name, frame, offered(self.color))
            if under:
                colors, opacities = np.full_like(colors, GRAY), FAINT * opacities
            parts = splat_parts(self.unit, means + shift, covariances, colors, opacities)
            splats.set_gaussians(*parts)
        else:
            colors = clip.appearance
            if name != clip.reference:
                colors = clip.paint(frame, offered(self.color), name)
            colors = np.full_like(colors, GRAY) if under else colors
            points.points = centers.astype(np.float32)
            points.colors = (255 * colors).astype(np.uint8)
        said = name if len(clip.bodies) > 1 else clip.name  # alone, as of a preset, none is learned
        label.text = f"{said} (gray)" if under else said
        top = (centers @ clip.up).max() + (0.15 if under else 0.05) * clip.size
        middle = 0.5 * (centers.min(0) + centers.max(0))
        label.position = middle + (top - middle @ clip.up) * clip.up

    def run(self) -> None:
        """Advances the slider while `play` is on, until `stop`."""
        pause = 1.0
        while not self.ended.wait(pause):
            try:
                pause = 1 / offered(self.rate)
                if self.play.value:
                    # draws
                    self.frame.value = (int(offered(self.frame)) + 1) % len(self.clip.times)
            except Exception:  # the page outlives whatever a message, or a picture, meets
                logging.getLogger(__name__).exception("the viewer: a picture is left out")

    def stop(self) -> None:
        """Ends the player and the server."""
        self.ended.set()
        self.player.join(timeout=5)
        self.server.stop()


def options(arguments: Sequence[str]) -> dict[str, str | None]:
    """run= (or the path alone), live=, checkpoint=, host=, port=, device= of the command line. Errors: ConfigError naming what is
    wrong."""
    known = {"run": None, "checkpoint": None, "live": "false", "host": "127.0.0.1", "port": "8080", "device": "cpu"}  # fmt: skip
    for argument in arguments:
        argument = "live=true" if argument == "--live" else argument
        key, mark, value = argument.partition("=")
        if key not in known and known["run"] is None and Path(argument).exists():
            key, mark, value = "run", "=", argument
        way = "python -m mosa.viewer --help lists the options"
        if not mark and known["run"] is None and not argument.startswith("-"):
            raise ConfigError(
                f"run: expected the folder of a run, found no folder {argument!r}; {way}"
            )
        if not mark or key not in known:
            raise ConfigError(
                "viewer: expected the folder of a run, --live, checkpoint=<file>, host=<address>, port=<number>, "
                f"device=<name>, found {argument!r}; {way}"
            )
        known[key] = value
    known["run"] = known["run"] or known["checkpoint"]
    if known["run"] is None:
        way = "python -m mosa.viewer run=<run folder>"
        raise ConfigError(f"run: expected the folder of a finished run, found none; {way}")
    if not re.fullmatch(r"[0-9]{1,5}", known["port"]) or not 0 < int(known["port"]) < 65536:
        raise ConfigError(f"port: expected a number from 1 to 65535, found {known['port']!r}")
    if known["live"] not in ("true", "false"):
        raise ConfigError(f"live: expected true or false, found {known['live']!r}")
    if known["live"] == "false" and Path(known["run"]).is_file():
        way = "--live shows the twin of a checkpoint"
        raise ConfigError(f"run: expected a folder, found the file {known['run']!r}; {way}")
    return known


def checkpoint_of(run: str, checkpoint: str | None) -> Path:
    """Of the twin that --live shows. Errors: DataError where there is none."""
    path = Path(checkpoint or run)
    path = path / "checkpoints" / "last.ckpt" if path.is_dir() else path
    if not path.is_file():
        raise DataError(
            "run: expected the folder of a run with checkpoints/last.ckpt, or a checkpoint, found "
            f"no file {path}; of an exported folder it is given by checkpoint="
        )
    return path


def opened(chosen: Mapping[str, str | None]) -> Viewer | LiveViewer:
    """The page that `options` ask for, served. Errors: ConfigError, DataError."""
    place = {"host": chosen["host"], "port": int(chosen["port"])}
    if chosen["live"] == "true":
        path = checkpoint_of(chosen["run"], chosen["checkpoint"])
        with given_as("checkpoint" if chosen["checkpoint"] else "run"):
            twin = Twin.load(path, named_device(chosen["device"]))
        return LiveViewer(Live(twin), **place)
    return Viewer(read_run(chosen["run"], chosen["checkpoint"]), **place)


def main(arguments: Sequence[str]) -> None:
    logging.basicConfig(format="%(message)s")
    begin_log()
    # of a held body that creeps: the page sets no substeps
    warnings.filterwarnings("ignore", "substeps: ")
    with one_message():
        chosen = options(arguments)
        viewer = opened(chosen)
    port = viewer.server.get_port()
    if port != int(chosen["port"]):
        print(f"port {chosen['port']} is taken; serving on {port}")
    shown = ", ".join(viewer.clips) if isinstance(viewer, Viewer) else "the twin, live"
    print(f"http://{chosen['host']}:{port} shows {shown}; Ctrl-C ends it")
    try:
        viewer.ended.wait()
    except KeyboardInterrupt:
        viewer.stop()
