"""Georeferences of the drives of a map, and boxes in degrees."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vplog.data import Floats, Gps, Ints
from vplog.errors import ResultError, SettingsError, plural
from vplog.results import mcap_read, run_record, tables
from vplog.results.geo import Earth, on_earth
from vplog.results.run_cameras import unit_camera
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
    record = run_record.read_run_json(folder / "run.json")
    known = record.get("gps")
    fixes = (
        mcap_read.read_fixes(folder / "result.mcap") if known is None and (folder / "result.mcap").is_file() else None
    )
    if known is None and fixes is None:
        return None
    trajectory, _ = tables.read_trajectory(folder / "trajectory.parquet")
    return earth_of(trajectory, fixes, known, unit_camera(record))


def earth_record(earth: Earth | None, world_from_body: Floats) -> dict[str, Any] | None:
    """Field `earth` of drive.json, with the bounds of poses (N, 4, 4): south, west, north, east in degrees."""
    if earth is None:
        return None
    record = {"origin": list(earth.origin), "enu_from_world": earth.enu_from_world.tolist()}
    record |= {"point": earth.point.tolist()} if earth.point.any() else {}
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
        known = {"point": np.zeros(3), **record}
        origin, enu_from_world, point = (
            np.array(known[name], np.float64) for name in ("origin", "enu_from_world", "point")
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    if (origin.shape, enu_from_world.shape, point.shape) != ((3,), (4, 4), (3,)):
        return None
    if not np.isfinite([*enu_from_world.flat, *point]).all():
        return None
    return Earth((float(origin[0]), float(origin[1]), float(origin[2])), enu_from_world, point)


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


class DriveBounds:
    """Where each drive of a map is on earth."""

    def __init__(self, drives: Mapping[str, Mapping[str, Any]]) -> None:
        """`drives` are records by name."""
        self.names = list(drives)
        nowhere = [math.nan] * 4
        found = [bounds_of(record.get("earth")) or nowhere for record in drives.values()]
        self._bounds = np.array(found, np.float64).reshape(-1, 4)

    def within(self, wanted: Sequence[str], box: Box | None, name: str) -> tuple[Ints, list[str]]:
        """Numbers of the drives that are wanted, all of them if none is, and may have places in a box; and warnings.

        A drive whose place on earth is not known is in no box. Raises SettingsError where the map of this name has no
        such drive, and ResultError where none is left.
        """
        if unknown := set(wanted).difference(self.names) if wanted else set():
            raise SettingsError(f"{name} has no drive {min(unknown)!r}. `vplog map info {name}` names them.")
        chosen = np.flatnonzero(np.isin(self.names, wanted)) if wanted else np.arange(len(self.names))
        if box is None:
            return chosen, []
        bounds = self._bounds[chosen]
        within, unplaced = chosen[_overlap(bounds, box)], int(np.isnan(bounds[:, 0]).sum())
        without = f"{plural(unplaced, 'drive')} of {len(chosen)} without a place on earth."
        if not len(within):
            raise ResultError(f"No drive of {name} is in the box that is searched; {without}")
        return within, [f"Not searched: {without}"] if unplaced else []

    def near(self, number: int, radius_m: float) -> NDArray[np.bool_]:
        """(N,) which drives may be within `radius_m` of one. Drives without a georeference may be near to any."""
        south, west, north, east = self._bounds[number].tolist()
        if math.isnan(south):
            return np.ones(len(self.names), bool)
        return np.isnan(self._bounds[:, 0]) | _overlap(self._bounds, box_around(south, west, north, east, radius_m))


def _overlap(bounds: Floats, box: Box) -> NDArray[np.bool_]:
    """(N,) which bounds (N, 4) meet the box; those of NaN meet none."""
    south, west, north, east = box
    parts = [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
    along = np.logical_or.reduce([(bounds[:, 1] <= b) & (bounds[:, 3] >= a) for a, b in parts])
    return (bounds[:, 0] <= north) & (bounds[:, 2] >= south) & along
