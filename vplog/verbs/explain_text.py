"""A row of the ledger in plain sentences: what was proposed and why, the results of geometry and solver, what would
change the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import ACCEPTED, USED, Floats, Keyframes, Verdict
from vplog.geometry import se3 as geometry

if TYPE_CHECKING:
    from vplog.pipeline import Pipeline

    Row = dict[str, Any]

_NAMED = 4
"""References named in a sentence; the table has them all."""
_TYPICAL_SIGMA, _MOST_SIGMA = 2.3, 3.5
"""Median and 95 % of the length of six independent normal errors, square roots of chi-square's 5.35 and 12.6."""
_SCALE = {
    "odometry": "Its metres come from the odometry between the map's own frames.",
    "depth": "Its metres come from the depth images.",
    "stereo": "Its metres come from the stereo pair.",
}


@dataclass(frozen=True)
class Explanation:
    """Paragraphs of one to four sentences that explain one closure."""

    verdict: str
    proposed: str
    geometry: str
    solver: str
    change: str


def describe(
    row: Row, keyframes: Keyframes, world_from_body: Floats, siblings: list[str], pipeline: Pipeline, reason: str
) -> Explanation:
    """Describe one ledger row, by column.

    `world_from_body` (N, 4, 4) are the solved poses, `siblings` the verdicts of all candidates of its query, `reason`
    the solver's sentence on the whole run.
    """
    verdict = Verdict(row["verdict"])
    became = "Accepted" if verdict in ACCEPTED else "Used" if verdict in USED else f"Rejected, {verdict.value}"
    return Explanation(
        f"{became}: {verdict.sentence}",
        _proposed(row, keyframes, siblings),
        _geometry(row),
        _solver(row, keyframes, world_from_body, reason),
        _change(row, pipeline),
    )


def _proposed(row: Row, keyframes: Keyframes, siblings: list[str]) -> str:
    query, match, start = row["query"], row["match"], keyframes.stamp_ns[0]
    at_s = [(row[f"{role}_stamp_ns"] - int(start)) / 1e9 for role in ("query", "match")]
    path = keyframes.odom_from_body[match : query + 1, :3, 3]
    between_m = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    sentences = [
        f"Keyframe {query} ({at_s[0]:.1f} s into the drive) was proposed as a return to keyframe {match} "
        f"({at_s[1]:.1f} s), {between_m:.1f} m of path earlier.",
        f"It ranks {row['rank'] + 1} of this keyframe's {len(siblings)} candidates, "
        f"{sum(one in ACCEPTED for one in siblings)} of them accepted; its score is {row['score']:.3f}"
        + (
            f", with {_count(row['support'], 'neighbouring pair')} in agreement by sequence." if row["support"] else "."
        ),
    ]
    shared = list(zip(row["shared_references"], row["shared_overlap"], strict=True))
    if shared:
        named = ", ".join(f"no. {number} ({100 * share:.0f} %)" for number, share in shared[:_NAMED])
        more = f" and {len(shared) - _NAMED} more" if len(shared) > _NAMED else ""
        sentences.append(
            f"{_count(len(shared), 'reference image')} of the library {'explain' if len(shared) > 1 else 'explains'} "
            f"both views: {named}{more}; in brackets, how much of a box the two have in common there."
        )
    return " ".join(sentences)


def _geometry(row: Row) -> str:
    sentences = [f"The two images have {_count(row['matches'], 'feature match', 'es')}"]
    if row["landmarks"]:
        sentences[0] += f", {row['landmarks']} of them with a known position in the map"
    sentences[0] += (
        f"; {row['inliers']} agree with one geometry" if row["inliers"] else "; none agree with one geometry"
    )
    sentences[0] += f" and cover {100 * row['spread']:.0f} % of the image." if row["spread"] else "."
    if row["reverse_inliers"] >= 0:
        sentences.append(f"Checked in reverse, {row['reverse_inliers']} agree.")
    if row["tx"] is not None:
        moved = np.array([row["tx"], row["ty"], row["tz"]])
        turn = geometry.rotation(np.array([row["qx"], row["qy"], row["qz"], row["qw"]]))
        turned = f"is turned by {np.degrees(geometry.angle(turn)):.1f} degrees"
        if row["scale"] == "none":
            sentences.append(
                f"By this pose keyframe {row['query']} {turned}; its direction is known, its distance is not."
            )
        else:
            sentences.append(
                f"By this pose keyframe {row['query']} lies {np.linalg.norm(moved):.2f} m from keyframe {row['match']} "
                f"(x {moved[0]:+.2f}, y {moved[1]:+.2f}, z {moved[2]:+.2f} in its body frame) and {turned}."
            )
            sentences += [_certainty(row["covariance"]), _SCALE[row["scale"]]]
    return " ".join(sentences)


def _certainty(covariance: list[float] | None) -> str:
    if covariance is None:
        return "Some direction of it is unconstrained."
    matrix = np.reshape(covariance, (6, 6))
    turn, shift = (np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0)) for part in (matrix[:3, :3], matrix[3:, 3:]))
    return f"Its standard deviation in the worst direction is {shift:.3f} m and {np.degrees(turn):.2f} degrees."


