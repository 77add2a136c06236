"""GPS fixes as factors of a pose graph: the keyframe of each, and which are inliers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from pydantic import Field

from vplog.data import RECEIVER_SIGMA_M, Bools, Floats, Gps, Ints, Keyframes, Odometry
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu
from vplog.graph.build import informed
from vplog.graph.consistency import chi2_quantile
from vplog.graph.factors import Factors
from vplog.graph.least_squares import GAUGE_SIGMA, Objective, Positions, minimised
from vplog.graph.marginals import positions_redundancy
from vplog.graph.robust_kernels import truncated_weights
from vplog.graph.variance_components import most_likely_variance
from vplog.settings import Settings

NO_FIXES = "The log has no GPS fixes to use. `vplog info` lists the topics; run without --gps."
_LEAST = 3
"""Fixes that fix where a graph is and how it is turned."""
_VERTICAL_SIGMA = 0.1
"""rad; how far a body's vertical is from the plumb line, the mean over a drive: vehicles within some 3 degrees, what is
held or mounted askew within some 10. It tells the turn about a straight road, which fixes leave open, and little beside
what they tell of a road that bends."""
_MOST_EVALUATIONS = 100
"""Evaluations of the errors for one frame; 3 are usual, many where hardly anything tells the slope of the ground."""
_FORWARD = 0.7
"""Share of the way along the body's z from which it is a camera's optical axis, with y down: within 45 degrees."""
_JUMP = 2
"""Fixes one after the other that are left out where one jumps; fewer are noise."""
_MOST_JUMPS = 10
"""Jumps that are tried: each costs a few solves."""
_TESTS = 5
"""Most tests of the fixes by a solution of those that passed the last one; 2 are usual."""
_NOISE_ROUNDS = 4
"""Most rounds of estimating the noise of the fixes and testing them by it: sound ones were left out as outliers where
it was claimed too small."""
_STEADY = 0.2
"""Change of the covariance in a round, as a share, below which it is settled."""
_UNLIKE = 0.1
"""Autocorrelation below which errors are taken as uncorrelated."""
_MOST_CORRELATED = 0.99
"""Correlation of the errors of fixes that follow each other, most."""


class GpsSettings(Settings):
    """GPS as constraints. Off, a log's GPS changes nothing."""

    use: bool = False
    """Whether fixes take part: `vplog run --gps`."""
    unknown_sigma_m: float = Field(default=RECEIVER_SIGMA_M, gt=0)
    """Horizontal noise of a fix whose covariance is unknown or zero: 3 m is an open sky without corrections; twice
    that upwards, as satellites are above only."""
    least_sigma_m: float = Field(default=0.02, gt=0)
    """No fix is taken for better: 2 cm is carrier phase at its best, and receivers claim less."""
    inlier_probability: float = Field(default=0.99, gt=0, lt=1)
    """A sound fix is kept with this probability: its chi-square of 3 degrees stays below that quantile (11.3)."""
    reach_s: float = Field(default=2.0, gt=0)
    """A fix hangs on a keyframe at most this far away in time, by the odometry in between."""
    growth: float = Field(default=2.0, gt=1)
    """Factor by which the loss comes closer to the truncated one at each stage, as in `solve`."""
    max_stages: int = Field(default=40, ge=1)
    """Stages after which it gives up."""


@dataclass(frozen=True, eq=False)
class Fixes:
    """F fixes, each on a keyframe."""

    row: Ints
    """(F,) keyframe."""
    arm_m: Floats
    """(F, 3) where the antenna was, in the frame of that keyframe's body."""
    enu_m: Floats
    """(F, 3) east, north, up of the first fix of the log."""
    covariance: Floats
    """(F, 3, 3) m^2 of the same axes."""
    up: Floats
    """(3,) axis of the body that points up."""
    origin: tuple[float, float, float]
    """Latitude, longitude in degrees, altitude in m of the first fix."""
    settings: GpsSettings
    warnings: list[str]
    alike: float = 1.0
    """Correlated fixes with the information of one, by which the covariance is multiplied: GPS errors wander."""

    def __len__(self) -> int:
        return len(self.row)


