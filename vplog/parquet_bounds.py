"""What a Parquet file may take in memory: as much as its bytes can justify.

Equal values are one number and a count in Parquet, so 200 kB may say four million rows. Files may come from anyone, so
what their rows come to is reckoned from the footer before any is read. Texts are read as numbers of a dictionary, whose
entries are in the file, and checked before each row gets its own.
"""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

ALWAYS_BYTES = 1 << 26
"""Any file may come to so much: hundreds of thousands of the default's places, of whatever size the file is."""
MOST_TIMES = 200
"""Times its own size that a larger one may come to. Tables of drives come to 0.6 to 7 times, those of descriptors to
1.4; a ledger of which every candidate failed alike to 64."""
_NARROW = {"INT_8": 1, "UINT_8": 1, "INT_16": 2, "UINT_16": 2}
_LEAF_BYTES = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}


def open_table(path: Path) -> pq.ParquetFile:
    """A Parquet file. Raises OSError where there is something that is no file, too: a pipe would be waited for."""
    check_file(path)
    return pq.ParquetFile(path)


def check_file(path: Path) -> None:
    """Raises OSError where there is none, or something else of that name."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("It is not a file.")


def check_size(path: Path, file: pq.ParquetFile, columns: Collection[str] | None = None) -> None:
    """Raises ValueError where the rows of a file, or some of its columns, would take more than it may hold: but for
    texts, which count as numbers of a dictionary."""
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
    _check(needed, path)


def read_table(path: Path, file: pq.ParquetFile, columns: Collection[str] | None = None) -> pa.Table:
    """The rows of a file that is open, or some columns. Raises ValueError where they would take more than it may hold,
    and KeyError where it lacks one."""
    check_size(path, file, columns)
    schema = file.schema_arrow  # made anew by every look
    names = schema.names if columns is None else list(columns)
    texts = [name for name in names if _is_text(schema.field(name).type)]
    if not texts:
        return file.read(columns=names)
    with pq.ParquetFile(path, metadata=file.metadata, read_dictionary=texts) as numbered:
        table = numbered.read(columns=names)
    for name in texts:
        column = table[name]
        lengths = [pc.call_function("binary_length", [part.dictionary]).to_numpy() for part in column.chunks]
        _check(sum(len(part) * int(own.max(initial=0)) for part, own in zip(column.chunks, lengths, strict=True)), path)
        table = table.set_column(
            table.schema.get_field_index(name), schema.field(name), column.cast(schema.field(name).type)
        )
    return table


def _is_text(kind: pa.DataType) -> bool:
    return kind in (pa.string(), pa.binary())


def _check(needed: int, path: Path) -> None:
    size = path.stat().st_size
    if needed > (most := max(ALWAYS_BYTES, MOST_TIMES * size)):
        raise ValueError(f"Its {size} bytes tell of {needed // 10**6} MB, and {most // 10**6} MB is the most they may.")


def _row_bytes(kind: pa.DataType) -> int:
    """What a row of a type takes at least, a null too."""
    if pa.types.is_struct(kind):
        return sum(_row_bytes(part.type) for part in kind)
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _row_bytes(kind.value_type)
    try:
        return -(-kind.bit_width // 8)
    except ValueError:  # of no fixed width: where it starts
        return 4
