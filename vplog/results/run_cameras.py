"""The cameras of a run: their records, and the pictures of each by its tables."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vplog.data import Camera, Floats, Ints, Keyframes
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.results import tables
from vplog.results.run_record import has_metres

_CAMERA: dict[str, Callable[[Any], Any]] = {
    "name": str, "distortion_model": str, "width": int, "height": int, "disparity_zero_px": float, "baseline_m": float,
    "matrix": lambda rows: np.array(rows, np.float64).reshape(3, 3),
    "distortion": lambda values: np.array(values, np.float64).reshape(-1),
    "body_from_camera": lambda rows: np.array(rows, np.float64).reshape(4, 4),
}  # fmt: skip
"""Fields of a camera, from plain values."""


def camera_from(values: dict[str, Any], again: str) -> Camera:
    """The camera of plain values. Raises ResultError, with the remedy `again`, where the values are not one."""
    try:
        known = {name: kind(values[name]) for name, kind in _CAMERA.items() if values[name] is not None}
        return Camera(**(dict[str, Any](matrix=None, baseline_m=None) | known))
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(f"The record of a camera is damaged: {error}. {again}") from None


def recorded_camera(record: dict[str, Any], number: int) -> Camera:
    """The camera that a run computed with, by its run.json and the camera's number: its matrix may be assumed, or left
    out where nothing is known of the motion. Raises ResultError."""
    known = record.get("calibrations")
    values = known[number] if isinstance(known, list) and 0 <= number < len(known) else None
    return camera_from(values if isinstance(values, dict) else {}, "Run it again.")


def unit_camera(record: dict[str, Any]) -> Floats | None:
    """body_from_camera (4, 4) of the camera whose path is in the unit of a run without metres, while its place on the
    body is in metres. None of a run in metres."""
    return None if has_metres(record) else recorded_camera(record, 0).body_from_camera


class CameraPictures(NamedTuple):
    """The pictures of one camera."""

    row: Ints
    """(V,) keyframe of each picture, increasing."""
    keyframes: Keyframes
    """Stamps of the V pictures, and the odometry's poses there."""


def camera_pictures(folder: Path, camera: int) -> CameraPictures:
    """The pictures of a camera of a run, by its number; of a further one in a condensed map those that it describes.
    Raises ResultError."""
    keyframes, _ = tables.read_keyframes(folder / "keyframes.parquet")
    if camera == 0:
        return CameraPictures(np.arange(len(keyframes.stamp_ns)), keyframes)
    described = folder / "descriptors.parquet"
    row, of = tables.read_pictures(described)
    row, stamp_ns = row[of == camera].astype(np.int64), tables.read_stamps(described)[of == camera]
    _, odometry = tables.read_trajectory(folder / "trajectory.parquet")
    if len(row) and not row[-1] < len(keyframes.stamp_ns):
        raise ResultError(f"{described} is damaged: it has pictures of keyframes that are not there. Run it again.")
    poses = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, stamp_ns)
    return CameraPictures(row, Keyframes(keyframes.drive, stamp_ns, poses))


def camera_topics(record: dict[str, Any]) -> list[str]:
    """The topics of a run's cameras by its run.json, the first one's first; one without a name where it names none."""
    names = record.get("cameras")
    return list(map(str, names)) if isinstance(names, list) and names else [""]
