"""Cameras ahead and behind on one body: together they fix a pose better than one, and where one alone has too few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vplog.data import Camera, Closures, Features, Floats, Keyframes, Verdict
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.loops.candidate import lenient
from vplog.loops.propose import Proposals
from vplog.loops.undistort import project
from vplog.loops.verify import VerifySettings, drive_of, verify_between
from vplog.loops.verify_rig import Rig, _is_sure, _pairs, verify_together

K = np.array([[200.0, 0, 159.5], [0, 200, 119.5], [0, 0, 1]])
AHEAD = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
BACK = se3.pose(se3.so3_exp(np.array([0.0, 0, np.pi])), np.array([-0.4, 0.1, 0.0])) @ AHEAD
CAMERAS = [Camera(f"/c{n}", K, "none", np.zeros(0), 320, 240, mount) for n, mount in enumerate((AHEAD, BACK))]
ROWS = [np.arange(2), np.arange(2)]
SETTINGS = VerifySettings.model_validate({"min_matches": 6, "both_ways": False})


def pictures(rng: np.random.Generator, poses: Floats, camera: Camera, count: int, shuffled: bool) -> list[Features]:
    """`count` points with depths that both poses of the body see, and their descriptors; `shuffled` mixes up whose
    are whose."""
    world_from_camera = poses @ camera.body_from_camera
    ahead = np.column_stack([rng.uniform(-2, 2, (4000, 2)), rng.uniform(3, 8, 4000)])
    world = se3.transform(world_from_camera[0], ahead)
    px = np.stack([project(camera, se3.transform(se3.inverse(pose), world)) for pose in world_from_camera])
    inside = (np.nan_to_num(px, nan=-1.0) > 2).all(axis=(0, 2)) & (px < [317, 237]).all(axis=(0, 2))
    chosen = np.flatnonzero(inside)[:count]
    descriptors, found = rng.integers(0, 120, (count, 128)).astype(np.uint8), []
    for view, pose in enumerate(world_from_camera):
        z = se3.transform(se3.inverse(pose), world[chosen])[:, 2]
        rho = 1.0 / z + rng.normal(0, SETTINGS.landmarks.depth_sigma, count)
        points = (px[view, chosen] + rng.normal(0, 0.7, (count, 2))).astype(np.float32)
        order = rng.permutation(count) if shuffled and view else np.arange(count)
        sizes = np.full(count, 3, np.float32)
        found.append(Features(points, sizes, descriptors[order], (1.0 / rho).astype(np.float32), 320, 240))
    return found


def rig_of(rng: np.random.Generator, motion: Floats, counts: tuple[int, int], shuffled: bool = False) -> Rig:
    """A body that is at the identity, then moved by `motion` (4, 4)."""
    poses = np.stack([np.eye(4), motion])
    keyframes = Keyframes("drive", np.array([0, 10**11]), poses)  # so slow that stamps do not count
    drives = []
    for camera, count in zip(CAMERAS, counts, strict=True):
        features = pictures(rng, poses, camera, count, shuffled)
        drives.append(drive_of(keyframes, camera, features.__getitem__, SETTINGS))
    return Rig(drives, ROWS, 0.0)


def by_one(rig: Rig, number: int = 0) -> Closures:
    """The second keyframe as a return to the first, as one camera has it."""
    one = np.ones(1, np.int32)
    proposals = Proposals(one, 0 * one, 0 * one, one.astype(np.float32), one)
    found = verify_between(proposals, rig.drives[number], rig.drives[number], Execution(), 0.0)
    return replace(found, query_camera=number * one, match_camera=number * one)


def motion_of(rng: np.random.Generator) -> Floats:
    return np.asarray(se3.exp(rng.normal(0, [0.02, 0.02, 0.05, 0.2, 0.2, 0.05])), np.float64)


def test_all_cameras_together_are_surer_and_nearer_the_truth_than_one() -> None:
    rng, errors, normalised = np.random.default_rng(0), [], []
    for _ in range(20):
        motion = motion_of(rng)
        rig = rig_of(rng, motion, (60, 60))
        alone = by_one(rig)
        assert alone.accepted.all()
        (together,) = verify_together(alone, rig, Execution())
        off = [se3.log(se3.between(motion, one.match_from_query[0])) for one in (alone, together)]
        errors.append([[np.linalg.norm(one[:3]), np.linalg.norm(one[3:])] for one in off])
        normalised.append(off[1] @ together.information[0] @ off[1] / 6)
        smaller = np.linalg.eigvalsh(together.information[0] - alone.information[0])
        assert smaller[0] > -1e-6 * smaller[-1]
        assert together.inliers.tolist() == alone.inliers.tolist()
    alone_error, together_error = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert (together_error < 0.8 * alone_error).all()
    assert np.mean(normalised) < 1.3


def test_cameras_that_have_too_few_alone_verify_together() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        motion = motion_of(rng)
        rig = rig_of(rng, motion, (14, 15))
        alone = by_one(rig)
        assert alone.verdict == [Verdict.TOO_FEW_LANDMARKS]
        (together,) = verify_together(alone, rig, Execution())
        assert together.verdict == [Verdict.ACCEPTED]
        assert together.scale == ["depth"]
        assert (together.query_camera.tolist(), together.inliers.dtype) == ([1], alone.inliers.dtype)
        assert np.linalg.norm(se3.log(se3.between(motion, together.match_from_query[0]))) < 0.15


def test_matches_that_agree_with_no_pose_are_no_closure() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        alone = by_one(rig := rig_of(rng, motion_of(rng), (40, 40), shuffled=True))
        (together,) = verify_together(alone, rig, Execution())
        assert together.verdict == alone.verdict
        assert not together.accepted.any()


@pytest.mark.parametrize("yaw_deg", [3.0, 8.0])
def test_a_camera_whose_mount_is_wrong_leaves_the_pose_of_the_other(yaw_deg: float) -> None:
    """On a return with the body turned, a wrong mount has its camera contradict the other."""
    rng = np.random.default_rng(3)
    motion = np.asarray(se3.exp(np.array([0.05, 0.0, 0.2, 0.3, 0.2, 0.0])), np.float64)
    rig = rig_of(rng, motion, (80, 80))
    wrong = se3.pose(se3.so3_exp(np.array([0.0, np.radians(yaw_deg), 0.0])), np.array([0.2, 0.0, 0.3]))
    camera = replace(CAMERAS[1], body_from_camera=BACK @ wrong)
    rig.drives = [rig.drives[0], replace(rig.drives[1], camera=camera)]
    alone = by_one(rig)
    (together,) = verify_together(alone, rig, Execution())
    off = [np.linalg.norm(se3.log(se3.between(motion, one.match_from_query[0]))) for one in (alone, together)]
    assert off[1] < off[0] + 0.05


def test_a_ledger_without_candidates_stays_so() -> None:
    rig = rig_of(np.random.default_rng(4), np.eye(4), (30, 30))
    assert verify_together(by_one(rig).rows(np.zeros(0, np.int64)), rig, Execution()) == []


def test_a_camera_without_a_matrix_leaves_the_others() -> None:
    rig = rig_of(np.random.default_rng(5), np.eye(4), (40, 40))
    ledger = replace(by_one(rig, 1), verdict=[Verdict.TOO_FEW_INLIERS])
    rig.drives = [rig.drives[0], replace(rig.drives[1], camera=replace(CAMERAS[1], matrix=None))]
    (together,) = verify_together(ledger, rig, Execution())
    assert together.verdict == [Verdict.TOO_FEW_INLIERS]


def test_what_chance_does_not_explain_has_a_pose_whatever_the_share_of_its_inliers() -> None:
    """As a person decided, and in reverse: 40 of 200 matches on a facade whose windows are alike."""
    rng = np.random.default_rng(6)
    rig = rig_of(rng, motion_of(rng), (200, 0))
    own = rig.drives[0]
    first, second = own.features(0), own.features(1)
    order = np.concatenate([np.arange(40), rng.permutation(np.arange(40, 200))])
    mixed = [first, replace(second, descriptors=second.descriptors[order])]
    for settings, accepted in ((SETTINGS, False), (lenient(SETTINGS), True)):
        drive = drive_of(own.keyframes, own.camera, mixed.__getitem__, settings)
        rig.drives = [drive, drive]
        assert by_one(rig).accepted.tolist() == [accepted]


def test_chance_is_that_of_the_smallest_image() -> None:
    """20 of 80 matches may agree by chance where the images of one pair have 10^4 px, whatever the first camera's."""
    rng = np.random.default_rng(7)
    rig = rig_of(rng, np.eye(4), (60, 60))
    pairs = _pairs(by_one(rig), np.eye(4), rig)
    pairs = [replace(one, matches=one.matches.rows(np.arange(60) < 40), place=one.place[:40]) for one in pairs]
    sure = []
    for areas in ((10**7, 10**7), (10**7, 10**4), (10**4, 10**7)):
        sized = [replace(one, area_px=area) for one, area in zip(pairs, areas, strict=True)]
        sure.append(_is_sure(np.eye(4), sized, [np.arange(40) < 10] * 2, rig))
    assert sure == [True, False, False]
