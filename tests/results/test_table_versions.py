"""Tables of another version of vplog: older ones are read, newer ones refused in one line."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.results.test_tables import write_all
from tests.storage.test_flipped_bits import plain, write_tables
from vplog.errors import NewerError, ResultError
from vplog.places.library_files import read_library_record
from vplog.results import tables
from vplog.results.run_record import read_finished_run
from vplog.storage import parquet_limits
from vplog.storage.parquet_limits import VERSION_KEY

if TYPE_CHECKING:
    from pathlib import Path


def rewritten(path: Path, table: pa.Table, **header: str) -> None:
    own = {key.encode(): text for key, text in header.items()}
    pq.write_table(
        table.replace_schema_metadata({**table.schema.metadata, **own}), path, row_group_size=max(len(table) // 6, 1)
    )


def extra(table: pa.Table) -> pa.Table:
    return table.append_column(pa.field("mood", pa.string(), True), pa.array(["good"] * len(table)))


def test_a_column_more_is_passed_over(tmp_path: Path) -> None:
    """In every table, by every reader."""
    for path, readers in write_tables(tmp_path).items():
        before = [plain(read(path)) for read in readers if read is not tables.read_metadata]
        rewritten(path, extra(pq.read_table(path)))
        assert [plain(read(path)) for read in readers if read is not tables.read_metadata] == before, path.name


@pytest.mark.parametrize("version", ["2", "1.5", "-1", "two"])
def test_a_newer_version_is_refused_in_one_line(tmp_path: Path, version: str) -> None:
    for path, readers in write_tables(tmp_path).items():
        rewritten(path, extra(pq.read_table(path)), **{VERSION_KEY: version, "vplog.version": "9.8"})
        for read in readers:
            with pytest.raises(ResultError) as told:
                read(path)
            text = str(told.value)
            assert "\n" not in text
            for part in (str(path), "vplog 9.8", f"version {version or '?'} ", "up to version 1", "Update vplog"):
                assert part in text


def test_a_table_before_versions_is_the_first(tmp_path: Path) -> None:
    path = write_all(tmp_path)[0]
    before, table = plain(tables.read_keyframes(path)), pq.read_table(path)
    header = {key: text for key, text in table.schema.metadata.items() if key != VERSION_KEY.encode()}
    pq.write_table(table.replace_schema_metadata(header), path)
    assert plain(tables.read_keyframes(path)) == before


def test_a_newer_vplog_reads_null_where_an_older_one_wrote_no_column(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And takes a version below its own."""
    path = write_all(tmp_path)[1]
    monkeypatch.setattr(parquet_limits, "TABLE_VERSION", 3)
    newer = tables.CLOSURES.append(pa.field("mood", pa.string(), True))
    monkeypatch.setattr(tables, "CLOSURES", newer)
    assert tables.read_closure(path, 0)["mood"] is None
    monkeypatch.setattr(tables, "CLOSURES", tables.CLOSURES.append(pa.field("must", pa.string(), False)))
    with pytest.raises(ResultError, match="no column must of type string: of another version"):
        tables.read_closure(path, 0)


READERS: list[tuple[int, Any]] = [(0, tables.read_keyframes), (1, tables.read_closures), (3, tables.read_trajectory)]


@pytest.mark.parametrize(("number", "read"), READERS)
def test_columns_that_are_missing_or_of_another_type(tmp_path: Path, number: int, read: Any) -> None:
    """Each of them in turn: one that may be null is null, another is named in one line."""
    path = write_all(tmp_path)[number]
    table = pq.read_table(path)
    for at, column in enumerate(table.schema):
        rewritten(path, table.drop_columns([column.name]))
        if column.nullable:
            read(path)
        else:
            with pytest.raises(ResultError, match=f"no column {column.name} of type .*of another version"):
                read(path)
        other = pa.int16() if column.type != pa.int16() else pa.int8()
        changed = pa.field(column.name, other, True)
        rewritten(path, table.set_column(at, changed, pa.nulls(len(table), other)))
        with pytest.raises(ResultError, match=f"no column {column.name} of type .*but of type {other}"):
            read(path)


def test_records_of_a_newer_version_are_refused(tmp_path: Path) -> None:
    """A run folder, a library; those before versions are of the first."""
    for read, name, newest in ((read_finished_run, "run.json", 1), (read_library_record, "library.json", 2)):
        for version in (None, *range(1, newest + 2)):
            record = {"vplog": "9.8", "finished": True, "hash": "a", "settings": {}}
            (tmp_path / name).write_text(json.dumps(record if version is None else {**record, "format": version}))
            if version is None or version <= newest:
                assert read(tmp_path)["hash"] == "a"
                continue
            refused = rf"by vplog 9.8 in version {newest + 1} .* reads up to version {newest}. Update vplog"
            with pytest.raises(NewerError, match=refused):
                read(tmp_path)
