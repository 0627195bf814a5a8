"""What both pages of the viewer share: the server, the ground, rigid solids, and the view that holds what is to be seen."""

from __future__ import annotations

import ipaddress
import math
import socket
from itertools import product
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import numpy as np
from scipy.spatial.transform import Rotation

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import Box, Capsule, Cylinder, Shape, Sphere
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.twin.shown_solids import SOLID, surface

PANEL = 0.12  # of the window's height: the first view leaves room for viser's panel
FIELD_OF_VIEW = math.radians(40)  # vertical, of the first view


def open_server(host: str, port: int) -> Any:
    """A viser server. port: the next free one where it is taken. Errors: ConfigError without viser, or for a host that is no
    address of this machine."""
    try:
        import viser
    except ImportError as error:
        way = "pip install -e '.[viewer]' in a clone, pip install viser elsewhere"
        raise ConfigError(f"viewer: expected the package viser, found none: {way}") from error
    try:  # viser's own server would try port after port and then wait for ever
        with socket.create_server((host, 0)):
            pass
        if not host:  # all addresses of the machine, which nobody asked for by name
            raise ValueError("an empty name")
    except (OSError, ValueError, TypeError) as error:
        wanted = "127.0.0.1, 0.0.0.0 or this machine's address"
        raise ConfigError(f"host: expected {wanted}, found {host!r} ({error})") from error
    import websockets.asyncio.server as sockets  # viser brings it

    def serve(
        *arguments: Any, process_request: Any, begin: Any = sockets.serve, **options: Any
    ) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if own_page(request.headers.get("Origin"), request.headers.get("Host"), host):
                return process_request(connection, request)
            said = f"expected a page of this server, by its address or the name {host}\n"
            return connection.respond(403, said)

        return begin(*arguments, process_request=answer, **options)

    with patch.object(sockets, "serve", serve):  # viser has no argument for it
        return viser.ViserServer(host=host, port=port, label="MoSA", verbose=False)


def own_page(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether a request is of a page of the server itself, or of none (no browser). asked: the name by which the server was asked
    for: an address or one of its own names, as a stranger's may be said to be at this address."""
    try:
        name = urlsplit(f"//{asked}").hostname
        known = name in ("localhost", host, socket.gethostname()) or ipaddress.ip_address(name)
    except ValueError:
        return False
    return bool(known) and origin in (None, f"http://{asked}", f"https://{asked}")


def offered(handle: Any) -> Any:
    """What is chosen on the page, within what the page offers: a message may say anything."""
    if hasattr(handle, "options"):
        return handle.value if handle.value in handle.options else handle.options[0]
    return min(max(handle.min, handle.value), handle.max)  # of NaN the least


def horizontal(up: np.ndarray) -> np.ndarray:
    """(3,) unit vector across `up` (3,): to the right in the first view."""
    across = np.eye(3)[np.abs(up).argmin()]
    across = across - (across @ up) * up
    return across / np.linalg.norm(across)


def view_of(
    points: np.ndarray, up: np.ndarray, across: np.ndarray, ground: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """((3,) camera, (3,) point looked at) [m] that hold points (M, 3) and the ground below them, from the front and a little above.
    ground: its height along `up` [m], None where there is none."""
    axes = np.stack([across, up, np.cross(across, up)])  # right, up, to the camera
    seen = points @ axes.T
    low, high = seen.min(0), seen.max(0)
    if ground is not None:
        low[1] = min(low[1], ground)
    corners = 0.5 * (high - low) * np.array(list(product((-1, 1), repeat=3)))
    toward = np.array([0, 0.25, 1]) / math.hypot(0.25, 1)
    # to the right, and up
    rim = np.abs(np.stack([corners[:, 0], corners @ np.cross(toward, [1, 0, 0])])).max(0)
    # all in a square window, and a margin
    distance = (corners @ toward + 1.15 * rim / math.tan(FIELD_OF_VIEW / 2)).max()
    target = 0.5 * (low + high) @ axes
    return target + distance * toward @ axes, target


def aim(eye: np.ndarray, target: np.ndarray, *cameras: Any) -> None:
    """The first view, for what viser calls cameras."""
    for camera in cameras:
        camera.position = eye  # first: it takes a connected client's look_at along
        camera.look_at, camera.fov = target, FIELD_OF_VIEW
        camera.near = 1e-3 * float(np.linalg.norm(eye - target))


def beside_panel(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, ...]:
    """A first view (camera (3,), point looked at (3,)) moved to the right by `PANEL`, so that the panel covers nothing of it in a
    window of 1280 x 800."""
    right = np.cross(target - eye, up)
    wide = 2 * math.tan(FIELD_OF_VIEW / 2) * np.linalg.norm(target - eye)
    move = PANEL * wide * right / np.linalg.norm(right)
    return eye + move, target + move


def cell(size: float) -> float:
    """Width [m] of a ground cell for a body of that size [m]: the power of ten below it."""
    return 10.0 ** math.floor(math.log10(size))


def add_ground(
    scene: Any,
    up: np.ndarray,
    across: np.ndarray,
    height: float,
    size: float,
    target: np.ndarray,
    far: float,
) -> None:
    """A grid at `height` along `up` [m] in cells for a body of `size` [m], about `target` (3,), `far` [m] to each side."""
    axes = np.stack([across, np.cross(up, across), up], axis=1)  # the grid's x, y and normal
    at, width = target + (height - target @ up) * up, cell(size)
    # lines at multiples of the width
    at = axes @ np.array([*(width * np.round(axes.T[:2] @ at / width)), at @ up])
    extent = 2 * width * math.ceil(far / width)
    look = {"plane": "xy", "cell_size": width, "section_size": 10 * width}
    scene.add_grid("/ground", extent, extent, position=at, wxyz=turn(axes), **look)


def turn(rotation: np.ndarray) -> np.ndarray:
    """(4,) quaternion as viser has it, real part first, of a (3, 3) rotation."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def add_points(
    scene: Any, name: str, points: np.ndarray, colors: Any, size: float, **options
) -> Any:
    """A node for points (N, 3) [m] of `size` [m]."""
    look = {"point_size": size, "point_shape": "circle", "precision": "float32"}
    return scene.add_point_cloud(name, points.astype(np.float32), colors, **look, **options)


def splat_parts(unit: float, means, covariances, colors, opacities) -> tuple[np.ndarray, ...]:
    """What viser takes of splats, in units of `unit` [m]: it keeps covariances as float16, whose steps are 6e-8 below 6e-5, and in
    m^2 a splat of 0.5 mm would lose its shape."""
    return (means / unit).astype(np.float32), covariances / unit**2, colors, opacities[:, None]


def add_solid(scene: Any, name: str, shape: Shape, **options) -> Any | None:
    """A node for a collider's shape, of a mesh as points; None for half spaces, which are not drawn."""
    import trimesh  # viser brings it

    if isinstance(shape, Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.radius)
    elif isinstance(shape, Box):
        mesh = trimesh.creation.box(extents=shape.size)
    elif isinstance(shape, Cylinder):
        mesh = trimesh.creation.cylinder(radius=shape.radius, height=shape.length)
    elif isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(radius=shape.radius, height=shape.length)
        mesh.apply_translation(-mesh.bounds.mean(0))
    elif isinstance(shape, SignedDistanceField):
        points = surface(shape, shape.spacing).numpy()
        return scene.add_point_cloud(name, points, SOLID, point_size=shape.spacing, **options)
    else:
        return None
    return scene.add_mesh_simple(name, np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32), color=SOLID,
                                 flat_shading=isinstance(shape, Box), **options)  # fmt: skip
