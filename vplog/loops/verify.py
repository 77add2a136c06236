"""The ledger: every proposed closure checked by geometry, the rejected ones with their reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Camera, Closures, Floats, Int32s, Ints, Keyframes, Trajectory
from vplog.execution.run_warnings import warn
from vplog.features.matching import PairMatches
from vplog.geometry import se3
from vplog.geometry.motion_comparison import Motions, compare_motions
from vplog.loops import undistort
from vplog.loops.calibration import (
    body_twists,
    compared_pairs,
    motion_covariance,
    stamp_covariance,
)
from vplog.loops.candidate import Drive, Row, VerifySettings, check_queries, check_reverse
from vplog.loops.landmarks import FeaturesOf, for_stereo
from vplog.loops.propose import Proposals

if TYPE_CHECKING:
    from vplog.execution.execution import Execution

_WARNED_SHARE = 0.05
"""Relative disagreement of camera and odometry that is warned of: five times a careful calibration's error."""
_WARNED_AXES_RAD = np.radians(30.0)
"""Angle between the axes of their rotations that is a wrong mount's: noise has some degrees."""
_WARNED_OFFSET_S = 0.05
"""Offset of the images' stamps that is warned of: at 10 m/s half a metre."""
_WARNED_LENGTHS = 0.4
"""Relative difference of the metres of depth and odometry that is warned of: wheels slip by less, and a focal length
that is 30 % off makes 0.7."""


def drive_of(
    keyframes: Keyframes,
    camera: Camera,
    features: FeaturesOf,
    settings: VerifySettings,
    matches: PairMatches | None = None,
) -> Drive:
    """A drive as its candidates are checked.

    `features` gives the features of a keyframe row and is called from any thread. With a stereo camera their depths are
    of the pair, whose error is in the disparity. Raises LogError for a calibrated camera with an unknown distortion
    model.
    """
    if camera.matrix is not None:
        focal_px = undistort.focal_px(camera)  # refuse an unknown lens before the work, not within it
        if camera.baseline_m is not None:
            stereo = for_stereo(settings.landmarks, focal_px, camera.baseline_m)
            settings = settings.model_copy(update={"landmarks": stereo})
    return Drive(keyframes, camera, features, settings, matches or PairMatches(features, settings.matching))


def verify_between(
    proposals: Proposals,
    later: Drive,
    earlier: Drive,
    execution: Execution,
    share: float,
) -> Closures:
    """The ledger of proposals whose queries are rows of `later` and whose matches are rows of `earlier`, in order.

    Both may be the same drive. Progress counts candidates. They are verified by map frame, whose landmarks are made
    once, and only when some query shares enough features with it; those accepted are then checked in reverse.
    `share` is the larger `calibration_share` of the two drives, 0 without calibration.
    """
    total = len(proposals.query)

    def check(group: Ints) -> list[Row]:
        return check_queries(later, earlier, int(proposals.match[group[0]]), proposals.query[group].tolist())

    def reverse(group: Ints) -> list[Row]:
        query, matches = int(proposals.query[group[0]]), proposals.match[group].tolist()
        return check_reverse(later, earlier, query, matches, [rows[at] for at in group.tolist()], share)

    rows: dict[int, Row] = {}
    groups = _by(proposals.match, proposals.query, np.arange(total))
    for group, found in zip(groups, execution.map(check, groups), strict=True):
        rows.update(zip(group.tolist(), found, strict=True))
        execution.progress("verify", len(rows), total)
    if later.settings.both_ways:
        accepted = np.flatnonzero([rows[at].pairs is not None for at in range(total)])
        groups = _by(proposals.query, proposals.match, accepted)
        for group, found in zip(groups, list(execution.map(reverse, groups)), strict=True):
            rows.update(zip(group.tolist(), found, strict=True))
    return _ledger(proposals, [rows[at] for at in range(total)], later, earlier, share)


def _by(key: Int32s, other: Int32s, rows: Ints) -> list[Ints]:
    """The ledger's `rows` in groups of one key, by increasing key, then other."""
    order = rows[np.lexsort([other[rows], key[rows]])]
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(rows) else []


