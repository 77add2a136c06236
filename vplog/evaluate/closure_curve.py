"""Precision over recall of a ledger's candidates, point by point, and which of them are true."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vplog.evaluate.closures import ANGLE_DEG, RADIUS_M, _apart, _revisits
from vplog.evaluate.pairs import poses_at

if TYPE_CHECKING:
    from vplog.data import Closures, Floats, Int32s, Ints, Keyframes, Trajectory
    from vplog.evaluate.closures import Bools


@dataclass(frozen=True, eq=False)
class Curves:
    """Of one drive."""

    true: Bools
    """(C,) both ends at one place by the truth, looking the same way."""
    known: Bools
    """(C,) the truth covers both ends."""
    curves: dict[str, Floats] = field(default_factory=dict)
    """By what candidates are ranked, (P, 3): recall of the revisits, precision of the candidates, and the value from
    which on; empty where nothing was revisited."""


def closure_curves(keyframes: Keyframes, closures: Closures, truth: Trajectory, stop: Ints) -> Curves:
    """The curves whose areas `score_closures` gives, by falling score and by falling inliers."""
    poses, covered = poses_at(truth, keyframes.stamp_ns)
    known = covered[closures.query] & covered[closures.match]
    distance, angle = _apart(poses[closures.query], poses[closures.match])
    true = known & (distance <= RADIUS_M) & (angle <= ANGLE_DEG)
    revisit = _revisits(poses, covered, np.asarray(stop), RADIUS_M, ANGLE_DEG)
    if not revisit.any() or not known.any():
        return Curves(true, known)
    rows = np.flatnonzero(known)
    named = {"score": closures.score, "inliers": closures.inliers}
    return Curves(
        true,
        known,
        {
            name: _curve(value[rows].astype(np.float64), true[rows], closures.query[rows], revisit)
            for name, value in named.items()
        },
    )


def _curve(value: Floats, true: Bools, query: Int32s, revisit: Bools) -> Floats:
    """(P, 3) by falling value; equal values come together, as no threshold can tell them apart."""
    order = np.argsort(-value, kind="stable")
    value, true, query = value[order], true[order], query[order]
    useful = np.flatnonzero(true & revisit[query])
    found = np.zeros(len(value))
    found[useful[np.unique(query[useful], return_index=True)[1]]] = 1.0
    last_of_equal = np.append(np.flatnonzero(value[1:] != value[:-1]), len(value) - 1)
    precision = np.cumsum(true) / np.arange(1, len(value) + 1)
    recall = np.cumsum(found) / revisit.sum()
    return np.stack([recall, precision, value], axis=1)[last_of_equal]
