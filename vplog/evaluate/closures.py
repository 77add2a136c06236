"""Precision of closures, recall of revisits, and the residuals of closures by their claimed covariances.

Accepted closures are judged by their pose (`closure_pose`), candidates and revisits by place: a distance and a heading
between the true poses, as in `vplog compare`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from vplog.data import Bools, Closures, Floats, Int32s, Ints, Keyframes, Verdict
from vplog.errors import TruthError
from vplog.evaluate.body_truth import BodyTruth, TruthAt
from vplog.evaluate.closure_pose import PoseBounds, pose_bounds, pose_errors
from vplog.evaluate.pairs import optical_axis, pose_pairs
from vplog.evaluate.place_truth import DISTANCE_M, HEADING_DEG
from vplog.evaluate.retrieval import Curve, average_precision, recall_at_full_precision
from vplog.geometry import se3

_OPPOSITE_DEG = 90.0
"""Degrees; beyond it a forward camera looks the other way."""
_NEAR = 5
"""Keyframes that the ends of two closures may be apart to be neighbours; the truth between them is short, and good."""


@dataclass(frozen=True)
class PlaceCriterion:
    """Criterion by which two frames show one place."""

    distance_m: float = DISTANCE_M
    heading_deg: float = HEADING_DEG
    """Between the optical axes, so that roll about them does not matter; of the whole rotation where the camera's mount
    is not known, and of none where the truth has no orientation."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """C closures against the truth."""

    bounds: PoseBounds
    posed: Bools
    """(C,) judged by their pose."""
    overconfident: Bools
    """(C,) right ones that are further off than they claim."""
    known: Bools
    """(C,) the truth covers both ends."""
    at_place: Bools
    """(C,) the two frames show one place."""
    opposite: Bools
    """(C,) the two frames are near each other and look in opposite directions (more than 90 degrees)."""
    right: Bools
    """(C,) by pose where there is one, else by place."""
    wrong: Bools
    """(C,) closures neither right nor wrong are not judged: the truth is missing or too coarse."""
    curves: dict[str, Floats] = field(default_factory=dict)
    """By what candidates are ranked, (P, 3): recall of the revisits, precision of the candidates, and the value from
    which on; empty where nothing was revisited."""


@dataclass(frozen=True)
class ClosureScore:
    """Counts and shares of one drive. A share is None where there is nothing to take it of."""

    keyframes: int
    """Keyframes with a truth."""
    outside: int
    """Keyframes without one; they and their closures are left out of everything else."""
    candidates: int
    accepted: int
    """Accepted closures with a truth at both ends."""
    accepted_true: int
    """Accepted closures whose pose is right."""
    accepted_false: int
    not_judged: int
    """Accepted closures that the truth does not cover, or too coarsely to tell."""
    precision: float | None
    """Accepted closures that are right, of those that are right or wrong."""
    by_place: int
    """Accepted closures judged by the place criterion, for want of a pose or of a truth with orientations."""
    overconfident: int
    """Right ones that are further off than they claim (99.9 %)."""
    same_place: int
    """Accepted closures between frames of one place."""
    place_precision: float | None
    """`same_place` as a share of the accepted closures."""
    revisits: int
    """Keyframes that have an older keyframe at the same place."""
    revisits_found: int
    recall: float | None
    """Revisits with at least one accepted, right closure."""
    opposite: int
    """Accepted closures between poses at one place that look in opposite directions (more than 90 degrees)."""
    directions: int
    """Closures that the solve took without metres (`direction_only`)."""
    directions_true: int
    """Direction-only closures whose rotation and direction are right."""
    average_precision: float | None
    """Area below precision over recall of all candidates by falling score, whatever their verdict, by place."""
    recall_at_full_precision: float | None
    """Recall of the most candidates by falling score that are all of one place."""
    average_precision_by_inliers: float | None
    recall_at_full_precision_by_inliers: float | None
    criterion: dict[str, float] = field(default_factory=dict)
    """The bounds: translation_m and rotation_deg, most (times these with the claimed covariance), length_m of the drive
    they are for; distance_m and heading_deg of a place."""


def judge_closures(
    closures: Closures,
    query: TruthAt,
    match: TruthAt,
    bounds: PoseBounds,
    place: PlaceCriterion,
    cameras: tuple[Sequence[Floats], Sequence[Floats]] = ((), ()),
    oriented: bool = True,
) -> Judgement:
    """Compare a ledger with the truth at its queries' and its matches' keyframes, in one frame.

    `cameras` are body_from_camera (4, 4) of the cameras of queries and of matches, by number; `oriented` whether the
    truth has orientations: without, places are within the distance, and no pose is judged.
    """
    known = query.known[closures.query] & match.known[closures.match]
    rows = np.flatnonzero(known)
    here, there = query.world_from_body[closures.query[rows]], match.world_from_body[closures.match[rows]]
    distance = np.linalg.norm(here[:, :3, 3] - there[:, :3, 3], axis=1)
    ends = (cameras[0], query, closures.query_camera), (cameras[1], match, closures.match_camera)
    axes = [_optical_axes(mounts, at)[np.minimum(number[rows], len(mounts))] for mounts, at, number in ends]
    heading, near = _heading_deg(here, there, *axes) * oriented, distance <= place.distance_m
    at_place, opposite = np.zeros((2, len(closures)), bool)
    at_place[rows], opposite[rows] = near & (heading <= place.heading_deg), near & (heading > _OPPOSITE_DEG)
    into, out = (np.stack([*mounts, np.eye(4)])[np.minimum(number, len(mounts))] for mounts, _, number in ends)
    posed, right, wrong, overconfident = np.array(pose_errors(closures, query, match, bounds, (into, out))) & oriented
    by_place = known & ~posed
    right, wrong = right | by_place & at_place, wrong | by_place & ~at_place
    return Judgement(bounds, posed, overconfident, known, at_place, opposite, right, wrong)


def score_closures(
    keyframes: Keyframes,
    closures: Closures,
    truth: BodyTruth,
    stop: Ints,
    place: PlaceCriterion | None = None,
    cameras: Sequence[Floats] = (),
) -> tuple[ClosureScore, Judgement]:
    """Compare a drive's ledger with the truth; `cameras` are body_from_camera by number, as far as they are known.

    Keyframe i may close a loop with the rows below `stop[i]`, (N,): it is a revisit when one of these is of its place,
    by any camera of either.
    Raises TruthError where no keyframe has a truth.
    """
    place = place or PlaceCriterion()
    at = truth.at(keyframes.stamp_ns)
    if not at.known.any():
        raise TruthError(
            f"The truth covers none of the {len(at.known)} keyframes. Give the truth of this drive, in the log's clock."
        )
    covered = np.flatnonzero(at.known)
    bounds = pose_bounds(at.world_from_body[covered][:, :3, 3])
    judged = judge_closures(closures, at, at, bounds, place, (cameras, cameras), truth.oriented)
    poses = at.world_from_body[covered]
    axes = [optical_axis(camera, poses) for camera in cameras or [None]]
    older = np.searchsorted(covered, np.minimum(np.asarray(stop), np.arange(len(at.known)))[covered])
    heading_deg = place.heading_deg if truth.oriented else 180.0
    revisit = np.zeros(len(at.known), bool)
    revisit[covered] = np.any(
        [
            pose_pairs(poses, poses, place.distance_m, heading_deg, here, there).below(older).positive
            for here, there in product(axes, axes)
        ],
        axis=0,
    )
    judged = replace(judged, curves=_curves(closures, judged, revisit))
    return _score(closures, judged, at.known, revisit, place), judged


def count_closures(closures: Closures, judged: Judgement, place: PlaceCriterion) -> dict[str, Any]:
    """Counts of `ClosureScore` for the accepted closures of any ledger, of one drive or between two."""
    accepted = closures.accepted
    right, wrong = accepted & judged.right, accepted & judged.wrong
    here = accepted & judged.known
    return {
        "candidates": int(judged.known.sum()),
        "accepted": int(here.sum()),
        "accepted_true": int(right.sum()),
        "accepted_false": int(wrong.sum()),
        "not_judged": int((accepted & ~right & ~wrong).sum()),
        "precision": _share(right.sum(), right.sum() + wrong.sum()),
        "by_place": int((here & ~judged.posed).sum()),
        "overconfident": int((accepted & judged.overconfident).sum()),
        "same_place": int((accepted & judged.at_place).sum()),
        "place_precision": _share((accepted & judged.at_place).sum(), here.sum()),
        "opposite": int((accepted & judged.opposite).sum()),
        "criterion": asdict(judged.bounds) | {"distance_m": place.distance_m, "heading_deg": place.heading_deg},
    }


def closure_sentences(closures: dict[str, Any]) -> list[str]:
    """Sentences of a ClosureScore, or of the counts between two drives with their criterion, as plain values."""
    share = {
        name: "none" if closures.get(name) is None else f"{closures[name]:.3f}"
        for name in ("precision", "place_precision", "recall")
    }
    by = closures["criterion"]
    lines = [
        f"{closures['accepted']} accepted, {closures['accepted_true']} of them true, {closures['accepted_false']} "
        f"false (precision {share['precision']}); {closures['opposite']} in the opposite direction",
        f"true by pose: within {by['translation_m']:.2f} m and {by['rotation_deg']:g} deg of the truth, or the claimed "
        f"covariance, at most {by['most']:g} times that: {by['length_m']:.0f} m of drive",
        f"{closures['same_place']} accepted of one place: within {by['distance_m']:g} m and {by['heading_deg']:g} deg "
        f"between optical axes (precision {share['place_precision']})",
    ]
    for name, text in (
        ("not_judged", "not judged: the truth has a gap there, or is too coarse"),
        (
            "overconfident",
            "true, but outside 99.9 % of the covariance claimed: that, or the truth between two visits, is wrong",
        ),
        ("by_place", "judged by place: without a pose, or a truth with orientations"),
        ("directions", f"without metres, {closures.get('directions_true')} of them true by turn and direction"),
    ):
        if closures.get(name):
            lines.append(f"{closures[name]} {text}")
    if "revisits" in closures:
        found = f"{closures['revisits_found']} of {closures['revisits']}"
        lines.append(f"{found} revisits found (recall {share['recall']})")
    return lines


def _score(
    closures: Closures, judged: Judgement, covered: Bools, revisit: Bools, place: PlaceCriterion
) -> ClosureScore:
    accepted, direction = closures.accepted, closures.of(Verdict.DIRECTION_ONLY) & judged.known
    found = np.unique(closures.query[accepted & judged.right])
    found = found[revisit[found]]
    by_score, by_inliers = (_area(judged.curves.get(name), bool(revisit.any())) for name in ("score", "inliers"))
    return ClosureScore(
        keyframes=int(covered.sum()), outside=int((~covered).sum()), **count_closures(closures, judged, place),
        revisits=int(revisit.sum()), revisits_found=len(found), recall=_share(len(found), revisit.sum()),
        directions=int(direction.sum()), directions_true=int((direction & judged.right).sum()),
        average_precision=by_score[0], recall_at_full_precision=by_score[1],
        average_precision_by_inliers=by_inliers[0], recall_at_full_precision_by_inliers=by_inliers[1],
    )  # fmt: skip


def _optical_axes(cameras: Sequence[Floats], at: TruthAt) -> Floats:
    """(K + 1, 3) in the body, NaN where not known, as the last row is: that of a camera that has no number here."""
    axes = [optical_axis(camera, at.world_from_body[at.known]) for camera in cameras]
    return np.array([np.full(3, np.nan) if axis is None else axis for axis in [*axes, None]])


def _heading_deg(a: Floats, b: Floats, a_axis: Floats, b_axis: Floats) -> Floats:
    """(R,) degrees between the optical axes (R, 3) of poses (R, 4, 4), or of their whole rotation where one is NaN."""
    cosine = np.einsum("rij,rj,rik,rk->r", a[:, :3, :3], a_axis, b[:, :3, :3], b_axis)
    whole = np.degrees(se3.angle(se3.between(a, b)))
    return np.where(np.isnan(cosine), whole, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _curves(closures: Closures, judged: Judgement, revisit: Bools) -> dict[str, Floats]:
    rows = np.flatnonzero(judged.known)
    if not revisit.any() or not len(rows):
        return {}
    query, true = closures.query[rows], judged.at_place[rows]
    return {
        name: _curve(value[rows].astype(np.float64), true, query, revisit)
        for name, value in (("score", closures.score), ("inliers", closures.inliers))
    }


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


def _area(curve: Floats | None, revisits: bool) -> tuple[float | None, float | None]:
    """Average precision and the highest recall at precision 1; None without revisits, 0 without candidates."""
    if curve is None:
        return (0.0, 0.0) if revisits else (None, None)
    recall, precision, threshold = curve.T
    whole = Curve(threshold, precision, recall)
    return average_precision(whole), recall_at_full_precision(whole)


def _share(part: Any, whole: Any) -> float | None:
    return float(part / whole) if whole else None


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
    usable = closures.accepted & known[closures.query] & known[closures.match]
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
    """Errors of the keyframes' poses relative to reference keyframes, normalised by their covariances.

    Each figure is the median over the references.
    """

    keyframes: int
    """Number of keyframes with a covariance and a truth, without the reference."""
    nees: float | None
    """Mean of e' C^-1 e / 6 over the keyframes, about 1 for honest covariances. Neighbours share their errors, so that
    one drive alone is within a factor of 2 or 3 of 1."""
    median_sigma_m: float | None
    """Median over the keyframes of the standard deviation of the position: the root of the covariance's trace."""
    reason: str = ""
    """Why the covariances are not known, empty if they are."""


