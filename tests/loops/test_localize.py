"""A picture of a made-up place is put where it was taken, within the covariance that is claimed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.loops.scene import NOISE_PX, camera, empty, pose, scene, view
from vplog.data import Verdict
from vplog.geometry import se3
from vplog.loops import localize as localize_module
from vplog.loops import verify_metric
from vplog.loops.landmarks import from_depth
from vplog.loops.localize import KeyframeLandmarks, localize
from vplog.loops.undistort import rays
from vplog.loops.verify import VerifySettings

if TYPE_CHECKING:
    from tests.loops.scene import Scene
    from vplog.data import Floats

SETTINGS = VerifySettings()
LENS = camera()


def place(world: Scene, world_from_body: Floats, rng: np.random.Generator) -> KeyframeLandmarks:
    """A keyframe with a depth camera's landmarks."""
    own = view(world, world_from_body, LENS, rng, depth=True)
    own = own.rows(np.flatnonzero(np.isfinite(own.depth_m)))
    found = from_depth(rays(LENS, own.points), own.depth_m.astype(np.float64), LENS, SETTINGS.landmarks)
    rows = np.flatnonzero(found.known)
    sigma = np.sqrt(found.covariance[rows, 2, 2])
    world_from_camera = world_from_body @ LENS.body_from_camera
    return KeyframeLandmarks(world_from_camera, own.rows(rows), sigma, LENS, SETTINGS.landmarks.pixel_sigma, True)


def test_poses_are_as_sure_as_their_covariance_says() -> None:
    """In a world whose calibration is right, without what is set aside for wrong ones."""
    exact = VerifySettings.model_validate({"metric": {"systematic_px": 0.0}, "calibration": {"least_share": 0.0}})
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        world = scene(rng)
        places = [place(world, pose(x), rng) for x in (0.0, 1.0, 2.0, 3.0)]
        true = pose(1.6, 0.3, 0.0, yaw=0.06)
        found = localize(view(world, true, LENS, rng), LENS, places, exact)
        assert found.verdict is Verdict.ACCEPTED
        assert found.places > 1
        assert found.world_from_camera is not None
        assert found.covariance is not None
        error = se3.log(se3.between(found.world_from_camera, true @ LENS.body_from_camera))
        assert np.linalg.norm(error[3:]) < 0.2
        errors.append(error @ np.linalg.solve(found.covariance, error))
    # chi-square's mean is 6, for the pixels' noise as claimed; over 30 worlds it varies by 0.6 times that
    claimed = 6.0 * (NOISE_PX / SETTINGS.landmarks.pixel_sigma) ** 2
    assert 0.6 * claimed < np.mean(errors) < 1.4 * claimed


def test_more_places_make_a_pose_surer() -> None:
    rng = np.random.default_rng(3)
    world = scene(rng)
    places = [place(world, pose(x), rng) for x in (0.0, 1.0, 2.0)]
    picture = view(world, pose(1.2), LENS, rng)
    one, all_of_them = (localize(picture, LENS, some, SETTINGS) for some in (places[:1], places))
    assert one.covariance is not None
    assert all_of_them.covariance is not None
    assert all_of_them.inliers > one.inliers
    assert np.linalg.det(all_of_them.covariance) < np.linalg.det(one.covariance)


def test_a_picture_of_elsewhere_has_no_pose() -> None:
    rng = np.random.default_rng(1)
    world, other = scene(rng), scene(rng)
    found = localize(view(other, pose(0.0), LENS, rng), LENS, [place(world, pose(0.0), rng)], SETTINGS)
    assert found.verdict in (Verdict.TOO_FEW_MATCHES, Verdict.TOO_FEW_INLIERS)
    assert found.world_from_camera is None


def test_a_picture_of_two_equal_places_is_at_neither() -> None:
    """The same room in another storey: as many landmarks agree with a pose there."""
    rng = np.random.default_rng(2)
    world = scene(rng)
    here = place(world, pose(0.0), rng)
    there = replace(here, world_from_camera=pose(0.0, 0.0, 30.0) @ here.world_from_camera)
    picture = view(world, pose(0.2), LENS, rng)
    assert localize(picture, LENS, [here, there], SETTINGS).verdict is Verdict.INCONSISTENT
    assert localize(picture, LENS, [here], SETTINGS).verdict is Verdict.ACCEPTED


def test_places_that_cannot_be_rivals_change_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a pose fitted at every place the verdicts are the same, and the poses within their covariance."""
    worlds, solved, solve = [], list[Any](), verify_metric.solve
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world, far = scene(rng), pose(0.0, 0.0, rng.choice([2.0, 30.0]))
        places = [place(world, pose(x), rng) for x in rng.uniform(0.0, 3.0, rng.integers(1, 5))]
        copied = [one for one in places if rng.random() < 0.3]
        places += [replace(one, world_from_camera=far @ one.world_from_camera) for one in copied]
        worlds.append((view(world, pose(rng.uniform(0.0, 3.0)), LENS, rng), places))

    def counted(*given: Any) -> Any:
        solved.append(given)
        return solve(*given)

    monkeypatch.setattr(verify_metric, "solve", counted)
    counts, found = [], []
    for _ in range(2):
        solved.clear()
        found.append([localize(picture, LENS, places, SETTINGS) for picture, places in worlds])
        counts.append(len(solved))
        for test in ("_may_be_rival", "_is_far"):
            monkeypatch.setattr(localize_module, test, lambda *_: True)
    assert [one.verdict for one in found[0]] == [one.verdict for one in found[1]]
    assert {Verdict.ACCEPTED, Verdict.INCONSISTENT} == {one.verdict for one in found[0]}
    for fast, slow in zip(*found, strict=True):
        if fast.world_from_camera is not None and slow.world_from_camera is not None and fast.covariance is not None:
            error = se3.log(se3.between(fast.world_from_camera, slow.world_from_camera))
            assert error @ np.linalg.solve(fast.covariance, error) < 6.0
    assert counts[0] < 0.7 * counts[1]


@pytest.mark.parametrize("count", [0, 1])
def test_what_lacks_features_or_calibration_gets_a_verdict(count: int) -> None:
    rng = np.random.default_rng(0)
    places = [place(scene(rng), pose(0.0), rng)][:count]
    assert localize(empty(LENS), LENS, places, SETTINGS).verdict is Verdict.TOO_FEW_MATCHES
    uncalibrated = camera(calibrated=False)
    assert localize(empty(LENS), uncalibrated, places, SETTINGS).verdict is Verdict.NO_CALIBRATION


def test_a_keyframe_without_landmarks_is_passed_over() -> None:
    rng = np.random.default_rng(5)
    world = scene(rng)
    sound = place(world, pose(0.0), rng)
    blind = replace(sound, features=sound.features.rows(slice(0)), sigma=np.empty(0))
    assert localize(view(world, pose(0.2), LENS, rng), LENS, [blind, sound], SETTINGS).verdict is Verdict.ACCEPTED
