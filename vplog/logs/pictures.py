"""The images of a log by their row in time: camera, right and depth images, each with its message or its video."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import LogError
from vplog.logs.formats.container import plural
from vplog.logs.frames import Decoded, Encoded, image_in
from vplog.logs.messages.pixels import drive_levels, grey, spread
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.logs.messages.video import VideoStream

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Float32s
    from vplog.logs.content import Content
    from vplog.logs.formats.container import Channel, Container, Notes, Place
    from vplog.logs.messages.pixels import Levels

_TRIED = 10
"""Images tried for the size of all; a drive whose first second is damaged is not usable."""


class Pictures:
    """Reads images where `content` says they lie."""

    def __init__(self, container: Container, image: Channel | None, codec: str, content: Content, notes: Notes) -> None:
        """`codec` is FFmpeg's decoder where the topic of the images is a video, else empty."""
        self._container, self._image = container, image
        self._video = None if image is None or not codec else self._stream(image, codec, content.stream)
        self.content = content if self._video is None else self._from_first_key(self._video, content, notes)
        """What was read, without the images before a video's first key frame."""

    def image(self, row: int) -> Encoded | Decoded:
        if self._image is None:
            raise LogError("No image topic is chosen. Choose one with --image-topic.")
        if self._video is None:
            return Encoded(self._image, self._container.read(self.content.places[row]), self._levels)
        try:
            return Decoded(self._image, self._video.frame(int(self.content.stream_rows[row])))
        except BadMessageError as error:
            return Decoded(self._image, error)

    def beside(self, channel: Channel | None, places: list[Place | None], row: int) -> Encoded | None:
        """The depth or right image of a row; None where there is none."""
        place = places[row]
        return None if channel is None or place is None else Encoded(channel, self._container.read(place), self._levels)

    @cached_property
    def _levels(self) -> Levels | None:
        """Black and white of 16 bits for the whole drive, by images spread over it: SIFT compares views by contrast."""
        places = self.content.places
        return None if self._image is None else drive_levels(self._sampled(self._image, places[:: spread(len(places))]))

    def _sampled(self, channel: Channel, places: list[Place]) -> Iterator[ImageMessage]:
        for place in places:
            with suppress(BadMessageError):
                yield image_in(channel, self._container.read(place))

    def first(self, channel: Channel, places: list[Place | None], log: str) -> tuple[str, tuple[int, int]]:
        """Frame, and width and height of the first image that decodes. Raises LogError where none of the first few
        does, and where it is a video that needs PyAV."""
        video, reason = self._video if channel == self._image else None, ""
        for i, place in enumerate([place for place in places if place is not None][:_TRIED]):
            try:
                message = image_in(channel, self._container.read(place))
                pixels = grey(message) if video is None else video.frame(int(self.content.stream_rows[i]))
                return message.frame, (pixels.shape[1], pixels.shape[0])
            except BadMessageError as error:
                reason = str(error)
        raise LogError(f"No image of {channel.topic} in {log} decodes: {reason}. Choose another --image-topic.")

    def first_depth(self, channel: Channel) -> Float32s | None:
        """The first depth image that decodes; None where no image has one. Raises LogError where none does."""
        failures: list[LogError] = []
        found = [(row, place) for row, place in enumerate(self.content.depth_places) if place is not None]
        for row, place in found[:_TRIED]:
            try:
                return Encoded(channel, self._container.read(place)).depth_m(int(self.content.stamp_ns[row]))
            except LogError as error:
                failures.append(error)
        if failures:
            raise failures[0]
        return None

    def _stream(self, image: Channel, codec: str, places: list[Place]) -> VideoStream:
        def payload(row: int) -> bytes:
            with suppress(BadMessageError):
                return bytes(image_in(image, self._container.read(places[row])).data)
            return b""

        return VideoStream(codec, image.topic, payload, len(places))

    def _from_first_key(self, video: VideoStream, content: Content, notes: Notes) -> Content:
        first = video.first_key()
        decodable = content.stream_rows >= (len(content.stream) if first is None else first)
        if self._image is not None and (lost := int((~decodable).sum())):
            why = "without a key frame before them" if first is None else "before the first key frame"
            notes.add(f"{self._image.topic}: {plural(lost, 'image')} {why} cannot be decoded; left out.")
        rows = np.flatnonzero(decodable).tolist()
        return replace(
            content,
            stamp_ns=content.stamp_ns[decodable],
            places=[content.places[row] for row in rows],
            stream_rows=content.stream_rows[decodable],
            depth_places=[content.depth_places[row] for row in rows],
            right_places=[content.right_places[row] for row in rows],
        )
