"""A Log over any container: topics are chosen when it is opened, everything else is read when it is first used."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from vplog.data import Bytes, Camera, Floats, Gps, Imu, Ints, Lidar, LogInfo, Odometry, Scan, Topic, Trajectory
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.calibration_file import SidecarFiles, named_for
from vplog.logs.cameras import BODY, body_from_camera, camera_of, optical_frame
from vplog.logs.content import LogContent, read_content
from vplog.logs.depth_registration import DepthRegistration, registration_of
from vplog.logs.formats.container import Channel, Container, Contents, Notes
from vplog.logs.formats.loss_account import TopicLoss
from vplog.logs.formats.ros2_folder import messages_unpacked
from vplog.logs.frames import ImageReader, RecordedFrame
from vplog.logs.masks import masks_of
from vplog.logs.messages.records import CalibrationMessage
from vplog.logs.odometry_sources import PROPERTIES, is_truth
from vplog.logs.rectification import (
    CHECKED_FRAMES,
    MOST_TURN_RAD,
    NoPairError,
    Pair,
    Side,
    pair_of,
)
from vplog.logs.scans import ScanReader
from vplog.logs.stamps import rows_of
from vplog.logs.topic_candidates import read_candidates
from vplog.logs.topic_selection import (
    MOST_TOPICS,
    Candidate,
    Selection,
    TopicChoice,
    further_cameras,
    select,
    wheel_options,
)

_SAME_VIEW_RAD, _SAME_VIEW_M = np.radians(5.0), 1.0
"""Turn and distance of two cameras below which they see the same: as far as those of a stereo head."""
_LISTED = 8
"""Topics that an error lists."""


class RecordedLog:
    """A drive in a container, as `vplog.stages.Log`."""

    is_one_drive: bool = False
    """Controls uncalibrated image files of different sizes. True for a drive whose motion may be computed: the images
    are brought to the size of the first. False: each image keeps its size. A calibration always needs one size, and a
    recorded topic is of one camera."""

    def __init__(
        self, path: Path, name: str, kind: str, container: Container, notes: Notes, choice: TopicChoice
    ) -> None:
        self.name, self.account = name, notes.account
        self._path, self._kind, self._notes = path, kind, notes
        self._contents: Contents = container.contents().with_image_offset(choice.image_offset_ns)
        self._container = messages_unpacked(container, self._contents, notes)
        self._candidates = read_candidates(self._container, self._contents)
        if (count := len(self._candidates)) > MOST_TOPICS:
            notes.add(
                f"{path.name} has {count} topics that can be used; the {MOST_TOPICS} with the most messages are "
                "considered. Choose others by their names, for example with --image-topic."
            )
        self._by_channel = {candidate.channel: candidate for candidate in self._candidates}
        self._sidecar = SidecarFiles(choice, notes)
        self._choice = choice = self._sidecar.choice
        self._selection = select(self._candidates, choice, path.name)
        if self._sidecar.has_pair:
            self._selection = replace(self._selection, right_info=None)
        topics = {c.channel.topic: self._contents.files.get(c.channel.topic, {}) for c in self._candidates}
        self._masks = masks_of(choice.masks, topics, self._selection.image, self._selection.right)

    @property
    def warnings(self) -> list[str]:
        return self._notes.lines

    @property
    def losses(self) -> list[TopicLoss]:
        """Losses counted so far; complete once the log was read."""
        return self.account.losses

    def summary(self) -> tuple[int, float]:
        """Images of the camera and s, as the index of the container has them: no message is read."""
        contents, image = self._contents, self._selection.image
        return 0 if image is None else contents.counts[image], (contents.end_ns - contents.start_ns) / 1e9

    def info(self) -> LogInfo:
        """Reads the chosen topics once, so that the warnings are complete."""
        content = self._content
        others = self.further_cameras()
        parts = content.chosen.parts
        if self._selection.image is not None and self._check_images():
            parts = {channel: part for channel, part in parts.items() if not part.startswith("right")}
        topics = [
            self._topic(channel, count, parts.get(channel) or ("image" if channel.topic in others else ""))
            for channel, count in self._contents.counts.items()
        ]
        tracks = [track for track in (content, content.odometry, content.gps) if track and len(track.stamp_ns)]
        start_ns = min((int(track.stamp_ns[0]) for track in tracks), default=self._contents.start_ns)
        end_ns = max((int(track.stamp_ns[-1]) for track in tracks), default=self._contents.end_ns)
        return LogInfo(
            str(self._path), self._kind, start_ns, end_ns, self._contents.messages, topics, self.warnings,
            [frame for frame in content.frames if frame], content.clock_offset_ms, content.sources, self._truth_name,
        )  # fmt: skip

    def _topic(self, channel: Channel, count: int, part: str) -> Topic:
        rate_hz, known = self._content.rates_hz.get(channel), self._candidate(channel) or Candidate(channel, count, "")
        calibrated = known.calibrated if known.role == "camera_info" else None
        return Topic(
            *channel, count, known.role, bool(part), part, known.encoding, *known.size, known.frame, calibrated, rate_hz
        )

    def _candidate(self, channel: Channel | None) -> Candidate | None:
        return None if channel is None else self._by_channel.get(channel)

    def stamps(self) -> Ints:
        self._image_channel()
        return self._content.stamp_ns

    def frames(self, stamp_ns: Ints) -> Iterator[RecordedFrame]:
        """Raises LogError where a stamp is not one of `stamps()`."""
        content, images, pair, camera = self._content, self._images, self._pair, self.camera()
        registration = self._depth[1] if self._depth else None
        own_size = bool(self._contents.names) and camera.matrix is None and not self.is_one_drive
        for row in rows_of(content.stamp_ns, stamp_ns, self.name):
            at_ns, image = int(content.stamp_ns[row]), images.image(row)
            depth = images.companion("depth", row) if self._depth else None
            right = images.companion("right", row) if pair else None
            mask = images.companion("mask", row) or self._masks[0].of(at_ns)
            right_mask = self._masks[1].of(int(content.right_ns[row])) if right else None
            later = bisect_right(self._later_calibrations, at_ns, key=lambda calibration: calibration.stamp_ns)
            own = self._later_calibrations[later - 1] if later else None
            beside = depth, right, pair, self._notes, own, mask, right_mask, registration, own_size
            yield RecordedFrame(at_ns, camera, image, *beside)

    def file_names(self) -> list[str] | None:
        names = self._contents.names
        return [names[stamp_ns] for stamp_ns in self.stamps().tolist()] if names else None

    @property
    def assumed_times(self) -> bool:
        """As `Contents.assumed_times`."""
        return self._contents.assumed_times

    def odometry(self) -> Odometry | None:
        return self._sidecar.odometry or self._content.odometry

    def further_cameras(self) -> list[str]:
        choice, body = self._choice, self._body or BODY
        if choice.cameras is not None or choice.image is not None:
            return list(choice.cameras or ())
        tree, used = self._content.tree, self._candidate(self._selection.image)
        found, frames = list[str](), [used.frame] if used else []
        for c, left in further_cameras(self._candidates, self._selection, choice, self._notes):
            if left is not None and not self._are_apart(left.frame, c.frame):
                continue
            if tree.between(body, c.frame) is None:
                self._notes.add(
                    f"{c.channel.topic} is calibrated but not used: no static transforms lead from {body} to its frame "
                    f"{c.frame}. Take it with a further --image-topic, its mount from --calibration."
                )
            elif not self._is_same_view(frames, c.frame):
                found.append(c.channel.topic)
                frames.append(c.frame)
        return found

    def _is_same_view(self, frames: list[str], frame: str) -> bool:
        """Whether a camera looks the way of one of the others from beside it, as KITTI's colour ones: it costs as much
        and sees nothing else."""
        between = (self._content.tree.between(other, frame) for other in frames)
        return any(
            found is not None and se3.angle(found) < _SAME_VIEW_RAD and np.linalg.norm(found[:3, 3]) < _SAME_VIEW_M
            for found in between
        )

    def _are_apart(self, left: str, right: str) -> bool:
        """Whether two cameras, a pair by their names, look to two sides."""
        turned = self._content.tree.between(left, right)
        return turned is not None and float(se3.angle(turned)) > MOST_TURN_RAD

    def has_depth(self) -> bool:
        return self._pair is not None or self._depth is not None

    def lidar(self) -> Lidar | None:
        return None if self._sidecar.odometry is not None else self._scans.lidar(self._selection.image is not None)

    def scans(self, stamp_ns: Ints) -> Iterator[Scan]:
        """Raises LogError where a stamp is not one of the lidar's."""
        return self._scans.scans(stamp_ns, self.name)

    @cached_property
    def _scans(self) -> ScanReader:
        return ScanReader(self._container, self._content, self._notes)

    @property
    def _body(self) -> str:
        """Frame of the body, empty where nothing names it."""
        return self._content.body or self._scans.body

    def gps(self) -> Gps | None:
        """Without the place of its antenna where a calibration file, and not the odometry, says what the body is."""
        gps, channel = self._content.gps, self._content.chosen.image
        known = None if channel is None else self._sidecar.camera(channel.topic)
        by_file = known is not None and known.body_from_camera is not None and not self._content.body
        return replace(gps, antenna_m=None) if gps is not None and by_file else gps

    def imu(self) -> Imu | None:
        """By the static transforms, else the calibration file; noted where neither places it."""
        content = self._content
        if content.imu is None or content.chosen.imu is None or self.odometry() is not None:
            return None
        (camera, camera_frame), (frame, stamp_ns, values) = self._left, content.imu
        topic, placed = content.chosen.imu.topic, content.tree.between(camera_frame, frame)
        known = self._sidecar.camera(self._image_channel().topic)
        if placed is None and known is not None and known.body_from_camera is not None:
            placed = se3.inverse(known.body_from_camera)
            self._notes.add(f"{topic} is taken to be the IMU of the calibration.")
        finite = np.isfinite(values).all(axis=1) & values[:, 3:].any(axis=1)  # zero of a gyroscope alone
        if placed is None or not finite.any():
            why = (
                "the static transforms do not place it beside the camera"
                if placed is None
                else "it does not measure both turns and accelerations"
            )
            self._notes.add(f"{topic}: {why}; visual odometry does without its measurements.")
            return None
        if known is not None and known.timeshift_cam_imu_s:
            stamp_ns = stamp_ns - round(known.timeshift_cam_imu_s * 1e9)
            self._notes.add(f"{topic} is shifted by its calibration's {known.timeshift_cam_imu_s * 1e3:.1f} ms.")
        gyro, accel = values[finite, :3], values[finite, 3:]
        return Imu(topic, stamp_ns[finite], gyro, accel, camera.body_from_camera @ placed)

    def _body_from_calibrated_imu(self) -> Floats:
        """(4, 4) of the IMU that a calibration file has as the body, by the static transforms; else, noted where an
        odometry moves another frame, the identity."""
        if self.odometry() is None:
            return np.eye(4)
        body = self._body or BODY
        imus = [c for c in self._candidates if c.role == "imu" and self._choice.imu in (None, c.channel.topic)]
        for one in sorted(imus, key=lambda c: -c.count):
            if one.frame and (placed := self._content.tree.between(body, one.frame)) is not None:
                self._notes.add(f"The calibration's IMU is taken to be that of {one.channel.topic}.")
                return placed
        self._notes.add(f"No static transforms place an IMU on {body}; the calibration's IMU is taken to be {body}.")
        return np.eye(4)

    def truth(self) -> Trajectory | Gps | None:
        """Ground truth of the data set, else the poses of a topic that is called ground truth."""
        if self._contents.truth is not None or not self._truth_name:
            return self._contents.truth
        chosen = select(self._candidates, TopicChoice(odometry=self._truth_name), self._path.name)
        found = read_content(self._container, self._contents, chosen, Notes()).odometry
        return None if found is None else found.trajectory

    @cached_property
    def _truth_name(self) -> str:
        """The kind of truth: poses or positions of the data set, or the first topic that is called ground truth."""
        if (known := self._contents.truth) is not None:
            return f"{len(known.stamp_ns)} {'poses' if isinstance(known, Trajectory) else 'positions'} of the data set"
        named = (c.channel.topic for c in self._candidates if c.role == "odometry" and c.count)
        return min(filter(is_truth, named), default="")

    def without_odometry(self) -> str:
        """Ways out where there is none: the sources that are not taken by themselves, and files."""
        content = self._content
        given = [f"--odometry {source.topic}: {PROPERTIES[source.kind]}" for source in content.sources]
        wheels = [c.channel for c in self._candidates if c.count]
        given += [f"{needs} make odometry of {one.topic}" for one in wheels if (needs := wheel_options(one))]
        given += ["--odometry visual takes the images to be a drive"] if self._selection.image else []
        clouds = [c.channel.topic for c in self._candidates if c.role == "lidar" and c.count]
        given += [f"--odometry lidar takes it from {clouds[0]}"] if clouds else []
        return "; ".join([*given, "--odometry-file takes poses from a file; `vplog library` needs none"]) + "."

    def _check_images(self) -> bool:
        """Note everything that decoding the first image and depth would warn of, for info; whether depth is used, which
        needs no right images."""
        try:
            self.camera()
            return self._depth is not None
        except LogError as error:
            self._notes.add(str(error))
            return False

    def _image_channel(self) -> Channel:
        if self._selection.image is None:
            names = list(dict.fromkeys(channel.topic for channel in self._contents.counts))
            listed = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
            depth = [c.channel.topic for c in self._candidates if c.role == "depth" and c.encoding.startswith("16UC1")]
            hint = f" If {depth[0]} is a thermal camera's, take it with --image-topic {depth[0]}." if depth else ""
            raise LogError(f"No camera images in {self._path.name}. Topics: {listed or 'none'}.{hint}")
        if not len(self._content.stamp_ns):
            raise LogError(f"No image of {self._selection.image.topic} can be read. Choose another with --image-topic.")
        return self._selection.image

    @cached_property
    def _later_calibrations(self) -> list[CalibrationMessage]:
        """Calibrations that replace the camera's, by stamp: an autofocus lens has one for every image."""
        if self._sidecar.camera(self._image_channel().topic) is not None:
            return []
        return sorted(self._content.calibrations[1:], key=lambda calibration: calibration.stamp_ns)

    @cached_property
    def _depth(self) -> tuple[Channel, DepthRegistration | None] | None:
        """The depth topic, and its registration where it is another camera's; None, with a note, where the camera is
        not calibrated, or its first images do not decode or do not fit the camera's."""
        depth, camera = self._selection.depth, self._left[0]
        try:
            first = None if depth is None else self._images.first_depth(depth)
            if first is None or depth is None:
                return None
            if camera.matrix is None:  # metres beside an assumed focal length, whose motion is in a unit
                raise LogError(f"camera {camera.name} is not calibrated. Give its --calibration.")
            own = camera_of(depth.topic, self._content.depth_calibration, (first.shape[1], first.shape[0]), Notes())
            frames = self._left[1], self._optical(known.frame) if (known := self._candidate(depth)) else ""
            return depth, registration_of(own, camera, frames, self._content.tree, self._notes)
        except LogError as error:
            self._notes.add(f"Depth is not used: {error}")
            return None

    @cached_property
    def _images(self) -> ImageReader:
        image, known = self._selection.image, self._candidate(self._selection.image)
        found, notes = self._read(self._selection)
        if found.odometry is None and (wider := self._without_poses()) != self._selection:
            found, notes = self._read(wider)
        self._notes.extend(notes)
        content = found.between(self._choice.start_s, self._choice.stop_s)
        return ImageReader(self._container, image, known.codec if known else "", content, self._notes)

    def _read(self, selection: Selection) -> tuple[LogContent, Notes]:
        notes = Notes()
        return read_content(self._container, self._contents, selection, notes), notes

    def _without_poses(self) -> Selection:
        """The selection, with the IMU and the lidar where none is requested and no topic of poses or velocities proved
        to be odometry: those of a receiver know no heading. They are not read before, as they are most of a log."""
        posed = [c for c in self._candidates if c.role != "odometry"]
        if self._choice.odometry is not None:
            return self._selection
        other = select(posed, self._choice, self._path.name)
        return replace(self._selection, imu=other.imu, lidar=other.lidar)

    @property
    def _content(self) -> LogContent:
        return self._images.content

    def camera(self) -> Camera:
        """Raises LogError where the log has no images."""
        return self._left[0] if self._pair is None else self._pair.camera

    @cached_property
    def _left(self) -> tuple[Camera, str]:
        """The camera of the images as they come, and its frame."""
        image = self._image_channel()
        content, notes = self._content, self._notes
        logged, size = self._images.first(image, [*content.places], self._path.name)
        frame = self._optical(logged)
        known = self._sidecar.camera(image.topic)
        if known and known.topic and not self._contents.body and not named_for([known], image.topic):
            notes.add(f"The calibration is of {known.topic} by its file; {image.topic} takes it all the same.")
        calibration = known.calibration if known else content.calibration
        camera = camera_of(image.topic, calibration, size, notes)
        self._masks[0].check(content.stamp_ns.tolist(), size, notes)
        self._images.check_masks(image.topic, notes)
        body = self._body
        named = body and frame and frame == logged and content.tree.between(body, frame) is not None
        visual = camera.matrix is not None or self._contents.names is None
        if known is not None and known.body_from_camera is not None and not named:
            placed = self._body_from_calibrated_imu() if known.body_is_imu else np.eye(4)
            camera = replace(camera, body_from_camera=placed @ known.body_from_camera)
        elif self.odometry() is not None or content.chosen.lidar is not None or visual:
            ahead = self.odometry() is None  # it is computed then
            ahead |= any(source.used and source.kind in ("gps", "twist") for source in content.sources)
            remarks = Notes() if camera.matrix is None and not ahead else notes  # no closure is metric
            placed = body_from_camera(content.tree, body, frame, remarks, self.odometry(), ahead)
            camera = replace(camera, body_from_camera=placed)
        return camera, frame

    def _optical(self, frame: str) -> str:
        """Frame of a camera, by the frame_id of its images; those of a data set are optical."""
        if self._contents.body or not frame:
            return frame
        return optical_frame(self._content.tree, self._body or BODY, frame, self.odometry(), self._notes)

    @cached_property
    def _pair(self) -> Pair | None:
        """The left and right images as a rectified pair; None where there is depth, or, with a note, where a right
        topic was there."""
        image, right, content = self._selection.image, self._selection.right, self._content
        if image is None or right is None or self._depth is not None:
            return None
        left, frame = self._left
        if left.matrix is None:  # warned of as such: it costs more than the depth
            return None
        try:
            if (candidate := self._candidate(right)) and candidate.codec:
                raise NoPairError(f"{right.topic} is video; of a stereo pair, only the left images may be video")
            files = self._sidecar.camera(image.topic), self._sidecar.camera(right.topic)
            both = files[0] is not files[1]  # else none, or a file of the left camera alone
            own = files[0].calibration if files[0] else content.calibration
            theirs = files[1].calibration if files[1] and both else content.right_calibration
            if own is None or theirs is None:
                why = ", and that of --calibration is of one camera" if files[0] else ""
                raise NoPairError(f"{right.topic} has no calibration{why}")
            other, size = self._images.first(right, content.companions["right"], self._path.name)
            camera, other = camera_of(right.topic, theirs, size, self._notes), self._optical(other)
            if other and frame and not self._choice.right and self._are_apart(frame, other):
                return None  # the other is a camera by itself
            right_from_left = content.tree.between(other, frame) if other and frame else None
            right_from_left = self._sidecar.right_from_left(image.topic, right.topic) if both else right_from_left
            pair = pair_of(Side(left, own), Side(camera, theirs), right_from_left)
            pair = pair.with_common_rows(self._rectified(pair))
            if pair.right_down_px:
                self._notes.add(
                    f"{right.topic}: rectified by the calibration, its rows lie {abs(pair.right_down_px):.1f} px "
                    f"{'above' if pair.right_down_px > 0 else 'below'} those of the left images; they are moved by as "
                    "much. A new calibration would be better."
                )
        except (NoPairError, LogError) as error:
            self._notes.add(f"The right image is not used: {str(error).rstrip('.')}.")
            return None
        self._masks[1].check(content.right_ns[content.right_ns >= 0].tolist(), size, self._notes)
        self._notes.extend(content.right_notes)
        return pair

    def _rectified(self, pair: Pair) -> Iterator[tuple[Bytes, Bytes]]:
        """Images of a few frames; what does not decode is left out."""
        content, images, camera = self._content, self._images, self._left[0]
        rows = [row for row, place in enumerate(content.companions["right"]) if place is not None]
        for row in rows[:: max(len(rows) // CHECKED_FRAMES, 1)][:CHECKED_FRAMES]:
            image, other = images.image(row), images.companion("right", row)
            stamp_ns = int(content.stamp_ns[row])
            try:  # not counted as lost: only a check
                frame = RecordedFrame(stamp_ns, camera, image, None, other, pair, Notes()).decode()
            except LogError:
                continue
            if frame.right is not None:
                yield frame.image, frame.right
