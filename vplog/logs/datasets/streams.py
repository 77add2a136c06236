"""A published data set as streams of messages: the container that a recorder of the same sensors would have written."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import LogError
from vplog.logs.datasets import ros1
from vplog.logs.datasets.tables import numbers_of, rows_of, stamps_ns
from vplog.logs.formats.container import BRIEF, Channel, Contents, Message, by_topic
from vplog.logs.messages.pixels import scaled_depth_m
from vplog.logs.messages.records import BadMessageError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from vplog.data import Gps, Ints, Trajectory
    from vplog.logs.calibrations.camera import CalibratedCamera
    from vplog.logs.formats.container import Notes, Place

BODY = "base_link"
"""Frame of the body, by its name in ROS REP 105."""
_LATEST_NS = 2**32 * 10**9
"""ns; stamps of ROS 1 end in 2106."""


@dataclass(frozen=True, eq=False)
class Stream:
    """The messages of one topic."""

    channel: Channel
    stamp_ns: Ints
    """(K,) increasing or not."""
    message: Callable[[int], bytes]
    """The message of a row."""
    length: Callable[[int], int] | None = None
    """Bytes of a message without making it; None of small ones."""
    files: Sequence[Path] = ()
    """(K,) of images, where each message is a file."""


@dataclass(frozen=True, eq=False)
class DataSet:
    """One drive of a data set."""

    kind: str
    """`kitti`, `euroc`, `tum-rgbd`, `vslam-lab`, `colmap`, `utm-images` or `video`."""
    streams: list[Stream]
    truth: Trajectory | Gps | None = None
    """Poses of the body, or fixes."""
    remarks: list[str] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    """File of each image by its stamp, of pictures that are known by name."""


class DataSetContainer:
    """The streams of a data set as a `vplog.logs.formats.container.Container`."""

    def __init__(self, found: DataSet, notes: Notes) -> None:
        """Raises LogError where a stamp is out of range."""
        self._streams, self._truth, self._names = found.streams, found.truth, found.names
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
        return Contents(dict(sorted(counts.items())), *span_ns, self._truth, BODY, self._names, files)

    def messages(self, channels: Collection[Channel], brief: Collection[Channel] = ()) -> Iterator[Message]:
        """The messages in order of time."""
        numbers = [number for number, one in enumerate(self._streams) if one.channel in channels]
        at = [(int(ns), number, row) for number in numbers for row, ns in enumerate(self._streams[number].stamp_ns)]
        for stamp_ns, number, row in sorted(at):
            one = self._streams[number]
            length = 0 if one.length is None or one.channel not in brief else one.length(row)
            data = ros1.header(stamp_ns).ljust(BRIEF, b"\0") if length >= BRIEF else one.message(row)
            yield Message(one.channel, stamp_ns, data, (number, row))

    def read(self, place: Place) -> bytes:
        return self._streams[place[0]].message(place[1])


def camera_streams(
    topic: str, stamp_ns: Ints, files: Sequence[Path], camera: CalibratedCamera | None, damaged: Collection[Path] = ()
) -> list[Stream]:
    """Image files as they are, with the calibration of their camera and its place on the body. Files that are not
    there, or damaged, make messages without an image."""
    channel = Channel(topic, "sensor_msgs/CompressedImage", "ros1")

    def message(row: int) -> bytes:
        data = b"" if files[row] in damaged else _bytes_of(files[row])
        return ros1.compressed(int(stamp_ns[row]), topic, files[row].suffix[1:].lower(), data)

    def length(row: int) -> int:
        return 0 if files[row] in damaged else _length_of(files[row])

    return [Stream(channel, stamp_ns, message, length, files), *calibration_streams(topic, topic, stamp_ns, camera)]


def calibration_streams(topic: str, frame: str, stamp_ns: Ints, camera: CalibratedCamera | None) -> list[Stream]:
    """The calibration of an image topic and the static transform to its frame, where they are known."""
    if camera is None or not len(stamp_ns):
        return []
    known, first = camera.calibration, stamp_ns[:1]
    info = Channel(f"{topic}/camera_info", "sensor_msgs/CameraInfo", "ros1")
    found = [Stream(info, first, lambda row: ros1.camera_info(int(first[row]), frame, known))]
    if camera.body_from_camera is not None:
        message = ros1.transforms(int(first[0]), BODY, frame, camera.body_from_camera)
        found.append(Stream(Channel("tf_static", "tf2_msgs/TFMessage", "ros1"), first, lambda _: message))
    return found


def depth_stream(topic: str, stamp_ns: Ints, files: Sequence[Path], per_m: float, frame: str) -> Stream:
    """16-bit PNGs with `per_m` counts of a metre, registered to the images of `frame`."""

    def message(row: int) -> bytes:
        try:
            metres = scaled_depth_m(_bytes_of(files[row]), per_m)
        except BadMessageError:
            metres = np.zeros((0, 0), np.float32)
        return ros1.image(int(stamp_ns[row]), frame, "32FC1", metres)

    def length(row: int) -> int:
        return _length_of(files[row])

    return Stream(Channel(topic, "sensor_msgs/Image", "ros1"), stamp_ns, message, length)


def imu_stream(topic: str, table: Path) -> Stream:
    """Rates in rad/s and accelerations in m/s^2 of the body: a stamp in ns and six numbers a line. Raises LogError."""
    rows = rows_of(table, 7)
    stamp_ns, values = stamps_ns(table, [row[0] for row in rows], 1), numbers_of(table, rows, 1, 6)
    channel = Channel(topic, "sensor_msgs/Imu", "ros1")
    return Stream(channel, stamp_ns, lambda row: ros1.imu(int(stamp_ns[row]), BODY, values[row, :3], values[row, 3:]))


def fix_stream(topic: str, gps: Gps) -> Stream:
    """Satellite fixes."""
    channel = Channel(topic, "sensor_msgs/NavSatFix", "ros1")
    return Stream(channel, gps.stamp_ns, partial(_fix, gps))


def _fix(gps: Gps, row: int) -> bytes:
    place = gps.latitude_deg[row], gps.longitude_deg[row], gps.altitude_m[row]
    return ros1.fix(int(gps.stamp_ns[row]), BODY, place, gps.covariance[row])


def _bytes_of(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError:
        return b""


def _length_of(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0
