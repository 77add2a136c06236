"""Which closures are right, on drives drawn by chance whose closures are labelled, of every scale and kind of truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.evaluate.drawn import KINDS, Drawn, draw
from tests.graph.drive import ledger
from vplog.data import Floats, Trajectory
from vplog.evaluate.body_truth import BodyTruth, TruthAt, body_truth
from vplog.evaluate.closure_pose import pose_bounds, pose_errors
from vplog.evaluate.closures import ClosureScore, Judgement, score_closures
from vplog.geometry import se3
from vplog.geometry.pose_conventions import AS_GIVEN

SEEDS = range(2)


def with_rotations(change: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
    return lambda poses: se3.pose(change(poses[:, :3, :3]), poses[:, :3, 3])


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
WRITTEN: dict[str, Callable[[Floats], Floats]] = {
    "body_from_world (inverted)": se3.inverse,
    "with conjugated quaternions": with_rotations(lambda rotations: np.swapaxes(rotations, 1, 2)),
    "with quaternions in the order w x y z": with_rotations(
        lambda rotations: Rotation.from_quat(np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)).as_matrix()
    ),
    "in left-handed axes (mirrored)": lambda poses: MIRROR @ poses @ MIRROR,
}
"""Poses world_from_body as other conventions write them."""


def judged(drive: Drawn, truth: Trajectory) -> tuple[ClosureScore, Judgement, BodyTruth]:
    found = body_truth(truth, drive.odometry, drive.camera)
    return *score_closures(drive.keyframes, drive.closures, found, drive.stop, cameras=[drive.camera]), found


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_label_is_found(kind: str, seed: int) -> None:
    drive = draw(kind, seed)
    score, found, truth = judged(drive, drive.truth)
    np.testing.assert_array_equal(found.right, drive.right)
    np.testing.assert_array_equal(found.wrong, ~drive.right)
    assert (truth.frame, truth.oriented) == ("body", True)
    assert score.precision == drive.right.mean()
    assert (score.not_judged, score.by_place, score.overconfident) == (0, 0, 0)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_of_1_hz_calls_nothing_what_it_is_not(kind: str, seed: int) -> None:
    drive = draw(kind, seed)
    seconds = np.arange(7, len(drive.truth.stamp_ns), 20)
    _, found, _ = judged(drive, Trajectory(drive.truth.stamp_ns[seconds] + 11_000_000, poses_between(drive, seconds)))
    assert not (found.right & ~drive.right).any()
    assert not (found.wrong & drive.right).any()
    assert (found.right | found.wrong)[found.known].mean() > 0.95


def poses_between(drive: Drawn, rows: np.ndarray) -> np.ndarray:
    return se3.interpolate_at(
        drive.truth.stamp_ns, drive.truth.world_from_body, drive.truth.stamp_ns[rows] + 11_000_000
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_of_the_camera_is_known_as_such(kind: str, seed: int) -> None:
    drive = draw(kind, seed)
    other = se3.exp(np.array([0.3, -2.0, 1.0, 5.0, 6.0, 7.0]))  # and in another world
    truth = Trajectory(drive.truth.stamp_ns, other @ drive.truth.world_from_body @ drive.camera)
    _, found, of_body = judged(drive, truth)
    assert of_body.frame == "camera"
    np.testing.assert_array_equal(found.right, drive.right)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_of_another_point_is_estimated(kind: str, seed: int) -> None:
    drive = draw(kind, seed)
    size = {"room": 0.1, "road": 1.5, "drone": 0.5, "aisles": 0.5}[kind]
    marker = se3.exp(np.concatenate([np.random.default_rng(seed).normal(size=3), [size, -size / 2, size / 3]]))
    truth = Trajectory(drive.truth.stamp_ns, drive.truth.world_from_body @ marker)
    _, found, of_body = judged(drive, truth)
    assert of_body.frame == "estimated"
    np.testing.assert_array_equal(found.right, drive.right)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_marker_as_far_from_the_body_as_it_moves_is_estimated(seed: int) -> None:
    drive, random = draw("room", 100 + seed), np.random.default_rng(100 + seed)
    marker = se3.exp(np.concatenate([random.normal(size=3), random.uniform(-0.5, 0.5, 3)]))
    _, found, of_body = judged(drive, Trajectory(drive.truth.stamp_ns, drive.truth.world_from_body @ marker))
    assert of_body.frame == "estimated"
    np.testing.assert_array_equal(found.right, drive.right)
    np.testing.assert_array_equal(found.wrong, ~drive.right)


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_in_another_convention_is_converted(kind: str, written: str) -> None:
    drive = draw(kind, 5)
    poses = WRITTEN[written](drive.truth.world_from_body)
    _, found, of_body = judged(drive, Trajectory(drive.truth.stamp_ns, poses))
    np.testing.assert_array_equal(found.right, drive.right)
    assert (of_body.convention, of_body.frame) == (written, "body")
    assert of_body.as_read is not None
    np.testing.assert_allclose(of_body.as_read.world_from_body, drive.truth.world_from_body, atol=1e-6)


@pytest.mark.parametrize("written", WRITTEN)
def test_a_straight_road_does_not_tell_the_convention_of_the_truth(written: str) -> None:
    seconds = np.arange(0.0, 60.0, 0.1)
    poses = np.tile(np.eye(4), (len(seconds), 1, 1))
    poses[:, 0, 3] = 5.0 * seconds
    stamps, rng = (seconds * 1e9).astype(np.int64), np.random.default_rng(0)
    noise = se3.exp(rng.normal(0.0, [1e-3] * 3 + [1e-2] * 3, (len(seconds), 6)))
    of_body = body_truth(Trajectory(stamps, poses @ noise), Trajectory(stamps, poses), np.eye(4))
    assert (of_body.convention, of_body.unit, of_body.has_other_scale) == (AS_GIVEN, "m", False)
    of_body = body_truth(Trajectory(stamps, WRITTEN[written](poses @ noise)), Trajectory(stamps, poses), np.eye(4))
    assert of_body.convention in (AS_GIVEN, written)


@pytest.mark.parametrize(("times", "unit", "differs"), [(1000.0, "mm", False), (100.0, "cm", False), (1.3, "m", True)])
@pytest.mark.parametrize("kind", KINDS)
def test_the_scale_of_the_truth_is_found(kind: str, times: float, unit: str, differs: bool) -> None:
    drive = draw(kind, 6)
    marker = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.0, 0.2]))
    for poses in (drive.truth.world_from_body, drive.truth.world_from_body @ marker):
        _, found, of_body = judged(drive, Trajectory(drive.truth.stamp_ns, se3.stretched(poses, times)))
        assert (of_body.unit, of_body.has_other_scale) == (unit, differs)
        assert of_body.scale == pytest.approx((times if differs else 1.0) / 1.02, rel=0.03)
        assert differs or (found.right == drive.right).all()


@pytest.mark.parametrize("scale", [0.3, 7.0])
@pytest.mark.parametrize("kind", KINDS)
def test_odometry_without_metres_finds_the_frame_of_the_truth(kind: str, scale: float) -> None:
    """As that of a single camera."""
    drive = draw(kind, 3)
    poses = drive.odometry.world_from_body.copy()
    poses[:, :3, 3] *= scale
    drive = replace(drive, odometry=Trajectory(drive.odometry.stamp_ns, poses))
    _, found, of_body = judged(drive, Trajectory(drive.truth.stamp_ns, drive.truth.world_from_body @ drive.camera))
    assert (of_body.frame, of_body.offset_s) == ("camera", 0.0)
    np.testing.assert_array_equal(found.right, drive.right)
    np.testing.assert_array_equal(found.wrong, ~drive.right)
    seconds = slice(7, None, 20)
    _, found, _ = judged(drive, Trajectory(drive.truth.stamp_ns[seconds], drive.truth.world_from_body[seconds]))
    assert not (found.right & ~drive.right).any()
    assert not (found.wrong & drive.right).any()
    assert (found.right | found.wrong)[found.known].mean() > 0.9


@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_of_another_clock_is_known_as_such(kind: str) -> None:
    drive = draw(kind, 4)
    of_body, of_camera = drive.truth.world_from_body, drive.truth.world_from_body @ drive.camera
    for truth, offset_s in ((of_body, -2.0), (of_camera, 0.1), (of_body, 0.5), (of_camera, 0.0)):
        late = Trajectory(drive.truth.stamp_ns + round(offset_s * 1e9), truth)
        found = body_truth(late, drive.odometry, drive.camera).offset_s
        assert found == pytest.approx(-offset_s, abs=0.03 if offset_s else 0.0), offset_s


@pytest.mark.parametrize("times", [1, 10])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_noise_of_the_truth_makes_no_closure_false(kind: str, seed: int, times: int) -> None:
    drive = draw(kind, seed)
    metres = times * {"room": 0.005, "road": 0.1, "drone": 0.05, "aisles": 0.02}[kind]
    noise = np.random.default_rng(seed).normal(size=(len(drive.truth.stamp_ns), 6)) * np.repeat([0.005, metres], 3)
    truth = Trajectory(drive.truth.stamp_ns, drive.truth.world_from_body @ se3.exp(noise))
    _, found, of_body = judged(drive, truth)
    assert of_body.frame == "body"
    assert not (found.right & ~drive.right).any()
    assert not (found.wrong & drive.right).any()
    assert times > 1 or (found.right | found.wrong).mean() > 0.95


@pytest.mark.parametrize("seed", SEEDS)
def test_gaps_of_the_truth_are_not_judged(seed: int) -> None:
    drive = draw("drone", seed)
    stamps = drive.keyframes.stamp_ns
    gap = (stamps[len(stamps) // 2 + 10], stamps[len(stamps) // 2 + 60])
    rows = (drive.truth.stamp_ns < gap[0]) | (drive.truth.stamp_ns > gap[1])
    score, found, _ = judged(drive, Trajectory(drive.truth.stamp_ns[rows], drive.truth.world_from_body[rows]))
    np.testing.assert_array_equal(found.right, drive.right & found.known)
    assert score.not_judged == (~found.known).sum() > 0
    assert score.accepted == found.known.sum()


def test_positions_alone_judge_places() -> None:
    drive = draw("road", 0)
    flat = drive.truth.world_from_body.copy()
    flat[:, :3, :3] = np.eye(3)
    score, found, truth = judged(drive, Trajectory(drive.truth.stamp_ns, flat))
    assert not truth.oriented
    assert not found.posed.any()
    assert score.by_place == score.accepted
    np.testing.assert_array_equal(found.right, found.at_place)


def known(poses: np.ndarray, error: float = 0.0) -> TruthAt:
    return TruthAt(poses, np.ones(len(poses), bool), np.tile([0.0, error], (len(poses), 1)))


def outcome(error: np.ndarray, sigma: tuple[float, float], metres: float, unsure_m: float = 0.0) -> str:
    """Of a closure that is off by `error` (6,) and claims `sigma` rad and m, on a drive `metres` long."""
    poses = np.stack([np.eye(4), se3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.1, 0.2]))])
    measured = (se3.between(poses[0], poses[1]) @ se3.exp(error))[None]
    found = replace(
        ledger(np.array([1]), np.array([0]), measured),
        information=np.diag(1.0 / np.repeat(sigma, 3) ** 2)[None],
    )
    line = np.linspace([0.0, 0.0, 0.0], [metres, 0.0, 0.0], 10)
    at = known(poses, unsure_m)
    _, right, wrong, _ = pose_errors(found, at, at, pose_bounds(line))
    return "right" if right[0] else "wrong" if wrong[0] else "not judged"


def off(metres: float, degrees: float) -> np.ndarray:
    return np.array([0.0, 0.0, np.radians(degrees), metres, 0.0, 0.0])


def test_the_bounds_follow_the_drive_and_the_claim() -> None:
    assert outcome(off(0.06, 2.0), (0.01, 0.01), 7.0) == "right"
    assert outcome(off(0.4, 2.0), (0.01, 0.01), 7.0) == "wrong"
    assert outcome(off(0.4, 2.0), (0.01, 0.01), 1000.0) == "right"
    assert outcome(off(1.1, 8.0), (0.01, 0.05), 1000.0) == "wrong"
    assert outcome(off(0.13, 1.0), (0.01, 0.01), 7.0) == "wrong"
    assert outcome(off(0.13, 1.0), (0.01, 0.04), 7.0) == "right"
    assert outcome(off(0.06, 9.0), (0.04, 0.01), 7.0) == "right"
    assert outcome(off(0.06, 11.0), (1.0, 1.0), 7.0) == "wrong"
    assert outcome(off(0.35, 1.0), (1.0, 1.0), 7.0) == "wrong"
    for metres in (1.0, 7.0, 100.0, 1e3, 1e5, 1e7):
        for claimed in (0.01, 1.0, 1e4):
            assert outcome(off(8.0, 0.0), (0.01, claimed), metres) == "wrong"


def test_what_the_truth_cannot_tell_is_not_judged() -> None:
    assert outcome(off(0.2, 1.0), (0.01, 0.01), 7.0, unsure_m=0.1) == "not judged"
    assert outcome(off(0.05, 1.0), (0.01, 0.01), 7.0, unsure_m=0.1) == "right"
    assert outcome(off(8.0, 1.0), (0.01, 0.01), 7.0, unsure_m=0.1) == "wrong"


def test_rounds_in_a_room_do_not_widen_the_bound() -> None:
    turn = np.linspace(0, 200 * np.pi, 20_000)
    room = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    assert pose_bounds(room).length_m < 10
    assert pose_bounds(np.zeros((0, 3))).translation_m == 0
    assert pose_bounds(room, room).length_m == pytest.approx(2 * pose_bounds(room).length_m)


def test_closures_without_metres_are_held_to_their_direction() -> None:
    drive = draw("road", 1)
    closures, camera = drive.closures, drive.camera
    at = known(drive.truth.world_from_body[np.searchsorted(drive.truth.stamp_ns, drive.keyframes.stamp_ns)])
    there, here = (at.world_from_body[rows] @ camera for rows in (closures.match, closures.query))
    true = se3.between(there, here)
    length = np.linalg.norm(true[:, :3, 3], axis=1)
    unit = true.copy()
    unit[:, :3, 3] /= length[:, None]
    turned = unit @ se3.exp(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    reverse = unit.copy()
    reverse[:, :3, 3] *= -1.0
    bounds = replace(pose_bounds(drive.truth.world_from_body[:, :3, 3]), translation_m=0.1 * float(length.min()))
    for measured, right in ((unit, True), (turned, False), (reverse, False)):
        told = replace(
            closures,
            match_from_query=camera @ measured @ se3.inverse(camera),
            scale=["none"] * len(closures),
            information=closures.information / 1e12,  # in no metres: a claim that widens nothing
        )
        _, found, wrong, _ = pose_errors(told, at, at, bounds, (camera, camera))
        assert (found == right).all()
        assert (wrong == ~found).all()
