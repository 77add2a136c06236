from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tests.loops.scene import NOISE_PX, camera, empty, keyframes, pose, proposals, scene, verify, view
from vplog.data import Camera, Closures, Features, Keyframes, Trajectory, Verdict
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.loops.landmarks import LandmarkSettings
from vplog.loops.verify import VerifySettings, calibration_share, drive_of
from vplog.loops.verify_epipolar import EpipolarSettings, epipolar_inliers
from vplog.loops.verify_metric import MetricSettings

EXACT = VerifySettings(landmarks=LandmarkSettings(pixel_sigma=NOISE_PX, depth_share=0.0))
COLUMNS = ("query", "match", "rank", "score", "support", "matches", "landmarks", "inliers", "spread", "reverse_inliers")
LAP = 16
"""Keyframes of the first pass; the second comes back over the same road, off to the side."""


@lru_cache(maxsize=8)
def drive(depth: bool, model: str = "none") -> tuple[Camera, Keyframes, np.ndarray, list[Features]]:
    rng = np.random.default_rng(11)
    lens = camera(model, {"none": (), "equidistant": (0.01,) * 4, "plumb_bob": (-0.2, 0.05, 1e-3, 0.0)}[model])
    place = scene(rng)
    there = [pose(1.2 * i, 0.2 * np.sin(i), yaw=0.05 * np.sin(i / 3)) for i in range(LAP)]
    back = [
        pose(1.2 * i + rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), 0.03)
        for i in range(LAP)
    ]
    poses = np.array(there + back)
    return lens, keyframes(list(poses)), poses, [view(place, p, lens, rng, depth) for p in poses]


def lap_pairs() -> list[tuple[int, int]]:
    return [(LAP + i, i) for i in range(LAP)]


def sigmas(ledger: Closures, poses: np.ndarray) -> np.ndarray:
    """(C,) Mahalanobis distance to the truth over sqrt(6)."""
    error = se3.log(se3.between(se3.between(poses[ledger.match], poses[ledger.query]), ledger.match_from_query))
    return np.sqrt(np.einsum("ni,nij,nj->n", error, ledger.information, error) / 6)


@pytest.mark.parametrize(
    ("depth", "model"), [(False, "none"), (False, "plumb_bob"), (True, "none"), (True, "equidistant")]
)
def test_revisits_are_found_with_the_pose_and_the_certainty_they_have(depth: bool, model: str) -> None:
    lens, frames, poses, seen = drive(depth, model)
    ledger = verify(proposals(lap_pairs()), frames, lens, seen.__getitem__, EXACT)
    accepted = [v is Verdict.ACCEPTED for v in ledger.verdict]
    assert sum(accepted) >= LAP - 3
    rows = np.flatnonzero(accepted)
    part = replace(
        ledger,
        query=ledger.query[rows],
        match=ledger.match[rows],
        match_from_query=ledger.match_from_query[rows],
        information=ledger.information[rows],
    )
    moved = se3.between(se3.between(poses[part.match], poses[part.query]), part.match_from_query)
    assert np.median(np.linalg.norm(moved[:, :3, 3], axis=1)) < 0.05
    assert np.median(se3.angle(moved)) < 0.003
    assert np.isfinite(part.information).all()
    np.testing.assert_allclose(part.information, np.swapaxes(part.information, 1, 2))
    assert (np.linalg.eigvalsh(part.information) > 0).all()
    # floors and the odometry's scale make it careful; never sure of what is wrong
    assert np.median(sigmas(part, poses)) < 1.2
    assert sigmas(part, poses).max() < 3.0


@pytest.mark.parametrize(("depth", "model"), [(False, "none"), (True, "none"), (True, "equidistant")])
def test_without_floors_the_covariance_is_the_errors_own(depth: bool, model: str) -> None:
    """Without what real cameras err by beyond the noise of features. Landmarks from motion share errors: 1.5."""
    lens, frames, poses, seen = drive(depth, model)
    bare = EXACT.model_copy(
        update={
            "metric": MetricSettings(systematic_px=0.0, scale_share=0.0),
            "calibration": EXACT.calibration.model_copy(update={"least_share": 0.0, "stamp_sigma_s": 0.0}),
        }
    )
    pairs = [(LAP + i, i + k) for i in range(LAP) for k in (-1, 0) if i + k >= 0]
    ledger = verify(proposals(pairs), frames, lens, seen.__getitem__, bare)
    ratio = sigmas(ledger, poses)[[v is Verdict.ACCEPTED for v in ledger.verdict]]
    assert len(ratio) > 24
    assert 0.7 < np.mean(ratio**2) < 1.8


