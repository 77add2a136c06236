"""The default pipeline on real drives or much of them, from log to verdict, without one setting changed."""

from __future__ import annotations

import os
from itertools import count
from typing import TYPE_CHECKING, Any

import pytest

from tests.joined import copied
from vplog.data import Verdict
from vplog.execution.execution import Execution
from vplog.pipeline import Run, load_pipeline, run
from vplog.verbs.evaluate_run import evaluate

if TYPE_CHECKING:
    from pathlib import Path

GARDENS = ("gardens_day_left", "gardens_night_right")
STREET = "/cam0/image_raw/compressed"
PASSED_TWICE = ((95, 225), (560, 600), (1380, 1425), (1545, 1655))
"""Frames with places that are passed again, in the same direction and in the other one."""


def found(log: Path) -> Path:
    if not log.exists():
        pytest.skip(f"no {log}: set VPLOG_DATA to the folder with the real drives")
    return log


def run_default(log: Path, out: Path) -> Run:
    return run(log, out, load_pipeline("default"), execution=Execution(os.cpu_count() or 1))


@pytest.fixture(scope="module")
def kitti(compiled: None, shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """With the images of what is passed twice, and every twelfth of the rest; all else of the log is there."""
    drives, folder, images = shared_data / "drives", tmp_path_factory.mktemp("kitti00"), count()

    def wanted(topic: str, _: int) -> bool:
        frame = 2 * next(images) if topic == STREET else 0
        return frame % 24 == 0 or any(first <= frame <= last for first, last in PASSED_TWICE)

    log = copied(found(drives / "kitti00" / "kitti00.mcap"), folder / "kitti00.mcap", wanted)
    run_default(log, folder / "run")
    return evaluate(folder / "run", str(drives / "kitti00.groundtruth.tum"))


@pytest.fixture(scope="module")
def seven_scenes(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    drives, out = shared_data / "drives", tmp_path_factory.mktemp("seven_scenes") / "run"
    run_default(found(drives / "seven_scenes.bag"), out)
    return evaluate(out, str(drives / "seven_scenes.groundtruth.tum"))


@pytest.fixture(scope="module", params=GARDENS)
def uncalibrated(request: pytest.FixtureRequest, shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The first sixteen images of a drive."""
    drive, folder = found(shared_data / "drives" / f"{request.param}.mcap"), tmp_path_factory.mktemp(request.param)
    messages = count()
    return run_default(copied(drive, folder / "drive.mcap", lambda *_: next(messages) < 32), folder / "run")


def test_a_street_passed_again_is_found_and_drift_removed(kitti: dict[str, Any]) -> None:
    assert kitti["ate_before"]["rmse_m"] == pytest.approx(30.8, abs=0.5)
    assert kitti["ate_after"]["rmse_m"] < 2.5


def test_street_closures_are_right(kitti: dict[str, Any]) -> None:
    closures = kitti["closures"]
    assert closures["precision"] == 1.0
    assert closures["recall"] >= 0.9
    assert closures["opposite"] == 0


def test_a_hand_held_camera_that_comes_back(seven_scenes: dict[str, Any]) -> None:
    """The data's own calibration leaves 2 to 3 cm in a relative pose."""
    assert seven_scenes["ate_before"]["rmse_m"] == pytest.approx(0.0948, abs=0.002)
    assert seven_scenes["ate_after"]["rmse_m"] <= 0.026


def test_without_calibration_there_is_no_metric_closure(uncalibrated: Run) -> None:
    assert Verdict.ACCEPTED not in uncalibrated.closures.verdict
    assert any("calibrat" in warning for warning in uncalibrated.record["warnings"])
    assert uncalibrated.record["finished"] is True
