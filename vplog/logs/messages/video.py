"""Video in packets, as messages hold H.264, H.265, VP9 and AV1, each frame decoded from the key frame before it.

Decoding runs forward only: for frames in order of time every packet is decoded at most once, and stretches between key
frames without a frame of interest not at all. Behind a damaged or missing packet nothing is decoded up to the next key
frame.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np

from vplog.data import Bytes
from vplog.errors import LogError
from vplog.logs.messages.h264 import FrameNumbers
from vplog.logs.messages.records import BadMessageError

if TYPE_CHECKING:
    from av import VideoFrame

_CODECS = {
    "264": ("h264", "H.264"),
    "avc": ("h264", "H.264"),
    "265": ("hevc", "H.265"),
    "hevc": ("hevc", "H.265"),
    "vp9": ("vp9", "VP9"),
    "av1": ("av1", "AV1"),
}
"""By a part of a format's first word (`h264`, `libx264`, `hevc_nvenc`): FFmpeg's codec, and its usual name."""
NAMES = {**dict(_CODECS.values()), "vp8": "VP8"}
"""Usual names of the codecs that have a decoder here."""
_DECODERS = {"av1": ("libdav1d",), "vp9": ("libvpx-vp9", "vp9"), "vp8": ("libvpx", "vp8")}
"""FFmpeg's decoders, the best first, where that of the codec's own name is not: its `av1` is for graphics cards alone,
and its `vp9` and `vp8` show a wrong picture behind a damaged or missing packet."""
MAX_PIXELS = 2**25
"""px of a video frame that is decoded: 8K (7680 x 4320); a decoder keeps up to 16 of them."""
_DELAY = 64
"""Packets behind a frame that are given to the decoder before the frame counts as lost: H.264 and H.265 reorder 16."""
_PADDING = 64
_BROKEN = "a video packet between its key frame and it is damaged or missing"
_START_CODE = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
_SEI, _RECOVERY_POINT = 6, 6
"""nal_unit_type of supplemental information, and its payloadType that names a picture from which decoding can start
(ITU-T H.264, table 7-1 and D.2.8): open groups of pictures and gradual refresh have no other after the first."""
_SEI_LIMIT = 256
"""Bytes of supplemental information that are looked at."""
_IDR = re.compile(rb"\x00\x00\x01[\x05\x25\x45\x65]")
_REFERENCES = 16
"""Pictures that H.264 keeps at most: so long behind a recovery point may packets release some that came before it,
which FFmpeg takes for an error."""
_DELIMITER, _SEQUENCE_HEADER = b"\x12\x00", 1
"""The unit (OBU) that an AV1 packet may begin with, and the type of the one behind it at a key frame: AV1 bitstream
5.3."""
_UNREAD, PLAIN, _PARAMETERS, _KEY, WHOLE_KEY = range(5)
"""Kinds of packets: not read; needs those before it; parameter sets alone; a key frame without, or with them."""


def codec_of(encoding: str) -> str:
    """FFmpeg's codec for a compressed image message's format; empty where it is no video."""
    first = encoding.split(";", maxsplit=1)[0].lower()
    return next((codec for word, (codec, _) in _CODECS.items() if word in first), "")


class VideoStream:
    """The frames of one topic or file, by their row: the number of their packet, or their place as they are shown."""

    def __init__(
        self, codec: str, packet: Callable[[int], bytes | None], count: int, decoder: Callable[[], Any],
        rows: Sequence[int] = (), kinds: bytes = b"",
    ) -> None:  # fmt: skip
        """`packet` gives a payload by its number, empty where it is damaged, None where it is the one before it once
        more; `decoder` a new decoder. `rows` and `kinds` of the packets are given where they are known."""
        self._codec, self._packet, self._count, self._new_decoder = codec, packet, count, decoder
        self._kinds = bytearray(kinds or count)
        self._rows = rows or range(count)
        self._number = {row: number for number, row in enumerate(rows)} if rows else range(count)
        self._decoder: Any = None
        self._numbers: FrameNumbers | None = None
        self._last = 0
        """The last row given out: frames behind it that came out since are ready."""
        self._next = 0
        """The first packet that the decoder has not been given."""
        self._settled = 0
        """The first packet whose errors are damage."""
        self._damaged = -1
        """The last packet that did not decode: none decodes from there to the next key frame."""
        self._ready: dict[int, VideoFrame] = {}
        self._before: dict[int, int] = {}
        """By packet an earlier one, up to which no key frame was found."""

    def first_key(self) -> int | None:
        """The first packet from which decoding can start; None where there is none."""
        return next((number for number in range(self._count) if self._kind(number) >= _KEY), None)

    def frame(self, row: int) -> VideoFrame:
        """Rows are best read in increasing order. Raises BadMessageError where it cannot be decoded, and LogError where
        PyAV is not installed."""
        if row not in self._ready:
            self._advance(row)
        self._last = row
        self._ready = {later: frame for later, frame in self._ready.items() if later >= row}
        if row not in self._ready:
            raise BadMessageError("its video packet decodes to no frame")
        return self._ready[row]

    def _advance(self, row: int) -> None:
        """Give the decoder packets until the frame of this row comes out."""
        number, running = self._number[row], self._decoder is not None and self._last <= row
        key = self._key_before(number, self._next + 1 if running else 0)  # at a key frame that is next, it runs on
        if key is None and not running:
            raise BadMessageError("no key frame comes before it")
        if key is not None:
            if key <= self._damaged <= number:
                raise BadMessageError(_BROKEN)
            self._restart(key)
        self._run(row)
        if row not in self._ready and key and self._codec not in _DECODERS:
            # pictures behind a key frame that are shown before it may refer to what comes before it (RASL, H.265
            # 3.114; B-frames of MPEG-4), and so may those of a gradual refresh
            earlier = self._key_before(key - 1, 0)
            if earlier is not None and not earlier <= self._damaged <= number:
                self._restart(earlier)
                self._run(row)

    def _run(self, row: int) -> None:
        while row not in self._ready and self._next < min(self._count, self._number[row] + _DELAY):
            self._feed(self._next, row)
            self._next += 1
        if row not in self._ready and self._next == self._count:
            self._decode(None, row, row)  # what the decoder held back
            self._decoder = None

    def _restart(self, key: int) -> None:
        self._decoder = self._new_decoder()
        self._next = self._settled = key
        self._numbers = FrameNumbers() if self._codec == "h264" else None
        if self._numbers and not _IDR.search(self._packet(key) or b""):
            self._settled += _REFERENCES
        if self._kind(key) == _KEY:  # its parameter sets came in a packet of their own
            before = (r for r in range(key - 1, -1, -1) if self._kind(r) in (_PARAMETERS, WHOLE_KEY))
            if (row := next(before, None)) is not None:
                self._feed(row, key)

    def _feed(self, number: int, row: int) -> None:
        data = self._packet(number)
        if data is None:
            return None
        follows = self._numbers is None or self._numbers.follows(data)
        if not data or not follows:  # FFmpeg takes an empty packet for the end
            return self._fail(number, row)
        packet = padded(data)
        packet.pts, packet.dts = self._rows[number], number
        return self._decode(packet, number, row)

    def _decode(self, packet: Any, number: int, row: int) -> None:
        """Decode one packet, None at the end; what comes out from this row on is ready."""
        from av.error import FFmpegError

        try:
            for frame in self._decoder.decode(packet):
                if frame.is_corrupt:
                    return self._fail(number, row)
                if frame.pts is not None and frame.pts >= row:
                    self._ready[frame.pts] = frame
        except FFmpegError:
            if number >= self._settled:
                return self._fail(number, row)
        return None

    def _fail(self, number: int, row: int) -> None:
        """Give the decoder up at this packet, with what it held back of those before."""
        from av.error import FFmpegError

        decoder, self._decoder, self._damaged = self._decoder, None, number
        with suppress(FFmpegError):  # it held nothing
            for frame in decoder.decode(None) if decoder is not None else ():
                broken = frame.is_corrupt or (number < self._count and frame.pts == self._rows[number])
                if frame.pts is not None and frame.pts >= row and not broken:
                    self._ready[frame.pts] = frame
        if row not in self._ready:
            raise BadMessageError(_BROKEN)

    def _key_before(self, number: int, first: int) -> int | None:
        """The last key frame of the packets first..number."""
        at = number
        while at >= first and self._kind(at) < _KEY:
            at = self._before.get(at, at - 1)
        if at < number:
            self._before[number] = at
        return at if at >= first else None

    def _kind(self, number: int) -> int:
        if self._kinds[number] == _UNREAD:
            self._kinds[number] = packet_kind(self._codec, self._packet(number) or b"")
        return self._kinds[number]


def packet_kind(codec: str, data: bytes) -> int:
    """Whether decoding can start at a packet: by its first unit that holds a picture."""
    if codec == "vp9":  # uncompressed header, VP9 bitstream 6.2: marker 10, profile, show_existing_frame, frame_type
        return WHOLE_KEY if data and data[0] >> 6 == 2 and not data[0] & 0b1100 else PLAIN
    if codec == "av1":  # a sequence header comes with every key frame, behind the delimiter: AV1 bitstream 7.5
        first = data.removeprefix(_DELIMITER)[:1]
        return WHOLE_KEY if first and first[0] >> 3 & 0xF == _SEQUENCE_HEADER else PLAIN
    parameters = recovery = False
    for unit in _START_CODE.finditer(data):
        header = unit[1][0]
        kind = header & 0x1F if codec == "h264" else header >> 1 & 0x3F
        if codec == "h264" and kind == _SEI:
            recovery |= _RECOVERY_POINT in _payload_types(data[unit.end() : unit.end() + _SEI_LIMIT])
        if kind == (7 if codec == "h264" else 33):  # SPS: ITU-T H.264 table 7-1, H.265 table 7-1
            parameters = True
        if (1 <= kind <= 5) if codec == "h264" else kind <= 31:  # a slice
            key = (kind == 5 or recovery) if codec == "h264" else 16 <= kind <= 21  # IDR; BLA, IDR, CRA
            return (WHOLE_KEY if parameters else _KEY) if key else PLAIN
    return _PARAMETERS if parameters else PLAIN


def _payload_types(data: bytes) -> set[int]:
    """Types of the messages of supplemental information (ITU-T H.264, 7.3.2.3.1), up to the first that is cut off."""
    found, position = set(), 0
    while position < len(data) and data[position:] != b"\x80":  # not the trailing bits
        numbers = []
        for _ in range(2):  # type and size: each byte of 255 goes on
            start = position
            while data[position : position + 1] == b"\xff":
                position += 1
            if position >= len(data):
                return found
            numbers.append(255 * (position - start) + data[position])
            position += 1
        found.add(numbers[0])
        position += numbers[1]
    return found


_FULL_RANGE = 2
"""AVCOL_RANGE_JPEG: luma runs over 0..255; else, by convention, over 16..235 (ITU-R BT.601)."""
_EIGHT_BITS = re.compile(r"(yuvj?4[0-9]{2}p|nv12|nv16|nv21|gray)$")
_STRETCH = np.clip(np.rint((np.arange(256) - 16.0) * 255 / 219), 0, 255).astype(np.uint8)


def grey(frame: Any) -> Bytes:
    """(H, W) uint8: the luma as JPEG and PNG have it."""
    if not _EIGHT_BITS.match(frame.format.name):
        return np.asarray(cv2.cvtColor(rgb(frame), cv2.COLOR_RGB2GRAY), np.uint8)
    plane = frame.planes[0]
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
    full = int(frame.color_range) == _FULL_RANGE or frame.format.name.startswith("yuvj")
    full |= frame.format.name == "gray" and not int(frame.color_range)  # unset: as FFmpeg converts it
    return rows.copy() if full else _STRETCH[rows]


def rgb(frame: Any) -> Bytes:
    """(H, W, 3) uint8 red, green, blue."""
    return frame.to_ndarray(format="rgb24")


def new_decoder(codec: str, subject: str, note: Callable[[str], object], advice: str = "") -> Any:
    """A decoder of PyAV, an extra, that shows no wrong picture where it can. `note` takes what it cannot. Raises
    LogError where PyAV or the codec's decoder is not there; `subject` is what holds the video."""
    av = pyav(f"{subject} is {NAMES[codec]} video", advice)
    best, *others = _DECODERS.get(codec, (codec,))
    for name in (best, *others):
        with suppress(ValueError):  # PyAV's UnknownCodecError
            decoder = av.CodecContext.create(name, "r")
            if name != best:
                note(
                    f"The FFmpeg of this PyAV lacks {best}: {subject}, {NAMES[codec]} video, may show a wrong picture "
                    "behind a damaged or missing packet. Install PyAV's own wheel (pip install --force-reinstall av)."
                )
            return careful(decoder)
    raise LogError(
        f"{subject} is {NAMES[codec]} video, and the FFmpeg of this PyAV lacks its decoder, {best}. Install PyAV's own "
        f"wheel (pip install --force-reinstall av){advice}."
    )


def padded(data: bytes) -> Any:
    """A packet and the zeros that decoders read behind it (FFmpeg's AV_INPUT_BUFFER_PADDING_SIZE), where PyAV has what
    happens to lie there."""
    import av

    return cast("Any", av.Packet)(memoryview(data + bytes(_PADDING))[: len(data)])


def careful(decoder: Any) -> Any:
    """The decoder, set to fail where it would show a wrong picture."""
    decoder.options = {"err_detect": "explode", "max_pixels": str(MAX_PIXELS)}
    decoder.thread_count = 1  # with more, what damage does is a matter of chance
    return decoder


def pyav(subject: str, advice: str = "") -> Any:
    """PyAV, an extra. Raises LogError where it is not installed."""
    try:
        import av
    except ImportError:
        raise LogError(
            f"{subject}, and PyAV, which decodes it, is not installed. Install PyAV (pip install av){advice}."
        ) from None
    return av
