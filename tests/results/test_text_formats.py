"""TUM and g2o, read back by other people's readers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.results.example import COUNT, make_run, random_poses
from vplog.data import Trajectory
from vplog.evaluate.truth import read_truth
from vplog.geometry.tum import seconds, write_tum
from vplog.results.g2o import write_g2o

if TYPE_CHECKING:
    from pathlib import Path

RUN = make_run()


def test_tum_comes_back_with_exact_stamps(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    stamp_ns = np.unique(rng.integers(0, 2_000_000_000_000_000_000, 50))
    trajectory = Trajectory(stamp_ns, random_poses(rng, len(stamp_ns)))
    write_tum(tmp_path / "t.tum", trajectory)
    read = read_truth(tmp_path / "t.tum")
    np.testing.assert_array_equal(read.stamp_ns, stamp_ns)
    np.testing.assert_allclose(read.world_from_body, trajectory.world_from_body, rtol=0, atol=1e-8)


def test_evo_reads_the_tum_file(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    write_tum(tmp_path / "t.tum", RUN.trajectory)
    read = file_interface.read_tum_trajectory_file(tmp_path / "t.tum")
    np.testing.assert_allclose(read.poses_se3, RUN.trajectory.world_from_body, rtol=0, atol=1e-8)
    np.testing.assert_allclose(read.timestamps, RUN.trajectory.stamp_ns / 1e9, rtol=0, atol=1e-6)


@given(st.integers(-(2**63), 2**63 - 1))
def test_stamp_text_is_exact(stamp_ns: int) -> None:
    whole, _, rest = seconds(stamp_ns).partition(".")
    assert len(rest) == 9
    assert int(whole + rest) == stamp_ns


def test_gtsam_reads_the_same_graph(tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    write_g2o(tmp_path / "g.g2o", RUN.graph, RUN.solution.world_from_body)
    graph, values = gtsam.readG2o(str(tmp_path / "g.g2o"), True)
    assert (graph.size(), values.size()) == (len(RUN.graph.a), COUNT)
    for node in range(COUNT):
        np.testing.assert_allclose(values.atPose3(node).matrix(), RUN.solution.world_from_body[node], atol=1e-12)
    for edge in range(graph.size()):
        factor = graph.at(edge)
        assert factor.keys() == [RUN.graph.a[edge], RUN.graph.b[edge]]
        np.testing.assert_allclose(factor.measured().matrix(), RUN.graph.a_from_b[edge], atol=1e-12)
        root = factor.noiseModel().R()
        np.testing.assert_allclose(root.T @ root, RUN.graph.information[edge], rtol=1e-9, atol=1e-9)


def test_same_run_same_text(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_g2o(tmp_path / name, RUN.graph, RUN.solution.world_from_body)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
