"""A video file (MP4, MOV, MKV, WebM, AVI): its frames with its own time stamps, turned as its rotation flag says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog.errors import LogError
from vplog.logs.datasets import ros1
from vplog.logs.datasets.streams import DataSet, Stream
from vplog.logs.formats.container import Channel
from vplog.logs.messages.video import MAX_PIXELS, grey

if TYPE_CHECKING:
    from collections.abc import Iterator
    from fractions import Fraction
    from pathlib import Path

    from vplog.data import Bytes, Ints

_TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, -180: cv2.ROTATE_180, -90: cv2.ROTATE_90_CLOCKWISE}
"""By the degrees counterclockwise that PyAV gives of the display matrix (ISO/IEC 14496-12, 8.3.2)."""
_AHEAD = 250
"""Frames that are decoded to reach one, rather than sought from the key frame before it: usual distances of these."""
_MOST_FRAMES = 10_000_000
"""Frames of a file: two days at 60 Hz."""


def is_video(path: Path) -> bool:
    """By the first bytes: ISO base media, Matroska and WebM, AVI."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] == b"ftyp" or head[:4] == b"\x1a\x45\xdf\xa3" or (head[:4] == b"RIFF" and head[8:] == b"AVI ")


def read(path: Path) -> DataSet:
    """Stamps are those of the file, since its start. Raises LogError where it holds no picture, or PyAV is missing."""
    frames = VideoFrames(path)
    channel = Channel("video", "sensor_msgs/Image", "ros1")

    def message(row: int) -> bytes:
        stamp_ns = int(frames.stamp_ns[row])
        return ros1.image(stamp_ns, "video", "mono8", frames.image(row))

    return DataSet("video", [Stream(channel, frames.stamp_ns, message, lambda _: MAX_PIXELS)])


class VideoFrames:
    """The frames of a file by their row in time, decoded forward from the key frame before them."""

    def __init__(self, path: Path) -> None:
        """Reads the packets once, without decoding. Raises LogError."""
        self._av, self._path = _av(path), path
        with self._opened() as container:
            stream = self._stream(container)
            packets = [(packet.pts, packet.dts) for packet in container.demux(stream) if packet.size]
            self._slots = container.format.name == "avi" or any(pts is None for pts, _ in packets)
            """AVI has a slot of time for each packet in place of stamps: the frames take them in their order."""
            self._tick_s: Fraction = stream.time_base
            times = [dts if self._slots else pts for pts, dts in packets]
            ticks = np.unique([time for time in times if time is not None])
        if not 0 < len(ticks) <= _MOST_FRAMES:
            raise LogError(f"{path} holds no picture with a time stamp. Give another video.")
        self._ticks: list[int] = [int(tick) for tick in ticks]
        self._rows = {tick: row for row, tick in enumerate(self._ticks)}
        self._running: Any = None
        """The frames from the last one on."""
        self._next = 0
        """The row that comes next."""

    @property
    def stamp_ns(self) -> Ints:
        """(F,) since the first frame."""
        return np.array([int((tick - self._ticks[0]) * 10**9 * self._tick_s) for tick in self._ticks], np.int64)

    def image(self, row: int) -> Bytes:
        """(H, W) uint8 grey; (0, 0) where it does not decode. Rows are best read in increasing order."""
        wanted = self._ticks[row]
        try:
            if self._running is None or not self._next <= row < self._next + _AHEAD:
                self._running = self._from_key(wanted)
            for tick, frame in self._running:
                self._next = self._rows.get(tick, self._next - 1) + 1
                if tick == wanted and not frame.is_corrupt:
                    turn = _TURNS.get(round(frame.rotation))
                    picture = grey(frame)
                    return picture if turn is None else np.asarray(cv2.rotate(picture, turn), np.uint8)
                if tick is not None and tick >= wanted:
                    break
        except self._av.error.FFmpegError:
            self._running = None
        return np.zeros((0, 0), np.uint8)

    def _from_key(self, tick: int) -> Iterator[tuple[int | None, Any]]:
        """Times and frames from the key frame before a time on; from the first where they take slots."""
        container = self._opened()
        stream = self._stream(container)
        stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        stream.codec_context.thread_count = 1  # with more, what damage does is a matter of chance
        if self._slots:
            yield from zip(self._ticks, container.decode(stream), strict=False)
            return
        container.seek(tick, stream=stream, backward=True)
        for frame in container.decode(stream):
            yield frame.pts, frame

    def _opened(self) -> Any:
        try:
            return self._av.open(str(self._path), metadata_errors="ignore")
        except self._av.error.FFmpegError as error:
            raise LogError(f"{self._path} is no video that can be read: {error.strerror}. Convert it first.") from None

    def _stream(self, container: Any) -> Any:
        if not container.streams.video:
            raise LogError(f"{self._path} has no video stream. Give a file with pictures.")
        return container.streams.video[0]


def _av(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise LogError(f"{path} is a video, and PyAV is not installed. Install vplog[video].") from None
    return av
