"""Which source of a log is its odometry, and what is said of the choice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.logs.drives import START_NS, Written, matrices, write_ros2
from tests.logs.test_motion import image, pose_message, tf
from vplog import logs
from vplog.data import Odometry
from vplog.logs import TopicChoice
from vplog.logs.formats.container import Channel
from vplog.logs.odometry_sources import score_source
from vplog.logs.stamps import NONE
from vplog.logs.tracks import PoseTrack
from vplog.verbs.info import preflight

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.stages import Log

COUNT, PERIOD_NS = 100, 100_000_000
STAMPS = START_NS + PERIOD_NS * np.arange(COUNT)
ODOMETRY, POSE, AMCL = (
    f"{kind[0]}/msg/{kind[1]}"
    for kind in (
        ("nav_msgs", "Odometry"),
        ("geometry_msgs", "PoseStamped"),
        ("geometry_msgs", "PoseWithCovarianceStamped"),
    )
)


def motion(seed: int, count: int = COUNT) -> np.ndarray:
    """A robot that drives on and turns at random."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0, 0.05, count))
    speed = 0.05 + 0.03 * rng.random(count)
    steps = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(count)], 1)
    return matrices(np.cumsum(steps, axis=0), Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])))


def poses(topic: str, kind: str, values: np.ndarray, stamps: np.ndarray = STAMPS) -> list[Written]:
    pairs = zip(stamps.tolist(), values, strict=True)
    return [Written(topic, kind, stamp, pose_message(kind, stamp, value)) for stamp, value in pairs]


def transforms(*edges: tuple[str, str, np.ndarray], topic: str = "/tf") -> list[Written]:
    each = enumerate(STAMPS.tolist())
    return [tf(2, topic, stamp, *((a, b, values[i]) for a, b, values in edges)) for i, stamp in each]


def drive(folder: Path, *found: list[Written]) -> Path:
    """Images and these messages in order of time."""
    messages = [image(2, stamp) for stamp in STAMPS.tolist()] + [message for part in found for message in part]
    return write_ros2(folder / "drive", sorted(messages, key=lambda message: message.stamp_ns))


def source(log: Log) -> str | None:
    return next((topic.name for topic in log.info().topics if topic.part == "odometry"), None)


WALK, OTHER = motion(1), motion(2)
FOUR = np.sort(np.random.default_rng(5).choice(COUNT, 4, replace=False))


@pytest.mark.parametrize("name", ["/goal_pose", "/amcl_pose", "/a_pose"])
@pytest.mark.parametrize("kind", [POSE, AMCL])
def test_a_few_poses_do_not_win_over_transforms(name: str, kind: str, tmp_path: Path) -> None:
    few = poses(name, kind, OTHER[FOUR], STAMPS[FOUR])
    log = logs.open(drive(tmp_path, few, transforms(("odom", "base_link", WALK))))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, WALK, atol=1e-9)
    assert source(log) == "/tf"


