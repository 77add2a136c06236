"""What result.mcap shows beside the tables: pictures, boxes, GPS, and what made it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vplog.data import Floats, Gps


@dataclass(frozen=True, eq=False)
class Explained:
    """Where the parts of one keyframe were found on the reference that explains it best.

    All places are shares of an image's sides, x0 y0 x1 y1.
    """

    references: Sequence[int]
    """Those that explain it, best first; the boxes are on the first."""
    windows: Floats
    """(I, 4) parts of the keyframe."""
    boxes: Floats
    """(I, 4) where each was found, NaN where it was not."""


@dataclass(frozen=True, eq=False)
class Earth:
    """Where on earth the trajectory's frame is."""

    origin: tuple[float, float, float]
    """Latitude and longitude in degrees and altitude in m, WGS84."""
    enu_from_world: Floats
    """(4, 4): from the trajectory's frame to m east, north and up of the origin."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What result.mcap shows beside the tables, all of it optional."""

    image: Callable[[int], bytes] | None = None
    """JPEG of a keyframe by its row."""
    image_size: tuple[int, int] = (0, 0)
    """Width and height in px of these JPEGs."""
    explained: Callable[[int], Explained | None] | None = None
    """By row of the keyframe."""
    references: Mapping[int, bytes] = field(default_factory=dict)
    """JPEG of a reference of the library by its number."""
    pictures: Mapping[int, bytes] = field(default_factory=dict)
    """JPEG of a candidate closure by its row in the ledger."""
    gps: Gps | None = None
    earth: Earth | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    """Versions, input hashes: what the file's metadata says beside the settings, as plain values by name."""
