"""Made-up pictures: noise at all scales, neighbouring views overlap; features of them; libraries of them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from vplog.data import Features, Reference
from vplog.features.sift import SiftSettings
from vplog.places.bobb_paper import PaperBobbSettings

SMALL = PaperBobbSettings(partitions=20, features=250)
"""The paper's method with fewer partitions and features, so that tests are quick."""


@lru_cache
def _panorama(seed: int) -> np.ndarray:
    """A sum of noise images from 32 px to 1 px, wide enough for 20 views."""
    rng = np.random.default_rng(seed)
    width, height = 20 * 80 + 320, 200
    total = np.zeros((height, width))
    for octave in range(6):
        rough = rng.standard_normal((height >> octave, width >> octave))
        total += cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC) * 1.6**octave
    return np.clip(127 + total * 45 / total.std(), 0, 255).astype(np.uint8)


def texture(seed: int) -> np.ndarray:
    """(200, 320) uint8: views 0, 1, .. 19 move to the right by a quarter of their width, 20 begins another place."""
    left = seed % 20 * 80
    return _panorama(seed // 20)[:, left : left + 320].copy()


@lru_cache
def reference(seed: int) -> Reference:
    image = texture(seed)
    return Reference(image, SiftSettings(max_features=400)(image), f"drive {seed % 3}", 10**18 + seed)


def nothing() -> Features:
    empty = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2), np.float32), empty, np.zeros((0, 128), np.uint8), empty, 320, 200)


def noisy(features: Features, seed: int, noise: float = 4.0) -> Features:
    """The same features with other descriptors and another thumbnail: near, but not equal."""
    rng = np.random.default_rng(seed)

    def near(values: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(values + rng.normal(0, noise, values.shape)), 0, 255).astype(np.uint8)

    thumbnail = None if features.thumbnail is None else near(features.thumbnail)
    return replace(features, descriptors=near(features.descriptors), thumbnail=thumbnail)
