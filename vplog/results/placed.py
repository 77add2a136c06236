"""Where the views of a log are in a map, as a Parquet table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pyarrow as pa

from vplog.results.tables import column
from vplog.storage.parquet_limits import write_table
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vplog.results.tables import TableMetadata


PLACED = pa.schema(
    [
        column("query", pa.int32(), "row", "View of the log, 0 is the first."),
        column("query_stamp_ns", pa.int64(), "ns", "Stamp of the view, in the log's clock."),
        column("rank", pa.int32(), "1", "0 is the view's best answer."),
        column("drive", pa.string(), "", "Drive of the place; with keyframe it joins with MAP/keyframes."),
        column("keyframe", pa.int32(), "row", "Keyframe of that drive, 0 is the first."),
        column("stamp_ns", pa.int64(), "ns", "Stamp of the keyframe, in its log's clock."),
        column("score", pa.float32(), "1", "Similarity by the recogniser; of a sequence, how much above the usual."),
        column("support", pa.int32(), "1", "Other views of the window that agree; 0 where views stand alone."),
    ]
)
"""What a query answers, in order of the views, then of rank."""


def placed_table(columns: Sequence[Any]) -> pa.Table:
    """The table of values (R,) for each column in order."""
    arrays = [pa.array(values, field.type) for values, field in zip(columns, PLACED, strict=True)]
    return pa.Table.from_arrays(arrays, schema=PLACED)


def write_placed(path: Path, table: pa.Table, metadata: TableMetadata) -> None:
    """Write the answers, with what the map is described with in the header."""
    header = {**metadata.record(), "vplog.table": "placed"}
    with replacing(path) as stream:
        write_table(stream, table.replace_schema_metadata(header), compression="zstd")
