"""A map of places in one Parquet file: the descriptors of one drive or many, with their poses and stamps.

A descriptor becomes one column for each of its parts, and a part that is a list of fixed length becomes as many bytes
(little endian): a fixed width without levels, which reads more than ten times as fast as a list and is smaller. The
header has the type of the bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vplog.data import Floats, Int32s, Ints
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.results import geo, run_record, tables
from vplog.storage.json_records import canonical_json, parse_json
from vplog.storage.parquet_limits import check_size, filled, open_table, read_schema, table_writer
from vplog.storage.scratch import replacing

ROWS_PER_GROUP = 16_384
"""Places of a row group: 2 MB of the default's descriptors."""
ZSTD_LEVEL = 3
"""Level 1 is 1 % larger and no faster; 9 is 1 % smaller and takes twice as long to write."""
_MOST_HEADER = 2**25
"""Bytes of a header's list of drives: it is in the file twice."""
_MOST_ROWS = 2**20
"""Rows of a group that is read at once: as many as other writers put into one."""
PLACE = pa.schema(
    [
        tables.KEYFRAMES.field("drive").with_type(pa.dictionary(pa.int32(), pa.string())),
        *(field for field in tables.KEYFRAMES if field.name in ("keyframe", "stamp_ns") or field.name[:6] == "world_"),
    ]
)
"""As in keyframes.parquet; the poses of each drive are in a frame of its own."""
_AGAIN = "Write it again: vplog map export MAP -o FILE.parquet"
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
    """Header of the table of descriptors; it names the library."""
    where: Floats | None = None
    """(P, 3) longitude and latitude in degrees and altitude in m; None where not known."""

    def of(self, rows: Ints) -> DrivePlaces:
        """The places of these rows."""
        return replace(
            self, keyframe=self.keyframe[rows], stamp_ns=self.stamp_ns[rows],
            world_from_body=self.world_from_body[rows], descriptors=self.descriptors.take(pa.array(rows)),
            where=None if self.where is None else self.where[rows],
        )  # fmt: skip


def read_places(folder: Path, drive: str | None = None) -> DrivePlaces:
    """All places of a run's first camera, under the name of its drive or the one given. Raises ResultError."""
    column, _ = tables.read_first_camera(folder / "descriptors.parquet")
    header = tables.read_metadata(folder / "descriptors.parquet")
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    pictures, count = tables.read_pictures(folder / "descriptors.parquet"), len(keyframes.stamp_ns)
    rows = pictures[0][pictures[1] == 0]
    if len(rows) and rows[-1] >= count:
        raise ResultError(f"{folder} has a descriptor of keyframe {rows[-1]}, and {count} keyframes. Run again.")
    stamps, poses = keyframes.stamp_ns[rows], world_from_body[rows]
    return DrivePlaces(drive or keyframes.drive, folder, rows, stamps, poses, column, header)


def drive_header(folder: Path) -> dict[str, Any]:
    """The entry of a drive in the header: the content of its log, the topics that were requested, and where it is, as
    drive.json has it in a map; of a run elsewhere the first two, by run.json."""
    records = [folder / name for name in ("drive.json", "run.json") if (folder / name).is_file()]
    account = run_record.read_run_json(records[0]) if records else {}
    topics = account.get("topics")
    known: dict[str, Any] = {"inputs": account.get("inputs"), "topics": None, "earth": account.get("earth")}
    if isinstance(topics, dict):  # files beside the log are among the inputs
        known["topics"] = {name: topic for name, topic in topics.items() if not name.endswith(("_file", "masks"))}
    return {name: known[name] for name in ("inputs", "topics", "earth") if known[name] is not None}


