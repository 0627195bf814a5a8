"""Gaussians in the PLY layout of 3D Gaussian Splatting (Kerbl et al. 2023), which its trainers write and its viewers open.

Per vertex, float32: x y z, nx ny nz (unused), f_dc_0..2 and f_rest_* (spherical harmonics: the rest channel by channel),
opacity (logit), scale_0..2 (log of the standard deviations), rot_0..3 (quaternion wxyz)."""

from __future__ import annotations

import io
import math
import warnings
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import DataError
from mosa.rendering.appearance.spherical_harmonics import (
    DEGREES,
    constant_coefficients,
    degree_of,
    mean_colors,
)
from mosa.system.ply import check_ply
from mosa.system.whole_files import written_whole
from mosa.types import Splats

AXES = ("x", "y", "z")
SCALES = tuple(f"scale_{i}" for i in range(3))
ROTATIONS = tuple(f"rot_{i}" for i in range(4))
CONSTANT = tuple(f"f_dc_{i}" for i in range(3))
SPREAD = 0.3
"""Of plain opacities, at least: logits that lie within 0 to 1 are of opacities from 0.5 to 0.73."""
OPAQUE = 30.0
"""Of a logit: 1 - 1e-13. Of a trained object some are below 0."""
FAR = 100.0
"""Extents from the origin, from which on an object is read about its own middle: float32 would round its shape."""
OPACITY_MARGIN = 1e-6
"""Opacities are kept this far from 0 and 1, where the logit has no number."""
BRIGHT = 6.0  # of a constant harmonic: a colour from 0 to 1 is one from -1.8 to 1.8
SMALLEST = 1e-9
"""Standard deviations [m] below are written as this: the logarithm of 0 has no number either."""


