"""ATE and RPE against evo, on random and on real trajectories."""

from __future__ import annotations

import copy
import json
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.core.units import Unit
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.evaluate.data import data
from vplog.data import Trajectory
from vplog.errors import TruthError
from vplog.evaluate.trajectory import associate, at_truth, ate, drift, rpe
from vplog.evaluate.truth import read_truth
from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Floats

NOW_NS = 1_305_031_102_175_304_031


def walk(seed: int, count: int, period_ns: int = 100_000_000, start_ns: int = NOW_NS, noise: float = 0.0) -> Trajectory:
    """A smooth path in space with jittered stamps, each pose off by `noise` rad and m."""
    rng = np.random.default_rng(seed)
    steps = se3.exp(np.tile([0.01, 0.02, 0.05, 0.8, 0.1, 0.05], (count, 1)) * rng.normal(1.0, 0.3, (count, 6)))
    poses = np.empty((count, 4, 4))
    poses[0] = np.eye(4)
    for row in range(1, count):
        poses[row] = poses[row - 1] @ steps[row]
    jitter = rng.integers(-period_ns // 5, period_ns // 5, count)
    stamps = start_ns + period_ns * np.arange(count) + jitter
    return Trajectory(stamps, poses @ se3.exp(noise * rng.normal(size=(count, 6))))


def moved(trajectory: Trajectory, a_from_world: Floats) -> Trajectory:
    return Trajectory(trajectory.stamp_ns, a_from_world @ trajectory.world_from_body)


def in_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    stamps = np.array([stamp / 10**9 for stamp in trajectory.stamp_ns.tolist()])
    return PoseTrajectory3D(poses_se3=list(trajectory.world_from_body), timestamps=stamps)


def evo_ate(estimate: Trajectory, truth: Trajectory, alignment: str = "se3") -> dict[str, Any]:
    reference, aligned = sync.associate_trajectories(in_evo(truth), in_evo(estimate))
    aligned = copy.deepcopy(aligned)
    if alignment == "origin":
        aligned.align_origin(reference)
    else:
        aligned.align(reference, correct_scale=alignment == "sim3")
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((reference, aligned))
    return {**metric.get_all_statistics(), "count": reference.num_poses}


def evo_rpe(estimate: Trajectory, truth: Trajectory, relation: Any) -> dict[str, Any]:
    metric = metrics.RPE(relation, delta=1, delta_unit=Unit.frames)
    metric.process_data(sync.associate_trajectories(in_evo(truth), in_evo(estimate)))
    return {**metric.get_all_statistics(), "count": len(metric.error)}


def assert_agrees_with_evo(estimate: Trajectory, truth: Trajectory) -> None:
    ours, theirs = ate(estimate, truth), evo_ate(estimate, truth)
    assert ours.count == theirs["count"]
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, f"{name}_m") == pytest.approx(theirs[name], abs=1e-7), name
    steps = rpe(estimate, truth)
    for relation, part, unit in (
        (metrics.PoseRelation.translation_part, "translation", "m"),
        (metrics.PoseRelation.rotation_angle_deg, "rotation", "deg"),
    ):
        theirs = evo_rpe(estimate, truth, relation)
        assert steps.count == theirs["count"]
        for name in ("rmse", "mean", "max"):
            # evo's angle of nearly equal rotations comes from a trace and keeps half the digits
            assert getattr(steps, f"{part}_{name}_{unit}") == pytest.approx(theirs[name], abs=2e-6), (part, name)


