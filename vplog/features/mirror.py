"""The features of an image as in a mirror: what no camera saw, with the texture, depth and spread of what one did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vplog.data import Features

_CELLS, _BINS = 4, 8
"""Cells on a side of a SIFT descriptor, and directions of the gradient in each (Lowe 2004, section 6.1)."""
_OPPOSITE = -np.arange(_BINS) % _BINS
"""In a mirror a gradient turns the other way round from the keypoint's own direction."""


def mirrored(features: Features) -> Features:
    """SIFT features of the image with left and right exchanged, without its pixels; the thumbnail is left out.

    A keypoint's direction is mirrored with it, so its patch is, across that direction: rows of cells change places.
    """
    cells = features.descriptors.reshape(-1, _CELLS, _CELLS, _BINS)
    return replace(
        features,
        points=features.points * np.array([-1, 1], np.float32) + np.array([features.width - 1, 0], np.float32),
        descriptors=np.ascontiguousarray(cells[:, ::-1, :, _OPPOSITE]).reshape(features.descriptors.shape),
        thumbnail=None,
    )
