"""A map of places: every recogniser's type comes back, of one drive or many, in columns that tables take."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.results.example import COUNT, METADATA, make_run, read_map, write_map
from vplog.errors import ResultError
from vplog.results import tables

if TYPE_CHECKING:
    from pathlib import Path

BOXES = pa.struct([("references", pa.list_(pa.uint16(), 3)), ("boxes", pa.list_(pa.uint8(), 6))])
WORD = pa.struct([pa.field("word", pa.uint16(), nullable=False), pa.field("count", pa.uint8(), nullable=False)])
TYPES = {
    "bobb": BOXES,
    "hybrid": pa.struct([("boxes", BOXES), ("signs", pa.list_(pa.uint8(), 8))]),
    "vlad": pa.list_(pa.float16(), 5),
    "fabmap": pa.list_(pa.field("item", pa.uint16(), nullable=False)),
    "bovf": pa.list_(pa.field("item", WORD, nullable=False)),
    "other": pa.binary(),
}


def value(kind: pa.DataType, rng: np.random.Generator) -> Any:
    if pa.types.is_struct(kind):
        return {part.name: value(part.type, rng) for part in kind}
    if pa.types.is_fixed_size_list(kind):
        return [value(kind.value_type, rng) for _ in range(kind.list_size)]
    if pa.types.is_list(kind):
        return [value(kind.value_type, rng) for _ in range(rng.integers(4))]
    if kind == pa.binary():
        return rng.bytes(int(rng.integers(5)))
    return np.float16(rng.normal()) if kind == pa.float16() else int(rng.integers(2**kind.bit_width))


def a_run(folder: Path, kind: pa.DataType, seed: int) -> pa.Array:
    """Write what a map is made of, and give the descriptors."""
    run, rng = make_run(seed), np.random.default_rng(seed)
    folder.mkdir()
    keyframes = replace(run.keyframes, drive=f"drive {seed}")
    column = pa.array([value(kind, rng) for _ in range(COUNT)], kind)
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, run.solution.world_from_body, METADATA)
    tables.write_descriptors(folder / "descriptors.parquet", keyframes, column, METADATA)
    return column


@pytest.mark.parametrize("name", TYPES)
def test_places_come_back_in_the_recognisers_own_type(tmp_path: Path, name: str) -> None:
    kind = TYPES[name]
    columns = [a_run(tmp_path / f"{seed}", kind, seed) for seed in (0, 1)]
    folders = [tmp_path / "0", tmp_path / "1"]
    told = write_map(tmp_path / "map", folders)
    assert told["drives"] == ["drive 0", "drive 1"]
    table, places = read_map(tmp_path / "map", kind)
    assert places.type == kind
    assert places.equals(pa.concat_arrays(columns))
    for seed, folder in enumerate(folders):
        keyframes, world = tables.read_keyframes(folder / "keyframes.parquet")
        part = table.slice(seed * COUNT, COUNT)
        assert part["drive"].to_pylist() == [keyframes.drive] * COUNT
        assert part["keyframe"].to_pylist() == list(range(COUNT))
        assert part["stamp_ns"].to_pylist() == keyframes.stamp_ns.tolist()
        found = np.stack([part[f"world_t{axis}"].to_numpy() for axis in "xyz"], axis=1)
        np.testing.assert_allclose(found, world[:, :3, 3], rtol=0, atol=1e-12)
    rows = duckdb.execute("select drive, count(*) from read_parquet(?) group by 1 order by 1", [str(tmp_path / "map")])
    assert rows.fetchall() == [("drive 0", COUNT), ("drive 1", COUNT)]


def test_fixed_lists_become_bytes_of_a_fixed_width(tmp_path: Path) -> None:
    """Little endian, as the header says, so that any language reads them without Arrow's nested types."""
    column = a_run(tmp_path / "0", TYPES["hybrid"], 0)
    write_map(tmp_path / "map", [tmp_path / "0"])
    table = pq.read_table(tmp_path / "map")
    widths = {"boxes.references": 6, "boxes.boxes": 6, "signs": 8}
    for name, width in widths.items():
        assert table.schema.field(name).type == pa.binary(width)
    raw = np.frombuffer(b"".join(table["boxes.references"].to_pylist()), "<u2").reshape(COUNT, 3)
    assert raw.tolist() == [row["boxes"]["references"] for row in column.to_pylist()]


def test_same_runs_same_bytes(tmp_path: Path) -> None:
    a_run(tmp_path / "0", BOXES, 0)
    for name in ("one", "two"):
        write_map(tmp_path / name, [tmp_path / "0"])
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_a_map_of_another_recogniser_is_refused(tmp_path: Path) -> None:
    a_run(tmp_path / "0", BOXES, 0)
    write_map(tmp_path / "map", [tmp_path / "0"])
    with pytest.raises(ResultError, match="not a map of places of this recogniser"):
        read_map(tmp_path / "map", TYPES["vlad"])
    with pytest.raises(ResultError, match="not a file of places"):
        read_map(tmp_path / "0" / "keyframes.parquet", BOXES)
    (tmp_path / "text").write_text("no table")
    with pytest.raises(ResultError, match="cannot be read"):
        read_map(tmp_path / "text", BOXES)
