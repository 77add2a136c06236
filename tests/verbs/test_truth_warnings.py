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


def _wxyz(truth: Trajectory) -> Trajectory:
    vectors = se3.vectors(truth.world_from_body)
    swapped = vectors[:, [6, 3, 4, 5]] / np.linalg.norm(vectors[:, 3:], axis=1, keepdims=True)
    x, y, z, w = swapped.T
    R = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
         2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
         2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    return Trajectory(truth.stamp_ns, se3.pose(R, vectors[:, :3]))


def _part(truth: Trajectory) -> Trajectory:
    rows = slice(0, len(truth.stamp_ns) // 2)
    return Trajectory(truth.stamp_ns[rows], truth.world_from_body[rows])


def _other(truth: Trajectory) -> Trajectory:
    """That of a drive on another way: the same, backwards."""
    return Trajectory(truth.stamp_ns, truth.world_from_body[::-1])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_wxyz, "does not move as the odometry does"),
        (_other, "does not move as the odometry does"),
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
