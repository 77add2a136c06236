"""The table of localised pictures: verdict and pose of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog.results.tables import MATRIX, TableMetadata, column, pose_columns
from vplog.storage.parquet_limits import write_table
from vplog.storage.scratch import replacing

LOCALIZED = pa.schema(
    [
        column("picture", pa.string(), "", "File of the picture, or its stamp in a log."),
        column("stamp_ns", pa.int64(), "ns", "Stamp of the picture, in the log's clock."),
        column("verdict", pa.string(), "", "`accepted` where it has a pose."),
        column("sentence", pa.string(), "", "The verdict in one sentence."),
        column("drive", pa.string(), "", "Drive of the keyframe that explains it best; null without one.", True),
        column("keyframe", pa.int32(), "row", "That keyframe, 0 is the drive's first; null without one.", True),
        column("frame", pa.string(), "", "Frame of the pose: the first of the drives joined with that one.", True),
        column("matches", pa.int32(), "features", "Feature matches with that keyframe's landmarks."),
        column("inliers", pa.int32(), "features", "Features that agree with the pose."),
        column("places", pa.int32(), "keyframes", "Keyframes whose landmarks they match."),
        *pose_columns("", "world_from_camera, null where not localised", nullable=True),
        column("covariance", MATRIX, "rad^2, rad m, m^2", "6x6 of the pose in the camera, relative to the map.", True),
        column("longitude", pa.float64(), "deg", "WGS84; null where the frame's place on earth is not known.", True),
        column("latitude", pa.float64(), "deg", "WGS84; null where the frame's place on earth is not known.", True),
        column("altitude_m", pa.float64(), "m", "WGS84; null where the frame's place on earth is not known.", True),
    ]
)


def write_localized(path: Path, records: Sequence[dict[str, Any]], metadata: TableMetadata) -> None:
    """Write the records of pictures, in order; `metadata` is that of the map."""
    rows = [{**one, "covariance": np.ravel(one["covariance"])} if "covariance" in one else one for one in records]
    table = pa.Table.from_pylist(rows, LOCALIZED.with_metadata({**metadata.record(), "vplog.table": "localized"}))
    with replacing(path) as stream:
        write_table(stream, table, compression="zstd")
