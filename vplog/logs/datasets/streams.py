"""A published data set as streams of messages: the container that a recorder of the same sensors would have written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from stat import S_ISREG

import numpy as np

from vplog.data import Bytes, Float32s, Floats, Gps, Ints, Trajectory
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.calibrations.camera import CalibratedCamera
from vplog.logs.cameras import BODY
from vplog.logs.datasets.text_tables import numbers_of, rows_of, stamps_ns, table_unit_ns
from vplog.logs.formats.container import HEADER_BYTES, Channel, Contents, Message, Notes, Place, by_topic
from vplog.logs.messages.pixels import scaled_depth_m
from vplog.logs.messages.records import (
    BadMessageError,
    CalibrationMessage,
    FixMessage,
    ImageMessage,
    ImuMessage,
    PoseMessage,
    Record,
)

_MOST_BYTES = 2**29
"""Length of an image, four times that of the largest uncompressed ones."""
_LATEST_NS = 2**32 * 10**9
"""ns; stamps of ROS 1 end in 2106."""


@dataclass(frozen=True, eq=False)
class Stream:
    """The messages of one topic."""

    channel: Channel
    stamp_ns: Ints
    """(K,) increasing or not."""
    message: Callable[[int], Record]
    """The message of a row."""
    length: Callable[[int], int] | None = None
    """Bytes of a message without making it; None of small ones."""
    files: Sequence[Path] = ()
    """(K,) of images, where each message is a file."""


@dataclass(frozen=True, eq=False)
class DataSet:
    """One drive of a data set."""

    kind: str
    """`kitti`, `euroc`, `tum-rgbd`, `vslam-lab`, `colmap`, `utm-images`, `stereo-images` or `video`."""
    streams: list[Stream]
    truth: Trajectory | Gps | None = None
    """Poses of the body, or fixes."""
    remarks: list[str] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    """File of each image by its stamp, of pictures that are known by name."""
    assumed_times: bool = False
    """As in `Contents`."""


class DataSetContainer:
    """The streams of a data set as a `vplog.logs.formats.container.Container`."""

    def __init__(self, found: DataSet, notes: Notes) -> None:
        """Raises LogError where a stamp is out of range."""
        self._streams, self._truth, self._names = found.streams, found.truth, found.names
        self._assumed_times = found.assumed_times
        for remark in found.remarks:
            notes.add(remark)
        for one in found.streams:
            if len(one.stamp_ns) and (one.stamp_ns.min() < 0 or one.stamp_ns.max() >= _LATEST_NS):
                raise LogError(f"The stamps of {one.channel.topic} lie outside 1970 to 2106; are they in another unit?")
        contents = self.contents()
        notes.account.set_recorded(found.kind, by_topic(contents.counts), contents.start_ns, contents.end_ns)

    def contents(self) -> Contents:
        counts: Counter[Channel] = Counter()
        for one in self._streams:
            counts[one.channel] += len(one.stamp_ns)
        stamps = np.concatenate([one.stamp_ns for one in self._streams] or [np.zeros(0, np.int64)])
        span_ns = (int(stamps.min()), int(stamps.max())) if len(stamps) else (0, 0)
        files = {
            one.channel.topic: dict(zip(one.stamp_ns.tolist(), map(str, one.files), strict=True))
            for one in self._streams
            if one.files
        }
        return Contents(
            dict(sorted(counts.items())), *span_ns, self._truth, BODY, self._names, files, self._assumed_times
        )

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        """The messages in order of time."""
        numbers = [number for number, one in enumerate(self._streams) if one.channel in channels]
        at = [(int(ns), number, row) for number in numbers for row, ns in enumerate(self._streams[number].stamp_ns)]
        for stamp_ns, number, row in sorted(at):
            one = self._streams[number]
            length = 0 if one.length is None or one.channel not in header_only else one.length(row)
            data = ImageMessage(stamp_ns, "", "", bytes(1), True) if length >= HEADER_BYTES else one.message(row)
            yield Message(one.channel, stamp_ns, data, (number, row))

    def read(self, place: Place) -> Record:
        return self._streams[place[0]].message(place[1])


def camera_streams(
    topic: str, stamp_ns: Ints, files: Sequence[Path], camera: CalibratedCamera | None, damaged: Collection[Path] = ()
) -> list[Stream]:
    """Image files as they are, with the calibration of their camera and its place on the body. Files that are not
    there, or damaged, make messages without an image."""
    channel = Channel(topic, "sensor_msgs/CompressedImage", "ros1")

    def message(row: int) -> ImageMessage:
        data = b"" if files[row] in damaged else _bytes_of(files[row])
        return ImageMessage(int(stamp_ns[row]), topic, files[row].suffix[1:].lower(), data, True)

    def length(row: int) -> int:
        return 0 if files[row] in damaged else _length_of(files[row])

    found, first = [Stream(channel, stamp_ns, message, length, files)], stamp_ns[:1]
    if camera is not None and len(first):
        found.append(calibration_stream(topic, first, [camera.calibration]))
        if camera.body_from_camera is not None:
            found.append(mount_stream(topic, first, camera.body_from_camera))
    return found


def mount_stream(topic: str, stamp_ns: Ints, body_from_camera: Floats) -> Stream:
    """The place (4, 4) on the body of the camera of an image topic, at each stamp."""
    turn, shift = se3.quaternion(body_from_camera[:3, :3]).tolist(), body_from_camera[:3, 3].tolist()
    channel = Channel("tf_static", "tf2_msgs/TFMessage", "ros1")
    return Stream(channel, stamp_ns, lambda row: [PoseMessage(int(stamp_ns[row]), BODY, topic, shift, turn, None)])


def calibration_stream(topic: str, stamp_ns: Ints, known: Sequence[CalibrationMessage]) -> Stream:
    """The calibration of an image topic at each stamp."""
    channel = Channel(f"{topic}/camera_info", "sensor_msgs/CameraInfo", "ros1")
    return Stream(channel, stamp_ns, lambda row: replace(known[row], stamp_ns=int(stamp_ns[row]), frame=topic))


def depth_stream(topic: str, stamp_ns: Ints, files: Sequence[Path], per_m: float, frame: str) -> Stream:
    """16-bit PNGs with `per_m` counts of a metre, registered to the images of `frame`."""

    def message(row: int) -> ImageMessage:
        try:
            metres = scaled_depth_m(_bytes_of(files[row]), per_m)
        except BadMessageError:
            metres = np.zeros((0, 0), np.float32)
        return raw_image(int(stamp_ns[row]), frame, "32FC1", metres)

    channel = Channel(topic, "sensor_msgs/Image", "ros1")
    return Stream(channel, stamp_ns, message, lambda row: _length_of(files[row]))


def imu_stream(topic: str, table: Path) -> Stream:
    """Rates in rad/s and accelerations in m/s^2 of the body: a stamp, in ns unless the first line names another
    unit, and six numbers a line. Raises LogError."""
    rows = rows_of(table, 7)
    stamp_ns = stamps_ns(table, [row[0] for row in rows], table_unit_ns(table))
    values = numbers_of(table, rows, 1, 6)
    channel = Channel(topic, "sensor_msgs/Imu", "ros1")

    def message(row: int) -> ImuMessage:
        return ImuMessage(int(stamp_ns[row]), BODY, *values[row].reshape(2, 3).tolist())

    return Stream(channel, stamp_ns, message)


def fix_stream(topic: str, gps: Gps) -> Stream:
    """Satellite fixes."""

    def message(row: int) -> FixMessage:
        place = float(gps.latitude_deg[row]), float(gps.longitude_deg[row]), float(gps.altitude_m[row])
        return FixMessage(int(gps.stamp_ns[row]), True, *place, gps.covariance[row], BODY)

    return Stream(Channel(topic, "sensor_msgs/NavSatFix", "ros1"), gps.stamp_ns, message)


def raw_image(stamp_ns: int, frame: str, encoding: str, pixels: Bytes | Float32s) -> ImageMessage:
    """An image of (H, W) pixels."""
    height, width = pixels.shape
    return ImageMessage(stamp_ns, frame, encoding, pixels.tobytes(), False, width, height)


def _bytes_of(file: Path) -> bytes:
    """Empty of what cannot be read, is no file, as a pipe, or longer than an image is."""
    try:
        about = file.stat()
        return file.read_bytes() if S_ISREG(about.st_mode) and about.st_size <= _MOST_BYTES else b""
    except OSError:
        return b""


def _length_of(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0
