"""Georeferences of the drives of a map, and boxes in degrees."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vplog.data import Floats
from vplog.results import mcap_read, run_record, tables
from vplog.results.geo import Earth, on_earth
from vplog.run.figures.run_figures import earth_of

Box = tuple[float, float, float, float]
"""South, west, north, east in degrees; west of more than east crosses the antimeridian."""


_DECIMALS = 7
"""Decimals of a degree, the last of which is a centimetre."""


def earth_of_run(folder: Path) -> Earth | None:
    """The georeference of a run: of its solve where it used GPS, else of the fixes in result.mcap; None without three.

    Raises ResultError where a file of the run is damaged.
    """
    known = run_record.read_run_json(folder / "run.json").get("gps")
    fixes = (
        mcap_read.read_fixes(folder / "result.mcap") if known is None and (folder / "result.mcap").is_file() else None
    )
    if known is None and fixes is None:
        return None
    trajectory, _ = tables.read_trajectory(folder / "trajectory.parquet")
    return earth_of(trajectory, fixes, known)


def earth_record(earth: Earth | None, world_from_body: Floats) -> dict[str, Any] | None:
    """Field `earth` of drive.json, with the bounds of poses (N, 4, 4): south, west, north, east in degrees."""
    if earth is None:
        return None
    record = {"origin": list(earth.origin), "enu_from_world": earth.enu_from_world.tolist()}
    if not len(world_from_body):
        return record
    where = on_earth(earth, world_from_body)[:, [1, 0]]
    return {**record, "bounds": np.round([*where.min(0), *where.max(0)], _DECIMALS).tolist()}


def bounds_of(record: Any) -> list[float] | None:
    """South, west, north, east by the field `earth` of drive.json; None where it has none."""
    bounds = record.get("bounds") if isinstance(record, dict) else None
    return bounds if isinstance(bounds, list) and len(bounds) == 4 and all(map(is_finite, bounds)) else None


def is_finite(value: Any) -> bool:
    """Whether a value of a record is a finite number."""
    return isinstance(value, float | int) and abs(value) <= sys.float_info.max


def earth_from_record(record: Any) -> Earth | None:
    """Inverse of `earth_record`; None where the record is not one."""
    try:
        origin, enu_from_world = np.array(record["origin"], np.float64), np.array(record["enu_from_world"], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    if origin.shape != (3,) or enu_from_world.shape != (4, 4) or not np.isfinite(enu_from_world).all():
        return None
    return Earth((float(origin[0]), float(origin[1]), float(origin[2])), enu_from_world)


def in_box(where: Floats, box: Box) -> NDArray[np.bool_]:
    """(N,) which of the longitudes and latitudes (N, 2+) in degrees are in the box, its edges included."""
    south, west, north, east = box
    longitude, latitude = where[:, 0], where[:, 1]
    along = (longitude >= west) & (longitude <= east) if west <= east else (longitude >= west) | (longitude <= east)
    return (latitude >= south) & (latitude <= north) & along
