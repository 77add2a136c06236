"""The probability that a verified closure is false, calibrated on impossible and on certain pairs of its drive.

Pairs that odometry rules out were proposed as its best by the same recogniser and passed the same geometry, so a false
candidate does no better than they do: its conformal p-value is the share of them that does as well (Vovk, Gammerman and
Shafer, Algorithmic Learning in a Random World, 2005, section 2.2; as a test for outliers, Bates et al. 2023). Pairs
that odometry makes certain tell how often the pose is wrong at a right place.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from pydantic import Field

from vplog.data import Bools, Closures, Features, Floats, Ints, Verdict
from vplog.features.matching import PairMatches
from vplog.features.sift import mirrored
from vplog.loops.candidate import Drive
from vplog.loops.propose import Proposals
from vplog.loops.verify import verify_between
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.execution.execution import Execution

_VERIFIED = (Verdict.ACCEPTED, Verdict.NO_CALIBRATION)
"""Geometry found one place."""
_SURE = 1e-3
"""Least `p_false` that is believed, and most likewise: it is counted from some hundred pairs."""
_FINER = 2.0
"""Times the least false rate that pairs can tell is below the rate that is asked for."""
_STRONG = 0.05
"""False rate below which the closures of one place are strong evidence by themselves."""
MOST_APART = 8
"""Keyframes between which odometry hardly drifts, as of the pairs that calibrate the camera."""


class FalseRateSettings(Settings):
    """Bound on the share of the accepted closures that may be false."""

    rate: float | None = Field(default=None, gt=0, lt=1)
    """Expected share of false closures of a drive among those that are given to the solver; the least sure ones are
    left out. `null` uses all that geometry verifies."""
    sigmas: float = Field(default=5.0, ge=3)
    """Odometry rules a pair out that it has further apart than a closure is long by so many sigmas of the
    drift model (`noise`), whatever the log claims: with 2 % of drift, 10 %."""
    null_pairs: int = Field(default=200, ge=0, le=100_000)
    """Pairs that are no closures, at least, and as many as `rate` (1 in 20 without one) needs; where odometry rules out
    fewer, as in a room, candidates with the query mirrored make up for them, which costs their verification. 0: no
    candidate is mirrored."""
    certain_pairs: int = Field(default=200, ge=0, le=100_000)
    """Pairs of neighbouring keyframes, most, whose verified poses are held against the odometry between them: how many
    are wrong at so many inliers, with depth or stereo; 0 takes every pose of a right place for right."""

    def warnings_between(self) -> list[str]:
        """Why no closure between two drives is used, where it is so: odometry rules nothing out between them, so that
        mirrored candidates are all there is to count by."""
        if self.rate is None or self.null_pairs:
            return []
        return [
            f"--false-rate {self.rate:g}: no closure between drives is used, since no pairs are known that are no "
            "closures: with false_rate.null_pairs=0, or features other than sift, no candidate is mirrored. Leave the "
            "rate out."
        ]


def conformal_p(found: Floats | Ints, null: Floats | Ints) -> Floats:
    """(N,) share of the null sample (K,) that does as well, itself counted (Vovk et al. 2005, section 2.2)."""
    higher = len(null) - np.searchsorted(np.sort(null), found, "left")
    return np.asarray((1.0 + higher) / (1.0 + len(null)), np.float64)


def evidence(closures: Closures) -> Ints:
    """(C,) inliers of candidates that geometry verified, 0 of the others."""
    return np.where(closures.of(*_VERIFIED), closures.inliers, 0).astype(np.int64)


def null_pairs(found: Ints, settings: FalseRateSettings) -> int:
    """Pairs that are no closures, enough for `rate`, or for strong evidence of what is verified: by K of them the least
    false rate of candidates with evidence (C,) is C / verified / K."""
    if settings.null_pairs == 0:
        return 0
    rate = _STRONG if settings.rate is None else settings.rate
    return max(settings.null_pairs, math.ceil(_FINER * len(found) / max(int((found > 0).sum()), 1) / rate))


def are_unrated(found: Ints, null: int, settings: FalseRateSettings) -> bool:
    """Whether candidates with evidence (C,) stay without `p_false`: where none is mirrored, so few pairs that are no
    closures (`null`) would leave the best of them above a half, and the solver would take all for false."""
    least = len(found) / max(int((found > 0).sum()), 1) / 0.5
    return settings.rate is None and settings.null_pairs == 0 and null < least


def mirrored_evidence(proposals: Proposals, later: Drive, earlier: Drive, execution: Execution) -> Ints:
    """(R,) evidence of proposals (R,) whose query is mirrored: they are no closures, whatever it is."""

    def features(row: int) -> Features:
        return mirrored(later.features(row))

    mirror = replace(later, features=features, matches=PairMatches(features, later.settings.matching))
    return evidence(verify_between(proposals, mirror, earlier, execution, share=0.0))


def certain_pairs(positions: Floats, stops: Ints, reach_m: float, count: int) -> Proposals:
    """At most `count` pairs of near keyframes, later and earlier, spread evenly: odometry between them is sure.

    The earlier one is within `reach_m` of the later by `positions` (N, D), and not below its stop (N,).
    """
    rows = np.arange(len(stops), dtype=np.int32)
    apart = range(1, min(MOST_APART + 1, len(rows)))
    query = np.concatenate([rows[:0], *(rows[k:] for k in apart)])
    match = np.concatenate([rows[:0], *(rows[:-k] for k in apart)])
    near = np.linalg.norm(positions[query] - positions[match], axis=1) <= reach_m
    near = np.flatnonzero(near & (match >= stops[query]))
    near = near[np.linspace(0, max(len(near) - 1, 0), min(count, len(near))).astype(np.int64)]
    none = np.zeros(len(near), np.int32)
    return Proposals(query[near], match[near], none, none.astype(np.float32), none)


def wrong_poses(candidates: Ints, certain: Ints, wrong: Bools) -> Floats:
    """(C,) probability that a candidate's pose is wrong, falling with its evidence, as among certain pairs (K,).

    Isotonic regression (Robertson, Wright and Dykstra 1988). Evidence less than any certain pair's leans to 1.
    """
    if not len(certain):
        return np.zeros(len(candidates))
    order = np.lexsort((~wrong, certain))
    share = scipy.optimize.isotonic_regression(wrong[order].astype(np.float64), increasing=False).x
    return np.interp(candidates, [0, *certain[order]], [1.0, *share])


def p_false(candidates: Ints, null: Ints, wrong: Floats) -> Floats:
    """(C,) the least false rate that admits a candidate: the expected share of false ones among it and all better.

    By evidence of candidates (C,) and of pairs that are no closures (K,): conformal p-values, Benjamini and Hochberg's
    1995 step-up rule, and of true null hypotheses as many as candidates without evidence imply (Storey 2002, eq. 6).
    The mean of `wrong` (C,) among the same candidates is added, for right places with a wrong pose.
    """
    p = conformal_p(candidates, null)
    refused = (candidates == 0).sum()
    most_false = min(float(len(candidates)), (1.0 + refused) * (1.0 + len(null)) / max((null == 0).sum(), 1e-9))
    as_good = len(candidates) - np.searchsorted(np.sort(candidates), candidates, "left")
    order = np.argsort(candidates, kind="stable")
    at_least = np.cumsum(wrong[order][::-1])[as_good - 1]
    rate = np.empty(len(candidates))
    rate[order] = np.minimum.accumulate(((most_false * p + at_least) / as_good)[order])
    return np.minimum(rate, 1.0)


def with_p_false(closures: Closures, ruled_out: Bools, mirror: Ints, certain: Ints, wrong: Bools) -> Closures:
    """The ledger with `p_false` of the verified candidates, 1 where odometry rules them out (C,).

    `mirror` (M,) is further evidence of pairs that are no closures, `certain` (K,) that of verified pairs that are
    closures, and `wrong` (K,) whether their pose is wrong.
    """
    found = evidence(closures)
    rate, left = np.ones(len(closures)), found[~ruled_out]
    rate[~ruled_out] = p_false(left, np.concatenate([found[ruled_out], mirror]), wrong_poses(left, certain, wrong))
    return replace(closures, p_false=np.where(found > 0, rate, np.nan))


def log_odds_false(closures: Closures) -> Floats:
    """(C,) log of the odds of being false by `p_false`, 0 where there is none."""
    p = np.clip(np.where(np.isnan(closures.p_false), 0.5, closures.p_false), _SURE, 1.0 - _SURE)
    return np.asarray(np.log(p) - np.log1p(-p), np.float64)


def at_rate(closures: Closures, rate: float) -> Closures:
    """The ledger with the closures of a larger `p_false` rejected."""
    verdict = [
        Verdict.NOT_SIGNIFICANT if one is Verdict.ACCEPTED and p > rate else one
        for one, p in zip(closures.verdict, closures.p_false.tolist(), strict=True)
    ]
    return replace(closures, verdict=verdict)
