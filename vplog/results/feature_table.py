"""features.parquet: the strongest features of every keyframe, which closures to drives that come later are checked by.

One row group for each keyframe, so that any of them is read alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog.data import Features
from vplog.results.keyframe_table import KeyframeTable, write_groups
from vplog.results.tables import FLOAT32_LIST, column, reading
from vplog.storage.parquet_limits import VERSION_ABOUT, VERSION_KEY

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
    groups = (_columns(row, features(row), most) for row in range(count))
    write_groups(path, FEATURES.with_metadata(header), groups, _LEVEL)


def _columns(row: int, own: Features, most: int) -> list[list[Any]]:
    floats = (own.points[:most, 0], own.points[:most, 1], own.sizes[:most], own.depth_m[:most])
    lists = [[np.ascontiguousarray(values, np.float32)] for values in floats]
    return [[row], [own.width], [own.height], *lists, [own.descriptors[:most].tobytes()]]


class FeatureTable(KeyframeTable[Features]):
    """Features of keyframes in such a file."""

    def __init__(self, path: Path, made_from: str, most: int) -> None:
        """Raises ResultError where there is no such file, or one made from something else or of fewer features."""
        super().__init__(path, FEATURES, made_from, self._features, 1, _IN_MEMORY)
        with reading(path, "", ""):
            held = int(self.header.get("vplog.most_features", "0")[:9])
            self._descriptor_bytes = int(self.header.get("vplog.descriptor_bytes", "128")[:9])
        if held < most:
            self.refuse("is of another state of the drive, or holds fewer features")

    def _features(self, table: pa.Table, at: int) -> Features:
        width, height = (int(table[name][at].as_py()) for name in ("width", "height"))
        x, y, size, depth = (np.array(table[name][at].values) for name in ("x", "y", "size", "depth"))
        if not len(y) == len(size) == len(depth) == len(x):
            raise ValueError("columns of different length")
        data = table["descriptors"][at].as_buffer()
        descriptors = np.frombuffer(data, np.uint8).reshape(len(x), self._descriptor_bytes)
        return Features(np.column_stack([x, y]), size, descriptors, depth, width, height)
