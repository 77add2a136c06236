"""SE(3) on stacks of (..., 4, 4) float64 matrices. Tangent vectors are rotation first (rad), then translation (m)."""

from __future__ import annotations

import numpy as np

from vplog.data import Floats

_SMALL_ANGLE = 1e-7
"""rad; below it the Taylor series is exact to double precision."""


def pose(rotation: Floats, translation: Floats) -> Floats:
    """(..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    result = np.zeros((*shape, 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def inverse(a_from_b: Floats) -> Floats:
    """b_from_a for rigid (..., 4, 4)."""
    rotation = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return pose(rotation, -(rotation @ a_from_b[..., :3, 3:])[..., 0])


def between(world_from_a: Floats, world_from_b: Floats) -> Floats:
    """a_from_b."""
    return inverse(world_from_a) @ world_from_b


def transform(a_from_b: Floats, points: Floats) -> Floats:
    """Points (..., 3) in b, moved to a."""
    return points @ np.swapaxes(a_from_b[..., :3, :3], -1, -2) + a_from_b[..., None, :3, 3]


def skew(v: Floats) -> Floats:
    """(..., 3, 3) with skew(v) @ x = cross(v, x)."""
    result = np.zeros((*v.shape[:-1], 3, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return result


def so3_exp(omega: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3): Rodrigues' formula."""
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    k = skew(omega)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * k + b * (k @ k)


def so3_log(rotation: Floats) -> Floats:
    """Rotation vectors (..., 3), angle in 0..pi, of rotation matrices (..., 3, 3)."""
    q = quaternion(rotation)  # through the quaternion: stable up to pi
    norm = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, q[..., 3:])
    scale = np.where(norm < _SMALL_ANGLE, 2.0, angle / np.where(norm < _SMALL_ANGLE, 1.0, norm))
    return np.asarray(q[..., :3] * scale, np.float64)


def exp(xi: Floats) -> Floats:
    """(..., 4, 4) of twists (..., 6): the exact exponential, as GTSAM's Pose3.Expmap."""
    omega, v = xi[..., :3], xi[..., 3:]
    return pose(so3_exp(omega), (left_jacobian(omega) @ v[..., None])[..., 0])


def log(a_from_b: Floats) -> Floats:
    """Twists (..., 6) of poses (..., 4, 4); the inverse of exp for angles below pi."""
    omega = so3_log(a_from_b[..., :3, :3])
    v = np.linalg.solve(left_jacobian(omega), a_from_b[..., :3, 3:])[..., 0]
    return np.asarray(np.concatenate([omega, v], axis=-1), np.float64)


def left_jacobian(omega: Floats) -> Floats:
    """V of the exponential: translation = V @ v."""
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    k = skew(omega)
    small = angle < 1e-5  # the quotient of c loses digits earlier than sin(x)/x does
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - angle**2 / 24.0, 0.5 * (np.sin(safe / 2.0) / (safe / 2.0)) ** 2)  # no 1 - cos
    c = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + b * k + c * (k @ k)


def adjoint(a_from_b: Floats) -> Floats:
    """(..., 6, 6) that moves a twist in b to a: exp(Ad xi) = T exp(xi) T^-1."""
    rotation = a_from_b[..., :3, :3]
    result = np.zeros((*a_from_b.shape[:-2], 6, 6))
    result[..., :3, :3] = rotation
    result[..., 3:, 3:] = rotation
    result[..., 3:, :3] = skew(a_from_b[..., :3, 3]) @ rotation
    return result


def interpolate(a: Floats, b: Floats, share: Floats) -> Floats:
    """The pose `share` (0..1, shape (...)) of the way along the geodesic from a to b."""
    return a @ exp(np.asarray(share)[..., None] * log(between(a, b)))


def interpolate_at(stamp_ns: np.ndarray, poses: Floats, at_ns: np.ndarray) -> Floats:
    """Poses at the stamps `at_ns`, (len(at_ns), 4, 4); `stamp_ns` increases and covers them."""
    right = np.clip(np.searchsorted(stamp_ns, at_ns), 1, len(stamp_ns) - 1)
    left = right - 1
    share = (at_ns - stamp_ns[left]) / (stamp_ns[right] - stamp_ns[left])
    result = interpolate(poses[left], poses[right], share)
    for end in (left, right):  # no rounding where a sample is hit
        hit = stamp_ns[end] == at_ns
        result[hit] = poses[end[hit]]
    return result


