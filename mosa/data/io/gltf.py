"""Gaussians as binary glTF with KHR_gaussian_splatting, which engines and web viewers read.

Source: the extension's text (KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting,
2026). Kernel `ellipse`; SCALE are standard deviations [m], not their logarithms, ROTATION unit
quaternions xyzw, OPACITY in [0, 1], SH_DEGREE_l_COEF_n harmonics with Condon-Shortley phase, m = -l
... l. All are float32: smaller integers are allowed, but not for harmonics. The colours are display
values (`srgb_rec709_display`); COLOR_0, linear by glTF, is for readers that show points. The text
defines no animation of splats: a motion is a file for each frame."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import torch

from mosa.rendering.appearance.spherical_harmonics import degree_of
from mosa.system.whole_files import written_whole
from mosa.types import Appearance

EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS = 5126, 0
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def save_glb(path: str | Path, shown: Appearance) -> Path:
    """Write Gaussians whose vertical is y, glTF's; folders are made."""
    path, splats, harmonics = Path(path), shown.splats, shown.harmonics
    shown_as = splats.colors.clamp(0, 1)
    # IEC 61966-2-1
    linear = torch.where(shown_as <= 0.04045, shown_as / 12.92, ((shown_as + 0.055) / 1.055) ** 2.4)
    opacities = splats.opacities.clamp(0, 1)[:, None]
    values = {
        "POSITION": splats.means,
        "COLOR_0": torch.cat([linear, opacities], 1),
        f"{EXTENSION}:ROTATION": splats.rotations[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": opacities,
    } | {
        f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}": harmonics[:, l * l + n]
        for l in range(degree_of(harmonics) + 1)
        for n in range(2 * l + 1)
    }
    arrays = [value.detach().cpu().numpy().astype("<f4") for value in values.values()]
    starts = np.cumsum([0, *(a.nbytes for a in arrays)]).tolist()
    accessors = [
        {"bufferView": k, "componentType": FLOAT, "count": len(a), "type": KINDS[a.shape[1]]}
        for k, a in enumerate(arrays)
    ]
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": {name: k for k, name in enumerate(values)}, "mode": POINTS,
                 "extensions": {EXTENSION: kernel}}  # fmt: skip
    document = {
        "asset": {"version": "2.0", "generator": "mosa"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "body"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": a.nbytes}
            for start, a in zip(starts, arrays)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial, open(partial, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + starts[-1]))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", starts[-1], b"BIN\0"))
        file.writelines(a.tobytes() for a in arrays)
    return path
