"""Parquet tables of keyframes, of which a few row groups at a time are in memory."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import pyarrow as pa

from vplog.errors import ResultError
from vplog.results.tables import reading, unreadable
from vplog.storage.parquet_limits import check_columns, check_size, open_table, table_writer
from vplog.storage.scratch import replacing

T = TypeVar("T")


def write_groups(
    path: Path, schema: pa.Schema, groups: Iterable[Sequence[Any]], level: int, split: Sequence[str] = ()
) -> None:
    """Write the values of each row group by column, with zstd of a level; of the columns `split` the first bytes of all
    values come first, then the second ones. Raises ResultError where the disk is full."""
    options: dict[str, Any] = {"compression": "zstd", "compression_level": level, "use_dictionary": False}
    options["column_encoding"] = dict.fromkeys(split, "BYTE_STREAM_SPLIT") or None
    with replacing(path, parents=True) as stream, table_writer(stream, schema, **options) as writer:
        for columns in groups:
            arrays = [pa.array(values, field.type) for values, field in zip(columns, schema, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=writer.schema))


class KeyframeTable(Generic[T]):
    """Keyframes of a file with so many rows in a group, each as `read` makes it of a group and its row there, so many
    groups in memory. Reads are safe from any thread."""

    def __init__(
        self, path: Path, schema: pa.Schema, made_from: str, read: Callable[[pa.Table, int], T], rows: int, cached: int
    ) -> None:
        """Raises ResultError where there is no such file, or one made from something else."""
        with reading(path, "", ""):
            self._file = open_table(path)
            check_columns(self._file.schema_arrow, schema)
            check_size(path, self._file, schema.names)
            header = self._file.schema_arrow.metadata or {}
            self.header = {key.decode(): value.decode() for key, value in header.items()}
        self._path, self._schema, self._parse, self._rows = path, schema, read, rows
        self._lock, self._group = threading.Lock(), lru_cache(cached)(self._read_group)
        if self.header.get("vplog.made_from") != made_from:
            self.refuse("is of another state of the drive")

    def refuse(self, why: str) -> None:
        self.close()
        raise ResultError(f"{self._path} {why}.")

    def __len__(self) -> int:
        return self._file.metadata.num_rows

    def close(self) -> None:
        self._file.close()
        self._group.cache_clear()  # which refers to this object, and would stay until a collection of cycles

    def __getitem__(self, row: int) -> T:
        """Raises ResultError where the file is damaged."""
        try:
            return self._group(row // self._rows)[row % self._rows]
        except (OSError, LookupError, ValueError, pa.ArrowException) as error:
            raise unreadable(f"{self._path}: keyframe {row}", error) from None

    def _read_group(self, number: int) -> list[T]:
        with self._lock:
            table = self._file.read_row_group(number, self._schema.names)
        return [self._parse(table, at) for at in range(len(table))]
