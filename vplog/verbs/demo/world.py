"""The street: boxes with pictures on them, those that stay (houses, street furniture) and those that move (traffic).

The world's axes and distances are those of route.py. Pictures are (H, W) uint8 of albedo, painted from a seed at a
fixed number of px per metre: every place looks like no other.
"""

from __future__ import annotations

import string
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise, product
from typing import Any, NamedTuple

import cv2
import numpy as np

from vplog.data import Bytes, Float32s, Floats, Int32s, Ints
from vplog.verbs.demo.route import axis_point, lap_length
from vplog.verbs.demo.settings import DemoSettings

PX_PER_M = 48
"""Scale of walls and objects: at the default 640 px and 80 degrees a wall 8 m away is seen at this scale."""
GROUND_PX_PER_M = 32
"""Scale of the ground, which is viewed more obliquely and is far larger."""
_LETTERS = list(string.ascii_uppercase + string.digits)
HOUSE_LINE_M = 5.0
"""From the axis to the houses of either side, which stand up to 0.5 m before or behind that line."""
_ROAD_M = 7.4
"""Between the kerbs."""
_HOUSE_DEPTH_M = 10.0
_MARGIN_M = 24.0
"""The ground reaches this far beyond the axis."""
_LEVELS = 9
"""Levels of every texture pyramid: the last has 2 px of 480."""
_POSTERS = 24
"""Pictures that cars and people are made of."""


class Quads(NamedTuple):
    """Q parallelograms in the world, each seen from both sides."""

    corner: Floats
    """(Q, 3) m, the upper left corner as seen from the front."""
    right: Floats
    """(Q, 3) m, from there to the upper right corner."""
    down: Floats
    """(Q, 3) m, from there to the lower left corner."""
    texture: Ints
    """(Q,) row of Textures.levels."""

    def with_others(self, other: Quads) -> Quads:
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self, other, strict=True)]
        return Quads(*columns)


class Textures(NamedTuple):
    """All pictures with their pyramids, in one array."""

    pixels: Bytes
    """(P,)."""
    levels: Int32s
    """(textures, _LEVELS, 3): where a level starts in pixels, its width and its height."""


class World(NamedTuple):
    """Geometry and textures of the street. Texture 0 is the ground's; after it come the _POSTERS of the traffic."""

    textures: Textures
    quads: Quads


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