@pytest.mark.parametrize("depth", [False, True])
def test_both_ways_agree_and_are_together_no_worse_than_one(depth: bool) -> None:
    lens, frames, poses, seen = drive(depth)
    both, one = (
        verify(
            proposals(lap_pairs()[::2]), frames, lens, seen.__getitem__, EXACT.model_copy(update={"both_ways": asked})
        )
        for asked in (True, False)
    )
    accepted = np.array([v is Verdict.ACCEPTED for v in both.verdict])
    assert both.verdict == one.verdict
    assert (both.reverse_inliers[accepted] >= 20).all()
    assert (one.reverse_inliers == -1).all()
    assert {s for s, a in zip(both.scale, accepted, strict=True) if a} == {"depth" if depth else "odometry"}
    assert {s for s, a in zip(both.scale, accepted, strict=True) if not a} <= {"none"}
    true = se3.between(poses[both.match[accepted]], poses[both.query[accepted]])
    error = [se3.log(se3.between(true, ledger.match_from_query[accepted])) for ledger in (both, one)]
    size = [np.sqrt((e[:, 3:] ** 2).sum(1).mean()) for e in error]
    assert size[0] < 1.1 * size[1]


def test_two_ways_that_disagree_are_inconsistent() -> None:
    lens, _, poses, seen = drive(False)
    stretched = poses.copy()
    stretched[LAP:, :3, 3] *= 1.4  # the odometry of the second pass has a wrong scale
    sure = EXACT.model_copy(update={"metric": MetricSettings(systematic_px=0.0)})  # these pixels share no error
    pairs = lap_pairs()[:8]
    wrong = verify(proposals(pairs), keyframes(list(stretched)), lens, seen.__getitem__, sure)
    alone = sure.model_copy(update={"both_ways": False})
    one_way = verify(proposals(pairs), keyframes(list(stretched)), lens, seen.__getitem__, alone)
    moved = np.linalg.norm(se3.between(poses[wrong.match], poses[wrong.query])[:, :3, 3], axis=1)
    far = np.array([v is Verdict.ACCEPTED for v in one_way.verdict]) & (moved > 0.8)
    assert far.sum() >= 4
    for row in np.flatnonzero(far):
        assert wrong.verdict[row] is Verdict.INCONSISTENT
        assert wrong.reverse_inliers[row] >= 0
        assert wrong.scale[row] == "odometry"
        assert np.isnan(wrong.match_from_query[row]).all()
        assert np.isnan(wrong.information[row]).all()


def test_where_the_query_has_no_landmarks_one_way_has_to_do() -> None:
    lens, frames, poses, seen = drive(False)
    alone = [empty(lens) if row >= LAP and row != LAP + 5 else f for row, f in enumerate(seen)]
    ledger = verify(proposals([(LAP + 5, 5)]), frames, lens, alone.__getitem__, EXACT)
    assert ledger.verdict == [Verdict.ACCEPTED]
    assert ledger.reverse_inliers.tolist() == [-1]
    assert sigmas(ledger, poses)[0] < 3.0


