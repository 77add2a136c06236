"""One pass over a log: motion, fixes and calibrations are collected, images by stamp and offset."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np

from vplog.data import Ints
from vplog.errors import plural
from vplog.logs.formats.container import HEADER_BYTES, Channel, Message, Notes, Place, RawData
from vplog.logs.formats.loss_account import LossRuns
from vplog.logs.messages.decode import FRAME_ID_AT, decode, read_poses, stamp_of
from vplog.logs.messages.records import (
    BadMessageError,
    CalibrationMessage,
    FixesMessage,
    FixMessage,
    ImageMessage,
    ImuMessage,
    PathMessage,
    PoseMessage,
    Record,
    short_type,
)
from vplog.logs.stamps import NONE, Stamps, rate_hz
from vplog.logs.tf_odometry import DynamicTransforms
from vplog.logs.topic_selection import Selection
from vplog.logs.tracks import FixTrack, ImuTrack, PoseTrack

PARTS = ("lidar", "mask", "right", "depth", "image")
"""Topics of images and scans of a selection; what is several of them is the last."""
PATH = "nav_msgs/Path"
"""The type whose messages hold all poses up to then."""
_TOGETHER = 1024
"""Messages of odometry that are read at once: 0.7 MB, with which the calls to set up take no time."""


class _EmptyImageError(BadMessageError):
    """An image message without an image: cameras that lose a frame may log one."""


@dataclass
class Images:
    """Stamps and places of one image topic."""

    channel: Channel | None
    stamps: Stamps = field(default_factory=Stamps)
    places: list[Place] = field(default_factory=list)
    stream: list[Place] = field(default_factory=list)
    """Places of all messages, the empty and damaged ones too."""
    rows: list[int] = field(default_factory=list)
    """Rows of `stream` that the places are."""
    offset_ns: int = 0
    """ns to add to the stamps."""

    def add(self, message: Message, position: int) -> None:
        """Add a message. Raises BadMessageError."""
        channel, log_ns, data, place = message
        self.stream.append(place)
        if len(data) < HEADER_BYTES:
            record = decode(channel, data) if data else None
            if record is None or (isinstance(record, ImageMessage) and not record.data):
                raise _EmptyImageError
        self.stamps.add(stamp_of(channel, data), log_ns, position)
        self.places.append(place)
        self.rows.append(len(self.stream) - 1)

    def finish(self, notes: Notes) -> tuple[Ints, list[Place], Ints]:
        """Stamps and places of the images in order of time, and which of `stream` they are."""
        if self.channel is None:
            return NONE, [], NONE
        stamp_ns, rows = self.stamps.order(self.channel.topic, notes)
        places = [self.places[row] for row in rows.tolist()]
        return stamp_ns + self.offset_ns, places, np.array(self.rows, np.int64)[rows]


@dataclass
class Calibrations:
    """Calibrations of one topic that are set and differ from the one before."""

    channel: Channel
    found: list[CalibrationMessage] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    """Positions of those in the order of the file."""
    unset: int = 0
    """Messages before the first that is set."""
    _last: bytes = b""
    _first: CalibrationMessage | None = None

    def add(self, calibration: CalibrationMessage, data: RawData | Record, position: int) -> None:
        self._last = bytes(data[FRAME_ID_AT:]) if isinstance(data, bytes | memoryview) else b""
        self._first = self._first or calibration
        if not calibration.is_set:
            self.unset += not self.found
        elif not self.found or not self.found[-1].equals(calibration):
            self.found.append(calibration)
            self.positions.append(position)

    def repeats(self, data: RawData | Record) -> bool:
        """Whether a message of ROS is that before it but for its stamp."""
        if not self.found or self.channel.encoding not in ("cdr", "ros1"):
            return False
        return isinstance(data, bytes | memoryview) and data[FRAME_ID_AT:] == self._last

    def finish(self, images: Stamps, times: Stamps, notes: Notes) -> list[CalibrationMessage]:
        """The calibrations that are set; the first one where none is. Each with the stamp of the first of the `images`
        that it is of: the nearest by header stamps where these are of the images' clock, else by the log `times` of
        the topic."""
        if self.unset and self.found:
            notes.add(
                f"The first {plural(self.unset, 'calibration')} of {self.channel.topic} "
                f"{'is' if self.unset == 1 else 'are'} not set (K is zero or NaN); the first that is set is used."
            )
        stamp_ns, rows = images.order("", Notes())
        if not self.found or not len(rows):
            return self.found or ([self._first] if self._first else [])
        header_ns, log_ns = (np.array(one, np.int64)[rows] for one in (images.header_ns, images.log_ns))
        own_ns = np.array([one.stamp_ns for one in self.found], np.int64)
        logged_ns = np.array(times.log_ns, np.int64)[np.searchsorted(times.positions(), self.positions)]
        same_clock = (own_ns != 0) & (own_ns >= header_ns.min()) & (own_ns <= header_ns.max())
        first = np.where(same_clock, _nearest(header_ns, own_ns), _nearest(log_ns, logged_ns))
        return [replace(one, stamp_ns=at) for one, at in zip(self.found, stamp_ns[first].tolist(), strict=True)]


def _nearest(known_ns: Ints, wanted_ns: Ints) -> Ints:
    """(M,) rows of the nearest of (K,), which are in no order."""
    order = np.argsort(known_ns, kind="stable")
    ordered = known_ns[order]
    return order[np.searchsorted(ordered[:-1] + np.diff(ordered) // 2, wanted_ns)]


class TopicCollector:
    """Collects the messages of the topics of a selection."""

    def __init__(self, chosen: Selection) -> None:
        self.images = {part: Images(getattr(chosen, part)) for part in PARTS}
        for part in PARTS[1:]:
            self.images[part].offset_ns = chosen.image_offset_ns
        self.by_channel = {one.channel: one for one in self.images.values() if one.channel}
        self._calibrations = {
            one: Calibrations(one) for one in (chosen.camera_info, chosen.right_info, chosen.depth_info) if one
        }
        self.poses = {
            source: PoseTrack(source.topic, chosen.geometry.get(source, (1.0, 1.0)))
            for source in chosen.sources
            if source not in chosen.tf
        }
        """Tracks of the topics that may be the odometry."""
        self.fixes = FixTrack(chosen.gps.topic, chosen.gps_any_status) if chosen.gps else None
        self.imu = ImuTrack(chosen.imu)
        self._paths: dict[Channel, Message] = {}
        """The last message of each topic of paths, which holds those before it."""
        self.transforms: list[PoseMessage] = []
        self.dynamic = DynamicTransforms(store=any(source in chosen.tf for source in chosen.sources))
        self.lost: defaultdict[str, dict[str, LossRuns]] = defaultdict(dict)
        """Lost messages by topic, then by reason."""
        self._tf = chosen.tf
        self._waiting: defaultdict[Channel, list[tuple[bytes, int, int]]] = defaultdict(list)
        """Messages of odometry that are still to be added, their log times and their positions."""
        self._messages = 0
        """Read so far: the position of the next one in the order of the file."""
        self._others: defaultdict[Channel, Stamps] = defaultdict(Stamps)
        """Log times of the topics that are not followed over time."""

    def add(self, message: Message) -> None:
        """Add a message; odometry in batches."""
        channel, position = message.channel, self._messages
        self._messages += 1
        if channel in self.by_channel:
            self._add_message(message, position)
        elif channel in self.poses and short_type(channel.type) == PATH:
            self._paths[channel] = message._replace(data=bytes(message.data))
        elif channel in self.poses:
            waiting = self._waiting[channel]
            waiting.append((bytes(message.data), message.log_ns, position))
            if len(waiting) >= _TOGETHER:
                self._add_poses(channel)
        else:
            self._others[channel].add(0, message.log_ns, position)
            known = self._calibrations.get(channel)
            if not (known and known.repeats(message.data)):
                self._add_message(message, position)

    def finish_poses(self) -> None:
        """Add the messages of odometry, and fixes of NMEA, that wait."""
        for channel in list(self._waiting):
            self._add_poses(channel)
        for message in self._paths.values():
            self._add_message(message, self._messages)
        self.poses = {source: track.of_most() for source, track in self.poses.items()}
        if self.fixes:
            self.fixes.add_sentences()

    def _add_poses(self, channel: Channel) -> None:
        """Add those of one topic: at once where each is a pose, else one by one."""
        waiting = self._waiting.pop(channel)
        data, log_ns, positions = map(list, zip(*waiting, strict=True))
        found = read_poses(channel, data)
        if found is not None:
            self.poses[channel].add_all(found, log_ns, positions)
            self._sound(channel.topic)
        else:
            for one, time_ns, position in waiting:
                self._add_message(Message(channel, time_ns, one, ()), position)

    def _add_message(self, message: Message, position: int) -> None:
        """Add a message, or count it among the lost ones."""
        channel = message.channel
        try:
            if images := self.by_channel.get(channel):
                images.add(message, position)
            else:
                self._add(message, position)
        except BadMessageError as error:
            reason = "empty_image" if isinstance(error, _EmptyImageError) else "undecodable"
            self.lost[channel.topic].setdefault(reason, LossRuns()).add_lost(message.log_ns)
        else:
            self._sound(channel.topic)

    def _sound(self, topic: str) -> None:
        for runs in self.lost.get(topic, {}).values():
            runs.add_sound()

    def calibrations(self, channel: Channel | None, part: str, notes: Notes) -> list[CalibrationMessage]:
        """The calibrations of a channel, stamped as the images of this part."""
        known, images = self._calibrations.get(channel) if channel else None, self.images[part]
        found = known.finish(images.stamps, self._others[known.channel], notes) if known else []
        return [replace(one, stamp_ns=one.stamp_ns + images.offset_ns) for one in found]

    def stamps(self) -> list[tuple[str, Stamps]]:
        """Every topic that is followed over time, with its stamps."""
        images = [(one.channel.topic, one.stamps) for one in reversed(self.images.values()) if one.channel]
        tracks = (*self.poses.values(), self.fixes, self.imu)
        return images + [(one.topic, one.stamps) for one in tracks if one and one.topic]

    def shared_stamps(self) -> list[Stamps]:
        """Stamps of the odometry, which does not depend on the camera in use."""
        return [one.stamps for one in self.poses.values()]

    def every_stamps(self) -> list[Stamps]:
        """Stamps of every topic that was read, each pose with its position."""
        for track in self.poses.values():
            track.set_xyz()
        return [*(stamps for _, stamps in self.stamps()), *self._others.values(), *self.dynamic.stamps()]

    def clock_offset_ms(self) -> dict[str, float]:
        """Log time less header stamp of each topic whose stamps follow a clock, the median."""
        return {topic: offset / 1e6 for topic, stamps in self.stamps() if (offset := stamps.offset_ns()) is not None}

    def rates_hz(self) -> dict[Channel, float | None]:
        """Messages a second of each topic that was read, by its own times."""
        found = {channel: one.stamps for channel, one in (*self.by_channel.items(), *self.poses.items())}
        return {channel: rate_hz(stamps.order("", Notes())[0]) for channel, stamps in (found | self._others).items()}

    def _add(self, message: Message, position: int) -> None:
        """Raises BadMessageError."""
        channel = message.channel
        match decode(channel, message.data):
            case CalibrationMessage() as calibration if known := self._calibrations.get(channel):
                known.add(calibration, message.data, position)
            case PoseMessage() as pose if channel in self.poses:
                self.poses[channel].add(pose, message.log_ns, position)
            case PathMessage(stamp_ns, poses):
                late_ns = message.log_ns - stamp_ns
                for pose in poses:
                    self.poses[channel].add(pose, max(pose.stamp_ns + late_ns, 0), position)
            case ImuMessage() as imu:
                self.imu.add(imu, message.log_ns, position)
            case FixMessage() as fix if self.fixes:
                self.fixes.add(fix, message.log_ns, position)
            case FixesMessage(_, fixes) if self.fixes:
                for fix in fixes:
                    self.fixes.add(fix, message.log_ns, position)
            case list() as transforms if channel in self._tf:
                self.dynamic.add(transforms, message.log_ns, position)
            case list() as transforms:
                self.transforms += transforms
