"""Images as the log holds them, by their row in time, with what belongs to each to decode one frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog.data import Bools, Bytes, Camera, Float32s, Floats, Frame
from vplog.errors import LogError, plural
from vplog.geometry.masking import filled
from vplog.logs.cameras import camera_from_image
from vplog.logs.formats.container import Channel, Container, Notes, Place, RawData
from vplog.logs.masks import Mask, check_share, is_used, resized_mask
from vplog.logs.messages import pixels, video
from vplog.logs.messages.decode import decode
from vplog.logs.messages.pixels import Levels, depth_m, levels_of, spread
from vplog.logs.messages.records import BadMessageError, CalibrationMessage, ImageMessage
from vplog.logs.messages.video import VideoStream
from vplog.logs.rectification import Pair
from vplog.storage.image_file import is_lossy

if TYPE_CHECKING:
    from av import VideoFrame

    from vplog.logs.content import LogContent
    from vplog.logs.depth_registration import DepthRegistration


_HALF = 127
"""Threshold of a mask of 0 and 255 that was resampled."""
_TRIED = 10
"""Images tried for the size of all, the first ones and as many spread over the drive: a video whose first key frame is
damaged has none before the next."""


def image_in(channel: Channel, data: RawData | ImageMessage) -> ImageMessage:
    """The image of a message. Raises BadMessageError."""
    message = decode(channel, data)
    if not isinstance(message, ImageMessage):
        raise BadMessageError("it is not an image message")
    return message


@dataclass(frozen=True, eq=False)
class LoggedImage:
    """An image message as it lies in the log; a frame of a video, which decodes in the order of the file alone, was
    decoded where it was read."""

    channel: Channel
    data: RawData | ImageMessage | VideoFrame | BadMessageError
    levels: Levels | None = None
    """Black and white of its topic, where that has 16 bits."""

    def grey(self, stamp_ns: int) -> Bytes:
        """(H, W) uint8. Raises LogError."""
        return self._pixels(stamp_ns, partial(pixels.grey, levels=self.levels), video.grey)

    def rgb(self, stamp_ns: int) -> Bytes:
        """(H, W, 3) uint8. Raises LogError."""
        return self._pixels(stamp_ns, partial(pixels.rgb, levels=self.levels), video.rgb)

    def used(self, stamp_ns: int) -> Bools:
        """(H, W) px that count, of a mask. Raises LogError."""

        def of_message(message: ImageMessage) -> Bools:
            return is_used(pixels.values(message), message.compressed and is_lossy(message.data))

        return self._pixels(stamp_ns, of_message, video.grey)

    def depth_m(self, stamp_ns: int) -> Float32s:
        """(H, W) float32 m, NaN where unknown. Raises LogError."""
        return self._pixels(stamp_ns, depth_m, video.grey)

    def _pixels(self, stamp_ns: int, of_message: Callable[[ImageMessage], Any], of_video: Callable[[Any], Any]) -> Any:
        try:
            if isinstance(self.data, BadMessageError):
                raise self.data
            if isinstance(self.data, bytes | memoryview | ImageMessage):
                return of_message(image_in(self.channel, self.data))
            return of_video(self.data)
        except BadMessageError as error:
            raise LogError(f"{self.channel.topic} at {stamp_ns} ns cannot be decoded: {error}.") from None


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One image with its depth or right image; decoding needs nothing else."""

    stamp_ns: int
    camera: Camera
    image: LoggedImage
    depth: LoggedImage | None
    right: LoggedImage | None
    pair: Pair | None
    notes: Notes
    """Notes of the log, where what does not decode is counted."""
    calibration: CalibrationMessage | None = None
    """The calibration of the image, where a later one differs from the camera's."""
    mask: Mask | LoggedImage | None = None
    right_mask: Mask | None = None
    registration: DepthRegistration | None = None
    """Where the depth is another camera's."""
    own_size: bool = False
    """True if the image keeps its size, so that the camera of the decoded frame has the size of the image. False if the
    image is brought to the size of `camera`."""

    def decode(self, colour: bool = False) -> Frame:
        """The frame, without depth or right image where that does not decode or fit. Raises LogError where the image
        does not."""
        image, camera, affine = self._image()
        mask = self._mask(image)
        rgb = self.image.rgb(self.stamp_ns) if colour else None
        if self.pair is not None:
            rgb = None if rgb is None else self.pair.rectify(rgb, 0)
            right = self._right(self.pair)
            mask = None if mask is None else self.pair.rectify(255 * mask.astype(np.uint8), 0) > _HALF
            return Frame(self.stamp_ns, self.camera, self.pair.rectify(image, 0), None, right, rgb, mask)
        depth = None if self.depth is None else self._registered(self.depth, image, affine)
        rgb = None if rgb is None else warped(rgb, affine, camera)
        if mask is not None and affine is not None:
            mask = warped(255 * mask.astype(np.uint8), affine, camera) > _HALF
        return Frame(self.stamp_ns, camera, warped(image, affine, camera), depth, colour=rgb, mask=mask)

    def _image(self) -> tuple[Bytes, Camera, Floats | None]:
        """Return the image, its camera, and the (2, 3) transform from px of the image to px of the camera, None for the
        identity. Raises LogError if the image does not decode or fit."""
        channel, image = self.image.channel, None
        try:
            image = self.image.grey(self.stamp_ns)
            if self.pair is not None:
                self._check_size(channel, image)
                return image, self.camera, None
            height, width = image.shape
            if self.own_size:
                return image, replace(self.camera, width=width, height=height), None
            affine = camera_from_image(self.camera, (width, height), self.calibration)
            size = f"{self.camera.width} x {self.camera.height} px"
            if affine is None:
                raise LogError(
                    f"{channel.topic} has an image of {size_of(image)} px among those of {size}, of another shape and "
                    "without a calibration of its own; it is left out."
                )
        except LogError as error:
            self._count_undecodable(channel, "" if image is None else str(error))
            raise
        if image.shape == (self.camera.height, self.camera.width) and np.array_equal(affine, np.eye(2, 3)):
            return image, self.camera, None
        self.notes.add(
            f"The images of {channel.topic} change their size or region of interest; those unlike the first are "
            f"resampled to its {size}."
        )
        return image, self.camera, affine

    def _mask(self, image: Bytes) -> Bools | None:
        """(H, W) px of the image as it comes that count; None where all do. Raises LogError where its mask does not fit
        or decode."""
        size = (image.shape[1], image.shape[0])
        try:
            if not isinstance(self.mask, LoggedImage):
                return None if self.mask is None else self.mask.used(size)
            return resized_mask(self.mask.used(self.stamp_ns), size, self.mask.channel.topic)
        except LogError as error:
            self._count_undecodable(self.image.channel, str(error))
            raise

    def _registered(self, depth: LoggedImage, image: Bytes, affine: Floats | None) -> Float32s | None:
        """The depth of the camera's px, NaN beyond the image; None, and counted, where it does not decode or has
        another size than the image, or than that which is registered."""
        detail, found, registration = "", None, self.registration
        fitting = image if registration is None else registration.rays
        with suppress(LogError):
            found = depth.depth_m(self.stamp_ns)
        if found is not None and found.shape != fitting.shape[:2]:
            what = "the image has" if registration is None else "its calibration is of"
            detail = (
                f"{depth.channel.topic} has {size_of(found)} px where {what} {size_of(fitting)}; depth must be "
                "registered to the image: choose another with --depth-topic."
            )
        if found is None or detail:
            return self._count_undecodable(depth.channel, detail)
        if registration is not None:
            return registration.register(found)
        if affine is None:
            return found
        size = self.camera.width, self.camera.height  # the nearest measurement to each px
        return np.asarray(cv2.warpAffine(found, affine, size, flags=cv2.INTER_NEAREST, borderValue=np.nan), np.float32)

    def _right(self, pair: Pair) -> Bytes | None:
        if self.right is None:
            return None
        try:
            image = self.right.grey(self.stamp_ns)
            self._check_size(self.right.channel, image)
            if self.right_mask is not None:
                image = filled(image, self.right_mask.used((image.shape[1], image.shape[0])))
        except LogError:
            return self._count_undecodable(self.right.channel)
        return pair.rectify(image, 1)

    def _check_size(self, channel: Channel, image: np.ndarray) -> None:
        """Raises LogError where an image of a pair has another size than the camera."""
        if image.shape != (self.camera.height, self.camera.width):
            size = f"{self.camera.width} x {self.camera.height}"
            raise LogError(
                f"{channel.topic} has an image of {size_of(image)} px among those of {size} px; it is left out."
            )

    def _count_undecodable(self, channel: Channel, detail: str = "") -> None:
        at = self.stamp_ns
        self.notes.account.add("undecodable_image", {channel.topic: 1}, (channel.topic, at), [(at, at)], detail)


