"""Serialisation of the results of stages for the stage cache: Arrow tables, and JSON for plain values.

Reading checks what it reads, as of any file: what does not fit raises ValueError, and nothing larger than the bytes
given is made.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
import pyarrow as pa

from vplog.data import Bytes, Closures
from vplog.results import tables
from vplog.stages import PlaceState
from vplog.storage.image_file import decode_image

T = TypeVar("T")

_NUMBERS = "iuf"
"""Kinds of numpy types that are read: whole and floating numbers."""


@dataclass(frozen=True)
class Codec(Generic[T]):
    """Serialisation of a value."""

    to_bytes: Callable[[T], bytes]
    from_bytes: Callable[[bytes], T]


def json_codec(make: Callable[[Any], T], plain: Callable[[T], Any]) -> Codec[T]:
    """JSON of the plain values that `plain` gives, from which `make` builds the value again."""
    return Codec(lambda value: json.dumps(plain(value)).encode(), lambda data: make(json.loads(data)))


def columns_codec(kind: type[T]) -> Codec[T]:
    """An Arrow table of a dataclass of columns of numbers."""

    def from_bytes(data: bytes) -> T:
        table = _read(data)
        columns = {name: np.array(table[name].to_numpy()) for name in table.column_names}
        if any(table[name].null_count or columns[name].dtype.kind not in _NUMBERS for name in columns):
            raise ValueError("a column does not hold numbers")
        return kind(**columns)

    return Codec(
        lambda value: _written(pa.table({field.name: getattr(value, field.name) for field in fields(kind)})),  # type: ignore[arg-type]
        from_bytes,
    )


def closures_codec() -> Codec[Closures]:
    """An Arrow table of a ledger."""
    return Codec(
        lambda closures: _written(tables.exact_ledger(closures)),
        lambda data: tables.ledger_of(_read(data, tables.EXACT_LEDGER)),
    )


def descriptors_codec(state: PlaceState, count: int) -> Codec[Sequence[Any]]:
    """An Arrow table of `count` place descriptors in the recogniser's type."""

    def from_bytes(data: bytes) -> Sequence[Any]:
        table = _read(data, pa.schema({"place": state.arrow_type}))
        if len(table) != count:
            raise ValueError(f"it holds {len(table)} places instead of {count}")
        return state.from_arrow(table["place"].combine_chunks())

    return Codec(lambda descriptors: _written(pa.table({"place": state.to_arrow(descriptors)})), from_bytes)


def images_codec() -> Codec[list[tuple[int, Bytes]]]:
    """An Arrow table of grey images with a number each, as PNG: lossless at half the bytes."""
    schema = pa.schema({"number": pa.int64(), "png": pa.binary()})

    def to_bytes(images: list[tuple[int, Bytes]]) -> bytes:
        encoded = [cv2.imencode(".png", image)[1].tobytes() for _, image in images]
        return _written(pa.table([[number for number, _ in images], encoded], schema=schema))

    def from_bytes(data: bytes) -> list[tuple[int, Bytes]]:
        numbers, encoded = (column.to_pylist() for column in _read(data, schema))
        return [
            (int(number), np.asarray(decode_image(png), np.uint8)) for number, png in zip(numbers, encoded, strict=True)
        ]

    return Codec(to_bytes, from_bytes)


def _written(table: pa.Table) -> bytes:
    """A table as an Arrow IPC stream, which is read where it lies."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue().to_pybytes()


def _read(data: bytes, schema: pa.Schema | None = None) -> pa.Table:
    """The table, checked, with the columns of the schema where one is given."""
    try:
        table = pa.ipc.open_stream(data).read_all()
        table.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(str(error)) from None
    if schema is not None and not table.schema.equals(schema):
        raise ValueError(f"it holds columns {table.schema.names} instead of {schema.names}, or other types")
    return table
