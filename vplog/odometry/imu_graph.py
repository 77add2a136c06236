"""Motions of a camera and the measurements of an IMU in one graph, by GTSAM: gravity, the unit's metres, and gaps.

Pre-integrated IMU factors (Forster et al. 2017) are loosely coupled: states are related by the motions of the images,
too. The start is the linear alignment of Qin & Shen 2017 (Robust initialization of monocular visual-inertial
estimation). The IMU is the body of the graph: as a sensor beside the body GTSAM leaves out its angular acceleration,
and a lever of a metre turned gravity by 0.7 degrees.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, S, V, X
from scipy import sparse

from vplog.data import SCALE_WANDER, Bools, Floats, Imu, Ints
from vplog.geometry import se3

GRAVITY = 9.81
"""m/s^2; it varies by 0.3 % over the earth."""
_LONGEST_S = 20.0
"""s of a gap that is bridged, at most: the bias of an accelerometer, 0.05 m/s^2, moves it by 10 m."""
_HOLE_NS = 100_000_000
"""ns between two samples of an IMU beyond which the motion is not known."""
_ACCEL, _GYRO = 0.02, 0.002
"""Noise densities, m/s^2/sqrt(Hz) and rad/s/sqrt(Hz): ten times an ADIS16448's, with the vibration of a vehicle."""
_ACCEL_WALK, _GYRO_WALK = 0.003, 0.0002
"""Random walks of the biases, m/s^3/sqrt(Hz) and rad/s^2/sqrt(Hz): an ADIS16448's, the gyroscope's ten times."""
_ACCEL_BIAS, _GYRO_BIAS = 0.2, 0.02
"""Sigmas of the biases at the start: m/s^2 of a MEMS that no one calibrated; rad/s about what the images say."""
_ACROSS = 1.0
"""Sigma of the log of the scale across a break; that of the first state is three times it."""
_HUBER = 2.0
"""Sigmas beyond which a motion counts linearly."""
_DISAGREES = 3.0
"""Root of chi-square per degree of freedom from which the IMU and the images contradict each other."""
_ROUNDS = 20
"""Levenberg-Marquardt steps of each start; a good one takes five."""
_STARTS = (1.0, 3.0, 10.0, 0.3)
"""Factors of the linear scale that are tried until one converges: noise makes it too small, and the way from there to
a larger one is a long valley."""
_BIAS_LEFT = 0.02
"""m/s^2 of the accelerometer's bias that changes, at the start."""
_SHARE, _TURN_NOISE = 0.01, 0.0005
"""Error of a motion as a share of its length, and rad of its turn: what points err in together."""
_TILT = 0.02
"""m/s^2 by which gravity turns from state to state at the start, as the images drift."""
_FAR = 30.0
"""m, and m/s, of what no measurement tells."""
_SAMPLES = 9
"""States whose scale's sigma is taken."""


Preintegrated = gtsam.PreintegratedCombinedMeasurements


class States(NamedTuple):
    """Frames that are states of the graph."""

    rows: Ints
    """(K,) rows of the odometry."""
    cameras: Floats
    """(K, 4, 4) poses by the images."""
    imu_from_camera: Floats
    """(4, 4)."""
    covariance: Floats
    """(K, 6, 6) of the motion since the state before, in the camera."""
    broken: Bools
    """(K,) the motion since the state before is not known."""
    imu: list[Preintegrated | None]
    """(K,) since the state before; None where there is none."""


def _params() -> gtsam.PreintegrationCombinedParams:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    for covariance, density in (
        (params.setAccelerometerCovariance, _ACCEL),
        (params.setGyroscopeCovariance, _GYRO),
        (params.setBiasAccCovariance, _ACCEL_WALK),
        (params.setBiasOmegaCovariance, _GYRO_WALK),
    ):
        covariance(np.eye(3) * density**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-6)
    return params


