"""ROS messages, CDR (ROS 2) and as ROS 1 packs them, their fields read where they lie.

By hand: rosbags' decoders take 20 us for three transforms where this takes 11, and 22 us for an image of 0.3 MB, which
they copy, where this takes 5.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from vplog.logs.messages.records import (
    BadMessageError,
    CalibrationMessage,
    FixMessage,
    ImageMessage,
    PoseMessage,
    nanoseconds,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Floats
    from vplog.logs.formats.container import Octets
    from vplog.logs.messages.records import Record

_UNKNOWN_COVARIANCE = 0
"""NavSatFix.COVARIANCE_TYPE_UNKNOWN."""
_ENCAPSULATION = 4
"""Bytes before a message in CDR: plain, big (0) or little (1) endian. Numbers are aligned to their size behind them."""


def decode_ros(kind: str, encoding: str, data: Octets) -> Record:
    """A record of type `sensor_msgs/Image` and so on; the bytes of images are a view of `data`. Raises BadMessageError,
    struct.error, ValueError (UnicodeDecodeError) or LookupError on damaged bytes."""
    fields = _Fields(data, encoding == "cdr")
    record = _READERS[kind](fields)
    fields.check_end()
    return record


class _Fields:
    """Reads the fields of a message in their order."""

    __slots__ = ("_at", "_cdr", "_data", "_order")

    def __init__(self, data: Octets, cdr: bool) -> None:
        if cdr and bytes(data[:2]) not in (b"\0\0", b"\0\1"):
            raise BadMessageError("its CDR encapsulation is not supported")
        self._data, self._cdr, self._at = data, cdr, _ENCAPSULATION if cdr else 0
        self._order = "<" if not cdr or data[1] else ">"

    def numbers(self, layout: str) -> tuple:
        """Numbers by a format of `struct`, in which none needs more alignment than the first."""
        fixed, size = _layout(self._order + layout)
        self._align(size)
        values = fixed.unpack_from(self._data, self._at)
        self._at += fixed.size
        return values

    def _align(self, size: int) -> None:
        if self._cdr:
            self._at += (_ENCAPSULATION - self._at) % size

    def octets(self) -> memoryview:
        """uint8[]."""
        (size,) = self.numbers("I")
        start, self._at = self._at, self._at + size
        if self._at > len(self._data):
            raise BadMessageError(f"its {len(self._data)} bytes are too few")
        return memoryview(self._data)[start : self._at]

    def text(self) -> str:
        """A string; those of CDR end with a zero."""
        raw = self.octets()
        return str(raw[:-1] if self._cdr else raw, "utf-8")

    def doubles(self) -> Floats:
        """float64[]."""
        (count,) = self.numbers("I")
        if count:
            self._align(8)
        values = np.frombuffer(self._data, f"{self._order}f8", count, self._at).astype(np.float64)
        self._at += 8 * count
        return values

    def stamp_ns(self) -> int:
        return nanoseconds(*self.numbers("iI" if self._cdr else "II"))

    def header(self) -> tuple[int, str]:
        """Stamp in ns and frame."""
        if not self._cdr:
            self._at += 4  # the sequence number
        return self.stamp_ns(), self.text()

    def check_end(self) -> None:
        """Raises BadMessageError where more follows than the padding of CDR."""
        if len(self._data) - self._at > (3 if self._cdr else 0):
            raise BadMessageError(f"its {len(self._data)} bytes are too many")


@cache
def _layout(layout: str) -> tuple[struct.Struct, int]:
    """The compiled format, and the size of its first number."""
    return struct.Struct(layout), struct.calcsize("=" + layout.lstrip("<>0123456789")[0])


def _image(fields: _Fields) -> Record:
    stamp_ns, frame = fields.header()
    (height, width), encoding = fields.numbers("2I"), fields.text()
    (big_endian,), (step,) = fields.numbers("B"), fields.numbers("I")
    return ImageMessage(stamp_ns, frame, encoding, fields.octets(), False, width, height, step, bool(big_endian))


def _compressed(fields: _Fields) -> Record:
    return ImageMessage(*fields.header(), fields.text(), fields.octets(), True)


def _packet(fields: _Fields) -> Record:
    """github.com/ros-misc-utilities/ffmpeg_image_transport_msgs."""
    stamp_ns, frame = fields.header()
    fields.numbers("2i")  # width, height
    encoding = fields.text()
    fields.numbers("Q")  # pts
    fields.numbers("2B")  # flags, is_bigendian
    return ImageMessage(stamp_ns, frame, encoding, fields.octets(), True)


def _video(fields: _Fields) -> Record:
    """docs.foxglove.dev/docs/sdk/schemas."""
    stamp_ns, frame, data = fields.stamp_ns(), fields.text(), fields.octets()
    return ImageMessage(stamp_ns, frame, fields.text(), data, True)


def _calibration(fields: _Fields) -> Record:
    """K and P are of the full image; roi says which part of it is sent, and binning how many px become one."""
    stamp_ns, frame = fields.header()
    (height, width), model, distortion = fields.numbers("2I"), fields.text(), fields.doubles()
    numbers = np.array(fields.numbers("30d"))
    k, r, p = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:].reshape(3, 4)
    binning_x, binning_y, left, top, roi_height, roi_width, _ = fields.numbers("6IB")
    x, y = max(binning_x, 1), max(binning_y, 1)
    # Pixel centres are whole numbers, so a pixel of n begins half a pixel before the first of them.
    window = np.array([[1 / x, 0.0, (0.5 - left) / x - 0.5], [0.0, 1 / y, (0.5 - top) / y - 0.5], [0.0, 0.0, 1.0]])
    k, p = (window @ matrix if matrix.any() else matrix for matrix in (k, p))
    size = (roi_width or width) // x, (roi_height or height) // y
    return CalibrationMessage(stamp_ns, frame, *size, model, distortion, k, p, r)


def _odometry(fields: _Fields) -> Record:
    (stamp_ns, frame), child = fields.header(), fields.text()
    numbers = fields.numbers("85d")  # pose and its covariance, twist and its own
    return PoseMessage(stamp_ns, frame, child, numbers[:3], numbers[3:7], numbers[7:43])


def _pose(fields: _Fields) -> Record:
    (stamp_ns, frame), numbers = fields.header(), fields.numbers("7d")
    return PoseMessage(stamp_ns, frame, "", numbers[:3], numbers[3:], None)


def _pose_with_covariance(fields: _Fields) -> Record:
    (stamp_ns, frame), numbers = fields.header(), fields.numbers("43d")
    return PoseMessage(stamp_ns, frame, "", numbers[:3], numbers[3:7], numbers[7:])


def _transform(fields: _Fields) -> PoseMessage:
    (stamp_ns, frame), child, numbers = fields.header(), fields.text(), fields.numbers("7d")
    return PoseMessage(stamp_ns, frame, child, numbers[:3], numbers[3:], None)


def _transforms(fields: _Fields) -> Record:
    return [_transform(fields) for _ in range(fields.numbers("I")[0])]


def _fix(fields: _Fields) -> Record:
    (stamp_ns, frame), (status,) = fields.header(), fields.numbers("b")
    fields.numbers("H")  # service
    latitude, longitude, altitude, *covariance, kind = fields.numbers("12dB")
    known = np.full((3, 3), np.nan) if kind == _UNKNOWN_COVARIANCE else np.array(covariance).reshape(3, 3)
    return FixMessage(stamp_ns, status >= 0, latitude, longitude, altitude, known, frame)


_READERS: dict[str, Callable[[_Fields], Record]] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed,
    "ffmpeg_image_transport_msgs/FFMPEGPacket": _packet,
    "foxglove_msgs/CompressedVideo": _video,
    "sensor_msgs/CameraInfo": _calibration,
    "nav_msgs/Odometry": _odometry,
    "geometry_msgs/PoseStamped": _pose,
    "geometry_msgs/PoseWithCovarianceStamped": _pose_with_covariance,
    "geometry_msgs/TransformStamped": _transform,
    "sensor_msgs/NavSatFix": _fix,
    "tf2_msgs/TFMessage": _transforms,
    "tf/tfMessage": _transforms,
}
