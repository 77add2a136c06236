from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.results.example import COUNT, METADATA, make_run
from vplog.data import Closures, Verdict
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.results import tables

if TYPE_CHECKING:
    from pathlib import Path

RUN = make_run()
RESIDUAL = np.linspace(0.0, 3.0, len(RUN.graph.a))


def write_all(folder: Path) -> list[Path]:
    names = ["keyframes", "closures", "edges", "trajectory", "descriptors"]
    paths = [folder / f"{name}.parquet" for name in names]
    tables.write_keyframes(paths[0], RUN.keyframes, RUN.solution.world_from_body, METADATA)
    tables.write_closures(paths[1], RUN.closures, RUN.keyframes, METADATA)
    tables.write_edges(paths[2], RUN.graph, RUN.solution, RESIDUAL, METADATA)
    tables.write_trajectory(paths[3], RUN.trajectory, RUN.odometry, METADATA)
    column = pa.array([bytes([row]) for row in range(COUNT)], pa.binary())
    tables.write_descriptors(paths[4], RUN.keyframes, column, METADATA)
    return paths


def assert_same(read: Any, written: Any, poses: tuple[str, ...]) -> None:
    for field in dataclasses.fields(written):
        left, right = getattr(read, field.name), getattr(written, field.name)
        if field.name in poses:
            np.testing.assert_allclose(left, right, rtol=0, atol=1e-12)
        elif isinstance(right, np.ndarray):
            assert left.dtype == right.dtype, field.name
            np.testing.assert_array_equal(left, right, err_msg=field.name)
        elif field.name.startswith("shared_"):
            for one, other in zip(left, right, strict=True):
                assert one.dtype == other.dtype, field.name
                np.testing.assert_array_equal(one, other, err_msg=field.name)
        else:
            assert left == right, field.name


def test_keyframes_come_back(tmp_path: Path) -> None:
    tables.write_keyframes(tmp_path / "k", RUN.keyframes, RUN.solution.world_from_body, METADATA)
    keyframes, world = tables.read_keyframes(tmp_path / "k")
    assert_same(keyframes, RUN.keyframes, ("odom_from_body",))
    np.testing.assert_allclose(world, RUN.solution.world_from_body, rtol=0, atol=1e-12)


def test_the_covariance_of_keyframes_comes_back_and_tables_of_before_have_none(tmp_path: Path) -> None:
    count = len(RUN.keyframes.stamp_ns)
    covariance = np.random.default_rng(0).normal(size=(count, 6, 6))
    covariance[1] = np.nan
    for given, expected in ((covariance, covariance), (None, np.full((count, 6, 6), np.nan))):
        tables.write_keyframes(tmp_path / "k", RUN.keyframes, RUN.solution.world_from_body, METADATA, given)
        np.testing.assert_array_equal(tables.read_keyframe_covariance(tmp_path / "k"), expected)
    pq.write_table(pq.read_table(tmp_path / "k").drop_columns(["covariance"]), tmp_path / "before")
    assert np.isnan(tables.read_keyframe_covariance(tmp_path / "before")).all()


def test_closures_come_back_with_what_is_unknown(tmp_path: Path) -> None:
    tables.write_closures(tmp_path / "c", RUN.closures, RUN.keyframes, METADATA)
    assert_same(tables.read_closures(tmp_path / "c"), RUN.closures, ("match_from_query",))


def test_the_covariance_is_the_inverse_where_there_is_one(tmp_path: Path) -> None:
    """Of a pose without metres some direction is open: its information has no inverse, and the table no covariance."""
    information = RUN.closures.information.copy()
    [accepted] = [row for row, verdict in enumerate(RUN.closures.verdict) if verdict is Verdict.ACCEPTED]
    information[accepted, 5] = information[accepted, :, 5] = 0.0
    closures = dataclasses.replace(RUN.closures, information=information)
    tables.write_closures(tmp_path / "c", closures, RUN.keyframes, METADATA)
    written = pq.read_table(tmp_path / "c")["covariance"].to_pylist()
    known = [row for row, values in enumerate(written) if values is not None]
    assert known == [row for row, verdict in enumerate(closures.verdict) if verdict is Verdict.REJECTED_BY_SOLVER]
    np.testing.assert_allclose(np.reshape(written[known[0]], (6, 6)) @ information[known[0]], np.eye(6), atol=1e-9)


