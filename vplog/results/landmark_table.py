"""landmarks.parquet: the landmarks of every keyframe of a drive, by which pictures are localised in it.

A landmark takes 72 bytes: its pixel to 1/65535 of the image, inverse depth and its error as half floats, and four bits
of each value of its descriptor.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog.data import Bytes, Camera, Features, Floats
from vplog.results.keyframe_table import KeyframeTable, write_groups
from vplog.results.run_cameras import camera_from
from vplog.results.tables import column, reading
from vplog.storage.json_records import plain
from vplog.storage.parquet_limits import VERSION_ABOUT, VERSION_KEY

_LEVEL = 15
"""Level of zstd, at 1.5 ms a keyframe: a tenth less than at 3, and read as fast."""
_KEYFRAMES_PER_GROUP = 16
"""Keyframes read at once, some 200 kB; a row group for each would take as much for its head as for landmarks."""
_IN_MEMORY = 64
"""Row groups that are cached, some 20 MB."""
_PIXELS = 65535
"""Steps of a pixel's position along a side of the image: a fiftieth of a px of full HD."""

_UINT16_LIST = pa.list_(pa.field("element", pa.uint16(), nullable=False))
_HALF_LIST = pa.list_(pa.field("element", pa.float16(), nullable=False))
LANDMARKS = pa.schema(
    [
        column("keyframe", pa.int32(), "row", "Row of the keyframe, 0 is the first."),
        column("x", _UINT16_LIST, "1/65535", "Column of each landmark in the image, as a share of its width."),
        column("y", _UINT16_LIST, "1/65535", "Row of each landmark in the image, as a share of its height."),
        column("inverse_depth", _HALF_LIST, "1/m", "Inverse depth along the camera's z."),
        column("sigma", _HALF_LIST, "1/m", "Standard deviation of the inverse depth."),
        column(
            "descriptors", pa.binary(), "4 bits",
            "Equally many bytes for each landmark, of two values each, the first in the lower half: 64 of SIFT.",
        ),
    ]
)  # fmt: skip
HEADER = {
    "vplog.table": "Name of the table.",
    "vplog.made_from": "Hash of all that the landmarks depend on.",
    "vplog.camera": "The camera as JSON: matrix, distortion, size in px, body_from_camera.",
    "vplog.scale": "Where metres come from: `depth`, `stereo` or `odometry`.",
    "vplog.descriptor_bytes": "Bytes of one descriptor, 64 of SIFT.",
    VERSION_KEY: VERSION_ABOUT,
}
"""Metadata of the file."""


def quantised(descriptors: Bytes) -> Bytes:
    """(L, D / 2) the upper four bits of values (L, D), two to a byte."""
    upper = descriptors >> 4
    return np.asarray(upper[:, ::2] | (upper[:, 1::2] << 4), np.uint8)


def restored(packed: Bytes) -> Bytes:
    """(L, D) values from their upper four bits, in the middle of what these stand for; 0 stays 0, the commonest."""
    upper = np.stack([packed & 15, packed >> 4], axis=2).reshape(len(packed), 2 * packed.shape[1])
    return np.where(upper > 0, (upper << 4) | 8, 0).astype(np.uint8)


def write_landmarks(
    path: Path, keyframes: Iterable[tuple[Features, Floats]], camera: Camera, scale: str, made_from: str
) -> None:
    """The landmarks of keyframes 0, 1, ...: features (L,) with their depths, and the standard deviation (L,) of the
    inverse depths in 1/m. Raises ResultError where the disk is full."""
    header = {
        "vplog.table": "landmarks", "vplog.made_from": made_from, "vplog.scale": scale,
        "vplog.camera": json.dumps(plain(dict(vars(camera)))),
    }  # fmt: skip
    rows = enumerate(keyframes)
    groups = iter(lambda: list(islice(rows, _KEYFRAMES_PER_GROUP)), [])
    split = ("x.list.element", "y.list.element")  # two bytes of four are zero
    write_groups(path, LANDMARKS.with_metadata(header), map(_columns, groups), _LEVEL, split)


def _columns(keyframes: Sequence[tuple[int, tuple[Features, Floats]]]) -> list[list[Any]]:
    shares = [
        np.rint((own.points + 0.5) / [own.width, own.height] * _PIXELS).clip(0, _PIXELS).astype(np.uint16)
        for _, (own, _) in keyframes
    ]
    return [
        [row for row, _ in keyframes],
        [share[:, 0] for share in shares],
        [share[:, 1] for share in shares],
        [(1.0 / own.depth_m).astype(np.float16) for _, (own, _) in keyframes],
        [sigma.astype(np.float16) for _, (_, sigma) in keyframes],
        [quantised(own.descriptors).tobytes() for _, (own, _) in keyframes],
    ]


class LandmarkTable(KeyframeTable[tuple[Features, Floats]]):
    """Landmarks of keyframes in such a file: features (L,) with depths, and the standard deviation (L,) of the inverse
    depths."""

    def __init__(self, path: Path, made_from: str) -> None:
        """Raises ResultError where there is no such file, or one made from something else."""
        super().__init__(path, LANDMARKS, made_from, self._landmarks, _KEYFRAMES_PER_GROUP, _IN_MEMORY)
        with reading(path, "", ""):
            self.camera = camera_from(json.loads(self.header["vplog.camera"]), "Run `vplog localize` again.")
            self.scale = self.header["vplog.scale"]

    def _landmarks(self, table: pa.Table, at: int) -> tuple[Features, Floats]:
        x, y, rho, sigma = (
            table[name][at].values.to_numpy(zero_copy_only=False)
            for name in ("x", "y", "inverse_depth", "sigma")
        )  # fmt: skip
        count, data = len(x), table["descriptors"][at].as_buffer()
        if not len(y) == len(rho) == len(sigma) == count or (data.size % count if count else data.size):
            raise ValueError("columns of different length")
        packed = np.frombuffer(data, np.uint8).reshape(count, -1) if count else np.empty((0, 64), np.uint8)
        size = np.array([self.camera.width, self.camera.height])
        points = np.column_stack([x, y]) / _PIXELS * size - 0.5
        with np.errstate(divide="ignore"):
            depth_m = 1.0 / rho.astype(np.float32)
        features = Features(
            points.astype(np.float32), np.zeros(count, np.float32), restored(packed), depth_m, *size.tolist()
        )
        return features, sigma.astype(np.float64)
