"""The places of a map in one file: all, of one drive, in a box on earth; and where there is no place to write."""

from __future__ import annotations

import json
import struct
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.maps.runs import KIND, LIBRARY, OTHER_LIBRARY, PLACES, make_map, put, put_library
from tests.results.example import read_map
from vplog.data import Gps
from vplog.geometry import geodesy, se3
from vplog.maps.storage import map_store
from vplog.results import tables

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    Verb = Callable[..., Said]
TURNED = se3.pose(se3.so3_exp(np.array([0.0, 0.0, 0.7])), np.array([5.0, -3.0, 2.0]))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two drives on earth, the second 3 km east of the first, and one that is nowhere."""
    far = TURNED @ se3.pose(np.eye(3), np.array([-3000.0, 0.0, 0.0]))
    with map_store.writing(tmp_path / "map") as store:
        put_library(store)
        put(store, "near", 1, world_from_enu=TURNED)
        put(store, "far", 2, world_from_enu=far)
        put(store, "nowhere", 3)
    return tmp_path / "map"


def places(path: Path) -> list[tuple[str, int]]:
    table, column = read_map(path, KIND)
    assert len(column) == len(table)
    return list(zip(table["drive"].to_pylist(), table["keyframe"].to_pylist(), strict=True))


def points(path: Path) -> Any:
    return np.array([struct.unpack("<BIddd", one)[2:] for one in pq.read_table(path)["geometry"].to_pylist()])


def test_all_or_some_drives(root: Path, verb: Verb, tmp_path: Path) -> None:
    out = tmp_path / "out.parquet"
    told = verb("map", "export", root, "-o", out, "--json").json
    assert told["drives"] == ["far", "near", "nowhere"]
    assert told["places"] == 3 * PLACES
    assert places(out) == [(drive, row) for drive in told["drives"] for row in range(PLACES)]
    runs = [root / "runs" / f"drive={drive}" for drive in told["drives"]]
    verb("map", "export", *runs, "-o", tmp_path / "runs.parquet")
    assert (tmp_path / "runs.parquet").read_bytes() == out.read_bytes()
    told = verb("map", "export", root, "--drive", "nowhere", "--drive", "near", "-o", out, "--json").json
    assert told["drives"] == ["near", "nowhere"]
    assert {drive for drive, _ in places(out)} == {"near", "nowhere"}
    _, column = read_map(out, KIND)
    assert column.slice(0, PLACES).equals(tables.read_descriptors(runs[1] / "descriptors.parquet")[0].cast(KIND))


def test_geoparquet_says_where_every_place_is(root: Path, verb: Verb, tmp_path: Path) -> None:
    """By the way in, from degrees to metres, not the way out."""
    out = tmp_path / "out.parquet"
    said = verb("map", "export", root, "--format", "geoparquet", "-o", out)
    assert "nowhere is left out" in said.err
    assert f"{2 * PLACES} places of 2 drives" in said.out
    where = points(out)
    about = json.loads(pq.read_schema(out).metadata[b"geo"])["columns"]["geometry"]
    assert about["bbox"] == [*where.min(0), *where.max(0)]
    unknown = np.full((2 * PLACES + 1, 3, 3), np.nan)
    rows = np.vstack([[11.0, 48.0, 500.0], where])
    enu = geodesy.local_enu(Gps(np.arange(len(rows)), rows[:, 1], rows[:, 0], rows[:, 2], unknown)).enu_m[1:]
    _, world = tables.read_keyframes(root / "runs" / "drive=near" / "keyframes.parquet")
    near = np.array([drive == "near" for drive, _ in places(out)])
    np.testing.assert_allclose(se3.transform(TURNED, enu[near]), world[:, :3, 3], atol=1e-5)
    assert np.all(enu[~near, 0] - enu[near, 0].mean() > 2900)
    query = "select drive, count(*) from read_parquet(?) group by 1 order by 1"
    assert duckdb.execute(query, [str(out)]).fetchall() == [("far", PLACES), ("near", PLACES)]


def test_a_box_on_earth(root: Path, verb: Verb, tmp_path: Path) -> None:
    """Exactly the places whose points are in it, its edges included, in either format."""
    every, out = tmp_path / "every.parquet", tmp_path / "out.parquet"
    verb("map", "export", root, "--format", "geoparquet", "-o", every)
    where, names = points(every), places(every)
    near = np.array([drive == "near" for drive, _ in names])
    low, high = where[near].min(0), where[near].max(0)
    middle = float(np.median(where[near, 0]))
    for south, west, north, east in (
        (-90.0, -180.0, 90.0, 180.0), (low[1], low[0], high[1], high[0]), (low[1], middle, high[1], high[0]),
        (-90.0, middle, 90.0, -170.0),
    ):  # fmt: skip
        box = f"--box={south!r},{west!r},{north!r},{east!r}".replace("np.float64(", "").replace(")", "")
        inside = (where[:, 1] >= south) & (where[:, 1] <= north)
        inside &= (
            (where[:, 0] >= west) & (where[:, 0] <= east)
            if west <= east
            else (where[:, 0] >= west) | (where[:, 0] <= east)
        )
        assert inside.any()
        for kind in ("parquet", "geoparquet"):
            told = verb("map", "export", root, box, "--format", kind, "-o", out, "--json").json
            assert places(out) == [names[row] for row in np.flatnonzero(inside)]
            assert told["left_out"] == ["nowhere"]
    assert np.array_equal(points(out), where[inside])


def test_what_cannot_be_exported_is_one_line(root: Path, verb: Verb, tmp_path: Path) -> None:
    out = tmp_path / "out.parquet"
    assert "Drives: far, near, nowhere" in verb("map", "export", root, "--drive", "none", "-o", out).error
    assert "1 of 3 drives have no place on earth" in verb("map", "export", root, "--box=0,0,1,1", "-o", out).error
    assert "alone" in verb("map", "export", root, root / "runs" / "drive=near", "-o", out).error
    run = root / "runs" / "drive=near"
    assert "--drive" in verb("map", "export", run, "--drive", "near", "-o", out).error
    for box in ("1,2,3", "1,2,0,3", "a,b,c,d", "0,0,91,0", "0,-181,1,0"):
        assert verb("map", "export", root, f"--box={box}", "-o", out).code == 2
    assert "no finished drive" in verb("map", "export", make_map(tmp_path / "empty", {}), "-o", out).error
    assert not out.exists()


def test_an_exported_file_goes_into_a_map_with_its_library(root: Path, verb: Verb, tmp_path: Path) -> None:
    """The same places in the same spots of the earth, found and exported as those of the map that they are from."""
    out, other = tmp_path / "out.parquet", make_map(tmp_path / "other", {"near": 7})
    verb("map", "export", root, "-o", out)
    told = verb("map", "merge", out, "-o", other, "--json").json
    assert [(one["drive"], one["as"], one["state"]) for one in told["drives"]] == [
        ("far", "far", "places taken"), ("near", "near-2", "places taken"), ("nowhere", "nowhere", "places taken"),
    ]  # fmt: skip
    store = map_store.Store(other)
    for drive, taken in (("far", "far"), ("near", "near-2"), ("nowhere", "nowhere")):
        run, own = store.run(taken), root / "runs" / f"drive={drive}"
        (keyframes, world), (known, there) = (tables.read_keyframes(at / "keyframes.parquet") for at in (run, own))
        assert keyframes.drive == taken
        np.testing.assert_array_equal(keyframes.stamp_ns, known.stamp_ns)
        np.testing.assert_allclose(world, there, atol=1e-12)
        column, library = tables.read_descriptors(run / "descriptors.parquet")
        assert column.equals(tables.read_descriptors(own / "descriptors.parquet")[0])
        assert library == LIBRARY
        assert len(tables.read_closures(run / "closures.parquet")) == 0
        assert store.earth(taken) is not None or drive == "nowhere"
    about = {one["drive"]: one["bounds"] for one in verb("map", "info", root, "--json").json["drives"]}
    assert about["nowhere"] is None
    west = {drive: bounds[1] for drive, bounds in about.items() if bounds}
    assert west["far"] > west["near"] + 0.03
    drives = verb("map", "info", other, "--json").json["drives"]
    assert {one["drive"]: one["bounds"] for one in drives if one["drive"] != "near"} == {
        "far": about["far"], "near-2": about["near"], "nowhere": None,
    }  # fmt: skip
    verb("map", "export", root, "--box=" + ",".join(map(str, about["near"])), "-o", tmp_path / "near.parquet")
    assert {drive for drive, _ in places(tmp_path / "near.parquet")} == {"near"}
    again = verb("map", "merge", out, "-o", other, "--json").json
    assert {one["state"] for one in again["drives"]} == {"there already"}
    for folder in (root, other):
        verb("map", "export", folder, "--format", "geoparquet", "-o", folder / "geo.parquet")
    np.testing.assert_allclose(points(other / "geo.parquet"), points(root / "geo.parquet"), atol=1e-9)
    told = verb("map", "info", other, "--json").json
    assert [one["keyframes"] for one in told["drives"]] == [PLACES] * 4
    assert "out.parquet" in told["drives"][0]["warnings"][0]
    whole = verb("map", "merge", root, out, "-o", other, "--json").json
    assert [one["state"] for one in whole["drives"]] == ["taken"] * 3 + ["there already"] * 3
    assert [one["as"] for one in whole["drives"]] == ["far", "near-2", "nowhere"] * 2
    assert len(tables.read_closures(store.run("far") / "closures.parquet")) > 0
    assert set(store.drives()) == {"far", "near", "near-2", "nowhere"}


def test_a_part_of_a_map_goes_by_file(root: Path, verb: Verb, tmp_path: Path) -> None:
    whole, out, other = tmp_path / "whole.parquet", tmp_path / "out.parquet", make_map(tmp_path / "other", {"x": 7})
    verb("map", "export", root, "--format", "geoparquet", "-o", whole)
    near = np.array([drive == "near" for drive, _ in places(whole)])
    middle = float(np.median(points(whole)[near, 0]))
    verb("map", "export", root, f"--box=-90,{middle!r},90,180".replace("np.float64(", ""), "-o", out)
    inside = [place for place in places(out) if place[0] == "near"]
    assert 0 < len(inside) < PLACES
    verb("map", "merge", out, "--drive", "near", "-o", other)
    store = map_store.Store(other)
    assert list(store.drives()) == ["near", "x"]
    assert store.rows("descriptors", "near") == len(inside)
    for source, state, count in (
        (out, "there already", len(inside)),
        (whole, "places taken", PLACES),
        (out, "there already", PLACES),
    ):
        told = verb("map", "merge", source, "--drive", "near", "-o", other, "--json").json
        assert [one["state"] for one in told["drives"]] == [state]
        assert store.rows("descriptors", "near") == count


def test_an_export_goes_from_server_to_map(root: Path, verb: Verb, tmp_path: Path) -> None:
    out, other = tmp_path / "served" / "out.parquet", make_map(tmp_path / "other", {"x": 7})
    out.parent.mkdir()
    verb("map", "export", root, "-o", out)
    handler = partial(SimpleHTTPRequestHandler, directory=str(out.parent))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_address[1]}/out.parquet"
        told = verb("map", "merge", url, "-o", other, "--json").json
        server.shutdown()
    assert {one["from"] for one in told["drives"]} == {url}
    assert map_store.Store(other).drives()["far"]["log"] == f"{url}#far"


def test_files_that_are_no_export_or_of_another_library_are_one_line(root: Path, verb: Verb, tmp_path: Path) -> None:
    out, other = tmp_path / "out.parquet", make_map(tmp_path / "other", {"x": 7}, OTHER_LIBRARY)
    verb("map", "export", root, "-o", out)
    assert "do not compare" in verb("map", "merge", out, "-o", other).error
    assert "without their library" in verb("map", "merge", out, "-o", tmp_path / "new").error
    assert not (tmp_path / "new").exists()
    assert (
        "not a file of places"
        in verb("map", "merge", root / "keyframes/drive=near/keyframes.parquet", "-o", root).error
    )
    (tmp_path / "text").write_text("no table")
    assert "cannot be read" in verb("map", "merge", tmp_path / "text", "-o", root).error
    table = pq.read_table(out)
    deep = table.replace_schema_metadata(
        {**table.schema.metadata, b"vplog.settings": b'{"a":' * 900 + b"1" + b"}" * 900}
    )
    pq.write_table(deep, tmp_path / "deep")
    assert "cannot be read" in verb("map", "merge", tmp_path / "deep", "-o", root).error
    mine = make_map(tmp_path / "mine", {"x": 7})
    for damaged, why in (
        (pa.concat_tables([table, table]), "together"), (table.drop_columns(["stamp_ns"]), "cannot be read"),
        (table.slice(PLACES), "no place of far"), (table.take(list(range(PLACES))[::-1]), "do not increase"),
    ):  # fmt: skip
        pq.write_table(damaged, out)
        assert why in verb("map", "merge", out, "-o", mine).error
        with map_store.writing(mine) as store:
            for drive in store.drives():
                if drive != "x":
                    map_store.remove(store, [drive])