def write_places(
    path: Path, drives: Mapping[str, dict[str, Any]], parts: Iterable[DrivePlaces],
    bounds: tuple[Floats, Floats] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One row for every place, one drive in memory at a time; what was written. `drives` are all of them, with what is
    known of each, which goes into the header.

    With the bounds of their points, (3,) each as `where` has them, the file is GeoParquet 1.1 too, whose header comes
    first. Raises ResultError where descriptors were not made with one library, and so do not compare, where there is no
    place at all, and where one is beyond the bounds.
    """
    rest = iter(parts)
    first = next(rest, None)
    if first is None:
        raise ResultError("The drives given have no place, so there is no file to write. Give a drive with places.")
    names = list(drives)
    kind, library = first.descriptors.type, first.header.get("vplog.library", "")
    described = _parts(kind)
    columns = [pa.field(name, _stored(part), False) for name, part in described]
    header = json.dumps(drives)
    if len(header) > _MOST_HEADER:  # readers take headers of up to 100 MB
        header = json.dumps({drive: {} for drive in drives})
    about = {
        **{key: first.header.get(key, "") for key in ("vplog.library", "vplog.version", "vplog.settings")},
        "vplog.table": "map",
        "vplog.drives": header,
        "vplog.descriptor": json.dumps([_described(name, part) for name, part in described]),
        **({} if bounds is None else geo.geo_header(*bounds)),
    }
    points = [] if bounds is None else [pa.field("geometry", pa.binary(), False)]
    schema = pa.schema([*PLACE, *columns, *points], metadata=about)
    places = 0
    with replacing(path) as stream, table_writer(
        stream, schema, compression="zstd", compression_level=ZSTD_LEVEL,
        use_dictionary=["drive"],
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
            writer.write_table(pa.Table.from_arrays(arrays, schema=writer.schema), ROWS_PER_GROUP)
            places += len(part.keyframe)
    return {"written": str(path), "drives": names, "places": places, "library": library}


def _arrays(part: DrivePlaces, names: Sequence[str]) -> list[pa.Array]:
    """The columns of a drive's places."""
    number = names.index(part.drive)
    drive = pa.DictionaryArray.from_arrays(pa.array([number] * len(part.keyframe), pa.int32()), pa.array(names))
    where = np.ascontiguousarray(se3.vectors(part.world_from_body).T)
    packed = [_packed(one.combine_chunks()) for one in _flattened(part.descriptors).columns]
    return [drive, pa.array(part.keyframe), pa.array(part.stamp_ns), *map(pa.array, where), *packed]


@dataclass(frozen=True)
class PlacesHeader:
    """The header of a map of places."""

    library: str
    settings: dict[str, Any]
    descriptor: str
    """Names and types of its columns, as JSON."""
    drives: dict[str, dict[str, Any]]
    """By drive, in order: its `inputs`, `topics` and `earth`, as far as known."""


def read_places_header(path: Path) -> PlacesHeader:
    """The header of a map of places. Raises ResultError where it is none."""
    with tables.reading(path, _AGAIN, _AGAIN):
        header = {key.decode(): value.decode() for key, value in (read_schema(path).metadata or {}).items()}
        settings, drives = (parse_json(header.get(f"vplog.{name}", "null")) for name in ("settings", "drives"))
        canonical_json([settings, drives])  # not nested deeper than can be written again
    sound = isinstance(settings, dict) and isinstance(drives, dict)
    sound = sound and all(isinstance(known, dict) for known in drives.values())
    if header.get("vplog.table") != "map" or not sound:
        raise ResultError(
            f"{path} is not a file of places with its drives. Write one: vplog map export MAP -o FILE.parquet"
        )
    return PlacesHeader(header.get("vplog.library", ""), settings, header.get("vplog.descriptor", ""), drives)


def places_by_drive(path: Path) -> dict[str, int]:
    """Number of places of each drive in a map. Raises ResultError."""
    found: dict[str, int] = {}
    with tables.reading(path, _AGAIN, _AGAIN), _opened(path, ["drive"]) as file:
        for batch in file.iter_batches(ROWS_PER_GROUP, columns=["drive"]):
            for value in batch.column(0).value_counts():
                drive = str(value["values"])
                found[drive] = found.get(drive, 0) + value["counts"].as_py()
    return found


def read_drives(path: Path, kind: pa.DataType) -> Iterator[DrivePlaces]:
    """The places of a map drive by drive, one of them in memory at a time. Raises ResultError where it is damaged, of
    another recogniser, or where a drive comes twice."""
    parts, about = _parts(kind), read_places_header(path)
    if about.descriptor != json.dumps([_described(*part) for part in parts]):
        raise ResultError(f"{path} is not a map of places of this recogniser.")
    schema = pa.schema([*PLACE, *(pa.field(name, _stored(part), False) for name, part in parts)])
    done, waiting = set[str](), list[pa.Table]()
    with tables.reading(path, _AGAIN, _AGAIN), _opened(path, schema.names) as file:
        for number in range(file.num_row_groups):
            if (rows := file.metadata.row_group(number).num_rows) > _MOST_ROWS:
                raise ResultError(f"{path} has {rows} places in a row group; write it with at most {_MOST_ROWS}.")
            table = filled(file.read_row_group(number, columns=schema.names), schema)
            for drive, rows in _stretches(table):
                if waiting and waiting[0]["drive"][0].as_py() != drive:
                    yield _places_of(waiting, path, parts, kind)
                    waiting = []
                if drive in done and not waiting:
                    raise ResultError(
                        f"{path} does not hold the places of {drive} together. Write it again with `vplog map export`."
                    )
                done.add(drive)
                waiting.append(rows)
        if waiting:
            yield _places_of(waiting, path, parts, kind)


@contextmanager
def _opened(path: Path, columns: list[str]) -> Iterator[pq.ParquetFile]:
    """A file of places whose drives are dictionary encoded. Raises ValueError where these columns would take more
    memory than a file may."""
    with open_table(path, read_dictionary=["drive"]) as file:
        check_size(path, file, columns)
        yield file


def _stretches(table: pa.Table) -> Iterator[tuple[str, pa.Table]]:
    """Each run of consecutive rows of one drive: its name and its rows. Raises ValueError for rows without a drive."""
    drives = table["drive"].combine_chunks()
    if drives.null_count:
        raise ValueError("There are places of no drive.")
    numbers = drives.indices.to_numpy()
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    for start, stop in pairwise([*starts.tolist(), len(numbers)]):
        yield drives.dictionary[int(numbers[start])].as_py(), table.slice(start, stop - start)


def _places_of(tables_of_drive: list[pa.Table], path: Path, parts: list[Any], kind: pa.DataType) -> DrivePlaces:
    table = pa.concat_tables(tables_of_drive).combine_chunks()
    columns = iter([_unpacked(table[name].combine_chunks(), part) for name, part in parts])
    keyframe, stamp_ns = (table[name].to_numpy() for name in ("keyframe", "stamp_ns"))
    drive, poses = table["drive"][0].as_py(), tables.read_poses(table, "world_")
    return DrivePlaces(drive, path, keyframe, stamp_ns, poses, _joined(kind, columns), {})


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


def _flattened(column: pa.Array) -> pa.Table:
    """A column for every leaf of a descriptor, nested ones with dotted names."""
    table = pa.table({"descriptor": column})
    while any(pa.types.is_struct(part.type) for part in table.schema):
        table = table.flatten()
    return table.rename_columns([name.removeprefix("descriptor.") for name in table.column_names])


def _parts(kind: pa.DataType) -> list[tuple[str, pa.DataType]]:
    """Dotted name and type of every leaf of a descriptor."""
    return [(part.name, part.type) for part in _flattened(pa.array([], kind)).schema]


def _joined(kind: pa.DataType, columns: Any) -> pa.Array:
    """The descriptors from their leaves, an iterator in the order of `_parts`."""
    if not pa.types.is_struct(kind):
        return next(columns)
    return pa.StructArray.from_arrays([_joined(part.type, columns) for part in kind], fields=list(kind))


def _is_bytes(kind: pa.DataType) -> bool:
    """Whether a leaf is a fixed-size list of numbers, which is stored as bytes."""
    return pa.types.is_fixed_size_list(kind) and pa.types.is_primitive(kind.value_type)


def _stored(kind: pa.DataType) -> pa.DataType:
    return pa.binary(kind.list_size * kind.value_type.bit_width // 8) if _is_bytes(kind) else kind


def _described(name: str, kind: pa.DataType) -> dict[str, Any]:
    """A column in the header: the type of its numbers and how many, or its own type alone."""
    if _is_bytes(kind):
        return {"name": name, "type": str(kind.value_type), "length": kind.list_size}
    return {"name": name, "type": _type_name(kind)}


def _type_name(kind: pa.DataType) -> str:
    """A type in words that do not hang on the names of list items, which Parquet changes."""
    if pa.types.is_struct(kind):
        return f"({', '.join(f'{_type_name(part.type)} {part.name}' for part in kind)})"
    if pa.types.is_fixed_size_list(kind):
        return f"{_type_name(kind.value_type)}[{kind.list_size}]"
    return f"{_type_name(kind.value_type)}[]" if pa.types.is_list(kind) else str(kind)


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
