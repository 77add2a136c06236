"""Patch-normalised thumbnails, compared by absolute differences: SeqSLAM's images.

Milford & Wyeth, SeqSLAM: Visual route-based navigation for sunny summer days and stormy winter nights, ICRA 2012.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numba
import numpy as np
import pyarrow as pa

from vplog.data import THUMBNAIL_SIDE, Bytes, Features, Reference
from vplog.execution.execution import Execution
from vplog.places.dense import VectorState, thumbnail_of
from vplog.places.library_files import RelearnedSettings, keep_references

_WIDTH, _HEIGHT, _PATCH = 64, 32, 8
"""px, the paper's table I."""
_STEPS = 32
"""Steps of a byte per standard deviation, so that it holds four to either side."""
_LEAST_DEVIATION = 1.0
"""Grey levels; a patch that varies less is the camera's noise, which must not be blown up to the size of a texture."""


@numba.njit(cache=True, nogil=True)
def _likeness(images, query):
    """(N,) float32: 1 less the mean absolute difference (N, P) to (P,), as a share of a byte's range."""
    result = np.zeros(images.shape[0], np.float32)
    for row in range(images.shape[0]):
        total = np.int32(0)
        for p in range(images.shape[1]):
            total += abs(np.int32(images[row, p]) - np.int32(query[p]))
        result[row] = 1 - total / (255 * images.shape[1])
    return result


class ThumbnailSettings(RelearnedSettings):
    """SeqSLAM's image comparison. It learns nothing: the references only go into the library."""

    kind: Literal["thumbnail"] = "thumbnail"
    """Name of the recogniser."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> ThumbnailState:
        """Nothing to learn. Raises LibraryError where there is no reference."""
        return ThumbnailState(self, keep_references(references))


class ThumbnailState(VectorState):
    """Nothing but what to save. Shared freely between threads."""

    arrow_type = pa.list_(pa.uint8(), _WIDTH * _HEIGHT)
    similarity = staticmethod(_likeness)
    compared = np.uint8

    def describe(self, features: Features) -> Bytes:
        """(2048,) uint8 row by row: deviations from the patch's mean in units of its own. Needs the thumbnail."""
        image = thumbnail_of(features)
        small = image.reshape(_HEIGHT, THUMBNAIL_SIDE // _HEIGHT, _WIDTH, THUMBNAIL_SIDE // _WIDTH).mean(axis=(1, 3))
        patches = small.reshape(_HEIGHT // _PATCH, _PATCH, _WIDTH // _PATCH, _PATCH)
        mean, deviation = patches.mean(axis=(1, 3), keepdims=True), patches.std(axis=(1, 3), keepdims=True)
        normal = (patches - mean) / np.maximum(deviation, _LEAST_DEVIATION)
        return np.clip(np.rint(128 + _STEPS * normal), 0, 255).astype(np.uint8).reshape(-1)
