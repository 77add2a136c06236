"""Messages as ROS 1 packs them (wiki.ros.org/msg): little endian, without padding, strings behind their length."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s, Floats
    from vplog.logs.messages.records import CalibrationMessage

_UNKNOWN, _KNOWN = 0, 3
"""NavSatFix.COVARIANCE_TYPE_UNKNOWN and COVARIANCE_TYPE_KNOWN."""
_NO_ORIENTATION = np.array([0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8])
"""An Imu's orientation and its covariance, whose first number says that there is none."""


def header(stamp_ns: int, frame: str = "") -> bytes:
    return struct.pack("<3I", 0, *divmod(stamp_ns, 10**9)) + _text(frame)


def _text(text: str) -> bytes:
    return _octets(text.encode())


def _octets(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _doubles(*values: Floats | float) -> bytes:
    return b"".join(np.asarray(value, "<f8").tobytes() for value in values)


def compressed(stamp_ns: int, frame: str, kind: str, data: bytes) -> bytes:
    """sensor_msgs/CompressedImage."""
    return header(stamp_ns, frame) + _text(kind) + _octets(data)


def image(stamp_ns: int, frame: str, encoding: str, pixels: Bytes | Float32s) -> bytes:
    """sensor_msgs/Image of (H, W) pixels."""
    height, width = pixels.shape
    head = struct.pack("<2I", height, width) + _text(encoding) + struct.pack("<BI", 0, width * pixels.itemsize)
    return header(stamp_ns, frame) + head + _octets(pixels.tobytes())


def camera_info(stamp_ns: int, frame: str, known: CalibrationMessage) -> bytes:
    """sensor_msgs/CameraInfo without binning and of the whole image."""
    lens = struct.pack("<I", len(known.distortion)) + _doubles(known.distortion)
    size = struct.pack("<2I", known.height, known.width)
    numbers = _doubles(known.matrix, known.rotation, known.projection)
    return header(stamp_ns, frame) + size + _text(known.model) + lens + numbers + bytes(6 * 4 + 1)


def transforms(stamp_ns: int, parent: str, child: str, parent_from_child: Floats) -> bytes:
    """tf2_msgs/TFMessage with one transform (4, 4)."""
    turn = se3.quaternion(parent_from_child[:3, :3])
    placed = _doubles(parent_from_child[:3, 3], turn)
    return struct.pack("<I", 1) + header(stamp_ns, parent) + _text(child) + placed


def imu(stamp_ns: int, frame: str, gyro: Floats, acceleration: Floats) -> bytes:
    """sensor_msgs/Imu without orientation and covariances."""
    unknown = np.zeros(9)
    return header(stamp_ns, frame) + _doubles(_NO_ORIENTATION, gyro, unknown, acceleration, unknown)


def fix(stamp_ns: int, frame: str, place: tuple[float, float, float], covariance: Floats) -> bytes:
    """sensor_msgs/NavSatFix of latitude and longitude in degrees and altitude in m; the covariance NaN if unknown."""
    known = bool(np.isfinite(covariance).all())
    numbers = _doubles(np.array(place), covariance if known else np.zeros(9))
    return header(stamp_ns, frame) + struct.pack("<bH", 0, 0) + numbers + bytes([_KNOWN if known else _UNKNOWN])