@pytest.mark.parametrize(("estimated", "true"), [(80, 80), (80, 300), (300, 80)])
def test_random_walks_agree_with_evo(estimated: int, true: int) -> None:
    shortest = min(estimated, true)
    truth = walk(1, true, 100_000_000 * shortest // true)
    estimate = moved(walk(1, estimated, 100_000_000 * shortest // estimated, noise=0.1), se3.exp(np.full(6, 0.7)))
    assert_agrees_with_evo(estimate, truth)


@pytest.mark.parametrize(
    ("estimate", "truth"),
    [
        ("freiburg1_xyz-rgbdslam", "freiburg1_xyz-groundtruth"),
        ("freiburg1_xyz-rgbdslam_drift", "freiburg1_xyz-groundtruth"),
        ("fr2_desk_ORB", "fr2_desk_groundtruth"),
        ("fr2_desk_ORB_kf_mono", "fr2_desk_groundtruth"),
    ],
)
def test_real_trajectories_agree_with_evo(estimate: str, truth: str) -> None:
    folder = "trajectories/evo"
    assert_agrees_with_evo(read_truth(data(f"{folder}/{estimate}.txt")), read_truth(data(f"{folder}/{truth}.txt")))


@pytest.mark.parametrize(("method", "file"), [("orb", "KITTI_00_ORB"), ("sptam", "KITTI_00_SPTAM")])
def test_kitti_agrees_with_the_published_results(method: str, file: str) -> None:
    folder = "trajectories/evo"
    stamps = np.loadtxt(data(f"{folder}/KITTI_00_gt_times.txt"))
    trajectories = []
    for name in (file, "KITTI_00_gt"):
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3] = np.loadtxt(data(f"{folder}/{name}.txt")).reshape(-1, 3, 4)
        trajectories.append(Trajectory(np.round(stamps * 1e9).astype(np.int64), poses))
    with zipfile.ZipFile(data(f"{folder}/res_files/{method}_ape.zip")) as archive:
        published = json.loads(archive.read("stats.json"))
    ours = ate(trajectories[0], trajectories[1])
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, f"{name}_m") == pytest.approx(published[name], abs=1e-6)


@given(
    st.lists(st.integers(0, 400), min_size=1, max_size=20, unique=True),
    st.lists(st.integers(0, 400), min_size=1, max_size=20, unique=True),
)
def test_association_is_evos(estimate_ms: list[int], truth_ms: list[int]) -> None:
    """Ties at the very limit of 10 ms included: stamps are whole milliseconds, compared as floats."""
    trajectories = []
    for stamps_ms in (estimate_ms, truth_ms):
        stamp_ns = NOW_NS + 1_000_000 * np.sort(np.array(stamps_ms))
        trajectories.append(Trajectory(stamp_ns, np.tile(np.eye(4), (len(stamp_ns), 1, 1))))
    estimate, truth = trajectories
    seconds = [in_evo(trajectory).timestamps for trajectory in (estimate, truth)]
    if len(estimate_ms) > len(truth_ms):
        there, here = sync.matching_time_indices(seconds[1], seconds[0])
    else:
        here, there = sync.matching_time_indices(seconds[0], seconds[1])
    if not here:
        with pytest.raises(TruthError):
            associate(estimate, truth)
        return
    found = associate(estimate, truth)
    assert (found[0].tolist(), found[1].tolist()) == (here, there)


@given(st.integers(0, 2**32 - 1), st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_a_rigid_motion_of_the_estimate_changes_nothing(seed: int, xi: list[float]) -> None:
    truth, estimate = walk(seed, 12), walk(seed, 12, noise=0.05)
    assume(len(associate(estimate, truth)[0]) == 12)
    before, after = ate(estimate, truth), ate(moved(estimate, se3.exp(np.array(xi))), truth)
    assert after.rmse_m == pytest.approx(before.rmse_m, abs=1e-9)
    assert ate(moved(truth, se3.exp(np.array(xi))), truth).max_m == pytest.approx(0, abs=1e-9)


def test_a_straight_drive_is_scored() -> None:
    """The rotation about the line is free there, the distance is not."""
    truth = walk(0, 20)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = np.arange(20)
    longer = poses.copy()
    longer[:, 0, 3] *= 1.1
    found = ate(Trajectory(truth.stamp_ns, longer), Trajectory(truth.stamp_ns, poses))
    assert found.rmse_m == pytest.approx(0.1 * np.std(np.arange(20)))


def test_too_little_to_compare_is_one_line() -> None:
    truth = walk(0, 20)
    nothing = Trajectory(truth.stamp_ns[:0], truth.world_from_body[:0])
    two = Trajectory(truth.stamp_ns[:2], truth.world_from_body[:2])
    later = Trajectory(truth.stamp_ns + 10**12, truth.world_from_body)
    broken = Trajectory(truth.stamp_ns, np.where(np.arange(20)[:, None, None] == 7, np.nan, truth.world_from_body))
    for estimate, says in ((nothing, "no pose"), (two, "needs 3"), (later, "within 0.01 s"), (broken, "not finite")):
        with pytest.raises(TruthError, match=says) as caught:
            ate(estimate, truth)
        assert "\n" not in str(caught.value)


def test_a_single_pose_has_no_rpe() -> None:
    one = walk(0, 1)
    found = rpe(one, one)
    assert (found.delta, found.count, found.translation_rmse_m, found.rotation_max_deg) == ("1 frame", 0, None, None)


@pytest.mark.parametrize(("alignment", "name"), [("se3", "SE(3)"), ("sim3", "Sim(3)"), ("origin", "origin")])
def test_each_alignment_is_evos_and_named(alignment: str, name: str) -> None:
    truth = walk(2, 90)
    estimate = moved(walk(2, 90, noise=0.1), se3.exp(np.full(6, 0.7)))
    poses = estimate.world_from_body.copy()
    poses[:, :3, 3] *= 1.3
    longer = Trajectory(estimate.stamp_ns, poses)
    found = ate(longer, truth, alignment=alignment)
    theirs = evo_ate(longer, truth, alignment)
    assert found.alignment == name
    assert found.scale == pytest.approx(1 / 1.3, rel=0.02) if alignment == "sim3" else found.scale == 1.0
    for figure in ("rmse", "mean", "median", "max"):
        assert getattr(found, f"{figure}_m") == pytest.approx(theirs[figure], abs=1e-7), figure


def along_x(metres: float, count: int = 2001, longer: float = 1.0, turn_deg_per_100_m: float = 0.0) -> Trajectory:
    """Straight on, or bent, with a pose every `metres` / (`count` - 1)."""
    step_m = longer * metres / (count - 1)
    step = np.array([0, 0, np.radians(turn_deg_per_100_m) * metres / (count - 1) / 100.0, step_m, 0, 0])
    poses = se3.exp(np.arange(count, dtype=np.float64)[:, None] * step)
    return Trajectory(NOW_NS + 50_000_000 * np.arange(count), poses)


@pytest.mark.parametrize(
    ("metres", "lengths"),
    [(2000.0, [100, 200, 300, 400, 500, 600, 700, 800]), (350.0, [100, 200, 300]), (99.0, [10, 20, 30, 40, 50, 60, 70,
     80]), (7.5, [1, 2, 3, 4, 5, 6, 7]), (0.35, [0.1, 0.2, 0.3])],
)  # fmt: skip
def test_drift_is_a_share_of_the_path_at_every_length(metres: float, lengths: list[float]) -> None:
    truth = along_x(metres)
    found = drift(along_x(metres, longer=1.02), truth)
    assert found.lengths_m == pytest.approx(lengths)
    # a segment ends at the first pose behind its length, which is up to one step more
    assert found.translation_m == pytest.approx(2.0, rel=0.03)
    assert found.rotation_deg == pytest.approx(0.0, abs=1e-6)
    turned = drift(along_x(metres, turn_deg_per_100_m=3.0), truth)
    assert turned.rotation_deg == pytest.approx(3.0, rel=0.03)
    assert drift(truth, truth).translation_m == pytest.approx(0.0, abs=1e-9)


def devkit(truth: Floats, estimate: Floats) -> tuple[float, float, int]:
    """m and degrees per 100 m, and segments: calcSequenceErrors of KITTI's evaluate_odometry.cpp, line by line."""
    step = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    away = np.concatenate([[0.0], np.cumsum(step)])
    errors = []
    for first in range(0, len(truth), 10):
        for length in range(100, 900, 100):
            last = next((row for row in range(first, len(truth)) if away[row] > away[first] + length), None)
            if last is not None:
                true = np.linalg.inv(truth[first]) @ truth[last]
                error = np.linalg.inv(np.linalg.inv(estimate[first]) @ estimate[last]) @ true
                turned = np.degrees(np.arccos(np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0)))
                errors.append([np.linalg.norm(error[:3, 3]) / length, turned / length])
    metres, degrees = 100.0 * np.mean(errors, axis=0)
    return float(metres), float(degrees), len(errors)


@pytest.mark.parametrize("seed", range(3))
def test_drift_is_that_of_kittis_kit(seed: int) -> None:
    truth, other = walk(seed, 1200), walk(seed + 10, 1200, noise=0.01)
    between = se3.log(se3.between(other.world_from_body[:-1], other.world_from_body[1:]))
    poses = truth.world_from_body.copy()
    for row, step in enumerate(se3.exp(0.01 * between)):  # the truth's steps, each off by a hundredth of another's
        poses[row + 1] = poses[row] @ se3.between(*truth.world_from_body[row : row + 2]) @ step
    found = drift(Trajectory(truth.stamp_ns, poses), truth)
    metres, degrees, segments = devkit(truth.world_from_body, poses)
    assert found.segments == segments > 100
    assert found.lengths_m[-1] == 800.0
    assert found.translation_m == pytest.approx(metres, rel=1e-9)
    assert found.rotation_deg == pytest.approx(degrees, rel=1e-6)


def test_a_drive_that_stood_still_has_no_drift() -> None:
    still = Trajectory(NOW_NS + 10**8 * np.arange(5), np.tile(np.eye(4), (5, 1, 1)))
    assert (drift(still, still).translation_m, drift(still, still).segments) == (None, 0)


def test_a_truth_of_1_hz_between_the_stamps_is_compared_at_its_own() -> None:
    estimate = along_x(100.0)
    at_ns = estimate.stamp_ns[10:-10:20] + 23_000_000
    truth = Trajectory(at_ns, se3.interpolate_at(estimate.stamp_ns, estimate.world_from_body, at_ns))
    with pytest.raises(TruthError):
        ate(estimate, truth)
    compared, interpolated = at_truth(estimate, truth)
    assert interpolated
    assert ate(compared, truth).count == len(at_ns)
    assert ate(compared, truth).max_m < 1e-9
    assert at_truth(estimate, estimate) == (estimate, False)


def test_a_truth_of_20_hz_between_the_stamps_of_slower_odometry_is_compared_at_its_own() -> None:
    whole = along_x(100.0)
    estimate = Trajectory(whole.stamp_ns[::2], whole.world_from_body[::2])
    at_ns = whole.stamp_ns[10:-10] + 25_000_000
    truth = Trajectory(at_ns, se3.interpolate_at(whole.stamp_ns, whole.world_from_body, at_ns))
    compared, interpolated = at_truth(estimate, truth)
    assert interpolated
    assert ate(compared, truth).count == len(at_ns)


def test_what_lies_between_two_drives_of_a_map_is_not_compared() -> None:
    """A truth of 1 Hz goes on for half an hour between them, while the robot is driven elsewhere."""
    rows = np.r_[0:400, 1600:2001]
    whole = along_x(100.0)
    estimate = Trajectory(whole.stamp_ns[rows], whole.world_from_body[rows])
    at_ns = whole.stamp_ns[10:-10:20] + 23_000_000
    poses = se3.interpolate_at(whole.stamp_ns, whole.world_from_body, at_ns)
    gap = (at_ns > estimate.stamp_ns[399]) & (at_ns < estimate.stamp_ns[400])
    poses[gap, 1, 3] += 1000.0
    truth = Trajectory(at_ns, poses)
    compared, interpolated = at_truth(estimate, truth)
    assert interpolated
    found = ate(compared, truth)
    assert found.count == (~gap).sum()
    assert found.max_m < 1e-9


def test_an_estimate_of_a_third_of_a_hz_is_interpolated() -> None:
    """As of odometry that comes at each keyframe; 30 s without it are a gap all the same."""
    whole = along_x(100.0)
    rows = np.r_[0:900:60, 1500:2001:60]
    estimate = Trajectory(whole.stamp_ns[rows], whole.world_from_body[rows])
    at_ns = whole.stamp_ns[20:1900:100] + 23_000_000
    truth = Trajectory(at_ns, se3.interpolate_at(whole.stamp_ns, whole.world_from_body, at_ns))
    compared, interpolated = at_truth(estimate, truth)
    assert interpolated
    assert len(compared.stamp_ns) == ((at_ns < estimate.stamp_ns[14]) | (at_ns > estimate.stamp_ns[15])).sum()


def test_a_truth_of_1_hz_may_be_longer_than_the_drive() -> None:
    whole = along_x(100.0)
    at_ns = whole.stamp_ns[::20] + 23_000_000
    truth = Trajectory(at_ns[:-1], se3.interpolate_at(whole.stamp_ns, whole.world_from_body, at_ns[:-1]))
    short = Trajectory(whole.stamp_ns[:60], whole.world_from_body[:60])
    compared, interpolated = at_truth(short, truth)
    assert interpolated
    assert ate(compared, truth).count == 3