def test_other_places_are_rejected_and_carry_no_pose() -> None:
    lens, frames, _, seen = drive(False)
    rng = np.random.default_rng(1)
    elsewhere = [view(scene(rng), pose(0), lens, rng) for _ in range(LAP)]
    for other in elsewhere:  # half of each image's descriptors are the road's: matches without geometry
        count = len(other) // 2
        source = seen[int(rng.integers(LAP))].descriptors
        other.descriptors[:count] = source[rng.choice(len(source), count, replace=False)]
    both = seen[:LAP] + elsewhere
    ledger = verify(proposals(lap_pairs()), frames, lens, both.__getitem__, EXACT)
    assert not any(v is Verdict.ACCEPTED for v in ledger.verdict)
    assert (ledger.matches >= 25).any()  # some did reach the geometry
    assert np.isnan(ledger.match_from_query).all()
    assert np.isnan(ledger.information).all()
    assert np.isnan(ledger.weight).all()
    for name in COLUMNS:
        assert np.isfinite(getattr(ledger, name)).all()


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.usefixtures("computed_anew")
def test_threads_and_order_change_no_byte(calibrated: bool) -> None:
    lens, frames, _, seen = drive(False)
    lens = lens if calibrated else replace(lens, matrix=None)
    pairs = [(LAP + i, j) for i in range(0, LAP, 4) for j in (i, (i + 7) % LAP)]
    one, four = (verify(proposals(pairs), frames, lens, seen.__getitem__, EXACT, Execution(n)) for n in (1, 4))
    for name in (*COLUMNS, "match_from_query", "information"):
        assert getattr(one, name).tobytes() == getattr(four, name).tobytes(), name
    assert one.verdict == four.verdict
    alone = verify(proposals(pairs[4:5]), frames, lens, seen.__getitem__, EXACT)
    assert alone.match_from_query.tobytes() == one.match_from_query[4:5].tobytes()


def test_uncalibrated_images_agree_or_not_but_have_no_pose() -> None:
    lens, frames, _, seen = drive(False)
    lens = replace(lens, matrix=None)
    near, far = [(LAP + i, i) for i in range(8)], [(LAP + i, i + 8) for i in range(8)]
    rng = np.random.default_rng(2)
    shuffled = [replace(f, points=rng.permutation(f.points)) for f in seen]  # the same features, no geometry
    same = verify(proposals(near), frames, lens, seen.__getitem__, EXACT)
    none = verify(proposals(near), frames, lens, (seen[:LAP] + shuffled[LAP:]).__getitem__, EXACT)
    assert set(same.verdict) == {Verdict.NO_CALIBRATION}
    assert (same.inliers > 100).all()
    assert set(none.verdict) == {Verdict.TOO_FEW_INLIERS}
    for ledger in (same, none, verify(proposals(far), frames, lens, seen.__getitem__, EXACT)):
        assert np.isnan(ledger.match_from_query).all()
        assert (ledger.landmarks == 0).all()


def test_images_without_features_are_too_few_matches() -> None:
    lens, frames, _, seen = drive(False)
    blank = [empty(lens) if i % 2 else f for i, f in enumerate(seen)]
    for given in (blank, [empty(lens)] * len(seen)):
        ledger = verify(proposals([(LAP, 1), (LAP + 1, 2)]), frames, lens, given.__getitem__, EXACT)
        assert ledger.verdict == [Verdict.TOO_FEW_MATCHES] * 2
        assert ledger.matches.tolist() == [0, 0]


@pytest.mark.parametrize("still", ["standing", "turning"])
def test_a_map_camera_that_did_not_move_has_no_scale(still: str) -> None:
    rng = np.random.default_rng(12)
    lens, place = camera(), scene(rng)
    swing = 0.04 if still == "turning" else 0.0
    about = se3.inverse(lens.body_from_camera)
    poses = [lens.body_from_camera @ se3.exp(np.array([0.0, swing * i, 0, 0, 0, 0])) @ about for i in range(5)] + [
        pose(0.3, 0.4)
    ]
    seen = [view(place, p, lens, rng) for p in poses]
    ledger = verify(proposals([(5, 2)]), keyframes(poses), lens, seen.__getitem__, EXACT)
    assert ledger.verdict == [Verdict.DEGENERATE_MOTION]
    assert ledger.matches[0] > 100


