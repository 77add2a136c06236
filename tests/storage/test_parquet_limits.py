"""A file takes no more memory than its bytes justify, whatever it tells of; what drives write is far from the bound."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.results.example import METADATA, make_run
from vplog.errors import ResultError
from vplog.results import places_map, tables
from vplog.storage import parquet_limits
from vplog.storage.parquet_limits import open_table, read_table

if TYPE_CHECKING:
    from pathlib import Path

    from pyarrow import Schema

PLACE = pa.list_(pa.uint8(), 200)
ROWS = 50_000


def write_same(path: Path, schema: Schema, rows: int, **values: pa.Array) -> None:
    """Rows that are all the same, in a few kB."""
    firsts = [values[field.name] if field.name in values else pa.array([0], field.type) for field in schema]
    columns = [first.take(pa.array(np.zeros(rows, int))) for first in firsts]
    pq.write_table(pa.table(columns, schema=schema), path, compression="zstd")


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet_limits, "ALWAYS_BYTES", 2**20)


@pytest.mark.parametrize("rows", [4000, ROWS])
def test_places_of_a_few_bytes_are_read_up_to_a_bound(tmp_path: Path, rows: int) -> None:
    path, start = tmp_path / "descriptors.parquet", pa.total_allocated_bytes()
    schema = tables.descriptors_schema(PLACE).with_metadata({"vplog.table": "descriptors"})
    write_same(path, schema, rows, descriptor=pa.array([[7] * 200], PLACE))
    if rows < ROWS:
        assert len(tables.read_descriptors(path)[0]) == rows
        return
    with pytest.raises(ResultError, match=r"Its \d+ bytes claim to unpack to \d+ MB; the limit is \d+ MB") as told:
        tables.read_descriptors(path)
    assert "\n" not in str(told.value)
    assert pa.total_allocated_bytes() < start + 2**20


def test_a_long_name_is_not_written_out_for_every_row(tmp_path: Path) -> None:
    """It is in the file once, and memory would have it as many times as there are rows."""
    path, run = tmp_path / "keyframes.parquet", make_run()
    keyframes = replace(run.keyframes, drive="x" * 500_000)
    tables.write_keyframes(path, keyframes, run.solution.world_from_body, METADATA)
    assert path.stat().st_size < 30_000
    with pytest.raises(ResultError, match="the limit is"):
        tables.read_keyframes(path)


def test_an_exported_file_is_read_up_to_a_bound(tmp_path: Path) -> None:
    path, kind = tmp_path / "places.parquet", pa.binary(200)
    described = '[{"name": "descriptor", "type": "uint8", "length": 200}]'
    about = {"vplog.table": "map", "vplog.settings": "{}", "vplog.drives": "{}", "vplog.descriptor": described}
    schema = pa.schema([*places_map.PLACE, pa.field("descriptor", kind, False)], metadata=about)
    name = pa.array(["walk"]).dictionary_encode()
    write_same(path, schema, 1000, drive=name, descriptor=pa.array([b"7" * 200], kind))
    assert [len(places.keyframe) for places in places_map.read_drives(path, PLACE)] == [1000]
    write_same(path, schema, ROWS, drive=name, descriptor=pa.array([b"7" * 200], kind))
    with pytest.raises(ResultError, match="the limit is"):
        list(places_map.read_drives(path, PLACE))
    write_same(path, pa.schema([places_map.PLACE.field("drive")]), 10 * ROWS, drive=name)
    with pytest.raises(ResultError, match="the limit is"):
        places_map.places_by_drive(path)


def test_the_rows_are_those_of_the_file(tmp_path: Path) -> None:
    """Texts, bytes and dictionaries of its own too."""
    table = pa.table(
        {
            "text": pa.array(["a", None, "bc", "a"]),
            "bytes": pa.array([b"", b"x", None, b"x"]),
            "own": pa.array(["p", "q", "p", None]).dictionary_encode(),
            "many": pa.array([[1], [], None, [2, 3]]),
            "a.b": pa.array([{"c": 1}, {"c": 2}, None, {"c": 3}]),
        }
    )
    pq.write_table(table, tmp_path / "table", row_group_size=3)
    with open_table(tmp_path / "table") as file:
        found = read_table(tmp_path / "table", file)
        assert found.to_pylist() == table.to_pylist()
        assert found.schema.equals(file.schema_arrow)
        assert read_table(tmp_path / "table", file, ["text"]).to_pydict() == {"text": table["text"].to_pylist()}


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    pipe, loop = tmp_path / "pipe", tmp_path / "loop"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    for path in (pipe, loop, tmp_path):
        with pytest.raises(ResultError):
            tables.read_keyframes(path)
        with pytest.raises(ResultError):
            tables.read_metadata(path)


def test_a_ledger_whose_every_candidate_failed_alike_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No table of ours compresses more."""
    monkeypatch.setattr(parquet_limits, "ALWAYS_BYTES", 0)
    run = make_run()
    tables.write_closures(tmp_path / "closures.parquet", run.closures, run.keyframes, METADATA)
    table = pq.read_table(tmp_path / "closures.parquet")
    row = next(at for at, text in enumerate(table["verdict"].to_pylist()) if text != "accepted")
    many = 50_000
    table = table.take(pa.array(np.full(many, row)))
    rng = np.random.default_rng(0)
    for name in ("query", "match"):
        own = pa.array(np.sort(rng.integers(0, 5000, many)), pa.int32())
        table = table.set_column(table.schema.get_field_index(name), table.schema.field(name), own)
    score = pa.array(rng.random(many), pa.float32())
    table = table.set_column(table.schema.get_field_index("score"), table.schema.field("score"), score)
    pq.write_table(table, tmp_path / "closures.parquet", compression="zstd")
    assert len(tables.read_closures(tmp_path / "closures.parquet")) == many
