"""Positions on the earth as metres in one plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vplog.data import Floats, Gps, Ints

_SEMI_MAJOR_M = 6_378_137.0
"""m, WGS84 (NIMA TR8350.2, table 3.1)."""
_FLATTENING = 1.0 / 298.257223563
"""WGS84 (NIMA TR8350.2, table 3.1)."""
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)
_KRUEGER = (
    (1 / 2, -2 / 3, 5 / 16, 41 / 180, -127 / 288, 7891 / 37800),
    (0, 13 / 48, -3 / 5, 557 / 1440, 281 / 630, -1983433 / 1935360),
    (0, 0, 61 / 240, -103 / 140, 15061 / 26880, 167603 / 181440),
    (0, 0, 0, 49561 / 161280, -179 / 168, 6601661 / 7257600),
    (0, 0, 0, 0, 34729 / 80640, -3418889 / 1995840),
    (0, 0, 0, 0, 0, 212378941 / 319334400),
)
"""Coefficients of the powers 1..6 of the third flattening in Krueger's alpha_1..alpha_6 (Karney 2011, eq. 35)."""


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


def earth_centred(enu_m: Floats, origin: tuple[float, float, float]) -> Floats:
    """Return points (T, 3), given in m east, north and up of the origin (see `LocalFixes`), in m from the centre of the
    earth."""
    latitude, longitude = np.radians(origin[0]), np.radians(origin[1])
    at = _earth_centred(np.array([latitude]), np.array([longitude]), np.array([origin[2]]))
    return enu_m @ _enu_from_earth(latitude, longitude) + at


def geodetic(enu_m: Floats, origin: tuple[float, float, float]) -> Floats:
    """(T, 3) latitude and longitude in degrees and altitude in m of points in m east, north and up of the origin.

    The way back of `local_enu`: earth-centred, then to the ellipsoid by Bowring's formula (Survey Review 1976), which
    is exact to a micrometre within 10 km of the ground.
    """
    x, y, z = earth_centred(enu_m, origin).T
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


def utm_zone(longitude_deg: float, latitude_deg: float) -> int:
    """Number of the zone, 1..60: six degrees each from 180 W on, but wider in the south-west of Norway and on Svalbard
    (NGA.STND.0037, section 7-3)."""
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude_deg < 12.0:
        return 32
    if 72.0 <= latitude_deg < 84.0 and 0.0 <= longitude_deg < 42.0:
        return int(np.searchsorted([9.0, 21.0, 33.0], longitude_deg, side="right")) * 2 + 31
    return zone


def utm(latitude_deg: Floats, longitude_deg: Floats, zone: int) -> Floats:
    """(T, 2) easting and northing in m of UTM on WGS84; south of the equator, by the first point, northings are
    counted from 10,000 km south of it.

    Krueger's series to the sixth order of the third flattening, exact to nanometres within 3900 km of the meridian:
    Karney, Transverse Mercator with an accuracy of a few nanometers, Journal of Geodesy 85, 2011, eq. 7-9, 11-12, 35.
    """
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg - (6.0 * zone - 183.0))
    e = np.sqrt(_ECCENTRICITY_2)
    tau = np.tan(phi)
    sigma = np.sinh(e * np.arctanh(e * tau / np.hypot(1.0, tau)))
    tau = tau * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tau)
    xi, eta = np.arctan2(tau, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(tau, np.cos(lam)))
    n = _FLATTENING / (2.0 - _FLATTENING)
    j = 2.0 * np.arange(1, 7)[:, None]
    alpha = (np.array(_KRUEGER) * n ** np.arange(1, 7)).sum(axis=1)[:, None]
    north = xi + (alpha * np.sin(j * xi) * np.cosh(j * eta)).sum(axis=0)
    east = eta + (alpha * np.cos(j * xi) * np.sinh(j * eta)).sum(axis=0)
    radius_m = _SEMI_MAJOR_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0 + n**6 / 256.0)
    south = len(latitude_deg) > 0 and latitude_deg[0] < 0
    return np.column_stack([500e3 + 0.9996 * radius_m * east, 0.9996 * radius_m * north + (10e6 if south else 0.0)])
