"""The street: flat textured rectangles in space, those that stay (houses, ground) and those that move (traffic).

The world's axes and distances are those of route.py.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from vplog.demo import textures as paint
from vplog.demo.route import axis_point, lap_length

if TYPE_CHECKING:
    from vplog.data import Bytes, Floats, Int32s, Ints
    from vplog.demo.settings import DemoSettings

HALF_STREET_M = 5.0
"""From the axis to the houses of either side, which stand up to 0.5 m before or behind that line."""
_ROAD_M = 7.4
"""Between the kerbs."""
_HOUSE_DEPTH_M = 10.0
"""How far the side walls of a house reach back: seen only where a neighbour is missing."""
_MARGIN_M = 24.0
"""The ground reaches this far beyond the axis, past the end of every side street."""
_LEVELS = 9
"""Of every texture's pyramid: the last halves 480 px to 2 px."""
_FURNITURE = (
    (1, 3, (0.05, 0.6, 0.6), (0.1, 1.1, 1.1), (2.4, 4.2), (0.4, 0.6)),  # signs that hang out over the pavement
    (0, 1, (1.4, 0.5, 1.0), (2.4, 0.9, 2.2), (2.6, 3.6), (0.3, 0.5)),  # a bay or a balcony
    (1, 3, (0.4, 0.3, 0.5), (1.3, 0.7, 1.7), (0.0, 0.0), (0.2, 0.8)),  # bins, planters, switch boxes, kiosks
    (0, 2, (0.1, 0.1, 2.6), (0.3, 0.3, 5.0), (0.0, 0.0), (0.9, 1.1)),  # lamps, poles and trunks at the kerb
    (0, 1, (1.2, 1.2, 1.2), (2.2, 1.6, 2.0), (2.4, 3.0), (0.5, 0.9)),  # a crown of leaves or an awning
)
"""What stands out from one house, so that no scene is a plane: how many at least and at most; size in m along the
house, across and up, least and most; height of its foot; how far before the house its middle is."""


class Quads(NamedTuple):
    """Q parallelograms in the world, each seen from both sides."""

    corner: Floats
    """(Q, 3) m, the upper left corner as seen from the front."""
    right: Floats
    """(Q, 3) m, from there to the upper right corner."""
    down: Floats
    """(Q, 3) m, from there to the lower left corner."""
    texture: Int32s
    """(Q,) row of Textures.levels."""

    def with_others(self, other: Quads) -> Quads:
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self, other, strict=True)]
        return Quads(*columns)


class Textures(NamedTuple):
    """All pictures with their pyramids, in one array."""

    pixels: Bytes
    """(P,)."""
    levels: Ints
    """(textures, _LEVELS, 3): where a level starts in pixels, its width and its height."""


class World(NamedTuple):
    """What stands in the street, and the pictures that the traffic is made of."""

    textures: Textures
    quads: Quads
    cars: Int32s
    """(cars, 3) textures of a car's side, end and glass."""
    people: Int32s
    """(people,) textures."""


