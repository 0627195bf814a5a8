"""The learned twin in use: load a checkpoint, roll its law out from a new start, export particles and a video.

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

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from torch import Tensor

from mosa.analysis.figures import side_by_side, write_video
from mosa.errors import ConfigError, DataError
from mosa.modules.body import Body, Start, World
from mosa.modules.observer import deformed_covariances, observe
from mosa.physics.colliders import Collider, colliders_from_config
from mosa.progress import tqdm
from mosa.rendering.cameras import look_at
from mosa.types import Cameras, MotionCues, Rollout


class Twin:
    """A learned body in its world. `frame_dt` [s]: time between the frames it was trained on."""

    def __init__(self, body: Body, world: World, frame_dt: float, config: dict, training_start: Start) -> None:
        self.body, self.world, self.frame_dt = body, world, frame_dt
        self.config, self.training_start = config, training_start

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> Twin:
        """Read a checkpoint. Errors: DataError where the file is missing or was not written by this program."""
        from mosa.config import build_body, build_world  # the builder needs the whole package, a twin's user only this line

        checkpoint = read_checkpoint(path)
        saved = checkpoint["mosa"]
        state = {k.removeprefix("body."): v for k, v in checkpoint["state_dict"].items() if k.startswith("body.")}
        body = build_body(saved["config"], {k: state[k] for k in ("rest", "volume", "colors", "opacities", "covariances")})
        body.load_state_dict(state)
        start = Start.read(saved["start"])
        config = saved["config"]
        return cls(body.to(device).eval(), build_world(config["world"]), config["frame_dt"], config, start)

    @torch.no_grad()
    def simulate(
        self,
        *,
        rotation: Sequence[float] | Tensor | None = None,
        height: float | None = None,
        velocity: Sequence[float] | None = None,
        angular_velocity: Sequence[float] | None = None,
        frames: int = 30,
        variant: str = "adapted",
        progress: bool = False,
        colliders: Sequence[Collider | Mapping] | None = None,
    ) -> Rollout:
        """Roll the learned law out from a new start.

        rotation: (ax, ay, az, degrees) about the body's centre, or a (3, 3) matrix, relative to the rest shape; height [m] of the
        lowest point above the ground; velocity [m/s]; angular_velocity [rad/s]; what is left out is taken from the training
        sequence. colliders: rigid solids instead of the world's, or entries as a configuration has them; `reactions` of the result
        holds the forces on them. Errors: ConfigError (shapes), SimulationDiverged (the body leaves the box of the scene).
        """
        body, first = self.body, self.training_start
        Q = first.rotation if rotation is None else rotation_matrix(rotation)
        Q = Q.to(body.rest)
        velocity_ = first.velocity if velocity is None else vector("velocity", velocity)
        spin = first.angular_velocity if angular_velocity is None else vector("angular_velocity", angular_velocity)
        center = first.center.to(body.rest)
        up = self.world.up.to(body.rest)
        if height is not None:
            lowest = (((body.rest - body.center) @ Q.T) @ up).min()
            ground = self.world.ground.height if self.world.ground is not None else 0.0
            center = center + up * (ground + height - lowest - center @ up)
        start = Start(Q, center, velocity_.to(body.rest), spin.to(body.rest))
        world = self.world
        if colliders is not None:
            world = replace(world, colliders=colliders_from_config(colliders, "colliders"))
        with tqdm(total=frames - 1, desc="simulate", unit="frame", disable=not progress) as bar:
            return body.simulate(start, world, frames, self.frame_dt, variant=variant, progress=lambda _: bar.update())

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
        return observe(rollout.x, deformed_covariances(rollout.F_tot, body.covariances), body.opacities, body.colors, camera,
                       torch.ones(3).to(body.rest)).images[0].cpu()

    def export(self, rollout: Rollout, folder: str | Path, *, video: bool = True, title: str = "learned twin") -> Path:
        """Write `rollout.npz`, one PLY a frame (x y z red green blue) and `simulation.mp4` into `folder`."""
        folder = Path(folder)
        (folder / "ply").mkdir(parents=True, exist_ok=True)
        save_rollout(folder / "rollout.npz", {"simulation": rollout})
        for t, x in enumerate(rollout.x.cpu().numpy()):
            write_ply(folder / "ply" / f"{t:03d}.ply", x, self.body.colors.cpu().numpy())
        if video:
            moments = [f"frame {t}, {time:.3f} s" for t, time in enumerate(rollout.times.tolist())]
            frames = side_by_side({title: self.render(rollout)}, footer=moments)
            write_video(folder / "simulation.mp4", frames, fps=max(5.0, 0.3 / self.frame_dt))
        return folder


def read_checkpoint(path: str | Path) -> dict:
    """The checkpoint's dictionary. Errors: DataError naming the file."""
    path = Path(path)
    if not path.is_file():
        raise DataError(f"ckpt_path: no file {path}; a run writes <run folder>/checkpoints/last.ckpt")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise DataError(f"ckpt_path: {path} is not a readable checkpoint ({type(error).__name__}: {error})") from error
    if "mosa" not in checkpoint:
        raise DataError(f"ckpt_path: {path} was not written by this program (no entry 'mosa')")
    return checkpoint


