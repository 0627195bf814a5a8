"""Mattes of raw images from the empty background plate of the same camera, robust against the object's own shadow.

A shadow scales the plate's colour, an object replaces it: per pixel, the factor k that brings the plate p closest to the
image c, and what is left, r = |c - k p|. The object is where r is large, or k no shadow's (Horprasert et al. 1999). An
object whose colour is proportional to the plate's, between shadow and highlight, cannot be told from it.
"""

from __future__ import annotations

import cv2
import numpy as np

RESIDUAL = 0.08
"""Colour left over, in [0, sqrt 3], above which a pixel belongs to the object: 1.3 times the largest elsewhere in the plates and
shadows of the PAC-NeRF bird (0.060 to 0.074), 0.6 times the 0.1 % quantile inside of it."""
DARKEST, BRIGHTEST = 0.5, 1.25  # factors on the plate's colour: shadow, highlight
SPECK = 0.01  # pieces smaller than this share of the largest are dropped


def matte_from_plate(image: np.ndarray, plate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Straight colour (H, W, 3) and matte (H, W) in [0, 1], of an image and its empty plate, both (H, W, 3) in [0, 1].

    On the rim, two pixels wide, the image is a mixture a o + (1 - a) p, whose residual is a times the object's nearby:
    coverage and the object's own colour follow from it. All zero where nothing differs from the plate.
    """
    factor = (image * plate).sum(-1) / np.maximum((plate * plate).sum(-1), 1e-3)
    residual = np.linalg.norm(image - factor[..., None] * plate, axis=-1)
    mask = ((residual > RESIDUAL) | (factor < DARKEST) | (factor > BRIGHTEST)).astype(np.uint8)
    mask = cv2.medianBlur(mask, 5)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count == 1:
        return np.ones_like(image), np.zeros(mask.shape, np.float32)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    mask = (area >= SPECK * area.max())[labels].astype(np.uint8)
    kernel = np.ones((5, 5), np.uint8)
    core, reach = cv2.erode(mask, kernel), cv2.dilate(mask, kernel)
    inside = cv2.dilate(np.where(mask > 0, residual, 0).astype(np.float32), kernel)
    share = np.clip(residual / np.maximum(inside, 1e-6), 0, 1)
    # only a residual well above the noise can be divided; where the brightness gave the object away, the mask is all there is
    share = np.where(inside > 2 * RESIDUAL, share, mask)
    share = np.where(share * inside > 0.5 * RESIDUAL, share, 0.0)
    matte = np.where(core > 0, 1.0, np.where(reach > 0, share, 0.0)).astype(np.float32)
    own = (image - (1 - matte[..., None]) * plate) / np.maximum(matte[..., None], 1e-3)
    return np.where(matte[..., None] > 0, np.clip(own, 0, 1), 1.0).astype(np.float32), matte
