"""A video file (MP4, MOV, MKV, WebM, AVI): its frames with its own time stamps, turned as its rotation flag says."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from vplog.data import Bytes, Ints
from vplog.errors import LogError, plural
from vplog.logs.datasets import gopro
from vplog.logs.datasets.streams import DataSet, Stream, raw_image
from vplog.logs.formats.container import Channel
from vplog.logs.image_folder import first_bytes
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.logs.messages.video import (
    MAX_PIXELS,
    NAMES,
    PLAIN,
    WHOLE_KEY,
    VideoStream,
    careful,
    grey,
    new_decoder,
    padded,
    pyav,
    rgb,
)

_TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, -180: cv2.ROTATE_180, -90: cv2.ROTATE_90_CLOCKWISE}
"""By the degrees counterclockwise that PyAV gives of the display matrix (ISO/IEC 14496-12, 8.3.2)."""
_STILLS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"avif", b"crx ", b"M4A ")
"""Brands of files that hold a picture, or sound alone: ISO/IEC 23008-12, annex B; AVIF 1.1; Canon's CR3; M4A."""
_AHEAD = 250
"""Packets that are read to reach one, rather than sought from the key frame before it: usual distances of these."""
_FILTERS = {"h264": "h264_mp4toannexb,dump_extra", "hevc": "hevc_mp4toannexb,dump_extra"}
"""FFmpeg's filters that make packets of files like those of messages, each key frame with its parameter sets."""
_MOST_FRAMES = 10_000_000
"""Frames of a file: two days at 60 Hz."""
_FEW = 10
"""Packets of another stream that are no camera's: thumbnails."""
_CUT_S, _CUT = 1.0, 0.1
"""s, and share of the duration that a file names, without which at its end it is noted to be cut short: audio may go
on a little longer."""
_DURATION = re.compile(r"(\d+):(\d+):(\d+\.?\d*)")
_SQUARE = 0.01
"""Most that the width of a pixel may differ from its height: rounding."""


class _Packet(NamedTuple):
    """A packet without its data; times in the ticks of its stream."""

    pts: int | None
    dts: int | None
    position: int
    """Byte of the file."""
    key: bool
    discarded: bool
    """Decoded as a reference of other frames, and not shown."""


def is_video(path: Path) -> bool:
    """By the first bytes: ISO base media but still pictures (HEIC, AVIF), Matroska and WebM, AVI."""
    head = first_bytes(path, 12)
    is_media = head[4:8] == b"ftyp" and head[8:] not in _STILLS
    return is_media or head[:4] == b"\x1a\x45\xdf\xa3" or (head[:4] == b"RIFF" and head[8:] == b"AVI ")


def read(path: Path) -> DataSet:
    """Stamps are those of the file, since its start. Raises LogError where it holds no picture, or PyAV is missing."""
    remarks = list[str]()
    frames = VideoFrames(path, remarks.append)
    channel = Channel("video", "sensor_msgs/Image", "ros1")
    images = Stream(channel, frames.stamp_ns, frames.message, lambda _: MAX_PIXELS)
    return DataSet("video", [images, *gopro.streams_of(frames.metadata())], remarks=remarks)


