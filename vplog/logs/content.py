"""The one pass over the chosen topics: motion, fixes and calibration are kept, images only by stamp and place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.logs.containers import Notes, plural
from vplog.logs.losses import Runs
from vplog.logs.messages import (
    BadMessageError,
    CalibrationMessage,
    FixMessage,
    ImageMessage,
    PoseMessage,
    TransformMessage,
    decode,
    stamp_of,
)
from vplog.logs.moving import MovingFrames
from vplog.logs.odometry_message import read_odometry
from vplog.logs.stamps import NONE, Stamps, nearest, share_clock
from vplog.logs.tracks import FixTrack, PoseTrack
from vplog.logs.transforms import FrameTree

if TYPE_CHECKING:
    from vplog.data import Gps, Ints, Odometry
    from vplog.logs.containers import Channel, Container, Message, Place
    from vplog.logs.select import Selection


@dataclass(frozen=True)
class Content:
    """What the pass gives."""

    stamp_ns: Ints
    """(F,) of the images, increasing."""
    places: list[Place]
    """Where they lie."""
    stream: list[Place]
    """Where all messages of the images' topic lie, in the order of the file: a video decodes in that order alone."""
    stream_rows: Ints
    """(F,) which of them the images are."""
    depth_places: list[Place | None]
    """Where the depth image of each lies."""
    right_places: list[Place | None]
    """Where the right image of each lies."""
    calibration: CalibrationMessage | None
    right_calibration: CalibrationMessage | None
    odometry: Odometry | None
    frames: list[str]
    """Names of the odometry's frames, from the one that stands still to the body; empty names where it has none."""
    gps: Gps | None
    tree: FrameTree
    skew_ms: dict[str, float]
    """By topic: log time less header stamp, the median."""

    @property
    def body(self) -> str:
        """The frame that the odometry moves, empty where it has no name."""
        return self.frames[-1] if self.frames else ""


_TOGETHER_NS = 5_000_000
"""ns that the images of a pair may be apart: 5 cm at 10 m/s, a tenth of a usual baseline."""
_SMALL = 512
"""Bytes below which an image message may hold no image at all: header, frame and format take about 50."""


class _EmptyImageError(BadMessageError):
    """An image message without an image: cameras that lose a frame may log one."""


def _is_empty(message: Message) -> bool:
    """Raises BadMessageError."""
    record = decode(message.channel, message.data) if message.data else None
    return record is None or (isinstance(record, ImageMessage) and not record.data)


@dataclass
class _Images:
    """Stamps and places of one image topic."""

    channel: Channel | None
    stamps: Stamps = field(default_factory=Stamps)
    places: list[Place] = field(default_factory=list)
    stream: list[Place] = field(default_factory=list)
    """Of all messages, the empty and damaged ones too."""
    rows: list[int] = field(default_factory=list)
    """Which of `stream` the places are."""

    def add(self, message: Message) -> None:
        """Raises BadMessageError."""
        self.stream.append(message.place)
        if len(message.data) < _SMALL and _is_empty(message):
            raise _EmptyImageError
        self.stamps.add(stamp_of(message.channel, message.data), message.log_ns)
        self.places.append(message.place)
        self.rows.append(len(self.stream) - 1)

    def finish(self, notes: Notes) -> tuple[Ints, list[Place], Ints]:
        """Stamps and places of the images in order of time, and which of `stream` they are."""
        if self.channel is None:
            return NONE, [], NONE
        stamp_ns, rows = self.stamps.order(self.channel.topic, notes)
        return stamp_ns, [self.places[row] for row in rows.tolist()], np.array(self.rows, np.int64)[rows]


