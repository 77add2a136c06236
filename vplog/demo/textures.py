"""Pictures painted from a seed: facades, signs and the ground. Every place looks like no other.

All are (H, W) uint8 of albedo. Sizes are in metres, painted at a fixed number of px per metre.
"""

from __future__ import annotations

import string
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s, Floats

PX_PER_M = 48
"""Of walls and objects: at the default 640 px and 80 degrees a wall 8 m away is seen at this scale."""
GROUND_PX_PER_M = 32
"""Of the ground, which is seen more obliquely and is far larger."""
_LETTERS = list(string.ascii_uppercase + string.digits)


def _noise(rng: np.random.Generator, shape: tuple[int, int], amplitude: dict[int, float]) -> Float32s:
    """Octaves of smooth noise: {cell in px: standard deviation in grey levels}."""
    total = np.zeros(shape, np.float32)
    for cell, sigma in amplitude.items():
        grid = rng.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2), np.float32) * np.float32(sigma)
        total += cv2.resize(grid, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return total


def _slabs(rng: np.random.Generator, shape: tuple[int, int], high: int, long: int) -> Float32s:
    """Bricks, cladding or paving of `high` x `long` px with joints, every other row shifted by half."""
    rows = np.arange(shape[0])[:, None]
    columns = np.arange(shape[1])[None, :] + (rows // high % 2) * (long // 2)
    tones = rng.normal(0, 10, (shape[0] // high + 1, (shape[1] + long) // long + 1)).astype(np.float32)
    return np.where((rows % high == 0) | (columns % long == 0), np.float32(-20), tones[rows // high, columns // long])


def _grey(image: Float32s) -> Bytes:
    """Clear of black and white, so that other light still shows every detail."""
    return np.clip(image, 8, 245).astype(np.uint8)


def _tone(rng: np.random.Generator) -> float:
    return float(rng.uniform(25, 225))


def _mark(rng: np.random.Generator, image: Bytes, size: int) -> None:
    """A disc, a plate, a scrawl or a word of about `size` px anywhere in the image."""
    kind, tone, x, y = int(rng.integers(4)), _tone(rng), *(int(rng.integers(side)) for side in image.shape[::-1])
    if kind == 0:
        cv2.circle(image, (x, y), max(1, size // 2), tone, -1, cv2.LINE_AA)
    elif kind == 1:
        width, height = rng.integers(max(2, size // 3), size + 3, 2).tolist()
        cv2.rectangle(image, (x, y, width, height), tone, -1)
    elif kind == 2:
        points = np.cumsum([(x, y), *rng.normal(0, size / 2, (6, 2))], axis=0)
        cv2.polylines(image, [points.astype(np.int32)], False, tone, int(rng.integers(1, 3)), cv2.LINE_AA)
    else:
        word, scale = "".join(rng.choice(_LETTERS, rng.integers(2, 6))), max(8, size) / 22  # capitals are 22 px at 1
        cv2.putText(image, word, (x, y), cv2.FONT_HERSHEY_DUPLEX, scale, tone, max(1, round(scale * 1.6)), cv2.LINE_AA)


def poster(rng: np.random.Generator, width_m: float, height_m: float) -> Bytes:
    """A sign, a shop window, a door or the side of a thing: marks on a plain ground within a frame."""
    h, w = max(8, int(height_m * PX_PER_M)), max(8, int(width_m * PX_PER_M))
    image = _grey(_tone(rng) + _noise(rng, (h, w), {3: 4, 11: 8}))
    for _ in range(int(rng.integers(6, 13))):
        _mark(rng, image, int(min(w, h) * rng.uniform(0.1, 0.5)))
    return cv2.rectangle(image, (0, 0), (w - 1, h - 1), _tone(rng), int(rng.integers(2, 5)))  # type: ignore[return-value]


def facade(rng: np.random.Generator, width_m: float, height_m: float) -> Bytes:
    """The front of a house: bricks or cladding, rows of windows, vents, lamps, stains and scrawls."""
    h, w = int(height_m * PX_PER_M), int(width_m * PX_PER_M)
    high = int(rng.integers(6, 50))
    wall = rng.uniform(75, 185) + _noise(rng, (h, w), {1: 3, 2: 5, 7: 5, 23: 6, 90: 9})
    image = _grey(wall + _slabs(rng, (h, w), high, 2 * high))
    storey_m, wide_m, tall_m = rng.uniform((2.5, 0.8, 1.2), (3.2, 1.6, 2.0)).tolist()
    pitch = int(wide_m * rng.uniform(1.4, 2.2) * PX_PER_M)
    for bottom in range(h - int(0.3 * PX_PER_M), int(tall_m * PX_PER_M), -int(storey_m * PX_PER_M)):
        for x in range(int(rng.integers(8, 30)), w - int(wide_m * PX_PER_M), pitch):
            pane = poster(rng, wide_m, tall_m)
            image[bottom - pane.shape[0] : bottom, x : x + pane.shape[1]] = pane
    for size in rng.integers(4, 22, int(0.8 * width_m * height_m)).tolist():
        _mark(rng, image, size)
    return image


def ground(rng: np.random.Generator, axis_m: Floats, size_m: Floats, road_m: float) -> Bytes:
    """The street from above, north up: asphalt, pavements, kerbs, a dashed line, repairs, drains and litter.

    axis_m: (K, 2) closed axis of the street, every 0.1 m, in m from the upper left corner, y down; road_m: width
    between the kerbs.
    """
    w, h = (size_m * GROUND_PX_PER_M).astype(int).tolist()
    line, road_px = np.round(axis_m * GROUND_PX_PER_M).astype(np.int32), int(road_m * GROUND_PX_PER_M)
    kind = np.zeros((h, w), np.uint8)  # pavement, kerb, road
    for value, width_px in ((1, road_px + 8), (2, road_px)):
        cv2.polylines(kind, [line], True, value, width_px)
    paving = 140 + _noise(rng, (h, w), {40: 6, 160: 6}) + _slabs(rng, (h, w), 19, 38)
    asphalt = 88 + _noise(rng, (h, w), {1: 9, 3: 8, 12: 6, 60: 6, 300: 8})
    image = _grey(np.where(kind == 2, asphalt, np.where(kind == 1, np.float32(190), paving)))
    for start in range(0, len(line) - 30, 60):  # 3 m long, worn
        cv2.polylines(image, [line[start : start + 30]], False, rng.uniform(170, 225), 4, cv2.LINE_AA)
    for largest_px, per_m2 in ((60, 0.1), (24, 0.1), (5, 0.3)):  # repairs; cracks, manholes and drains; litter
        for size in rng.integers(2, largest_px, int(size_m.prod() * per_m2)).tolist():
            _mark(rng, image, size)
    return image
