"""Columns of places: to Arrow, and back from a table that anyone may have written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from vplog.errors import LibraryError


def to_column(arrow_type: pa.DataType, arrays: Iterator[NDArray]) -> pa.Array:
    """A column of fixed-size lists, or of structs of them, from the values (N, ...) of each list in turn."""
    if isinstance(arrow_type, pa.StructType):
        parts = [to_column(part.type, arrays) for part in arrow_type]
        return pa.StructArray.from_arrays(parts, fields=list(arrow_type))
    return pa.FixedSizeListArray.from_arrays(pa.array(next(arrays).reshape(-1), arrow_type.value_type), type=arrow_type)


def from_column(column: pa.Array, arrow_type: pa.DataType) -> list[NDArray]:
    """The values (N, length) of each fixed-size list of a `to_column`. Raises LibraryError where the column is of
    another type, or lacks a finite value."""
    check_type(column, arrow_type)
    check_values(column)
    if isinstance(arrow_type, pa.StructType):
        return [values for part in arrow_type for values in from_column(column.field(part.name), part.type)]
    values = column.flatten().to_numpy().reshape(-1, arrow_type.list_size)
    if not np.all(np.isfinite(values)):
        raise LibraryError("Some descriptors have values that are not finite; compute them again with `vplog run`.")
    return [values]


def check_type(column: pa.Array, arrow_type: pa.DataType) -> None:
    """Raises LibraryError where a column is not of a recogniser's type."""
    if not column.type.equals(arrow_type):
        raise LibraryError(f"Descriptors of type {column.type} do not fit this recogniser's {arrow_type}.")


def check_values(*arrays: pa.Array) -> None:
    """Raises LibraryError where one of them, or what it lists, has no value."""
    for array in arrays:
        lists = pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type)
        if array.null_count or (lists and array.flatten().null_count):
            raise LibraryError("Some descriptors have no value; compute them again with `vplog run`.")


def to_lists(items: pa.Array, lengths: Sequence[int], arrow_type: pa.ListType) -> pa.Array:
    """A column of lists of these lengths from all their items."""
    start = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(start), items, type=arrow_type)


def list_slices(column: pa.ListArray, words: NDArray[np.uint16], vocabulary: int) -> list[slice]:
    """The slice of all words (K,) for each list of the column. Raises LibraryError where the words of a place do not
    rise or are beyond the `vocabulary`."""
    if len(words) and words.max() >= vocabulary:
        raise LibraryError(
            "The descriptors name words that this library does not have; compute them again with `vplog run`."
        )
    lengths = column.value_lengths().to_numpy()
    stop = np.cumsum(lengths)
    start = stop - lengths
    rising = np.diff(words.astype(np.int32), prepend=-1) > 0
    rising[start[start < len(words)]] = True  # a place's first word follows none
    if not np.all(rising):
        raise LibraryError("The descriptors name a word twice or out of order; compute them again with `vplog run`.")
    return list(map(slice, start.tolist(), stop.tolist()))
