"""Images as the log holds them, with what belongs to each: all that a worker needs to decode one frame."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog.data import Frame
from vplog.errors import LogError
from vplog.logs.cameras import camera_from_image
from vplog.logs.messages.decode import decode
from vplog.logs.messages.pixels import depth_m, grey
from vplog.logs.messages.records import BadMessageError, ImageMessage

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Bytes, Camera, Float32s, Floats
    from vplog.logs.formats.container import Channel, Notes, Octets
    from vplog.logs.messages.pixels import Levels
    from vplog.logs.messages.records import CalibrationMessage
    from vplog.logs.rectification import Pair


def image_in(channel: Channel, data: Octets) -> ImageMessage:
    """The image of a message. Raises BadMessageError."""
    message = decode(channel, data)
    if not isinstance(message, ImageMessage):
        raise BadMessageError("it is not an image message")
    return message


@dataclass(frozen=True, eq=False)
class Encoded:
    """An image message as bytes."""

    channel: Channel
    data: Octets
    levels: Levels | None = None
    """Black and white of its topic, where that has 16 bits."""

    def grey(self, stamp_ns: int) -> Bytes:
        """(H, W) uint8. Raises LogError."""
        return self._pixels(stamp_ns, partial(grey, levels=self.levels))

    def depth_m(self, stamp_ns: int) -> Float32s:
        """(H, W) float32 m, NaN where unknown. Raises LogError."""
        return self._pixels(stamp_ns, depth_m)

    def _pixels(self, stamp_ns: int, convert: Callable[[ImageMessage], np.ndarray]) -> Any:
        try:
            return convert(image_in(self.channel, self.data))
        except BadMessageError as error:
            raise _undecodable(self.channel, stamp_ns, error) from None


@dataclass(frozen=True, eq=False)
class Decoded:
    """A frame of a video, which decodes in the order of the file alone and so was decoded where it was read."""

    channel: Channel
    image: Bytes | BadMessageError

    def grey(self, stamp_ns: int) -> Bytes:
        """(H, W) uint8. Raises LogError."""
        if isinstance(self.image, BadMessageError):
            raise _undecodable(self.channel, stamp_ns, self.image)
        return self.image


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One image with its depth or right image; decoding needs nothing else."""

    stamp_ns: int
    camera: Camera
    image: Encoded | Decoded
    depth: Encoded | None
    right: Encoded | None
    pair: Pair | None
    notes: Notes
    """Notes of the log, where what does not decode is counted."""
    calibration: CalibrationMessage | None = None
    """That of the image, where it came later and is another than the camera's."""

    def decode(self) -> Frame:
        """The frame, without depth or right image where that does not decode or fit. Raises LogError where the image
        does not."""
        image, affine = self._image()
        if self.pair is not None:
            return Frame(self.stamp_ns, self.camera, self.pair.rectify(image, 0), right=self._right(self.pair))
        depth = None if self.depth is None else self._registered(self.depth, image, affine)
        return Frame(self.stamp_ns, self.camera, warped(image, affine, self.camera), depth)

    def _image(self) -> tuple[Bytes, Floats | None]:
        """The image, and what leads from its px to the camera's. Raises LogError."""
        channel, image = self.image.channel, None
        try:
            image = self.image.grey(self.stamp_ns)
            if self.pair is None:
                return image, affine_to_camera(channel.topic, image, self.camera, self.calibration, self.notes)
            _check_size(channel, image, self.camera)
        except LogError as error:
            self._lose(channel, "" if image is None else str(error))
            raise
        return image, None

    def _registered(self, depth: Encoded, image: Bytes, affine: Floats | None) -> Float32s | None:
        """The depth of the camera's px, NaN beyond the image; None, and counted, where it does not decode or has
        another size than the image."""
        detail, found = "", None
        with suppress(LogError):
            found = depth.depth_m(self.stamp_ns)
        if found is not None and found.shape != image.shape:
            detail = (
                f"{depth.channel.topic} has {size_of(found)} px where the image has {size_of(image)}; depth must be "
                "registered to the image: choose another with --depth-topic."
            )
        if found is None or detail:
            return self._lose(depth.channel, detail)
        if affine is None:
            return found
        size = self.camera.width, self.camera.height  # the nearest measurement to each px
        return np.asarray(cv2.warpAffine(found, affine, size, flags=cv2.INTER_NEAREST, borderValue=np.nan), np.float32)

    def _right(self, pair: Pair) -> Bytes | None:
        if self.right is None:
            return None
        try:
            image = self.right.grey(self.stamp_ns)
            _check_size(self.right.channel, image, self.camera)
        except LogError:
            return self._lose(self.right.channel)
        return pair.rectify(image, 1)

    def _lose(self, channel: Channel, detail: str = "") -> None:
        at = self.stamp_ns
        self.notes.account.add("undecodable_image", {channel.topic: 1}, (channel.topic, at), [(at, at)], detail)


def _undecodable(channel: Channel, stamp_ns: int, reason: BadMessageError) -> LogError:
    return LogError(f"{channel.topic} at {stamp_ns} ns cannot be decoded: {reason}.")


def size_of(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"


def affine_to_camera(
    topic: str, image: Bytes, camera: Camera, calibration: CalibrationMessage | None, notes: Notes
) -> Floats | None:
    """(2, 3) from px of the image to those of the camera; None where they are the same. Raises LogError."""
    found, same = camera_from_image(camera, (image.shape[1], image.shape[0]), calibration)
    size = f"{camera.width} x {camera.height} px"
    if found is None and not same:
        raise LogError(
            f"{topic} has an image of {size_of(image)} px among those of {size}, of another shape and without a "
            "calibration of its own; it is left out."
        )
    if found is not None:
        notes.add(
            f"The images of {topic} change their size or region of interest; those unlike the first are resampled "
            f"to its {size}."
        )
    return found


def warped(image: Bytes, affine: Floats | None, camera: Camera) -> Bytes:
    """The image in px of the camera; what it does not show repeats its edge, which has no corners."""
    if affine is None:
        return image
    if (shrunk := 1 / affine[0, 0]) > 1:  # the usual blur before pixels are left out
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), max((shrunk - 1) / 2, 1e-3)), np.uint8)
    size = (camera.width, camera.height)
    return np.asarray(cv2.warpAffine(image, affine, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _check_size(channel: Channel, image: np.ndarray, camera: Camera) -> None:
    if image.shape != (camera.height, camera.width):
        size = f"{camera.width} x {camera.height}"
        raise LogError(f"{channel.topic} has an image of {size_of(image)} px among those of {size} px; it is left out.")
