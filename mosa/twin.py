"""The learned twin in use: load a checkpoint, roll its law out from a new start or step by step, export particles and a video.

    from mosa.twin import Twin
    twin = Twin.load("outputs/train/.../checkpoints/last.ckpt")
    rollout = twin.simulate(rotation=(1, 0, 0, 45), height=0.2, velocity=(0.5, -2, 0), frames=30)
    twin.export(rollout, "falling/")
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from torch import Tensor

from mosa.analysis.figures import side_by_side, write_video
from mosa.checkpoints import TENSORS, checked, checked_posterior, checked_splats, read_checkpoint
from mosa.data.splat_files import save_frames
from mosa.episode import Episode, Stepped, TwinState
from mosa.errors import ConfigError, DataError, MosaError, SimulationDiverged
from mosa.limits import machine_memory
from mosa.modules.body import VARIANTS, Body, Start, World
from mosa.modules.carried_splats import CarriedSplats, seen
from mosa.modules.gauss_newton import Posterior
from mosa.modules.identification import each_law, read_numbers
from mosa.npz import write_npz
from mosa.physics.contact.colliders import Collider, colliders_from_config
from mosa.physics.contact.overlap import check_clear
from mosa.prediction import total_spread
from mosa.progress import tqdm
from mosa.rendering.cameras import look_at
from mosa.rollout_file import save_rollout
from mosa.schema import is_number
from mosa.types import Cameras, MotionCues, Rollout


class Twin:
    """A learned body in its world. `frame_dt` [s]: time between the frames it was trained on."""

    def __init__(
        self, body: Body, world: World, frame_dt: float, config: dict, training_start: Start, posterior: Posterior | None = None
    ) -> None:
        self.body, self.world, self.frame_dt = body, world, frame_dt
        self.config, self.training_start, self.posterior = config, training_start, posterior
        self._episode: Episode | None = None

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> Twin:
        """Read a checkpoint, as data alone (docs/safety.md). Errors: DataError naming file and part where it is missing, damaged,
        or was not written by this program."""
        from mosa.config import build_body, build_world  # the builder needs the whole package, a twin's user only this line

        checkpoint = read_checkpoint(path)
        config, begun, tensors = checked(checkpoint, path)
        splats = checked_splats(checkpoint, path)
        try:
            body = build_body(config, {name: tensors[name] for name in TENSORS})
            body.load_state_dict(tensors)
            if splats is not None:
                body.splats = CarriedSplats.read(splats, body.rest)
            world, start = build_world(config["world"]), Start.read(begun)
        except Exception as error:  # every part has been checked; a file of a stranger may still fit no body
            reason = str(error) if isinstance(error, MosaError) else f"{type(error).__name__}: {error}"
            raise DataError(f"ckpt_path: {path}: no body can be built from it ({' '.join(reason.split())[:300]})") from error
        known = checked_posterior(checkpoint, len(read_numbers(body)), path)
        posterior = None if known is None else Posterior.read(known)
        return cls(body.to(device).eval(), world, config["frame_dt"], config, start, posterior)

    def predict(self, *, draws: int = 16, seed: int = 0, **start) -> tuple[Rollout, Tensor]:
        """(rollout of the learned law, standard deviation (T, N) [m] of every particle's position) from a new start.

        start: as `simulate` takes it; draws: laws drawn from the posterior. Errors: ConfigError where the run kept no posterior
        (a fit by Adam), or where fewer than two of the draws can be simulated.
        """
        if self.posterior is None:
            raise ConfigError("predict: this run kept no posterior; a fit by Gauss-Newton does (fit.joint.optimizer=auto)")
        rollout, found = self.simulate(**start), []
        for _ in each_law(self.body, self.posterior.draws(draws, torch.Generator().manual_seed(seed))):
            try:
                found.append(self.simulate(**start).x)
            except SimulationDiverged:
                continue
        if len(found) < 2:
            raise ConfigError(f"predict: expected at least two of {draws} draws of the law that can be simulated from this start, "
                              f"found {len(found)}")
        return rollout, total_spread(torch.stack(found), self.posterior.model_error)

    @torch.no_grad()
    def simulate(
        self,
        *,
        rotation: Sequence[float] | Tensor | None = None,
        height: float | None = None,
        position: Sequence[float | None] | Tensor | None = None,
        velocity: Sequence[float] | None = None,
        angular_velocity: Sequence[float] | None = None,
        frames: int = 30,
        variant: str = "adapted",
        progress: bool = False,
        colliders: Sequence[Collider | Mapping] | None = None,
    ) -> Rollout:
        """Roll the learned law out from a new start.

        rotation: (ax, ay, az, degrees) about the body's centre, or a (3, 3) matrix, relative to the rest shape; position: (3,) [m]
        of the body's centre, None for a number that is left as it is; height [m] of the lowest point above the ground, in place
        of the position along `up`; velocity [m/s]; angular_velocity [rad/s]; what is left out is taken from the training
        sequence. colliders: rigid solids instead of the world's, or entries as a configuration has them; `reactions` of the result
        holds the forces on them. Errors: ConfigError naming the argument (also a solid that the body starts in),
        SimulationDiverged (the body leaves the box of the scene).
        """
        check_frames(frames, len(self.body.rest))
        check_variant(variant)
        start, world = self._start(rotation, height, position, velocity, angular_velocity, colliders)
        with tqdm(total=frames - 1, desc="simulate", unit="frame", disable=not progress) as bar:
            return self.body.simulate(start, world, frames, self.frame_dt, variant=variant, progress=lambda _: bar.update())

    def reset(
        self,
        *,
        rotation: Sequence[float] | Tensor | None = None,
        height: float | None = None,
        position: Sequence[float | None] | Tensor | None = None,
        velocity: Sequence[float] | Tensor | None = None,
        angular_velocity: Sequence[float] | Tensor | None = None,
        colliders: Sequence[Collider | Mapping] | None = None,
        variant: str = "adapted",
        control_dt: float | None = None,
        substeps: int | None = None,
        frames: int = 30,
        differentiable: bool = False,
    ) -> TwinState:
        """Begin a motion that `step` goes on with; returns its state at time 0.

        rotation, height, position, velocity, angular_velocity, colliders, variant: as `simulate`. control_dt [s]: of a step, the
        `frame_dt` of the training by default; substeps: of every step, None for as many as the time step bound asks for in a
        motion of `frames` steps, `simulate(frames=...)`'s. differentiable: whether gradients reach tensors among these arguments
        (a rotation as a matrix), the actions, and the law's parameters; it keeps states between the passes. Errors: ConfigError.
        """
        check_frames(frames, len(self.body.rest))
        check_variant(variant)
        start, world = self._start(rotation, height, position, velocity, angular_velocity, colliders)
        self._episode = Episode(
            self.body, world, checked_dt(control_dt, self.frame_dt), start, variant=variant, frames=frames,
            substeps=checked_substeps(substeps), differentiable=differentiable,
        )  # fmt: skip
        return self._episode.state

    def step(self, action: Mapping[str, Any] | None = None) -> Stepped:
        """Go one step on: (state, reactions), see `mosa.episode`.

        action: for colliders by name (their number as a text where they have none), either `velocity` (3,) [m/s] and
        `angular_velocity` (3,) [rad/s] in world axes, about the collider's origin, for this step, or the `position` (3,) [m] and
        `rotation` ((3,) vector [rad] or (3, 3)) where it shall be after it; three numbers alone are a velocity. A collider that
        was never in an action follows its own motion; one that was, but is not in this one, stands still.
        Errors: ConfigError naming the collider, what was expected and found; SimulationDiverged.
        """
        return self.episode.step(action)

    @property
    def episode(self) -> Episode:
        """The motion that `reset` began. Errors: ConfigError before that."""
        if self._episode is None:
            raise ConfigError("twin: expected reset(...) before step and state, found no motion")
        return self._episode

    @property
    def state(self) -> TwinState:
        """Of the motion now; set it to go back to an earlier one, or to branch. `state.tensors()` are plain tensors to save, and
        `TwinState.read` makes them a state again, after a reset with the same arguments."""
        return self.episode.state

    @state.setter
    def state(self, state: TwinState) -> None:
        self.episode.state = state

    def worlds(self, count: int, laws: Tensor | None = None) -> TwinWorlds:
        """`count` copies of the body, each in a world of its own, that are reset and stepped together.

        laws: (count, numbers) of a law for each, as `posterior.draws(count)` gives them, None for the learned one in all.
        Errors: ConfigError."""
        return TwinWorlds(self, count, laws)

    def _start(self, rotation, height, position, velocity, angular_velocity, colliders) -> tuple[Start, World]:
        """(the start, the world with its colliders), checked. Errors: ConfigError naming the argument."""
        body, first = self.body, self.training_start
        Q = first.rotation if rotation is None else rotation_matrix(rotation)
        Q = Q.to(body.rest)
        velocity_ = first.velocity if velocity is None else vector("velocity", velocity)
        spin = first.angular_velocity if angular_velocity is None else vector("angular_velocity", angular_velocity)
        center = first.center.to(body.rest)
        if position is not None:
            center = placed(position, center)
        up = self.world.up.to(body.rest)
        arms = (body.rest - body.center) @ Q.T
        if height is not None:
            if not is_number(height) or (height < 0 and self.world.ground is not None):
                raise ConfigError(f"height: expected metres above the ground, a finite number >= 0, found {height!r}")
            ground = self.world.ground.height if self.world.ground is not None else 0.0
            center = center + up * (ground + height - (arms @ up).min() - center @ up)
        start = Start(Q, center, velocity_.to(body.rest), spin.to(body.rest))
        world = self.world
        if colliders is not None:
            world = replace(world, colliders=colliders_from_config(colliders, "colliders"))
        check_clear(world.colliders, center + arms, "the body", "world.colliders" if colliders is None else "colliders")
        return start, world

    @torch.no_grad()
    def render(self, rollout: Rollout, size: int = 400) -> Tensor:
        """(T, size, size, 3) images from one camera that sees the whole motion."""
        body, up = self.body, self.world.up.to(self.body.rest)
        low, high = rollout.x.amin((0, 1)), rollout.x.amax((0, 1))
        target = 0.5 * (low + high)
        side = torch.tensor([0.9, 0.0, 1.0]).to(body.rest)
        side = side - (side @ up) * up if float((side - (side @ up) * up).norm()) > 1e-3 else torch.roll(up, 1)
        focal = 1.6 * size
        distance = 0.75 * float((high - low).norm()) * focal / size + 0.2
        eye = target + distance * (side / side.norm() + 0.25 * up)
        K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
        camera = Cameras(K[None].to(body.rest), look_at(eye, target, up)[None].to(body.rest), size, size, ("view",))
        return seen(body, rollout.x, rollout.F_tot).images(camera, torch.ones(3).to(body.rest))[0].clamp(0, 1).cpu()

    def export(
        self, rollout: Rollout, folder: str | Path, *, video: bool = True, title: str = "learned twin",
        formats: Sequence[str] = ("ply",), colliders: Sequence[Collider] = (),
    ) -> Path:  # fmt: skip
        """Write `rollout.npz` (with the poses of `colliders`, those of the rollout, where they are given), one PLY a frame (x y z
        red green blue), `simulation.mp4` and the Gaussians that its images show in `formats` (`data.splat_files.FORMATS`: 3DGS
        PLY, splat, spz, usd) below `splats/` into `folder`."""
        folder = Path(folder)
        (folder / "ply").mkdir(parents=True, exist_ok=True)
        save_rollout(folder / "rollout.npz", {"simulation": rollout}, colliders)
        for t, x in enumerate(rollout.x.cpu().numpy()):
            write_ply(folder / "ply" / f"{t:03d}.ply", x, self.body.colors.cpu().numpy())
        save_frames(seen(self.body, rollout.x, rollout.F_tot), folder / "splats", formats, rate=1 / self.frame_dt, up=self.world.up)
        if video:
            moments = [f"frame {t}, {time:.3f} s" for t, time in enumerate(rollout.times.tolist())]
            frames = side_by_side({title: self.render(rollout)}, footer=moments)
            write_video(folder / "simulation.mp4", frames, fps=max(5.0, 0.3 / self.frame_dt))
        return folder


class TwinWorlds:
    """A twin's body in `count` worlds that never meet, stepped together: on CUDA in the same launches, on a CPU in threads."""

    def __init__(self, twin: Twin, count: int, laws: Tensor | None = None) -> None:
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ConfigError(f"worlds: expected a whole number of at least 1, found {count!r}")
        if laws is not None and len(laws) != count:
            raise ConfigError(f"laws: expected one for each of {count} worlds, found {len(laws)}")
        self.twin, self.count, self.laws = twin, count, laws
        self.episode: Episode | None = None

    def reset(
        self, starts: Mapping | Sequence[Mapping] | None = None, *, colliders: Sequence[Collider | Mapping] | None = None,
        gravity: Tensor | Sequence | None = None, variant: str = "adapted", control_dt: float | None = None,
        substeps: int | None = None, frames: int = 30, differentiable: bool = False,
    ) -> TwinState:  # fmt: skip
        """Begin a motion in every world; returns the state (count, ...).

        starts: rotation, height, position, velocity, angular_velocity as `Twin.simulate` takes them, for all worlds or one mapping
        for each; gravity: (count, 3) [m/s^2], None for the world's; others as `Twin.reset`. Errors: ConfigError naming the world.
        """
        check_frames(frames, self.count * len(self.twin.body.rest))
        check_variant(variant)
        found = self._found(starts, range(self.count), colliders)
        if gravity is not None:
            gravity = numbers("gravity", gravity, f"finite numbers ({self.count}, 3)")
            if gravity.shape != (self.count, 3):
                raise ConfigError(f"gravity: expected shape ({self.count}, 3), found {tuple(gravity.shape)}")
        self.episode = Episode(
            self.twin.body, found[0][1], checked_dt(control_dt, self.twin.frame_dt), [start for start, _ in found],
            variant=variant, frames=frames, substeps=checked_substeps(substeps), laws=self.laws, gravity=gravity,
            differentiable=differentiable,
        )  # fmt: skip
        return self.episode.state

    def restart(self, which: Sequence[int], starts: Mapping | Sequence[Mapping] | None = None) -> TwinState:
        """Put the worlds with these numbers back to new starts, as `reset` takes them, None for those they had; the others stay as
        they are. Time is one for all and goes on: colliders that were driven are back where they began, others follow their
        motion. Errors: ConfigError naming the world."""
        which, episode = list(which), self._going()
        given = None if starts is None else [start for start, _ in self._found(starts, which, episode.colliders)]
        return episode.restart(which, given)

    def _found(self, starts: Mapping | Sequence[Mapping] | None, which: Sequence[int], colliders) -> list[tuple[Start, World]]:
        """The starts of these worlds, and the world. Errors: ConfigError."""
        each = [dict(starts or {})] * len(which) if starts is None or isinstance(starts, Mapping) else list(starts)
        if len(each) != len(which):
            raise ConfigError(f"starts: expected one, or one for each of {len(which)} worlds, found {len(each)}")
        found = []
        for i, (b, given) in enumerate(zip(which, each)):
            if unknown := sorted(set(given) - set(STARTED)):
                raise ConfigError(f"starts[{b}]: expected {', '.join(STARTED)}, found {', '.join(unknown)}")
            if i and given is each[0]:
                found.append(found[0])
                continue
            try:
                found.append(self.twin._start(*(given.get(name) for name in STARTED), colliders))
            except ConfigError as error:
                raise ConfigError(f"starts[{b}]: {error}") from error
        return found

    def _going(self) -> Episode:
        if self.episode is None:
            raise ConfigError("worlds: expected reset(...) before step and state, found no motion")
        return self.episode

    def step(self, action: Mapping[str, Any] | None = None) -> Stepped:
        """As `Twin.step`; every command is the same in all worlds, or (count, 3), rotations (count, 3, 3), for each."""
        return self._going().step(action)

    @property
    def state(self) -> TwinState:
        """As `Twin.state`, of all worlds."""
        return self._going().state

    @state.setter
    def state(self, state: TwinState) -> None:
        self._going().state = state


STARTED = ("rotation", "height", "position", "velocity", "angular_velocity")
"""What a start may say, in the order of `Twin._start`."""
FASTEST = 1e6
"""[m/s], [rad/s] of a start: the time step would be refused far below."""
STORED_BYTES = 4 * (3 + 3 + 9 + 9)
"""Of a particle in a frame of a rollout: x, v, F, F_tot."""


def check_frames(frames: int, particles: int) -> None:
    """Errors: ConfigError where frames are no whole number, or are more than the machine can hold."""
    if isinstance(frames, bool) or not isinstance(frames, int) or frames < 1:
        raise ConfigError(f"frames: expected a whole number of at least 1, found {frames!r}")
    most = machine_memory() // (2 * STORED_BYTES * particles)
    if frames > most:
        raise ConfigError(f"frames: expected at most {most}, which take half of this machine's memory, found {frames}")


def check_variant(variant: str) -> None:
    if variant not in VARIANTS:
        raise ConfigError(f"variant: expected one of {', '.join(VARIANTS)}, found {variant!r}")


def checked_dt(value: float | None, default: float) -> float:
    """[s] of a step. Errors: ConfigError."""
    if value is None:
        return default
    if not is_number(value) or not value > 0:
        raise ConfigError(f"control_dt: expected a positive number [s], found {value!r}")
    return float(value)


def checked_substeps(value: int | None) -> int | None:
    if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
        raise ConfigError(f"substeps: expected a whole number of at least 1, or None, found {value!r}")
    return value


def placed(position: Sequence[float | None] | Tensor, center: Tensor) -> Tensor:
    """(3,) the centre with the numbers of `position` that are not None. Errors: ConfigError."""
    if isinstance(position, Sequence) and not isinstance(position, str) and len(position) == 3:
        kept = [number is None for number in position]
        found = vector("position", [0.0 if number is None else number for number in position]).to(center)
        return torch.where(torch.tensor(kept, device=center.device), center, found)
    return vector("position", position).to(center)


def numbers(name: str, value: Sequence[float] | Tensor, expected: str) -> Tensor:
    """Tensor of finite numbers, float64 where they are given so, else float32. Errors: ConfigError naming the field."""
    try:
        result = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ConfigError(f"{name}: expected {expected}, found {str(value)[:120]}") from error
    if result.dtype == torch.bool or result.is_complex() or not bool(torch.isfinite(result.detach().float()).all()):
        raise ConfigError(f"{name}: expected {expected}, found {str(value)[:120]}")
    return result if result.dtype == torch.float64 else result.float()


def rotation_matrix(value: Sequence[float] | Tensor) -> Tensor:
    """(3, 3) from (ax, ay, az, degrees) or a matrix. Errors: ConfigError for anything else, and a matrix that is no rotation."""
    expected = "(ax, ay, az, degrees) with a non-zero axis or a 3x3 rotation matrix"
    value = numbers("rotation", value, expected)
    if value.shape == (3, 3):
        R = value.detach().double()
        defect = float((R @ R.T - torch.eye(3).double()).abs().max())
        if defect > 1e-3 or float(torch.linalg.det(R)) < 0:
            raise ConfigError(f"rotation: expected R R^T = I and det R = 1, found a defect of {defect:.3g} and a determinant of "
                              f"{float(torch.linalg.det(R)):.3g}: scaled, sheared or mirrored bodies are not what was learned")
        return value
    if value.shape != (4,) or not 0 < float(value[:3].double().norm()) < math.inf:
        raise ConfigError(f"rotation: expected {expected}, found {value.tolist()}")
    axis = (value[:3].double() / value[:3].double().norm()).numpy()
    return torch.tensor(Rotation.from_rotvec(axis * math.radians(float(value[3]))).as_matrix(), dtype=torch.float32)


def vector(name: str, value: Sequence[float]) -> Tensor:
    """(3,) tensor. Errors: ConfigError naming the field."""
    expected = f"three finite numbers within {FASTEST:g}"
    result = numbers(name, value, expected)
    if result.shape != (3,) or float(result.detach().abs().max()) > FASTEST:
        raise ConfigError(f"{name}: expected {expected}, found {str(value)[:120]}")
    return result


def save_observed(path: str | Path, parts: dict[str, MotionCues]) -> None:
    """npz with x [T, N, 3] and covariances [T, N, 3, 3] of the motions learned from, under `<name>/...` as `save_rollout`."""
    save_parts(path, {name: {"x": cues.positions, "covariances": cues.covariances} for name, cues in parts.items()})


def save_spread(path: str | Path, parts: dict[str, Tensor]) -> None:
    """npz with sd [T, N], the predicted standard deviation of every particle's position [m], under `<name>/sd`."""
    save_parts(path, {name: {"sd": sd.float()} for name, sd in parts.items()})


def save_truth(path: str | Path, parts: dict[str, Tensor]) -> None:
    """npz with x [T, N, 3], single precision, where the body's particles would truly be, under `<name>/...` as `save_rollout`."""
    save_parts(path, {name: {"x": x.float()} for name, x in parts.items()})


def save_parts(path: str | Path, parts: dict[str, dict[str, Tensor]]) -> None:
    """npz of the tensors under `<name>/<key>`."""
    arrays = {f"{name}/{key}": t for name, tensors in parts.items() for key, t in tensors.items()}
    write_npz(path, {key: t.detach().cpu().numpy() for key, t in arrays.items()})


def write_ply(path: str | Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Binary PLY with x y z [m] and 8-bit colours."""
    vertex = np.empty(len(points), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for i, name in enumerate(("x", "y", "z")):
        vertex[name] = points[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        vertex[name] = np.clip(colors[:, i] * 255 + 0.5, 0, 255).astype(np.uint8)
    PlyData([PlyElement.describe(vertex, "vertex")]).write(str(path))
