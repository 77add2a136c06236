"""The street: flat textured rectangles in space, those that stay (houses, ground) and those that move (traffic).

The world's axes and distances are those of route.py.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vplog.demo import textures as paint
from vplog.demo.route import axis_point, lap_length

if TYPE_CHECKING:
    from vplog.data import Bytes, Floats, Int32s, Ints
    from vplog.demo.settings import DemoSettings

HALF_STREET_M = 5.0
"""From the axis to the houses of either side, which stand up to 0.5 m before or behind that line."""
_HOUSE_DEPTH_M = 10.0
"""How far the side walls of a house reach back: seen only where a neighbour is missing."""
_MARGIN_M = 24.0
"""The ground reaches this far beyond the axis, past the end of every side street."""
_LEVELS = 9
"""Of every texture's pyramid: the last halves 480 px to 2 px."""


@dataclass(frozen=True, eq=False)
class Quads:
    """Q parallelograms in the world, each seen from both sides."""

    corner: Floats
    """(Q, 3) m, the upper left corner as seen from the front."""
    right: Floats
    """(Q, 3) m, from there to the upper right corner."""
    down: Floats
    """(Q, 3) m, from there to the lower left corner."""
    texture: Int32s
    """(Q,) row of Textures.levels."""
    mask: Int32s
    """(Q,) row of the texture that is 0 where the quad has a hole, -1 where it has none."""

    def __len__(self) -> int:
        return len(self.corner)

    def __add__(self, other: Quads) -> Quads:
        names = [field.name for field in fields(Quads)]
        return Quads(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclass(frozen=True, eq=False)
class Textures:
    """All pictures with their pyramids, in one array."""

    pixels: Bytes
    """(P,)."""
    levels: Ints
    """(textures, _LEVELS, 3): where a level starts in pixels, its width and its height."""


@dataclass(frozen=True, eq=False)
class World:
    """What stands in the street, and the pictures that the traffic is made of."""

    textures: Textures
    quads: Quads
    cars: Int32s
    """(cars, 3) textures of a car's side, end and glass."""
    people: Int32s
    """(people, 2) texture and outline."""


class _Pictures:
    """Collects pictures while the world is built."""

    def __init__(self) -> None:
        self._pixels: list[Bytes] = []
        self._levels: list[list[tuple[int, int, int]]] = []
        self._end = 0

    def add(self, image: Bytes) -> int:
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

    def textures(self) -> Textures:
        return Textures(np.concatenate(self._pixels), np.array(self._levels, np.int64))


class _Shapes:
    """Collects quads while the world, or the traffic of one moment, is built."""

    def __init__(self) -> None:
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, int, int]] = []

    def quad(self, corner: Floats, right: Floats, down: Floats, texture: int, mask: int = -1) -> None:
        self._rows.append((corner, right, down, texture, mask))

    def wall(self, a: Floats, b: Floats, bottom: float, top: float, texture: int, mask: int = -1) -> None:
        """An upright quad from ground point a (2,), on the left as seen from its front, to b."""
        self.quad(np.array([*a, top]), np.array([*(b - a), 0.0]), np.array([0.0, 0.0, bottom - top]), texture, mask)

    def box(
        self,
        centre: Floats,
        ahead: Floats,
        size: tuple[float, float, float],
        bottom: float,
        faces: tuple[int, int, int],
    ) -> None:
        """An upright box around ground point centre (2,): size along `ahead` (2, unit), across it, and up.

        faces: textures of the two sides along `ahead`, the two ends, and the top.
        """
        left = np.array([-ahead[1], ahead[0]])
        long, wide = ahead * size[0] / 2, left * size[1] / 2
        top = bottom + size[2]
        corners = [centre - long - wide, centre + long - wide, centre + long + wide, centre - long + wide]
        for i in range(4):
            self.wall(corners[i], corners[(i + 1) % 4], bottom, top, faces[i % 2])
        self.quad(np.array([*corners[3], top]), np.array([*(2 * long), 0]), np.array([*(-2 * wide), 0]), faces[2])

    def quads(self) -> Quads:
        corner, right, down = (
            np.array([row[side] for row in self._rows], np.float64).reshape(-1, 3) for side in range(3)
        )
        texture, mask = (np.array([row[which] for row in self._rows], np.int32) for which in (3, 4))
        return Quads(corner, right, down, texture, mask)


