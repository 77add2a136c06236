"""Pictures painted from a seed: facades, ground, cars, people, signs. Every place looks like no other.

All return (H, W) uint8 of albedo. Sizes are given in metres and painted at a fixed number of px per metre.
"""

from __future__ import annotations

import string
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

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


def _text(rng: np.random.Generator, image: Float32s, x: int, y: int, height: int, tone: float, letters: int) -> None:
    """A word of random letters, its baseline's left end at (x, y)."""
    word = "".join(rng.choice(list(string.ascii_uppercase + string.digits), letters))
    scale = height / 22  # FONT_HERSHEY_DUPLEX capitals are 22 px high at scale 1
    band = image[max(0, y - 2 * height) : y + height, max(0, x) :]
    ink = np.zeros(band.shape, np.uint8)  # letters are drawn in 8 bits only, so they are laid over the picture
    at = (x - max(0, x), y - max(0, y - 2 * height))
    cv2.putText(ink, word, at, cv2.FONT_HERSHEY_DUPLEX, scale, 255, max(1, round(scale * 1.6)), cv2.LINE_AA)
    band += (np.float32(tone) - band) * (ink / np.float32(255))


def _bricks(rng: np.random.Generator, shape: tuple[int, int]) -> Float32s:
    """Rows of stones with joints, every other row shifted by half a stone."""
    high, long = int(rng.integers(6, 14)), int(rng.integers(18, 40))
    stones = rng.normal(0, 11, (shape[0] // high + 1, shape[1] // long + 2)).astype(np.float32)
    rows = np.arange(shape[0]) // high
    columns = np.arange(shape[1])[None, :] + (rows[:, None] % 2) * (long // 2)
    result = stones[rows[:, None], columns // long]
    joint = (np.arange(shape[0])[:, None] % high == 0) | (columns % long == 0)
    return np.where(joint, np.float32(-18), result)


def _panels(rng: np.random.Generator, shape: tuple[int, int]) -> Float32s:
    """Cladding: large plates of slightly different tone."""
    high, long = int(rng.integers(30, 70)), int(rng.integers(40, 110))
    plates = rng.normal(0, 9, (shape[0] // high + 1, shape[1] // long + 1)).astype(np.float32)
    rows, columns = np.arange(shape[0])[:, None], np.arange(shape[1])[None, :]
    joint = (rows % high < 2) | (columns % long < 2)
    return np.where(joint, np.float32(-25), plates[rows // high, columns // long])


def _window(rng: np.random.Generator, image: Float32s, x: int, y: int, w: int, h: int, bright_frame: bool) -> None:
    """A window with frame, bars, a curtain and a reflection; no two are alike."""
    frame = rng.uniform(190, 235) if bright_frame else rng.uniform(25, 60)
    cv2.rectangle(image, (x - 4, y - 4), (x + w + 4, y + h + 4), frame, -1)
    pane = rng.uniform(30, 85) + _noise(rng, (h, w), {5: 6, 17: 14})
    pane += np.linspace(rng.uniform(0, 50), 0, h, dtype=np.float32)[:, None]  # the sky in the glass
    if rng.random() < 0.6:  # curtain or blind
        part = int(w * rng.uniform(0.2, 0.8))
        folds = np.sin(np.arange(part) * rng.uniform(0.3, 1.2)) * 18 + rng.uniform(110, 200)
        top = int(h * rng.uniform(0, 0.5))
        pane[top:, slice(0, part) if rng.random() < 0.5 else slice(w - part, w)] = folds
    for _ in range(int(rng.integers(0, 4))):  # plants and lamps behind the glass
        centre = (int(rng.integers(0, w)), int(rng.integers(h // 2, h)))
        cv2.circle(pane, centre, int(rng.integers(3, 10)), _tone(rng), -1, cv2.LINE_AA)
    image[y : y + h, x : x + w] = pane
    bars, rails = int(rng.integers(0, 3)), int(rng.integers(0, 3))
    for i in range(1, bars + 1):
        cv2.line(image, (x + w * i // (bars + 1), y), (x + w * i // (bars + 1), y + h), frame, 2)
    for i in range(1, rails + 1):
        cv2.line(image, (x, y + h * i // (rails + 1)), (x + w, y + h * i // (rails + 1)), frame, 2)
    cv2.rectangle(image, (x - 8, y + h + 4), (x + w + 8, y + h + 9), rng.uniform(60, 230), -1)  # sill


def poster(rng: np.random.Generator, width_m: float, height_m: float, letters: int = 4) -> Bytes:
    """A sign, poster or shop window: shapes and lettering on a plain ground."""
    h, w = max(8, int(height_m * PX_PER_M)), max(8, int(width_m * PX_PER_M))
    image = rng.uniform(40, 215) + _noise(rng, (h, w), {3: 4, 11: 8})
    for _ in range(int(rng.integers(4, 9))):
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        size = max(2, int(min(w, h) * rng.uniform(0.05, 0.3)))
        if rng.random() < 0.5:
            cv2.circle(image, (x, y), size, _tone(rng), -1, cv2.LINE_AA)
        else:
            cv2.rectangle(image, (x, y), (x + 2 * size, y + size), _tone(rng), -1)
    for _ in range(int(rng.integers(1, 4))):
        tall = max(5, int(h * rng.uniform(0.15, 0.4)))
        _text(
            rng, image, int(rng.integers(0, max(1, w // 3))), int(rng.integers(tall, h + 1)), tall, _tone(rng), letters
        )
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), _tone(rng), 2)
    return _finish(image)


def _shop_fronts(rng: np.random.Generator, image: Float32s, storey: int, bright_frame: bool) -> None:
    """The ground floor from left to right: windows, doors, shops and the signs above them; `storey` px high."""
    h, w = image.shape
    x = int(rng.integers(10, 40))
    while x < w - 60:
        span = min(int(rng.uniform(1.0, 2.8) * PX_PER_M), w - x - 8)
        tall = int(rng.uniform(1.5, 2.3) * PX_PER_M)
        kind = rng.random()
        if kind < 0.35:
            _window(rng, image, x, h - tall - int(0.5 * PX_PER_M), span, tall - 20, bright_frame)
        elif kind < 0.6:  # a door, panelled
            span = min(span, int(1.1 * PX_PER_M))
            image[h - tall :, x : x + span] = rng.uniform(30, 200) + _noise(rng, (tall, span), {3: 5, 13: 6})
            for row in range(3):
                top = h - tall + 8 + row * tall // 3
                cv2.rectangle(image, (x + 7, top), (x + span - 7, top + tall // 3 - 14), _tone(rng), 2)
            cv2.circle(image, (x + span - 8, h - tall // 2), 4, 230, -1)
        else:
            shop = poster(rng, span / PX_PER_M, tall / PX_PER_M, 5)
            image[h - tall - 10 : h - tall - 10 + shop.shape[0], x : x + shop.shape[1]] = shop
        if rng.random() < 0.6:  # a sign above it
            top, tone = h - storey + int(rng.integers(0, 12)), _tone(rng)
            cv2.rectangle(image, (x, top), (x + span, top + 24), tone, -1)
            _text(rng, image, x + 4, top + 19, 15, (tone + 128) % 256, max(2, span // 22))
        x += span + int(rng.integers(12, 50))


def _clutter(rng: np.random.Generator, image: Float32s) -> None:
    """Vents, lamps, house numbers, stains and scrawls, 0.7 to the square metre, and a rain pipe or two."""
    h, w = image.shape
    for _ in range(int(0.7 * h * w / PX_PER_M**2)):
        x, y = int(rng.integers(4, w - 20)), int(rng.integers(4, h - 4))
        kind = rng.random()
        if kind < 0.4:
            size = (int(rng.integers(4, 22)), int(rng.integers(4, 22)))
            cv2.rectangle(image, (x, y), (x + size[0], y + size[1]), _tone(rng), -1)
        elif kind < 0.6:
            cv2.circle(image, (x, y), int(rng.integers(2, 9)), _tone(rng), -1, cv2.LINE_AA)
        elif kind < 0.75:
            _text(rng, image, x, y, int(rng.integers(8, 18)), _tone(rng), int(rng.integers(2, 5)))
        else:
            points = np.cumsum(rng.normal(0, 9, (6, 2)), axis=0) + np.array([x, y])
            cv2.polylines(image, [points.astype(np.int32)], False, _tone(rng), int(rng.integers(1, 3)), cv2.LINE_AA)
    for _ in range(int(rng.integers(1, 3))):
        x = int(rng.integers(5, w - 8))
        cv2.line(image, (x, 0), (x, h), _tone(rng), int(rng.integers(3, 6)))


def facade(rng: np.random.Generator, width_m: float, height_m: float) -> Bytes:
    """The front of a house: bricks, cladding or plaster, windows by floor, a ground floor with doors and shops."""
    h, w = int(height_m * PX_PER_M), int(width_m * PX_PER_M)
    image = rng.uniform(75, 185) + _noise(rng, (h, w), {2: 5, 7: 5, 23: 6, 90: 9})
    finish: Callable[[np.random.Generator, tuple[int, int]], Float32s] | None
    finish = (_bricks, _panels, None)[int(rng.integers(3))]
    if finish is not None:
        image += finish(rng, (h, w))
    bright_frame = bool(rng.random() < 0.5)

    ground_floor = int(rng.uniform(2.8, 3.3) * PX_PER_M)
    storey = int(rng.uniform(2.5, 3.2) * PX_PER_M)
    window_w, window_h = (int(rng.uniform(*span) * PX_PER_M) for span in ((0.8, 1.5), (1.2, 1.8)))
    pitch = int(window_w * rng.uniform(1.5, 2.3))
    for bottom in range(h - ground_floor, window_h + 20, -storey):
        for x in range(int(rng.integers(14, 30)), w - window_w - 14, pitch):
            if rng.random() < 0.85:
                top = bottom - window_h - int(0.3 * PX_PER_M)
                _window(rng, image, x + int(rng.integers(-5, 6)), top, window_w, window_h, bright_frame)

    _shop_fronts(rng, image, ground_floor, bright_frame)
    _clutter(rng, image)
    image += _noise(rng, (h, w), {1: 3})
    return _finish(image)


def ground(rng: np.random.Generator, axis_m: Floats, size_m: tuple[float, float], half_width_m: float) -> Bytes:
    """The street from above, north up: asphalt, pavements, kerbs, lane marks, crossings, manholes, cracks, patches.

    axis_m: (K, 2) closed axis of the street, in m from the upper left corner, y down; size_m: width and height.
    """
    scale = GROUND_PX_PER_M
    h, w = int(size_m[1] * scale), int(size_m[0] * scale)
    axis = axis_m * scale
    line = np.round(axis * 16).astype(np.int32)  # cv2's fixed point with 4 fractional bits

    paving = _noise(rng, (h, w), {40: 6, 160: 6})
    rows, columns = np.arange(h)[:, None], np.arange(w)[None, :]
    slabs = rng.normal(0, 8, (h // 19 + 1, w // 19 + 1)).astype(np.float32)[rows // 19, columns // 19]
    paving += np.where((rows % 19 == 0) | (columns % 19 == 0), np.float32(95), 140 + slabs)
    road = np.zeros((h, w), np.uint8)
    kerb_m = half_width_m - 1.3  # the pavement along the houses is this much narrower than the street
    cv2.polylines(road, [line], True, 1, int(2 * kerb_m * scale), cv2.LINE_8, 4)
    asphalt = 88 + _noise(rng, (h, w), {1: 9, 3: 8, 12: 6, 60: 6, 300: 8})
    image = np.where(road > 0, asphalt, paving)
    edges, _ = cv2.findContours(road, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, edges, -1, 190, 4)

    step = np.linalg.norm(np.diff(axis, axis=0, append=axis[:1]), axis=1)
    distance = np.cumsum(step) - step
    ahead = np.roll(axis, -1, axis=0) - axis
    left = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.maximum(step, 1e-9)[:, None]

    def at(s_m: float, lateral_m: float) -> tuple[int, int]:
        i = int(np.searchsorted(distance, s_m * scale % (distance[-1] + step[-1]), side="right")) - 1
        x, y = axis[i] + left[i] * lateral_m * scale
        return int(x), int(y)

    length_m = float(step.sum()) / scale
    for s in np.arange(0, length_m - 3, 6.0):  # the dashes between the lanes, 3 m long, worn
        cv2.line(image, at(s, 1.5), at(s + 3, 1.5), rng.uniform(170, 225), 4, cv2.LINE_AA)
    for s in (0.11, 0.37, 0.6, 0.88):  # pedestrian crossings
        for lateral in np.arange(-3.4, 3.5, 0.9):
            a, b = at(s * length_m, lateral), at(s * length_m + 2.5, lateral)
            cv2.line(image, a, b, rng.uniform(180, 230), int(0.45 * scale))
    for _ in range(int(length_m * 0.5)):  # repairs
        corner = at(rng.uniform(0, length_m), rng.uniform(-3.5, 3.5))
        size = rng.uniform(0.4, 2.0, 2) * scale
        patch = image[corner[1] : corner[1] + int(size[1]), corner[0] : corner[0] + int(size[0])]
        patch += rng.uniform(-30, 30)
    for _ in range(int(length_m * 0.8)):  # cracks
        start = at(rng.uniform(0, length_m), rng.uniform(-3.5, 3.5))
        points = np.cumsum(rng.normal(0, 12, (12, 2)), axis=0) + start
        cv2.polylines(image, [points.astype(np.int32)], False, rng.uniform(25, 60), 1, cv2.LINE_AA)
    for _ in range(int(length_m * 0.25)):  # manholes and drains
        centre = at(rng.uniform(0, length_m), rng.uniform(-3.3, 3.3))
        radius = int(rng.uniform(0.25, 0.4) * scale)
        cv2.circle(image, centre, radius, rng.uniform(40, 70), -1, cv2.LINE_AA)
        cv2.circle(image, centre, radius, 150, 1, cv2.LINE_AA)
        for offset in range(-radius + 4, radius - 2, 4):
            cv2.line(
                image, (centre[0] - radius // 2, centre[1] + offset), (centre[0] + radius // 2, centre[1] + offset), 110
            )
    for _ in range(int(length_m * 3)):  # leaves, gum, litter
        lateral = rng.uniform(-half_width_m, half_width_m)
        cv2.circle(image, at(rng.uniform(0, length_m), lateral), int(rng.integers(1, 4)), _tone(rng), -1, cv2.LINE_AA)
    return _finish(image)


def car_side(rng: np.random.Generator, length_m: float, height_m: float) -> Bytes:
    """The lower body of a car with its wheels, doors and a scratch or two."""
    h, w = int(height_m * PX_PER_M), int(length_m * PX_PER_M)
    image = (
        rng.uniform(40, 210) + _noise(rng, (h, w), {2: 2, 30: 6}) + np.linspace(18, -18, h)[:, None].astype(np.float32)
    )
    for x in (0.18, 0.8):
        cv2.circle(image, (int(w * x), h - 2), int(0.32 * PX_PER_M), 18, -1, cv2.LINE_AA)
        cv2.circle(image, (int(w * x), h - 2), int(0.18 * PX_PER_M), 150, -1, cv2.LINE_AA)
    for x in (0.3, 0.5, 0.7):
        cv2.line(image, (int(w * x), 0), (int(w * x), h - 6), 30, 1, cv2.LINE_AA)
    _text(rng, image, int(w * 0.33), int(h * 0.6), 12, _tone(rng), 5)
    return _finish(image)


def car_end(rng: np.random.Generator, width_m: float, height_m: float) -> Bytes:
    """Front or back: lamps, a grille, a number plate."""
    h, w = int(height_m * PX_PER_M), int(width_m * PX_PER_M)
    image = rng.uniform(40, 200) + _noise(rng, (h, w), {2: 2, 20: 5})
    for x in (0.12, 0.88):
        cv2.circle(image, (int(w * x), int(h * 0.35)), int(h * 0.15), 230, -1, cv2.LINE_AA)
    cv2.rectangle(image, (int(w * 0.28), int(h * 0.2)), (int(w * 0.72), int(h * 0.45)), 30, -1)
    cv2.rectangle(image, (int(w * 0.3), int(h * 0.6)), (int(w * 0.7), int(h * 0.85)), 225, -1)
    _text(rng, image, int(w * 0.33), int(h * 0.81), 7, 20, 6)
    return _finish(image)


def car_glass(rng: np.random.Generator, length_m: float, height_m: float) -> Bytes:
    """The windows of a car between their pillars."""
    h, w = int(height_m * PX_PER_M), int(length_m * PX_PER_M)
    image = 45 + _noise(rng, (h, w), {4: 5, 15: 16})
    for x in (0, 0.5, 1):
        cv2.line(image, (int(w * x), 0), (int(w * x), h), 150, 5)
    cv2.line(image, (0, 0), (w, 0), 150, 5)
    return _finish(image)


def person(rng: np.random.Generator) -> tuple[Bytes, Bytes]:
    """Someone on foot, 0.7 x 1.8 m, and their outline (255 inside, 0 outside)."""
    h, w = int(1.8 * PX_PER_M), int(0.7 * PX_PER_M)
    image, outline = np.full((h, w), 120, np.float32), np.zeros((h, w), np.uint8)
    coat, trousers = _tone(rng), _tone(rng)
    stride = int(rng.integers(3, 9))
    shapes = [
        ([(w // 2 - 4, h // 2), (w // 2 + 4, h // 2), (w // 2 + stride + 4, h), (w // 2 + stride - 4, h)], trousers),
        ([(w // 2 - 4, h // 2), (w // 2 + 4, h // 2), (w // 2 - stride + 4, h), (w // 2 - stride - 4, h)], trousers),
        ([(7, h // 5), (w - 7, h // 5), (w - 9, h * 3 // 5), (9, h * 3 // 5)], coat),
    ]
    for corners, tone in shapes:
        points = np.array(corners, np.int32)
        cv2.fillPoly(image, [points], tone)
        cv2.fillPoly(outline, [points], 255)
    for canvas, tone in ((image, rng.uniform(110, 200)), (outline, 255)):
        cv2.circle(canvas, (w // 2, h // 9), h // 13, tone, -1)
    return _finish(image + _noise(rng, (h, w), {2: 6, 6: 12})), outline


def foliage(rng: np.random.Generator, size_m: float) -> tuple[Bytes, Bytes]:
    """The crown of a tree and its ragged outline (255 inside, 0 outside)."""
    n = int(size_m * PX_PER_M)
    image = 85 + _noise(rng, (n, n), {3: 18, 9: 16, 40: 12})
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    edge = np.hypot(x, y) + _noise(rng, (n, n), {6: 0.08, 25: 0.12})
    return _finish(image), np.where(edge < 0.8, np.uint8(255), np.uint8(0))
