"""Made-up pictures: noise at all scales, neighbouring views overlap; features of them; libraries of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vplog.data import Features
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.testing.pictures import reference, texture

__all__ = ["SMALL", "noisy", "nothing", "reference", "texture"]

SMALL = PaperBobbSettings(partitions=20, features=250)
"""The paper's method with fewer partitions and features, so that tests are quick."""


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
