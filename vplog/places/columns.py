"""Checks of the places in a table's column, which anyone may have written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from vplog.errors import LibraryError

if TYPE_CHECKING:
    from numpy.typing import NDArray


def check_type(column: pa.Array, arrow_type: pa.DataType) -> None:
    """Raises LibraryError where the places of a column are of another kind than a recogniser's."""
    if not column.type.equals(arrow_type):
        raise LibraryError(f"Descriptors of type {column.type} do not fit this recogniser's {arrow_type}.")


def check_values(*arrays: pa.Array) -> None:
    """Raises LibraryError where one of them, or what it lists, has no value."""
    for array in arrays:
        lists = pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type)
        if array.null_count or (lists and array.flatten().null_count):
            raise LibraryError("Some descriptors have no value; compute them again with `vplog run`.")


def words_by_place(column: pa.ListArray, words: NDArray[np.uint16], vocabulary: int) -> list[slice]:
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
    return [slice(a, b) for a, b in zip(start.tolist(), stop.tolist(), strict=True)]


def struct_of_lists(arrow_type: pa.StructType, *arrays: NDArray) -> pa.Array:
    """A column of structs of fixed-size lists from the values (N, ...) of each."""
    columns = [
        pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), part.type.list_size)
        for values, part in zip(arrays, arrow_type, strict=True)
    ]
    return pa.StructArray.from_arrays(columns, fields=list(arrow_type))
