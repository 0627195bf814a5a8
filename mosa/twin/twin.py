"""The learned twin in use: load a checkpoint, roll its law out from a new start or step by step, export particles and a video.

from mosa.twin import Twin
twin = Twin.load("outputs/train/.../checkpoints/last.ckpt")
rollout = twin.simulate(rotation=(1, 0, 0, 45), height=0.2, velocity=(0.5, -2, 0), frames=30)
twin.export(rollout, "falling/")"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any
from warnings import warn

import numpy as np
import torch
from annotated_types import Ge, Le
from plyfile import PlyData, PlyElement
from pydantic import InstanceOf
from torch import Tensor

from mosa.config.build import build_body, world_of
from mosa.config.checkpoints import TENSORS, check_kinds, check_numbers, checked, read_checkpoint
from mosa.config.record import BodyRecord
from mosa.data.io.splat_formats import Formats, check_formats, drop_later_frames, save_frames
from mosa.errors import ConfigError, DataError, MosaError
from mosa.evaluation.analysis.figures import ffmpeg, side_by_side, to_uint8, write_video
from mosa.evaluation.uncertainty import (
    DRAWS,
    among_forms,
    motions_under,
    total_spread,
)
from mosa.modules.body.body import Body, Start, World
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.parameters import read_numbers
from mosa.physics.contact.colliders import Collider, colliders_from_config
from mosa.physics.contact.driven import Driven, driven_from_config
from mosa.physics.engine.simulator import Substeps
from mosa.rendering.appearance.carried_splats import CarriedSplats, seen
from mosa.settings import Count, Expected, Number, Pixels, Positive, Seed, Zoom, such, typed
from mosa.system.limits import named_device
from mosa.system.progress import tqdm
from mosa.system.whole_files import made_folder, written_whole
from mosa.twin.batch import TwinWorlds
from mosa.twin.episode import (
    Episode,
    InMotion,
    OneWorld,
    TwinState,
    in_order,
    placed_as,
    rollout_of,
)
from mosa.twin.film import Views, film, viewed_from
from mosa.twin.material import TwinMaterial, summary
from mosa.twin.material_files import Formats as MaterialFormats
from mosa.twin.material_files import export_material
from mosa.twin.rollout_file import poses, save_rollout
from mosa.twin.shown_body import FILE as BODY_FILE
from mosa.twin.shown_body import save_body
from mosa.twin.start import (
    Crossings,
    Seconds,
    Variant,
    check_frames,
    check_wants_no_gradients,
    start_in,
    warn_of_creep,
    warn_of_unmet,
)
from mosa.types import Rollout

Draws = Annotated[int, Ge(2), Le(10_000)]
Motion = Annotated[
    InstanceOf[Rollout] | Sequence[InstanceOf[TwinState]],
    Expected("a Rollout, or a list of the states of steps in order (of worlds: each.world(0))"),
    such(lambda v: isinstance(v, Rollout) or in_order(v)),
]


class Twin(InMotion):
    """A learned body in its world. `frame_dt` [s]: time between the frames it was trained on."""

    def __init__(
        self, body: Body, world: World, frame_dt: float, record: BodyRecord | None, training_start: Start,
        posterior: Posterior | None = None,
    ) -> None:  # fmt: skip
        self.body, self.world, self.frame_dt = body, world, frame_dt
        self._record, self.training_start, self.posterior = record, training_start, posterior

    @property
    def record(self) -> BodyRecord:
        """Record of the run that made the body; of a body from elsewhere, of its parts."""
        if self._record is None:
            self._record = BodyRecord.of(self.body, self.world, self.frame_dt, self.training_start)
        return self._record

    @classmethod
    @torch.inference_mode(False)  # what is loaded may be used with gradients later
    @torch.random.fork_rng(devices=[])  # `build_body` seeds the generator, which is the caller's
    def load(cls, path: str | Path, device: str = "cpu") -> Twin:
        """Read a checkpoint, as data alone (docs/safety.md). Errors: DataError naming file and part where it is missing, damaged,
        or was not written by this program; ConfigError for a device that is not here."""
        device = named_device(device)
        checkpoint = read_checkpoint(path)
        record, tensors = checked(checkpoint, path)
        try:
            body = build_body(record, {name: tensors[name] for name in TENSORS})
            check_kinds(tensors, body.state_dict())
            body.load_state_dict(tensors)
            if record.splats is not None:
                body.splats = CarriedSplats.read(record.splats.plain(), body.rest)
            world, start = world_of(record), Start.read(record.start.plain())
        except Exception as error:  # every part has been checked; all may still fit no body
            kind = "" if isinstance(error, MosaError) else f"{type(error).__name__}: "
            reason = " ".join(f"{kind}{error}".split())[:300]
            raise DataError(
                f"ckpt_path: {path}: no body can be built from it ({reason})"
            ) from error
        check_numbers(record, len(read_numbers(body)), path)
        posterior = None if record.posterior is None else Posterior.read(record.posterior.plain())
        if note := record.settings.get("note"):  # of a fit to tests
            warn(f"{path}: {note}", stacklevel=2)
        return cls(body.to(device).eval(), world, record.frame_dt, record.body, start, posterior)

    @typed
    def predict(
        self, *, draws: Draws = DRAWS, seed: Seed = 0, **start: Any
    ) -> tuple[Rollout, Tensor]:
        """(rollout of the learned law, standard deviation (T, N) [m] of every particle's position) from a new start.

        start: as `simulate` takes it, but for a variant; draws: laws drawn from the posterior. Errors: ConfigError where the run
        kept no posterior (a fit by Adam), or where fewer than two of the draws can be simulated."""
        if self.posterior is None:
            raise ConfigError(
                "predict: this twin has no posterior: its material was set (load the checkpoint "
                "again), or its run kept none (a fit that ends by Gauss-Newton does: adapter=operator, "
                "linear or none)"
            )
        if (variant := start.get("variant", "adapted")) != "adapted":  # draws would not change it
            raise ConfigError(
                f"variant: expected adapted, whose posterior the run kept, found {variant!r}: "
                "simulate(variant=) rolls it out, without a standard deviation"
            )
        rollout = self.simulate(**start)
        drawn = self.posterior.draws(draws, torch.Generator().manual_seed(seed))
        own, rivals = self.body.material.law, list(self.posterior.rivals.items())

        def predicted(body: Body) -> Tensor:
            given = self.world, self.frame_dt, self._record, self.training_start
            return Twin(body, *given).simulate(**start).x

        found = motions_under(self.body, [(own, numbers) for numbers in drawn], predicted)
        if len(found) < 2:
            raise ConfigError(
                f"predict: expected at least two of {draws} draws of the law that can be "
                f"simulated, found {len(found)}"
            )
        forms = among_forms(rollout.x, motions_under(self.body, rivals, predicted))
        return rollout, total_spread(torch.stack(found), self.posterior.model_error, forms)

    @typed
    def simulate(
        self,
        *,
        rotation: Sequence[float] | Tensor | None = None,
        height: Number | None = None,
        position: Sequence[float | None] | Tensor | None = None,
        velocity: Sequence[float] | None = None,
        angular_velocity: Sequence[float] | None = None,
        frames: Count = 30,
        variant: Variant = "adapted",
        progress: bool = False,
        colliders: Sequence[Collider | Mapping[str, Any]] | None = None,
        box: Sequence[Sequence[float]] | Tensor | None = None,
        driven: Sequence[Driven | Mapping[str, Any]] | None = None,
        substeps: Substeps | None = None,
        gravity: Sequence[float] | None = None,
    ) -> Rollout:
        """Roll the learned law out from a new start.

        rotation: (ax, ay, az, degrees) about the body's centre, or a (3, 3) matrix, relative to the rest shape; position: (3,)
        [m] of the body's centre, None for a number that is left as it is; height [m] of the lowest point above the ground, in
        place of the position along `up`; velocity [m/s]; angular_velocity [rad/s]; what is left out is taken from the training
        sequence. colliders: rigid solids instead of the world's, or entries as a configuration has them; `reactions` of the
        result holds the forces on them. driven: sets of particles that are held, moved or loaded, instead of the world's
        (docs/driven.md); their reactions come after those of the colliders. box: (2, 3) [m] the lower and the upper corner of
        what no particle may leave, None for the scene's; walls of the world stay where they are. substeps: of a frame, as
        `reset` takes them. gravity: (3,) [m/s^2], None for the world's. No gradients: `reset(differentiable=True)` and `step`
        have them, and a tensor that requires them is refused. Errors: ConfigError naming the argument (also a solid that the
        body starts in), SimulationDiverged (the body leaves the box)."""
        check_frames(frames, len(self.body.rest))
        given = {"rotation": rotation, "height": height, "position": position, "velocity": velocity,
                 "angular_velocity": angular_velocity, "colliders": colliders, "box": box,
                 "driven": driven, "gravity": gravity}  # fmt: skip
        check_wants_no_gradients(**given)
        with (
            torch.no_grad(),
            tqdm(total=frames - 1, desc="simulate", unit="frame", disable=not progress) as bar,
        ):
            start, world = start_in(self.body, self.world, self.training_start, **given)
            ready = self.body.ready(
                start, world, frames, self.frame_dt, model=self.body.model(variant), substeps=substeps, enough=True,
            )  # fmt: skip
            fixed = ready.simulator.substeps if ready.timing is None else None
            warn_of_creep(self.body, world, self.frame_dt, fixed)
            if len(world.colliders) > 1:
                crossings = Crossings(world.colliders)
                times = self.frame_dt * torch.arange(frames)
                for moment in zip(*poses(world.colliders, times)):
                    crossings.look(*moment)
            rollout = ready.simulate(frames, world.solids, progress=lambda _: bar.update())
        warn_of_unmet([rollout], world.colliders, self.body, world)
        return rollout

    @typed
    def reset(
        self,
        *,
        rotation: Sequence[float] | Tensor | None = None,
        height: Number | None = None,
        position: Sequence[float | None] | Tensor | None = None,
        velocity: Sequence[float] | Tensor | None = None,
        angular_velocity: Sequence[float] | Tensor | None = None,
        colliders: Sequence[Collider | Mapping[str, Any]] | None = None,
        variant: Variant = "adapted",
        control_dt: Seconds | None = None,
        substeps: Substeps | None = None,
        frames: Count = 30,
        differentiable: bool = False,
        box: Sequence[Sequence[float]] | Tensor | None = None,
        driven: Sequence[Driven | Mapping[str, Any]] | None = None,
        gravity: Sequence[float] | None = None,
    ) -> TwinState:
        """Begin a motion that `step` goes on with; returns its state at time 0.

        rotation, height, position, velocity, angular_velocity, colliders, variant, box, driven, gravity: as `simulate`.
        control_dt [s]: of a step, the `frame_dt` of the training by default; substeps: of every step, None for as many as the
        time step bound asks for in a motion of `frames` steps, `simulate(frames=...)`'s. differentiable: whether gradients
        reach tensors among these arguments (a rotation as a matrix), the actions, and the law's parameters; it keeps states
        between the passes. Without it tensors that require gradients are refused. Errors: ConfigError."""
        check_frames(frames, len(self.body.rest))
        given = {"rotation": rotation, "height": height, "position": position, "velocity": velocity,
                 "angular_velocity": angular_velocity, "colliders": colliders, "box": box,
                 "driven": driven, "gravity": gravity}  # fmt: skip
        if not differentiable:
            check_wants_no_gradients(**given)
        start, world = start_in(self.body, self.world, self.training_start, **given)
        self._episode = Episode(
            self.body, world, control_dt or self.frame_dt, start, variant=variant, frames=frames,
            substeps=substeps, differentiable=differentiable,
        )  # fmt: skip
        warn_of_creep(self.body, world, self._episode.frame_dt, self._episode.substeps)
        return self._episode.state

    @typed
    def worlds(self, count: Count, laws: Tensor | Sequence[Any] | None = None) -> TwinWorlds:
        """`count` copies of the body, each in a world of its own, that are reset and stepped together.

        laws: of each world values that differ from the twin's, [{"E": 1e4, "nu": 0.3}, ...], as `material.set` takes them; or
        (count, numbers) as `posterior.draws(count)` gives them, in columns `posterior.names` (E as its logarithm); None for the
        twin's law in all. Errors: ConfigError."""
        return TwinWorlds(self, count, laws)

    @torch.no_grad()
    @typed
    def render(
        self,
        rollout: Motion,
        size: Pixels = 400,
        colliders: Sequence[Collider | Mapping[str, Any]] | None = None,
        view: Views | None = None,
        zoom: Zoom = 1.0,
        shadow: bool = True,
        driven: Sequence[Driven | Mapping[str, Any]] | None = None,
    ) -> Tensor:
        """(T, height, width, 3) images from a camera that sees the whole motion, on the ground and among `colliders`, those
        that the rollout was simulated with (None: the world's), as `driven`. rollout: or a list of the states of T steps, whose
        solids are drawn where they were then (None: those of `reset`). Half spaces are not drawn. size [px]: of a square, or
        (width, height). view: (3,) from the body to the camera, or (K, 3), as `film.viewed_from` spreads them over the frames; None
        for the side and a little above. zoom: magnification of at most 20, or several, spread over the frames; above 1 the camera
        follows the body. shadow: on the ground, of the body and of the solids, under light from above. Errors: ConfigError."""
        motion = self._met(rollout, colliders, driven)
        return film(self.body, self.world, *motion, size, view, zoom, shadow)

    def _met(
        self,
        motion: Rollout | Sequence[TwinState],
        colliders: Sequence[Collider | Mapping[str, Any]] | None,
        driven: Sequence[Driven | Mapping[str, Any]] | None,
    ) -> tuple[Rollout, tuple[Collider, ...]]:
        """(rollout, its solids), both as `render` takes them. Errors: ConfigError where it was not simulated with as many."""
        if isinstance(motion, Rollout):
            rollout, world = motion, self.world
            met = 0 if rollout.reactions is None else rollout.reactions.shape[-2]
        else:
            rollout, world = rollout_of(motion), (self._episode or self).world
            met = len(motion[0].collider_position)
            if met and colliders is None and isinstance(motion[0], OneWorld):
                raise ConfigError(
                    f"colliders: expected the {met} that `worlds(...).reset` was given, found none: "
                    "states of one of many worlds do not hold them"
                )
        if rollout.x.shape[1:] != self.body.rest.shape:
            raise ConfigError(
                f"rollout: expected one of this body's {len(self.body.rest)} particles, found {rollout!r}"
            )
        if driven is not None:
            world = replace(world, driven=driven_from_config(driven, "driven"))
        if met and colliders is None:
            solids = world.solids
        else:
            solids = colliders_from_config(colliders or (), "colliders")
        # driven sets have reactions, and nothing to draw
        if colliders is not None and met > len(solids):
            solids += world.solids[len(world.colliders) :]
        if met != len(solids):
            raise ConfigError(
                f"colliders and driven: expected the {met} that the rollout was simulated with, as simulate takes "
                f"them, found {len(solids)}"
            )
        return rollout, solids if isinstance(motion, Rollout) else placed_as(motion, solids)

    @typed
    def export(
        self, rollout: Motion, folder: str | Path, *, video: bool = True, title: str = "twin",
        formats: Formats = ("ply",), colliders: Sequence[Collider | Mapping[str, Any]] | None = None,
        size: Pixels = 400, fps: Positive | None = None, view: Views | None = None, zoom: Zoom = 1.0,
        shadow: bool = True, caption: bool = True, progress: bool = False,
        driven: Sequence[Driven | Mapping[str, Any]] | None = None,
    ) -> Path:  # fmt: skip
        """Write into `folder`: `body.npz`, which the viewer shows the motion with; `rollout.npz`, with the poses of
        `colliders`; one PLY a frame (x y z red green blue); `simulation.mp4`, with them and the ground; and the Gaussians of
        the body that its images show in `formats` (ply, gltf, sog, usd, rrd: docs/splats.md) below `splats/`. colliders, driven:
        those that the rollout was simulated with, and a list of states, as `render` takes them. Of the video: size [px], view, zoom
        and shadow, as there; fps, None for 0.3 of real time; caption: title and times, in bars of 26 px above and below;
        progress: a bar on the terminal. Errors, before anything is written: ConfigError where they are not, or a format's or
        the video's program is missing."""
        rollout, solids = self._met(rollout, colliders, driven)
        if rollout.reactions is None:  # of steps
            warn_of_unmet([rollout], solids, self.body, self.world)
        check_formats(formats)
        if video:
            ffmpeg("video")
            if view is not None:
                viewed_from(view, self.world.up)
        apart = float(rollout.times[1]) if len(rollout.times) > 1 else self.frame_dt
        folder = made_folder(Path(folder) / "ply").parent
        save_body(folder / BODY_FILE, self.body, self.world)
        save_rollout(folder / "rollout.npz", {"simulation": rollout}, solids)
        write_frames(folder / "ply", rollout.x.cpu().numpy(), self.body.colors.cpu().numpy())
        splats = seen(self.body, rollout.x, rollout.F_tot)
        save_frames(splats, folder / "splats", formats, rate=1 / apart, up=self.world.up)
        if video:
            moments = [f"frame {t}, {time:.3f} s" for t, time in enumerate(rollout.times.tolist())]
            images = film(
                self.body, self.world, rollout, solids, size, view, zoom, shadow, progress
            )
            plain = map(to_uint8, images)
            frames = side_by_side({title: images}, footer=moments) if caption else list(plain)
            write_video(folder / "simulation.mp4", frames, fps or max(5.0, 0.3 / apart))
        return folder

    @property
    def material(self) -> TwinMaterial:
        """Its material, to read and to set in physical units: `twin.material.E = 2e4`, `twin.material.preset("jelly")`."""
        return TwinMaterial(self)

    @typed
    def export_material(
        self, folder: str | Path, formats: MaterialFormats = ("json", "npz")
    ) -> Path:
        """Write the material for other simulators into `folder`: `material.json` (E, nu, density, damping, 6x6 stiffness, and
        what these leave out), `particles.npz` (points, volume, mass, E and nu of every particle), and with newton_usd, mujoco
        or obj in `formats` `newton.usda`, `mujoco.xml` or `surface.obj`. SI units. Errors: ConfigError for an unknown format,
        without usd-core, or for a body thinner than a cell of the grid."""
        return export_material(self, folder, formats)

    def summary(self) -> str:
        """Body, law, world and grid in lines of text with units, and how sure the law is."""
        return summary(self)

    def __repr__(self) -> str:
        body = self.body
        return f"Twin({len(body.rest)} particles, {1e3 * body.size:.4g} mm, {self.material!r})"


def write_frames(folder: Path, x: np.ndarray, colors: np.ndarray) -> None:
    """A PLY for each frame of x (T, N, 3), each whole or not there."""
    drop_later_frames(folder, ".ply", len(x))
    for t, points in enumerate(x):
        with written_whole(folder / f"{t:03d}.ply") as partial:
            write_ply(partial, points, colors)


def write_ply(path: str | Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Binary PLY with x y z [m] and 8-bit colours."""
    kinds = {"x": "f4", "y": "f4", "z": "f4", "red": "u1", "green": "u1", "blue": "u1"}
    vertex = np.empty(len(points), dtype=list(kinds.items()))
    numbers = np.concatenate([points, np.clip(colors * 255 + 0.5, 0, 255)], 1)
    for i, name in enumerate(kinds):
        vertex[name] = numbers[:, i]
    PlyData([PlyElement.describe(vertex, "vertex")]).write(str(path))