def fixes_on(gps: Gps | None, odometry: Odometry, keyframes: Keyframes, settings: GpsSettings) -> Fixes:
    """The fixes of a log on the keyframes nearest in time. Raises GraphError where fewer than three are within reach.

    No odometry leads across a break, so fixes stay in their piece of it, and those within a break are left out.
    Fixes that share a keyframe share the information of one: their errors are those of the same satellites.
    """
    keys, warnings = keyframes.stamp_ns, []
    if gps is None:
        raise GraphError(NO_FIXES)
    local = local_enu(gps)
    begin, end = odometry.stamp_ns[odometry.breaks], odometry.stamp_ns[odometry.breaks - 1]  # of what breaks part
    inside = (local.stamp_ns >= odometry.stamp_ns[0]) & (local.stamp_ns <= odometry.stamp_ns[-1])
    inside &= end.searchsorted(local.stamp_ns, "left") == begin.searchsorted(local.stamp_ns, "right")
    stamps = local.stamp_ns[inside]
    piece, of_key = begin.searchsorted(stamps, "right"), begin.searchsorted(keys, "right")
    after = np.clip(np.searchsorted(keys, stamps), 1, len(keys) - 1)
    is_after = stamps - keys[after - 1] > keys[after] - stamps
    own_before, own_after = of_key[after - 1] == piece, of_key[after] == piece
    row = after - 1 + np.where(own_before == own_after, is_after, own_after)
    near = (np.abs(stamps - keys[row]) <= settings.reach_s * 1e9) & (of_key[row] == piece)
    if near.sum() < _LEAST:
        raise GraphError(
            f"{int(near.sum())} of {len(gps.stamp_ns)} GPS fixes are within {settings.reach_s:g} s of a keyframe, and "
            f"{_LEAST} are needed. Run without --gps, or set gps.reach_s higher."
        )
    stamps, row = stamps[near], row[near]
    if gps.antenna_m is None:
        warnings.append("The log does not say where the GPS antenna is on the body; it is taken to be at its origin.")
    then = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, stamps)
    key_from_then = se3.between(keyframes.odom_from_body[row], then)
    antenna = np.zeros(3) if gps.antenna_m is None else gps.antenna_m
    covariance, unknown = _usable(local.covariance[inside][near], settings)
    if unknown:
        warnings.append(
            f"{unknown} of {len(row)} GPS fixes have no usable covariance, or a variance of 0 on an axis; "
            f"{settings.unknown_sigma_m:g} m is assumed there."
        )
    alike = np.bincount(row, minlength=len(keys))[row]
    return Fixes(
        row.astype(np.int64),
        key_from_then[:, :3, :3] @ antenna + key_from_then[:, :3, 3],
        local.enu_m[inside][near],
        covariance * alike[:, None, None],
        _up(keyframes.odom_from_body),
        local.origin,
        settings,
        warnings,
    )


def _usable(covariance: Floats, settings: GpsSettings) -> tuple[Floats, int]:
    """(F, 3, 3) positive definite, and how many are assumed, whole or on an axis: 2D receivers write 0 for altitude."""
    assumed = np.diag(np.array([1.0, 1.0, 4.0]) * settings.unknown_sigma_m**2)
    finite: Bools = np.asarray(np.isfinite(covariance).all((1, 2)))
    symmetric = np.where(finite[:, None, None], (covariance + np.swapaxes(covariance, 1, 2)) / 2, np.eye(3))
    missing = np.diagonal(symmetric, axis1=1, axis2=2) == 0
    symmetric = np.where(missing[:, :, None] | missing[:, None, :], assumed, symmetric)
    values, vectors = np.linalg.eigh(symmetric)
    sound = finite & (values[:, 0] >= 0)
    values = np.maximum(values, settings.least_sigma_m**2)
    fixed = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.where(sound[:, None, None], fixed, assumed), int((~sound | missing.any(1)).sum())


def _up(poses: Floats) -> Floats:
    """(3,) axis of the body that points up: z (REP 103), or where it moves along z as a camera that looks ahead, -y."""
    moved = se3.between(poses[:-1], poses[1:])[:, :3, 3]
    ahead = abs(moved[:, 2].sum()) > _FORWARD * np.linalg.norm(moved, axis=1).sum()
    return np.array([0.0, -1.0, 0.0] if ahead else [0.0, 0.0, 1.0])


def antennas(poses: Floats, fixes: Fixes) -> Floats:
    """(F, 3) where the antenna was by the poses (N, 4, 4)."""
    on = poses[fixes.row]
    return (on[:, :3, :3] @ fixes.arm_m[:, :, None])[:, :, 0] + on[:, :3, 3]


