"""The one pass over the chosen topics: motion, fixes and calibration as arrays, images by stamp and place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from vplog.data import Floats, Gps, Ints, Odometry, OdometrySource
from vplog.errors import LogError, plural
from vplog.logs.continuity import without_jumps
from vplog.logs.formats.container import Channel, Container, Contents, Notes, Place
from vplog.logs.gather import TopicCollector
from vplog.logs.messages.records import CalibrationMessage
from vplog.logs.odometry_sources import choose_odometry, other_sources, rank_sources, read_sources
from vplog.logs.recorder_clock import correct_clock_steps
from vplog.logs.stamps import nearest, set_common_clock
from vplog.logs.tf_odometry import BODIES, FrameTree
from vplog.logs.topic_selection import Selection


@dataclass(frozen=True)
class LogContent:
    """The result of the pass."""

    stamp_ns: Ints
    """(F,) of the images, increasing."""
    places: list[Place]
    """Places of the images in the container."""
    stream: list[Place]
    """Places of all messages of the images' topic, in the order of the file: a video decodes in that order alone."""
    stream_rows: Ints
    """(F,) which of them the images are."""
    scan_ns: Ints
    """(L,) of the lidar's scans, increasing."""
    scan_places: list[Place]
    companions: dict[str, list[Place | None]]
    """Places of the `depth` and `right` images and of the `mask` of each."""
    calibrations: list[CalibrationMessage]
    """Calibrations that are set and differ from the one before: the first is the camera's, a later one that of images
    behind its stamp."""
    right_calibration: CalibrationMessage | None
    right_ns: Ints
    """(F,) stamps of the right images, -1 for none."""
    right_notes: Notes
    """Remarks on the right images, for where they make a pair."""
    depth_calibration: CalibrationMessage | None
    odometry: Odometry | None
    frames: list[str]
    """Names of the odometry's frames, from the one that stands still to the body; empty names where it has none."""
    gps: Gps | None
    imu: tuple[str, Ints, Floats] | None
    """Frame, stamps (K,), and (K, 6) rates in rad/s and accelerations in m/s^2 of the IMU beside images that give the
    odometry."""
    tree: FrameTree
    clock_offset_ms: dict[str, float]
    """By topic: log time less header stamp, the median."""
    chosen: Selection
    """With the source that the odometry was taken from."""
    sources: list[OdometrySource]
    """Sources that could be the odometry, the best first."""
    rates_hz: dict[Channel, float | None]
    """By topic that was read: messages a second."""

    @property
    def calibration(self) -> CalibrationMessage | None:
        """The camera's."""
        return next(iter(self.calibrations), None)

    @property
    def body(self) -> str:
        """The frame that the odometry moves, empty where it has no name."""
        return self.frames[-1] if self.frames else ""

    def between(self, start_s: float | None, stop_s: float | None) -> LogContent:
        """With the images from `start_s` up to `stop_s`, s after the first; all if None. Raises LogError for none."""
        if start_s is None and stop_s is None:
            return self
        since_s = (self.stamp_ns - self.stamp_ns[:1]) / 1e9
        inside = (since_s >= (start_s or 0.0)) & (since_s < (np.inf if stop_s is None else stop_s))
        if len(inside) and not inside.any():
            raise LogError(f"No image is left by --start and --stop: the last one is at {since_s[-1]:.1f} s.")
        return self.with_images(inside)

    def with_images(self, wanted: np.ndarray) -> LogContent:
        """With those of the images for which (F,) `wanted` is true."""
        places = list(compress(self.places, wanted))
        companions = {part: list(compress(found, wanted)) for part, found in self.companions.items()}
        return replace(
            self, stamp_ns=self.stamp_ns[wanted], places=places, stream_rows=self.stream_rows[wanted],
            companions=companions, right_ns=self.right_ns[wanted],
        )  # fmt: skip


_TOGETHER_NS = 5_000_000
"""ns that the images of a pair may be apart: 5 cm at 10 m/s, a tenth of a usual baseline."""


