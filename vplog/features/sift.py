"""SIFT (Lowe 2004) by OpenCV, as rows of bytes: 128 integers of 0..255 a feature.

OpenCV always doubles the image first, which costs four times the pixels for features below 3 px. Where the larger ones
are enough, the image is halved before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vplog.data import THUMBNAIL_SIDE, Bytes, Features, Float32s
from vplog.settings import Settings

_TAILS = (1, 99)
"""Percentiles of an image that become black and white."""
_MOST_GAIN = 16
"""By which contrast is stretched at most: four of eight bits are left, and below that are the sensor's noise."""
_NOISY_LEVELS, _NOISE_PX = 64, 1.0
"""An image with fewer grey levels is smoothed before, by a Gaussian of so many px: steps of grey and the sensor's noise
would be features. Of a drive at 6 % of its light that recognises 23 of 24 revisits, and 14 without."""
_LEAST_LEVELS = 3
"""Smoothed, what has fewer is noise, as of a covered lens."""
_CLIP, _TILES = 4.0, (8, 8)
"""Clip limit and tile grid of CLAHE (Zuiderveld 1994): the contrast of a tile grows by four at most."""
_CELLS, _BINS = 4, 8
"""Cells on a side of a SIFT descriptor, and directions of the gradient in each (Lowe 2004, section 6.1)."""
_OPPOSITE = -np.arange(_BINS) % _BINS
"""In a mirror a gradient turns the other way round from the keypoint's own direction."""


class SiftSettings(Settings):
    """SIFT of one image, strongest features first."""

    kind: Literal["sift"] = "sift"
    """Name of the extractor."""
    max_features: int = Field(default=2000, ge=1)
    """Features kept of an image, by response: enough that 400 of them are large enough to describe a place, while
    verification takes the 1000 strongest."""
    contrast_threshold: float = Field(default=0.02, ge=0)
    """Weakest extremum kept, half of Lowe's: `max_features` bounds a picture rich in contrast, and at night or in fog
    the weak ones are all there is."""
    min_features: int = Field(default=300, ge=0)
    """An image with fewer is searched again doubled, then with its contrast stretched, then enlarged where it is small,
    then with its contrast equalised tile by tile, until it has as many; 0 takes every image as it is. Pictures by day
    have 400 and more."""
    max_megapixels: float = Field(default=0.52, ge=0.001)
    """Larger images are reduced to this, half of full HD (960 x 540) as it is; points stay in px of the full image."""
    doubled: bool = False
    """Every image is doubled first, so that the smallest features are of 1.5 px instead of 3, at three times the cost.
    Images that have `min_features` without are recognised and placed as well by those (docs/how-it-works.md)."""

    def __call__(self, image: Bytes, depth_m: Float32s | None = None) -> Features:
        """Features of a grey (H, W) uint8 image; `depth_m` (H, W) float32 m registered to it is read at the points."""
        height, width = image.shape
        pixels = self._reduced(image, self.doubled)
        keypoints, descriptors = self._detect(pixels)
        remedies = self._remedies(image)
        while len(keypoints) < self.least_features and (better := next(remedies, None)) is not None:
            if len((found := self._detect(better))[0]) > len(keypoints):
                pixels, (keypoints, descriptors) = better, found
        x, y, sizes, angles, response = keypoints.T
        # OpenCV keeps every feature that ties with the last; a full order makes the cut the same everywhere
        order = np.lexsort((angles, sizes, x, y, -response))[: self.max_features]
        scale = np.array([width / pixels.shape[1], height / pixels.shape[0]], np.float32)
        points = (keypoints[order, :2] + 0.5) * scale - 0.5  # pixel centres, not corners, are the origin
        return Features(
            points=points.astype(np.float32),
            sizes=sizes[order] * np.sqrt(scale[0] * scale[1]),
            descriptors=descriptors[order],
            depth_m=depth_at(points, depth_m),
            width=width,
            height=height,
            thumbnail=thumbnail_of_image(image),
        )

    @property
    def least_features(self) -> int:
        """`min_features`, and no more than are wanted."""
        return min(self.min_features, self.max_features)

    def _reduced(self, image: Bytes, doubled: bool) -> Bytes:
        """The image at the size that OpenCV gets, which doubles it."""
        height, width = image.shape
        share = min(math.sqrt(self.max_megapixels * 1e6 / image.size), 1.0) * (1.0 if doubled else 0.5)
        if share == 1.0:
            return image
        smaller = (max(round(width * share), 1), max(round(height * share), 1))
        return np.asarray(cv2.resize(image, smaller, interpolation=cv2.INTER_AREA), np.uint8)

    def _remedies(self, image: Bytes) -> Iterator[Bytes]:
        """The picture doubled, then with its contrast stretched, then enlarged, then equalised by tiles, in turn."""
        pixels = self._reduced(image, doubled=True)
        if not self.doubled:
            yield pixels
        values, (dark, bright) = pixels, np.percentile(pixels, _TAILS)
        if bright - dark < _NOISY_LEVELS:
            values = np.asarray(cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _NOISE_PX))
            dark, bright = np.percentile(values, _TAILS)
        if bright - dark < _LEAST_LEVELS:
            return
        gain = min(255 / (bright - dark), _MOST_GAIN)
        pixels = np.clip(np.rint((values - dark) * gain), 0, 255).astype(np.uint8)  # SIFT's contrast floor is absolute
        yield pixels
        if 4 * pixels.size <= self.max_megapixels * 1e6:
            twice = (2 * pixels.shape[1], 2 * pixels.shape[0])
            pixels = np.asarray(cv2.resize(pixels, twice, interpolation=cv2.INTER_CUBIC), np.uint8)
            yield pixels
        yield np.asarray(cv2.createCLAHE(_CLIP, _TILES).apply(pixels), np.uint8)

    def _detect(self, pixels: Bytes) -> tuple[Float32s, Bytes]:
        """Keypoints (M, 5) x y size px, direction and contrast, and descriptors (M, 128), strongest first."""
        detector = cv2.SIFT.create(
            nfeatures=self.max_features,
            contrastThreshold=self.contrast_threshold,
            enable_precise_upscale=True,  # without it OpenCV's points lie a quarter of a pixel right of and below
        )
        keypoints, found = detector.detectAndCompute(pixels, None)
        if not keypoints:
            found = np.zeros((0, 128), np.float32)
        rows = np.array([(*one.pt, one.size, one.angle, one.response) for one in keypoints], np.float32)
        return rows.reshape(-1, 5), found.astype(np.uint8)  # whole numbers already


def thumbnail_of_image(image: Bytes) -> Bytes:
    """(THUMBNAIL_SIDE, THUMBNAIL_SIDE) of a grey image, by area averages."""
    side = THUMBNAIL_SIDE
    return np.asarray(cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA), np.uint8)


def depth_at(points: NDArray[np.float32], depth_m: Float32s | None) -> Float32s:
    """(M,) depth of the pixel each point falls in, NaN where there is none, or no point."""
    if depth_m is None:
        return np.full(len(points), np.nan, np.float32)
    column, row = np.rint(np.nan_to_num(points[:, :2])).astype(np.int64).T
    found = depth_m[np.clip(row, 0, depth_m.shape[0] - 1), np.clip(column, 0, depth_m.shape[1] - 1)]
    return np.where(np.isfinite(points[:, 0]), found, np.float32(np.nan))


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