def size_of(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"


def warped(image: Bytes, affine: Floats | None, camera: Camera) -> Bytes:
    """The image in px of the camera; what it does not show repeats its edge, which has no corners."""
    if affine is None:
        return image
    if (shrunk := 1 / affine[0, 0]) > 1:  # the usual blur before pixels are left out
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), max((shrunk - 1) / 2, 1e-3)), np.uint8)
    size = (camera.width, camera.height)
    return np.asarray(cv2.warpAffine(image, affine, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


class ImageReader:
    """Reads images by their place in the container."""

    def __init__(
        self, container: Container, image: Channel | None, codec: str, content: LogContent, notes: Notes
    ) -> None:
        """`codec` is FFmpeg's decoder where the topic of the images is a video, else empty."""
        self._container, self._image = container, image
        self._video = None if image is None or not codec else self._stream(image, codec, content, notes)
        self.content = content if self._video is None else self._from_first_key(self._video, content, notes)
        """Content of the log, without the images before a video's first key frame."""

    def image(self, row: int) -> LoggedImage:
        if self._image is None:
            raise LogError("No image topic is chosen. Choose one with --image-topic.")
        if self._video is None:
            return LoggedImage(self._image, self._container.read(self.content.places[row]), self._levels)
        try:
            return LoggedImage(self._image, self._video.frame(int(self.content.stream_rows[row])))
        except BadMessageError as error:
            return LoggedImage(self._image, error)

    def companion(self, part: str, row: int) -> LoggedImage | None:
        """The `depth` or `right` image or the `mask` of a row; None where there is none."""
        channel, place = getattr(self.content.chosen, part), self.content.companions[part][row]
        levels = self._levels if part == "right" else None
        return None if place is None else LoggedImage(channel, self._container.read(place), levels)

    def check_masks(self, topic: str, notes: Notes) -> None:
        """Note masks of a topic that leave out most of the images of `topic`. Raises LogError where they mask all."""
        if (masks := self.content.chosen.mask) is None:
            return
        placed, used = zip(self.content.stamp_ns.tolist(), self.content.companions["mask"], strict=True), list[Bools]()
        found = [(stamp_ns, place) for stamp_ns, place in placed if place is not None]
        for stamp_ns, place in found[:: spread(len(found))]:
            with suppress(LogError):  # its image is left out
                used.append(LoggedImage(masks, self._container.read(place)).used(stamp_ns))
        if used:
            check_share(masks.topic, used, topic, notes)

    @cached_property
    def _levels(self) -> Levels | None:
        """Black and white of 16 bits for the whole drive, by images spread over it: SIFT compares views by contrast."""

        def sampled(image: Channel) -> Iterator[ImageMessage]:
            for place in self.content.places[:: spread(len(self.content.places))]:
                with suppress(BadMessageError):
                    yield image_in(image, self._container.read(place))

        return None if self._image is None else levels_of(sampled(self._image))

    def first(self, channel: Channel, places: list[Place | None], log: str) -> tuple[str, tuple[int, int]]:
        """Frame, and width and height of the first image that decodes. Raises LogError where none of the first few
        does, and where it is a video that needs PyAV."""
        stream, reason = self._video if channel == self._image else None, ""
        found = [(row, place) for row, place in enumerate(places) if place is not None]
        for row, place in [*found[:_TRIED], *found[_TRIED :: max(len(found) // _TRIED, 1)]]:
            try:
                message = image_in(channel, self._container.read(place))
                if stream is not None:
                    frame = stream.frame(int(self.content.stream_rows[row]))
                    return message.frame, (frame.width, frame.height)
                image = pixels.grey(message)
                return message.frame, (image.shape[1], image.shape[0])
            except BadMessageError as error:
                reason = str(error)
        raise LogError(f"No image of {channel.topic} in {log} decodes: {reason}. Choose another with --image-topic.")

    def first_depth(self, channel: Channel) -> Float32s | None:
        """The first depth image that decodes; None where no image has one. Raises LogError where none does."""
        first: LogError | None = None
        found = [(row, place) for row, place in enumerate(self.content.companions["depth"]) if place is not None]
        for row, place in found[:_TRIED]:
            try:
                return LoggedImage(channel, self._container.read(place)).depth_m(int(self.content.stamp_ns[row]))
            except LogError as error:
                first = first or error
        if first is not None:
            raise first
        return None

    def _stream(self, image: Channel, codec: str, content: LogContent, notes: Notes) -> VideoStream:
        places, images = content.stream, {*content.stream_rows.tolist()}

        def payload(row: int) -> bytes | None:
            message = self._container.read(places[row])
            if row and row not in images and message == self._container.read(places[row - 1]):
                return None  # recorded twice: a decoder must not have it twice
            with suppress(BadMessageError):
                return bytes(image_in(image, message).data)
            return b""

        advice = ", or choose another topic with --image-topic"
        decoder = partial(video.new_decoder, codec, image.topic, notes.add, advice)
        return VideoStream(codec, payload, len(places), decoder)

    def _from_first_key(self, video: VideoStream, content: LogContent, notes: Notes) -> LogContent:
        first = video.first_key()
        decodable = content.stream_rows >= (len(content.stream) if first is None else first)
        if self._image is not None and (lost := int((~decodable).sum())):
            why = "without a key frame before them" if first is None else "before the first key frame"
            notes.add(f"{self._image.topic}: {plural(lost, 'image')} {why} cannot be decoded; left out.")
        return content.with_images(decodable)
