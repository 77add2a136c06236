"""Images named by their place in UTM, as the benchmarks of visual geo-localisation publish them (Berton et al., Deep
Visual Geo-localization Benchmark, CVPR 2022)."""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import NamedTuple

FORM = "@ east @ north @ zone @ letter @ latitude @ longitude @ panorama @ tile @ heading @ ... @.jpg"
"""In m and degrees; behind the heading are pitch, roll, height, time and a note."""


class UtmName(NamedTuple):
    """The columns of a name: NaN or empty where it lacks one."""

    east: float
    """m."""
    north: float
    """m."""
    zone: str
    letter: str
    """The band of latitude, or N and S."""
    latitude_deg: float
    longitude_deg: float
    panorama: str
    tile: str
    heading_deg: float
    height_m: float
    time: str


def utm_name(path: str) -> UtmName | None:
    """None where the file's name holds no position."""
    columns = [column.strip() for column in PurePosixPath(path).name.split("@")[1:-1]] + [""] * 13
    named = UtmName(
        _number(columns[0]), _number(columns[1]), columns[2], columns[3],
        _number(columns[4]), _number(columns[5]), columns[6], columns[7], _number(columns[8]),
        _number(columns[11]), columns[12],
    )  # fmt: skip
    return named if math.isfinite(named.east + named.north) else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
