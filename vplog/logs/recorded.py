"""A Log over any container: topics are chosen when it is opened, everything else is read when it is first asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from vplog.data import Frame, LogInfo, Topic
from vplog.errors import LogError
from vplog.logs.cameras import body_from_camera, camera_of
from vplog.logs.content import Content, read_content
from vplog.logs.images import depth_m, grey, is_depth
from vplog.logs.messages import BadMessageError, CalibrationMessage, ImageMessage, decode, kind_of
from vplog.logs.select import Candidate, TopicChoice, select
from vplog.logs.stamps import rows_of
from vplog.logs.transforms import clean

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import numpy as np

    from vplog.data import Camera, Gps, Ints, Odometry
    from vplog.logs.containers import Channel, Container, Contents, Notes

_LISTED = 8
"""Topics that an error lists."""
_TRIED = 10
"""Images tried for the size of all; a drive whose first second is damaged is not usable."""


@dataclass(eq=False)
class RecordedFrame:
    """One image message and its depth message, still as bytes; decoding needs nothing else."""

    stamp_ns: int
    camera: Camera
    image_channel: Channel
    image_data: bytes
    depth_channel: Channel | None
    depth_data: bytes | None

    def decode(self) -> Frame:
        """Raises LogError with topic and stamp where the bytes are not an image."""
        image = _pixels(self.image_channel, self.image_data, self.stamp_ns, grey)
        depth = None
        if self.depth_channel is not None and self.depth_data is not None:
            depth = _pixels(self.depth_channel, self.depth_data, self.stamp_ns, depth_m)
            if depth.shape != image.shape:
                raise LogError(
                    f"{self.depth_channel.topic} at {self.stamp_ns} ns is {_size(depth)} px, but the image is "
                    f"{_size(image)} px. Depth must be registered to the image; choose another with --depth-topic."
                )
        return Frame(self.stamp_ns, self.camera, image, depth)


class RecordedLog:
    """A drive in a container, as `vplog.stages.Log`."""

    def __init__(
        self, path: Path, name: str, kind: str, container: Container, notes: Notes, choice: TopicChoice
    ) -> None:
        self._path, self._name, self._kind, self._container, self._notes = path, name, kind, container, notes
        self._contents: Contents = container.contents()
        self._candidates = self._read_candidates()
        self._selection = select(self._candidates, choice, path.name)

    @property
    def name(self) -> str:
        return self._name

    @property
    def warnings(self) -> list[str]:
        return list(self._notes.lines)

    def info(self) -> LogInfo:
        """Reads the chosen topics once, so that the warnings are complete."""
        used = set(self._selection.channels)
        roles = {candidate.channel: candidate.role for candidate in self._candidates}
        topics = [
            Topic(channel.topic, channel.type, channel.encoding, count, roles.get(channel, ""), channel in used)
            for channel, count in self._contents.counts.items()
        ]
        content = self._content
        if self._selection.image is not None:
            self._check_images()
        stamps = [content.stamp_ns] + [track.stamp_ns for track in (content.odometry, content.gps) if track is not None]
        stamps = [stamp_ns for stamp_ns in stamps if len(stamp_ns)]
        start_ns = min((int(s[0]) for s in stamps), default=self._contents.start_ns)
        end_ns = max((int(s[-1]) for s in stamps), default=self._contents.end_ns)
        messages = self._contents.messages
        return LogInfo(str(self._path), self._kind, start_ns, end_ns, messages, topics, self.warnings)

    def camera(self) -> Camera:
        """Raises LogError where the log has no images."""
        return self._camera

    def stamps(self) -> Ints:
        self._image_channel()
        return self._content.stamp_ns

    def frames(self, stamp_ns: Ints) -> Iterator[RecordedFrame]:
        """Raises LogError where a stamp is not one of `stamps()`."""
        image, camera = self._image_channel(), self.camera()
        for row in rows_of(self._content.stamp_ns, stamp_ns, self._name):
            yield self._frame(row, image, camera)

    def odometry(self) -> Odometry | None:
        return self._content.odometry

    def gps(self) -> Gps | None:
        return self._content.gps

    def _check_images(self) -> None:
        """Everything that decoding the first image and depth would warn of, for info."""
        try:
            self.camera()
            _ = self._depth
        except LogError as error:
            self._notes.add(str(error))

    def _image_channel(self) -> Channel:
        if self._selection.image is None:
            names = list(dict.fromkeys(channel.topic for channel in self._contents.counts))
            listed = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
            raise LogError(f"No camera images in {self._path.name}. Topics: {listed or 'none'}.")
        if not len(self._content.stamp_ns):
            raise LogError(f"{self._selection.image.topic} in {self._path.name} has no readable image.")
        return self._selection.image

    def _frame(self, row: int, image: Channel, camera: Camera) -> RecordedFrame:
        depth, place = self._depth, self._content.depth_places[row]
        depth_data = None if depth is None or place is None else self._container.read(place)
        data = self._container.read(self._content.places[row])
        return RecordedFrame(int(self._content.stamp_ns[row]), camera, image, data, depth, depth_data)

    @cached_property
    def _depth(self) -> Channel | None:
        """The depth topic, or None, with a note, where its first image does not decode or not fit the camera's."""
        depth = self._selection.depth
        row = next((i for i, place in enumerate(self._content.depth_places) if place is not None), None)
        if depth is None or row is None:
            return None
        stamp_ns, place = int(self._content.stamp_ns[row]), self._content.depth_places[row]
        try:
            first = _pixels(depth, self._container.read(place or ()), stamp_ns, depth_m)
        except LogError as error:
            self._notes.add(f"Depth is not used: {error}")
            return None
        if first.shape != (self._camera.height, self._camera.width):
            size = f"{self._camera.width} x {self._camera.height}"
            self._notes.add(f"Depth is not used: {depth.topic} has {_size(first)} px, the images {size}.")
            return None
        return depth

    def _read_candidates(self) -> list[Candidate]:
        """Every topic that could play a part; the first message of each tells depth from grey, and its frame."""
        kinds = {c: kind_of(c) for c in self._contents.counts}
        asked = {c for c, kind in kinds.items() if kind in ("image", "camera_info") and self._contents.counts[c]}
        firsts: dict[Channel, ImageMessage | CalibrationMessage] = {}
        left = set(asked)
        for message in self._container.messages(asked) if asked else ():
            if message.channel not in left:
                continue
            try:
                record = decode(message.channel, message.data)
            except BadMessageError:
                continue  # the next one may be sound
            if isinstance(record, ImageMessage | CalibrationMessage):
                firsts[message.channel] = record
                left.discard(message.channel)
            if not left:
                break
        found = []
        for channel, kind in kinds.items():
            if kind:
                found.append(_candidate(channel, self._contents.counts[channel], kind, firsts.get(channel)))
        return found

    @cached_property
    def _content(self) -> Content:
        return read_content(self._container, self._selection, self._notes)

    @cached_property
    def _camera(self) -> Camera:
        image = self._image_channel()
        content, notes = self._content, self._notes
        first, size = self._first_image(image)
        camera = camera_of(image.topic, content.calibration, size, notes)
        if content.odometry is None:
            return camera
        return replace(camera, body_from_camera=body_from_camera(content.tree, content.body, first.frame, notes))

    def _first_image(self, channel: Channel) -> tuple[ImageMessage, tuple[int, int]]:
        """The first image that decodes, with its width and height; raises LogError where none of the first few does."""
        reason = ""
        for place in self._content.places[:_TRIED]:
            try:
                message = decode(channel, self._container.read(place))
                if isinstance(message, ImageMessage):
                    height, width = grey(message).shape
                    return message, (width, height)
            except BadMessageError as error:
                reason = str(error)
        raise LogError(f"{channel.topic} in {self._path.name} has no image that can be decoded: {reason}.")


def _pixels(channel: Channel, data: bytes, stamp_ns: int, convert: Callable[[ImageMessage], np.ndarray]) -> Any:
    try:
        message = decode(channel, data)
        if not isinstance(message, ImageMessage):
            raise BadMessageError("it is not an image message")
        return convert(message)
    except BadMessageError as error:
        raise LogError(f"{channel.topic} at {stamp_ns} ns cannot be decoded: {error}.") from None


def _candidate(channel: Channel, count: int, kind: str, first: ImageMessage | CalibrationMessage | None) -> Candidate:
    role = kind
    if kind == "tf" and channel.topic.rstrip("/").endswith("static"):
        role = "tf_static"
    if isinstance(first, ImageMessage) and (is_depth(first) or _named_depth(channel.topic, first)):
        role = "depth"
    calibrated = isinstance(first, CalibrationMessage) and bool(first.matrix[0, 0] > 0)
    return Candidate(channel, count, role, clean(first.frame) if first else "", calibrated)


def _named_depth(topic: str, first: ImageMessage) -> bool:
    """Where the encoding leaves it open: old compressedDepth says only `png`, RealSense records depth as mono16."""
    return topic.endswith("/compressedDepth") or (first.encoding == "mono16" and "depth" in topic.lower())


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
