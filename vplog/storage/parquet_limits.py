"""Parquet files: their checksums, the version of their columns, and what they may take in memory.

Every page has a CRC-32. Headers of pages and the footer have none, so a seal of 16 bytes stands in the gap before the
footer, where other readers do not look: CRC-32 of all before it, and of all behind it.

Equal values are one number and a count in Parquet, so 200 kB may say four million rows: what the rows come to is
reckoned from the footer before any is read. Texts are read as numbers of a dictionary, whose entries are in the file.
"""

from __future__ import annotations

import io
import stat
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from vplog.errors import NewerError

ALWAYS_BYTES = 1 << 26
"""Any file may come to so much: hundreds of thousands of the default's places, of whatever size the file is."""
MOST_TIMES = 200
"""Times its own size that a larger one may come to. Tables of drives come to 0.6 to 7 times, those of descriptors to
1.4; a ledger of which every candidate failed alike to 64."""
_NARROW = {"INT_8": 1, "UINT_8": 1, "INT_16": 2, "UINT_16": 2}
_LEAF_BYTES = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}
TABLE_VERSION = 1
"""Version of the columns of all tables. A new nullable column does not raise it; any other change of a column does, and
is refused by older programs."""
VERSION_KEY = "vplog.table_version"
"""In the header of a file; a file without it is of version 1."""
VERSION_ABOUT = (
    "Version of the columns. A reader takes this one and older ones; columns that it does not know it passes over."
)
"""Its description in the contracts."""
_SEAL = struct.Struct("<8sII")
"""Magic, CRC-32 of all before, CRC-32 of the footer with its length and magic."""
_SEAL_MAGIC = b"vplogcrc"
_TAIL = 8
"""Bytes behind the footer: its length, little endian, and `PAR1`."""
_BLOCK_BYTES = 1 << 22
"""Read at once of a file that is summed up."""


class _Sealed(io.RawIOBase):
    """A stream with a CRC-32 of what is written to it, which holds back the footer."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._crc, self.footer = stream, 0, bytearray()
        self.hold = False

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        if self.hold:
            self.footer += data
        else:
            self._crc = zlib.crc32(data, self._crc)
            self._stream.write(data)
        return memoryview(data).nbytes

    def seal(self) -> None:
        """Write the seal and the footer behind what was written so far."""
        start = len(self.footer) - _TAIL - int.from_bytes(self.footer[-_TAIL:-4], "little")
        self.hold, end = False, self.footer[start:]
        self.write(self.footer[:start])
        self._stream.write(_SEAL.pack(_SEAL_MAGIC, self._crc, zlib.crc32(end)) + end)


@contextmanager
def table_writer(stream: BinaryIO, schema: pa.Schema, **options: Any) -> Iterator[pq.ParquetWriter]:
    """A writer of a Parquet file with checksums and the version of the columns; options as pyarrow has them."""
    sink = _Sealed(stream)
    schema = schema.with_metadata({**(schema.metadata or {}), VERSION_KEY: str(TABLE_VERSION)})
    with pq.ParquetWriter(sink, schema, write_page_checksum=True, **options) as writer:
        yield writer
        sink.hold = True
    sink.seal()


def write_table(stream: BinaryIO, table: pa.Table, rows_per_group: int | None = None, **options: Any) -> None:
    """Write a table with checksums and the version of its columns."""
    with table_writer(stream, table.schema, **options) as writer:
        writer.write_table(table.replace_schema_metadata(writer.schema.metadata), rows_per_group)


def open_table(path: Path, **options: Any) -> pq.ParquetFile:
    """A Parquet file whose checksums are right. Raises OSError where there is something that is no file, too (a pipe
    would be waited for), ValueError where it is damaged, and NewerError where it is of a newer version."""
    check_file(path)
    _check_seal(path)
    file = pq.ParquetFile(path, page_checksum_verification=True, **options)
    _check_version(path, file.schema_arrow)
    return file


def read_footer(path: Path) -> pq.FileMetaData:
    """The footer of a Parquet file, by which alone it is checked. Raises as `open_table`."""
    check_file(path)
    _check_seal(path, footer_alone=True)
    footer = pq.read_metadata(path)
    _check_version(path, footer.schema.to_arrow_schema())
    return footer


def read_schema(path: Path) -> pa.Schema:
    """The columns and the header of a Parquet file, of which the footer alone is read. Raises as `open_table`."""
    return read_footer(path).schema.to_arrow_schema()


def _check_seal(path: Path, footer_alone: bool = False) -> None:
    with path.open("rb") as stream:
        start = footer_start(stream) - _SEAL.size
        if start < 0:
            return  # left to pyarrow
        stream.seek(start)
        magic, body, footer = _SEAL.unpack(stream.read(_SEAL.size))
        if magic != _SEAL_MAGIC:
            return
        sound = zlib.crc32(stream.read()) == footer
        if sound and not footer_alone:
            stream.seek(0)
            sound = crc_of(stream, start) == body
    if not sound:
        raise ValueError("It is damaged: its checksum does not match.")


def footer_start(stream: BinaryIO) -> int:
    """Offset of the footer of a Parquet file; negative where there is none."""
    end = stream.seek(0, io.SEEK_END) - _TAIL
    stream.seek(max(end, 0))
    return end - int.from_bytes(stream.read(4), "little")


def crc_of(stream: BinaryIO, count: int) -> int:
    """CRC-32 of the next `count` bytes."""
    total = 0
    while count and (block := stream.read(min(count, _BLOCK_BYTES))):
        total, count = zlib.crc32(block, total), count - len(block)
    return total


def _check_version(path: Path, schema: pa.Schema) -> None:
    header = schema.metadata or {}
    version, maker = (header.get(key, b"").decode(errors="replace") for key in (VERSION_KEY.encode(), b"vplog.version"))
    version = version or "1"
    check_version(path, int(version) if version.isdecimal() else version, TABLE_VERSION, maker)


def check_version(path: Path, version: object, newest: int, maker: object = None) -> None:
    """Raises NewerError where the version of a file is newer than the newest that is read."""
    if version is None:
        raise NewerError(f"{path} names no version of its format, so vplog did not write it. Name another folder.")
    if type(version) is not int or not 0 < version <= newest:
        by = f"by vplog {maker}" if isinstance(maker, str) and maker else "by another vplog"
        raise NewerError(
            f"{path} was written {by} in version {str(version)[:20]} of its format, and this vplog reads up to version "
            f"{newest}. Update vplog: run `pip install .` in a newer checkout."
        )


def check_columns(found: pa.Schema, wanted: Iterable[pa.Field]) -> None:
    """Columns that are not wanted may be there, and wanted ones that may be null be missing: those of another version.
    Raises ValueError where one that may not be null is missing, or one has another type."""
    for column in wanted:
        at = found.get_field_index(column.name)
        if (at < 0 and not column.nullable) or (at >= 0 and found.field(at).type != column.type):
            has = f", but of type {found.field(at).type}" if at >= 0 else ""
            raise ValueError(f"It has no column {column.name} of type {column.type}{has}: of another version of vplog.")


def filled(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """The columns of the schema; null where a table of an older version has none. Raises as `check_columns`."""
    check_columns(table.schema, schema)
    for column in schema:
        if column.name not in table.column_names:
            table = table.append_column(column, pa.nulls(len(table), column.type))
    return table.select(schema.names)


def check_file(path: Path) -> None:
    """Raises OSError where there is none, or something else of that name."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("It is not a file.")


