"""Comparison of two measurements of one body's motion, such as a camera's with the odometry's.

One robust fit gives what a sensor's motions differ by from a track of the body: a time offset, the mount (rotation and
lever arm), the ratio of lengths and that of turns. It is hand-eye calibration (Tsai and Lenz 1989) with unknown time
offset and scale. Priors keep what the drive does not determine at its given value, and their width tells that it is not
determined.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from vplog.data import Bools, Floats, Ints, Trajectory
from vplog.geometry import se3

_PRIOR = np.array([1.0, *[1.0] * 3, 3.0, 0.3, *[0.5] * 3])
"""Standard deviations before the drive is seen: time offset in s, rotation of the mount in rad (3), logs of the ratios
of lengths and of turns, and the lever arm in m (3)."""
_DETERMINED = 0.5
"""A quantity is determined if its standard deviation is below this share of the prior's."""
_LEAST_NOISE = np.array([1e-3, 1e-2])
"""Smallest noise of motions: rad, and the share of a length. A few motions that agree would give less."""
_FEWEST = 8
"""Motions from which a median is robust."""
_MOST_S, _MOST_SHARE, _STEPS = 2.0, 0.1, 40
"""Largest time offset that is looked for, in s and as a share of the track's time, and the steps of that search on
either side: a step of 0.05 s is a tenth of a quick turn."""
_ROUNDS = 3
"""Number of fits. Each takes its noise from the errors of the one before."""


@dataclass(frozen=True, eq=False)
class Motions:
    """M relative motions of one sensor."""

    first_ns: Ints
    """(M,) stamps of the beginnings."""
    last_ns: Ints
    """(M,) stamps of the ends."""
    first_from_last: Floats
    """(M, 4, 4)"""
    metric: Bools
    """(M,) whether the translation is known in m."""

    def rows(self, rows: Bools) -> Motions:
        """Return those of a mask (M,)."""
        return Motions(self.first_ns[rows], self.last_ns[rows], self.first_from_last[rows], self.metric[rows])


class Estimate(NamedTuple):
    """A value with its standard deviation, which is infinite if the drive does not determine the value."""

    value: float
    sigma: float

    def differs(self, other: float, least: float) -> bool:
        """Return whether it is more than `least`, and more than five standard deviations, away from another value."""
        return abs(self.value - other) > max(least, 5.0 * self.sigma)


@dataclass(frozen=True, eq=False)
class MotionComparison:
    """What the motions of a sensor differ by from those of a track of its body."""

    offset_s: Estimate
    """s to add to the sensor's stamps."""
    turned_rad: Estimate
    """Angle between the sensor's axes and those of the given mount."""
    lengths: Estimate
    """Length by the sensor of one m of the track."""
    turns: Estimate
    """Angle by the sensor of a turn by one rad of the track."""
    body_from_sensor: Floats
    """(4, 4) mount by the motions; what they do not determine is as given."""


def compare_motions(track: Trajectory, motions: Motions, body_from_sensor: Floats) -> MotionComparison | None:
    """Return what a sensor's motions differ by from those of a track; None if fewer than eight of them can be compared.

    `track` has the poses world_from_body over time, and `body_from_sensor` (4, 4) is the given mount.
    """
    begin_ns, end_ns = track.stamp_ns[[0, -1]].tolist()
    most_ns = min(_MOST_S * 1e9, _MOST_SHARE * (end_ns - begin_ns))
    inside = (motions.first_ns >= begin_ns + most_ns) & (motions.last_ns <= end_ns - most_ns)
    if inside.sum() < _FEWEST:
        return None
    fit = _Fit(track, motions.rows(inside), body_from_sensor, most_ns / 1e9)
    _, values, covariance = min((fit.solved(start) for start in fit.starts()), key=lambda one: one[0])
    sigma = np.sqrt(np.diagonal(covariance))
    sigma = np.where(sigma < _DETERMINED * _PRIOR, sigma, np.inf)
    turned = float(np.linalg.norm(values[1:4]))
    deviations = float(np.sqrt(values[1:4] @ np.linalg.solve(covariance[1:4, 1:4], values[1:4])))
    lengths, turns = np.exp(values[4:6]).tolist()
    return MotionComparison(
        Estimate(float(values[0]), float(sigma[0])), Estimate(turned, turned / max(deviations, 1e-9)),
        Estimate(lengths, lengths * float(sigma[4])), Estimate(turns, turns * float(sigma[5])), fit.mount(values),
    )  # fmt: skip


