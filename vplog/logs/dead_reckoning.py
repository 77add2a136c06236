"""Odometry of sensors that measure no pose: velocities added up, turned by a gyroscope, and positions of fixes."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from vplog.data import RECEIVER_SIGMA_M, UNKNOWN_VARIANCE, Floats, Gps, Ints, Odometry
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu
from vplog.logs.stamps import longest_gap_ns

_GYRO_GAP_NS = 100_000_000
"""ns between samples of a gyroscope within which a turn can begin and end."""
_AGREES = 0.5
"""Share of the variance of the turns that a gyroscope must explain."""
_SCALES = 0.2, 5.0
"""Its turns by those of the wheels: skid steering turns half as far as wheels tell; degrees are 57 times radians."""
_STANDING_M_S, _STANDING_RAD_S = 0.01, 0.02
"""m/s and rad/s; below both a vehicle stands: wheels resolve some mm/s, and a gyroscope's bias is below a degree/s."""
_SIDEWAYS_M_S2 = 30.0
"""m/s^2; speed times turn rate beyond what any vehicle bears for long: rates in degrees per second."""
_BIAS_RAD_S = 0.05
"""rad/s; where wheels tell a speed alone, what turns faster at no speed, and not always, turns on the spot."""
_UNEVEN_RAD_S = 0.1
"""rad/s; as fast as wheels of two sizes, 1 % apart, turn a straight drive at 15 m/s."""
_LEAST_STANDING_S = 1.0
"""s of standing in all, from which the mean of a gyroscope is its bias rather than its noise."""
_LEAST_FIXES = 5
"""Fixes that a smoothing spline is found for."""
_TOGETHER, _USUAL = 0.01, 0.75
"""Share of the time between fixes, by this quantile, within which they are of one moment, and the first is taken: the
curvature between two grows with the inverse square of the time, beyond what numbers reach. Two receivers have half of
their fixes close together."""
_LEAST_WAY = 6.0
"""Sigmas that the fixes extend over at least: noise at rest does not."""
_PERIOD_NS = 100_000_000
"""ns; between fixes the odometry has samples as often, so that bends are not cut."""
_GAP_PERIODS = 3.0
"""Times the median period between fixes, beyond which what happened there is not known."""
_SLOW = 0.1
"""Share of the drive's own speed (its 90 % quantile) below which a direction of motion is noise."""
_WINDOWS = (0.5, 300.0, 24)
"""Smoothing windows that are tried, in periods between fixes, and how many: hardly any, and as far as numbers reach."""
_PROBES = 16
"""Random signs by which the trace of the smoother is estimated (Hutchinson 1990): to a few percent of it."""
_LEVEL_RAD = 0.1
"""rad; sigma of roll and pitch, which positions leave unknown: roads are steep to 10 %."""


def dead_reckoned(stamp_ns: Ints, twists: Floats, variances: Floats, longest_ns: int | None = None) -> Odometry:
    """Velocities (T, 6), linear (m/s) then angular (rad/s) in the body's axes, added up by trapezoids; it breaks where
    there are none for longer than `longest_ns`, by their own stamps unless given, as of a recorder that was paused.

    `variances` (T, 6) of these, NaN or zero where unknown, become those of the increments, but for marks of axes that
    are not measured.
    """
    seconds = (np.diff(stamp_ns) / 1e9)[:, None]
    gap = np.diff(stamp_ns) > (longest_ns or longest_gap_ns(stamp_ns))
    moved = (twists[1:] + twists[:-1]) / 2 * np.where(gap[:, None], 0.0, seconds)
    step = se3.exp(moved[:, [3, 4, 5, 0, 1, 2]])
    poses = np.tile(np.eye(4), (len(stamp_ns), 1, 1))
    for row, one in enumerate(step, 1):
        np.matmul(poses[row - 1], one, out=poses[row])
    poses[:, :3, :3] = se3.rotation(se3.quaternion(poses[:, :3, :3]))  # rounding adds up over a long drive
    breaks = np.flatnonzero(gap) + 1
    known = np.isfinite(variances).all(1) & (variances >= 0).all(1) & (variances > 0).any(1)
    if not known.all():
        return Odometry(stamp_ns, poses, None, breaks=breaks)
    covariance = np.zeros((len(stamp_ns), 6, 6))
    each = variances[1:, [3, 4, 5, 0, 1, 2]]
    covariance[1:, range(6), range(6)] = np.where(each < UNKNOWN_VARIANCE, each * seconds**2, each)
    covariance[0] = covariance[1] if len(covariance) > 1 else 0.0
    return Odometry(stamp_ns, poses, covariance, breaks=breaks, increments=True)