def angle(rotation: Floats) -> Floats:
    """Rotation angle in rad of (..., 3, 3) or (..., 4, 4)."""
    return np.asarray(np.linalg.norm(so3_log(rotation[..., :3, :3]), axis=-1), np.float64)


def quaternion(rotation: Floats) -> Floats:
    """(..., 4) x y z w with w >= 0 of rotation matrices (..., 3, 3). Shepperd 1978: the largest component first."""
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    rows = np.empty((*m.shape[:-2], 4, 4))  # 4 q q^T
    rows[..., 0, 0], rows[..., 1, 1], rows[..., 2, 2] = 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    rows[..., 3, 3] = 1 + (xx + yy + zz)
    for one, other in ((0, 1), (0, 2), (1, 2)):
        rows[..., one, other] = rows[..., other, one] = m[..., one, other] + m[..., other, one]
    for axis, (one, other) in enumerate(((2, 1), (0, 2), (1, 0))):
        rows[..., axis, 3] = rows[..., 3, axis] = m[..., one, other] - m[..., other, one]
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    each = rows.reshape(-1, 4, 4)
    q = each[np.arange(len(each)), best.ravel()].reshape(*best.shape, 4)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def rotation(q: Floats) -> Floats:
    """(..., 3, 3) of quaternions (..., 4) x y z w, normalised here; NaN where the quaternion is zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    return _matrices(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def vectors(poses: Floats) -> Floats:
    """(..., 7) position and quaternion x y z w, w >= 0, of poses (..., 4, 4)."""
    return np.concatenate([poses[..., :3, 3], quaternion(poses[..., :3, :3])], axis=-1)


def from_vectors(values: Floats) -> Floats:
    """Poses (..., 4, 4) of positions and quaternions (..., 7)."""
    return pose(rotation(values[..., 3:]), values[..., :3])


def _matrices(rows: list[list[Floats]]) -> Floats:
    """(..., R, C) of entries (...)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def stretched(poses: Floats, scale: float, body_from_camera: Floats | None = None) -> Floats:
    """Poses (..., 4, 4) with their translations multiplied; those of a camera on the body where one is given, so that
    its place there keeps its length."""
    body_from_camera = np.eye(4) if body_from_camera is None else body_from_camera
    result = inverse(body_from_camera) @ poses @ body_from_camera
    result[..., :3, 3] *= scale
    return np.asarray(body_from_camera @ result @ inverse(body_from_camera), np.float64)


def umeyama(source: Floats, target: Floats, with_scale: bool = False) -> tuple[Floats, float]:
    """target_from_source (4, 4) and the scale that align points (T, 3) with least squares: Umeyama 1991, eq. 40-43."""
    mean_source, mean_target = source.mean(0), target.mean(0)
    x, y = source - mean_source, target - mean_target
    u, d, vt = np.linalg.svd(y.T @ x / len(source))
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    r = (u * s) @ vt
    variance = (x**2).sum() / len(source)
    scale = float((d * s).sum() / variance) if with_scale and variance > 0 else 1.0
    return pose(r, mean_target - scale * r @ mean_source), scale


def align(source: Floats, target: Floats, body_from_camera: Floats | None) -> tuple[Floats, float]:
    """target_from_source (4, 4) of poses (T, 4, 4) by their positions, once they are `stretched` by the scale that
    aligns the camera's path; 1 without a camera."""
    scale = 1.0
    if body_from_camera is not None:
        scale = umeyama((source @ body_from_camera)[:, :3, 3], (target @ body_from_camera)[:, :3, 3], True)[1]
    return umeyama(stretched(source, scale, body_from_camera)[:, :3, 3], target[:, :3, 3])[0], scale


def mahalanobis2(error: Floats, covariance: Floats) -> Floats:
    """(K,) e^T C^-1 e of errors (K, d) with covariances (K, d, d)."""
    return (error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(1)


def far_origin(poses: Floats) -> Floats:
    """(3,) the whole kilometre at which positions of poses (R, 4, 4) begin that are written as float32, which has steps
    of half a metre where UTM's northings are."""
    return np.round(poses[:1, :3, 3], -3).sum(0)
