"""A learned twin live in a browser: drop it, pause, step, push it with the mouse:  python -m mosa.viewer <run folder> --live"""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

import numpy as np

from mosa.viewer.live import COLORS, Live
from mosa.viewer.pages import (
    add_ground,
    add_points,
    add_solid,
    aim,
    beside_panel,
    cell,
    offered,
    open_server,
    splat_parts,
    turn,
    view_of,
)  # fmt: skip

log = logging.getLogger(__name__)

GEOMETRY = ("splats", "particles")
BALL = (235, 110, 60)  # 8-bit colour of the ball that the mouse moves


class LiveViewer:
    """A viser server with a panel for `live`. host, port: as `Viewer`. Errors: ConfigError without viser, or for a host that is no
    address of this machine."""

    def __init__(self, live: Live, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.live, self.ended, self.busy = live, threading.Event(), threading.RLock()
        self.server = open_server(host, port)
        gui, first, body = self.server.gui, live.drop_as, live.twin.body
        self.buttons = {name: gui.add_button(name) for name in ("drop", "pause", "step", "reset")}
        self.message = gui.add_markdown("")
        with gui.add_folder("the next drop"):
            high = max(live.highest, first.height, 0.01)
            fastest = 2 * float(np.sqrt(2 * 9.8 * live.size))
            self.sliders = {
                "height": gui.add_slider("height [m]", 0.0, high, round(high / 200, 6), first.height),
                "tilt": gui.add_slider("tilt [degrees]", -180, 180, 1, 0),
                "spin": gui.add_slider("spin [turns/s]", -5.0, 5.0, 0.1, 0.0),
                "speed": gui.add_slider("speed [m/s]", 0.0, round(fastest, 1), 0.05, 0.0),
                "heading": gui.add_slider("heading [degrees]", -180, 180, 1, 0, hint="of tilt, spin and speed; 0: to the right"),
            }  # fmt: skip
            E = live.twin.material.E
            self.stiffness, middle = None, round(float(np.log10(E)), 2) if E > 0 else 0.0
            if E > 0:
                self.stiffness = gui.add_slider(
                    "log10 of E [Pa]", middle - 1.5, middle + 1.5, 0.01, middle
                )
            self.set_stiffness = middle
        self.slowdown = gui.add_slider(
            "speed of time", 0.05, 1.0, 0.05, 1.0, hint="at most: a slow machine is slower"
        )
        self.geometry = gui.add_dropdown("geometry", GEOMETRY, initial_value=GEOMETRY[0])
        self.color = gui.add_dropdown("color", COLORS, initial_value=COLORS[0])
        self.legend = gui.add_image(np.full((1, 1, 3), 255, np.uint8), format="png", visible=False)
        self.caption = gui.add_markdown("")
        self.scale, self.taken = None, None
        scene, ball = self.server.scene, live.hand_position
        self.place()
        _, covariances, _, _ = live.splats("appearance", live.paint("appearance")[0])
        self.unit = float(np.sqrt(np.linalg.eigvalsh(covariances).max()))
        self.splats = None
        size = 0.5 * live.size / len(body.rest) ** (1 / 3)
        painted = live.paint("appearance")[0].astype(np.float32)
        self.points = add_points(scene, "/body", live.positions.cpu().numpy(), painted, size)
        self.solids = [
            add_solid(scene, f"/collider_{i}", c.shape)
            for i, c in enumerate(live.twin.world.colliders)
        ]
        self.ball = scene.add_icosphere("/ball", live.radius, BALL, position=ball)
        self.gizmo = scene.add_transform_controls("/push", 2.5 * live.radius, disable_rotations=True, depth_test=False,
                                                  position=ball)  # fmt: skip
        self.gizmo.on_update(lambda _: self.pushed(self.gizmo.position))
        # newer viser: the ball itself follows the mouse, in the screen's plane
        self.draggable = hasattr(self.ball, "on_drag")
        if self.draggable:
            self.ball.on_drag("left")(self.dragged)
        self.buttons["drop"].on_click(lambda _: self.drop())
        self.buttons["pause"].on_click(lambda _: self.pause())
        self.buttons["step"].on_click(lambda _: self.step())
        self.buttons["reset"].on_click(lambda _: self.reset())
        for handle in (self.geometry, self.color):
            handle.on_update(lambda _: self.draw())
        self.draw()
        self.player = threading.Thread(target=self.run, daemon=True)
        self.player.start()

    def place(self) -> None:
        """What does not move: the ground and the first view, of the drop's way and the ball's place."""
        live, scene = self.live, self.server.scene
        scene.set_up_direction(tuple(map(float, live.up)))
        x = live.positions.double().cpu().numpy()
        ground = live.twin.world.ground
        side = 1.5 * live.size * live.across
        around = np.concatenate([x, x + side, x - side, live.hand_position[None]])
        eye, target = view_of(around, live.up, live.across, None if ground is None else live.ground)
        aim(*beside_panel(eye, target, live.up), self.server.initial_camera)
        if ground is not None:
            far = float(np.linalg.norm(eye - target))
            add_ground(scene, live.up, live.across, live.ground, live.size, target, far)

    def drop(self) -> None:
        """Let the body go as the sliders say."""
        with self.busy:
            if self.stiffness is not None and offered(self.stiffness) != self.set_stiffness:
                self.set_stiffness = float(offered(self.stiffness))
                self.live.soften(10**self.set_stiffness)
            said = {name: float(offered(slider)) for name, slider in self.sliders.items()}
            self.live.change(**said)
            self.live.drop()
            self.follow()
            self.draw()

    def pause(self) -> None:
        """Stop, or go on."""
        with self.busy:
            self.live.running = not self.live.running and self.live.state is not None
            self.draw()

    def step(self) -> None:
        """One step, and then stand still."""
        with self.busy:
            self.live.running = False
            self.live.step()
            self.draw()

    def reset(self) -> None:
        with self.busy:
            self.live.reset()
            self.follow()
            self.draw()

    def follow(self) -> None:
        """The gizmo to where the ball is to go."""
        self.gizmo.position = tuple(map(float, self.live.target))

    def pushed(self, position: Any) -> None:
        """The gizmo was moved: the ball is to go there."""
        if np.shape(position) == (3,) and np.abs(position).max() < 1e6:  # [m], as NaN is not
            self.live.target = np.asarray(position, np.float64)

    def dragged(self, event: Any) -> None:
        """The ball is dragged: from the point where it was taken to the mouse."""
        moved = np.asarray(event.end_position) - np.asarray(event.start_position)
        self.pushed(self.live.hand_position + moved)
        self.follow()

    def draw(self) -> None:
        """The state now."""
        with self.busy, self.server.atomic():
            live, by = self.live, offered(self.color)
            colors, scale = live.paint(by)
            if offered(self.geometry) == "splats":
                parts = splat_parts(self.unit, *live.splats(by, colors))
                if self.splats is None:
                    scene = self.server.scene
                    self.splats = scene.add_gaussian_splats("/splats", *parts, scale=self.unit)
                else:
                    self.splats.set_gaussians(*parts)
            else:
                self.points.points = live.positions.cpu().numpy().astype(np.float32)
                self.points.colors = (255 * colors).astype(np.uint8)
            self.points.visible = offered(self.geometry) == "particles"
            if self.splats is not None:
                self.splats.visible = offered(self.geometry) == "splats"
            self.ball.position = tuple(map(float, live.hand_position))
            for node, (position, rotation) in zip(self.solids, live.poses()):
                if node is not None:
                    node.position, node.wxyz = tuple(map(float, position)), turn(rotation)
            self.explain(scale)
            self.buttons["pause"].label = "pause" if live.running else "go on"

    def explain(self, scale: Any) -> None:
        """The legend, the caption, and what went wrong."""
        if scale != self.scale:
            self.scale, self.legend.visible = scale, scale is not None
            if scale is not None:
                self.legend.image = scale.legend()
        live, said = self.live, self.live.caption()
        if self.taken is not None and live.running:
            said += f"  \n{live.dt / self.taken:.2f} of real time"
        if live.twin.world.ground is not None:
            said += f"  \nGround grid: {1e3 * cell(live.size):g} mm"
        hidden = len(live.twin.world.planes) + sum(node is None for node in self.solids)
        if hidden:
            said += f"  \nNot drawn: {hidden} walls or half spaces"
        self.caption.content = said
        self.message.content = f"**{live.message}**" if live.message else ""

    def run(self) -> None:
        """Steps while the twin runs, at most as fast as time goes by, until `stop`."""
        pause, wanted = 0.0, self.live.dt
        while not self.ended.wait(pause):
            begun = time.perf_counter()
            try:
                wanted = self.live.dt / offered(self.slowdown)
                with self.busy:
                    if self.live.running:
                        self.live.step()
                        self.draw()
            except Exception as error:  # the page outlives whatever a step or a picture meets
                log.exception("the viewer stopped the motion")
                self.live.running, self.live.message = False, f"{type(error).__name__}: {error}"
                self.message.content = f"**{self.live.message}**"
            self.taken = time.perf_counter() - begun
            pause = max(wanted - self.taken, 0.002)  # the buttons get their turn
            self.taken += pause

    def stop(self) -> None:
        """Ends the player and the server."""
        self.ended.set()
        self.player.join(timeout=5)
        self.server.stop()
