"""Made-up pictures: noise at all scales, each seed another place; features of them; libraries of them."""

from __future__ import annotations

import cv2
import numpy as np

from vplog.data import Features, Reference
from vplog.features.sift import SiftSettings
from vplog.places.bobb import BobbSettings

SMALL = BobbSettings(partitions=20, features=250)
"""The paper's method with fewer partitions and features, so that tests are quick."""


def texture(seed: int, width: int = 320, height: int = 200) -> np.ndarray:
    """(height, width) uint8: a sum of noise images from 4 px to the full resolution."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for octave in range(6):
        rough = rng.standard_normal((max(height >> octave, 4), max(width >> octave, 4)))
        total += cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC) * 1.6**octave
    return np.clip(127 + total * 45 / total.std(), 0, 255).astype(np.uint8)


def reference(seed: int) -> Reference:
    image = texture(seed)
    return Reference(image, SiftSettings(max_features=400)(image), f"drive {seed % 3}", 10**18 + seed)


def nothing() -> Features:
    empty = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2), np.float32), empty, np.zeros((0, 128), np.uint8), empty, 320, 200)


def noisy(features: Features, seed: int, noise: float = 4.0) -> Features:
    """The same features with other descriptors: near, but not equal."""
    rng = np.random.default_rng(seed)
    near = np.clip(np.rint(features.descriptors + rng.normal(0, noise, features.descriptors.shape)), 0, 255)
    return Features(
        features.points, features.sizes, near.astype(np.uint8), features.depth_m, features.width, features.height
    )