def score_poses(
    stamp_ns: Ints, world_from_body: Floats, references: Sequence[int], covariances: Iterable[Floats], truth: BodyTruth
) -> PoseScore:
    """Score keyframes (N, 4, 4) by their covariances (N, 6, 6) relative to each of `references`, NaN if unknown.

    An error of the truth at a reference is in the errors of all keyframes relative to it. The median over the
    references is robust to such errors. Covariances that are too small show at every reference.
    """
    at, scores = truth.at(stamp_ns), list[tuple[int, float, np.floating]]()
    known = at.known & truth.oriented
    for reference, covariance in zip(references, covariances, strict=True):
        rows = np.flatnonzero(known & known[reference] & np.isfinite(covariance).all((1, 2)))
        rows = rows[rows != reference]
        if len(rows):
            expected, found = (se3.between(p[[reference]], p[rows]) for p in (at.world_from_body, world_from_body))
            nees = float((_normalised(expected, found, covariance[rows]) ** 2).mean())
            sigma_m = np.median(np.sqrt(np.trace(covariance[rows, 3:, 3:], axis1=1, axis2=2)))
            scores.append((len(rows), nees, sigma_m))
    if not scores:
        return PoseScore(0, None, None)
    keyframes, nees, sigma_m = np.median(np.array(scores), axis=0).tolist()
    return PoseScore(int(keyframes), nees, sigma_m)


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
