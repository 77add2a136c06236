"""Odometry of a run by its images: requested, unasked, found in the cache, and in pieces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from unittest.mock import MagicMock

import numpy as np
import pytest

from vplog import logs
from vplog.data import Odometry
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.graph.noise import NoiseSettings, broken_edges, edge_covariance
from vplog.odometry.self_calibration import Lens
from vplog.pipeline import load_pipeline, run
from vplog.run.keyframes import KeyframeSettings
from vplog.run.odometry import camera_of, check_metric, read, source_of
from vplog.testing import pictures
from vplog.verbs.demo import SMALL, make_drive
from vplog.verbs.evaluate_run import evaluate
from vplog.verbs.info import preflight, preflight_lines

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Camera
    from vplog.verbs.demo.record import Demo

QUICK = (
    "features.max_features=200", "features.max_megapixels=0.03", "features.min_features=0", "library.size=6",
    "places.kind=thumbnail", "propose.per_query=1", "verify.calibration.pairs=0", "pictures.closures=0",
    "pictures.megapixels=0",
)  # fmt: skip
VISUAL = logs.TopicChoice(odometry="visual")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    settings = SMALL.model_copy(update={"depth": True, "frame_rate_hz": 4.0, "laps": 1.2, "width": 320, "height": 180})
    return make_drive(tmp_path_factory.mktemp("visual"), settings)


@dataclass(frozen=True, eq=False)
class Calibrated(pictures.PictureLog):
    """A log without odometry, whose camera is calibrated and has depth."""

    depth: bool = True

    def camera(self) -> Camera:
        return replace(super().camera(), matrix=np.diag([100.0, 100.0, 1.0]))

    def has_depth(self) -> bool:
        return self.depth


@pytest.mark.parametrize("depth", [False, True])
def test_fixes_that_a_log_does_not_have_are_not_used_in_silence(depth: bool) -> None:
    """Before any image is looked at, also by the odometry of a single camera, which has no metres."""
    log = Calibrated([np.zeros((9, 9), np.uint8)] * 2, depth=depth)
    with pytest.raises(LogError, match="no GPS fixes to use"):
        read(log, VISUAL, KeyframeSettings(), use_gps=True, steps=None)  # type: ignore[arg-type]


def test_a_run_by_its_images(drive: Demo, tmp_path: Path) -> None:
    done = run(drive.log, tmp_path / "run", load_pipeline("default", QUICK), topics=VISUAL, execution=Execution(2))
    assert done.odometry.stamp_ns.tolist() == done.log.stamps().tolist()  # not those of /odom
    assert done.record["stages"]["odometry"]["result"] == "computed"
    assert done.record["noise"] == "increments"
    found = evaluate(tmp_path / "run", str(drive.truth))
    path_m = np.linalg.norm(np.diff(drive.world_from_body[:, :3, 3], axis=0), axis=1).sum()
    assert found["ate_before"]["rmse_m"] < 0.01 * path_m
    again = run(drive.log, tmp_path / "run", load_pipeline("default", QUICK), topics=VISUAL)
    assert again.record["stages"]["odometry"]["result"] == "reused"
    assert again.odometry.odom_from_body.tobytes() == done.odometry.odom_from_body.tobytes()


def test_info_names_it(drive: Demo) -> None:
    by_log, by_images = (preflight(drive.log, topics).record for topics in (None, VISUAL))
    assert by_log["visual_odometry"] == "possible"
    assert any("--odometry visual" in text for _, text in preflight_lines(by_log))
    assert (by_images["visual_odometry"], by_images["ready"]) == ("used", True)
    assert "--odometry-topic visual" in by_images["command"]


def test_it_is_taken_where_the_log_has_no_other() -> None:
    log = Calibrated([np.zeros((9, 9), np.uint8)])
    assert source_of(log, logs.TopicChoice()) == source_of(log, VISUAL) == "visual"
    with pytest.raises(LogError, match="no odometry"):
        source_of(log, logs.TopicChoice(odometry="gps"))
    single = Calibrated([np.zeros((9, 9), np.uint8)] * 2, depth=False)
    assert source_of(single, logs.TopicChoice()) == source_of(single, VISUAL) == "visual"
    with pytest.raises(LogError, match="no metres"):
        check_metric(single, logs.TopicChoice())
    check_metric(single, with_height := logs.TopicChoice(camera_height_m=1.3))
    with pytest.raises(LogError, match="no metres"):  # the images show no ground
        check_metric(single, with_height, Odometry(np.arange(2), np.tile(np.eye(4), (2, 1, 1)), None, metric=False))
    check_metric(log, logs.TopicChoice())


def test_pictures_without_a_calibration_look_ahead() -> None:
    """Visual odometry has z up then, by which the height of the camera is over the ground."""
    steps = MagicMock(return_value=Lens(9.0, 0.0))
    camera = camera_of(pictures.PictureLog([np.zeros((9, 9), np.uint8)] * 2), VISUAL, steps)
    np.testing.assert_array_equal(camera.body_from_camera[:3, :3] @ [0, -1, 0], [0, 0, 1])


def test_nothing_is_known_of_the_motion_across_a_break() -> None:
    stamp_ns, poses = np.arange(10, dtype=np.int64), np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.arange(10)
    odometry = Odometry(stamp_ns, poses, None, breaks=np.array([6]))
    keys = np.array([0, 3, 5, 8, 9])
    assert broken_edges(odometry, keys).tolist() == [2]
    covariance, _, _ = edge_covariance(odometry, keys, NoiseSettings())
    sigma_m = np.sqrt(covariance[:, 3, 3])
    assert sigma_m[2] == pytest.approx(9.0)  # the whole path
    assert sigma_m[[0, 1, 3]].max() < 1.0
