"""A twin to play with: dropped, paused, stepped, pushed by a ball that a hand moves, coloured by stretch or stiffness.

Nothing here knows of a browser; `mosa.viewer.live_viewer` shows it. Not for several threads at once, but for `target`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import MosaError, SimulationDiverged
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.rendering.appearance.carried_splats import Seen, seen
from mosa.twin.episode import TwinState
from mosa.twin.start import start_in
from mosa.twin.twin import Twin
from mosa.viewer.clips import Scale, stiffness_scale
from mosa.viewer.pages import horizontal

COLORS = ("appearance", "stretch", "heterogeneity")
FASTEST = 4.0  # of the ball, body sizes per second: a jumping solid passes through the body
COURANT = 0.45  # cells per substep that the ball moves at most, below the half that a step allows
STEPS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Where the scale of stretches may end [%]: the next one above what was seen since the drop."""


@dataclass(frozen=True)
class Release:
    """How the body is let go. height [m]: of its lowest point above the ground; tilt [degrees] towards `heading` [degrees], which
    turns from the first view's right about the vertical; spin [turns/s] in the sense of the tilt; speed [m/s] along the heading."""

    height: float
    tilt: float = 0.0
    heading: float = 0.0
    spin: float = 0.0
    speed: float = 0.0


class Live:
    """One body of a twin among the twin's colliders and a ball, `hand`, that goes to `target` (3,) [m] as fast as a step allows.

    drop_as: the next drop; running: whether whoever shows it shall step on; message: what went wrong last, "" where nothing did. No
    method raises what a simulation or a start can: the motion stops, the message says why, and the last state reached stays.
    """

    def __init__(self, twin: Twin) -> None:
        self.twin, body, world = twin, twin.body, twin.world
        self.up = (world.up.double() / world.up.double().norm()).numpy()
        self.across = horizontal(self.up)
        self.arms = (body.rest - body.center).double().cpu().numpy()
        self.reach = float(np.linalg.norm(self.arms, axis=1).max())
        self.size, self.dt = body.size, twin.frame_dt
        self.ground = 0.0 if world.ground is None else float(world.ground.height)
        # at least two cells thick, that no material on both sides of it touches
        self.radius = max(0.12 * self.size, 1.25 * body.settings.dx)
        self.names = [solid.name or str(i) for i, solid in enumerate(world.solids)]
        self.column = len(world.colliders)  # of the ball: driven sets come after it
        self.hand = "hand"
        while self.hand in self.names:
            self.hand += "_"
        corners = torch.cartesian_prod(*world.box.double().T).numpy() @ self.up
        self.highest = max(float(corners.max()) - self.ground - 2 * self.reach, 0.0)
        begun = twin.training_start
        Q, middle = begun.rotation.double().cpu().numpy(), begun.center.double().cpu().numpy()
        low = float(((self.arms @ Q.T + middle) @ self.up).min()) - self.ground
        self.drop_as = Release(height=min(max(low, 0.0), self.highest))
        self.middle = middle
        self.running, self.message = False, ""
        self.state: TwinState | None = None
        self.force = np.zeros(3)
        self._last, self._high = self.drop_as, 0.0
        self.target = self.home()
        self.begin(self.drop_as)

    def axes(self, drop: Release) -> tuple[np.ndarray, np.ndarray]:
        """((3,) heading, (3,) axis of tilt and spin): unit vectors."""
        side, angle = np.cross(self.up, self.across), math.radians(drop.heading)
        heading = math.cos(angle) * self.across + math.sin(angle) * side
        return heading, np.cross(self.up, heading)

    def start(self, drop: Release) -> dict:
        """What `Twin.reset` takes."""
        heading, axis = self.axes(drop)
        return {
            "rotation": (*(axis if drop.tilt else self.up), drop.tilt), "height": float(drop.height),
            "velocity": tuple(drop.speed * heading), "angular_velocity": tuple(2 * math.pi * drop.spin * axis),
        }  # fmt: skip

    def home(self) -> np.ndarray:
        """(3,) [m] where the ball waits: beside the body, clear of it however it is turned, above the ground."""
        # contact fades in over 1.4 cells, and a particle is felt 1.5 cells away
        away = self.reach + self.radius + max(self.radius, 3 * self.twin.body.settings.dx)
        beside = self.middle - (self.middle @ self.up) * self.up - away * self.across
        return beside + (self.ground + max(1.1 * self.radius, 0.3 * self.size)) * self.up

    def begin(self, drop: Release) -> bool:
        """Let the body go from `drop`, at rest in time until `running`; whether it could be. The ball begins at its target, or at
        home where the body is."""
        self.message, self.running, self.force = "", False, np.zeros(3)
        twin, given = self.twin, self.start(drop)
        try:
            start, _ = start_in(twin.body, twin.world, twin.training_start, **given)
            Q, place = (each.double().cpu().numpy() for each in (start.rotation, start.center))
            x = self.arms @ Q.T + place
            if np.linalg.norm(x - self.target, axis=1).min() < self.radius + twin.body.settings.dx:
                self.target = self.home()
            solids = [*twin.world.colliders, self.ball(self.target)]
            # the time step is to allow for the speed that the whole fall gives
            options = {"colliders": solids, "control_dt": self.dt, "frames": 300}
            state = twin.reset(**given, **options)
        except (MosaError, RuntimeError) as error:
            return self.fail(error)
        self.state, self._last, self._high = state, drop, 0.0
        return True

    def ball(self, at: np.ndarray) -> Collider:
        return Collider(Sphere(self.radius), mode="separate", friction=0.3, name=self.hand,
                        motion=Motion(torch.as_tensor(at, dtype=torch.float64)))  # fmt: skip

    def drop(self) -> bool:
        """Let the body go as `drop_as` says, the ball where it was put."""
        self.running = self.begin(self.drop_as)
        return self.running

    def soften(self, E: float) -> None:
        """Young's modulus [Pa] of the drops to come."""
        self.twin.material.set(E=E)

    def reset(self) -> bool:
        """Back to the beginning of the last drop, the ball at home, paused."""
        self.target = self.home()
        return self.begin(self._last)

    def step(self) -> bool:
        """One step of `dt`; whether it could be made."""
        if self.state is None:
            self.running = False
            return False
        action = {self.hand: {"velocity": self.pull()}}
        try:
            state, reactions = self.twin.step(action)
        except (MosaError, RuntimeError) as error:
            return self.fail(error)
        felt = reactions[:, self.column, :3].mean(0)
        self.state, self.force = state, felt.detach().double().cpu().numpy()
        return True

    def pull(self) -> np.ndarray:
        """(3,) velocity [m/s] of the ball in the next step: to its target, or as far as a step allows."""
        velocity = (np.asarray(self.target, np.float64) - self.hand_position) / self.dt
        most, count = FASTEST * self.size, self.twin.episode.substeps
        if count is not None:
            most = min(most, COURANT * self.twin.body.settings.dx * count / self.dt)
        return velocity * min(1.0, most / max(float(np.linalg.norm(velocity)), 1e-12))

    def fail(self, error: Exception) -> bool:
        """Stop and say why; False."""
        self.running = False
        if isinstance(error, SimulationDiverged):
            self.message = (
                f"The simulation diverged at {self.time:.3f} s; what is shown is the state before. "
                f"Drop the body again, from lower or slower, or push more gently. ({error})"
            )
        else:
            self.message = f"{type(error).__name__}: {error}"
        return False

    @property
    def time(self) -> float:
        """[s] since the drop."""
        return 0.0 if self.state is None else float(self.state.time)

    @property
    def hand_position(self) -> np.ndarray:
        """(3,) [m] of the ball now."""
        if self.state is None:
            return np.asarray(self.target, np.float64)
        return self.state.collider_position[self.column].numpy()

    def poses(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """((3,) position [m], (3, 3) rotation) of the twin's own colliders now."""
        if self.state is None:
            return []
        pairs = zip(self.state.collider_position[: self.column], self.state.collider_rotation)
        return [(x.numpy(), R.numpy()) for x, R in pairs]

    @property
    def positions(self) -> Tensor:
        """(N, 3) [m] of the particles; as the training began where no drop could be made yet."""
        if self.state is None:
            begun, rest = self.twin.training_start, self.twin.body.rest
            arms = (rest - self.twin.body.center) @ begun.rotation.to(rest).T
            return arms + begun.center.to(rest)
        return self.state.positions.detach().to(self.twin.body.rest)

    @property
    def F_tot(self) -> Tensor:
        """(N, 3, 3)"""
        body = self.twin.body
        if self.state is None:
            return self.twin.training_start.rotation.to(body.rest).expand(len(body.rest), 3, 3)
        return self.state.F_tot.detach().to(body.rest)

    @cached_property
    def factor(self) -> np.ndarray:
        """(N,) by which a particle's stiffness differs from the law's."""
        with torch.no_grad():
            return self.twin.body.factor(self.twin.body.heterogeneity).cpu().numpy()

    @cached_property
    def nearest(self) -> np.ndarray | None:
        """(M,) particle nearest to each carried splat at rest; None where the particles are what is shown."""
        body = self.twin.body
        if body.splats is None:
            return None
        return cKDTree(body.rest.cpu().numpy()).query(body.splats.means.cpu().numpy())[1]

    def stretch(self) -> np.ndarray:
        """(N,) [-] largest principal stretch less 1: by how much the material's longest fibre there is longer than at rest."""
        F = self.F_tot.double()
        return torch.linalg.eigvalsh(F.mT @ F)[:, -1].clamp(min=0).sqrt().cpu().numpy() - 1

    def paint(self, by: str) -> tuple[np.ndarray, Scale | None]:
        """((N, 3) colours in [0, 1], their scale); that of the stretch only grows until the next drop."""
        if by == "appearance":
            return self.twin.body.colors.clamp(0, 1).cpu().numpy(), None
        if by == "heterogeneity":
            scale = stiffness_scale(self.factor)
            return scale.paint(self.factor), scale
        values = 100 * self.stretch()
        high = float(np.quantile(values, 0.99))
        self._high = max(self._high, next((s for s in STEPS if s >= high), STEPS[-1]))
        scale = Scale("largest principal stretch - 1 [%]", "viridis", 0, self._high, "max")
        return scale.paint(values), scale

    @torch.no_grad()
    def splats(self, by: str, colors: np.ndarray) -> tuple[np.ndarray, ...]:
        """Centers (M, 3) [m], covariances (M, 3, 3) [m^2], colours (M, 3) and opacities (M,) of what the body shows now; `colors`
        (N, 3) are those of `paint(by)`, which the splats take from the particles nearest to them at rest."""
        shown: Seen = seen(self.twin.body, self.positions[None], self.F_tot[None])
        if by == "appearance":
            colors = shown.colors()[0].cpu().numpy()
        elif self.nearest is not None:
            colors = colors[self.nearest]
        parts = (shown.means[0], shown.covariances[0], shown.opacities)
        means, covariances, opacities = (part.cpu().numpy() for part in parts)
        return means, covariances, colors, opacities

    def caption(self) -> str:
        """Of the moment."""
        x = self.positions.double().cpu().numpy() @ self.up - self.ground
        said = f"{self.time:.3f} s, lowest point {1e3 * x.min():.0f} mm above the ground  \n"
        return said + f"Force on the ball: {float(np.linalg.norm(self.force)):.2f} N"

    def change(self, **fields: float) -> None:
        """Fields of the next drop."""
        self.drop_as = replace(self.drop_as, **fields)
