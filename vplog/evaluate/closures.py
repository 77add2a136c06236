"""Were the loop closures right, and were the revisits found?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import geometry
from vplog.data import Verdict
from vplog.errors import TruthError
from vplog.evaluate.pairs import poses_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Closures, Floats, Int32s, Ints, Keyframes, Trajectory

    Bools = NDArray[np.bool_]

RADIUS_M = 6.0
"""m; two poses closer than this show the same place: a lane and a half, the radius of the field's KITTI protocols."""
ANGLE_DEG = 45.0
"""Degrees; a forward camera of 90 degrees still shares half its view."""
_OPPOSITE_DEG = 90.0
"""Degrees; beyond it a forward camera looks the other way."""


@dataclass(frozen=True)
class ClosureScore:
    """Counts and shares of one drive. A share is None where there is nothing to take it of."""

    keyframes: int
    """Keyframes with a truth."""
    outside: int
    """Keyframes without one; they and their closures are left out of everything else."""
    candidates: int
    accepted: int
    accepted_true: int
    precision: float | None
    """Accepted closures that are true."""
    revisits: int
    """Keyframes that have an older keyframe at the same place."""
    revisits_found: int
    recall: float | None
    """Revisits with at least one accepted, true closure."""
    opposite: int
    """Accepted closures between poses at one place that look in opposite directions (more than 90 degrees)."""
    average_precision: float | None
    """Area below precision over recall of all candidates by falling score, whatever their verdict."""
    recall_at_full_precision: float | None
    """Recall of the most candidates by falling score that are all true."""
    average_precision_by_inliers: float | None
    recall_at_full_precision_by_inliers: float | None


def score_closures(
    keyframes: Keyframes,
    closures: Closures,
    truth: Trajectory,
    stop: Ints,
    radius_m: float = RADIUS_M,
    angle_deg: float = ANGLE_DEG,
) -> ClosureScore:
    """Compare a ledger with the truth.

    A pair is true when its poses are within `radius_m` and `angle_deg` of each other in the truth. Keyframe i may
    close a loop with the rows below `stop[i]`, (N,): it is a revisit when one of these is true to it.
    Raises TruthError where no keyframe has a truth.
    """
    poses, known = poses_at(truth, keyframes.stamp_ns)
    if not known.any():
        raise TruthError(
            f"The truth covers none of the {len(known)} keyframes. Give the truth of this drive, in the log's clock."
        )
    revisit = _revisits(poses, known, np.asarray(stop), radius_m, angle_deg)
    rows = np.flatnonzero(known[closures.query] & known[closures.match])
    query, match = closures.query[rows], closures.match[rows]
    distance, angle = _apart(poses[query], poses[match])
    near = distance <= radius_m
    true = near & (angle <= angle_deg)
    accepted = np.array([verdict == Verdict.ACCEPTED for verdict in closures.verdict], bool)[rows]
    found = np.unique(query[accepted & true & revisit[query]])
    by_score = _ranked(closures.score[rows], true, query, revisit)
    by_inliers = _ranked(closures.inliers[rows], true, query, revisit)
    return ClosureScore(
        keyframes=int(known.sum()),
        outside=int((~known).sum()),
        candidates=len(rows),
        accepted=int(accepted.sum()),
        accepted_true=int((accepted & true).sum()),
        precision=_share((accepted & true).sum(), accepted.sum()),
        revisits=int(revisit.sum()),
        revisits_found=len(found),
        recall=_share(len(found), revisit.sum()),
        opposite=int((accepted & near & (angle > _OPPOSITE_DEG)).sum()),
        average_precision=by_score[0],
        recall_at_full_precision=by_score[1],
        average_precision_by_inliers=by_inliers[0],
        recall_at_full_precision_by_inliers=by_inliers[1],
    )


def _revisits(poses: Floats, known: Bools, stop: Ints, radius_m: float, angle_deg: float) -> Bools:
    """(N,) keyframes with an earlier, allowed one at the same place; sorted along the longest axis, so not N^2."""
    result = np.zeros(len(poses), bool)
    rows = np.flatnonzero(known)
    positions = poses[:, :3, 3]
    axis = np.ptp(positions[rows], axis=0).argmax()
    rows = rows[np.argsort(positions[rows, axis], kind="stable")]
    along = positions[rows, axis]
    first = np.searchsorted(along, along - radius_m, side="left")
    last = np.searchsorted(along, along + radius_m, side="right")
    for row, start, end in zip(rows.tolist(), first.tolist(), last.tolist(), strict=True):
        others = rows[start:end]
        others = others[others < min(stop[row], row)]
        others = others[((positions[others] - positions[row]) ** 2).sum(1) <= radius_m**2]
        if len(others):
            distance, angle = _apart(poses[others], poses[row])
            result[row] = bool(((distance <= radius_m) & (angle <= angle_deg)).any())
    return result


def _apart(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Distance in m and angle in degrees between poses (..., 4, 4)."""
    relative = geometry.between(a, b)
    return np.linalg.norm(relative[..., :3, 3], axis=-1), np.degrees(geometry.angle(relative))


def _ranked(value: NDArray[Any], true: Bools, query: Int32s, revisit: Bools) -> tuple[float | None, float | None]:
    """Average precision and the highest recall at precision 1 over candidates by falling value; None without revisits.

    Recall counts revisits with a true candidate so far, precision counts candidates. Equal values come together,
    as no threshold can tell them apart.
    """
    revisits = int(revisit.sum())
    if not revisits:
        return None, None
    if not len(value):
        return 0.0, 0.0
    order = np.argsort(-value.astype(np.float64), kind="stable")
    value, true, query = value[order], true[order], query[order]
    useful = np.flatnonzero(true & revisit[query])
    first = useful[np.unique(query[useful], return_index=True)[1]]
    found = np.zeros(len(value), np.int64)
    found[first] = 1
    last_of_equal = np.append(np.flatnonzero(value[1:] != value[:-1]), len(value) - 1)
    precision = (np.cumsum(true) / np.arange(1, len(value) + 1))[last_of_equal]
    recall = (np.cumsum(found) / revisits)[last_of_equal]
    average = float((np.diff(recall, prepend=0.0) * precision).sum())
    full = recall[precision == 1.0]
    return average, float(full.max()) if len(full) else 0.0


def _share(part: Any, whole: Any) -> float | None:
    return float(part / whole) if whole else None