def read_content(container: Container, contents: Contents, chosen: Selection, notes: Notes) -> LogContent:
    """Read the chosen topics once; what had to be repaired or left out is noted."""
    read = TopicCollector(chosen)
    stamped = [channel for channel in read.by_channel if channel.encoding in ("cdr", "ros1")]
    for message in container.messages(chosen.channels, stamped):
        read.add(message)
    read.finish_poses()
    correct_clock_steps(read.every_stamps(), notes)
    set_common_clock((stamps for _, stamps in read.stamps()), read.shared_stamps())
    gps_notes = Notes()
    gps = read.fixes.finish(gps_notes) if read.fixes else None
    found = read_sources(read, chosen) | other_sources(gps, contents, chosen)
    sources = rank_sources(found, read.images["image"].finish(Notes())[0])
    rates_hz = read.rates_hz()
    static, source = read.dynamic.static(), choose_odometry(sources, chosen, notes)
    chosen = chosen.with_odometry(source, bool(static), source is None or found[source].kind == "twist")
    sources = [(replace(one, used=known == source), known) for one, known in sources]
    read.poses = {source: track for source, track in read.poses.items() if source == chosen.odometry}
    topics = {channel.topic for channel in chosen.channels}
    for topic, lost in read.lost.items():
        for reason, runs in lost.items() if topic in topics else ():
            notes.account.add(reason, {topic: runs.messages}, (topic, 0), runs.spans)
    tree = FrameTree([*static, *read.transforms])
    if tree.dropped:
        notes.add(f"{plural(tree.dropped, 'static transform')} with NaN or without a rotation left out.")
    stamp_ns, places, rows = read.images["image"].finish(notes)
    scan_ns, scan_places, _ = read.images["lidar"].finish(notes)
    companions, right_ns, right_notes = _companions(read, stamp_ns, notes)
    for one in found.values():
        if one.odometry is None:
            notes.extend(one.notes)
    odometry, frames = None, []
    if chosen.odometry is not None:
        odometry, frames = found[chosen.odometry].odometry, found[chosen.odometry].frames
        notes.extend(found[chosen.odometry].notes)
        if odometry is not None and odometry.drifts:
            odometry = without_jumps(odometry, chosen.odometry.topic, notes)
    body = frames[-1] if frames else ""
    notes.extend(gps_notes)
    placed = tree.between(body or BODIES[0], read.fixes.frame) if read.fixes else None
    if gps is not None and placed is not None:
        gps = replace(gps, antenna_m=placed[:3, 3])
    imu = (read.imu.frame, *read.imu.finish(notes)) if chosen.imu is not None and odometry is None else None
    calibrations = read.calibrations(chosen.camera_info, "image", notes)
    right_calibration = next(iter(read.calibrations(chosen.right_info, "right", right_notes)), None)
    depth_calibration = next(iter(read.calibrations(chosen.depth_info, "depth", notes)), None)
    return LogContent(
        stamp_ns, places, read.images["image"].stream, rows, scan_ns, scan_places, companions, calibrations,
        right_calibration, right_ns, right_notes, depth_calibration, odometry, frames, gps, imu, tree,
        read.clock_offset_ms(), chosen, [source for source, _ in sources], rates_hz,
    )  # fmt: skip


def _companions(
    read: TopicCollector, stamp_ns: Ints, notes: Notes
) -> tuple[dict[str, list[Place | None]], Ints, Notes]:
    """Places of the `depth`, `right` and `mask` of each image (F,), and stamps of and remarks on the right ones."""
    companions, right_ns, right_notes = {}, np.full(len(stamp_ns), -1, np.int64), Notes()
    for name in ("depth", "right", "mask"):
        remarks = right_notes if name == "right" else notes
        other_ns, other_places, _ = read.images[name].finish(remarks)
        pairs = nearest(stamp_ns, other_ns)
        companions[name] = [None if pair < 0 else other_places[pair] for pair in pairs.tolist()]
        if read.images[name].channel and (alone := int((pairs < 0).sum())):
            remarks.add(f"{alone} of {plural(len(pairs), 'image')} without a {name} image within half a frame period.")
        both = pairs >= 0
        if name == "right":
            right_ns[both] = other_ns[pairs[both]]
            late_ns = np.abs(right_ns - stamp_ns)[both]
            if len(late_ns) and (typical := float(np.median(late_ns))) > _TOGETHER_NS:
                right_notes.add(
                    f"The right images are taken {typical / 1e6:.0f} ms off the left ones; depth is wrong in motion."
                )
    return companions, right_ns, right_notes