def world_from_enu(poses: Floats, fixes: Fixes, weight: Floats) -> Floats:
    """(4, 4) rigid motion from the plane of the first fix to the world of the poses, the likeliest by the covariances
    of the weighted fixes and the body's vertical, of `_VERTICAL_SIGMA`.

    Umeyama 1991, eq. 40-43, with the mean variance of each fix, then Levenberg-Marquardt with the whole covariances.
    """
    target, confidence = antennas(poses, fixes), 3.0 * weight / np.trace(fixes.covariance, axis1=1, axis2=2)
    vertical = (poses[fixes.row, :3, :3] @ fixes.up).mean(0)
    share = confidence / confidence.sum()
    middle, target_middle = share @ fixes.enu_m, share @ target
    spread = (confidence[:, None] * (target - target_middle)).T @ (fixes.enu_m - middle)
    spread[:, 2] += vertical / _VERTICAL_SIGMA**2
    left, _, right = np.linalg.svd(spread)
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    root = np.sqrt(weight)[:, None, None] * np.linalg.cholesky(np.linalg.inv(fixes.covariance), upper=True)

    antenna, measured = target - target_middle, fixes.enu_m - middle

    def turned(x: Floats) -> Floats:
        return rotation.T @ se3.so3_exp(x[:3])

    def error(x: Floats) -> Floats:
        R = turned(x)
        off = antenna @ R.T + x[3:] - measured
        tilt = (R @ vertical - [0.0, 0.0, 1.0]) / _VERTICAL_SIGMA
        return np.concatenate([(root @ off[:, :, None]).ravel(), tilt])

    def jacobian(x: Floats) -> Floats:
        around = turned(x), se3.left_jacobian(-x[:3])  # R exp(w + d) = R exp(w) exp(J(-w) d)
        moved, tilted = (-around[0] @ se3.skew(v) @ around[1] for v in (antenna, vertical))
        of_fixes = np.concatenate([root @ moved, root], axis=2).reshape(-1, 6)
        of_tilt = np.column_stack([tilted, np.zeros((3, 3))]) / _VERTICAL_SIGMA
        return np.asarray(np.concatenate([of_fixes, of_tilt]), np.float64)

    found = scipy.optimize.least_squares(
        error, np.zeros(6), jacobian, method="lm", x_scale="jac", max_nfev=_MOST_EVALUATIONS
    ).x
    enu_from_world = se3.pose(turned(found), found[3:])
    return se3.pose(np.eye(3), target_middle) @ se3.inverse(enu_from_world) @ se3.pose(np.eye(3), -middle)


def chi2_of_fixes(poses: Floats, fixes: Fixes, world: Floats) -> Floats:
    """(F,) squared Mahalanobis distance of the fixes, moved to the world of the poses, to the antenna."""
    error = (antennas(poses, fixes) - world[:3, 3]) @ world[:3, :3] - fixes.enu_m
    return se3.mahalanobis2(error, fixes.covariance)


def with_fixes(factors: Factors, weight: Floats, start: Floats, fixes: Fixes, inlier: Floats) -> Objective:
    """The weighted edges (E,) with the fixes (F,), weighted, in the world of `start`, and pose 0 free to move."""
    first_from_enu = se3.inverse(start[0]) @ world_from_enu(start, fixes, inlier)
    R = first_from_enu[:3, :3]
    Omega = np.linalg.inv(R @ fixes.covariance @ R.T) * inlier[:, None, None]
    up = np.tile(fixes.up, (len(fixes), 1))
    plumb = np.tile(np.eye(3) / (_VERTICAL_SIGMA**2 * len(fixes)), (len(fixes), 1, 1))
    return Objective(
        factors,
        weight,
        positions=Positions(fixes.row, fixes.arm_m, se3.transform(first_from_enu, fixes.enu_m), Omega),
        verticals=Positions(fixes.row, up, np.tile(R[:, 2], (len(fixes), 1)), plumb, directions=True),
    )