def build_world(settings: DemoSettings) -> World:
    """Houses along both sides of the street around the block, and the ground. Everything follows from the seed."""
    rng = np.random.default_rng([settings.seed, 1])
    pictures, shapes = _Pictures(), _Shapes()
    party_wall = pictures.add(paint.facade(rng, 2.0, 4.0))
    half = np.array([settings.block_length_m, settings.block_width_m]) / 2

    for turn in range(4):  # the four straight sides, as the car drives them
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn]
        ahead, left = np.array([c, s], float), np.array([-s, c], float)
        length, across = (half[0], half[1]) if turn % 2 == 0 else (half[1], half[0])
        room_m = across - HALF_STREET_M  # from the inner houses to the middle of the block
        inner = -ahead * (length - HALF_STREET_M) - left * (across - HALF_STREET_M)
        _row_of_houses(rng, pictures, shapes, inner, ahead, 2 * (length - HALF_STREET_M), room_m, party_wall)
        outer = ahead * (length + HALF_STREET_M) - left * (across + HALF_STREET_M)
        _row_of_houses(
            rng, pictures, shapes, outer, -ahead, 2 * (length + HALF_STREET_M), _MARGIN_M - HALF_STREET_M, party_wall
        )

    upper_left = np.array([-half[0] - _MARGIN_M, half[1] + _MARGIN_M])
    size = 2 * (half + _MARGIN_M)
    axis, _ = axis_point(settings, np.arange(0, lap_length(settings), 0.1))
    picture = paint.ground(rng, (axis - upper_left) * (1, -1), (size[0], size[1]), HALF_STREET_M)
    east, south = np.array([size[0], 0, 0]), np.array([0, -size[1], 0])
    shapes.quad(np.array([*upper_left, 0.0]), east, south, pictures.add(picture))

    cars = [
        [
            pictures.add(paint.car_side(rng, 4.2, 0.95)),
            pictures.add(paint.car_end(rng, 1.75, 0.95)),
            pictures.add(paint.car_glass(rng, 2.2, 0.6)),
        ]
        for _ in range(8)
    ]
    people = [[pictures.add(p) for p in paint.person(rng)] for _ in range(8)]
    return World(pictures.textures(), shapes.quads(), np.array(cars, np.int32), np.array(people, np.int32))


def _row_of_houses(
    rng: np.random.Generator,
    pictures: _Pictures,
    shapes: _Shapes,
    start: Floats,
    along: Floats,
    length_m: float,
    room_m: float,
    party_wall: int,
) -> None:
    """Houses of 8 to 11 m from ground point `start` (2,) on, left to right as seen from the street.

    room_m: how far back they may reach; party_wall: the picture of walls between neighbours.
    """
    out = np.array([along[1], -along[0]])  # towards the street
    depth_m = min(_HOUSE_DEPTH_M, 0.9 * room_m)
    count = max(1, round(length_m / 9.5))
    cuts = np.linspace(0, length_m, count + 1)
    cuts[1:-1] += rng.uniform(-0.8, 0.8, count - 1)
    gap = int(rng.integers(1, count - 1)) if count >= 4 else -1  # a side street with a house at its end
    for i, (left_m, right_m) in enumerate(pairwise(cuts.tolist())):
        wide, height = right_m - left_m, rng.uniform(6.0, 9.5)
        if i == gap:
            back = start - out * min(15.0, 0.9 * room_m)
            wall = pictures.add(paint.facade(rng, wide + 8, height))
            shapes.wall(back + along * (left_m - 4), back + along * (right_m + 4), 0, height, wall)
            continue
        front = start + out * rng.uniform(-0.5, 0.5)
        a, b = front + along * left_m, front + along * right_m
        shapes.wall(a, b, 0, height, pictures.add(paint.facade(rng, wide, height)))
        # A side in full view is like no other; between neighbours at most a strip shows, and one picture does for all.
        sides = [
            pictures.add(paint.facade(rng, depth_m, height)) if bare else party_wall
            for bare in (i in (0, gap + 1), i in (gap - 1, count - 1))
        ]
        shapes.wall(a - out * depth_m, a, 0, height, sides[0])
        shapes.wall(b, b - out * depth_m, 0, height, sides[1])
        _street_furniture(rng, pictures, shapes, front, along, out, left_m, wide)