def calibration_share(drive: Drive, execution: Execution, odometry: Trajectory | None = None) -> float:
    """Return the relative error of a calibrated camera's turns, and warn if its motions differ from the odometry's.

    The motions are those between pairs of keyframes. `odometry` has odom_from_body between the keyframes as well; None
    interpolates between them.
    """
    keyframes, camera, settings = drive.keyframes, drive.camera, drive.settings.calibration
    pairs = compared_pairs(keyframes, settings)
    found = execution.map(lambda pair: check_queries(drive, drive, pair[0], pair[1:]), pairs.tolist())
    good = [(at, row) for at, (row,) in enumerate(found) if row.pose.match_from_query is not None]
    earlier, later = keyframes.stamp_ns[pairs[[at for at, _ in good]].T]
    motions = np.array([row.pose.match_from_query for _, row in good]).reshape(-1, 4, 4)
    metric = np.array([row.scale != "odometry" for _, row in good], bool)
    track = odometry or Trajectory(keyframes.stamp_ns, keyframes.odom_from_body)
    compared = compare_motions(track, Motions(earlier, later, motions, metric), camera.body_from_camera)
    if compared is None:
        return settings.least_share
    offset, turned, lengths, turns = compared.offset_s, compared.turned_rad, compared.lengths, compared.turns
    share = float(np.clip(abs(turns.value - 1.0), settings.least_share, settings.most_share))
    if turned.differs(0.0, _WARNED_AXES_RAD):
        warn(
            f"Camera {camera.name!r} turns about another axis than the odometry, {np.degrees(turned.value):.0f} "
            "degrees off. Check its mount: the static transforms, or --calibration."
        )
    elif offset.differs(0.0, _WARNED_OFFSET_S):
        warn(
            f"The stamps of camera {camera.name!r} are {abs(offset.value):.2f} s (standard deviation "
            f"{offset.sigma:.3f} s) {'late' if offset.value < 0 else 'early'} against the odometry. --image-offset-s "
            f"{offset.value:.2f} corrects them; if you gave an offset, add it."
        )
    elif lengths.differs(1.0, _WARNED_LENGTHS):
        warn(
            f"Camera {camera.name!r} moves {lengths.value:.2g} times as far by its depth as by odometry. Check the "
            "unit of the depth, or the baseline, and the scale of the odometry."
        )
    elif share > _WARNED_SHARE:
        or_more = " or more" if share == settings.most_share else ""
        warn(
            f"Camera {camera.name!r} and odometry disagree by {100.0 * share:.0f} %{or_more} on rotations, so closures "
            "get a larger covariance. Check the focal length."
        )
    return share


def body_pose(match_from_query: Floats, query: Camera, match: Camera) -> Floats:
    """match_from_query (4, 4) of the bodies, from that of their cameras."""
    return match.body_from_camera @ match_from_query @ se3.inverse(query.body_from_camera)


def _ledger(proposals: Proposals, rows: list[Row], later: Drive, earlier: Drive, share: float) -> Closures:
    """The columns of the ledger; poses and their information moved from the cameras to the bodies."""
    count, camera = len(rows), later.camera
    pose, information = np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
    body_from_camera = se3.adjoint(camera.body_from_camera)
    twists = [body_twists(drive.keyframes) for drive in (earlier, later)]
    stamp_sigma_s = later.settings.calibration.stamp_sigma_s
    for at, row in enumerate(rows):
        found, covariance = row.pose.match_from_query, row.pose.covariance
        if found is None:
            continue
        pose[at] = body_pose(found, camera, earlier.camera)
        if covariance is not None:
            total = body_from_camera @ (covariance + motion_covariance(found, share)) @ body_from_camera.T
            speeds = twists[0][proposals.match[at]], twists[1][proposals.query[at]]
            inverse = np.linalg.inv(total + stamp_covariance(pose[at], *speeds, stamp_sigma_s))
            information[at] = (inverse + inverse.T) / 2.0
    return Closures(
        **vars(proposals),
        shared_references=[np.empty(0, np.uint16)] * count,
        shared_overlap=[np.empty(0, np.float32)] * count,
        matches=np.array([row.matches for row in rows], np.int32),
        landmarks=np.array([row.landmarks for row in rows], np.int32),
        inliers=np.array([row.pose.inliers for row in rows], np.int32),
        spread=np.array([row.pose.spread for row in rows], np.float32),
        reverse_inliers=np.array([row.reverse_inliers for row in rows], np.int32),
        scale=[row.scale for row in rows],
        match_from_query=pose,
        information=information,
        verdict=[row.pose.verdict for row in rows],
        p_false=np.full(count, np.nan),
        residual_before=np.full(count, np.nan),
        residual_after=np.full(count, np.nan),
        weight=np.full(count, np.nan),
        query_camera=np.zeros(count, np.int32),
        match_camera=np.zeros(count, np.int32),
    )


def no_closures() -> Closures:
    """The ledger of a drive without candidates."""
    rows, shares, none = np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0)
    return Closures(
        query=rows, match=rows, rank=rows, score=shares, support=rows, shared_references=[], shared_overlap=[],
        matches=rows, landmarks=rows, inliers=rows, spread=shares, reverse_inliers=rows, scale=[],
        match_from_query=np.empty((0, 4, 4)), information=np.empty((0, 6, 6)), verdict=[], p_false=none,
        residual_before=none, residual_after=none, weight=none, query_camera=rows, match_camera=rows,
    )  # fmt: skip
