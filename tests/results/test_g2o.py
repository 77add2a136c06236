"""g2o files from anywhere: what they hold comes back, and what is wrong with them is said with its line."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.results.example import make_run
from vplog.data import EdgeKind, PoseGraph
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.results import g2o
from vplog.results.g2o import read_g2o, write_g2o

if TYPE_CHECKING:
    from pathlib import Path

PLANAR = """# a square
VERTEX_SE2 20 1 1 3.1
VERTEX_SE2 0 0 0 0
EDGE_SE2 0 10 1 0 1.5708 4 1 2 5 3 6   # x y yaw, then the upper triangle
EDGE_SE2 10 20 1 0 1.5708 4 1 2 5 3 6

FIX 20
EDGE_SE2 20 0 1 1 3.1416 4 0 0 4 0 4
EDGE_SE2_XY 0 77 1 2 1 0 1
"""
SPATIAL = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.6 0.8 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21
"""


def file(folder: Path, text: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text(text, encoding="latin-1")
    return path


def planar(poses: int, loops: int, seed: int) -> PoseGraph:
    random = np.random.default_rng(seed)
    a = np.concatenate([np.arange(poses - 1), random.integers(0, poses - 3, loops)])
    b = np.concatenate([np.arange(1, poses), a[poses - 1 :] + 2])
    root = random.normal(size=(len(a), 3, 3))
    information = np.zeros((len(a), 6, 6))
    information[:, 2:5, 2:5] = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    kind = [EdgeKind.ODOMETRY] * (poses - 1) + [EdgeKind.LOOP] * loops
    some = [
        se3.pose(
            se3.so3_exp(np.stack([np.zeros(n), np.zeros(n), random.uniform(-np.pi, np.pi, n)], axis=1)),
            np.stack([*random.normal(size=(2, n)) * 1e3, np.zeros(n)], axis=1),
        )
        for n in (poses, len(a))
    ]
    return PoseGraph(some[0], a.astype(np.int32), b.astype(np.int32), some[1], information, kind, 2)


@settings(max_examples=20, deadline=None)
@given(st.integers(4, 12), st.integers(0, 5), st.integers(0, 1000), st.booleans())
def test_what_is_written_comes_back(
    tmp_path_factory: pytest.TempPathFactory, poses: int, loops: int, seed: int, symbols: bool
) -> None:
    graph = planar(poses, loops, seed)
    ids = np.arange(poses) + (ord("a") << 56 if symbols else 7)
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(path, graph, graph.world_from_body, ids, held=2)
    read = read_g2o(path)
    np.testing.assert_array_equal(read.ids, ids)
    assert read.held == 2
    assert read.warnings == []
    assert read.graph.dimension == 2
    assert read.graph.kind == graph.kind
    np.testing.assert_array_equal(np.stack([read.graph.a, read.graph.b]), np.stack([graph.a, graph.b]))
    np.testing.assert_array_equal(read.graph.information, graph.information)
    np.testing.assert_allclose(read.graph.a_from_b, graph.a_from_b, rtol=0, atol=1e-11)
    np.testing.assert_allclose(read.graph.world_from_body, graph.world_from_body, rtol=0, atol=1e-11)


def test_a_run_comes_back(tmp_path: Path) -> None:
    run = make_run()
    write_g2o(tmp_path / "g.g2o", run.graph, run.solution.world_from_body)
    read = read_g2o(tmp_path / "g.g2o").graph
    assert read.dimension == 3
    np.testing.assert_array_equal(read.information, run.graph.information)
    np.testing.assert_allclose(read.a_from_b, run.graph.a_from_b, atol=1e-14)
    np.testing.assert_allclose(read.world_from_body, run.solution.world_from_body, atol=1e-12)


@pytest.mark.parametrize("planar_file", [True, False])
def test_gtsam_reads_the_same(tmp_path: Path, planar_file: bool) -> None:
    gtsam = pytest.importorskip("gtsam")
    path = tmp_path / "g.g2o"
    run = make_run()
    graph = planar(9, 4, 0) if planar_file else run.graph
    write_g2o(path, graph, graph.world_from_body)
    factors, values = gtsam.readG2o(str(path), not planar_file)
    read = read_g2o(path).graph
    assert (factors.size(), values.size()) == (len(graph.a), len(graph.world_from_body))
    order = [2, 0, 1] if planar_file else list(range(6))
    axes = [2, 3, 4] if planar_file else list(range(6))
    for edge in range(factors.size()):
        root = factors.at(edge).noiseModel().R()
        theirs = (root.T @ root)[np.ix_(order, order)]
        np.testing.assert_allclose(theirs, read.information[edge][np.ix_(axes, axes)], rtol=1e-9, atol=1e-9)
    for node in range(values.size()):
        pose = values.atPose2(node) if planar_file else values.atPose3(node)
        np.testing.assert_allclose(pose.matrix()[:2, -1], read.world_from_body[node, :2, 3], rtol=1e-12, atol=1e-12)


def test_any_order_gaps_comments_and_missing_vertices(tmp_path: Path) -> None:
    read = read_g2o(file(tmp_path, PLANAR))
    assert read.ids.tolist() == [0, 10, 20]
    assert read.held == 2
    # no two ids follow each other, so neighbours do
    assert read.graph.kind == [EdgeKind.ODOMETRY, EdgeKind.ODOMETRY, EdgeKind.LOOP]
    np.testing.assert_allclose(read.graph.world_from_body[1, :2, 3], [1, 0])  # placed along its edge
    np.testing.assert_array_equal(read.graph.information[0, 2:5, 2:5], [[6, 2, 3], [2, 4, 1], [3, 1, 5]])
    assert any("1 of 3 poses without a VERTEX" in text for text in read.warnings)
    assert any("EDGE_SE2_XY" in text for text in read.warnings)


def test_spatial_information_is_turned_to_rotation_first(tmp_path: Path) -> None:
    read = read_g2o(file(tmp_path, SPATIAL)).graph
    information = read.information[0]
    np.testing.assert_array_equal(np.diagonal(information), [16, 19, 21, 1, 7, 12])
    assert information[3, 0] == information[0, 3] == 4  # x with the turn about x
    np.testing.assert_allclose(se3.quaternion(read.a_from_b[0, :3, :3]), [0, 0, 0.6, 0.8])


def test_edges_of_a_pose_to_itself_are_left_out_and_said(tmp_path: Path) -> None:
    edge = "1 0 0 1 0 0 1 0 1\n"
    pairs = ((0, 1), (1, 1), (1, 2), (7, 7))
    read = read_g2o(file(tmp_path, "".join(f"EDGE_SE2 {a} {b} {edge}" for a, b in pairs)))
    np.testing.assert_array_equal(np.stack([read.graph.a, read.graph.b]), [[0, 1], [1, 2]])
    assert read.ids.tolist() == [0, 1, 2, 7]
    assert any("2 edges of a pose to itself left out (first: line 2, vertex 1)" in text for text in read.warnings)


def test_consecutive_ids_are_odometry_once(tmp_path: Path) -> None:
    edge = "1 0 0 1 0 0 1 0 1\n"
    text = "".join(f"EDGE_SE2 {a} {b} {edge}" for a, b in ((0, 1), (1, 2), (3, 2), (0, 1), (3, 9), (0, 3)))
    read = read_g2o(file(tmp_path, text))
    loop, odometry = EdgeKind.LOOP, EdgeKind.ODOMETRY
    assert read.graph.kind == [odometry, odometry, odometry, loop, loop, loop]
    np.testing.assert_allclose(read.graph.world_from_body[:, 0, 3], [0, 1, 2, 1, 2])  # the third edge leads back


@pytest.mark.parametrize(
    ("pairs", "odometry"),
    [
        ([(0, 1), (1, 2), (5, 6), (2, 6)], 3),
        ([(0, 2), (2, 4), (4, 6), (1, 3), (3, 5), (5, 7), (2, 3)], 0),  # two robots with even and odd ids
        ([(0, 3), (3, 4), (4, 7), (7, 1), (1, 5), (5, 2), (2, 6), (6, 0)], 0),  # a graph of views
    ],
)
def test_without_a_chain_no_edge_is_odometry(tmp_path: Path, pairs: list[tuple[int, int]], odometry: int) -> None:
    read = read_g2o(file(tmp_path, "".join(f"EDGE_SE2 {a} {b} 1 0 0 1 0 0 1 0 1\n" for a, b in pairs)))
    assert read.graph.odometry.sum() == odometry
    assert any("No odometry" in text for text in read.warnings) == (odometry == 0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no EDGE_SE2 or EDGE_SE3"),
        ("VERTEX_SE2 0 0 0 0\n", "no EDGE_SE2 or EDGE_SE3"),
        ("VERTEX2 0 0 0 0\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\n", "It is TORO's: convert it"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", "line 1: 8 numbers after the ids instead of 9"),
        ("# c\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1 1\n", "line 2: 10 numbers"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1 1\n", "line 1: 8 numbers"),
        ("EDGE_SE2 0 1\n", "line 1: EDGE_SE2 ends too early"),
        ("EDGE_SE2 0 1 nan 0 0 1 0 0 1 0 1\n", "line 1: 'nan' is not a finite number"),
        ("EDGE_SE2 0 1 1 0 1e999 1 0 0 1 0 1\n", "line 1: '1e999' is not"),
        ("EDGE_SE2 0 1 1 0 x 1 0 0 1 0 1\n", "line 1: 'x' is not"),
        ("EDGE_SE2 0 -1 1 0 0 1 0 0 1 0 1\n", "line 1: '-1' is no vertex id"),
        ("EDGE_SE2 0 1.5 1 0 0 1 0 0 1 0 1\n", "line 1: '1.5' is no vertex id"),
        ("EDGE_SE2 0 9223372036854775808 1 0 0 1 0 0 1 0 1\n", "is no vertex id"),
        ("EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0\n", "line 1: diagonal of the information has 0"),
        ("EDGE_SE2 0 1 1 0 0 -2 0 0 1 0 1\n", "line 1: diagonal of the information has -2"),
        ("EDGE_SE2 0 1 1e30 0 0 1 0 0 1 0 1\n", r"line 1: 1e\+30 m"),
        ("VERTEX_SE2 4 0 0 0\nVERTEX_SE2 4 1 0 0\nEDGE_SE2 4 5 1 0 0 1 0 0 1 0 1\n", "line 2: vertex 4 .* line 1"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nFIX 8\n", "line 2: FIX 8"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n\x89PNG\x00\x00\n", "line 2: .*is not a g2o element"),
        (SPATIAL + "VERTEX_SE2 2 0 0 0\n", "line 4: VERTEX_SE2 in a graph that has EDGE_SE3"),
        (SPATIAL.replace("0.6 0.8", "0.6 0.1"), "line 3: the quaternion has length 0.608"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(GraphError, match=said) as error:
        read_g2o(file(tmp_path, text))
    assert "\n" not in str(error.value)


def test_a_byte_order_mark_is_left_out(tmp_path: Path) -> None:
    assert read_g2o(file(tmp_path, "\u00ef\u00bb\u00bfVERTEX_SE2 5 3 0 0\n" + PLANAR)).ids.tolist() == [0, 5, 10, 20]


def test_edges_with_a_switch_are_named_as_edges(tmp_path: Path) -> None:
    text = "EDGE_SE2_SWITCHABLE 0 2 9 1 0 0 1 0 0 1 0 1\nVERTEX_SWITCH 9 1\n"
    warnings = " ".join(read_g2o(file(tmp_path, PLANAR + text)).warnings)
    assert "1 line of EDGE_SE2_SWITCHABLE left out: write them as EDGE_SE2" in warnings
    assert "1 line of VERTEX_SWITCH left out: they are no poses" in warnings


def test_what_is_no_file_or_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (tmp_path, tmp_path / "none.g2o"):
        with pytest.raises(GraphError, match="is not a file"):
            read_g2o(path)
    monkeypatch.setattr(g2o, "_MOST_BYTES", 10)
    with pytest.raises(GraphError, match="graphs of up to"):
        read_g2o(file(tmp_path, SPATIAL))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 400))
def test_damage_leads_to_an_error_or_a_graph(tmp_path_factory: pytest.TempPathFactory, noise: bytes, at: int) -> None:
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    text = PLANAR.encode()
    path.write_bytes(text[:at] + noise + text[at:])
    try:
        read = read_g2o(path)
    except GraphError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(read.graph.a_from_b).all()


def test_parts_without_poses_are_placed_from_their_firsts(tmp_path: Path) -> None:
    edge = "1 0 0 1 0 0 1 0 1\n"
    read = read_g2o(file(tmp_path, f"EDGE_SE2 0 1 {edge}EDGE_SE2 5 6 {edge}VERTEX_SE2 6 10 0 0\n"))
    np.testing.assert_allclose(read.graph.world_from_body[:, 0, 3], [0, 1, 9, 10])


def test_what_is_fixed_may_be_no_pose_and_have_a_comment(tmp_path: Path) -> None:
    lines = ["VERTEX_XY 7 1 2", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "FIX 1  # anchor", ""]
    assert read_g2o(file(tmp_path, "\n".join(lines))).held == 1
    lines[2] = "FIX 7"
    found = read_g2o(file(tmp_path, "\n".join(lines)))
    assert found.held == 0
    assert any("FIX 7 is left out" in text for text in found.warnings)


def test_many_fixed_poses_take_no_time(tmp_path: Path) -> None:
    lines = [f"EDGE_SE2 {n} {n + 1} 1 0 0 1 0 0 1 0 1" for n in range(20_000)]
    text = "\n".join([*lines, "FIX " + "1 " * 1_000_000, ""])
    began = time.process_time()
    assert read_g2o(file(tmp_path, text)).held == 1
    assert time.process_time() - began < 20.0