def test_matches_without_landmarks_and_in_one_corner() -> None:
    lens, frames, _, seen = drive(True)
    holes = [replace(f, depth_m=np.where(np.arange(len(f)) < 5, f.depth_m, np.float32(np.nan))) for f in seen]
    ledger = verify(proposals([(LAP + 3, 3)]), frames, lens, holes.__getitem__, EXACT)
    assert (ledger.verdict, ledger.scale) == ([Verdict.ACCEPTED], ["odometry"]), "motion tells where depth does not"
    stands = keyframes([pose(0.0)] * len(seen))
    ledger = verify(proposals([(LAP + 3, 3)]), stands, lens, holes.__getitem__, EXACT)
    assert ledger.verdict == [Verdict.TOO_FEW_LANDMARKS]
    assert ledger.landmarks[0] <= 5

    rng = np.random.default_rng(9)
    place = scene(rng, 9000)
    poses = [pose(0.0), pose(0.3, 0.2)]
    seen = [view(place, p, lens, rng, depth=True, most=9000) for p in poses]
    kept = [(np.abs(f.points - [320, 240]) < 75).all(axis=1) for f in seen]  # 150 px square: 7 % of the image
    small = [
        replace(f, points=f.points[k], sizes=f.sizes[k], descriptors=f.descriptors[k], depth_m=f.depth_m[k])
        for f, k in zip(seen, kept, strict=True)
    ]
    ledger = verify(proposals([(1, 0)]), keyframes(poses), lens, small.__getitem__, EXACT)
    assert ledger.verdict == [Verdict.POOR_SPREAD]


def test_a_pose_too_far_to_share_the_view_is_implausible() -> None:
    rng = np.random.default_rng(13)
    lens = camera()
    place = replace(scene(rng), points=rng.uniform([9, -3, -2], [11, 3, 3], (3000, 3)))  # a wall 10 m ahead
    poses = [pose(0.0), pose(6.5)]
    seen = [view(place, p, lens, rng, depth=True) for p in poses]
    settings = EXACT.model_copy(update={"metric": MetricSettings(min_spread=0.0)})
    ledger = verify(proposals([(1, 0)]), keyframes(poses), lens, seen.__getitem__, settings)
    assert ledger.verdict == [Verdict.IMPLAUSIBLE_POSE]
    assert np.isnan(ledger.match_from_query).all()


def test_a_wall_is_no_obstacle_where_depth_is_measured() -> None:
    rng = np.random.default_rng(14)
    lens = camera()
    flat = rng.uniform([10, -9, -7], [10.001, 9, 7], (3000, 3))
    place = replace(scene(rng), points=flat)
    poses = np.array([pose(0.0), pose(0.5, 0.4, yaw=0.1)])
    seen = [view(place, p, lens, rng, depth=True) for p in poses]
    ledger = verify(proposals([(1, 0)]), keyframes(list(poses)), lens, seen.__getitem__, EXACT)
    assert ledger.verdict == [Verdict.ACCEPTED]
    assert sigmas(ledger, poses)[0] < 2.5


TURNED = se3.pose(se3.so3_exp(np.array([0.0, 0.0, 1.2])), np.zeros(3))