def _street_furniture(
    rng: np.random.Generator,
    pictures: _Pictures,
    shapes: _Shapes,
    front: Floats,
    along: Floats,
    out: Floats,
    left_m: float,
    wide_m: float,
) -> None:
    """What stands out from one house, so that no scene is a plane: signs, bays, boxes, poles, now and then a tree."""

    def at(forward_m: float) -> Floats:
        return front + along * (left_m + rng.uniform(0.12, 0.88) * wide_m) + out * forward_m

    for _ in range(int(rng.integers(1, 4))):  # a sign that hangs out over the pavement
        size, bottom = rng.uniform(0.6, 1.1, 2), rng.uniform(2.4, 4.2)
        a = at(0.1)
        picture = pictures.add(paint.poster(rng, size[0], size[1], 3))
        shapes.wall(a, a + out * size[0], bottom, bottom + size[1], picture)
    if rng.random() < 0.6:  # a bay or a balcony
        size = (rng.uniform(1.4, 2.4), rng.uniform(0.5, 0.9), rng.uniform(1.0, 2.2))
        face = pictures.add(paint.poster(rng, size[0], size[2], 6))
        end = pictures.add(paint.poster(rng, size[1], size[2], 2))
        shapes.box(at(size[1] / 2), along, size, rng.uniform(2.6, 3.6), (face, end, end))
    for _ in range(int(rng.integers(1, 4))):  # bins, planters, switch boxes, kiosks
        size = (rng.uniform(0.4, 1.3), rng.uniform(0.3, 0.7), rng.uniform(0.5, 1.7))
        face = pictures.add(paint.poster(rng, size[0], size[2]))
        end = pictures.add(paint.poster(rng, size[1], size[2], 2))
        shapes.box(at(size[1] / 2 + rng.uniform(0.05, 0.5)), along, size, 0.0, (face, end, end))
    if rng.random() < 0.7:  # a lamp or a traffic sign at the kerb
        foot, height = at(1.1), rng.uniform(2.6, 5.0)
        metal = pictures.add(paint.poster(rng, 0.15, 1.0, 1))
        shapes.box(foot, along, (0.12, 0.12, height), 0.0, (metal, metal, metal))
        plate = pictures.add(paint.poster(rng, 0.6, 0.6, 2))
        shapes.wall(foot - out * 0.3 - along * 0.08, foot + out * 0.3 - along * 0.08, height - 0.6, height, plate)
    if rng.random() < 0.3:
        foot, size = at(0.9), rng.uniform(2.0, 2.8)
        trunk = pictures.add(paint.poster(rng, 0.3, 2.5, 1))
        shapes.box(foot, along, (0.25, 0.25, 3.0), 0.0, (trunk, trunk, trunk))
        crown, outline = (pictures.add(p) for p in paint.foliage(rng, size))
        for direction in (along, out):
            half = direction * size / 2
            shapes.wall(foot - half, foot + half, 2.4, 2.4 + size, crown, outline)


def traffic(world: World, settings: DemoSettings, time_s: float) -> Quads:
    """Cars and people at one time of the drive: others are parked in each lap, and many move."""
    length = lap_length(settings)
    lap = int(time_s * settings.speed_m_s / length)
    # One draw per slot of 11 m and lap, so that no parked cars stand in each other.
    rng = np.random.default_rng([settings.seed, 2, lap])
    slots = int(length / 11)
    parked = np.arange(slots) * 11.0 + rng.uniform(0, 6, slots)
    parked_kind = rng.integers(0, len(world.cars), slots)
    is_parked = rng.random(slots) < 0.4
    parked, parked_kind = parked[is_parked], parked_kind[is_parked]
    rng = np.random.default_rng([settings.seed, 3])
    oncoming = max(1, int(length / 45))  # cars in the other lane
    driving = rng.uniform(0, length, oncoming) - rng.uniform(3, 7, oncoming) * time_s
    driving_kind = rng.integers(0, len(world.cars), oncoming)
    on_foot = int(length / 12)  # people on either pavement, either way
    walking = rng.uniform(0, length, on_foot) + rng.uniform(0.8, 1.6, on_foot) * rng.choice([-1, 1], on_foot) * time_s
    person_kind, side = rng.integers(0, len(world.people), on_foot), rng.choice([-4.2, 4.2], on_foot)

    axis, heading = axis_point(settings, np.concatenate([parked, driving, walking]))
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    lateral_m = np.concatenate([np.full(len(parked), -3.2), np.full(oncoming, 3.0), side])
    point = axis + left * lateral_m[:, None]

    shapes = _Shapes()
    cars = len(parked) + oncoming
    for i, kind in enumerate(np.concatenate([parked_kind, driving_kind])):
        way = ahead[i] if i < len(parked) else -ahead[i]
        body, end, glass = (int(t) for t in world.cars[kind])
        shapes.box(point[i], way, (4.2, 1.75, 0.75), 0.2, (body, end, end))
        shapes.box(point[i] - 0.2 * way, way, (2.3, 1.6, 0.55), 0.95, (glass, glass, end))
    for i, kind in enumerate(person_kind, start=cars):
        picture, outline = (int(t) for t in world.people[kind])
        across = 0.35 * (0.8 * left[i] + 0.6 * ahead[i])  # half a person's width, turned so that no view is edge-on
        shapes.wall(point[i] + across, point[i] - across, 0.0, 1.8, picture, outline)
    return shapes.quads()
