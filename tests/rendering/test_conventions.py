"""Each convention of the rasteriser on one or two Gaussians whose image is known by hand."""

import math

import pytest
import torch

from mosa.rendering.rasterizer import rasterize
from mosa.types import Cameras

SIZE, FOCAL = 48, 50.0


def shoot(
    pixels,
    sigmas,
    opacities,
    depths=None,
    *,
    channels=None,
    background=None,
    scan="gaussian",
):
    """Image and alpha of discs parallel to the image, of `sigmas` [px, before the low-pass] at `pixels`."""
    depths = torch.tensor(depths or [1.0] * len(pixels), dtype=torch.float64)
    u = torch.tensor(pixels, dtype=torch.float64)
    means = torch.cat(((u - SIZE / 2) / FOCAL * depths[:, None], depths[:, None]), 1)[None]
    sigma = torch.tensor(sigmas, dtype=torch.float64) / FOCAL * depths
    # flattened along the line of sight: then J's third column adds nothing away from the axis
    shape = torch.diag(torch.tensor([1.0, 1.0, 0.0])).double()
    covariances = (sigma[:, None, None] ** 2 * shape)[None]
    features = torch.eye(len(pixels)).tolist() if channels is None else channels
    features = torch.tensor(features, dtype=torch.float64)[None]
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], dtype=torch.float64)[
        None
    ]
    camera = Cameras(K, torch.eye(4)[None], SIZE, SIZE, ("front",))
    image, alpha = rasterize(
        means,
        covariances,
        torch.tensor(opacities, dtype=torch.float64),
        features,
        camera,
        torch.tensor([0]),
        background,
        scan=scan,
    )
    return image[0], alpha[0]


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
def test_pixel_centres_and_low_pass(scan):
    """A point on the axis at pixel coordinate 24.0: the four pixels around lie half a pixel off, variance is 0.3
    px^2."""
    _, alpha = shoot([(24.0, 24.0)], [0.0], [0.8], scan=scan)
    for y, x in ((23, 23), (23, 24), (24, 23), (24, 24)):
        assert float(alpha[y, x]) == pytest.approx(0.8 * math.exp(-0.5 * 0.5 / 0.3), rel=1e-12)
    assert float(alpha[24, 25]) == pytest.approx(
        0.8 * math.exp(-0.5 * (1.5**2 + 0.5**2) / 0.3), rel=1e-12
    )


def test_alpha_cap():
    _, alpha = shoot([(24.5, 24.5)], [3.0], [1.0])
    assert float(alpha[24, 24]) == pytest.approx(0.999, rel=1e-12)


def test_near_plane():
    near = 0.01
    for depth, seen in ((0.99 * near, False), (1.01 * near, True)):
        _, alpha = shoot([(24.5, 24.5)], [3.0], [0.5], [depth])
        assert bool(alpha.max() > 0) is seen


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
def test_faint_contributions_are_skipped(scan):
    """Opacity 0.1 with variance 4 + 0.3: alpha falls below 1/255 at distance sqrt(2 ln 25.5 * 4.3) = 5.28 px along
    a row."""
    _, alpha = shoot([(24.5, 24.5)], [2.0], [0.1], scan=scan)
    assert float(alpha[24, 29]) == pytest.approx(0.1 * math.exp(-0.5 * 25 / 4.3), rel=1e-12)
    assert float(alpha[24, 30]) == 0
    assert float(shoot([(24.5, 24.5)], [2.0], [0.99 / 255], scan=scan)[1].max()) == 0


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
def test_front_to_back_by_depth(scan):
    image, alpha = shoot([(24.5, 24.5)] * 3, [2.0] * 3, [0.5, 0.6, 0.7], [3.0, 1.0, 2.0], scan=scan)
    assert image[24, 24].tolist() == pytest.approx([0.4 * 0.3 * 0.5, 0.6, 0.4 * 0.7], rel=1e-12)
    assert float(alpha[24, 24]) == pytest.approx(1 - 0.4 * 0.3 * 0.5, rel=1e-12)


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
def test_stop_before_the_gaussian_that_exhausts_the_light(scan):
    """0.9 four times leaves 1e-4: the fourth is not added, nor is the faint fifth behind it."""
    image, alpha = shoot(
        [(24.5, 24.5)] * 5,
        [2.0] * 5,
        [0.9, 0.9, 0.9, 0.905, 0.2],
        [1.0, 2.0, 3.0, 4.0, 5.0],
        scan=scan,
    )
    assert image[24, 24].tolist() == pytest.approx([0.9, 0.09, 0.009, 0.0, 0.0], rel=1e-9)
    assert float(alpha[24, 24]) == pytest.approx(0.999, rel=1e-12)


def test_background_fills_what_is_left():
    background = torch.tensor([0.2, 0.4, 1.0], dtype=torch.float64)
    image, _ = shoot(
        [(24.5, 24.5)], [2.0], [0.25], channels=[[1.0, 0.0, 0.0]], background=background
    )
    assert image[24, 24].tolist() == pytest.approx([0.25 + 0.75 * 0.2, 0.75 * 0.4, 0.75], rel=1e-12)
    assert torch.equal(image[0, 0], background)


@pytest.mark.parametrize("channels", [1, 9])
def test_any_number_of_channels(channels):
    image, alpha = shoot(
        [(24.5, 24.5)], [2.0], [0.25], channels=[[1.0 + c for c in range(channels)]]
    )
    assert image.shape == (SIZE, SIZE, channels)
    torch.testing.assert_close(image, alpha[..., None] * (1.0 + torch.arange(channels)))
