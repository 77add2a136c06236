"""SE(3) agrees with scipy's matrix functions, and its own parts with each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Floats


FEW = settings(max_examples=50, deadline=None)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Floats:
    """Axes of any direction; angles of all sizes up to pi, tiny ones and those just below pi among them."""
    axis = draw(arrays.arrays(np.float64, 3, elements=st.floats(-1, 1)))
    assume(np.linalg.norm(axis) > 1e-3)
    tiny = st.floats(-12, 0).map(lambda power: 10.0**power)
    angle = draw(st.one_of(st.just(0.0), st.floats(0, 3.14159), tiny, tiny.map(lambda t: max(np.pi - t, 0.0))))
    return axis / np.linalg.norm(axis) * angle


@st.composite
def twists(draw: st.DrawFn) -> Floats:
    return np.concatenate([draw(rotation_vectors()), draw(arrays.arrays(np.float64, 3, elements=st.floats(-100, 100)))])


def _hat(xi: Floats) -> Floats:
    x, y, z = xi[:3]
    return np.array([[0, -z, y, xi[3]], [z, 0, -x, xi[4]], [-y, x, 0, xi[5]], [0, 0, 0, 0]])


def _poses(seed: int, count: int) -> Floats:
    rng = np.random.default_rng(seed)
    return se3.exp(rng.normal(0, [1, 1, 1, 5, 5, 5], (count, 6)))


@FEW
@given(twists())
def test_exp_is_the_matrix_exponential(xi: Floats) -> None:
    np.testing.assert_allclose(se3.exp(xi), expm(_hat(xi)), rtol=0, atol=1e-14 * (10 + np.abs(xi).max()))


@pytest.mark.parametrize("angle", np.logspace(-9, 0, 40))
def test_small_turns_lose_no_digits(angle: float) -> None:
    xi = np.array([0.6 * angle, 0.0, -0.8 * angle, 1.0, -2.0, 3.0])
    np.testing.assert_allclose(se3.exp(xi), expm(_hat(xi)), rtol=0, atol=3e-15)


@FEW
@given(rotation_vectors())
def test_rotations_agree_with_scipy(omega: Floats) -> None:
    expected = Rotation.from_rotvec(omega)
    rotation = se3.so3_exp(omega)
    np.testing.assert_allclose(rotation, expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(se3.angle(rotation), np.linalg.norm(omega), atol=1e-14)
    back = se3.so3_log(rotation)
    # at pi the axis may turn round
    close = np.allclose(back, omega, rtol=0, atol=1e-13)
    assert close or (np.linalg.norm(omega) > np.pi - 1e-7 and np.allclose(back, -omega, rtol=0, atol=1e-6))


@FEW
@given(twists())
def test_log_undoes_exp(xi: Floats) -> None:
    pose = se3.exp(xi)
    np.testing.assert_allclose(se3.exp(se3.log(pose)), pose, atol=1e-11)
    if np.linalg.norm(xi[:3]) < 3.1:
        np.testing.assert_allclose(se3.log(pose), xi, atol=1e-11)


@FEW
@given(twists(), twists())
def test_the_adjoint_moves_a_twist(at: Floats, xi: Floats) -> None:
    pose = se3.exp(at)
    moved = se3.exp(se3.adjoint(pose) @ xi)
    np.testing.assert_allclose(moved, pose @ se3.exp(xi) @ se3.inverse(pose), atol=1e-9)


def test_stacks_are_done_row_by_row() -> None:
    a, b = _poses(1, 6).reshape(2, 3, 4, 4), _poses(2, 6).reshape(2, 3, 4, 4)
    for function in (se3.inverse, se3.log, se3.adjoint, se3.angle):
        whole = function(a)
        for at in np.ndindex(2, 3):
            np.testing.assert_array_equal(whole[at], function(a[at]))
    np.testing.assert_allclose(a @ se3.between(a, b), b, atol=1e-12)
    np.testing.assert_allclose(se3.inverse(a) @ a, np.broadcast_to(np.eye(4), a.shape), atol=1e-12)
    points = np.random.default_rng(3).normal(size=(2, 3, 5, 3))
    ones = np.concatenate([points, np.ones((2, 3, 5, 1))], axis=-1)
    expected = np.einsum("...ij,...pj->...pi", a, ones)[..., :3]
    np.testing.assert_allclose(se3.transform(a, points), expected, atol=1e-12)


def test_skew_is_the_cross_product() -> None:
    v, x = np.random.default_rng(0).normal(size=(2, 7, 3))
    np.testing.assert_allclose((se3.skew(v) @ x[..., None])[..., 0], np.cross(v, x), atol=1e-14)


def test_interpolation_starts_and_ends_where_it_should() -> None:
    a, b = _poses(4, 20), _poses(5, 20)
    np.testing.assert_allclose(se3.interpolate(a, b, np.zeros(20)), a, atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(a, b, np.ones(20)), b, atol=1e-11)
    middle = se3.interpolate(a, b, np.full(20, 0.5))
    np.testing.assert_allclose(se3.between(a, middle), se3.between(middle, b), atol=1e-11)


def test_interpolation_in_time() -> None:
    stamps = 1_700_000_000_000_000_000 + np.array([0, 10, 30, 31, 1000]) * 1_000_001
    poses = _poses(6, 5)
    np.testing.assert_array_equal(se3.interpolate_at(stamps, poses, stamps), poses)
    between = stamps[:-1] + np.diff(stamps) // 4
    expected = se3.interpolate(poses[:-1], poses[1:], (between - stamps[:-1]) / np.diff(stamps))
    np.testing.assert_allclose(se3.interpolate_at(stamps, poses, between), expected, atol=1e-12)
    assert se3.interpolate_at(stamps, poses, stamps[:0]).shape == (0, 4, 4)
    # steady motion is found again at any time
    steady = se3.exp(np.linspace(0, 1, 5)[:, None] * [0.3, -0.2, 0.5, 1.0, 2.0, 3.0])
    at = np.linspace(0, 4000, 33).astype(np.int64)
    expected = se3.exp(at[:, None] / 4000 * [0.3, -0.2, 0.5, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(se3.interpolate_at(np.arange(5) * 1000, steady, at), expected, atol=1e-12)


@FEW
@given(rotation_vectors())
def test_quaternions_go_there_and_back(omega: Floats) -> None:
    rotation = Rotation.from_rotvec(omega).as_matrix()
    q = se3.quaternion(rotation)
    assert q[3] >= 0
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(se3.rotation(q), rotation, atol=1e-14)
    np.testing.assert_allclose(se3.rotation(-3.0 * q), rotation, atol=1e-14)
    expected = Rotation.from_rotvec(omega).as_quat()
    assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < 1e-14


def test_half_turns_about_the_axes() -> None:
    for axis in np.eye(3):
        rotation = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(se3.so3_log(rotation)), np.pi * axis, atol=1e-15)


def test_a_zero_quaternion_is_no_rotation() -> None:
    assert np.isnan(se3.rotation(np.zeros(4))).all()


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("rank", [3, 2])
@pytest.mark.parametrize("scale", [1.0, 0.2, 7.0])
def test_umeyama_finds_the_transform(seed: int, rank: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, rank)) @ rng.normal(size=(rank, 3)) + rng.normal(size=3) * 10
    pose = _poses(seed, 1)[0]
    target = scale * source @ pose[:3, :3].T + pose[:3, 3]
    found, found_scale = se3.umeyama(source, target, with_scale=True)
    np.testing.assert_allclose(found, pose, atol=1e-9)
    assert found_scale == pytest.approx(scale)
    if scale == 1.0:
        rigid, one = se3.umeyama(source, target)
        np.testing.assert_allclose(rigid, pose, atol=1e-9)
        assert one == 1.0


@pytest.mark.parametrize("seed", range(10))
def test_umeyama_never_reflects(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(8, 3))
    line = np.outer(rng.normal(size=8), [1.0, 2.0, 3.0])
    plane = cloud * [1.0, 1.0, 0.0]
    for source, target in (
        (cloud, cloud * [1, 1, -1]),  # a mirror image
        (plane, plane * [1, -1, 1]),
        (line, -line),
        (line, line[::-1].copy()),
        (cloud[:1], cloud[1:2]),
        (np.ones((4, 3)), np.zeros((4, 3))),
        (plane, cloud),
    ):
        for with_scale in (False, True):
            pose, scale = se3.umeyama(source, target, with_scale)
            assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
            assert np.isfinite(scale)


def test_umeyama_is_the_least_squares_fit() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(30, 3))
    target = se3.transform(_poses(1, 1)[0], source) + rng.normal(0, 0.2, (30, 3))
    best, _ = se3.umeyama(source, target)

    def error(pose: Floats) -> float:
        return float(((se3.transform(pose, source) - target) ** 2).sum())

    for step in rng.normal(0, 0.05, (200, 6)):
        assert error(best @ se3.exp(step)) > error(best)
