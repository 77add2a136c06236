"""A map of places in one Parquet file: the descriptors of one drive or many, with where and when they were seen.

A descriptor becomes one column for each of its parts, and a part that is a list of fixed length becomes as many bytes
(little endian): a fixed width without levels, which reads more than ten times as fast as a list and is smaller. The
header says how the bytes are to be taken.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vplog import geometry
from vplog.errors import ResultError
from vplog.results import geo, tables
from vplog.results.atomic import replacing

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from vplog.data import Floats, Int32s, Ints

ROWS_PER_GROUP = 16_384
"""Places of a row group: 2 MB of the default's descriptors."""
ZSTD_LEVEL = 3
"""Level 1 is 1 % larger and no faster; 9 is 1 % smaller and takes twice as long to write."""
PLACE = pa.schema(
    [
        tables.KEYFRAMES.field("drive").with_type(pa.dictionary(pa.int32(), pa.string())),
        *(field for field in tables.KEYFRAMES if field.name in ("keyframe", "stamp_ns") or field.name[:6] == "world_"),
    ]
)
"""As in keyframes.parquet; the poses of each drive are in a frame of its own."""
_COUNTED = ("keyframe", "stamp_ns")
"""Columns that grow by little from row to row."""


@dataclass(frozen=True, eq=False)
class DrivePlaces:
    """The places of one drive."""

    drive: str
    source: Path
    """The run they are of."""
    keyframe: Int32s
    """(P,) rows of the drive's keyframes."""
    stamp_ns: Ints
    world_from_body: Floats
    """(P, 4, 4)."""
    descriptors: pa.Array
    header: dict[str, str]
    """Of the table of descriptors; it names the library."""
    where: Floats | None = None
    """(P, 3) longitude and latitude in degrees and altitude in m; None where nothing says so."""

    def of(self, rows: Ints) -> DrivePlaces:
        """Some of them."""
        return replace(
            self, keyframe=self.keyframe[rows], stamp_ns=self.stamp_ns[rows],
            world_from_body=self.world_from_body[rows], descriptors=self.descriptors.take(pa.array(rows)),
            where=None if self.where is None else self.where[rows],
        )  # fmt: skip


def read_places(folder: Path, drive: str | None = None) -> DrivePlaces:
    """All places of a run, under the name of its drive or the one given. Raises ResultError."""
    column, _ = tables.read_descriptors(folder / "descriptors.parquet")
    header = tables.read_metadata(folder / "descriptors.parquet")
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    if len(column) != len(keyframes.stamp_ns):
        raise ResultError(f"{folder} has {len(column)} descriptors for {len(keyframes.stamp_ns)} keyframes.")
    rows = np.arange(len(column), dtype=np.int32)
    return DrivePlaces(drive or keyframes.drive, folder, rows, keyframes.stamp_ns, world_from_body, column, header)


def write_map(path: Path, folders: Sequence[Path]) -> dict[str, Any]:
    """One row for every keyframe of the runs, drives in the order given; what was written.

    Raises ResultError where the descriptors were not made with one library, and so do not compare, or where two
    drives bear one name.
    """
    return write_places(path, names_of(folders), (read_places(folder) for folder in folders))


def write_places(
    path: Path, names: Sequence[str], parts: Iterable[DrivePlaces], bounds: tuple[Floats, Floats] | None = None
) -> dict[str, Any]:
    """One row for every place, one drive in memory at a time; what was written. `names` are those of all drives.

    With the bounds of their points, (3,) each as `where` has them, the file is GeoParquet 1.1 too, whose header comes
    first. Raises ResultError as above, where there is no place at all, and where one is beyond the bounds.
    """
    rest = iter(parts)
    first = next(rest, None)
    if first is None:
        raise ResultError("There is no place to write.")
    kind, library = first.descriptors.type, first.header.get("vplog.library", "")
    described = list(_parts(kind, ""))
    columns = [pa.field(name, _stored(part), False) for name, part in described]
    about = {
        **{key: first.header.get(key, "") for key in ("vplog.library", "vplog.version", "vplog.settings")},
        "vplog.table": "map",
        "vplog.descriptor": json.dumps([_described(name, part) for name, part in described]),
        **({} if bounds is None else geo.geo_header(*bounds)),
    }
    points = [] if bounds is None else [pa.field("geometry", pa.binary(), False)]
    schema = pa.schema([*PLACE, *columns, *points], metadata=about)
    places = 0
    with replacing(path) as stream, pq.ParquetWriter(
        stream, schema, compression="zstd", compression_level=ZSTD_LEVEL,
        use_dictionary=["drive"],  # pyright: ignore[reportArgumentType] (the stubs know bool alone)
        column_encoding=dict.fromkeys(_COUNTED, "DELTA_BINARY_PACKED"),
    ) as writer:  # fmt: skip
        for part in chain([first], rest):
            if part.header.get("vplog.library", "") != library or part.descriptors.type != kind:
                raise ResultError(
                    f"The places of {part.source} were not described with the library of {first.source}, so they do "
                    "not compare. Run both with one library: vplog library LOG... -o LIB, then vplog run LOG "
                    "--library LIB."
                )
            arrays = _arrays(part, names)
            if bounds is not None:
                if part.where is None or np.any(part.where < bounds[0]) or np.any(part.where > bounds[1]):
                    raise ResultError(f"{part.source} was changed while it was read. Run again.")
                arrays.append(geo.points(part.where))
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=ROWS_PER_GROUP)
            places += len(part.keyframe)
    return {"written": str(path), "drives": list(names), "places": places, "library": library}


