"""GPS fixes as factors of a pose graph: the keyframe of each, and which are inliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu
from vplog.graph.consistency import chi2_quantile
from vplog.graph.least_squares import Objective, Positions, minimised
from vplog.graph.robust_kernels import truncated_weights
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import Bools, Floats, Gps, Ints, Keyframes, Odometry
    from vplog.graph.factors import Factors

_LEAST = 3
"""Fixes that fix where a graph is and how it is turned."""


_NOISE_ROUNDS = 5
"""Most rounds of estimating the noise of the fixes: poses follow them less as it grows."""
_UNLIKE = 0.1
"""Autocorrelation below which errors are not alike."""
_STEADY = 1.2
"""Factor of the noise at which it is settled."""


class GpsSettings(Settings):
    """GPS as constraints. Off, a log's GPS changes nothing."""

    use: bool = False
    """Whether fixes take part: `vplog run --gps`."""
    unknown_sigma_m: float = Field(default=3.0, gt=0)
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
    origin: tuple[float, float, float]
    """Latitude, longitude in degrees, altitude in m of the first fix."""
    warnings: list[str]

    def __len__(self) -> int:
        return len(self.row)


def fixes_on(gps: Gps | None, odometry: Odometry, keyframes: Keyframes, settings: GpsSettings) -> Fixes:
    """The fixes of a log on the keyframes nearest in time. Raises GraphError where fewer than three are within reach.

    Fixes that share a keyframe share the information of one: their errors are those of the same satellites.
    """
    keys, warnings = keyframes.stamp_ns, []
    if gps is None:
        raise GraphError("The log has no GPS fixes to use. `vplog info` lists the topics; run without --gps.")
    local = local_enu(gps)
    inside = (local.stamp_ns >= odometry.stamp_ns[0]) & (local.stamp_ns <= odometry.stamp_ns[-1])
    stamps = local.stamp_ns[inside]
    after = np.clip(np.searchsorted(keys, stamps), 1, len(keys) - 1)
    row = np.where(stamps - keys[after - 1] <= keys[after] - stamps, after - 1, after)
    near = np.abs(stamps - keys[row]) <= settings.reach_s * 1e9
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
            f"{unknown} of {len(row)} GPS fixes have no usable covariance; {settings.unknown_sigma_m:g} m is assumed."
        )
    alike = np.bincount(row, minlength=len(keys))[row]
    return Fixes(
        row.astype(np.int64),
        key_from_then[:, :3, :3] @ antenna + key_from_then[:, :3, 3],
        local.enu_m[inside][near],
        covariance * alike[:, None, None],
        local.origin,
        warnings,
    )


def _usable(covariance: Floats, settings: GpsSettings) -> tuple[Floats, int]:
    """(F, 3, 3) positive definite, and how many were none and are assumed."""
    finite: Bools = np.asarray(np.isfinite(covariance).all((1, 2)))
    symmetric = np.where(finite[:, None, None], (covariance + np.swapaxes(covariance, 1, 2)) / 2, np.eye(3))
    values, vectors = np.linalg.eigh(symmetric)
    sound = finite & (values[:, 0] >= 0) & (values[:, -1] > 0)
    values = np.maximum(values, settings.least_sigma_m**2)
    fixed = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    assumed = np.diag(np.array([1.0, 1.0, 4.0]) * settings.unknown_sigma_m**2)
    return np.where(sound[:, None, None], fixed, assumed), int((~sound).sum())


def antennas(poses: Floats, fixes: Fixes) -> Floats:
    """(F, 3) where the antenna was by the poses (N, 4, 4)."""
    on = poses[fixes.row]
    return (on[:, :3, :3] @ fixes.arm_m[:, :, None])[:, :, 0] + on[:, :3, 3]


def world_from_enu(poses: Floats, fixes: Fixes, weight: Floats) -> Floats:
    """(4, 4) rigid motion from the plane of the first fix to the world of the poses: Umeyama 1991, eq. 40-43."""
    target, share = antennas(poses, fixes), weight / weight.sum()
    middle, target_middle = share @ fixes.enu_m, share @ target
    spread = (share[:, None] * (target - target_middle)).T @ (fixes.enu_m - middle)
    left, _, right = np.linalg.svd(spread)
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return se3.pose(rotation, target_middle - rotation @ middle)


def chi2_of_fixes(poses: Floats, fixes: Fixes, world: Floats) -> Floats:
    """(F,) squared Mahalanobis distance of the fixes, moved to the world of the poses, to the antenna."""
    error = (antennas(poses, fixes) - world[:3, 3]) @ world[:3, :3] - fixes.enu_m
    return se3.mahalanobis2(error, fixes.covariance)


