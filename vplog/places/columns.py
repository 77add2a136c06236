"""Columns of places: to Arrow, and back from a table that anyone may have written."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from vplog.errors import LibraryError
from vplog.places.library_files import ReferencesState


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


class RecordState(ReferencesState, ABC):
    """A state whose places are records of arrays, the first of which are numbers of references."""

    record: type[Any]
    """Dataclass of a place."""
    none: int
    """The number of no reference."""

    @property
    @abstractmethod
    def layout(self) -> dict[str, tuple[pa.DataType, tuple[int, ...]]]:
        """Type and shape of the values of each field of a place."""

    @property
    def arrow_type(self) -> pa.StructType:
        return pa.struct({name: pa.list_(kind, math.prod(shape)) for name, (kind, shape) in self.layout.items()})

    def arrays(self, places: Sequence[Any]) -> Any:
        """(N, ...) values of each field, in a list."""
        return self._shaped([getattr(place, name) for place in places] for name in self.layout)

    def _shaped(self, fields: Iterable[Any]) -> list[Any]:
        return [
            np.asarray(values, kind.to_pandas_dtype()).reshape(-1, *shape)
            for values, (kind, shape) in zip(fields, self.layout.values(), strict=True)
        ]

    def to_arrow(self, descriptors: Sequence[Any]) -> pa.Array:
        return to_column(self.arrow_type, iter(self.arrays(descriptors)))

    def from_arrow(self, column: pa.Array) -> list[Any]:
        return list(map(self.record, *self.checked(from_column(column, self.arrow_type))))

    def checked(self, fields: Sequence[NDArray]) -> list[Any]:
        """(N, ...) values of each field of a column. Raises LibraryError where this library has no such reference."""
        references, *others = self._shaped(fields)
        if np.any((references != self.none) & ((references < 0) | (references >= len(self.references)))):
            raise LibraryError(
                "The descriptors name references that this library lacks; compute them again with `vplog run`."
            )
        return [references, *others]


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


def to_lists(places: Sequence[NDArray], arrow_type: pa.ListType) -> pa.Array:
    """A column of lists from the values (K,) of each place, a numpy record where the items are structs."""
    item = arrow_type.value_type
    values = np.concatenate([np.zeros(0, _dtype(item)), *places])
    parts = [pa.array(values[name]) for name in values.dtype.names or ()]
    items = pa.StructArray.from_arrays(parts, fields=list(item)) if parts else pa.array(values)
    start = np.concatenate([[0], np.cumsum([len(place) for place in places])]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(start), items, type=arrow_type)


def from_lists(column: pa.ListArray, arrow_type: pa.ListType, words: int) -> list[NDArray]:
    """The values of each list of a `to_lists`, whose first number is that of a visual word. Raises LibraryError where
    the column is of another type, lacks a value, or a place's words do not rise or are not below `words`."""
    check_type(column, arrow_type)
    items = column.flatten()
    parts = items.flatten() if pa.types.is_struct(items.type) else [items]
    check_values(column, *parts)
    values = np.empty(len(items), _dtype(items.type))
    for name, part in zip(values.dtype.names or (...,), parts, strict=True):
        values[name] = part.to_numpy()
    word = parts[0].to_numpy().astype(np.int32)
    if len(word) and word.max() >= words:
        raise LibraryError(
            "The descriptors name words that this library does not have; compute them again with `vplog run`."
        )
    stop = np.cumsum(column.value_lengths().to_numpy())
    rising = np.diff(word, prepend=-1) > 0
    rising[stop[stop < len(word)]] = True  # a place's first word follows none
    if not np.all(rising):
        raise LibraryError("The descriptors name a word twice or out of order; compute them again with `vplog run`.")
    return np.split(values, stop)[:-1]


def _dtype(item: pa.DataType) -> np.dtype:
    """Numpy's type of a number, or a record of the numbers of a struct."""
    if isinstance(item, pa.StructType):
        return np.dtype([(field.name, field.type.to_pandas_dtype()) for field in item])
    return np.dtype(item.to_pandas_dtype())
