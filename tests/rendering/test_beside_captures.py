"""Pictures and distances that one thread makes while another captures: Warp would record them, or refuse."""

import threading

import numpy as np
import pytest
import torch
import warp as wp
from drawn_splats import draw, gradients, render

from mosa.data.synthetic.renderer import render_surface
from mosa.data.synthetic.surface import Surface
from mosa.physics.contact.mesh import _signed_distance
from mosa.physics.engine.capture import WarpCapture
from mosa.rendering.rasterizer import rasterize

CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 4
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)


@wp.kernel
def twice(x: wp.array(dtype=float)):
    x[wp.tid()] *= 2.0


def splatted():
    scene = draw(20)
    return [*render(scene, rasterize, scan="tile"), *gradients(scene, rasterize, scan="tile")]


def ray_cast():
    cameras = draw(1).cameras
    surface = Surface(CORNERS, FACES, np.full((4, 3), 0.5))
    return [torch.from_numpy(render_surface(surface, CORNERS, cameras))]


def distances():
    return [torch.from_numpy(_signed_distance(CORNERS, FACES, CORNERS * 1.5))]


@pytest.mark.parametrize("work", [splatted, ray_cast, distances])
def test_another_threads_capture_neither_breaks_nor_records_it(work):
    alone = work()
    begun, found, waited = threading.Event(), [], []
    x = wp.ones(3, dtype=float, device="cpu")

    def beside():
        begun.set()
        found.extend(work())

    thread = threading.Thread(target=beside, daemon=True)

    def body():
        thread.start()
        assert begun.wait(30)
        thread.join(0.3)  # long enough for it to end, if it did not wait
        waited.append(thread.is_alive())
        wp.launch(twice, 3, inputs=[x], device="cpu")

    replay = WarpCapture(torch.device("cpu"), wp.get_device("cpu")).capture(body)
    thread.join(30)
    assert waited == [True] and not thread.is_alive()
    x.fill_(1.0)
    replay()
    np.testing.assert_array_equal(x.numpy(), 2)
    assert len(found) == len(alone)
    for own, wanted in zip(found, alone):
        torch.testing.assert_close(own, wanted, rtol=0, atol=0)