def test_shared_references_without_their_overlap_are_refused(tmp_path: Path) -> None:
    tables.write_closures(tmp_path / "c", RUN.closures, RUN.keyframes, METADATA)
    table = pq.read_table(tmp_path / "c")
    at = table.schema.get_field_index("shared_overlap")
    empty = pa.array([[]] * len(table), table.schema.field(at).type)
    pq.write_table(table.set_column(at, table.schema.field(at), empty), tmp_path / "c")
    with pytest.raises(ResultError, match="without their overlap"):
        tables.read_closures(tmp_path / "c")


@pytest.mark.parametrize("name", ["verdict", "scale"])
def test_words_that_are_none_of_ours_are_named(tmp_path: Path, name: str) -> None:
    tables.write_closures(tmp_path / "c", RUN.closures, RUN.keyframes, METADATA)
    table = pq.read_table(tmp_path / "c")
    at = table.schema.get_field_index(name)
    pq.write_table(table.set_column(at, table.schema.field(at), pa.array(["guess"] * len(table))), tmp_path / "c")
    with pytest.raises(ResultError, match=r"guess.*(too_far|stereo)"):
        tables.read_closures(tmp_path / "c")


@pytest.mark.parametrize("name", ["shared_references", "shared_overlap", "reverse_inliers", "scale"])
def test_a_ledger_of_an_older_version_is_told_apart(tmp_path: Path, name: str) -> None:
    tables.write_closures(tmp_path / "c", RUN.closures, RUN.keyframes, METADATA)
    pq.write_table(pq.read_table(tmp_path / "c").drop_columns([name]), tmp_path / "c")
    with pytest.raises(ResultError, match=f"no column {name} .* another version of vplog"):
        tables.read_closures(tmp_path / "c")


def test_empty_ledger_comes_back(tmp_path: Path) -> None:
    fields = {f.name: getattr(RUN.closures, f.name)[:0] for f in dataclasses.fields(Closures)}
    empty = Closures(**fields)
    tables.write_closures(tmp_path / "c", empty, RUN.keyframes, METADATA)
    assert_same(tables.read_closures(tmp_path / "c"), empty, ())


def test_edges_come_back(tmp_path: Path) -> None:
    tables.write_edges(tmp_path / "e", RUN.graph, RUN.solution, RESIDUAL, METADATA)
    graph, weight, residual = tables.read_edges(tmp_path / "e", RUN.graph.world_from_body)
    assert_same(graph, RUN.graph, ("a_from_b",))
    np.testing.assert_array_equal(weight, RUN.solution.weight)
    np.testing.assert_array_equal(residual, RESIDUAL)


def test_trajectory_comes_back(tmp_path: Path) -> None:
    tables.write_trajectory(tmp_path / "t", RUN.trajectory, RUN.odometry, METADATA)
    trajectory, odometry = tables.read_trajectory(tmp_path / "t")
    assert_same(trajectory, RUN.trajectory, ("world_from_body",))
    np.testing.assert_allclose(odometry.odom_from_body, RUN.odometry.odom_from_body, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", [pa.binary(), pa.list_(pa.int32()), pa.list_(pa.float32(), 4)], ids=str)
def test_descriptors_come_back_and_bytes_do_not_depend_on_what_they_are_a_slice_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: pa.DataType
) -> None:
    monkeypatch.setattr(tables, "DESCRIPTORS_PER_GROUP", 8)
    values = [bytes([row] * row) if kind == pa.binary() else [row, row + 1, row + 2, row + 3] for row in range(COUNT)]
    files = []
    for before, after in ((0, 0), (3, 0), (1, 5)):
        path = tmp_path / f"{before}"
        column = pa.array([*values[-before:][:before], *values, *values[:after]], kind).slice(before, COUNT)
        tables.write_descriptors(path, RUN.keyframes, column, METADATA)
        files.append(path.read_bytes())
        read, library = tables.read_descriptors(path)
        assert read.to_pylist() == values
        assert read.type == kind
        assert library == METADATA.library
    assert len(set(files)) == 1
    assert pq.ParquetFile(tmp_path / "1").num_row_groups == 4


@pytest.mark.parametrize("count", [COUNT - 1, COUNT + 1])
def test_descriptors_must_be_as_many_as_keyframes(tmp_path: Path, count: int) -> None:
    with pytest.raises(ResultError, match=f"{count} descriptors came for {COUNT}"):
        tables.write_descriptors(tmp_path / "d", RUN.keyframes, pa.array([b""] * count, pa.binary()), METADATA)
    assert list(tmp_path.iterdir()) == []