@pytest.mark.parametrize("seed", range(6))
def test_the_moving_pose_wins_over_setpoints(seed: int, tmp_path: Path) -> None:
    """One that never changes, and one that changes a few times, under any name and as any type."""
    rng = np.random.default_rng(seed)
    names = rng.permutation(["/a", "/b", "/c"]).tolist()
    kinds = [str(kind) for kind in rng.choice([POSE, AMCL], 2)]
    still = np.repeat(OTHER[:1], COUNT, axis=0)
    steps = OTHER[np.sort(rng.choice(COUNT, 3, replace=False))][np.arange(COUNT) * 3 // COUNT]
    log = logs.open(
        drive(tmp_path, poses(names[0], POSE, WALK), poses(names[1], kinds[0], still), poses(names[2], kinds[1], steps))
    )
    assert source(log) == names[0]
    assert next(one.topic for one in log.info().odometry_sources) == names[0]


@pytest.mark.parametrize("name", ["/groundtruth", "/ground_truth/pose", "/vicon/robot", "/robot/gt"])
def test_ground_truth_is_taken_only_where_nothing_else_is_and_that_is_said(name: str, tmp_path: Path) -> None:
    truth = poses(name, ODOMETRY, WALK)
    log = logs.open(drive(tmp_path / "both", truth, poses("/orb_slam/pose", POSE, OTHER[::2], STAMPS[::2])))
    assert source(log) == "/orb_slam/pose"
    assert "ground truth" not in " ".join(log.warnings)
    alone = logs.open(drive(tmp_path / "alone", truth))
    assert source(alone) == name
    assert f"{name} is ground truth by its name" in " ".join(alone.warnings)


def test_what_commands_a_robot_is_taken_only_where_it_is_asked_for(tmp_path: Path) -> None:
    path = drive(tmp_path, poses("/move_base/goal", POSE, WALK))
    log = logs.open(path)
    assert log.odometry() is None
    assert "--odometry-topic /move_base/goal takes it" in " ".join(log.warnings)
    assert logs.open(path, TopicChoice(odometry="/move_base/goal")).odometry() is not None


def test_a_name_does_not_decide_against_what_was_measured(tmp_path: Path) -> None:
    """Odometry that moves a body may be called as a command is; a worse source never wins over a command silently."""
    few, still = poses("/amcl_pose", AMCL, OTHER[FOUR], STAMPS[FOUR]), np.repeat(OTHER[:1], COUNT, axis=0)
    named = poses("/reference_pose", ODOMETRY, WALK)
    for name, others in {"alone": [], "few": [few], "still": [poses("/pose", POSE, still)]}.items():
        log = logs.open(drive(tmp_path / name, named, *others))
        assert source(log) == "/reference_pose"
        assert "/reference_pose is a command by its name" in " ".join(log.warnings)
    assert source(logs.open(drive(tmp_path / "both", named, poses("/pose", POSE, OTHER)))) == "/pose"
    log = logs.open(drive(tmp_path / "word", poses("/preferences/planet/odom", ODOMETRY, WALK)))
    assert source(log) == "/preferences/planet/odom" and "by its name" not in " ".join(log.warnings)
    log = logs.open(drive(tmp_path / "goal", poses("/goal", POSE, WALK), few))
    assert source(log) == "/amcl_pose"
    assert "--odometry-topic /goal takes it" in " ".join(log.warnings)


@pytest.mark.parametrize("asked", [None, "/odom"])
def test_odometry_of_a_part_of_the_time_is_never_taken_silently(asked: str | None, tmp_path: Path) -> None:
    half = slice(0, COUNT // 2)
    log = logs.open(drive(tmp_path, poses("/odom", ODOMETRY, WALK[half], STAMPS[half])), TopicChoice(odometry=asked))
    assert log.odometry() is not None
    assert "/odom covers 50% of the camera's time" in " ".join(log.warnings)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.85])
def test_what_covers_the_drive_wins_over_what_covers_a_part(share: float, tmp_path: Path) -> None:
    part = slice(0, int(share * COUNT))
    log = logs.open(drive(tmp_path, poses("/odom", ODOMETRY, WALK[part], STAMPS[part]), poses("/pose", POSE, OTHER)))
    assert source(log) == "/pose"
    assert "covers" not in " ".join(log.warnings)


def test_four_poses_alone_are_not_taken_silently(tmp_path: Path) -> None:
    log = logs.open(drive(tmp_path, poses("/amcl_pose", AMCL, OTHER[::33], STAMPS[::33])))
    assert source(log) == "/amcl_pose"
    assert "/amcl_pose has 0.3 poses a second that differ" in " ".join(log.warnings)


def test_a_topic_of_several_bodies_is_followed_for_one(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/TransformStamped"
    robot, other = poses("/vision", kind, WALK), poses("/vision", kind, OTHER)
    for message in other:
        message.message.child_frame_id = "ball"
        message.stamp_ns += 1
    log = logs.open(drive(tmp_path, robot, other))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, WALK, atol=1e-9)
    assert "100 poses of other frames than base_link" in " ".join(log.warnings)