def gyro_agrees(stamp_ns: Ints, twists: Floats, gyro_ns: Ints, gyro: Floats) -> bool:
    """Whether rates (K, 3) of a gyroscope are those of the body's velocities (T, 6), rad/s in its axes, but for a scale
    of wheels that slip; where the body does not turn, nothing contradicts them but a turn that no body bears."""
    since = stamp_ns[0]
    angle = scipy.integrate.cumulative_trapezoid(gyro, (gyro_ns - since) / 1e9, axis=0, initial=0.0)
    inside = (stamp_ns >= gyro_ns[0]) & (stamp_ns <= gyro_ns[-1])
    if inside.sum() < 2:
        return True
    at_ns, twists = stamp_ns[inside], twists[inside]
    seconds = np.diff(at_ns)[:, None] / 1e9
    turned = np.stack([np.interp(at_ns - since, gyro_ns - since, column) for column in angle.T], axis=1)
    measured, moving = np.diff(turned, axis=0) / seconds, (twists[1:] + twists[:-1]) / 2
    sideways = np.linalg.norm(np.cross(moving[:, :3], measured), axis=1)
    if np.quantile(sideways, 0.9) > _SIDEWAYS_M_S2:
        return False
    turning = moving[:, 3:]
    steady = float((measured * turning).sum() / max((turning**2).sum(), len(turning) * _STANDING_RAD_S**2))
    turned_by = np.median(turning, axis=0)
    measured, turning = measured - np.median(measured, axis=0), turning - turned_by
    axes = np.sqrt((turning**2).mean(0)) > _STANDING_RAD_S
    if not axes.any():  # of a slow turn less than a fifth may be right: wheels of two sizes turn a straight drive
        slow = np.linalg.norm(turned_by) < _UNEVEN_RAD_S
        return (-_SCALES[0] if slow else _SCALES[0]) < steady < _SCALES[1]
    measured, turning = measured[:, axes], turning[:, axes]
    common, own = float((measured * turning).sum()), float((turning**2).sum())
    return _SCALES[0] < common / own < _SCALES[1] and common**2 > _AGREES * own * float((measured**2).sum())


def turned_by_gyro(stamp_ns: Ints, twists: Floats, gyro_ns: Ints, gyro: Floats) -> tuple[Ints, Floats, float | None]:
    """Velocities (S, 6) at the samples of both, whose angular ones are those (K, 3) of a gyroscope, rad/s in the axes
    of the body, as long as it measures: a wheel's scale and slip no longer turn the drive. Nothing is made up within
    gaps of the velocities (T, 6). Stamps (S,), velocities, and the rad/s that the gyroscope is off at rest; None where
    the body never stands for long, and it is left in."""
    gaps = np.diff(stamp_ns) > longest_gap_ns(stamp_ns)
    behind = np.searchsorted(stamp_ns, gyro_ns).clip(1, len(stamp_ns) - 1)
    within = (gyro_ns >= stamp_ns[0]) & (gyro_ns <= stamp_ns[-1]) & ~gaps[behind - 1]
    at_ns = np.union1d(stamp_ns, gyro_ns[within])
    moving = _interpolated(at_ns, stamp_ns, twists)
    linear, turning = moving[:, :3], moving[:, 3:]
    next_one = np.searchsorted(gyro_ns, at_ns).clip(1, len(gyro_ns) - 1)
    measured = np.isin(at_ns, gyro_ns) | (
        (gyro_ns[0] <= at_ns) & (at_ns <= gyro_ns[-1])
        & (gyro_ns[next_one] - gyro_ns[next_one - 1] <= max(_GYRO_GAP_NS, 3 * np.median(np.diff(gyro_ns))))
    )  # fmt: skip
    rates = _interpolated(at_ns, gyro_ns, gyro)
    standing = (np.linalg.norm(linear, axis=1) < _STANDING_M_S) & (np.linalg.norm(turning, axis=1) < _STANDING_RAD_S)
    standing &= measured
    seconds = float(np.diff(at_ns)[standing[1:] & standing[:-1]].sum()) / 1e9
    bias = np.median(rates[standing], axis=0) if seconds >= _LEAST_STANDING_S else None
    if bias is not None and not twists[:, 3:].any():
        going = rates[measured & ~standing] - bias
        spread = np.subtract(*np.quantile(rates[standing], (0.95, 0.05), axis=0)).max()
        spread = max(spread, np.abs(np.median(going, axis=0)).max() if len(going) else 0.0)
        bias = None if min(spread, np.linalg.norm(bias)) > _BIAS_RAD_S else bias
    turning = np.where(measured[:, None], rates - (0.0 if bias is None else bias), turning)
    return at_ns, np.concatenate([linear, turning], axis=1), None if bias is None else float(np.linalg.norm(bias))


def _interpolated(at_ns: Ints, stamp_ns: Ints, values: Floats) -> Floats:
    """(S, D) of (T, D) values."""
    since = stamp_ns[0]
    return np.stack([np.interp(at_ns - since, stamp_ns - since, column) for column in values.T], axis=1)