def test_same_run_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    pairs = zip(write_all(tmp_path / "one"), write_all(tmp_path / "two"), strict=True)
    assert all(one.read_bytes() == two.read_bytes() for one, two in pairs)


def test_every_file_says_what_made_it(tmp_path: Path) -> None:
    for path in write_all(tmp_path):
        header = tables.read_metadata(path)
        assert sorted(header) == [
            *("vplog.library", "vplog.settings", "vplog.table", "vplog.table_version", "vplog.version")
        ]
        assert json.loads(header["vplog.settings"]) == METADATA.settings
        assert header["vplog.table"] == path.stem


def test_duckdb_reads_every_table(tmp_path: Path) -> None:
    for path in write_all(tmp_path):
        rows = duckdb.execute("select * from read_parquet(?)", [str(path)]).fetchall()
        assert len(rows) == pq.read_metadata(path).num_rows
    path = str(tmp_path / "closures.parquet")
    known, unknown = duckdb.execute("select count(tx), count(*) - count(tx) from read_parquet(?)", [path]).fetchall()[0]
    assert (known, unknown) == (2, len(RUN.closures) - 2)
    most = "select max(list_max(shared_overlap)), sum(len(shared_references)) from read_parquet(?)"
    shares = np.concatenate(RUN.closures.shared_overlap)
    assert duckdb.execute(most, [path]).fetchall() == [(shares.max(), len(shares))]
    query = "select query_stamp_ns, reason, information[8] from read_parquet(?) where verdict = 'accepted'"
    row = RUN.closures.verdict.index(Verdict.ACCEPTED)
    stamp = int(RUN.keyframes.stamp_ns[RUN.closures.query[row]])
    expected = (stamp, Verdict.ACCEPTED.sentence, RUN.closures.information[row, 1, 1])
    assert duckdb.execute(query, [path]).fetchall() == [expected]


def test_quaternions_are_unit_with_w_not_negative(tmp_path: Path) -> None:
    tables.write_trajectory(tmp_path / "t", RUN.trajectory, RUN.odometry, METADATA)
    table = pq.read_table(tmp_path / "t")
    q = np.stack([table[f"q{axis}"].to_numpy() for axis in "xyzw"], axis=1)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(se3.rotation(q), RUN.trajectory.world_from_body[:, :3, :3], atol=1e-12)


def test_reading_what_is_not_there_or_not_ours_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no table")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "other")
    tables.write_trajectory(tmp_path / "trajectory", RUN.trajectory, RUN.odometry, METADATA)
    whole = (tmp_path / "trajectory").read_bytes()
    (tmp_path / "cut").write_bytes(whole[: len(whole) // 2])
    for name in ("missing", "text", "other", "trajectory", "cut"):
        with pytest.raises(ResultError) as caught:
            tables.read_closures(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert name in str(caught.value)


def test_missing_column_is_named(tmp_path: Path) -> None:
    tables.write_trajectory(tmp_path / "t", RUN.trajectory, RUN.odometry, METADATA)
    table = pq.read_table(tmp_path / "t").drop_columns(["qw"])
    pq.write_table(table, tmp_path / "t")
    with pytest.raises(ResultError, match="no column qw"):
        tables.read_trajectory(tmp_path / "t")


def test_null_where_none_may_be_is_named(tmp_path: Path) -> None:
    tables.write_trajectory(tmp_path / "t", RUN.trajectory, RUN.odometry, METADATA)
    table = pq.read_table(tmp_path / "t")
    stamps = pa.array([None] * COUNT, pa.int64())
    table = table.set_column(0, pa.field("stamp_ns", pa.int64()), stamps)
    pq.write_table(table, tmp_path / "t")
    with pytest.raises(ResultError, match="nulls in column stamp_ns"):
        tables.read_trajectory(tmp_path / "t")


def test_edges_of_another_run_are_refused(tmp_path: Path) -> None:
    tables.write_edges(tmp_path / "e", RUN.graph, RUN.solution, RESIDUAL, METADATA)
    with pytest.raises(ResultError, match="another run"):
        tables.read_edges(tmp_path / "e", RUN.graph.world_from_body[:5])
