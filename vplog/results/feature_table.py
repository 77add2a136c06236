"""features.parquet: the strongest features of every keyframe, which closures to drives that come later are checked by.

One row group for each keyframe, so that any of them is read alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa

from vplog.data import Features
from vplog.errors import ResultError
from vplog.results.tables import FLOAT32_LIST, column
from vplog.storage.parquet_limits import VERSION_ABOUT, VERSION_KEY, check_columns, open_table, table_writer
from vplog.storage.scratch import replacing

_LEVEL = 1
"""Level of zstd: descriptors shrink by a fifth at any level."""

_IN_MEMORY = 128
"""Keyframes whose features are cached, some 20 MB."""


FEATURES = pa.schema(
    [
        column("keyframe", pa.int32(), "row", "Row of the keyframe, 0 is the first."),
        column("width", pa.int32(), "px", "Width of the image."),
        column("height", pa.int32(), "px", "Height of the image."),
        column("x", FLOAT32_LIST, "px", "Column of each feature, strongest first; 0 is the centre of the left pixel."),
        column("y", FLOAT32_LIST, "px", "Row of each feature; 0 is the centre of the topmost pixel."),
        column("size", FLOAT32_LIST, "px", "Diameter of the described neighbourhood."),
        column("depth", FLOAT32_LIST, "m", "Depth along the camera's z, NaN where unknown."),
        column(
            "descriptors",
            pa.binary(),
            "bytes",
            "Equally many bytes for each feature, 128 of SIFT, one after the other.",
        ),
    ]
)

HEADER = {
    "vplog.table": "Name of the table.",
    "vplog.made_from": "Hash of all that the features depend on.",
    "vplog.most_features": "Most features of a keyframe.",
    "vplog.descriptor_bytes": "Bytes of one descriptor, 128 of SIFT.",
    VERSION_KEY: VERSION_ABOUT,
}
"""Metadata of the file."""


def write_features(path: Path, count: int, features: Callable[[int], Features], most: int, made_from: str) -> None:
    """The `most` strongest features of keyframes 0..count - 1. `made_from` is a hash that `FeatureTable` requires."""
    header = {"vplog.table": "features", "vplog.made_from": made_from, "vplog.most_features": str(most)}
    if count:  # an image without features does not tell
        header["vplog.descriptor_bytes"] = str(features(0).descriptors.shape[1])
    schema = FEATURES.with_metadata(header)
    with (
        replacing(path) as stream,
        table_writer(stream, schema, compression="zstd", compression_level=_LEVEL, use_dictionary=False) as writer,
    ):
        for row in range(count):
            own = features(row)
            floats = [own.points[:most, 0], own.points[:most, 1], own.sizes[:most], own.depth_m[:most]]
            writer.write_table(
                pa.Table.from_arrays(
                    [
                        *(pa.array([value], pa.int32()) for value in (row, own.width, own.height)),
                        *(pa.array([np.ascontiguousarray(values, np.float32)], FLOAT32_LIST) for values in floats),
                        pa.array([own.descriptors[:most].tobytes()], pa.binary()),
                    ],
                    schema=writer.schema,
                )
            )


class FeatureTable:
    """Features of keyframes in such a file. Reads are safe from any thread."""

    def __init__(self, path: Path, made_from: str, most: int) -> None:
        """Raises ResultError where there is no such file, or one made from something else or of fewer features."""
        try:
            self._file = open_table(path)
            check_columns(self._file.schema_arrow, FEATURES)
            header = self._file.schema_arrow.metadata or {}
            held = int(header.get(b"vplog.most_features", b"0")[:9])
            self._descriptor_bytes = int(header.get(b"vplog.descriptor_bytes", b"128")[:9])
        except (OSError, ValueError, pa.ArrowException) as error:
            raise ResultError(f"{path} cannot be read: {str(error).splitlines()[0].rstrip('.')}.") from None
        self._path, self._lock = path, threading.Lock()
        self._read = lru_cache(_IN_MEMORY)(self._from_file)
        if header.get(b"vplog.made_from") != made_from.encode() or held < most:
            self.close()
            raise ResultError(f"{path} is of another state of the drive, or holds fewer features.")

    def __len__(self) -> int:
        return self._file.num_row_groups

    def close(self) -> None:
        self._file.close()

    def __getitem__(self, row: int) -> Features:
        """Raises ResultError where the file is damaged."""
        return self._read(row)

    def _from_file(self, row: int) -> Features:
        try:
            with self._lock:
                table = self._file.read_row_group(row, FEATURES.names)
            width, height = (int(table[name][0].as_py()) for name in ("width", "height"))
            x, y, size, depth = (
                table[name].combine_chunks().flatten().to_numpy() for name in ("x", "y", "size", "depth")
            )
            data = table["descriptors"][0].as_buffer()
            descriptors = np.frombuffer(data, np.uint8).reshape(len(x), self._descriptor_bytes)
            points = np.column_stack([x, y]).astype(np.float32)
            if not len(y) == len(size) == len(depth) == len(x):
                raise ValueError("columns of different length")
        except (OSError, ValueError, IndexError, pa.ArrowException) as error:
            raise ResultError(
                f"{self._path}: keyframe {row} cannot be read: {str(error).splitlines()[0].rstrip('.')}."
            ) from None
        return Features(points, size.astype(np.float32), descriptors, depth.astype(np.float32), width, height)