def _arrays(part: DrivePlaces, names: Sequence[str]) -> list[pa.Array]:
    """The columns of a drive's places."""
    number = names.index(part.drive)
    drive = pa.DictionaryArray.from_arrays(pa.array([number] * len(part.keyframe), pa.int32()), pa.array(names))
    quaternions = geometry.quaternion(part.world_from_body[:, :3, :3])
    where = np.ascontiguousarray(np.concatenate([part.world_from_body[:, :3, 3], quaternions], axis=1).T)
    packed = [_packed(one) for one in _values(part.descriptors)]
    return [drive, pa.array(part.keyframe), pa.array(part.stamp_ns), *map(pa.array, where), *packed]


def read_map(path: Path, kind: pa.DataType) -> tuple[pa.Table, pa.Array]:
    """The table of places without descriptors, and these in the recogniser's own type. Raises ResultError."""
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise ResultError(f"{path} cannot be read: {str(error).splitlines()[0]}") from None
    parts = list(_parts(kind, ""))
    header = table.schema.metadata or {}
    described = header.get(b"vplog.descriptor", b"").decode()
    if header.get(b"vplog.table") != b"map" or described != json.dumps([_described(*part) for part in parts]):
        raise ResultError(
            f"{path} is not a map of places of this recogniser. "
            "Write one with `vplog map export RUN... -o FILE.parquet`."
        )
    columns = iter([_unpacked(table[name].combine_chunks(), part) for name, part in parts])
    return table.select(PLACE.names), _joined(kind, columns)


def names_of(folders: Sequence[Path]) -> list[str]:
    """The drive of each run. Raises ResultError where two bear one name."""
    names = []
    for folder in folders:
        keyframes, _ = tables.read_keyframes(folder / "keyframes.parquet")
        if keyframes.drive in names:
            raise ResultError(
                f"{folder} is a run of a drive named {keyframes.drive!r}, as {folders[names.index(keyframes.drive)]} "
                "is. Export them to maps of their own, or rename the log and run it again."
            )
        names.append(keyframes.drive)
    return names


def _parts(kind: pa.DataType, prefix: str) -> Any:
    """Name and type of every part of a descriptor, those of a structure in a structure with a dot between."""
    if not pa.types.is_struct(kind):
        yield prefix or "descriptor", kind
        return
    for part in kind:
        yield from _parts(part.type, f"{prefix}.{part.name}" if prefix else part.name)


def _values(column: pa.Array) -> list[pa.Array]:
    """The columns of the parts."""
    if not pa.types.is_struct(column.type):
        return [column]
    return [value for at in range(column.type.num_fields) for value in _values(column.field(at))]


def _joined(kind: pa.DataType, columns: Any) -> pa.Array:
    """A descriptor of its parts, taken one after the other."""
    if not pa.types.is_struct(kind):
        return next(columns)
    return pa.StructArray.from_arrays([_joined(part.type, columns) for part in kind], fields=list(kind))


def _is_bytes(kind: pa.DataType) -> bool:
    """Whether a part is a list of so many numbers that stand side by side in memory."""
    return pa.types.is_fixed_size_list(kind) and pa.types.is_primitive(kind.value_type)


def _stored(kind: pa.DataType) -> pa.DataType:
    return pa.binary(kind.list_size * kind.value_type.bit_width // 8) if _is_bytes(kind) else kind


def _described(name: str, kind: pa.DataType) -> dict[str, Any]:
    """How the header tells a column: the type of its numbers and how many, or its own type alone."""
    if _is_bytes(kind):
        return {"name": name, "type": str(kind.value_type), "length": kind.list_size}
    return {"name": name, "type": _told(kind)}


def _told(kind: pa.DataType) -> str:
    """A type in words that do not hang on the names of list items, which Parquet changes."""
    if pa.types.is_struct(kind):
        return f"({', '.join(f'{_told(part.type)} {part.name}' for part in kind)})"
    if pa.types.is_fixed_size_list(kind):
        return f"{_told(kind.value_type)}[{kind.list_size}]"
    return f"{_told(kind.value_type)}[]" if pa.types.is_list(kind) else str(kind)


def _packed(part: pa.Array) -> pa.Array:
    if not _is_bytes(part.type):
        return part
    stored = _stored(part.type)
    values = part.flatten().to_numpy(zero_copy_only=False)
    data = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return pa.FixedSizeBinaryArray.from_buffers(stored, len(part), [None, pa.py_buffer(data)])


def _unpacked(part: pa.Array, kind: pa.DataType) -> pa.Array:
    if not _is_bytes(kind):
        return part.cast(kind)
    width = kind.list_size * kind.value_type.bit_width // 8
    data = memoryview(part.buffers()[1])[part.offset * width : (part.offset + len(part)) * width]
    values = np.frombuffer(data, np.dtype(kind.value_type.to_pandas_dtype()).newbyteorder("<"))
    return pa.FixedSizeListArray.from_arrays(pa.array(values, kind.value_type), type=kind)