def preintegrated(imu: Imu, first_ns: int, last_ns: int, bias: Floats) -> Preintegrated | None:
    """The samples between two stamps by the midpoint rule; None where there are too few."""
    a, b = np.searchsorted(imu.stamp_ns, [first_ns, last_ns], "right")
    ends = imu.stamp_ns[max(a - 1, 0) : b + 1]
    if (last_ns - first_ns) / 1e9 > _LONGEST_S or a < 1 or b >= len(imu.stamp_ns) or np.diff(ends).max() > _HOLE_NS:
        return None
    at = np.unique(np.concatenate([[first_ns], imu.stamp_ns[a:b], [last_ns]])) - first_ns
    middle = (at[1:] + at[:-1]) / 2.0
    since = imu.stamp_ns[max(a - 1, 0) : b + 1] - first_ns
    both = np.concatenate([imu.accel, imu.gyro], axis=1)[max(a - 1, 0) : b + 1]
    values = np.stack([np.interp(middle, since, column) for column in both.T], axis=1)
    result = Preintegrated(_params(), gtsam.imuBias.ConstantBias(np.zeros(3), bias))
    for value, seconds in zip(values, np.diff(at) / 1e9, strict=True):
        result.integrateMeasurement(value[:3], value[3:], seconds)
    return result


def gyro_bias(states: States) -> tuple[Floats, float]:
    """(3,) rad/s in the axes of the IMU, and the share of the images' turns that is explained with it."""
    rows = np.array([row for row, one in enumerate(states.imu) if one is not None and not states.broken[row]])
    turned = se3.so3_log(se3.between(states.cameras[rows - 1], states.cameras[rows])[:, :3, :3])
    turns = turned @ states.imu_from_camera[:3, :3].T
    gyro, seconds = _turns(states, rows)
    bias = np.median((gyro - turns) / seconds[:, None], axis=0)
    rest = gyro - turns - bias * seconds[:, None]
    noise = len(rows) * 3 * _TURN_NOISE**2
    return bias, 1.0 - max((rest**2).sum() - noise, 0.0) / max((turns**2).sum(), noise)


def _turns(states: States, rows: Ints) -> tuple[Floats, Floats]:
    """(R, 3) rad of the IMU since the state before, by the gyroscope, and (R,) s."""
    measured = [one for one in (states.imu[row] for row in rows.tolist()) if one is not None]
    gyro = np.stack([one.deltaRij().matrix() for one in measured])
    return se3.so3_log(gyro), np.array([one.deltaTij() for one in measured])


class _Start(NamedTuple):
    """Start of the solution, of the IMU in a world whose z is up."""

    poses: Floats
    """(K, 4, 4)."""
    velocities: Floats
    """(K, 3)."""
    log_scale: Floats
    """(K,) m of a unit."""


def _connected(states: States) -> Floats:
    """(K, 4, 4) poses by the images, each piece turned as the gyroscope has it since the last one."""
    poses = states.cameras.copy()
    for row in np.flatnonzero(states.broken).tolist():
        turn = np.eye(4)
        if (one := states.imu[row]) is not None:
            R = states.imu_from_camera[:3, :3]
            turn[:3, :3] = R.T @ one.deltaRij().matrix() @ R
        poses[row:] = poses[row - 1] @ turn @ se3.inverse(poses[row]) @ poses[row:]
    return poses


def _aligned(states: States, metric: bool) -> _Start:
    """Linear least squares of positions, velocities, gravity and scale with the rotations of the images."""
    poses = _connected(states)
    count = len(poses)
    scale = np.ones(count)
    for spread in (0.1, 1.0):  # one scale for all at first, which is the size of its changes then
        x = _linear(states, poses, scale, spread, metric)
        scale = np.where(x[:, 9] > 0, x[:, 9], np.median(np.abs(x[:, 9]))).clip(1e-3, 1e3)
    down = x[0, 6:9] / max(float(np.linalg.norm(x[0, 6:9])), 1e-9)
    level = np.eye(4)
    level[:3, :3] = _turn_to(-down)
    poses = poses @ se3.inverse(states.imu_from_camera)
    poses[:, :3, 3] = x[:, :3]
    return _Start(level @ poses, x[:, 3:6] @ level[:3, :3].T, np.zeros(count) if metric else np.log(scale))


