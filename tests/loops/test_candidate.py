from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.geometry import se3
from vplog.loops import candidate


def covariance(rng: np.random.Generator, sigma: float = 0.01) -> np.ndarray:
    root = rng.normal(size=(6, 6))
    return sigma**2 * (root @ root.T + 0.5 * np.eye(6))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_turned_round_twice_is_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, noise = se3.exp(rng.normal(0, 0.5, 6)), covariance(rng)
    there = candidate.reversed_pose(pose, noise)
    back = candidate.reversed_pose(*there)
    np.testing.assert_allclose(back[0], pose, atol=1e-9)
    np.testing.assert_allclose(back[1], noise, atol=1e-12)


def test_the_reverse_has_the_covariance_of_its_samples() -> None:
    rng = np.random.default_rng(0)
    pose, noise = se3.exp(rng.normal(0, 0.5, 6)), covariance(rng, 1e-3)
    error = rng.multivariate_normal(np.zeros(6), noise, 20_000)
    reverse, claimed = candidate.reversed_pose(pose, noise)
    seen = se3.log(se3.between(reverse, se3.inverse(pose @ se3.exp(error))))
    np.testing.assert_allclose(np.cov(seen.T), claimed, atol=0.05 * np.abs(claimed).max())


def test_noise_agrees_and_an_error_does_not() -> None:
    rng = np.random.default_rng(1)
    pose, a, b = se3.exp(rng.normal(0, 0.5, 6)), covariance(rng), covariance(rng)
    agreed = [
        candidate.agree(
            pose @ se3.exp(rng.multivariate_normal(np.zeros(6), a)),
            a,
            pose @ se3.exp(rng.multivariate_normal(np.zeros(6), b)),
            b,
        )
        for _ in range(500)
    ]
    assert np.mean(agreed) > 0.98
    values, vectors = np.linalg.eigh(a + b)
    wrong = pose @ se3.exp(6.0 * np.sqrt(values[-1]) * vectors[:, -1])  # 6 sigmas where it is least sure
    assert not candidate.agree(pose, a, wrong, b)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-1.0, 1.0))
def test_never_too_sure_however_the_errors_are_shared(seed: int, shared: float) -> None:
    """With any correlation of the two, the error of what they say together is no larger than claimed."""
    rng = np.random.default_rng(seed)
    pose, a, b = se3.exp(rng.normal(0, 0.5, 6)), covariance(rng), covariance(rng)
    _, claimed = candidate.covariance_intersection(pose, a, pose, b)
    # the step is linear in the errors: recover its weights from how unit errors move the result
    move = np.array(
        [se3.log(se3.between(pose, candidate.covariance_intersection(pose, a, pose @ e, b)[0])) for e in _unit()]
    )
    gain = move.T / 1e-4
    cross = shared * np.linalg.cholesky(a) @ np.linalg.cholesky(b).T  # |shared| <= 1 keeps the joint one a covariance
    keep = np.eye(6) - gain
    real = keep @ a @ keep.T + gain @ b @ gain.T + keep @ cross @ gain.T + (keep @ cross @ gain.T).T
    assert np.linalg.eigvalsh(claimed - real).min() > -1e-3 * np.trace(claimed)
    assert np.linalg.slogdet(claimed)[1] <= min(np.linalg.slogdet(a)[1], np.linalg.slogdet(b)[1]) + 1e-6


def _unit() -> np.ndarray:
    return se3.exp(1e-4 * np.eye(6))


def test_one_that_is_better_in_every_direction_is_taken_alone() -> None:
    rng = np.random.default_rng(2)
    pose, good = se3.exp(rng.normal(0, 0.5, 6)), covariance(rng)
    other = pose @ se3.exp(rng.normal(0, 0.01, 6))
    for first in (True, False):
        pair = (pose, good, other, 4 * good) if first else (other, 4 * good, pose, good)
        fused, claimed = candidate.covariance_intersection(*pair)
        np.testing.assert_allclose(fused, pose, atol=1e-5)
        np.testing.assert_allclose(claimed, good, rtol=1e-4, atol=1e-12)


def test_equals_meet_in_the_middle() -> None:
    rng = np.random.default_rng(3)
    noise, step = covariance(rng), np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0])
    fused, claimed = candidate.covariance_intersection(np.eye(4), noise, se3.exp(step), noise)
    np.testing.assert_allclose(claimed, noise, rtol=1e-9)
    # any weight is as good where both are equally sure: somewhere between the two
    assert se3.log(fused)[3] == pytest.approx(np.clip(se3.log(fused)[3], 0.0, 0.02))