@pytest.mark.parametrize("kind", [ODOMETRY, POSE])
@pytest.mark.parametrize("first", [True, False])
def test_a_topic_of_two_fixed_frames_is_followed_in_that_of_most(first: bool, kind: str, tmp_path: Path) -> None:
    """Two filters of robot_localization on one topic, or one that names another frame until it knows its place."""
    robot, other = poses("/filtered", kind, WALK), poses("/filtered", kind, OTHER[1:], STAMPS[1:])
    for message in other:
        message.message.header.frame_id = "map"
        message.stamp_ns += -1 if first else 1
    log = logs.open(drive(tmp_path, robot, other))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, WALK, atol=1e-9)
    frames = "base_link in odom" if kind == ODOMETRY else "odom"
    assert f"/filtered: 99 poses of other frames than {frames} left out." in log.warnings


def test_frames_tell_between_equal_types(tmp_path: Path) -> None:
    def frames(parent: str, child: str) -> Any:
        found = poses(f"/{parent}_{child}", ODOMETRY, WALK)
        for message in found:
            message.message.header.frame_id, message.message.child_frame_id = parent, child
        return found

    every = [frames("map", "base_link"), frames("base_link", "gripper"), frames("odom", "base_link")]
    log = logs.open(drive(tmp_path, *every))
    assert [one.topic for one in log.info().odometry_sources] == [
        "/odom_base_link", "/map_base_link", "/base_link_gripper"
    ]  # fmt: skip


def test_what_hardly_is_odometry_is_never_taken_silently(tmp_path: Path) -> None:
    """A pose that never changes, and one of a part in the body."""
    still = poses("/odom", ODOMETRY, np.repeat(OTHER[:1], COUNT, axis=0))
    assert "/odom never moves" in " ".join(logs.open(drive(tmp_path / "still", still)).info().warnings)
    part = poses("/tool", POSE, WALK)
    for message in part:
        message.message.header.frame_id = "base_link"
    said = " ".join(logs.open(drive(tmp_path / "part", part)).info().warnings)
    assert "/tool is placed in base_link, which moves" in said


def test_transforms_in_a_circle_are_followed_once(tmp_path: Path) -> None:
    back = np.linalg.inv(WALK)
    fixed = transforms(("odom", "base_link", WALK), ("base_link", "odom", back), ("map", "odom", OTHER))
    odometry = logs.open(drive(tmp_path / "rooted", fixed)).odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, WALK, atol=1e-9)
    loop = transforms(("a", "base_link", WALK), ("b", "a", OTHER), ("base_link", "b", back))
    log = logs.open(drive(tmp_path / "loop", loop))
    assert log.odometry() is None
    assert "form a loop" in " ".join(log.warnings)


def test_joints_and_static_transforms_are_no_odometry(tmp_path: Path) -> None:
    turns = [
        matrices(
            np.tile([0.0, 0.1 * i, 0.3], (COUNT, 1)), Rotation.from_rotvec(np.outer(motion(i)[:, 0, 3], [0, 0, 1]))
        )
        for i in range(3)
    ]
    arm = (("base_link", "link_1", turns[0]), ("link_1", "link_2", turns[1]), ("link_2", "tool", turns[2]))
    still = np.repeat(OTHER[:1], COUNT, axis=0)
    for name, edges in {
        "arm": arm,
        "arm_of_no_body": [(a.replace("base_link", "mount"), b, values) for a, b, values in arm],
        "static": (("odom", "base_link", still), ("base_link", "camera", still)),
        "slide": (("base_link", "sledge", WALK),),
    }.items():
        assert logs.open(drive(tmp_path / name, transforms(*edges))).odometry() is None, name
    log = logs.open(drive(tmp_path / "both", transforms(*arm), poses("/pose", POSE, WALK)))
    assert source(log) == "/pose"
    log = logs.open(drive(tmp_path / "on", transforms(*arm, ("r1/odom", "base_link", WALK))))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, WALK, atol=1e-9)