def odometry_of_fixes(gps: Gps) -> Odometry | None:
    """The fixes as poses, x ahead and z up; None where they do not go far enough for a heading.

    Positions are smoothed, headings the directions of their motion, level. The covariance is that of an increment.
    """
    local = local_enu(gps)
    if len(local) >= _LEAST_FIXES:
        steps = np.diff(local.stamp_ns)
        apart = np.append(True, steps > _TOGETHER * np.quantile(steps, _USUAL))
        columns = ("stamp_ns", "enu_m", "covariance")
        local = replace(local, **{name: getattr(local, name)[apart] for name in columns})
    variance = local.covariance[:, range(3), range(3)]
    known = np.isfinite(variance) & (variance > 0)
    variance = np.where(known, variance, np.array([1.0, 1.0, 4.0]) * RECEIVER_SIGMA_M**2)
    sigma_m = float(np.sqrt(np.median(variance[:, :2])))  # horizontal, of the usual fix
    if len(local) < _LEAST_FIXES or np.hypot(*np.ptp(local.enu_m[:, :2], axis=0)) < _LEAST_WAY * sigma_m:
        return None
    fixed_s, at_ns = (local.stamp_ns - local.stamp_ns[0]) / 1e9, _between(local.stamp_ns)
    at_s = (at_ns - local.stamp_ns[0]) / 1e9
    level, height = (_smoothed(fixed_s, local.enu_m[:, axes], variance[:, axes]) for axes in ([0, 1], [2]))
    curve = scipy.interpolate.CubicSpline(fixed_s, np.concatenate([level.places, height.places], axis=1))
    places, velocity = curve(at_s), curve(at_s, 1)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    slow = _SLOW * float(np.quantile(speed, 0.9))
    moving = speed > slow
    yaw = np.interp(at_s, at_s[moving], np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0])))
    poses = se3.pose(se3.so3_exp(yaw[:, None] * np.array([0.0, 0.0, 1.0])), places)
    rates = _rates([level, height], float(fixed_s[-1]), np.maximum(speed, slow))
    each = rates * np.gradient(at_s)[:, None]
    return Odometry(at_ns, poses, each[:, :, None] * np.eye(6), drifts=False)


def _between(stamp_ns: Ints) -> Ints:
    """The stamps of fixes, and others between those that are no gap apart."""
    steps = np.diff(stamp_ns)
    parts = np.where(steps <= _GAP_PERIODS * np.median(steps), np.ceil(steps / _PERIOD_NS), 1).astype(np.int64)
    each = np.repeat(np.arange(len(steps)), parts)
    number = np.arange(len(each)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(stamp_ns[each] + number * steps[each] // parts[each], stamp_ns[-1])


class _Smooth(NamedTuple):
    """Smoothed fixes."""

    places: Floats
    """(T, A) m."""
    variance: float
    """m^2 of a fix, by what the fixes are off these."""
    parameters: float
    """Effective degrees of freedom, the trace of the smoother."""


def _smoothed(at_s: Floats, places: Floats, variance: Floats) -> _Smooth:
    """The (T, A) places that balance distance to the fixes and acceleration (Whittaker 1923; Eilers 2003), by the
    window of least generalised cross-validation (Craven and Wahba 1979)."""
    count, steps = len(at_s), np.diff(at_s)
    weight, period = 1.0 / variance.mean(1), float(np.median(steps))
    middle = (steps[1:] + steps[:-1]) / 2
    curvature = scipy.sparse.diags_array(
        [1 / (steps[:-1] * middle), -(1 / steps[:-1] + 1 / steps[1:]) / middle, 1 / (steps[1:] * middle)],
        offsets=[0, 1, 2], shape=(count - 2, count),
    )  # fmt: skip
    energy = (curvature.T @ scipy.sparse.diags_array(middle) @ curvature).tocsr()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (count, _PROBES))
    found, right = list[tuple[float, _Smooth]](), weight[:, None] * np.concatenate([places, signs], axis=1)
    for window_s in period * np.geomspace(*_WINDOWS):
        bands = float(np.median(weight)) * window_s**4 / period * np.stack(
            [np.append(energy.diagonal(k), np.zeros(k)) for k in range(3)]
        )  # fmt: skip
        bands[0] += weight
        solved = np.asarray(scipy.linalg.solveh_banded(bands, right, lower=True))
        trace = float((signs * solved[:, places.shape[1] :]).sum()) / _PROBES
        free = max(count - trace, 1e-9)
        smooth = solved[:, : places.shape[1]]
        chi2 = float((weight[:, None] * (smooth - places) ** 2).mean(1).sum())
        own = chi2 / free * float(np.median(variance.mean(1)))
        found.append((count * chi2 / free**2, _Smooth(smooth, own, max(trace, 2.0))))
    return min(found, key=lambda one: one[0])[1]


def _rates(axes: list[_Smooth], seconds: float, speed: Floats) -> Floats:
    """(K, 6) variances that a second of motion adds, rotation first, where the body has (K,) this speed in m/s.

    A smoother of p parameters leaves p/T of the variance of T fixes, in errors that last for a p-th of the drive: in
    less time they grow at most as a random walk that reaches twice that variance by then, and so do the direction's.
    """
    noise = [one.variance * one.parameters / len(one.places) for one in axes]
    lasting_s = [seconds / one.parameters for one in axes]
    level = 2 * _LEVEL_RAD**2 / lasting_s[0]
    rates = np.tile([level, level, 0.0, *(2 * noise[i] / lasting_s[i] for i in (0, 0, 1))], (len(speed), 1))
    rates[:, 2] = 2 * noise[0] / (speed * lasting_s[0]) ** 2 / lasting_s[0]
    return rates
