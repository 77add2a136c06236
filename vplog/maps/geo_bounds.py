"""Georeferences of the drives of a map, and boxes in degrees."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vplog.data import Floats, Gps
from vplog.errors import ResultError, SettingsError, plural
from vplog.results import mcap_read, run_record, tables
from vplog.results.geo import Earth, on_earth
from vplog.run.figures.run_figures import earth_of

Box = tuple[float, float, float, float]
"""South, west, north, east in degrees; west of more than east crosses the antimeridian."""


_M_PER_DEG = 110_574.0
"""Least metres of a degree of latitude, at the equator of WGS84: boxes around a point are rather too large."""
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


def box_around(south: float, west: float, north: float, east: float, radius_m: float) -> Box:
    """The box grown by metres to each side; from pole to pole and all around where it meets a pole."""
    up = radius_m / _M_PER_DEG
    south, north = max(south - up, -90.0), min(north + up, 90.0)
    along = up / max(math.cos(math.radians(max(-south, north))), 1e-9)
    if east - west + 2.0 * along >= 360.0:
        return south, -180.0, north, 180.0
    return south, (west - along + 180.0) % 360.0 - 180.0, north, (east + along + 180.0) % 360.0 - 180.0


def box_of_fixes(gps: Gps | None, radius_m: float, name: str) -> Box:
    """The box of a log's fixes, grown by metres. Raises ResultError where it has none."""
    if gps is None or not len(gps.stamp_ns):
        raise ResultError(f"{name} has no satellite fixes to search near. Give a point: --near LAT,LON,M.")
    latitude, longitude = gps.latitude_deg, gps.longitude_deg
    return box_around(latitude.min(), longitude.min(), latitude.max(), longitude.max(), radius_m)


def drives_within(
    drives: Mapping[str, Mapping[str, Any]], wanted: Sequence[str], box: Box | None, name: str
) -> tuple[list[str], list[str]]:
    """The drives of a map that are wanted, all of them if none is, and may have places in a box; and warnings.

    A drive whose place on earth is not known is not in any box. Raises SettingsError where the map has no drive of such
    a name, and ResultError where none is left.
    """
    if unknown := [drive for drive in wanted if drive not in drives]:
        raise SettingsError(f"{name} has no drive {unknown[0]!r}. `vplog map info {name}` names them.")
    chosen, warnings = [drive for drive in drives if not wanted or drive in wanted], list[str]()
    if box is None:
        return chosen, warnings
    bounds = {drive: bounds_of(drives[drive].get("earth")) for drive in chosen}
    within = [drive for drive, own in bounds.items() if own is not None and _overlap(own, box)]
    unplaced = sum(own is None for own in bounds.values())
    without = f"{plural(unplaced, 'drive')} of {len(chosen)} without a place on earth."
    if not within:
        raise ResultError(f"No drive of {name} is in the box that is searched; {without}")
    return within, [f"Not searched: {without}"] if unplaced else []


def _overlap(bounds: Sequence[float], box: Box) -> bool:
    south, west, north, east = box
    parts = [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
    return bounds[0] <= north and bounds[2] >= south and any(bounds[1] <= b and bounds[3] >= a for a, b in parts)