def test_info_says_why_and_what_comes_next(tmp_path: Path) -> None:
    path = drive(tmp_path, poses("/pose", POSE, OTHER), transforms(("odom", "base_link", WALK)))
    record = preflight(path).record
    best, other = record["odometry_sources"]
    assert (best["topic"], other["topic"]) == ("/tf", "/pose")
    assert best["score"] > other["score"] == pytest.approx(np.prod(list(other["evidence"].values())), abs=1e-6)
    assert record["odometry"]["choice"] == (
        f"/tf is the best source: score {best['score']:.2g}, a TFMessage; next is /pose: "
        f"score {other['score']:.2g}, a PoseStamped"
    )
    why = {topic["name"]: topic["why"] for topic in record["topics"]}
    assert why["/pose"].startswith("/tf is taken, score") and why["/pose"].endswith("--odometry-topic /pose takes it")


def test_what_was_lost_of_a_source_that_is_not_taken_is_no_loss(tmp_path: Path) -> None:
    bad = poses("/pose", POSE, OTHER)
    for message in bad[::2]:
        message.message.pose.position.x = float("nan")
        message.message.header.stamp.sec = 0
    log = logs.open(drive(tmp_path, bad, poses("/odom", ODOMETRY, WALK)))
    assert source(log) == "/odom"
    assert not [line for line in log.warnings if "/pose" in line]
    assert not [line for line in log.warnings if "Lost" in line]


def test_each_source_is_converted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    converted, finish = [], PoseTrack.finish
    monkeypatch.setattr(
        PoseTrack, "finish", lambda track, notes: (converted.append(track.topic), finish(track, notes))[1]
    )
    log = logs.open(drive(tmp_path, poses("/a", POSE, WALK), poses("/b", ODOMETRY, OTHER)))
    assert log.odometry() is not None
    assert sorted(converted) == ["/a", "/b"]
    assert "carries no covariance" not in " ".join(log.warnings), "what is said of a source that is not taken"


@pytest.mark.parametrize("request_it", [False, True])
def test_two_publishers_of_one_topic_are_not_taken_silently(request_it: bool, tmp_path: Path) -> None:
    """A filter and the controller of the wheels, of which each has drifted its own way; the other source is sound."""
    away = matrices(np.tile([3.0, -4.0, 0.0], (COUNT, 1)), Rotation.identity(COUNT)) @ WALK
    both = [*poses("/odom", ODOMETRY, WALK), *poses("/odom", ODOMETRY, away, STAMPS + PERIOD_NS // 3)]
    path = drive(tmp_path / "both", both, poses("/pose", POSE, WALK))
    log = logs.open(path, TopicChoice(odometry="/odom") if request_it else TopicChoice())
    assert source(log) == ("/odom" if request_it else "/pose")
    assert ("/odom goes back and forth; do two nodes publish it?" in " ".join(log.warnings)) == request_it
    assert "goes back and forth" in " ".join(logs.open(drive(tmp_path / "alone", both)).info().warnings)


@pytest.mark.parametrize("circles", [False, True])
@pytest.mark.parametrize(
    ("speed_m_s", "noise_m", "hz"), [(0.0, 0.02, 20), (1.0, 0.02, 50), (30.0, 0.3, 20), (0.0, 0.2, 10), (0.0, 0.1, 50)]
)
def test_noise_is_no_second_publisher(speed_m_s: float, noise_m: float, hz: int, circles: bool) -> None:
    """Nor are circles that take a second each."""
    at_s = np.arange(0, 120, 1 / hz)
    place = np.outer(at_s * speed_m_s, [1, 0, 0]) + np.random.default_rng(8).normal(0, noise_m, (len(at_s), 3))
    if circles:
        place[:, :2] += np.stack([np.cos(2 * np.pi * at_s), np.sin(2 * np.pi * at_s)], axis=1)
    one = Odometry((at_s * 1e9).astype(np.int64), matrices(place, Rotation.identity(len(at_s))), None)
    found = score_source(Channel("/odom", "nav_msgs/Odometry", "cdr"), ["odom", "base_link"], one, one.stamp_ns, NONE)
    assert not [what for what in found.evidence if "back and forth" in what]