class _Fit:
    """The least-squares problem. Its unknowns (9,) are in the order of `_PRIOR`, and 0 at the given values."""

    def __init__(self, track: Trajectory, motions: Motions, body_from_sensor: Floats, most_s: float) -> None:
        self._track, self._motions, self._given, self._most_s = track, motions, body_from_sensor, most_s
        self._turns = se3.so3_log(motions.first_from_last[:, :3, :3])
        length = np.linalg.norm(motions.first_from_last[:, :3, 3], axis=1)
        self._length = np.maximum(length, length[motions.metric].mean() if motions.metric.any() else 1.0)

    def mount(self, values: Floats) -> Floats:
        """(4, 4) body_from_sensor."""
        return self._given @ se3.pose(se3.so3_exp(values[1:4]), values[6:9])

    def of_body(self, offset_s: float) -> Floats:
        """Motions of the track (M, 4, 4) between the sensor's stamps plus an offset."""
        offset_ns = round(float(np.clip(offset_s, -self._most_s, self._most_s)) * 1e9)
        stamps, poses = self._track.stamp_ns, self._track.world_from_body
        ends = (self._motions.first_ns, self._motions.last_ns)
        return se3.between(*(se3.interpolate_at(stamps, poses, end + offset_ns) for end in ends))

    def errors(self, values: Floats) -> Floats:
        """(M, 6) rotations in rad, then translations as shares of the length, which are zero if they are not known."""
        X, moved = self.mount(values), self.of_body(values[0])
        moved[:, :3, 3] *= np.exp(values[4])
        expected = se3.inverse(X) @ moved @ X
        turned = self._turns - np.exp(values[5]) * se3.so3_log(expected[:, :3, :3])
        shifted = (self._motions.first_from_last[:, :3, 3] - expected[:, :3, 3]) / self._length[:, None]
        return np.concatenate([turned, np.where(self._motions.metric[:, None], shifted, 0.0)], axis=1)

    def starts(self) -> list[Floats]:
        """Return two starts: the best time offset with the given mount, and with the mount that the turns imply."""
        offsets, found = np.linspace(-self._most_s, self._most_s, 2 * _STEPS + 1).tolist(), []
        bodies = [self.of_body(offset) for offset in offsets]
        for aligned in (False, True):
            tried = []
            for offset, body in zip(offsets, bodies, strict=True):
                turns = se3.so3_log(body[:, :3, :3]) @ self._given[:3, :3]
                rotation = _rotation_between(self._turns, turns) if aligned else np.eye(3)
                values = np.array([offset, *se3.so3_log(rotation), self._log_lengths(body), *np.zeros(4)])
                apart = np.linalg.norm(self.errors(values).reshape(-1, 2, 3), axis=2)
                tried.append((float((np.median(apart, axis=0) + apart.mean(axis=0)).sum()), offset, values))
            found.append(min(tried, key=lambda one: one[:2])[2])
        return found

    def _log_lengths(self, body: Floats) -> float:
        """Log of the ratio between the median lengths of the sensor's motions and of the body's (M, 4, 4)."""
        metric = self._motions.metric
        if not metric.any():
            return 0.0
        sensor, track = (np.linalg.norm(one[metric, :3, 3], axis=1) for one in (self._motions.first_from_last, body))
        return float(np.log(max(np.median(sensor), 1e-9) / max(np.median(track), 1e-9)))

    def solved(self, values: Floats) -> tuple[float, Floats, Floats]:
        """Cost, unknowns (9,) and their covariance (9, 9) of the robust fit from a start."""
        cost, covariance = np.inf, np.diag(_PRIOR**2)
        for _ in range(_ROUNDS):
            noise = self._noise(values)
            found = least_squares(lambda x, noise=noise: self._scaled(x, noise), values, loss="cauchy", x_scale=_PRIOR)
            values = found.x
            covariance = np.linalg.inv(found.jac.T @ found.jac)  # SciPy scales the rows by the loss
            count = 3.0 * np.array([len(self._length), self._motions.metric.sum()])
            cost = float(found.cost + count @ np.log(noise))
        return cost, values, covariance

    def _noise(self, values: Floats) -> Floats:
        """(2,) robust standard deviations of the rotations in rad, and of the translations as shares."""
        errors, metric = np.abs(self.errors(values)), self._motions.metric
        medians = np.median(errors[:, :3]), np.median(errors[metric, 3:]) if metric.any() else 0.0
        return np.maximum(1.4826 * np.array(medians), _LEAST_NOISE)

    def _scaled(self, values: Floats, noise: Floats) -> Floats:
        """Errors and unknowns in units of their standard deviations."""
        return np.concatenate([(self.errors(values) / np.repeat(noise, 3)).ravel(), values / _PRIOR])


def _rotation_between(a: Floats, b: Floats) -> Floats:
    """The rotation R (3, 3) for which b @ R is nearest to a; both (M, 3). Kabsch 1976."""
    u, _, vt = np.linalg.svd(b.T @ a + 1e-9 * np.eye(3))
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