@dataclass
class _Pass:
    """What has been collected so far."""

    images: _Images
    depths: _Images
    rights: _Images
    right_info: Channel | None
    poses: PoseTrack | None
    fixes: FixTrack | None
    calibration: CalibrationMessage | None = None
    """The first one speaks for the drive."""
    right_calibration: CalibrationMessage | None = None
    transforms: list[TransformMessage] = field(default_factory=list)
    lost: dict[tuple[str, str], Runs] = field(default_factory=dict)
    """By reason and topic."""
    info: Channel | None = None
    tf: tuple[Channel, ...] = ()
    moving: MovingFrames = field(default_factory=lambda: MovingFrames(keep=False))

    def take(self, message: Message) -> None:
        """Add a message, or count it among the lost ones."""
        topic = message.channel.topic
        try:
            self.add(message)
        except BadMessageError as error:
            reason = "empty_image" if isinstance(error, _EmptyImageError) else "undecodable"
            self.lost.setdefault((reason, topic), Runs()).lost(message.log_ns)
            return
        for reason in ("empty_image", "undecodable") if self.lost else ():
            if (reason, topic) in self.lost:
                self.lost[reason, topic].sound()

    def stamps(self) -> list[Stamps]:
        """Of every topic that is followed over time."""
        images = [one.stamps for one in (self.images, self.depths, self.rights) if one.channel]
        return images + [one.stamps for one in (self.poses, self.fixes) if one]

    def skew_ms(self) -> dict[str, float]:
        """Log time less header stamp of each topic whose stamps follow a clock, the median."""
        timed = [(one.channel.topic, one.stamps) for one in (self.images, self.depths, self.rights) if one.channel]
        timed += [(one.topic, one.stamps) for one in (self.poses, self.fixes) if one]
        return {topic: clock.skew_ns / 1e6 for topic, stamps in timed if (clock := stamps.clock())}

    def add(self, message: Message) -> None:
        """Raises BadMessageError."""
        for images in (self.images, self.depths, self.rights):
            if message.channel == images.channel:
                images.add(message)
                return
        if (message.channel == self.right_info and self.right_calibration) or (
            message.channel == self.info and self.calibration
        ):
            return
        if self.poses and (odometry := read_odometry(message.channel, message.data)) is not None:
            self.poses.add(odometry, message.log_ns)
            return
        match decode(message.channel, message.data):
            case CalibrationMessage() as calibration if message.channel == self.right_info:
                self.right_calibration = self.right_calibration or calibration
            case CalibrationMessage() as calibration:
                self.calibration = self.calibration or calibration
            case PoseMessage() as pose if self.poses:
                self.poses.add(pose, message.log_ns)
            case FixMessage() as fix if self.fixes:
                self.fixes.add(fix, message.log_ns)
            case list() as transforms if message.channel in self.tf:
                self.moving.add(transforms, message.log_ns)
            case list() as transforms:
                self.transforms.extend(transforms)


def read_content(container: Container, chosen: Selection, notes: Notes) -> Content:
    """Read the chosen topics once; what had to be repaired or left out is noted."""
    read = _Pass(
        _Images(chosen.image),
        _Images(chosen.depth),
        _Images(chosen.right),
        chosen.right_info,
        PoseTrack(chosen.odometry.topic) if chosen.odometry and chosen.odometry not in chosen.tf else None,
        FixTrack(chosen.gps.topic) if chosen.gps else None,
        info=chosen.camera_info,
        tf=chosen.tf,
        moving=MovingFrames(keep=chosen.odometry in chosen.tf),
    )
    for message in container.messages(chosen.channels):
        read.take(message)
    for (reason, topic), runs in read.lost.items():
        notes.account.add(reason, {topic: runs.messages}, (topic, 0), runs.spans)
    share_clock(read.stamps())
    tree = FrameTree([*read.moving.still(), *read.transforms])
    if tree.dropped:
        notes.add(f"{plural(tree.dropped, 'static transform')} with NaN or without a rotation left out.")
    stamp_ns, places, rows = read.images.finish(notes)
    paired = []
    for name, images in (("depth", read.depths), ("right", read.rights)):
        other_ns, other_places, _ = images.finish(notes)
        pairs = nearest(stamp_ns, other_ns).tolist()
        paired.append([None if pair < 0 else other_places[pair] for pair in pairs])
        if images.channel and (alone := sum(pair < 0 for pair in pairs)):
            notes.add(f"{alone} of {plural(len(pairs), 'image')} without a {name} image within half a frame's time.")
        found = np.flatnonzero(np.array(pairs, np.int64) >= 0)
        late_ns = np.abs(other_ns[np.array(pairs, np.int64)[found]] - stamp_ns[found])
        if name == "right" and len(found) and (typical := float(np.median(late_ns))) > _TOGETHER_NS:
            notes.add(f"The right images are taken {typical / 1e6:.0f} ms off the left ones; motion spoils depth.")
    odometry = read.poses.finish(notes) if read.poses else None
    frames = [read.poses.parent, read.poses.child] if read.poses else []
    if chosen.odometry in chosen.tf and chosen.odometry is not None:
        odometry, frames = read.moving.odometry(tree, chosen.odometry.topic, notes)
    body = frames[-1] if frames else ""
    gps = read.fixes.finish(notes) if read.fixes else None
    if gps is not None and read.fixes and body and (placed := tree.between(body, read.fixes.frame)) is not None:
        gps = replace(gps, antenna_m=placed[:3, 3])
    return Content(
        stamp_ns, places, read.images.stream, rows, paired[0], paired[1], read.calibration, read.right_calibration,
        odometry, frames, gps, tree, read.skew_ms(),
    )  # fmt: skip
