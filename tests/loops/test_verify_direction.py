from __future__ import annotations

import numpy as np
import pytest

from vplog import geometry
from vplog.data import Verdict
from vplog.loops import verify_direction
from vplog.loops.candidate import VerifySettings
from vplog.loops.landmarks import LandmarkSettings
from vplog.loops.verify_direction import DirectionSettings

from .scene import NOISE_PX, camera, keyframes, pose, proposals, scene, verify, view

KEEP = VerifySettings(landmarks=LandmarkSettings(pixel_sigma=NOISE_PX), direction=DirectionSettings(keep=True))


def rays(rng: np.random.Generator, match_from_query: np.ndarray, noise_px: float, count: int = 150) -> tuple:
    points = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)]) * rng.uniform(4, 20, (count, 1))
    moved = geometry.transform(match_from_query, points)
    query, match = (p[:, :2] / p[:, 2:] + rng.normal(0, noise_px / 505.0, (count, 2)) for p in (points, moved))
    return query, match


def solve(query: np.ndarray, match: np.ndarray, systematic_px: float = 0.0) -> verify_direction.Pose:
    shares = query + 0.5
    return verify_direction.solve(
        Verdict.DEGENERATE_MOTION, query, match, shares, camera(), 0.5, systematic_px, DirectionSettings()
    )


def test_turn_and_direction_are_as_sure_as_they_claim() -> None:
    rng = np.random.default_rng(0)
    ratio = []
    for _ in range(60):
        true = geometry.pose(geometry.so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 1.0, 3))
        query, match = rays(rng, true, 0.5)
        wrong = rng.choice(150, 30, replace=False)
        match[wrong] = rng.uniform(-0.5, 0.5, (30, 2))
        found = solve(query, match)
        if found.match_from_query is None or found.information is None:
            continue
        assert found.verdict is Verdict.DEGENERATE_MOTION
        assert np.linalg.norm(found.match_from_query[:3, 3]) == pytest.approx(1.0)
        true[:3, 3] /= np.linalg.norm(true[:3, 3])
        error = geometry.log(geometry.between(true, found.match_from_query))
        ratio.append(np.sqrt(error @ found.information @ error / 5))
        values, vectors = np.linalg.eigh(found.information)
        assert (values[1:] > 0).all()
        assert abs(values[0]) < 1e-9 * values[-1]  # of the translation's length nothing is known
        ahead = found.match_from_query[:3, :3].T @ found.match_from_query[:3, 3]
        assert abs(vectors[3:, 0] @ ahead) == pytest.approx(1.0, abs=1e-6)
    assert len(ratio) > 50
    assert 0.7 < np.median(ratio) < 1.5


def test_a_turn_on_the_spot_has_no_direction() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        found = solve(*rays(rng, geometry.pose(geometry.so3_exp(rng.normal(0, 0.1, 3)), np.zeros(3)), 0.5))
        assert found.match_from_query is None
        assert found.information is None


def test_views_of_different_places_have_none_either() -> None:
    rng = np.random.default_rng(2)
    query, match = rng.uniform(-0.5, 0.5, (2, 150, 2))
    assert solve(query, match).match_from_query is None
    assert solve(query[:10], match[:10]).match_from_query is None


def test_a_map_camera_that_stood_still_gives_direction_on_request() -> None:
    rng = np.random.default_rng(12)
    lens, place = camera(), scene(rng)
    poses = [pose(0.0)] * 5 + [pose(0.3, 0.4, yaw=0.1)]
    seen = [view(place, p, lens, rng) for p in poses]
    ledger = verify(proposals([(5, 2)]), keyframes(poses), lens, seen.__getitem__, KEEP)
    assert ledger.verdict == [Verdict.DEGENERATE_MOTION]
    assert ledger.scale == ["none"]
    b = lens.body_from_camera
    seen_motion = geometry.inverse(b) @ ledger.match_from_query[0] @ b  # the camera's motion, of length one
    true = geometry.inverse(b) @ geometry.between(poses[2], poses[5]) @ b
    assert np.linalg.norm(seen_motion[:3, 3]) == pytest.approx(1.0)
    assert geometry.angle(geometry.between(true, seen_motion)) < 0.01
    assert seen_motion[:3, 3] @ true[:3, 3] / np.linalg.norm(true[:3, 3]) > np.cos(0.1)
    plain = verify(proposals([(5, 2)]), keyframes(poses), lens, seen.__getitem__, VerifySettings())
    assert np.isnan(plain.match_from_query).all()


def test_derivatives_agree_with_differences() -> None:
    """Of the numerator over a fixed denominator, which is what the optimum needs: so at matches without error."""
    rng = np.random.default_rng(3)
    at = geometry.exp(rng.normal(0, 0.2, 6))
    query, match = rays(rng, at, 0.0, 6)
    x, y = (np.column_stack([p, np.ones(6)]) for p in (query, match))
    here, by_pose = verify_direction._sampson(at, x, y)
    np.testing.assert_allclose(here, 0.0, atol=1e-12)
    for axis in range(6):
        moved, _ = verify_direction._sampson(at @ geometry.exp(1e-6 * np.eye(6)[axis]), x, y)
        np.testing.assert_allclose(by_pose[:, axis], (moved - here) / 1e-6, atol=1e-4)