def inlier_fixes(factors: Factors, weight: Floats, start: Floats, fixes: Fixes) -> tuple[Floats, Floats]:
    """Poses (N, 4, 4), pose 0 as given, and the inliers (F,) among the fixes, 0 or 1.

    Graduated non-convexity with the truncated least squares loss (Yang et al., RA-L 2020) over the fixes, the edges
    keeping their weights. The first solve uses all of them, so their frame is found whatever the odometry drifted. A
    fix is judged by the noise that most have where that is more than they claim. Raises GraphError where hardly any
    agree.
    """
    settings, inlier, poses = fixes.settings, np.ones(len(fixes)), start
    bound, mu = chi2_quantile(settings.inlier_probability, 3), 0.0
    for _ in range(settings.max_stages):
        poses = minimised(with_fixes(factors, weight, poses, fixes, inlier), poses, 20, 1e-4).world_from_body
        chi2 = chi2_of_fixes(poses, fixes, world_from_enu(poses, fixes, np.maximum(inlier, 1e-9)))
        chi2 = chi2 / max(float(np.median(chi2)) / chi2_quantile(0.5, 3), 1.0)
        mu = bound / max(2.0 * chi2.max() - bound, bound) if mu == 0.0 else mu * settings.growth  # remark 5
        inlier = truncated_weights(chi2, bound, mu)
        if ((inlier == 0) | (inlier == 1)).all():
            break
    inlier = np.where(inlier > 0.5, 1.0, 0.0)
    _check_enough(inlier)
    return _without_jumps(factors, weight, poses, fixes, inlier)


def _without_jumps(
    factors: Factors, weight: Floats, poses: Floats, fixes: Fixes, inlier: Floats
) -> tuple[Floats, Floats]:
    """Poses and inliers (F,) of a lower cost, without jumps whose middle the odometry was bent to.

    Sound fixes before and after such a jump were left out, so each run of inliers between two that were is tried
    without, the shortest first.
    """
    bound = chi2_quantile(fixes.settings.inlier_probability, 3)

    def tested(poses: Floats, inlier: Floats) -> tuple[float, Floats, Floats]:
        for _ in range(_TESTS):
            poses = minimised(with_fixes(factors, weight, poses, noisy, inlier), poses, 20, 1e-4).world_from_body
            chi2 = chi2_of_fixes(poses, noisy, world_from_enu(poses, noisy, np.maximum(inlier, 1e-9)))
            before, inlier = inlier, (chi2 <= bound).astype(float)
            if inlier.sum() < _LEAST or (inlier == before).all():
                break
        cost = with_fixes(factors, weight, poses, noisy, np.maximum(inlier, 1e-9)).cost(se3.between(poses[:1], poses))
        return cost + 0.5 * bound * float((1.0 - inlier).sum()), poses, inlier

    chi2 = chi2_of_fixes(poses, fixes, world_from_enu(poses, fixes, np.maximum(inlier, 1e-9)))
    noise = max(float(np.median(chi2)) / chi2_quantile(0.5, 3), 1.0)
    noisy = replace(fixes, covariance=fixes.covariance * noise)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inlier, [0]])))
    runs = [np.arange(first, last) for first, last in edges.reshape(-1, 2).tolist()]
    between = [
        run
        for before, run, after in zip(runs[:-2], runs[1:-1], runs[2:], strict=True)
        if run[0] - before[-1] > _JUMP and after[0] - run[-1] > _JUMP and len(run) < len(fixes) / 2
    ]
    if not between:
        return poses, inlier
    best = tested(poses, inlier)
    for run in sorted(between, key=len)[:_MOST_JUMPS]:
        without = np.array(best[2])
        without[run] = 0.0
        if without.sum() >= _LEAST:
            best = min(best, tested(best[1], without), key=lambda one: one[0])
    _check_enough(best[2])
    return best[1:]


def _check_enough(inlier: Floats) -> None:
    if inlier.sum() < _LEAST:
        raise GraphError(
            f"Only {int(inlier.sum())} of {len(inlier)} GPS fixes agree with the odometry and each other. "
            "Run without --gps, or set gps.unknown_sigma_m to the receiver's accuracy."
        )


