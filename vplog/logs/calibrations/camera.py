"""One camera of a calibration file, and the checked numbers that every kind of file is made of."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from vplog.data import Floats
from vplog.geometry import se3
from vplog.logs.messages.records import CalibrationMessage

_ROUNDED = 1e-3
"""Most that the rows of a rotation may be off from unit length and right angles: files have six digits."""
_MOST = 16
"""Numbers of a matrix or a lens model, at most."""


class BadCalibrationError(Exception):
    """A fault of a calibration, as it follows the name of the file."""


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """One camera of a calibration file."""

    name: str
    topic: str
    """Image topic, empty where the file has none."""
    calibration: CalibrationMessage
    from_first: Floats | None = None
    """(4, 4) this camera from the first one of the chain; None where the file has no chain."""
    body_from_camera: Floats | None = None
    """(4, 4) None where the file has none."""
    body_is_imu: bool = False
    """Whether that body is the IMU by the kind of the file, as in Kalibr's, and not what a data set takes for it."""
    timeshift_cam_imu_s: float = 0.0
    """s that the IMU's stamps are later than the camera's: Kalibr's t_imu = t_cam + shift."""
    depth_per_m: float | None = None
    """Counts of a metre in the camera's depth images; None where the file does not name it."""


def pinhole(
    focal: Floats, centre: Floats, size: tuple[int, int] = (0, 0), model: str = "", lens: Floats | None = None
) -> CalibrationMessage:
    """A calibration by focal lengths (2,) and principal point (2,) in px, size in px (0 unknown), and lens model."""
    matrix = np.array([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    return CalibrationMessage(0, "", *size, model, np.zeros(0) if lens is None else lens, matrix, np.zeros((3, 4)))


def rigid_of(value: Any) -> Floats:
    """(4, 4) of the sixteen numbers of a transform. Raises BadCalibrationError where it is not rigid."""
    values = matrix_of(value, 16).reshape(4, 4)
    turn = values[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > _ROUNDED or np.linalg.det(turn) < 0:
        raise BadCalibrationError("a transform in it is not rigid (a rotation and a translation)")
    u, _, v = np.linalg.svd(turn)  # the nearest rotation: digits were cut
    return se3.pose(u @ v, values[:3, 3])


def matrix_of(value: Any, count: int | None) -> Floats:
    """Row by row, from `data`, from a list of rows or from a flat list. Raises BadCalibrationError."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and value and all(isinstance(row, list) and len(row) <= _MOST for row in value[:_MOST]):
        value = [item for row in value[:_MOST] for item in row]
    return numbers_of(value, count)


def numbers_of(value: Any, count: int | None) -> Floats:
    """`count` finite numbers; up to 16 where None. Raises BadCalibrationError."""
    fits = isinstance(value, list) and (len(value) <= _MOST if count is None else len(value) == count)
    if not fits or not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e15 for x in value):
        raise BadCalibrationError(f"it has {reprlib.repr(value)[:40]} where {count or 'a few'} numbers are expected")
    return np.array(value, np.float64)


def text_of(value: Any) -> str:
    return value[:1000] if isinstance(value, str) else ""


def size_of(value: Any) -> int:
    """px of a side of an image. Raises BadCalibrationError."""
    if not isinstance(value, int | float) or not 0 <= value < 1e6:
        raise BadCalibrationError(f"{reprlib.repr(value)[:40]} is not an image size in px")
    return int(value)
