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


def _noise(rng: np.random.Generator, shape: tuple[int, int], amplitude: dict[int, float]) -> Float32s:
    """Octaves of smooth noise: {cell in px: standard deviation in grey levels}."""
    total = np.zeros(shape, np.float32)
    for cell, sigma in amplitude.items():
        grid = rng.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2), np.float32) * np.float32(sigma)
        total += cv2.resize(grid, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return total


def _finish(image: Float32s) -> Bytes:
    """Keep clear of black and white, so that other light still shows every detail."""
    return np.clip(image, 8, 245).astype(np.uint8)


def _tone(rng: np.random.Generator) -> float:
    return float(rng.uniform(25, 225))


def _slabs(rng: np.random.Generator, shape: tuple[int, int], high: int, long: int, shift: int = 0) -> Float32s:
    """Bricks, cladding or paving of `high` x `long` px with joints, every other row shifted."""
    rows = np.arange(shape[0])[:, None]
    columns = np.arange(shape[1])[None, :] + (rows // high % 2) * shift
    tones = rng.normal(0, 10, (shape[0] // high + 1, (shape[1] + shift) // long + 1)).astype(np.float32)
    return np.where((rows % high == 0) | (columns % long == 0), np.float32(-20), tones[rows // high, columns // long])


def _mark(rng: np.random.Generator, image: Float32s, at: tuple[int, int], size: int) -> None:
    """A disc, a plate, a scrawl or a word of about `size` px at `at`."""
    kind, tone = int(rng.integers(4)), _tone(rng)
    if kind == 0:
        cv2.circle(image, at, max(1, size // 2), tone, -1, cv2.LINE_AA)
    elif kind == 1:
        width, height = rng.integers(max(2, size // 3), size + 3, 2).tolist()
        cv2.rectangle(image, at, (at[0] + width, at[1] + height), tone, -1)
    elif kind == 2:
        points = np.cumsum(rng.normal(0, size / 2, (6, 2)), axis=0) + at
        cv2.polylines(image, [points.astype(np.int32)], False, tone, int(rng.integers(1, 3)), cv2.LINE_AA)
    else:
        word = "".join(rng.choice(list(string.ascii_uppercase + string.digits), int(rng.integers(2, 6))))
        scale = max(8, size) / 22  # FONT_HERSHEY_DUPLEX capitals are 22 px high at scale 1
        top = max(0, at[1] - 2 * size)
        band = image[top : at[1] + size, at[0] : at[0] + 6 * size]
        ink = np.zeros(band.shape, np.uint8)  # letters are drawn in 8 bits only, so they are laid over the picture
        cv2.putText(
            ink, word, (0, at[1] - top), cv2.FONT_HERSHEY_DUPLEX, scale, 255, max(1, round(scale * 1.6)), cv2.LINE_AA
        )
        band += (np.float32(tone) - band) * (ink / np.float32(255))


def _place(rng: np.random.Generator, image: Float32s) -> tuple[int, int]:
    return int(rng.integers(image.shape[1])), int(rng.integers(image.shape[0]))


def poster(rng: np.random.Generator, width_m: float, height_m: float) -> Bytes:
    """A sign, a shop window, a door or the side of a thing: marks on a plain ground within a frame."""
    h, w = max(8, int(height_m * PX_PER_M)), max(8, int(width_m * PX_PER_M))
    image = _tone(rng) + _noise(rng, (h, w), {3: 4, 11: 8})
    for _ in range(int(rng.integers(6, 13))):
        _mark(rng, image, _place(rng, image), int(min(w, h) * rng.uniform(0.1, 0.5)))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), _tone(rng), int(rng.integers(2, 5)))
    return _finish(image)


def facade(rng: np.random.Generator, width_m: float, height_m: float) -> Bytes:
    """The front of a house: bricks or cladding, rows of windows, vents, lamps, stains and scrawls."""
    h, w = int(height_m * PX_PER_M), int(width_m * PX_PER_M)
    image = rng.uniform(75, 185) + _noise(rng, (h, w), {1: 3, 2: 5, 7: 5, 23: 6, 90: 9})
    high = int(rng.integers(6, 50))
    image += _slabs(rng, (h, w), high, 2 * high, high)
    storey, wide_m, tall_m = rng.uniform((2.5, 0.8, 1.2), (3.2, 1.6, 2.0)).tolist()
    pitch = int(wide_m * rng.uniform(1.4, 2.2) * PX_PER_M)
    for bottom in range(h - int(0.3 * PX_PER_M), int(tall_m * PX_PER_M), -int(storey * PX_PER_M)):
        for x in range(int(rng.integers(8, 30)), w - int(wide_m * PX_PER_M), pitch):
            if rng.random() < 0.85:
                pane = poster(rng, wide_m, tall_m)
                image[bottom - pane.shape[0] : bottom, x : x + pane.shape[1]] = pane
    for _ in range(int(0.8 * width_m * height_m)):
        _mark(rng, image, _place(rng, image), int(rng.integers(4, 22)))
    return _finish(image)


def ground(rng: np.random.Generator, axis_m: Floats, size_m: Floats, road_m: float) -> Bytes:
    """The street from above, north up: asphalt, pavements, kerbs, lane marks, crossings, repairs, drains and litter.

    axis_m: (K, 2) closed axis of the street, evenly spaced, in m from the upper left corner, y down; road_m: width
    between the kerbs.
    """
    scale = GROUND_PX_PER_M
    w, h = (size_m * scale).astype(int).tolist()
    ahead = np.roll(axis_m, -1, axis=0) - axis_m
    step_m = np.linalg.norm(ahead, axis=1, keepdims=True)
    left, length_m = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / step_m, float(step_m.sum())

    road = np.zeros((h, w), np.uint8)
    line = np.round(axis_m * scale * 16).astype(np.int32)  # cv2's fixed point with 4 fractional bits
    cv2.polylines(road, [line], True, 1, int(road_m * scale), cv2.LINE_8, 4)
    paving = 140 + _noise(rng, (h, w), {40: 6, 160: 6}) + _slabs(rng, (h, w), 19, 19)
    asphalt = 88 + _noise(rng, (h, w), {1: 9, 3: 8, 12: 6, 60: 6, 300: 8})
    image = np.where(road > 0, asphalt, paving)
    cv2.drawContours(image, cv2.findContours(road, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0], -1, 190, 4)

    def at(along_m: float, lateral_m: float) -> tuple[int, int]:
        i = int(along_m / length_m * len(axis_m)) % len(axis_m)
        x, y = ((axis_m[i] + left[i] * lateral_m) * scale).tolist()
        return int(x), int(y)

    for s in np.arange(0, length_m - 3, 6.0):  # the dashes between the lanes, 3 m long, worn
        cv2.line(image, at(s, 1.5), at(s + 3, 1.5), rng.uniform(170, 225), 4, cv2.LINE_AA)
    for s in (0.11, 0.37, 0.6, 0.88):  # pedestrian crossings
        for lateral_m in np.arange(-3.4, 3.5, 0.9):
            ends = at(s * length_m, lateral_m), at(s * length_m + 2.5, lateral_m)
            cv2.line(image, *ends, rng.uniform(180, 230), int(0.45 * scale))
    for largest_px, per_m in ((60, 1.0), (24, 1.0), (5, 3.0)):  # repairs; cracks, manholes and drains; litter
        for _ in range(int(length_m * per_m)):
            point = at(rng.uniform(0, length_m), rng.uniform(-0.65, 0.65) * road_m)
            _mark(rng, image, point, int(rng.integers(2, largest_px)))
    return _finish(image)
