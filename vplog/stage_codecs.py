"""How the results of stages become bytes for the stage cache, and back: arrays, descriptors, images, plain values.

Reading checks what it reads, as of any file: what does not fit raises ValueError, and nothing larger than the bytes
given is made.
"""

from __future__ import annotations

import io
import json
import math
import struct
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import cv2
import numpy as np

from vplog.data import Closures, Verdict
from vplog.image_file import decode_image

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.data import Bytes
    from vplog.stages import PlaceState

T = TypeVar("T")

_LENGTH = struct.Struct("<I")
_NUMBERS = "biuf"
"""Kinds of numpy types that are read: truth values, whole and floating numbers."""


@dataclass(frozen=True)
class Codec(Generic[T]):
    """Both ways."""

    to_bytes: Callable[[T], bytes]
    from_bytes: Callable[[bytes], T]


def json_codec(make: Callable[[Any], T], plain: Callable[[T], Any]) -> Codec[T]:
    """Of what `plain` makes a tree of plain values, and `make` makes of that again."""
    return Codec(lambda value: json.dumps(plain(value)).encode(), lambda data: make(json.loads(data)))


def arrays_codec(kind: type[T]) -> Codec[T]:
    """Of a dataclass of arrays."""
    return Codec(
        lambda value: _pack({field.name: getattr(value, field.name) for field in fields(kind)}),  # type: ignore[arg-type]
        lambda data: kind(**_unpack(data)),
    )


def closures_codec() -> Codec[Closures]:
    """Of a ledger: its lists are arrays of their values, one after the other, and of how many each row has."""
    ragged = {"shared_references": np.uint16, "shared_overlap": np.float32}

    def to_bytes(closures: Closures) -> bytes:
        columns: dict[str, Any] = {field.name: getattr(closures, field.name) for field in fields(Closures)}
        for name, kind in ragged.items():
            rows = columns[name]
            columns[f"{name} count"] = np.array([len(row) for row in rows], np.int32)
            columns[name] = np.concatenate([*rows, np.empty(0, kind)]).astype(kind)
        order = [verdict.value for verdict in Verdict]
        columns["verdict"] = np.array([order.index(verdict) for verdict in closures.verdict], np.int32)
        columns["scale"] = np.frombuffer("\n".join(closures.scale).encode(), np.uint8)
        return _pack(columns)

    def from_bytes(data: bytes) -> Closures:
        columns: dict[str, Any] = _unpack(data)
        for name in ragged:
            ends = np.cumsum(columns.pop(f"{name} count"), dtype=np.int64)
            columns[name] = np.split(columns[name], ends[:-1]) if len(ends) else []
        verdicts = list(Verdict)
        columns["verdict"] = [verdicts[number] for number in columns["verdict"].tolist()]
        scale = columns["scale"].tobytes().decode()
        columns["scale"] = scale.split("\n") if len(columns["query"]) else []
        closures = Closures(**columns)
        if any(len(getattr(closures, field.name)) != len(closures) for field in fields(Closures)):
            raise ValueError("the columns of a ledger are not of one length")
        return closures

    return Codec(to_bytes, from_bytes)


def descriptors_codec(state: PlaceState, count: int) -> Codec[Sequence[Any]]:
    """Of `count` place descriptors, as the recogniser stores them in a table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def to_bytes(descriptors: Sequence[Any]) -> bytes:
        sink = io.BytesIO()
        pq.write_table(pa.table({"place": state.to_arrow(descriptors)}), sink, compression="none")
        return sink.getvalue()

    def from_bytes(data: bytes) -> Sequence[Any]:
        file = pq.ParquetFile(io.BytesIO(data))
        if file.metadata.num_rows != count or file.schema_arrow.field("place").type != state.arrow_type:
            raise ValueError(f"it holds something else than {count} places of {state.arrow_type}")
        return state.from_arrow(file.read()["place"].combine_chunks())

    return Codec(to_bytes, from_bytes)


def images_codec() -> Codec[list[tuple[int, Bytes]]]:
    """Of grey images with a number each, as PNG: half the bytes, and they come back as they were."""

    def to_bytes(images: list[tuple[int, Bytes]]) -> bytes:
        pictures = [cv2.imencode(".png", image)[1].ravel() for _, image in images]
        return _pack({
            "number": np.array([number for number, _ in images], np.int64),
            "bytes": np.array([len(picture) for picture in pictures], np.int64),
            "png": np.concatenate([*pictures, np.empty(0, np.uint8)]).astype(np.uint8),
        })  # fmt: skip

    def from_bytes(data: bytes) -> list[tuple[int, Bytes]]:
        columns = _unpack(data)
        ends = np.cumsum(columns["bytes"])
        pictures = np.split(columns["png"], ends[:-1]) if len(ends) else []
        images = [decode_image(picture.tobytes()) for picture in pictures]
        return [
            (number, np.asarray(image, np.uint8))
            for number, image in zip(columns["number"].tolist(), images, strict=True)
        ]

    return Codec(to_bytes, from_bytes)


def _pack(columns: dict[str, Any]) -> bytes:
    """Arrays one after the other, behind their names, types and shapes."""
    arrays = {name: np.ascontiguousarray(array) for name, array in columns.items()}
    head = json.dumps([[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]).encode()
    return b"".join([_LENGTH.pack(len(head)), head, *(array.tobytes() for array in arrays.values())])


def _unpack(data: bytes) -> dict[str, np.ndarray]:
    [length] = _LENGTH.unpack(data[: _LENGTH.size])
    at = _LENGTH.size + length
    arrays = {}
    for name, kind, shape in json.loads(data[_LENGTH.size : at]):
        dtype = np.dtype(str(kind))
        if dtype.kind not in _NUMBERS or any(type(size) is not int or size < 0 for size in shape):
            raise ValueError(f"column {name} is none of numbers")
        count = math.prod(shape)
        if count * dtype.itemsize > len(data) - at:
            raise ValueError(f"column {name} is longer than the file")
        arrays[str(name)] = np.frombuffer(data, dtype, count, at).reshape(shape).copy()
        at += count * dtype.itemsize
    if at != len(data):
        raise ValueError("there is more than the columns named")
    return arrays