@pytest.mark.parametrize(
    ("turned", "focal", "depth", "warned"),
    [
        (np.eye(4), 1.0, 1.0, ""),
        (np.eye(4), 1.12, 1.0, "focal length"),
        (np.eye(4), 1.3, 1.0, "by 20 % or more"),
        (TURNED, 1.0, 1.0, "turns about another axis than the odometry, 69 degrees off. Check its mount"),
        (np.eye(4), 1.0, 1.8, "moves 1.8 times as far by its depth"),
        (np.eye(4), 1.0, 0.2, "moves 0.2 times as far by its depth"),
    ],
)
def test_a_camera_that_disagrees_with_the_odometry_is_said_to_be_wrong_in_the_way_it_is(
    turned: np.ndarray, focal: float, depth: float, warned: str, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(15)
    lens, place = camera(), scene(rng, 4000)
    assert lens.matrix is not None
    poses = [pose(0.1 * i, yaw=0.35 * np.sin(i / 3)) for i in range(40)]
    views = [view(place, p, lens, rng, depth=True) for p in poses]
    views = [replace(one, depth_m=depth * one.depth_m) for one in views]
    wrong = replace(
        lens,
        matrix=lens.matrix * [[focal, 1, 1], [1, focal, 1], [1, 1, 1]],
        body_from_camera=lens.body_from_camera @ turned,
    )
    calibration_share(drive_of(keyframes(poses), wrong, views.__getitem__, EXACT), Execution())
    assert [warned in record.getMessage() for record in caplog.records] == [True] * bool(warned)


def test_late_images_are_said_to_be_late(caplog: pytest.LogCaptureFixture) -> None:
    rng, path = np.random.default_rng(15), lambda at: pose(0.1 * at, yaw=0.35 * np.sin(at / 3))
    lens, place = camera(), scene(rng, 4000)
    rows, times = np.arange(40), np.arange(-10.0, 50.0, 0.1)
    drive = keyframes([path(row) for row in rows])
    views = [view(place, one, lens, rng, depth=True) for one in drive.odom_from_body]
    second_ns, at_ns = int(drive.stamp_ns[1] - drive.stamp_ns[0]), int(drive.stamp_ns[0])
    track = Trajectory(at_ns + (times * second_ns).astype(np.int64), np.array([path(at + 0.4) for at in times]))
    calibration_share(drive_of(drive, lens, views.__getitem__, EXACT), Execution(), track)
    (said,) = [record.getMessage() for record in caplog.records]
    assert re.search(r"are 0\.(3[5-9]|4[0-5]) s .* late against the odometry\. --image-offset-s -0\.", said), said


def test_a_wrong_focal_length_is_noticed_and_claims_less(caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(15)
    lens, place = camera(), scene(rng, 6000)
    assert lens.matrix is not None
    poses = np.array([pose(0.1 * i, yaw=0.35 * np.sin(i / 3)) for i in range(40)])
    seen = [view(place, p, lens, rng, depth=True) for p in poses]
    wrong = replace(lens, matrix=lens.matrix * [[1.12, 1, 1], [1, 1.12, 1], [1, 1, 1]])
    pairs = proposals([(34, 0), (33, 1)])  # 20 degrees apart
    good = verify(pairs, keyframes(list(poses)), lens, seen.__getitem__, EXACT)
    assert not caplog.records
    bad = verify(pairs, keyframes(list(poses)), wrong, seen.__getitem__, EXACT)
    assert "focal length" in caplog.text
    assert good.verdict == bad.verdict == [Verdict.ACCEPTED] * 2
    trace = [np.trace(np.linalg.inv(ledger.information[0])[:3, :3]) for ledger in (good, bad)]
    assert trace[1] > 2.0 * trace[0]
    assert (sigmas(bad, poses) < 2.0).all()


def test_no_candidates_and_progress() -> None:
    lens, frames, _, seen = drive(False)
    assert len(verify(proposals([]), frames, lens, seen.__getitem__, EXACT)) == 0
    calls: list[tuple[str, int, int]] = []
    execution = Execution(2, lambda name, done, total: calls.append((name, done, total)))
    verify(proposals(lap_pairs()[:5]), frames, lens, seen.__getitem__, EXACT, execution)
    assert calls == [("verify", i + 1, 5) for i in range(5)]


def test_an_unknown_lens_stops_before_the_work() -> None:
    lens, frames, _, _ = drive(False)
    with pytest.raises(LogError, match="distortion model"):
        verify(proposals([(LAP, 0)]), frames, replace(lens, distortion_model="fov"), lambda _: 1 / 0, EXACT)  # type: ignore[arg-type]


def test_matches_of_one_plane_agree_and_never_end_a_run() -> None:
    """OpenCV's USAC raises for some of them: the facade of a house, with a few wrong matches."""
    rng = np.random.default_rng(0)
    for _ in range(150):
        count, wrong = int(rng.integers(12, 60)), int(rng.integers(0, 4))
        match = rng.uniform([180, 5], [360, 170], (count, 2))
        a, b, d = rng.normal(0, 0.05, 3)
        plane = np.array([[0.6 + a, b, -90], [d, 0.6, rng.uniform(0, 40)], [*rng.normal(0, 3e-4, 2), 1]])
        seen = np.c_[match, np.ones(count)] @ plane.T
        query = seen[:, :2] / seen[:, 2:]
        query[:wrong] = rng.uniform(0, 380, (wrong, 2))
        agrees, _ = epipolar_inliers(query.astype(np.float32), match.astype(np.float32), 384, 216, EpipolarSettings())
        assert agrees[wrong:].mean() > 0.9
