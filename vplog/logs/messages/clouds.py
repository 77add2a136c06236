"""Scans of a lidar: points and their times, from the fields that a point cloud names."""

from __future__ import annotations

import numpy as np

from vplog.data import Floats, Scan
from vplog.geometry import se3
from vplog.logs.messages.records import BadMessageError, CloudMessage

_TIMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time")
"""Fields with the time of a point: of Ouster, Velodyne, Hesai and RoboSense, Livox, as kiss-icp takes them."""
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""s, ms, us, ns."""
_SHORTEST_S, _LONGEST_S = 1e-3, 1.0
"""s that a scan takes at least, and less than: by this the unit of its times is known."""
_NEAR_S = 10.0
"""s that an absolute time is off the message's stamp at most; others are of another clock."""


def scan_of(cloud: CloudMessage, stamp_ns: int) -> Scan:
    """The points that are finite, at `stamp_ns`, the message's in the log's clock. Raises BadMessageError."""
    named = _columns(cloud)
    if any(axis not in named for axis in "xyz"):
        raise BadMessageError("it has no fields x, y and z")
    points = np.stack([named[axis].ravel() for axis in "xyz"], axis=1).astype(np.float64)
    if cloud.frame_from_cloud is not None:
        points = se3.transform(cloud.frame_from_cloud, points)
    finite = np.isfinite(points).all(axis=1)
    times = next((named[name] for name in _TIMES if name in named), None)
    seconds = None if times is None else _seconds(times.ravel()[finite].astype(np.float64), cloud.stamp_ns)
    return Scan(stamp_ns, points[finite], seconds)


def _columns(cloud: CloudMessage) -> dict[str, np.ndarray]:
    """(H, W) of every field, views of the message; of several fields of a name the first. Raises BadMessageError."""
    width, height, step = cloud.width, cloud.height, cloud.step
    row_step = cloud.row_step if height > 1 and cloud.row_step else width * step
    if row_step == height * width * step == len(cloud.data):  # of the whole cloud, as some drivers write it
        row_step = width * step
    if row_step < width * step or height * row_step > len(cloud.data):
        raise BadMessageError(f"{width} x {height} points of {step} bytes do not fit its {len(cloud.data)} bytes")
    found = {}
    for name, offset, kind in reversed(cloud.fields):
        if offset + np.dtype(kind).itemsize > step:
            raise BadMessageError(f"its field {name[:40]!r} lies beyond the {step} bytes of a point")
        shape = (height, width) if width and height else (0, 0)
        found[name] = np.ndarray(shape, np.dtype(kind), cloud.data, offset if shape[0] else 0, (row_step, step))
    return found


def _seconds(times: Floats, stamp_ns: int) -> Floats | None:
    """(K,) s since the stamp; None where all are equal, or the times are none."""
    if not len(times) or not np.isfinite(times).all():
        return None
    span = float(np.ptp(times))
    unit = next((one for one in _UNITS if _SHORTEST_S <= span * one < _LONGEST_S), None)
    if unit is None:
        return None
    first = float(times.min())
    if abs(first * unit) < _LONGEST_S:  # they count from the stamp
        return times * unit
    since = first * unit - stamp_ns / 1e9
    return (times - first) * unit + (since if abs(since) < _NEAR_S else 0.0)