def check_size(path: Path, file: pq.ParquetFile, columns: Collection[str] | None = None) -> None:
    """Raises ValueError where the rows of a file, or some of its columns, would take more than it may hold."""
    _check(unpacked_bytes(file, columns), path)


def unpacked_bytes(file: pq.ParquetFile, columns: Collection[str] | None = None) -> int:
    """Return the memory in bytes that the rows of a file, or some of its columns, take by its footer. Texts count as
    numbers of a dictionary."""
    about, leaves = file.metadata, list[tuple[int, bool, pq.ColumnSchema]]()
    chosen = {field.name: field.type for field in file.schema_arrow if columns is None or field.name in columns}
    width = sum(map(_row_bytes, chosen.values()))
    for at in range(about.num_columns):
        leaf = file.schema.column(at)
        name = leaf.path
        while name and name not in chosen:
            name = name.rpartition(".")[0]
        if name:
            leaves.append((at, _is_text(chosen[name]) or pa.types.is_dictionary(chosen[name]), leaf))
    needed = 0
    for number in range(about.num_row_groups):
        group = about.row_group(number)
        values = stored = 0
        for at, numbered, leaf in leaves:
            chunk = group.column(at)
            stored += chunk.total_uncompressed_size
            width_of = _NARROW.get(leaf.converted_type) or _LEAF_BYTES.get(leaf.physical_type)
            longest = chunk.total_uncompressed_size if leaf.physical_type == "BYTE_ARRAY" else leaf.length
            values += chunk.num_values * (4 if numbered else width_of or longest)
        needed += max(group.num_rows * width, values, stored)
    return needed


def read_table(path: Path, file: pq.ParquetFile, columns: Collection[str] | None = None) -> pa.Table:
    """The rows of a file that is open, or of these columns those that it has. Raises ValueError where they would take
    more than it may hold."""
    check_size(path, file, columns)
    schema = file.schema_arrow  # pyarrow makes it again at every call
    names = [name for name in schema.names if columns is None or name in columns]
    texts = [name for name in names if _is_text(schema.field(name).type)]
    if not texts:
        return file.read(columns=names)
    import pyarrow.compute as pc  # a tenth of a second, which most verbs need not spend

    options: dict[str, Any] = {"read_dictionary": texts, "page_checksum_verification": True}
    with pq.ParquetFile(path, metadata=file.metadata, **options) as numbered:
        table = numbered.read(columns=names)
    for name in texts:
        column, text = table[name], schema.field(name)
        lengths = [pc.call_function("binary_length", [part.dictionary]).to_numpy() for part in column.chunks]
        _check(sum(len(part) * int(own.max(initial=0)) for part, own in zip(column.chunks, lengths, strict=True)), path)
        table = table.set_column(table.schema.get_field_index(name), text, column.cast(text.type))
    return table


def _is_text(kind: pa.DataType) -> bool:
    return kind in (pa.string(), pa.binary())


def _check(needed: int, path: Path) -> None:
    size = path.stat().st_size
    if needed > (most := max(ALWAYS_BYTES, MOST_TIMES * size)):
        raise ValueError(f"Its {size} bytes claim to unpack to {needed // 10**6} MB; the limit is {most // 10**6} MB.")


def _row_bytes(kind: pa.DataType) -> int:
    """Least bytes of a row of a type, a null too."""
    if pa.types.is_struct(kind):
        return sum(_row_bytes(part.type) for part in kind)
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _row_bytes(kind.value_type)
    try:
        return -(-kind.bit_width // 8)
    except ValueError:  # of no fixed width: where it starts
        return 4