def with_fixes(factors: Factors, weight: Floats, start: Floats, fixes: Fixes, inlier: Floats) -> Objective:
    """The weighted edges (E,) with the fixes (F,), weighted, in the world of `start`, and pose 0 free to move."""
    first_from_enu = se3.inverse(start[0]) @ world_from_enu(start, fixes, inlier)
    R = first_from_enu[:3, :3]
    Omega = np.linalg.inv(R @ fixes.covariance @ R.T) * inlier[:, None, None]
    return Objective(
        factors,
        weight,
        positions=Positions(fixes.row, fixes.arm_m, se3.transform(first_from_enu, fixes.enu_m), Omega),
    )


def inlier_fixes(
    factors: Factors, weight: Floats, start: Floats, fixes: Fixes, settings: GpsSettings
) -> tuple[Floats, Floats]:
    """Poses (N, 4, 4), pose 0 as given, and the inliers (F,) among the fixes, 0 or 1.

    Graduated non-convexity with the truncated least squares loss (Yang et al., RA-L 2020) over the fixes, the edges
    keeping their weights. The first solve uses all of them, so their frame is found whatever the odometry drifted. A
    fix is judged by the noise that most have where that is more than they claim.
    """
    bound, inlier, poses = chi2_quantile(settings.inlier_probability, 3), np.ones(len(fixes)), start
    mu = 0.0
    for _ in range(settings.max_stages):
        poses = minimised(with_fixes(factors, weight, poses, fixes, inlier), poses, 20, 1e-4).world_from_body
        chi2 = chi2_of_fixes(poses, fixes, world_from_enu(poses, fixes, np.maximum(inlier, 1e-9)))
        chi2 = chi2 / max(float(np.median(chi2)) / chi2_quantile(0.5, 3), 1.0)
        mu = bound / max(2.0 * chi2.max() - bound, bound) if mu == 0.0 else mu * settings.growth  # remark 5
        inlier = truncated_weights(chi2, bound, mu)
        if ((inlier == 0) | (inlier == 1)).all():
            break
    inlier = np.where(inlier > 0.5, 1.0, 0.0)
    if inlier.sum() < _LEAST:
        raise GraphError(
            f"Only {int(inlier.sum())} of {len(fixes)} GPS fixes agree with the odometry and each other. "
            "Run without --gps, or set gps.unknown_sigma_m to what the receiver does."
        )
    return poses, inlier


def with_noise_of(factors: Factors, weight: Floats, start: Floats, fixes: Fixes, settings: GpsSettings) -> Fixes:
    """The fixes with the covariance that their residuals to the weighted edges (E,) say they have.

    Not less than they claim, since poses follow them. Errors of satellites wander: fixes whose errors are alike count
    for so much less, by the sum of the autocorrelation of their residuals as far as it is positive (Geyer, Practical
    Markov Chain Monte Carlo, 1992).
    """
    for _ in range(_NOISE_ROUNDS):
        poses, inlier = inlier_fixes(factors, weight, start, fixes, settings)
        world = world_from_enu(poses, fixes, np.maximum(inlier, 1e-9))
        sound = np.flatnonzero(inlier)
        error = ((antennas(poses, fixes) - world[:3, 3]) @ world[:3, :3] - fixes.enu_m)[sound]
        root = np.linalg.cholesky(np.linalg.inv(fixes.covariance[sound]))
        white = (np.swapaxes(root, 1, 2) @ error[:, :, None])[:, :, 0]
        power = max(float((white**2).mean()), 1e-12)
        alike = 1.0
        for lag in range(1, len(white) // 4):
            share = float((white[lag:] * white[:-lag]).mean()) / power
            if share < _UNLIKE:
                break
            alike += 2.0 * share
        factor = power * alike
        fixes = replace(fixes, covariance=fixes.covariance * max(factor, 1.0))
        if factor < _STEADY:
            break
    return fixes


def cost_of_fixes(factors: Factors, weight: Floats, poses: Floats, fixes: Fixes, settings: GpsSettings) -> float:
    """By how much the log density is less with the fixes than that of the weighted edges (E,), least at `poses`.

    But for a constant; outliers count as at the bound of inliers.
    """
    most = 0.5 * chi2_quantile(settings.inlier_probability, 3)
    try:
        moved, inlier = inlier_fixes(factors, weight, poses, fixes, settings)
    except GraphError:
        return most * len(fixes)
    fit = minimised(with_fixes(factors, weight, moved, fixes, inlier), moved, 20, 1e-4).world_from_body
    alone, together = Objective(factors, weight), with_fixes(factors, weight, fit, fixes, inlier)
    cost = together.cost(se3.between(fit[:1], fit)) - alone.cost(poses) + most * float((1.0 - inlier).sum())
    return cost + 0.5 * (together.information(fit).log_determinant() - alone.information(poses).log_determinant())
