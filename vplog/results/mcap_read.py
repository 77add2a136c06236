"""What result.mcap holds that no table does, read back: pictures, references, fixes."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.reader import make_reader

from vplog.data import Gps
from vplog.errors import ResultError
from vplog.results.mcap import FIXES, PICTURES

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True, eq=False)
class Found:
    """Empty where the run was written without."""

    pictures: dict[int, bytes] = field(default_factory=dict)
    """JPEG of a candidate closure by its row in the ledger."""
    references: dict[int, bytes] = field(default_factory=dict)
    """JPEG of a reference of the library by its number."""
    gps: Gps | None = None


def read_pictures(path: Path) -> Found:
    """Of a result.mcap. Raises ResultError where it is not there or damaged."""
    pictures, references, fixes = {}, {}, []
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            for attachment in reader.iter_attachments():
                if named := re.fullmatch(r"reference-(\d{1,6})\.jpg", attachment.name):
                    references[int(named[1])] = attachment.data
            for _, channel, message in reader.iter_messages(topics=[PICTURES, FIXES]):
                if channel.topic == FIXES:
                    fixes.append(LocationFix.FromString(message.data))
                    continue
                picture = CompressedImage.FromString(message.data)
                if named := re.fullmatch(r"closure_(\d{1,9})", picture.frame_id):
                    pictures[int(named[1])] = picture.data
    except FileNotFoundError:
        raise ResultError(f"{path} does not exist. Give the folder that `vplog run -o` wrote.") from None
    except (OSError, McapError, DecodeError, ValueError, EOFError, struct.error) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise ResultError(f"{path} cannot be read: {why} Run `vplog run` again to write it anew.") from None
    return Found(pictures, references, _gps(fixes) if fixes else None)


def _gps(fixes: list[LocationFix]) -> Gps:
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
    )
