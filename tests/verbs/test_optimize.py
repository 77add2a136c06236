"""`vplog optimize` from file to file, as a function and as the verb."""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from tests.benchmarks.graphs import aligned_error, bicocca_truth, city, false_by_gps, spoiled
from tests.graph.drive import ring
from vplog.cli import main, results
from vplog.data import EdgeKind, Int32s, PoseGraph
from vplog.errors import GraphError, ResultError
from vplog.geometry import se3
from vplog.graph import lm
from vplog.graph.consistency import OdometryChain, is_loop
from vplog.graph.solve import OptimiserSettings
from vplog.results.g2o import read_g2o, write_g2o
from vplog.verbs.optimize import optimize

CITY, FALSE = spoiled(city(200, seed=5), 0.3, 0)
PUBLIC = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "posegraphs"
EDGE = "1 0 0 100 0 0 100 0 100\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "in.g2o"
    write_g2o(path, CITY, CITY.world_from_body, np.arange(200) * 3 + 50, held=7)
    return path


@pytest.mark.parametrize("kind", results._SOLVERS)
def test_every_method_solves_and_nothing_is_lost(path: Path, tmp_path: Path, kind: str) -> None:
    done = optimize(path, tmp_path / "out.g2o", kind)
    before, after = read_g2o(path), read_g2o(tmp_path / "out.g2o")
    np.testing.assert_array_equal(after.ids, before.ids)
    np.testing.assert_allclose(after.graph.a_from_b, before.graph.a_from_b, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(after.graph.information, before.graph.information)
    np.testing.assert_allclose(after.graph.world_from_body, done.solution.world_from_body, atol=1e-12)
    # FIX 71, the eighth
    assert after.held == 7
    np.testing.assert_allclose(after.graph.world_from_body[7], before.graph.world_from_body[7], atol=1e-12)
    record = json.loads(json.dumps(done.record))
    assert record["method"] == kind
    assert record["kept"] + record["rejected"] == record["loops"] == is_loop(CITY).sum()
    assert record["error_after"] <= record["error_before"] + 1e-12
    if kind in ("gnc", "pcm"):
        false = np.flatnonzero(FALSE)
        expected = {(int(50 + 3 * CITY.a[edge]), int(50 + 3 * CITY.b[edge])) for edge in false}
        assert expected <= set(map(tuple, record["rejected_edges"]))


def test_a_part_that_only_a_rejected_edge_joins_is_named(tmp_path: Path) -> None:
    """Ten poses on a line, ten on another, and between them two closures that contradict each other. The file has every
    other vertex off by 1 m, and 100 / 2 an edge, of 18."""
    text = "".join(f"VERTEX_SE2 {k} {k % 10} {k // 10 * 5 + k % 2} 0\n" for k in range(20))
    text += "".join(f"EDGE_SE2 {k} {k + 1} {EDGE}" for k in range(19) if k != 9)
    (tmp_path / "in.g2o").write_text(text + f"EDGE_SE2 2 12 0 5 {EDGE[4:]}EDGE_SE2 4 14 0 90 {EDGE[4:]}")
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert any("1 part (from 10 on)" in warning for warning in done.record["warnings"])
    assert done.record["odometry_kept"]
    assert done.record["error_before"] == pytest.approx(900.0)
    assert done.record["error_after"] == pytest.approx(0.0, abs=1e-9)


def test_a_local_minimum_is_refused_and_the_record_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A circle of 12 poses, begun with two turns in place of one: plain least squares stays there."""
    turn = 2 * np.pi / 12
    text = "".join(f"VERTEX_SE2 {k} 0 0 {np.angle(np.exp(2j * turn * k))}\n" for k in range(12))
    text += "".join(f"EDGE_SE2 {k} {(k + 1) % 12} {1 + 0.1 * (k == 5)} 0 {turn} 1 0 0 1 0 1\n" for k in range(12))
    (tmp_path / "in.g2o").write_text(text)
    monkeypatch.setattr(lm, "initial_poses", lambda factors, _: factors.graph.world_from_body)
    assert "certificate" not in optimize(tmp_path / "in.g2o", tmp_path / "out.g2o", "lm").record
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o", "lm", certify=True).record
    assert done["error_after"] > 1.0
    found = json.loads(json.dumps(done))["certificate"]
    assert found["verdict"] == "refused"
    assert found["smallest_eigenvalue"] < 0
    assert "isotropic" in found["noise"]
    words = ["optimize", str(tmp_path / "in.g2o"), "-o", str(tmp_path / "out.g2o"), "--method", "lm", "--certify"]
    with pytest.raises(SystemExit):
        main.main(words)
    assert "does not say whether the closures kept are true" in capsys.readouterr().out


def test_the_methods_of_the_command_line_are_those_of_the_seam() -> None:
    assert set(results._SOLVERS) == {settings().kind for settings in get_args(get_args(OptimiserSettings)[0])}


def test_least_squares_uses_every_edge(path: Path, tmp_path: Path) -> None:
    done = optimize(path, tmp_path / "out.g2o", "lm")
    assert done.record["rejected"] == 0
    assert not done.record["odometry_kept"]


@pytest.mark.parametrize(("odometry", "closures"), [(1e-12, 1e-12), (1e12, 1e12), (1e-12, 1e12)])
def test_information_that_no_sensor_has_is_refused(tmp_path: Path, odometry: float, closures: float) -> None:
    """Closures cannot be judged by it; a method that does not judge them still solves the file."""
    graph = ring(40, 12).graph
    information = np.where(is_loop(graph)[:, None, None], closures, odometry) * np.eye(6)
    write_g2o(tmp_path / "in.g2o", replace(graph, information=information), graph.world_from_body)
    with pytest.raises(GraphError, match=r"claims a standard deviation of .* m for steps of .* m.* --method lm"):
        optimize(tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert optimize(tmp_path / "in.g2o", tmp_path / "out.g2o", "lm").record["kept"] == 12


def test_parts_are_solved_each_by_itself_and_that_is_said(tmp_path: Path) -> None:
    text = "".join(f"VERTEX_SE2 {node} {node} 9 0\n" for node in (0, 1, 2, 40, 41, 42, 99))
    text += "".join(f"EDGE_SE2 {a} {b} {EDGE}" for a, b in ((0, 1), (1, 2), (40, 41), (41, 42)))
    text += f"EDGE_SE2 40 42 {EDGE.replace('1', '1.7', 1)}"
    (tmp_path / "in.g2o").write_text(text)
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o", "lm")
    said = " ".join(done.record["warnings"])
    assert "2 unconnected parts" in said
    assert "from 0, 40 on" in said
    assert "1 pose without an edge" in said
    poses = read_g2o(tmp_path / "out.g2o").graph.world_from_body
    np.testing.assert_allclose(poses[:3, 0, 3], [0, 1, 2])
    np.testing.assert_allclose(poses[3:6, 0, 3], [40, 40.9, 41.8], atol=1e-6)  # two of one, one of 1.7
    np.testing.assert_allclose(poses[6, :2, 3], [99, 9])


def test_indefinite_information_is_mended_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "in.g2o").write_text(f"EDGE_SE2 0 1 {EDGE}EDGE_SE2 1 2 1 0 0 100 200 0 100 0 100\n")
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert any("not positive" in text for text in done.record["warnings"])


def test_a_graph_with_every_oddity_is_solved(tmp_path: Path) -> None:
    """Edges of a pose to itself, said twice, nearly singular, impossible, and a piece that nothing joins."""
    ring = [f"EDGE_SE2 {at} {at + 1} 1 0 {np.pi / 4} 100 0 0 100 0 100\n" for at in range(16)]
    loops = [f"EDGE_SE2 {at} {at + 8} 0 0 0 100 0 0 100 0 100\n" for at in range(8)]
    odd = [loops[3], loops[3], f"EDGE_SE2 5 5 {EDGE}", "EDGE_SE2 2 10 0 0 0 100 100 0 100 0 1e-9\n"]
    odd += ["EDGE_SE2 4 12 0 0 0 100 300 0 100 0 100\n", f"EDGE_SE2 90 91 {EDGE}", f"EDGE_SE2 91 91 {EDGE}"]
    (tmp_path / "in.g2o").write_text("".join(ring + loops + odd))
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o", certify=True).record
    assert (done["kept"], done["loops"], done["converged"]) == (12, 12, True)
    said = " ".join(done["warnings"])
    assert all(words in said for words in ("2 edges of a pose to itself", "1 edge is not positive", "2 unconnected"))
    again = read_g2o(tmp_path / "out.g2o").graph.world_from_body
    np.testing.assert_allclose(again[8:17], again[:9], atol=1e-6)


def test_edges_that_say_nothing_of_one_direction_leave_the_closures_true(tmp_path: Path) -> None:
    """Else they are less certain there than a false closure is anywhere."""
    graph, random = ring(40, 12).graph, np.random.default_rng(1)
    direction = random.normal(size=(len(graph.a), 6))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    flat = np.eye(6) - direction[:, :, None] * direction[:, None, :]
    some = (random.random(len(graph.a)) < 0.4)[:, None, None]
    graph = replace(graph, information=np.where(some, flat @ graph.information @ flat, graph.information))
    write_g2o(tmp_path / "in.g2o", graph, graph.world_from_body)
    assert optimize(tmp_path / "in.g2o", tmp_path / "out.g2o").record["kept"] == 12


@pytest.mark.parametrize("step", [1, 2])
def test_edges_computed_from_the_odometry_do_not_make_it_better(tmp_path: Path, step: int) -> None:
    """As those of a covisibility graph are: every true closure was rejected."""
    drive = ring(60, 12, false=2)
    graph, of_closures = drive.graph, len(drive.false) - 59
    a = np.arange(60 - step, dtype=np.int32)
    poses = OdometryChain.of(graph).poses
    write_g2o(
        tmp_path / "in.g2o",
        replace(
            graph,
            a=np.append(graph.a, a),
            b=np.append(graph.b, a + np.int32(step)),
            a_from_b=np.append(graph.a_from_b, se3.between(poses[a], poses[a + step]), axis=0),
            information=np.append(graph.information, graph.information[a], axis=0),
            kind=graph.kind + [EdgeKind.LOOP] * len(a),
        ),
        graph.world_from_body,
    )
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert done.record["kept"] == 12 + len(a)
    assert (done.solution.weight[59 : 59 + of_closures] == ~drive.false[59:]).all()
    assert any(f"restate the odometry: {len(a)} edges" in text for text in done.record["warnings"])


@pytest.mark.parametrize(("claimed", "warned"), [(1.0, False), (0.1, True)])
def test_noise_that_is_not_as_claimed_is_said_and_the_least_squares_are_the_files(
    tmp_path: Path, claimed: float, warned: bool
) -> None:
    graph = ring(60, 20, false=2).graph
    factor = np.where(graph.odometry, claimed, 1.0)[:, None, None] ** -2.0
    write_g2o(tmp_path / "in.g2o", replace(graph, information=graph.information * factor), graph.world_from_body)
    done = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert any("not as the information claims" in text for text in done.record["warnings"]) == warned
    [sigmas] = done.record["sigmas"]
    assert sigmas["rotation"] * claimed == pytest.approx(1.0, rel=0.4)
    weight, poses = done.solution.weight, done.solution.world_from_body
    assert done.record["error_after"] == pytest.approx(lm.half_chi2(done.file.graph, weight, poses))


def test_what_cannot_be_is_said(path: Path, tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="is not a file"):
        optimize(tmp_path / "none.g2o", tmp_path / "out.g2o")
    with pytest.raises(ResultError, match="Cannot write"):
        optimize(path, tmp_path / "none" / "out.g2o")


def test_the_verb(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vplog", *words])
        with pytest.raises(SystemExit) as end:
            main.main(words)
        code, read = end.value.code, capsys.readouterr()
        return code if isinstance(code, int) else 0, read.out, read.err

    out = str(tmp_path / "out.g2o")
    code, told, _ = said("optimize", str(path), "-o", out, "--json")
    assert code == 0
    assert json.loads(told)["poses"] == 200
    code, told, _ = said("optimize", str(path), "-o", out, "--method", "dcs")
    assert code == 0
    assert "closures" in told
    (tmp_path / "bad.g2o").write_text(f"EDGE_SE2 0 1 {EDGE.replace('1 0 0 1', 'nan 0 0 1', 1)}")
    code, told, error = said("optimize", str(tmp_path / "bad.g2o"), "-o", out)
    assert (code, told) == (1, "")
    assert "line 1: 'nan' is not a finite number" in error
    assert said("optimize", str(path), "-o", out, "--method", "magic")[0] == 2


def public(name: str) -> Path:
    if not (PUBLIC / name).exists():
        pytest.skip(f"{PUBLIC / name} is not there; set VPLOG_DATA to the folder of public data.")
    return PUBLIC / name


@pytest.mark.parametrize(
    ("name", "error"),
    [("SE-Sync/CSAIL.g2o", 20.2755), ("SE-Sync/kitti_00.g2o", 49.161), ("SE-Sync/intel.g2o", 22.5022)],
)
def test_public_graphs_reach_their_known_errors(tmp_path: Path, name: str, error: float) -> None:
    done = optimize(public(name), tmp_path / "out.g2o", "lm")
    assert done.record["error_after"] == pytest.approx(error, rel=1e-4)
    assert not done.record["odometry_kept"]


@pytest.mark.parametrize("name", ["robot_a", "robot_b", "ordered", "unordered"])
def test_graphs_of_two_robots_are_read_with_their_symbols(tmp_path: Path, name: str) -> None:
    source = public(f"Kimera-RPGO/{name}.g2o")
    done = optimize(source, tmp_path / "out.g2o")
    ids = [int(line.split()[1]) for line in source.read_text().splitlines() if line.startswith("VERTEX")]
    np.testing.assert_array_equal(done.file.ids, np.sort(ids))
    assert done.record["converged"]


def between_closures(graph: PoseGraph) -> tuple[PoseGraph, Int32s]:
    """The graph of the poses that have closures, and their rows: odometry from one to the next is what the poses
    between them add up to, so that it says the same."""
    loops, chain = np.flatnonzero(is_loop(graph)), OdometryChain.of(graph)
    rows = np.unique([0, *graph.a[loops], *graph.b[loops]]).astype(np.int32)
    information, axes = np.zeros((len(rows) - 1, 6, 6)), np.array(chain.axes)
    information[:, axes[:, None], axes] = np.linalg.inv(chain.covariance(rows[:-1], rows[1:]))
    along = np.arange(len(rows), dtype=np.int32)
    return PoseGraph(
        world_from_body=chain.poses[rows],
        a=np.concatenate([along[:-1], np.searchsorted(rows, graph.a[loops]).astype(np.int32)]),
        b=np.concatenate([along[1:], np.searchsorted(rows, graph.b[loops]).astype(np.int32)]),
        a_from_b=np.concatenate([se3.between(chain.poses[rows[:-1]], chain.poses[rows[1:]]), graph.a_from_b[loops]]),
        information=np.concatenate([information, graph.information[loops]]),
        kind=[EdgeKind.ODOMETRY] * len(information) + [EdgeKind.LOOP] * len(loops),
        dimension=graph.dimension,
    ), rows


def test_real_false_closures_do_not_bend_the_map(tmp_path: Path) -> None:
    """Bicocca 25b with the closures of a bag of words, held against its GPS."""
    source = public("rrr/B25b/B25b_0.300.g2o")
    graph, rows = between_closures(read_g2o(source).graph)
    known, places = bicocca_truth(source.parent)
    known, places = known[rows], places[rows]
    write_g2o(tmp_path / "in.g2o", graph, graph.world_from_body)
    record = optimize(tmp_path / "in.g2o", tmp_path / "out.g2o").record
    false = false_by_gps(graph, loops := np.flatnonzero(is_loop(graph)), known, places)
    assert false.sum() == 32
    rejected = set(map(tuple, record["rejected_edges"]))
    assert {(int(graph.a[edge]), int(graph.b[edge])) for edge in loops[false]} <= rejected
    assert 32 < len(rejected) < len(loops)
    solved = read_g2o(tmp_path / "out.g2o").graph.world_from_body
    odometry = aligned_error(graph.world_from_body[known], places[known])
    assert aligned_error(solved[known], places[known]) < 0.8 * odometry


def test_poses_without_an_edge_are_no_parts_to_solve(tmp_path: Path) -> None:
    count = 30_000
    lines = [f"VERTEX_SE2 {at} {at} 0 0" for at in range(count)]
    lines += [f"EDGE_SE2 {at} {at + 1} 1 0 0 1 0 0 1 0 1" for at in (0, 1, 5)]
    (tmp_path / "parts.g2o").write_text("\n".join(lines))
    found = optimize(tmp_path / "parts.g2o", tmp_path / "out.g2o", "lm")
    assert any("29995 poses without an edge" in text for text in found.record["warnings"])
    assert len(found.solution.world_from_body) == count


@pytest.mark.parametrize("value", ["1e300", "1e-300"])
def test_information_beyond_what_a_double_squares_is_refused(tmp_path: Path, value: str) -> None:
    graph = f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 {value} 0 0 1 0 1\n"
    (tmp_path / "graph.g2o").write_text(graph)
    with pytest.raises(GraphError, match=rf"holds {re.escape(str(float(value)))}; it must be .* of 1e-30 to 1e\+30"):
        optimize(tmp_path / "graph.g2o", tmp_path / "out.g2o")
