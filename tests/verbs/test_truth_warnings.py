"""Warnings about the truth stand wherever its figures do: on the terminal, in JSON, in a report and in a comparison of
runs."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest

from vplog.data import Trajectory
from vplog.evaluate.truth import read_truth
from vplog.geometry import se3
from vplog.geometry.tum import write_tum
from vplog.results.run_record import read_run_json, write_run_json
from vplog.verbs.diff import diff
from vplog.verbs.evaluate_run import evaluate
from vplog.verbs.report import report

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo


def _inverted(truth: Trajectory) -> Trajectory:
    return Trajectory(truth.stamp_ns, se3.inverse(truth.world_from_body))


def _wxyz(truth: Trajectory) -> Trajectory:
    quaternions = np.roll(se3.quaternion(truth.world_from_body[:, :3, :3]), 1, axis=1)
    return Trajectory(truth.stamp_ns, se3.pose(se3.rotation(quaternions), truth.world_from_body[:, :3, 3]))


def _two(truth: Trajectory) -> Trajectory:
    """That of two drives, the later poses of each between those of the other."""
    stamps = np.concatenate([truth.stamp_ns, truth.stamp_ns + 7_000_000])
    poses = np.concatenate([truth.world_from_body, truth.world_from_body[::-1]])
    order = np.argsort(stamps)
    return Trajectory(stamps[order], poses[order])


def _stretched(times: float) -> Callable[[Trajectory], Trajectory]:
    return lambda truth: Trajectory(truth.stamp_ns, se3.stretched(truth.world_from_body, times))


def _part(truth: Trajectory) -> Trajectory:
    rows = slice(0, len(truth.stamp_ns) // 2)
    return Trajectory(truth.stamp_ns[rows], truth.world_from_body[rows])


def _other(truth: Trajectory) -> Trajectory:
    """That of a drive on another way: the same, backwards."""
    return Trajectory(truth.stamp_ns, truth.world_from_body[::-1])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_stretched(1.3), "The path of the truth is"),
        (_other, "does not move as the odometry does"),
        (_two, "the file holds two trajectories"),
        (_part, "The truth covers"),
    ],
    ids=lambda one: getattr(one, "__name__", ""),
)
def test_a_truth_of_another_motion_or_of_a_part_is_spoken_of(
    change: Callable[[Trajectory], Trajectory], text: str, finished: Path, drive: Demo, tmp_path: Path
) -> None:
    write_tum(tmp_path / "other.tum", change(read_truth(str(drive.truth))))
    found = evaluate(finished, str(tmp_path / "other.tum"))
    assert any(text in one for one in found["warnings"]), found
    report(finished, tmp_path / "page.html", str(tmp_path / "other.tum"))
    assert text in (tmp_path / "page.html").read_text()
    assert diff(finished, finished, str(tmp_path / "other.tum"))["warnings"] == found["warnings"]


@pytest.mark.parametrize(
    ("change", "text"),
    [(_wxyz, "in the order w x y z"), (_inverted, "body_from_world"), (_stretched(1000.0), "in mm")],
)
def test_a_truth_in_another_convention_or_unit_is_converted(
    change: Callable[[Trajectory], Trajectory], text: str, finished: Path, drive: Demo, tmp_path: Path
) -> None:
    truth = read_truth(str(drive.truth))
    write_tum(tmp_path / "other.tum", change(truth))
    write_tum(tmp_path / "same.tum", truth)
    found, same = (evaluate(finished, str(tmp_path / name)) for name in ("other.tum", "same.tum"))
    assert len(found["warnings"]) == 1
    assert text in found["warnings"][0]
    assert found["closures"] | {"criterion": None} == same["closures"] | {"criterion": None}
    assert found["ate_after"]["rmse_m"] == pytest.approx(same["ate_after"]["rmse_m"], rel=1e-3)


def test_the_right_truth_needs_no_word(finished: Path, drive: Demo) -> None:
    found = evaluate(finished, str(drive.truth))
    assert found["warnings"] == []
    assert found["truth_is"]["disagreement"] < 0.1


def test_pieces_that_nothing_relates_are_spoken_of(
    finished: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    record = read_run_json(out / "run.json")
    assert record["solution"]["pieces"] == 1
    record["solution"]["pieces"], record["scale"] = 3, "unknown"
    write_run_json(out / "run.json", record)
    assert any("3 pieces" in one for one in evaluate(out, str(drive.truth))["warnings"])
    found = verb("export", out, "--format", "tum", "-o", tmp_path / "a.tum")
    assert "3 pieces" in found.err
    assert "no metres" in found.err
    found = verb("export", out, "--format", "tum", "-o", tmp_path / "a.tum", "--json")
    assert len(json.loads(found.out)["warnings"]) == 2


def test_runs_of_two_logs_are_said_to_be(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    record = read_run_json(out / "run.json")
    record["inputs"] = {"other.mcap": "0" * 64}
    write_run_json(out / "run.json", record)
    assert diff(finished, out)["warnings"] == ["The runs are of different logs: stamps alone pair their poses."]
    assert diff(finished, finished)["warnings"] == []