def _turn_to(up: Floats) -> Floats:
    """(3, 3) the least turn that brings a direction to z."""
    axis, z = np.cross(up, [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / sine * np.arctan2(sine, float(up @ z)))


def _linear(states: States, poses: Floats, scale: Floats, spread: float, metric: bool) -> Floats:
    """(K, 10) position, velocity, gravity and scale of each state; `scale` (K,) is their size as known so far."""
    count = len(poses)
    rows: list[tuple[list[tuple[int, Floats]], Floats, float]] = []
    eye, steps = np.eye(3), np.diff(poses[:, :3, 3], axis=0)
    turns = poses[:, :3, :3] @ states.imu_from_camera[:3, :3].T
    lever = np.diff(turns @ states.imu_from_camera[:3, 3], axis=0)
    last = 10 * count  # of the accelerometer's bias
    for i, one in enumerate(states.imu[1:]):
        j, R = i + 1, turns[i]
        a, b = 10 * i, 10 * j
        way, size = float(np.linalg.norm(steps[i])), float(scale[j])
        if one is not None:
            t = float(one.deltaTij())
            sigma = _ACCEL * t**0.5 + _BIAS_LEFT * t
            rows.append(([(b + 3, eye), (a + 3, -eye), (a + 6, -eye * t), (last, R * t)], R @ one.deltaVij(), sigma))
            known = [(b, eye), (a, -eye), (a + 3, -eye * t), (a + 6, -eye * t**2 / 2), (last, R * t**2 / 2)]
            rows.append((known, R @ one.deltaPij(), sigma * t / 2))
        if not states.broken[j]:
            noise = size * float(np.sqrt(np.trace(states.covariance[j, 3:, 3:]) / 3.0) + _SHARE * way)
            rows.append(([(b, eye), (a, -eye), (b + 9, -steps[i][:, None])], -lever[i], noise))
        across = _ACROSS if states.broken[j] else spread * SCALE_WANDER * (way + 1e-3) ** 0.5
        rows.append(([(b + 9, np.ones((1, 1))), (a + 9, -np.ones((1, 1)))], np.zeros(1), across * size))
        rows.append(([(b + 6, eye), (a + 6, -eye)], np.zeros(3), spread * _TILT))
        if states.broken[j] and one is None:
            rows.append(([(b, eye), (a, -eye)], np.zeros(3), _FAR))
    rows.append(([(0, eye)], np.zeros(3), 1e-3))
    rows.append(([(last, eye)], np.zeros(3), _ACCEL_BIAS))
    rows.append(([(9, np.ones((1, 1)))], np.ones(1), 1e-6 if metric else 1e3))
    entries = list[tuple[int, int, float]]()
    right, top = list[float](), 0
    for blocks, value, sigma in rows:
        for column, block in blocks:
            for (r, c), number in np.ndenumerate(block):
                entries.append((top + r, column + c, number / sigma))
        right += (value / sigma).tolist()
        top += len(value)
    r, c, values = zip(*entries, strict=True)
    A = sparse.csc_array((values, (r, c)), (top, last + 3))
    normal = (A.T @ A).tocsc() + sparse.eye_array(last + 3, format="csc") * 1e-12
    x = sparse.linalg.spsolve(normal, A.T @ np.array(right))
    return x[:last].reshape(count, 10)


class Solved(NamedTuple):
    """The solution of the graph."""

    poses: Floats
    """(K, 4, 4) of the IMU."""
    log_scale: Floats
    """(K,)."""
    sigma: float
    """Standard deviation of the log of the scale, where it is least known."""
    broken: Floats
    """(B, 6, 6) covariance of each motion across a break, in the IMU."""


def solved(states: States, metric: bool) -> Solved | None:
    """The states that explain motions and measurements best, in units where the motions are not `metric`; None where
    these contradict each other."""
    start = _aligned(states, metric)
    graph, count = gtsam.NonlinearFactorGraph(), len(start.poses)
    first = next(one for one in states.imu if one is not None).biasHat()
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    held = diagonal(np.array([1.0, 1.0, 1e-3, 1e-3, 1e-3, 1e-3]))
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(start.poses[0]), _in_world(start.poses[0], held)))
    biases = diagonal(np.array([_ACCEL_BIAS] * 3 + [_GYRO_BIAS] * 3))
    graph.add(gtsam.PriorFactorConstantBias(B(0), first, biases))
    known = 1e-6 if metric else 3.0 * _ACROSS
    graph.add(gtsam.PriorFactorVector(S(0), np.zeros(1), diagonal(np.array([known]))))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    for i in range(count - 1):
        _add(graph, states, i, metric, huber)
    try:
        found, converged = _optimised(graph, start, first, metric)
        covariance = _Covariance(graph.linearize(found), count)
    except RuntimeError:  # an indeterminate system
        return None
    sigma = 0.0
    if not metric:
        bounds = [0, *np.flatnonzero(states.broken).tolist(), count]
        middles = [(a + b) // 2 for a, b in pairwise(bounds)]  # each piece has a scale of its own
        sampled = {*middles, *np.linspace(0, count - 1, _SAMPLES).round().astype(int).tolist()}
        sigma = float(np.sqrt(np.max([covariance.of([6 * count + k])[0, 0] for k in sorted(sampled)])))
    broken = [_relative(covariance, found, k) for k in np.flatnonzero(states.broken).tolist()]
    poses = np.stack([found.atPose3(X(k)).matrix() for k in range(count)])
    scale = np.array([found.atVector(S(k))[0] for k in range(count)])
    redundancy = sum(graph.at(k).dim() for k in range(graph.size())) - 16 * count
    factor = max(1.0, 2.0 * graph.error(found) / max(redundancy, 1)) ** 0.5
    if factor > _DISAGREES and converged:
        return None
    sigma = sigma * factor if converged or metric else np.inf
    return Solved(poses, scale, sigma, np.array(broken).reshape(-1, 6, 6) * factor**2)


def _optimised(
    graph: gtsam.NonlinearFactorGraph, start: _Start, bias: gtsam.imuBias.ConstantBias, metric: bool
) -> tuple[gtsam.Values, bool]:
    """The first solution that converges, from several scales, else the best; whether it did."""
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(_ROUNDS)
    settings.setRelativeErrorTol(1e-4)
    found = list[tuple[float, int, gtsam.Values]]()
    for number, factor in enumerate(_STARTS):
        values = gtsam.Values()
        for row, pose in enumerate(start.poses):
            values.insert(X(row), gtsam.Pose3(se3.stretched(pose, factor)))
            values.insert(V(row), start.velocities[row] * factor)
            values.insert(B(row), bias)
            values.insert(S(row), start.log_scale[row : row + 1] + np.log(factor))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, settings)
        result = optimizer.optimize()
        found.append((graph.error(result), number, result))
        if optimizer.iterations() < _ROUNDS:
            return result, True
        if metric:
            break
    return min(found, key=lambda one: one[:2])[2], False


