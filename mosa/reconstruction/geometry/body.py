"""The body that is filled: a visual hull without the air that colours, outlines of the free flight and smoothness tell from
matter.

Where the images say nothing the hull stays, smoothed between its outlines, and `Geometry.figures` say how much of the surface
that is."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.data.hull import Volume, shave_ridges
from mosa.errors import DataError
from mosa.reconstruction.geometry import refinement
from mosa.reconstruction.geometry.carving import carve, keep_silhouettes
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.pose.flight import free_motions
from mosa.reconstruction.settings import GeometrySection
from mosa.types import Scene, Splats

OPTIMISM = 1.3
"""Root mean square error of the surface over the standard deviation that its information alone gives: neighbouring pixels are not
independent, and a neighbourhood does not move as one. Measured on the gorilla and the bowl."""


FIRST, THEN = ((4, 2.0), (4, 1.0)), ((3, 1.0), (9, 0.4))
"""Rounds and blur [px] of the refinement on frame 0, from which the flight is followed, and then on all free frames."""


@dataclass(frozen=True)
class Geometry:
    """body: values 0 or 1; hull_volume [m^3]; deviation: standard deviation [m] of the surface where it is known at all, on the
    body's grid, infinite where no image says anything (empty: nothing was measured); free_frames: how many frames were used;
    static: Gaussians that the body was found by, if any; registered, place: figures of a body of known shape, and the
    parts of its similarity (`Similarities`)."""

    body: Volume
    hull_volume: float
    deviation: Tensor
    free_frames: int
    static: Splats | None = None
    registered: dict[str, float] = field(default_factory=dict)
    place: dict[str, Tensor] = field(default_factory=dict)

    def figures(self, spacing: float) -> dict[str, float]:
        """`geometry/...`: volumes [m^3], share of the hull that was emptied, and, where images were used, share of the surface
        that they do not tell to 0.7 particle spacings (two standard deviations): there the body is a guess between outlines."""
        volume = self.body.occupied_volume()
        if self.registered:
            return {"geometry/volume_m3": volume, **self.registered}
        figures = {
            "geometry/hull_volume_m3": self.hull_volume, "geometry/volume_m3": volume,
            "geometry/carved_share": 1 - volume / self.hull_volume, "geometry/free_frames": float(self.free_frames),
        }  # fmt: skip
        if self.deviation.numel():
            on_surface = self.deviation[surface_of(self.body)]
            uncertain = 2 * on_surface > 0.7 * spacing
            figures["geometry/uncertain_share"] = float(uncertain.double().mean())
            figures["geometry/deviation_m"] = float(on_surface.median())
        return figures

    def stored(self) -> dict:
        """Tensors and numbers of it, for `read`."""
        return {
            "values": self.body.values.cpu(), "origin": self.body.origin.cpu(), "pitch": self.body.pitch,
            "hull_volume": self.hull_volume, "deviation": self.deviation.cpu(), "free_frames": self.free_frames,
            "static": None if self.static is None else vars(self.static.to("cpu")), "registered": self.registered,
            "place": self.place,
        }  # fmt: skip

    @classmethod
    def read(cls, stored: dict) -> Geometry:
        """The inverse of `stored`."""
        rest = dict(stored)
        body = Volume(*(rest.pop(name) for name in ("values", "origin", "pitch")))
        static = Splats(**rest["static"]) if rest["static"] else None
        return cls(body, **rest | {"static": static})


def surface_of(body: Volume) -> Tensor:
    """Voxels (X, Y, Z) bool of a body that have an empty neighbour across a face."""
    inside = F.pad((body.values > 0.5).float(), (1,) * 6)
    around = sum(inside.roll(step, dim) for dim in range(3) for step in (-1, 1))
    return ((inside > 0.5) & (around < 6))[1:-1, 1:-1, 1:-1]


def free_frames_at_most(scene: Scene, count: int) -> list[int]:
    """Training frames 0, 1, ... without a gap, at most `count`."""
    frames = []
    for t in scene.training_frames:
        if t != len(frames) or len(frames) == count:
            break
        frames.append(t)
    return frames


def holds_matter(distance: Volume) -> bool:
    """Whether any point of the grid lies inside of the surface."""
    return bool((distance.values < 0).any())


def nothing_left(scene: Scene, hull: Geometry) -> Geometry:
    """The hull's geometry, where the images left nothing of it, with a warning that says so."""
    warnings.warn(
        f"scene {scene.name}: carving and refinement left nothing of a visual hull of {int(hull.body.values.sum())} voxels of "
        f"{1e3 * hull.body.pitch:.3g} mm; the hull is the body, as with reconstruction.geometry.source=hull. More voxels "
        "(reconstruction.resolution) or pixels (scene.scale) may tell more", stacklevel=3,
    )  # fmt: skip
    return hull


def find_geometry(
    scene: Scene, hull: Volume, settings: GeometrySection, *, ridge_passes: int, sigma: float,
    margin: int, device: torch.device | str,
) -> Geometry:  # fmt: skip
    """The body of `scene` inside its visual hull (occupancy of frame 0, training cameras only), read from training frames alone;
    the hull's where they leave nothing of it. Errors: DataError where the hull has no inside.

    ridge_passes, sigma: of `shave_ridges`, which gives the body where source is hull, and else a start; margin: px around the
    mattes."""
    whole = replace(hull, values=(hull.values > 0.5).float())
    volume = whole.occupied_volume()
    cameras = scene.cameras.select(scene.training_cameras)

    def of_hull() -> Geometry:
        body = shave_ridges(whole, cameras, passes=ridge_passes, sigma=sigma)
        return Geometry(body, volume, torch.empty(0), 1)

    if not holds_matter(refinement.signed_distance(whole)):
        raise DataError(
            f"scene {scene.name}: expected a visual hull with an inside, found {int(whole.values.sum())} voxels of "
            f"{1e3 * hull.pitch:.3g} mm: take more voxels (reconstruction.resolution) or more pixels (scene.scale), "
            "and look at the mattes of frame 0 and at scene.box"
        )
    if settings.source == "hull":
        return of_hull()
    frames = free_frames_at_most(scene, max(1, settings.frames))
    windows = object_windows(scene, scene.training_cameras, frames, margin=margin).to(device)
    seen = [windows.of_frame(t) for t in frames]
    solid = Volume(whole.values.to(device), whole.origin.to(device), whole.pitch)
    bound = refinement.signed_distance(solid)
    start = carve(solid, seen[0])
    # of the whole hull: rounding would widen what was carved by mistake
    rounded = shave_ridges(solid, cameras, passes=ridge_passes, sigma=sigma)
    start = replace(start, values=torch.minimum(start.values, rounded.values))
    distance = refinement.refine(refinement.signed_distance(start), bound, seen[:1], FIRST)
    if not holds_matter(distance):
        return nothing_left(scene, of_hull())
    motions = free_motions(scene, distance, seen)
    moved = [seen[0], *(motion.windows(views) for motion, views in zip(motions, seen[1:]))]
    distance = refinement.refine(distance, bound, moved, THEN)
    if not holds_matter(distance):
        return nothing_left(scene, of_hull())
    information = refinement.surface_information(distance, moved, THEN[-1][1])
    inner = slice(refinement.BORDER, -refinement.BORDER)
    kept = keep_silhouettes(refinement.voxels(distance, solid).values > 0.5, solid, seen[0])
    deviation = OPTIMISM * information[inner, inner, inner].rsqrt()
    body = Volume(kept.float().cpu(), solid.origin.cpu(), solid.pitch)
    return Geometry(body, volume, deviation.cpu(), len(moved))