def save_ply(path: str | Path, splats: Splats, coefficients: Tensor | None = None) -> Path:
    """Write Gaussians as a binary 3DGS PLY; folders are made.

    coefficients: spherical harmonics (N, K, 3), K = 1, 4, 9 or 16; None: the constant colours of `splats`.
    Errors: DataError where a field holds a number that is not finite; ConfigError for another K."""
    path = Path(path)
    if coefficients is None:
        coefficients = constant_coefficients(splats.colors)
    degree_of(coefficients)
    rest = coefficients[:, 1:].transpose(1, 2).flatten(1)
    opacities = splats.opacities.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = {
        AXES: splats.means,
        ("nx", "ny", "nz"): torch.zeros_like(splats.means),
        CONSTANT: coefficients[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): torch.logit(opacities)[:, None],
        SCALES: splats.scales.clamp(min=SMALLEST).log(),
        ROTATIONS: splats.rotations,
    }
    names = [name for fields in columns for name in fields]
    vertices = np.empty(len(splats.means), dtype=[(name, "<f4") for name in names])
    for fields, values in columns.items():
        for name, column in zip(fields, values.detach().cpu().numpy().T):
            vertices[name] = _finite(column, name, path, "to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial, open(partial, "wb") as file:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(file)
    return path


def load_ply(path: str | Path) -> tuple[Splats, Tensor]:
    """`read_ply` without the rest."""
    return read_ply(path)[:2]


def read_ply(path: str | Path, centred: bool = False) -> tuple[Splats, Tensor, Tensor, str]:
    """Gaussians of a 3DGS PLY, their spherical harmonics (N, K, 3), K = 1, 4, 9 or 16, what was taken from their means (3,), and
    the axis that the header calls vertical; float32, the offset float64.

    Scales that are no logarithms and opacities that are no logits are known by their numbers, with a warning; the 3D filter of
    Mip-Splatting (Yu et al. 2024) is applied. centred: means far from the origin are taken about their median.
    `Splats.colors` are the colours averaged over directions, rotations have unit length.
    Errors: DataError naming the file and the field: missing, of another number of harmonics, not finite.
    """
    path = Path(path)
    vertices, comments = vertices_of(path)
    rest = [name for name in vertices if name.startswith("f_rest_")]
    per_channel, left = divmod(len(rest), 3)
    if left or per_channel + 1 not in DEGREES:
        raise DataError(
            f"{path}: expected 0, 9, 24 or 45 fields f_rest_* (spherical harmonics of degree 0 to 3), found {len(rest)}"
        )

    def read(fields: tuple[str, ...]) -> Tensor:
        for name in fields:
            if name not in vertices:
                raise DataError(
                    f"{path}: no field {name}, which 3D Gaussians have; found {', '.join(list(vertices)[:8])} ...: "
                    f"{'a point cloud or mesh' if 'scale_0' not in vertices else 'another layout'} cannot be used; "
                    "train 3DGS on its images and give the PLY that it writes"
                )
        columns = np.empty((len(vertices["x"]), len(fields)), np.float32)
        for column, name in zip(columns.T, fields):
            column[:] = _finite(np.asarray(vertices[name], np.float32), name, path, "found")
        return torch.from_numpy(columns)

    read(AXES)  # all there, and finite
    axes = [np.asarray(vertices[name], np.float64) for name in AXES]
    places = torch.from_numpy(np.stack(axes, -1))
    if len(places) == 0:
        raise DataError(f"{path}: expected Gaussians, found none")
    middle, (low, high) = places.median(0).values, np.quantile(places.numpy(), [0.05, 0.95], axis=0)
    extent = float((high - low).max())
    offset = middle if centred and float(middle.abs().max()) > FAR * extent else 0 * middle
    means = (places - offset).float()
    logs, opacity, rotations = read(SCALES), read(("opacity",))[:, 0], read(ROTATIONS)
    odd, scales = [], logs.exp()
    if float(logs.min()) > 0:  # then they are what is nearer to the Gaussians' distances
        apart = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1])) or extent or 1.0
        if abs(math.log(logs.median() / apart)) < abs(logs.median() - math.log(apart)):
            odd, scales = ["scales as lengths, not their logarithms"], logs
    opacities, least, most = torch.sigmoid(opacity), float(opacity.min()), float(opacity.max())
    if least >= 0 and most <= 1 and (float(opacity.max() - opacity.min()) > SPREAD or most == 1):
        odd, opacities = [*odd, "opacities as they are, not their logits"], opacity
    if odd:
        warnings.warn(f"{path}: read with {' and '.join(odd)}, as its numbers are", stacklevel=3)
    if least >= 0 and float(opacity.median()) > OPAQUE:
        raise DataError(
            f"{path}: field opacity: expected logits, found {least:.3g} to {most:.3g}: per cent or bytes?"
        )
    if "filter_3D" in vertices:
        wide = (scales.square() + read(("filter_3D",)).square()).sqrt()
        opacities, scales = opacities * (scales / wide).prod(1), wide
    if not bool(torch.isfinite(scales).all()):
        wanted = "logarithms of standard deviations"
        raise DataError(f"{path}: field scale_*: expected {wanted}, found some too large for exp")
    length = rotations.norm(dim=1, keepdim=True)
    if float(length.min()) == 0:
        found = f"zero at vertex {int(length.argmin())}"
        raise DataError(f"{path}: field rot_*: expected quaternions, found {found}")
    higher = read(tuple(f"f_rest_{i}" for i in range(len(rest))))
    higher = higher.view(len(means), 3, per_channel).transpose(1, 2)
    coefficients = torch.cat((read(CONSTANT)[:, None], higher), 1)
    if (usual := float(coefficients[:, 0].abs().median())) > BRIGHT:
        raise DataError(
            f"{path}: field f_dc_*: expected harmonics, of which most are within 2, found half of them beyond {usual:.3g}: "
            "colours as bytes?"
        )
    colors = mean_colors(coefficients)
    said = " ".join(comments).lower().partition("vertical axis:")[2].split()[:1]
    splats = Splats(means, scales, rotations / length, opacities, colors)
    return splats, coefficients, offset, "".join(said)


def vertices_of(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns of the vertices by field, and the comments of the header. Errors: DataError naming the file."""
    if not path.is_file():
        raise DataError(f"{path}: file not found; expected a PLY file of 3D Gaussians")
    check_ply(path)
    try:
        head, end, body = path.read_bytes().partition(b"end_header")
        plain = head.decode("ascii", "replace").replace("\ufffd", "?").encode()  # of comments
        document = PlyData.read(io.BytesIO(plain + end + body))
        vertices = {p.name: document["vertex"][p.name] for p in document["vertex"].properties}
    except (PlyParseError, KeyError, ValueError, OSError, UnicodeDecodeError) as error:
        found = f"a damaged or other one ({error})"
        raise DataError(
            f"{path}: expected a PLY file with an element vertex, found {found}"
        ) from error
    if any(name.startswith("scalar_") for name in vertices):  # as CloudCompare writes them
        vertices = {name.removeprefix("scalar_"): column for name, column in vertices.items()}
    if "packed_position" in vertices:
        raise DataError(
            f"{path}: expected a 3DGS PLY, found a compressed one; export it uncompressed"
        )
    return vertices, document.comments


def _finite(column: np.ndarray, name: str, path: Path, verb: str) -> np.ndarray:
    bad = np.flatnonzero(~np.isfinite(column))
    if len(bad):
        raise DataError(
            f"{path}: field {name}: expected finite numbers, {verb} NaN or infinity in {len(bad)} of {len(column)}, "
            f"first at vertex {bad[0]}"
        )
    return column