def _in_world(pose: Floats, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """Noise whose turns are about the axes of the world, for a prior on the pose."""
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = pose[:3, :3].T
    return gtsam.noiseModel.Gaussian.Covariance(turned @ np.diag(noise.sigmas() ** 2) @ turned.T)


class _Covariance:
    """Marginal covariances of a solution with K states. (gtsam.Marginals calls chains of 800 states indeterminate.)"""

    def __init__(self, linear: gtsam.GaussianFactorGraph, count: int) -> None:
        rows, columns, values = linear.sparseJacobian_()  # keys in alphabetical order, then the right-hand side
        size = int(rows.max()), int(columns.max())
        A: Any = sparse.csc_array((values, (rows.astype(int) - 1, columns.astype(int) - 1)), size)[:, : 16 * count]
        self._solve = sparse.linalg.splu((A.T @ A).tocsc()).solve
        self.size = 16 * count

    def of(self, columns: list[int]) -> Floats:
        """(C, C) of some columns."""
        right = np.zeros((self.size, len(columns)))
        right[columns, range(len(columns))] = 1.0
        return self._solve(right)[columns]


def _relative(covariance: _Covariance, found: gtsam.Values, k: int) -> Floats:
    """(6, 6) covariance of the pose of a state in the one before it."""
    first = covariance.size // 16 * 10 + 6 * (k - 1)
    joint = covariance.of(list(range(first, first + 12)))
    moved = se3.between(found.atPose3(X(k)).matrix(), found.atPose3(X(k - 1)).matrix())
    both = np.hstack([-se3.adjoint(moved), np.eye(6)])
    return both @ joint @ both.T


def _add(graph: gtsam.NonlinearFactorGraph, states: States, i: int, metric: bool, huber: Any) -> None:
    """Factors between a state and the next."""
    j, isotropic = i + 1, gtsam.noiseModel.Isotropic.Sigma
    moved = se3.between(states.cameras[i], states.cameras[j])
    way = float(np.linalg.norm(moved[:3, 3]))
    across = _ACROSS if states.broken[j] else SCALE_WANDER * (way + 1e-3) ** 0.5
    wander = isotropic(1, 1e-6 if metric else across)
    graph.add(gtsam.BetweenFactorVector(S(i), S(j), np.zeros(1), wander))
    one = states.imu[j]
    if one is not None:
        graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), one))
    else:
        graph.add(gtsam.BetweenFactorConstantBias(B(i), B(j), gtsam.imuBias.ConstantBias(), isotropic(6, 0.01)))
        graph.add(gtsam.BetweenFactorPoint3(V(i), V(j), np.zeros(3), isotropic(3, _FAR)))
    if states.broken[j]:
        if one is None:
            far = gtsam.noiseModel.Diagonal.Sigmas(np.array([np.pi] * 3 + [_FAR] * 3))
            graph.add(gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(), far))
        return
    turned = np.eye(6)
    turned[3:, 3:] = moved[:3, :3]  # the translation in the axes of the state before
    covariance = turned @ states.covariance[j] @ turned.T
    covariance += np.diag([_TURN_NOISE**2] * 3 + [(_SHARE * way) ** 2 + 1e-8] * 3)
    noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(covariance))
    graph.add(gtsam.CustomFactor(noise, [X(i), X(j), S(j)], _motion_error(moved, states.imu_from_camera)))


def _motion_error(moved: Floats, imu_from_camera: Floats):
    """Error function of a motion in a unit of S: its rotation, then its translation in the unit."""
    R, t = moved[:3, :3], moved[:3, 3]
    ad = se3.adjoint(se3.inverse(imu_from_camera))

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[Floats] | None) -> Floats:
        a, b, s = this.keys()
        found = se3.between(*(values.atPose3(key).matrix() @ imu_from_camera for key in (a, b)))
        unit, turn = np.exp(-values.atVector(s)[0]), found[:3, :3]
        at = unit * found[:3, 3]
        if H is not None:
            H[0], H[1], H[2] = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 1))
            H[0][:3, :3], H[0][3:, :3], H[0][3:, 3:] = -turn.T, se3.skew(at[None])[0], -unit * np.eye(3)
            H[1][:3, :3], H[1][3:, 3:] = np.eye(3), unit * turn
            H[0], H[1] = H[0] @ ad, H[1] @ ad
            H[2][3:, 0] = -at
        return np.concatenate([se3.so3_log(R.T @ turn), at - t])

    return error