class VideoFrames:
    """The frames of a file by their row in time."""

    def __init__(self, path: Path, note: Callable[[str], object] = lambda _: None) -> None:
        """Reads the packets once; `note` takes what the decoder cannot. Raises LogError."""
        self._av, self._path, self._note = pyav(f"{path} is a video"), path, note
        with self._opened() as container:
            streams = self._streams(container)
            found = {one.index: list[_Packet]() for one in streams}
            for one in container.demux(streams):
                if one.size:
                    packet = _Packet(one.pts, one.dts, one.pos, one.is_keyframe, one.is_discard)
                    found[one.stream_index].append(packet)
            self._index = max(found, key=lambda index: len(found[index]))
            stream, packets = self._stream(container), found[self._index]
            self._codec, self._tick_s = stream.codec_context.codec.canonical_name, stream.time_base
            is_avi = container.format.name == "avi"
            # AVI has a slot of time for each packet in place of stamps: the frames take them in their order
            slots = any(one.pts is None for one in packets) or (
                is_avi and self._codec == "h264" and stream.codec_context.has_b_frames
            )
            # FFmpeg shortens the duration of an AVI file to the bytes that are there, and not the count of its frames
            if is_avi and stream.average_rate:
                whole_s = stream.frames / stream.average_rate
            elif stream.duration is not None:
                whole_s = stream.duration * stream.time_base
            elif named := _DURATION.match(stream.metadata.get("DURATION", "")):  # Matroska's, of this stream alone
                whole_s = sum(float(part) * 60**power for power, part in zip((2, 1, 0), named.groups(), strict=True))
            else:
                whole_s = 0 if len(container.streams) > 1 else (container.duration or 0) / 10**6
            aspect = float(stream.sample_aspect_ratio or 1)
        self._packets = packets
        self._at, self._data = -1, b""
        """The last packet that was read, and its number."""
        self._running: Iterator[tuple[int, bytes]] | None = None
        """Packets behind the last one that was read, with their numbers."""
        times = [one.dts if slots else one.pts for one in packets]
        shown = [time for time, one in zip(times, packets, strict=True) if time is not None and not one.discarded]
        self._ticks = np.unique(np.array(shown, np.int64))
        if not 0 < len(self._ticks) <= _MOST_FRAMES:
            raise LogError(f"{path} holds no picture with a time stamp. Give another video.")
        self._note_doubts({index: len(one) for index, one in found.items()}, len(shown), float(whole_s), aspect)
        self._turn = self._first_turn()
        self._decoder()  # raises here where the file cannot be decoded
        order = self._decoded_order() if slots else range(len(packets))
        places = {int(tick): row for row, tick in enumerate(self._ticks)}
        rows = [-1] * len(packets)  # of those that are not shown
        for number, time, one in zip(order, times, (packets[number] for number in order), strict=True):
            if time is not None and not one.discarded:
                rows[number] = places.pop(time, -1)  # the first of those with one stamp
        kinds = bytes(WHOLE_KEY if one.key else PLAIN for one in packets)
        self._video = VideoStream(self._codec, self._packet, len(packets), self._decoder, rows, kinds)

    @cached_property
    def stamp_ns(self) -> Ints:
        """(F,) since the first frame."""
        first, *_ = ticks = self._ticks.tolist()  # Python's integers do not overflow
        times, parts = 10**9 * self._tick_s.numerator, self._tick_s.denominator
        return np.array([(tick - first) * times // parts for tick in ticks], np.int64)

    def metadata(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield stamp and duration in ns, as `stamp_ns`, and data of the packets of a GoPro's metadata track."""
        with self._opened() as container, suppress(self._av.error.FFmpegError):
            tracks = [one for one in container.streams.data if one.metadata.get("handler_name") == gopro.HANDLER]
            first_s, last_ns = self._ticks.tolist()[0] * self._tick_s, int(self.stamp_ns[-1])
            for one in container.demux(tracks[:1]) if tracks else ():
                stamp_ns = -1 if one.pts is None else int(10**9 * (one.pts * one.time_base - first_s))
                if one.size and 0 <= stamp_ns <= last_ns:
                    yield stamp_ns, min(int(10**9 * (one.duration or 0) * one.time_base), last_ns), bytes(one)

    def message(self, row: int) -> ImageMessage:
        """Its image, of no px where it does not decode. Rows are best read in increasing order."""
        stamp_ns = int(self.stamp_ns[row])
        try:
            frame = self._video.frame(row)
        except BadMessageError:
            return raw_image(stamp_ns, "video", "mono8", np.zeros((0, 0), np.uint8))
        turn = _TURNS.get(_turn_deg(frame) or self._turn)

        def turned(image: Bytes) -> Bytes:
            return image if turn is None else np.asarray(cv2.rotate(image, turn), np.uint8)

        grey_image = raw_image(stamp_ns, "video", "mono8", turned(grey(frame)))
        return grey_image._replace(rgb=lambda: turned(rgb(frame)))

    def _packet(self, number: int) -> bytes:
        """Empty where it cannot be read."""
        if self._running is None or not self._at <= number <= self._at + _AHEAD:
            self._at, self._running = -1, self._from(number)
        try:
            while self._at < number:
                self._at, self._data = next(self._running)
        except (StopIteration, self._av.error.FFmpegError):
            self._running = None
            return b""
        return self._data if self._at == number else b""

    def _from(self, number: int) -> Iterator[tuple[int, bytes]]:
        """Packets with their numbers from one on, or from one before it."""
        container, numbers = self._opened(), {one.position: number for number, one in enumerate(self._packets)}
        stream = self._stream(container)
        key = next((one for one in self._packets[number::-1] if one.key), None)
        if key and len(numbers) == len(self._packets):
            container.seek(key.pts if key.dts is None else key.dts, stream=stream, backward=True)
        else:
            numbers = {}
        name = _FILTERS.get(self._codec)
        bytestream = self._av.bitstream.BitStreamFilterContext(name, stream) if name else None
        found = (one for one in container.demux(stream) if one.size)
        for count, packet in enumerate(found):
            at = numbers.get(packet.pos, -1) if numbers else count
            for one in bytestream.filter(packet) if bytestream else (packet,):
                yield at, bytes(one)

    def _decoder(self) -> Any:
        stream = self._stream(self._opened())
        known = stream.codec_context
        if self._codec not in NAMES:
            return careful(known)
        decoder = new_decoder(self._codec, str(self._path), self._note)
        decoder.color_range = known.color_range
        if self._codec not in _FILTERS:
            decoder.extradata = known.extradata
        return decoder

    def _first_turn(self) -> int:
        """The turn that the container names, in degrees counterclockwise."""
        name = self._path.name
        with self._opened() as container, suppress(self._av.error.FFmpegError):
            stream = self._stream(container)
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
            for frame in container.decode(stream):
                if frame.interlaced_frame:
                    self._note(
                        f"The frames of {name} are interlaced: rows in turn are of two times. Make whole frames first: "
                        "ffmpeg -i IN -vf bwdif OUT."
                    )
                if (turn := _turn_deg(frame)) is None:
                    self._note(f"The display matrix of {name} mirrors its pictures; they are read as recorded.")
                return turn or 0
        return 0

    def _note_doubts(self, packets: dict[int, int], shown: int, whole_s: float, aspect: float) -> None:
        """Note where the file holds other pictures, or others than it names: `packets` of each stream, frames `shown`
        of the one in use, its duration, and the width of a pixel by its height."""
        name, span_s = self._path.name, self.stamp_ns[-1] / 1e9
        end_s = max(span_s, float(self._ticks[-1] * self._tick_s))  # where time does not begin at 0
        if sum(count > _FEW for count in packets.values()) > 1:
            listed = ", ".join(f"{index} ({count} packets)" for index, count in packets.items())
            self._note(
                f"{name} has the video streams {listed}, of which {self._index} is used. Give another as a file of its "
                "own: ffmpeg -i IN -map 0:NUMBER -c copy OUT."
            )
        if whole_s - end_s > max(_CUT_S, _CUT * whole_s):
            self._note(f"{name} ends after {end_s:.1f} of the {whole_s:.1f} s that it names: is it cut? Copy it again.")
        if double := shown - len(self._ticks):
            self._note(f"{plural(double, 'frame')} of {name} with the time stamp of another left out.")
        if abs(aspect - 1) > _SQUARE:
            self._note(
                f"The pixels of {name} are {aspect:.3g} times as wide as high, and are read as stored. Without a "
                "calibration of such images, make them square first: ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 OUT."
            )

    def _decoded_order(self) -> list[int]:
        """Numbers of the packets as their frames come out, those without a frame before the next key frame."""
        decoder, found = self._decoder(), list[int]()
        decoder.options = {"max_pixels": str(MAX_PIXELS)}
        for number in [*range(len(self._packets)), None]:
            packet = None if number is None else padded(self._packet(number))
            if packet is not None:
                packet.pts = packet.dts = number
            with suppress(self._av.error.FFmpegError):
                found += [frame.pts for frame in decoder.decode(packet)]
        lost = sorted({*range(len(self._packets))} - {*found})
        order = list[int]()
        for number in found:
            while lost and self._packets[number].key and lost[0] < number:
                order.append(lost.pop(0))
            order.append(number)
        return [*order, *lost]

    def _opened(self) -> Any:
        try:
            return self._av.open(str(self._path), metadata_errors="ignore")
        except self._av.error.FFmpegError as error:
            raise LogError(f"{self._path} is no video that can be read: {error.strerror}. Convert it first.") from None

    def _streams(self, container: Any) -> list[Any]:
        """Streams of pictures in time. Raises LogError."""
        attached = self._av.stream.Disposition.attached_pic
        found = [one for one in container.streams.video if not one.disposition & attached]
        if not found:
            raise LogError(f"{self._path} has no video stream. Give a file with pictures.")
        if known := [one for one in found if one.codec_context is not None]:
            return known
        raise LogError(
            f"{self._path} is encrypted, or of a codec that FFmpeg does not know. Convert it where it was made."
        )

    def _stream(self, container: Any) -> Any:
        return container.streams[self._index]


def _turn_deg(frame: Any) -> int | None:
    """Degrees counterclockwise by the display matrix; None where that mirrors the picture."""
    with suppress(KeyError):
        a, b, _, c, d = np.frombuffer(frame.side_data["DISPLAYMATRIX"], np.int32)[:5].tolist()
        if a * d < b * c:
            return None
    return round(frame.rotation)
