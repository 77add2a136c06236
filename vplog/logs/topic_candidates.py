"""The topics of a log that could be used, described by the first message of each."""

from __future__ import annotations

import re
from dataclasses import replace

from vplog.logs.formats.container import Channel, Container, Contents
from vplog.logs.messages.decode import decode
from vplog.logs.messages.pixels import is_depth, is_image, may_be_thermal
from vplog.logs.messages.records import BadMessageError, CalibrationMessage, ImageMessage, ImuMessage, kind_of
from vplog.logs.messages.video import codec_of
from vplog.logs.tf_odometry import frame_name
from vplog.logs.topic_selection import Candidate
from vplog.storage.image_file import PNG, image_size

_THERMAL = re.compile(r"therm|infra|lwir|flir|boson|lepton|(?<![a-z])ir(?![a-z])")
"""Words for thermal cameras: their kind, their band, and the most common makes."""
_First = ImageMessage | CalibrationMessage | ImuMessage
"""The first message of a topic, where it says more than its type."""


def read_candidates(container: Container, contents: Contents) -> list[Candidate]:
    """Every topic that could play a part; the first message of each tells depth from grey, its frame and its codec."""
    kinds = {channel: kind_of(channel) for channel in contents.counts}
    wanted = {c for c, kind in kinds.items() if kind in ("image", "camera_info", "imu") and contents.counts[c]}
    firsts: dict[Channel, _First] = {}
    left = set(wanted)
    for message in container.messages(wanted) if wanted else ():
        if message.channel not in left:
            continue
        try:
            record = decode(message.channel, message.data)
        except BadMessageError:
            continue  # the next one may be sound
        if isinstance(record, _First):
            firsts[message.channel] = record
            left.discard(message.channel)
        if not left:
            break
    found = [
        _candidate(channel, contents.counts[channel], kind, firsts.get(channel))
        for channel, kind in kinds.items()
        if kind
    ]
    frames = {c.frame for c in found if c.role == "image"}
    return [replace(c, role="image") if _is_thermal(c, firsts.get(c.channel), frames) else c for c in found]


def _candidate(channel: Channel, count: int, kind: str, first: _First | None) -> Candidate:
    role, codec, encoding, size = kind, "", "", None
    if kind == "tf" and channel.topic.rstrip("/").endswith("static"):
        role = "tf_static"
    if isinstance(first, ImageMessage):
        codec, encoding = codec_of(first.encoding) if first.compressed else "", first.encoding
        size = image_size(first.data) if first.compressed else (first.width, first.height)
        # by their name where encodings are ambiguous: old compressedDepth is `png`, RealSense records mono16
        head = bytes(first.data[:26])  # of a PNG ends with its bits and colour type: PNG 1.2, 4.1.1
        grey16 = first.encoding.startswith("mono16") or (head.startswith(PNG) and head.endswith(b"\x10\0"))
        named = channel.topic.endswith("/compressedDepth") or (grey16 and "depth" in channel.topic.lower())
        if not codec and (is_depth(first) or named):
            role = "depth"
    calibrated = isinstance(first, CalibrationMessage) and bool(first.matrix[0, 0] > 0)
    frame = frame_name(first.frame) if first else ""
    supported = not isinstance(first, ImageMessage) or is_image(first)
    if isinstance(first, ImuMessage):
        supported = any(abs(rate) > 0 for rate in first.gyro)
    return Candidate(channel, count, role, frame, calibrated, codec, encoding, size or (0, 0), supported)


def _is_thermal(candidate: Candidate, first: object, frames: set[str]) -> bool:
    """Whether images of 16UC1 are a thermal camera's, not depth: by the words of topic and frame; else if no camera
    has their frame, to which depth would be registered, and every px has a value. `frames` are those of the cameras."""
    if candidate.role != "depth" or not isinstance(first, ImageMessage) or not may_be_thermal(first):
        return False
    words = f"{candidate.channel.topic} {candidate.frame}".lower()
    if "depth" in words or _THERMAL.search(words):
        return "depth" not in words
    return candidate.frame not in frames
