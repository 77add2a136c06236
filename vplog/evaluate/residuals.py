"""Errors of closures and of keyframes against the truth, normalised by their covariances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Verdict
from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Closures, Floats, Ints, Keyframes
    from vplog.evaluate.body_truth import BodyTruth

_NEAR = 5
"""Keyframes that the ends of two closures may be apart to be neighbours; the truth between them is short, and good."""


@dataclass(frozen=True)
class ResidualScore:
    """Medians of sqrt(e' C^-1 e / 6): honest covariances have about 1 (0.94 for Gaussian errors)."""

    closures: int
    """Accepted ones with a covariance and a truth."""
    to_truth: float | None
    """Median of the closures against the truth. A truth that is itself off between two visits counts as their error."""
    pairs: int
    """Closures with an accepted neighbour."""
    to_neighbours: float | None
    """Median of each closure against the next one near it, moved by the truth over the few keyframes between them. What
    the truth is off between two visits cancels, and so does what neighbours share, so it may be less."""


def score_residuals(keyframes: Keyframes, closures: Closures, truth: BodyTruth) -> ResidualScore:
    """Score the accepted closures of a ledger."""
    at = truth.at(keyframes.stamp_ns)
    poses, known = at.world_from_body, at.known & truth.oriented
    usable = closures.of(Verdict.ACCEPTED) & known[closures.query] & known[closures.match]
    rows = np.flatnonzero(usable & np.isfinite(closures.information).all((1, 2)))
    query, match = closures.query[rows], closures.match[rows]
    measured = closures.match_from_query[rows]
    covariance = np.asarray(np.linalg.inv(closures.information[rows]), np.float64)
    to_truth = _normalised(se3.between(poses[match], poses[query]), measured, covariance)
    this, following = _neighbours(query.astype(np.int64), match.astype(np.int64))
    moved = se3.between(poses[query[following]], poses[query[this]])  # the next query's frame from this one's
    predicted = se3.between(poses[match[following]], poses[match[this]]) @ measured[this] @ se3.inverse(moved)
    turned = se3.adjoint(moved)
    both = covariance[following] + turned @ covariance[this] @ np.swapaxes(turned, 1, 2)
    to_neighbours = _normalised(predicted, measured[following], both)
    return ResidualScore(len(rows), _median(to_truth), len(this), _median(to_neighbours))


@dataclass(frozen=True)
class PoseScore:
    """Errors of the keyframes' poses, normalised by their covariances, both relative to the first keyframe."""

    keyframes: int
    """Those with a covariance and a truth."""
    nees: float | None
    """Mean of e' C^-1 e / 6: about 1 for honest covariances. Neighbours share their errors, so that one drive alone is
    within a factor of 2 or 3 of it."""
    median_sigma_m: float | None
    """Median of the standard deviation of the position: the root of the covariance's trace."""


def score_poses(keyframes: Keyframes, world_from_body: Floats, covariance: Floats, truth: BodyTruth) -> PoseScore:
    """Score solved keyframes (N, 4, 4) by their covariances (N, 6, 6), NaN where unknown."""
    at = truth.at(keyframes.stamp_ns)
    rows = np.flatnonzero(at.known & truth.oriented & at.known[:1] & np.isfinite(covariance).all((1, 2)))
    rows = rows[rows > 0]
    if not len(rows):
        return PoseScore(0, None, None)
    expected, found = (se3.between(poses[:1], poses[rows]) for poses in (at.world_from_body, world_from_body))
    nees = float((_normalised(expected, found, covariance[rows]) ** 2).mean())
    return PoseScore(len(rows), nees, float(np.median(np.sqrt(np.trace(covariance[rows, 3:, 3:], axis1=1, axis2=2)))))


def _neighbours(query: Ints, match: Ints) -> tuple[Ints, Ints]:
    """Positions of closures, and of the next one in order of queries whose ends are near but not both the same."""
    order = np.lexsort((match, query))
    this, following = [], []
    for at, row in enumerate(order[:-1].tolist()):
        for other in order[at + 1 :].tolist():
            if query[other] - query[row] > _NEAR:
                break
            if query[other] > query[row] and abs(match[other] - match[row]) <= _NEAR:
                this.append(row)
                following.append(other)
                break
    return np.array(this, np.int64), np.array(following, np.int64)


def _normalised(expected: Floats, measured: Floats, covariance: Floats) -> Floats:
    chi2 = se3.mahalanobis2(se3.log(se3.between(measured, expected)), covariance)
    return np.sqrt(np.maximum(chi2, 0.0) / 6.0)


def _median(values: Floats) -> float | None:
    return float(np.median(values)) if len(values) else None
