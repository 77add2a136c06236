"""Satellite fixes as truth: positions only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.errors import TruthError
from vplog.evaluate.trajectory import Ate, aligned_error

if TYPE_CHECKING:
    from vplog.data import Floats, Gps, Ints, Trajectory

_SEMI_MAJOR_M = 6_378_137.0
"""m, WGS84 (NIMA TR8350.2, table 3.1)."""
_FLATTENING = 1.0 / 298.257223563
"""WGS84 (NIMA TR8350.2, table 3.1)."""


def local_enu(gps: Gps) -> tuple[Ints, Floats]:
    """Stamps and positions (T, 3) in m east, north and up of the first fix, without fixes that hold no position.

    Exact: geodetic to earth-centred (NIMA TR8350.2, eq. 4-14), then rotated into the plane of the first fix.
    Raises TruthError where no fix holds a position.
    """
    values = np.stack([gps.latitude_deg, gps.longitude_deg, gps.altitude_m], axis=1)
    usable = np.isfinite(values).all(1) & (np.abs(values[:, 0]) <= 90.0) & (np.abs(values[:, 1]) <= 360.0)
    if not usable.any():
        raise TruthError(f"None of the {len(values)} GPS fixes holds a position. Give a TUM file with --truth.")
    stamp_ns, values = gps.stamp_ns[usable], values[usable]
    latitude, longitude = np.radians(values[:, 0]), np.radians(values[:, 1])
    points = _earth_centred(latitude, longitude, values[:, 2])
    sin_lat, cos_lat, sin_lon, cos_lon = (f(x[0]) for x in (latitude, longitude) for f in (np.sin, np.cos))
    enu_from_earth = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return stamp_ns, (points - points[0]) @ enu_from_earth.T


def _earth_centred(latitude: Floats, longitude: Floats, altitude_m: Floats) -> Floats:
    """(T, 3) m from the centre of the earth; angles in rad, altitude above the ellipsoid."""
    eccentricity_2 = _FLATTENING * (2.0 - _FLATTENING)
    normal = _SEMI_MAJOR_M / np.sqrt(1.0 - eccentricity_2 * np.sin(latitude) ** 2)
    return np.stack(
        [
            (normal + altitude_m) * np.cos(latitude) * np.cos(longitude),
            (normal + altitude_m) * np.cos(latitude) * np.sin(longitude),
            (normal * (1.0 - eccentricity_2) + altitude_m) * np.sin(latitude),
        ],
        axis=1,
    )


def ate_to_gps(estimate: Trajectory, gps: Gps) -> Ate:
    """ATE of the estimate, interpolated at the fixes, after a rigid alignment; the antenna's offset is not known.

    Raises TruthError where fewer than three fixes lie within the estimate.
    """
    stamp_ns, positions = local_enu(gps)
    if len(estimate.stamp_ns) < 2:
        raise TruthError("The estimated trajectory has fewer than 2 poses, so it cannot be compared with GPS.")
    if not np.isfinite(estimate.world_from_body).all():
        raise TruthError("The estimated trajectory holds a pose that is not finite.")
    inside = (stamp_ns >= estimate.stamp_ns[0]) & (stamp_ns <= estimate.stamp_ns[-1])
    if inside.sum() < 3:
        raise TruthError(f"Only {inside.sum()} of {len(inside)} GPS fixes lie within the drive; 3 are needed.")
    poses = geometry.interpolate_at(estimate.stamp_ns, estimate.world_from_body, stamp_ns[inside])
    return aligned_error(poses[:, :3, 3], positions[inside])