def rotation_matrix(value: Sequence[float] | Tensor) -> Tensor:
    """(3, 3) from (ax, ay, az, degrees) or a matrix."""
    value = torch.as_tensor(value, dtype=torch.float32)
    if value.shape == (3, 3):
        return value
    if value.shape != (4,) or float(value[:3].norm()) == 0:
        raise ConfigError(f"rotation: expected (ax, ay, az, degrees) with a non-zero axis or a 3x3 matrix, found {value.tolist()}")
    axis = (value[:3] / value[:3].norm()).double().numpy()
    return torch.tensor(Rotation.from_rotvec(axis * math.radians(float(value[3]))).as_matrix(), dtype=torch.float32)


def vector(name: str, value: Sequence[float]) -> Tensor:
    """(3,) tensor. Errors: ConfigError naming the field."""
    result = torch.as_tensor(value, dtype=torch.float32)
    if result.shape != (3,) or not bool(torch.isfinite(result).all()):
        raise ConfigError(f"{name}: expected three finite numbers, found {value}")
    return result


def save_rollout(path: str | Path, parts: dict[str, Rollout]) -> None:
    """npz with x [T, N, 3], F and F_tot [T, N, 3, 3], times [T] and counts [T - 1] (substeps) under `<name>/...`."""
    save_parts(path, {
        name: {"x": r.x, "F": r.F, "F_tot": r.F_tot, "times": r.times, "counts": torch.tensor(r.counts, dtype=torch.int64)}
        for name, r in parts.items()
    })  # fmt: skip


def save_observed(path: str | Path, parts: dict[str, MotionCues]) -> None:
    """npz with x [T, N, 3] and covariances [T, N, 3, 3] of the motions learned from, under `<name>/...` as `save_rollout`."""
    save_parts(path, {name: {"x": cues.positions, "covariances": cues.covariances} for name, cues in parts.items()})


def save_truth(path: str | Path, parts: dict[str, Tensor]) -> None:
    """npz with x [T, N, 3], single precision, where the body's particles would truly be, under `<name>/...` as `save_rollout`."""
    save_parts(path, {name: {"x": x.float()} for name, x in parts.items()})


def save_parts(path: str | Path, parts: dict[str, dict[str, Tensor]]) -> None:
    """npz of the tensors under `<name>/<key>`."""
    arrays = {f"{name}/{key}": t for name, tensors in parts.items() for key, t in tensors.items()}
    np.savez_compressed(path, **{key: t.detach().cpu().numpy() for key, t in arrays.items()})


def write_ply(path: str | Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Binary PLY with x y z [m] and 8-bit colours."""
    vertex = np.empty(len(points), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for i, name in enumerate(("x", "y", "z")):
        vertex[name] = points[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        vertex[name] = np.clip(colors[:, i] * 255 + 0.5, 0, 255).astype(np.uint8)
    PlyData([PlyElement.describe(vertex, "vertex")]).write(str(path))
