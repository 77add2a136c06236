"""Masks: the parts of a camera's images that are the vehicle's own, or that move, give no features and no edges.

A masked part is filled before anything is detected, so that it takes no share of the features of an image, and
thumbnails and networks find nothing there (features whose centre is masked are left out, as in COLMAP).
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from vplog.data import Bools, Bytes, Float32s, Frame, Ints

_FADE = 1 / 16
"""Share of an image's longer side over which the fill goes over from its border to the mean: an edge would be a
feature."""


def masked(frame: Frame) -> Frame:
    """The frame with the masked part of its image, grey and colour, filled."""
    if frame.mask is None:
        return frame
    colour = None if frame.colour is None else filled(frame.colour, frame.mask)
    return replace(frame, image=filled(frame.image, frame.mask), colour=colour)


def filled(image: Bytes, used: Bools) -> Bytes:
    """The image (H, W) or (H, W, 3) uint8 with the px that are not `used` (H, W) filled: with the nearest px that is at
    the border, with the mean of those that are further inside."""
    if used.all() or not used.any():
        return image
    at, nearest, near = _border(used.tobytes(), used.shape)
    pixels = image.reshape(used.size, -1)
    mean = np.array(cv2.mean(image, used.astype(np.uint8))[: pixels.shape[1]], np.float32)
    result = pixels.copy()
    result[at] = np.rint(mean + near * (pixels[nearest] - mean))
    return result.reshape(image.shape)


@lru_cache(maxsize=4)  # of a camera with one mask, all images
def _border(used: bytes, shape: tuple[int, int]) -> tuple[Ints, Ints, Float32s]:
    """Numbers (K,) of the masked px and of the used px nearest to each, and (K, 1) the share of that in its fill."""
    masked = np.frombuffer(used, np.uint8).reshape(shape) ^ 1
    distance, label = cv2.distanceTransformWithLabels(
        masked, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    at, inside, label = np.flatnonzero(masked), np.flatnonzero(masked == 0), np.asarray(label, np.int64).ravel()
    nearest = np.zeros(label.max() + 1, np.int64)
    nearest[label[inside]] = inside
    near = np.maximum(1 - distance.ravel()[at] / np.float32(_FADE * max(shape)), 0)[:, None]
    return at, nearest[label[at]], near
