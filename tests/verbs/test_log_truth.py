"""`--truth auto`: the ground truth that comes with a log, else its fixes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.logs.drives import Drive, ros_messages, write_ros2
from tests.logs.test_datasets import kitti, poses
from vplog.data import Gps, Trajectory
from vplog.errors import LogError, TruthError
from vplog.logs import TopicChoice
from vplog.verbs.evaluate_run import TruthOptions, log_truth, recorded_topics

if TYPE_CHECKING:
    from pathlib import Path


def test_the_truth_of_a_data_set_is_shifted_as_a_file_is(tmp_path: Path) -> None:
    stamps = kitti(tmp_path)
    found = log_truth(tmp_path, {"log": str(tmp_path)}, None, TruthOptions(truth_offset_s=1.5))
    assert isinstance(found, Trajectory)
    np.testing.assert_array_equal(found.stamp_ns, stamps + 1_500_000_000)
    np.testing.assert_allclose(found.world_from_body, poses(), atol=1e-6)


def test_of_a_bag_it_is_the_topic_of_that_name_or_the_fixes(tmp_path: Path) -> None:
    messages = ros_messages(Drive(), 2)
    fixes = log_truth(tmp_path, {"log": str(write_ros2(tmp_path / "fixes", messages))}, None, TruthOptions())
    assert isinstance(fixes, Gps)
    for one in messages:
        one.topic = "/ground_truth/odom" if one.topic == "/odom" else one.topic
    found = log_truth(tmp_path, {"log": str(write_ros2(tmp_path / "truth", messages))}, None, TruthOptions())
    assert isinstance(found, Trajectory)
    np.testing.assert_allclose(found.world_from_body[:, :3, 3], Drive().position, atol=1e-9)


def test_a_log_without_either_is_one_line(tmp_path: Path) -> None:
    messages = [one for one in ros_messages(Drive(), 2) if one.type != "sensor_msgs/msg/NavSatFix"]
    path = write_ros2(tmp_path / "drive", messages)
    with pytest.raises(TruthError, match="comes with no ground truth"):
        log_truth(tmp_path, {"log": str(path)}, None, TruthOptions())
    with pytest.raises(LogError, match="no longer exists"):
        log_truth(tmp_path, {"log": str(tmp_path / "gone")}, None, TruthOptions())


def test_the_truth_of_a_log_is_read_with_the_topics_of_the_run() -> None:
    record = {"topics": {"gps": "/rtk/fix", "image": "/front", "calibration_file": "/gone.yaml"}}
    assert (recorded_topics(record, None).gps, recorded_topics(record, None).calibration_file) == ("/rtk/fix", None)
    other = recorded_topics(record, TopicChoice(gps="/other"))
    assert (other.gps, other.image) == ("/other", "/front")
