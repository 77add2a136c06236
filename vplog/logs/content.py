"""The one pass over the chosen topics: motion, fixes and calibration are kept, images only by stamp and place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from vplog.logs.containers import Notes, plural
from vplog.logs.messages import (
    BadMessageError,
    CalibrationMessage,
    FixMessage,
    PoseMessage,
    TransformMessage,
    decode,
    stamp_of,
)
from vplog.logs.stamps import NONE, Stamps, nearest
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
    depth_places: list[Place | None]
    """Where the depth image of each lies."""
    calibration: CalibrationMessage | None
    odometry: Odometry | None
    body: str
    """The frame that the odometry moves, empty where it has no name."""
    gps: Gps | None
    tree: FrameTree


@dataclass
class _Images:
    """Stamps and places of one image topic."""

    channel: Channel | None
    stamps: Stamps = field(default_factory=Stamps)
    places: list[Place] = field(default_factory=list)

    def add(self, message: Message) -> None:
        self.stamps.add(stamp_of(message.channel, message.data), message.log_ns)
        self.places.append(message.place)

    def finish(self, notes: Notes) -> tuple[Ints, list[Place]]:
        if self.channel is None:
            return NONE, []
        stamp_ns, rows = self.stamps.order(self.channel.topic, notes)
        return stamp_ns, [self.places[row] for row in rows.tolist()]


@dataclass
class _Pass:
    """What has been collected so far."""

    images: _Images
    depths: _Images
    poses: PoseTrack | None
    fixes: FixTrack | None
    calibration: CalibrationMessage | None = None
    """The first one speaks for the drive."""
    transforms: list[TransformMessage] = field(default_factory=list)

    def add(self, message: Message) -> None:
        """Raises BadMessageError."""
        for images in (self.images, self.depths):
            if message.channel == images.channel:
                images.add(message)
                return
        match decode(message.channel, message.data):
            case CalibrationMessage() as calibration:
                self.calibration = self.calibration or calibration
            case PoseMessage() as pose if self.poses:
                self.poses.add(pose, message.log_ns)
            case FixMessage() as fix if self.fixes:
                self.fixes.add(fix, message.log_ns)
            case list() as transforms:
                self.transforms.extend(transforms)


def read_content(container: Container, chosen: Selection, notes: Notes) -> Content:
    """Read the chosen topics once; what had to be repaired or left out is noted."""
    read = _Pass(
        _Images(chosen.image),
        _Images(chosen.depth),
        PoseTrack(chosen.odometry.topic) if chosen.odometry else None,
        FixTrack(chosen.gps.topic) if chosen.gps else None,
    )
    damaged: dict[str, int] = {}
    for message in container.messages(chosen.channels):
        try:
            read.add(message)
        except BadMessageError:
            topic = message.channel.topic
            damaged[topic] = damaged.get(topic, 0) + 1
    for topic, count in sorted(damaged.items()):
        notes.add(f"{topic}: {plural(count, 'message')} that cannot be decoded left out.")
    tree = FrameTree(read.transforms)
    if tree.dropped:
        notes.add(f"{plural(tree.dropped, 'static transform')} with NaN or without a rotation left out.")
    stamp_ns, places = read.images.finish(notes)
    depth_ns, depth_places = read.depths.finish(notes)
    pairs = nearest(stamp_ns, depth_ns).tolist()
    if chosen.depth and (alone := sum(pair < 0 for pair in pairs)):
        notes.add(f"{alone} of {plural(len(pairs), 'image')} without a depth image within half a frame's time.")
    odometry = read.poses.finish(notes) if read.poses else None
    body = read.poses.child if read.poses else ""
    gps = read.fixes.finish(notes) if read.fixes else None
    if gps is not None and read.fixes and body and (placed := tree.between(body, read.fixes.frame)) is not None:
        gps = replace(gps, antenna_m=placed[:3, 3])
    paired = [None if pair < 0 else depth_places[pair] for pair in pairs]
    return Content(stamp_ns, places, paired, read.calibration, odometry, body, gps, tree)
