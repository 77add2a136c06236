"""Images as the log holds them, with what belongs to each: all that a worker needs to decode one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vplog.data import Frame
from vplog.errors import LogError
from vplog.logs.image_message import read_image
from vplog.logs.images import depth_m, grey
from vplog.logs.messages import BadMessageError, ImageMessage, decode

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from vplog.data import Bytes, Camera, Float32s
    from vplog.logs.containers import Channel, Octets
    from vplog.logs.losses import Account
    from vplog.logs.stereo import Pair


def image_in(channel: Channel, data: Octets) -> ImageMessage:
    """The image of a message, its pixels or file a view of it. Raises BadMessageError.

    What this takes, other threads wait for: the interpreter is one.
    """
    message = read_image(channel, data, copy=False) or decode(channel, data)
    if not isinstance(message, ImageMessage):
        raise BadMessageError("it is not an image message")
    return message


@dataclass(frozen=True, eq=False)
class Encoded:
    """An image message as bytes."""

    channel: Channel
    data: Octets

    def grey(self, stamp_ns: int) -> Bytes:
        """(H, W) uint8. Raises LogError."""
        return self._pixels(stamp_ns, grey)

    def depth_m(self, stamp_ns: int) -> Float32s:
        """(H, W) float32 m, NaN where unknown. Raises LogError."""
        return self._pixels(stamp_ns, depth_m)

    def _pixels(self, stamp_ns: int, convert: Callable[[ImageMessage], np.ndarray]) -> Any:
        try:
            return convert(image_in(self.channel, self.data))
        except BadMessageError as error:
            raise LogError(undecodable(self.channel, stamp_ns, str(error))) from None


@dataclass(frozen=True, eq=False)
class Decoded:
    """A frame of a video, which decodes in the order of the file alone and so was decoded where it was read."""

    channel: Channel
    image: Bytes | None
    reason: str
    """Why there is no image."""

    def grey(self, stamp_ns: int) -> Bytes:
        """(H, W) uint8. Raises LogError."""
        if self.image is None:
            raise LogError(undecodable(self.channel, stamp_ns, self.reason))
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
    account: Account
    """Of the log: what does not decode is counted there."""

    def decode(self) -> Frame:
        """Raises LogError with topic and stamp where the bytes are not an image.

        Without its depth or right image, where that does not decode, the frame is still one.
        """
        try:
            image = self.image.grey(self.stamp_ns)
        except LogError:
            self._lose(self.image.channel)
            raise
        if self.pair is not None:
            _check_size(self.image.channel, image, self.camera)
            return Frame(self.stamp_ns, self.camera, self.pair.rectify(image, 0), right=self._right(self.pair))
        if self.depth is None:
            return Frame(self.stamp_ns, self.camera, image)
        try:
            depth = self.depth.depth_m(self.stamp_ns)
        except LogError:
            self._lose(self.depth.channel)
            return Frame(self.stamp_ns, self.camera, image)
        if depth.shape != image.shape:
            raise LogError(
                f"{self.depth.channel.topic} at {self.stamp_ns} ns is {size_of(depth)} px, but the image is "
                f"{size_of(image)} px. Depth must be registered to the image; choose another with --depth-topic."
            )
        return Frame(self.stamp_ns, self.camera, image, depth)

    def _right(self, pair: Pair) -> Bytes | None:
        if self.right is None:
            return None
        try:
            image = self.right.grey(self.stamp_ns)
            _check_size(self.right.channel, image, self.camera)
        except LogError:
            self._lose(self.right.channel)
            return None
        return pair.rectify(image, 1)

    def _lose(self, channel: Channel) -> None:
        at = self.stamp_ns
        self.account.add("undecodable_image", {channel.topic: 1}, (channel.topic, at), [(at, at)])


def undecodable(channel: Channel, stamp_ns: int, reason: str) -> str:
    return f"{channel.topic} at {stamp_ns} ns cannot be decoded: {reason}."


def size_of(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"


def _check_size(channel: Channel, image: np.ndarray, camera: Camera) -> None:
    if image.shape != (camera.height, camera.width):
        size = f"{camera.width} x {camera.height}"
        raise LogError(f"{channel.topic} has an image of {size_of(image)} px among those of {size} px; it is left out.")
