"""Positions on the earth as metres in one plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vplog.data import Floats, Gps, Ints

_SEMI_MAJOR_M = 6_378_137.0
"""m, WGS84 (NIMA TR8350.2, table 3.1)."""
_FLATTENING = 1.0 / 298.257223563
"""WGS84 (NIMA TR8350.2, table 3.1)."""
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)


@dataclass(frozen=True, eq=False)
class LocalFixes:
    """T fixes in the plane of the first."""

    stamp_ns: Ints
    enu_m: Floats
    """(T, 3) east, north and up of the first."""
    covariance: Floats
    """(T, 3, 3) m^2 of the same axes, NaN where unknown."""
    origin: tuple[float, float, float]
    """Latitude and longitude in degrees and altitude in m of the first."""

    def __len__(self) -> int:
        return len(self.stamp_ns)


def local_enu(gps: Gps) -> LocalFixes:
    """The fixes that hold a position, about the first of them; none where none does.

    Exact: geodetic to earth-centred (NIMA TR8350.2, eq. 4-14), then rotated into the plane of the first fix.
    """
    values = np.stack([gps.latitude_deg, gps.longitude_deg, gps.altitude_m], axis=1)
    usable = np.isfinite(values).all(1) & (np.abs(values[:, 0]) <= 90.0) & (np.abs(values[:, 1]) <= 360.0)
    stamp_ns, values = gps.stamp_ns[usable], values[usable]
    if not len(values):
        return LocalFixes(stamp_ns, np.zeros((0, 3)), np.zeros((0, 3, 3)), (np.nan, np.nan, np.nan))
    latitude, longitude = np.radians(values[:, 0]), np.radians(values[:, 1])
    points = _earth_centred(latitude, longitude, values[:, 2])
    enu_m = (points - points[0]) @ _enu_from_earth(latitude[0], longitude[0]).T
    return LocalFixes(stamp_ns, enu_m, gps.covariance[usable], (values[0, 0], values[0, 1], values[0, 2]))


def _earth_centred(latitude: Floats, longitude: Floats, altitude_m: Floats) -> Floats:
    """(T, 3) m from the centre of the earth; angles in rad, altitude above the ellipsoid."""
    normal = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    x = (normal + altitude_m) * np.cos(latitude) * np.cos(longitude)
    y = (normal + altitude_m) * np.cos(latitude) * np.sin(longitude)
    return np.stack([x, y, (normal * (1.0 - _ECCENTRICITY_2) + altitude_m) * np.sin(latitude)], axis=1)


def geodetic(enu_m: Floats, origin: tuple[float, float, float]) -> Floats:
    """(T, 3) latitude and longitude in degrees and altitude in m of points in m east, north and up of the origin.

    The way back of `local_enu`: earth-centred, then to the ellipsoid by Bowring's formula (Survey Review 1976), which
    is exact to a micrometre within 10 km of the ground.
    """
    latitude, longitude = np.radians(origin[0]), np.radians(origin[1])
    at = _earth_centred(np.array([latitude]), np.array([longitude]), np.array([origin[2]]))[0]
    x, y, z = (enu_m @ _enu_from_earth(latitude, longitude) + at).T
    semi_minor = _SEMI_MAJOR_M * (1.0 - _FLATTENING)
    second_2 = _ECCENTRICITY_2 / (1.0 - _ECCENTRICITY_2)
    axis = np.hypot(x, y)
    reduced = np.arctan2(z * _SEMI_MAJOR_M, axis * semi_minor)
    lat = np.arctan2(
        z + second_2 * semi_minor * np.sin(reduced) ** 3,
        axis - _ECCENTRICITY_2 * _SEMI_MAJOR_M * np.cos(reduced) ** 3,
    )
    normal = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(lat) ** 2)
    # by the larger of both, so that neither pole nor equator divides by zero
    height = axis * np.cos(lat) + z * np.sin(lat) - normal * (1.0 - _ECCENTRICITY_2 * np.sin(lat) ** 2)
    return np.stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), height], axis=1)


def _enu_from_earth(latitude: float, longitude: float) -> Floats:
    """(3, 3) into the plane at a point; angles in rad."""
    sin_lat, cos_lat, sin_lon, cos_lon = (f(x) for x in (latitude, longitude) for f in (np.sin, np.cos))
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