def _packed(pictures: list[Bytes]) -> Textures:
    levels: list[Any] = []
    for image in pictures:
        for _ in range(_LEVELS):
            levels.append(image)
            h, w = image.shape
            image = cv2.resize(image, (max(1, w // 2), max(1, h // 2)), interpolation=cv2.INTER_AREA)  # noqa: PLW2901
    shapes = np.array([level.shape[::-1] for level in levels])
    starts = np.cumsum(shapes.prod(axis=1)) - shapes.prod(axis=1)
    table = np.column_stack([starts, shapes]).reshape(-1, _LEVELS, 3)
    return Textures(np.concatenate([level.ravel() for level in levels]), table.astype(np.int32))


def _boxes(foot: Floats, heading: Floats, size: Floats, side: Ints, end: Ints) -> Quads:
    """The walls and tops of upright boxes: middle of the foot (B, 3), heading (B,) in rad, m along it, across and up
    (B, 3), and the textures (B,) of the two sides along the heading and of the rest."""
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    long, wide = ahead * size[:, :1] / 2, np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1) * size[:, 1:2] / 2
    around = np.stack([-long - wide, long - wide, long + wide, wide - long], axis=1)
    corner, right, down = (np.zeros((len(foot), 5, 3)) for _ in range(3))
    corner[..., :2] = foot[:, None, :2] + around[:, [0, 1, 2, 3, 3]]
    corner[..., 2] = (foot + size)[:, 2:]
    right[:, :4, :2], right[:, 4, :2] = np.roll(around, -1, axis=1) - around, 2 * long
    down[:, :4, 2], down[:, 4, :2] = -size[:, 2:], -2 * wide
    corner, right, down = (v.reshape(-1, 3) for v in (corner, right, down))
    return Quads(corner, right, down, np.stack([side, end, side, end, end], axis=1).ravel())


@lru_cache(2)  # a second
def build_world(settings: DemoSettings) -> World:
    """Houses along both sides of the street around the block, and the ground. Everything follows from the seed."""
    rng = np.random.default_rng([settings.seed, 1])
    extent = np.array([settings.block_length_m, settings.block_width_m]) / 2
    upper_left, size = (extent + _MARGIN_M) * (-1, 1), 2 * (extent + _MARGIN_M)
    axis, _ = axis_point(settings, np.arange(0, lap_length(settings), 0.1))
    pictures = [ground(rng, (axis - upper_left) * (1, -1), size, _ROAD_M)]
    pictures += [poster(rng, 2.0, 1.0) for _ in range(_POSTERS)]
    placed: list[tuple[float, ...]] = [(0, 0, -0.01, 0, *size, 0.01, 0, 0)]  # the ground is a flat box
    for turn, left in product(range(4), (-1, 1)):  # the straight sides as the car drives, the block on its left
        heading, (ahead_m, across_m) = turn * np.pi / 2, extent[:: 1 - 2 * (turn % 2)].tolist()
        c, s = np.cos(heading), np.sin(heading)
        for x, y, bottom, *box in _row_of_houses(rng, pictures, ahead_m - left * HOUSE_LINE_M, extent.min(), left):
            y -= across_m  # noqa: PLW2901
            placed.append((c * x - s * y, s * x + c * y, bottom, heading, *box))
    table = np.array(placed)
    side, end = table[:, 7:].T.astype(np.int64)
    return World(_packed(pictures), _boxes(table[:, :3], table[:, 3], table[:, 4:7], side, end))


def _row_of_houses(
    rng: np.random.Generator, pictures: list[Bytes], reach_m: float, room_m: float, left: int
) -> Iterator[tuple[float, ...]]:
    """Houses of 8 to 11 m along a straight side, and what stands out from them, so that no scene is a plane.

    Boxes as metres ahead of the side's middle, left of its axis and up, size, and two rows of `pictures`, which grow.
    left: -1 on the right, 1 on the left; reach_m: half the row's length; room_m: from an axis to the block's centre.
    """
    count = max(1, round(reach_m / 4.75))
    cuts = np.linspace(-reach_m, reach_m, count + 1)
    cuts[1:-1] += rng.uniform(-0.8, 0.8, count - 1)
    depth_m = min(_HOUSE_DEPTH_M, 0.9 * (room_m - HOUSE_LINE_M))
    for a, b in pairwise(cuts.tolist()):
        high, front = rng.uniform(6.0, 9.5), HOUSE_LINE_M + rng.uniform(-0.5, 0.5)
        pictures.append(facade(rng, b - a, high))
        yield (a + b) / 2, left * (front + depth_m / 2), 0, b - a, depth_m, high, len(pictures) - 1, len(pictures) - 1
        for _ in range(int(rng.integers(4, 9))):  # signs and balconies, or bins and poles at the kerb
            size, hangs = rng.uniform((0.1, 0.1, 0.6), (1.8, 0.8, 2.6)), rng.random() < 0.5
            pictures += [poster(rng, wide, size[2]) for wide in size[:2]]
            at = a + (b - a) * rng.uniform(0.1, 0.9), left * (front - rng.uniform(0.2, 0.9))
            yield *at, 2.5 * hangs, *size, len(pictures) - 2, len(pictures) - 1


def traffic(settings: DemoSettings, time_s: float) -> Quads:
    """Cars and people at one time of the drive: others are parked in each lap, and many move."""
    length = lap_length(settings)
    # One draw per slot of 11 m and lap, so that no parked cars stand in each other.
    rng = np.random.default_rng([settings.seed, 2, int(time_s * settings.speed_m_s / length)])
    parked = np.arange(int(length / 11)) * 11.0
    parked = (parked + rng.uniform(0, 6, len(parked)))[rng.random(len(parked)) < 0.4]
    parked_kind = rng.integers(0, _POSTERS, len(parked))
    rng = np.random.default_rng([settings.seed, 3])
    oncoming, on_foot = max(1, int(length / 45)), int(length / 12)  # cars in the other lane; people either way
    driving = rng.uniform(0, length, oncoming) - rng.uniform(3, 7, oncoming) * time_s
    walking = rng.uniform(0, length, on_foot) + rng.uniform(0.8, 1.6, on_foot) * rng.choice([-1, 1], on_foot) * time_s
    kind = np.concatenate([parked_kind, rng.integers(0, _POSTERS, oncoming + on_foot)])

    point, heading = axis_point(settings, np.concatenate([parked, driving, walking]))
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    lateral_m = np.repeat([-3.2, 3.0, 4.2], [len(parked), oncoming, on_foot])
    lateral_m[-on_foot:] *= rng.choice([-1, 1], on_foot)
    point += left * lateral_m[:, None]

    cars = np.arange(len(parked) + oncoming)  # a body and its glass
    rows, counts = np.concatenate([cars, cars, np.arange(len(cars), len(point))]), [len(cars), len(cars), on_foot]
    size = np.repeat([(4.2, 1.75, 0.75), (2.3, 1.6, 0.55), (0.3, 0.5, 1.8)], counts, axis=0)
    foot = np.column_stack([point[rows], np.repeat([0.2, 0.95, 0.0], counts)])
    return _boxes(foot, heading[rows], size, 1 + kind[rows], 1 + (kind[rows] + 1) % _POSTERS)