class _Builder:
    """Collects pictures and quads while the world, or the traffic of one moment, is built."""

    def __init__(self) -> None:
        self._pixels: list[Bytes] = []
        self._levels: list[list[tuple[int, int, int]]] = []
        self._end = 0
        self._rows: list[tuple[Floats, Floats, Floats, int]] = []

    def picture(self, image: Bytes) -> int:
        """Store a picture with its pyramid; the row it got."""
        rows = []
        for _ in range(_LEVELS):
            h, w = image.shape
            rows.append((self._end, w, h))
            self._pixels.append(image.ravel())
            self._end += image.size
            half = cv2.resize(image, (max(1, w // 2), max(1, h // 2)), interpolation=cv2.INTER_AREA)
            image = half.astype(np.uint8)
        self._levels.append(rows)
        return len(self._levels) - 1

    def quad(self, corner: Floats, right: Floats, down: Floats, texture: int) -> None:
        self._rows.append((corner, right, down, texture))

    def wall(self, a: Floats, b: Floats, bottom: float, top: float, texture: int) -> None:
        """An upright quad from ground point a (2,), on the left as seen from its front, to b."""
        self.quad(np.array([*a, top]), np.array([*(b - a), 0.0]), np.array([0.0, 0.0, bottom - top]), texture)

    def box(self, centre: Floats, ahead: Floats, size: Floats, bottom: float, faces: tuple[int, int, int]) -> None:
        """An upright box around ground point centre (2,): size along `ahead` (2, unit), across it, and up.

        faces: textures of the two sides along `ahead`, the two ends, and the top.
        """
        long, wide = ahead * size[0] / 2, np.array([-ahead[1], ahead[0]]) * size[1] / 2
        top = bottom + size[2]
        corners = [centre - long - wide, centre + long - wide, centre + long + wide, centre - long + wide]
        for i in range(4):
            self.wall(corners[i], corners[(i + 1) % 4], bottom, top, faces[i % 2])
        self.quad(np.array([*corners[3], top]), np.array([*(2 * long), 0]), np.array([*(-2 * wide), 0]), faces[2])

    def textures(self) -> Textures:
        return Textures(np.concatenate(self._pixels), np.array(self._levels, np.int64))

    def quads(self) -> Quads:
        corner, right, down, texture = zip(*self._rows, strict=True)
        return Quads(np.array(corner), np.array(right), np.array(down), np.array(texture, np.int32))


def build_world(settings: DemoSettings) -> World:
    """Houses along both sides of the street around the block, and the ground. Everything follows from the seed."""
    rng = np.random.default_rng([settings.seed, 1])
    build = _Builder()
    party_wall = build.picture(paint.facade(rng, 2.0, 4.0))
    half = np.array([settings.block_length_m, settings.block_width_m]) / 2
    for turn, (c, s) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):  # the four straight sides, as the car drives
        ahead, left = np.array([c, s], float), np.array([-s, c], float)
        length, across = half if turn % 2 == 0 else half[::-1]
        for side, facing, room_m in ((-1, ahead, across - HALF_STREET_M), (1, -ahead, _MARGIN_M - HALF_STREET_M)):
            reach_m = length + side * HALF_STREET_M
            start = -facing * reach_m - left * (across + side * HALF_STREET_M)
            _row_of_houses(rng, build, start, facing, 2 * reach_m, room_m, party_wall)

    upper_left, size = (half + _MARGIN_M) * (-1, 1), 2 * (half + _MARGIN_M)
    axis, _ = axis_point(settings, np.arange(0, lap_length(settings), 0.1))
    picture = build.picture(paint.ground(rng, (axis - upper_left) * (1, -1), size, _ROAD_M))
    build.quad(np.array([*upper_left, 0.0]), np.array([size[0], 0, 0]), np.array([0, -size[1], 0]), picture)
    faces = ((4.2, 0.75), (1.75, 0.75), (2.3, 0.55))
    cars = [[build.picture(paint.poster(rng, *face)) for face in faces] for _ in range(8)]
    people = [build.picture(paint.poster(rng, 0.5, 1.8)) for _ in range(8)]
    return World(build.textures(), build.quads(), np.array(cars, np.int32), np.array(people, np.int32))


def _row_of_houses(
    rng: np.random.Generator, build: _Builder, start: Floats, along: Floats, length_m: float, room_m: float, party: int
) -> None:
    """Houses of 8 to 11 m from ground point `start` (2,) on, left to right as seen from the street.

    room_m: how far back they may reach; party: the picture of walls between neighbours.
    """
    out = np.array([along[1], -along[0]])  # towards the street
    back = -out * min(_HOUSE_DEPTH_M, 0.9 * room_m)
    count = max(1, round(length_m / 9.5))
    cuts = np.linspace(0, length_m, count + 1)
    cuts[1:-1] += rng.uniform(-0.8, 0.8, count - 1)
    gap = int(rng.integers(1, count - 1)) if count >= 4 else -1  # a side street with a house at its end
    for i, (left_m, right_m) in enumerate(pairwise(cuts.tolist())):
        height = rng.uniform(6.0, 9.5)
        if i == gap:
            end, wide = start - out * min(15.0, 0.9 * room_m), right_m - left_m + 8
            wall = build.picture(paint.facade(rng, wide, height))
            build.wall(end + along * (left_m - 4), end + along * (right_m + 4), 0, height, wall)
            continue
        front = start + out * rng.uniform(-0.5, 0.5)
        a, b = front + along * left_m, front + along * right_m
        build.wall(a, b, 0, height, build.picture(paint.facade(rng, right_m - left_m, height)))
        # A side in full view is like no other; between neighbours at most a strip shows, and one picture does for all.
        for ends, bare in (((a + back, a), i in (0, gap + 1)), ((b, b + back), i in (gap - 1, count - 1))):
            side = build.picture(paint.facade(rng, _HOUSE_DEPTH_M, height)) if bare else party
            build.wall(*ends, 0, height, side)
        for least, most, low, high, bottom, forward in _FURNITURE:
            for _ in range(int(rng.integers(least, most + 1))):
                size = rng.uniform(low, high)
                foot = a + (b - a) * rng.uniform(0.12, 0.88) + out * rng.uniform(*forward)
                face, end = (build.picture(paint.poster(rng, wide, size[2])) for wide in size[:2])
                build.box(foot, along, size, rng.uniform(*bottom), (face, end, end))


def traffic(world: World, settings: DemoSettings, time_s: float) -> Quads:
    """Cars and people at one time of the drive: others are parked in each lap, and many move."""
    length = lap_length(settings)
    lap = int(time_s * settings.speed_m_s / length)
    # One draw per slot of 11 m and lap, so that no parked cars stand in each other.
    rng = np.random.default_rng([settings.seed, 2, lap])
    parked = np.arange(int(length / 11)) * 11.0
    parked = (parked + rng.uniform(0, 6, len(parked)))[rng.random(len(parked)) < 0.4]
    parked_kind = rng.integers(0, len(world.cars), len(parked))
    rng = np.random.default_rng([settings.seed, 3])
    oncoming, on_foot = max(1, int(length / 45)), int(length / 12)  # cars in the other lane; people either way
    driving = rng.uniform(0, length, oncoming) - rng.uniform(3, 7, oncoming) * time_s
    walking = rng.uniform(0, length, on_foot) + rng.uniform(0.8, 1.6, on_foot) * rng.choice([-1, 1], on_foot) * time_s
    kinds = np.concatenate([parked_kind, rng.integers(0, len(world.cars), oncoming)])
    people, pavement_m = rng.choice(world.people, on_foot), rng.choice([-4.2, 4.2], on_foot)

    axis, heading = axis_point(settings, np.concatenate([parked, driving, walking]))
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    lateral_m = np.concatenate([np.full(len(parked), -3.2), np.full(oncoming, 3.0), pavement_m])
    point = axis + left * lateral_m[:, None]
    ahead[len(parked) : len(kinds)] *= -1

    build = _Builder()
    for i, (body, end, glass) in enumerate(world.cars[kinds].tolist()):
        build.box(point[i], ahead[i], np.array([4.2, 1.75, 0.75]), 0.2, (body, end, end))
        build.box(point[i] - 0.2 * ahead[i], ahead[i], np.array([2.3, 1.6, 0.55]), 0.95, (glass, glass, end))
    for i, picture in enumerate(people.tolist(), start=len(kinds)):
        build.box(point[i], ahead[i], np.array([0.3, 0.5, 1.8]), 0.0, (picture, picture, picture))
    return build.quads()
