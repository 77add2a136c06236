"""Reader of result.mcap for what no table holds: pictures, references, fixes."""

from __future__ import annotations

import io
import json
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import McapReader, make_reader
from mcap.writer import MCAP0_MAGIC

from vplog.data import Floats, Gps
from vplog.geometry import se3
from vplog.results.closure_views import checked
from vplog.results.foxglove import GPS, camera_frame
from vplog.results.mcap import FIXES, PICTURES, VIEWS, McapContent
from vplog.results.tables import reading
from vplog.storage.parquet_limits import crc_of

_DATA_END = struct.Struct("<BQI")
"""Opcode, length and CRC-32 of all before, or 0: the MCAP specification, Data End."""
_FOOTER = struct.Struct("<BQQQI8s")
"""Opcode, length, starts of the summary and of its offsets, CRC-32 of the summary and of this so far, or 0, and magic:
the MCAP specification, Footer."""


@dataclass(frozen=True, eq=False)
class CameraPicture:
    """One picture of the camera."""

    stamp_ns: int
    image: bytes
    """JPEG."""
    matrix: Floats | None
    """(3, 3) px at the picture's size, None where the camera is not calibrated."""
    size: tuple[int, int]
    """Width and height in px, by the calibration."""


def read_pictures(path: Path) -> McapContent:
    """The pictures, references and fixes of a result.mcap. Raises ResultError where it is missing or damaged."""
    pictures, references, fixes, views, thumbnails = [], {}, [], {}, {}
    with _reading(path) as reader:
        for attachment in reader.iter_attachments():
            if named := re.fullmatch(r"reference-(\d{1,6})\.jpg", attachment.name):
                references[int(named[1])] = attachment.data
            if named := re.fullmatch(r"camera-(\d{1,6})-keyframe-(\d{1,9})\.jpg", attachment.name):
                thumbnails[int(named[1]), int(named[2])] = attachment.data
            if attachment.name == VIEWS:
                views = {int(row): checked(one) for row, one in json.loads(attachment.data).items()}
        for _, channel, message in reader.iter_messages(topics=[PICTURES, FIXES]):
            if channel.topic == FIXES:
                fixes.append(LocationFix.FromString(message.data))
                continue
            pictures.append(CompressedImage.FromString(message.data).data)
        named, gps = list(zip(_picture_rows(reader), pictures, strict=True)), _gps(reader, fixes)
    by_row = {row: data for row, data in named if row is not None}
    return McapContent(by_row, views, references, gps, thumbnails)


def read_fixes(path: Path) -> Gps | None:
    """The satellite fixes alone, None without any. Raises ResultError as above."""
    with _reading(path) as reader:
        fixes = [LocationFix.FromString(message.data) for _, _, message in reader.iter_messages(topics=[FIXES])]
        return _gps(reader, fixes)


def read_images(path: Path) -> Iterator[CameraPicture]:
    """The camera's pictures in order of time, one in memory at a time. Raises ResultError as above."""
    with _reading(path) as reader:
        wanted = [topic for topic in _topics(reader) if re.fullmatch(r"/cam/[^/]+/(image|calibration)", topic)]
        matrix, size = None, (0, 0)
        for _, channel, message in reader.iter_messages(topics=wanted) if wanted else ():
            if channel.topic.endswith("/calibration"):
                camera = CameraCalibration.FromString(message.data)
                matrix = np.reshape(camera.K, (3, 3)) if len(camera.K) == 9 else None
                size = camera.width, camera.height
            else:
                yield CameraPicture(message.log_time, CompressedImage.FromString(message.data).data, matrix, size)


def read_camera_poses(path: Path) -> list[Floats]:
    """body_from_camera (4, 4) of the cameras by number, as far as the file has them. Raises ResultError as above."""
    with _reading(path) as reader:
        found = _mounts(reader)
    return [found[name] for name in takewhile(found.__contains__, map(camera_frame, count()))]


def _mounts(reader: McapReader) -> dict[str, Floats]:
    """The static transforms (4, 4) by child frame."""
    found: dict[str, Floats] = {}
    for _, _, message in reader.iter_messages(topics=["/tf_static"]):
        for one in FrameTransforms.FromString(message.data).transforms:
            q, t = one.rotation, one.translation
            found[one.child_frame_id] = se3.from_vectors(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]))
    return found


def read_topics(path: Path) -> list[str]:
    """The topics of the file. Raises ResultError as above."""
    with _reading(path) as reader:
        return _topics(reader)


def _picture_rows(reader: McapReader) -> list[int | None]:
    """Rows of the ledger in the order of the pictures' messages, None for one of no closure."""
    about = next((one.metadata for one in reader.iter_metadata() if one.name == "vplog"), {})
    rows = json.loads(about.get("pictures", "[]"))
    return [row if isinstance(row, int) else None for row in rows] if isinstance(rows, list) else []


def _topics(reader: McapReader) -> list[str]:
    summary = reader.get_summary()
    return [channel.topic for channel in summary.channels.values()] if summary is not None else []


@contextmanager
def _reading(path: Path) -> Iterator[McapReader]:
    more = (McapError, TypeError, AttributeError, DecodeError, EOFError, struct.error)
    with reading(path, more=more), path.open("rb") as stream:
        _check_crcs(stream)
        yield make_reader(stream, validate_crcs=True)


def _check_crcs(stream: BinaryIO) -> None:
    """Raises ValueError or struct.error where the CRC-32 of the data or the summary does not match: those of chunks and
    attachments, which the reader checks, leave out names of topics and indexes."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(size - _FOOTER.size, 0))
    footer, length, summary_start, _, summary_crc, magic = _FOOTER.unpack(stream.read())
    stream.seek(0)
    data = crc_of(stream, summary_start - _DATA_END.size)
    end = _DATA_END.unpack(stream.read(_DATA_END.size))
    summary = crc_of(stream, size - summary_start - len(magic) - 4)
    framed = (footer, length, magic, *end[:2]) == (Opcode.FOOTER, 20, MCAP0_MAGIC, Opcode.DATA_END, 4)
    if not framed or end[2] not in (0, data) or summary_crc not in (0, summary):
        raise ValueError("It is damaged: its checksum does not match.")
    stream.seek(0)


def _gps(reader: McapReader, fixes: list[LocationFix]) -> Gps | None:
    if not fixes:
        return None
    placed = _mounts(reader).get(GPS)
    covariance = np.full((len(fixes), 3, 3), np.nan)
    for row, fix in enumerate(fixes):
        if len(fix.position_covariance) == 9:
            covariance[row] = np.reshape(fix.position_covariance, (3, 3))
    return Gps(
        np.array([fix.timestamp.ToNanoseconds() for fix in fixes], np.int64),
        np.array([fix.latitude for fix in fixes]),
        np.array([fix.longitude for fix in fixes]),
        np.array([fix.altitude for fix in fixes]),
        covariance,
        None if placed is None else placed[:3, 3],
    )