def _solver(row: Row, keyframes: Keyframes, world_from_body: Floats, reason: str) -> str:
    query, match = row["query"], row["match"]
    odometry_m, solved_m = (
        float(np.linalg.norm(poses[query, :3, 3] - poses[match, :3, 3]))
        for poses in (keyframes.odom_from_body, world_from_body)
    )
    apart = f"The two keyframes are {odometry_m:.2f} m apart by the odometry and {solved_m:.2f} m in the result."
    if row["weight"] is None:
        return f"It was not given to the solver. {apart}"
    residuals = (row[f"residual_{when}"] for when in ("before", "after"))
    before, after = ("an unknown number of sigma" if one is None else f"{one:.1f} sigma" for one in residuals)
    return (
        f"The odometry alone is {before} away from it, and the solved trajectory {after} (for a true closure "
        f"{_TYPICAL_SIGMA} is usual, and more than {_MOST_SIGMA} rare). Its weight in the robust solve is "
        f"{row['weight']:.2f}. {apart} The solve of the whole run: {reason}"
    )


def _count(number: int, name: str, plural: str = "s") -> str:
    return f"{number or 'no'} {name}{plural if number != 1 else ''}"


def _change(row: Row, pipeline: Pipeline) -> str:
    """The change that would lead to another verdict, in a sentence."""
    verdict, verify = Verdict(row["verdict"]), pipeline.verify
    metric = bool(row["landmarks"])
    needed = verify.epipolar.min_inliers
    if metric:
        needed = max(verify.metric.min_inliers, int(np.ceil(verify.metric.min_share * row["landmarks"])))
    name = verdict.value
    if verdict is Verdict.TOO_FEW_INLIERS and row["inliers"] >= needed:
        name = "by_chance"
    return _CHANGES[name].format(
        **row,
        verify=verify,
        kind="metric" if metric else "epipolar",
        compared=row["landmarks"] or row["matches"],
        needed=needed,
        share=", min_share" if metric else "",
        spread_percent=100 * (verify.metric if metric else verify.epipolar).min_spread,
        metric_percent=100 * verify.metric.min_spread,
    )


_CHANGES = {
    "accepted": "It would be rejected with fewer than {needed} inliers, if they covered less than "
    "{metric_percent:.0f} % of the image, or if the robust solve found it at odds with the rest.",
    "too_few_matches": "{verify.min_matches} matches are needed (verify.min_matches), or their part among the "
    "strongest {verify.matching.first_look} features. --set verify.min_matches={matches}, or a "
    "verify.matching.ratio above {verify.matching.ratio:g}, would verify it, and many false candidates with it.",
    "too_few_landmarks": "{verify.metric.min_inliers} matches with a position are needed (verify.metric.min_inliers). "
    "Depth images, or more sideways motion around keyframe {match}, would give more of them one.",
    "too_few_inliers": "{needed} inliers are needed (verify.{kind}.min_inliers{share}), and {inliers} were found.",
    "by_chance": "Enough agree, {needed} being needed, but so many of {compared} may do so by chance "
    "(verify.{kind}.log10_false_alarms).",
    "poor_spread": "{spread_percent:.0f} % of the image must be covered (verify.{kind}.min_spread): less is one "
    "object, such as a sign or a parked car, that may stand anywhere.",
    "degenerate_motion": "Depth images, or frames around keyframe {match} that move sideways, would give its features "
    "positions.",
    "no_calibration": "Record the camera's camera_info, or name it with --camera-info-topic: then a pose with "
    "{verify.metric.min_inliers} inliers would make it a closure.",
    "implausible_pose": "The distance may be {verify.metric.max_depths:g} of the inliers' median depth "
    "(verify.metric.max_depths); beyond it two views hardly share what they see.",
    "too_far": "Up to {verify.metric.max_distance_m:g} m are taken (verify.metric.max_distance_m). Nearer keyframes of "
    "the same pass have a smaller error; see the other candidates of this keyframe.",
    "inconsistent": "Both ways must give one pose. Where they do not, the scene repeats itself, or too little of it is "
    "seen from both; see the other candidates of keyframe {query}. --set verify.both_ways=false checks one way.",
    "rejected_by_solver": "It would be kept if the odometry or other closures agreed with it. Where it is right, the "
    "odometry's noise is set too small or the neighbouring closures are false: look at the candidates around keyframe "
    "{query} with a weight of 1, and at the noise settings (`noise`).",
    "not_significant": "It would be used at a false rate of {p_false:.2g} (--false-rate), or without one.",
    "accepted_by_decision": "Without its line in the file of decisions geometry and the robust solve would judge it.",
    "rejected_by_decision": "Without its line in the file of decisions geometry and the robust solve would judge it.",
    "direction_only": "Metres would need landmarks: keyframes around the match that moved further, a depth image or a "
    "stereo pair.",
}
"""The change that would lead to another, by verdict; `by_chance` where enough inliers for a pose may be chance."""