def with_noise_of(fixes: Fixes, inlier: Floats, poses: Floats, checks: float) -> tuple[Fixes, Floats, float]:
    """The fixes with the covariance that residuals at the least squares `poses` imply, their inliers (F,), its factor.

    `checks` are the degrees of freedom with which odometry and closures check the inliers (positions_redundancy).
    GPS errors are correlated in time: fixes with correlated errors count for less, by the sum of the autocorrelation
    of their residuals as far as it is positive (Geyer, Practical Markov Chain Monte Carlo, 1992).
    """
    world = world_from_enu(poses, fixes, np.maximum(inlier, 1e-9))
    white = _whitened(poses, fixes, inlier)
    power, alike = max(float((white**2).mean()), 1e-12), 1.0
    for lag in range(1, len(white) // 4):
        share = float((white[lag:] * white[:-lag]).mean()) / power
        if share < _UNLIKE:
            break
        alike += 2.0 * share
    checks = min(max(checks, 0.0), float(white.size))
    factor = most_likely_variance(power * white.size / alike, checks / alike) * alike
    fixes = replace(fixes, covariance=fixes.covariance * factor, alike=alike)
    chi2 = chi2_of_fixes(poses, fixes, world) * alike
    inlier = (chi2 <= chi2_quantile(fixes.settings.inlier_probability, 3)).astype(float)
    _check_enough(inlier)
    return fixes, inlier, factor


def _whitened(poses: Floats, fixes: Fixes, inlier: Floats) -> Floats:
    """(K, 3) errors of the inliers (F,), 0 or 1, in their sigma."""
    world, sound = world_from_enu(poses, fixes, np.maximum(inlier, 1e-9)), np.flatnonzero(inlier)
    error = ((antennas(poses, fixes) - world[:3, 3]) @ world[:3, :3] - fixes.enu_m)[sound]
    root = np.linalg.cholesky(np.linalg.inv(fixes.covariance[sound]), upper=True)
    return (root @ error[:, :, None])[:, :, 0]


def _autoregressive_cost(white: Floats) -> float:
    """Negative log density, but for a constant, of errors (K, 3) in sigmas of a first-order autoregression, which is
    the likeliest of no less noise."""
    after, before = white[1:], white[:-1]
    rho = min(max(float((after * before).sum() / max((before**2).sum(), 1e-12)), 0.0), _MOST_CORRELATED)
    innovation = np.concatenate([white[:1], (after - rho * before) / math.sqrt(1.0 - rho**2)])
    variance = max(float((innovation**2).mean()), 1.0)
    log_volume = white.size * math.log(variance) + after.size * math.log(1.0 - rho**2)
    return 0.5 * (float((innovation**2).sum()) / variance + log_volume)


def noisier(fixes: Fixes, estimated: Fixes | None) -> Fixes:
    """The fixes with the larger covariance, of two sets that differ by a factor."""
    return fixes if estimated is None or _times_noisier(estimated, fixes) <= 1.0 else estimated


def _times_noisier(fixes: Fixes, others: Fixes) -> float:
    """Factor of the covariance, of two sets that differ by one."""
    return float(fixes.covariance[0, 0, 0] / others.covariance[0, 0, 0])


def cost_of_fixes(factors: Factors, weight: Floats, poses: Floats, fixes: Fixes) -> float:
    """By how much the log density is less with the fixes than that of the weighted edges (E,), least at `poses`.

    But for a constant; the fixes' noise is the likeliest where that is more than `fixes` have, and outliers count as at
    the bound of inliers.
    """
    most, known, change = 0.5 * chi2_quantile(fixes.settings.inlier_probability, 3), fixes, math.inf
    try:
        moved, inlier = inlier_fixes(factors, weight, poses, fixes)
        together = with_fixes(factors, weight, moved, fixes, inlier)
        fit = minimised(together, moved, 20, 1e-4).world_from_body
        for _ in range(_NOISE_ROUNDS):
            present, inliers, factor = with_noise_of(fixes, inlier, fit, positions_redundancy(together, fit))
            before, change = change, abs(math.log(factor))
            if _times_noisier(present, known) <= 1.0 or change > 0.5 * before:  # it does not settle
                break
            fixes, inlier = present, inliers
            together = with_fixes(factors, weight, fit, fixes, inlier)
            fit = minimised(together, fit, 20, 1e-4).world_from_body
            if change <= _STEADY:
                break
    except GraphError:
        return most * len(fixes)
    alone, edges = Objective(factors, weight), replace(together, positions=None)
    cost = edges.cost(se3.between(fit[:1], fit)) - alone.cost(poses) + most * float((1.0 - inlier).sum())
    claimed = replace(known, covariance=known.covariance / known.alike)
    cost += _autoregressive_cost(_whitened(fit, claimed, inlier))
    return cost + 0.5 * (together.information(fit).log_determinant() - _log_determinant(alone, poses))


def _log_determinant(objective: Objective, poses: Floats) -> float:
    """Log determinant of the information matrix; of a chain, where rounding may leave none, that of its edges."""
    graph, on = objective.factors.graph, objective.weight > 0
    if not graph.odometry[on].all():
        return objective.information(poses).log_determinant()
    held = 1 + len(objective.factors.loose(objective.weight))
    return float(np.linalg.slogdet(informed(graph, on))[1].sum()) - 2.0 * held * 6.0 * float(np.log(GAUGE_SIGMA))
