"""Records of thousands of drives in one file: gzip of JSON."""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path
from typing import Any

from vplog.errors import ResultError
from vplog.storage.json_records import parse_json
from vplog.storage.parquet_limits import check_file
from vplog.storage.scratch import replacing

_MOST_RATIO = 100
"""Longest text as a multiple of the compressed file: records are mostly hashes, names and numbers, which shrink to a
tenth."""


def write_compressed(path: Path, value: Any) -> None:
    """Write plain values, however many, as gzip of JSON: the same bytes for the same values. Raises ResultError."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    with replacing(path, parents=True) as stream:
        stream.write(gzip.compress(text, 1, mtime=0))


def read_compressed(path: Path) -> Any:
    """The values that `write_compressed` wrote. Raises ResultError where the file is missing or damaged."""
    try:
        check_file(path)
        unpacked = zlib.decompressobj(31)
        packed = path.read_bytes()
        text = unpacked.decompress(packed, _MOST_RATIO * len(packed))
        if not unpacked.eof:  # its checksum is behind it
            raise ValueError
        return parse_json(text)
    except (OSError, ValueError, RecursionError, zlib.error):
        raise ResultError(f"{path} is missing or damaged.") from None
