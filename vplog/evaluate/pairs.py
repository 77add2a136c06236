"""Which rows of a map show the place of a query: from a list of pairs, by number, by pose, by position."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy

from vplog.data import Bools, Floats, Int32s, Ints, Trajectory
from vplog.geometry import se3

MAX_GAP_S = 2.0
"""s; truth further apart than this is not interpolated: at 10 m/s a curve in between costs metres."""
_UPRIGHT = 0.9
"""Length of the mean of unit vectors: they are within some 25 degrees of each other."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """The true pairs of Q queries and M map rows, as runs of neighbouring rows: few, even where drives stand."""

    start: Ints
    """(Q + 1,) query q has the runs start[q]..start[q + 1]."""
    first: Int32s
    """(R,) first map row of a run; runs of a query increase and do not touch."""
    stop: Int32s
    """(R,) the row after its last."""

    def __len__(self) -> int:
        return len(self.start) - 1

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Pairs) and all(map(np.array_equal, vars(self).values(), vars(other).values()))

    __hash__ = None

    @property
    def positive(self) -> Bools:
        """(Q,) queries that have a true row."""
        return np.diff(self.start) > 0

    @property
    def count(self) -> int:
        """Pairs in all."""
        return int((self.stop - self.first).sum(dtype=np.int64))

    def rows(self, query: int) -> Int32s:
        """The true rows of one query, increasing."""
        runs = slice(self.start[query], self.start[query + 1])
        parts = [np.arange(a, b, dtype=np.int32) for a, b in zip(self.first[runs], self.stop[runs], strict=True)]
        return np.concatenate(parts) if parts else np.zeros(0, np.int32)

    def below(self, stops: Ints) -> Pairs:
        """The pairs whose row is below the query's stop, (Q,): those that are candidates at all."""
        owner = np.repeat(np.arange(len(self)), np.diff(self.start))
        stop = np.minimum(self.stop, stops[owner]).astype(np.int32)
        some = self.first < stop
        counts = np.bincount(owner[some], minlength=len(self))
        return Pairs(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), self.first[some], stop[some])


def index_pairs(query: Ints, match: Ints, tolerance: int) -> Pairs:
    """Frame i of one traversal shows the place of frame i of the other, give or take `tolerance`.

    `query` (Q,) and `match` (M,) are the numbers of the frames, increasing.
    """
    first = np.searchsorted(match, query - tolerance, side="left")
    stop = np.searchsorted(match, query + tolerance, side="right")
    some = first < stop
    start = np.concatenate([[0], np.cumsum(some)]).astype(np.int64)
    return Pairs(start, first[some].astype(np.int32), stop[some].astype(np.int32))


def listed_pairs(listed: Ints, query: Ints, match: Ints) -> Pairs:
    """The pairs of a list (P, 2) of frame numbers, as rows of `query` (Q,) and `match` (M,), increasing numbers.

    Pairs of frames that are not among these are left out.
    """
    listed = np.unique(listed[np.isin(listed[:, 0], query) & np.isin(listed[:, 1], match)], axis=0)
    rows = np.searchsorted(match, listed[:, 1]).astype(np.int32)
    ends = np.searchsorted(listed[:, 0], query, side="right")
    begins = np.searchsorted(listed[:, 0], query, side="left")
    return _runs(rows[begin:end] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True))


def pose_pairs(
    query: Floats,
    match: Floats,
    distance_m: float,
    heading_deg: float,
    query_axis: Floats | None = None,
    match_axis: Floats | None = None,
) -> Pairs:
    """Poses (Q, 4, 4) and (M, 4, 4) in one frame that are within a distance and a heading of each other.

    The heading is the angle between the optical axes, unit vectors (3,) in either body's frame: a camera that is rolled
    about its axis sees the same place. Where an axis is not known it is the angle of the whole rotation.
    """
    cosine = np.cos(np.radians(min(heading_deg, 180.0)))
    if query_axis is not None and match_axis is not None:
        least, looks, sees = cosine, query[:, :3, :3] @ query_axis, match[:, :3, :3] @ match_axis
    else:  # the trace of a rotation is 1 + 2 cos(angle)
        least, looks, sees = 1.0 + 2.0 * cosine, query[:, :3, :3].reshape(-1, 9), match[:, :3, :3].reshape(-1, 9)
    near = _near(query[:, :3, 3], match[:, :3, 3], distance_m)
    # the margin is for rounding at 180 degrees, which allows all
    return _runs(rows[sees[rows] @ looks[q] >= least - 1e-9] for q, rows in enumerate(near))


def optical_axis(body_from_camera: Floats | None, poses: Floats) -> Floats | None:
    """(3,) the camera's axis in the body's frame, None where it is not known.

    An identity may stand for a log without the camera's mount. Then z is the optical axis unless the body's poses
    (N, 4, 4) move across a z that hardly turns, as a vehicle's whose z points up.
    """
    if body_from_camera is None:
        return None
    axis = body_from_camera[:3, 2]
    if not np.array_equal(body_from_camera, np.eye(4)):
        return axis
    if not len(poses):
        return None
    z = poses[:, :3, 2]
    step = np.diff(poses[:, :3, 3], axis=0)
    along = np.abs((step * z[:-1]).sum(1)) / np.maximum(np.linalg.norm(step, axis=1), 1e-12)
    upright = np.linalg.norm(z.mean(0)) > _UPRIGHT and (not len(along) or np.median(along) < 1.0 - _UPRIGHT)
    return None if upright else axis


def position_pairs(query: Floats | Ints, match: Floats | Ints, distance_m: float) -> Pairs:
    """Positions (Q, D) and (M, D) in one frame that are within a distance of each other."""
    return _runs(_near(query, match, distance_m))


def poses_at(truth: Trajectory, at_ns: Ints) -> tuple[Floats, Bools]:
    """The truth at the stamps, (N, 4, 4), and (N,) where it is known: at a pose of it, or between two near in time."""
    left, right, known = bracketing(truth.stamp_ns, at_ns)
    poses = np.full((len(at_ns), 4, 4), np.nan)
    poses[known & (left == right)] = truth.world_from_body[right[known & (left == right)]]
    between = known & (left != right)
    if between.any():
        poses[between] = se3.interpolate_at(truth.stamp_ns, truth.world_from_body, at_ns[between])
    return poses, known


def positions_at(stamp_ns: Ints, positions: Floats, at_ns: Ints) -> tuple[Floats, Bools]:
    """Positions (T, D) at increasing stamps (T,), at other stamps: (N, D), and (N,) where known, as `poses_at`."""
    _, _, known = bracketing(stamp_ns, at_ns)
    result = np.full((len(at_ns), positions.shape[1]), np.nan)
    if known.any():
        seconds = (stamp_ns - stamp_ns[0]) / 1e9  # float64 holds the ns of a drive, not those since 1970
        at = (at_ns[known] - stamp_ns[0]) / 1e9
        result[known] = np.column_stack([np.interp(at, seconds, axis) for axis in positions.T])
    return result, known


def bracketing(stamp_ns: Ints, at_ns: Ints, max_gap_s: float = MAX_GAP_S) -> tuple[Ints, Ints, Bools]:
    """Rows of the samples before and after each stamp, one and the same where it is hit, and where that is known: by
    samples that are no further apart than the gap."""
    if not len(stamp_ns):
        nothing = np.zeros(len(at_ns), np.int64)
        return nothing, nothing, np.zeros(len(at_ns), bool)
    right = np.minimum(np.searchsorted(stamp_ns, at_ns), len(stamp_ns) - 1)
    hit = stamp_ns[right] == at_ns
    left = np.where(hit, right, np.maximum(right - 1, 0))
    inside = (stamp_ns[left] < at_ns) & (at_ns < stamp_ns[right])
    return left, right, hit | (inside & (stamp_ns[right] - stamp_ns[left] <= max_gap_s * 1e9))


def _near(query: Floats | Ints, match: Floats | Ints, distance_m: float) -> Iterable[Int32s]:
    """For each query the increasing rows of `match` within the distance, one query at a time: not Q x M."""
    tree = scipy.spatial.KDTree(match)
    for position in query:
        yield np.array(tree.query_ball_point(position, distance_m, return_sorted=True), np.int32)


def _runs(rows_of_each: Iterable[Int32s]) -> Pairs:
    """Pairs from the increasing rows of each query."""
    counts, first, stop = [0], [], []
    for rows in rows_of_each:
        breaks = np.flatnonzero(np.diff(rows) > 1)
        if len(rows):
            first.append(rows[np.concatenate([[0], breaks + 1])])
            stop.append(rows[np.concatenate([breaks, [len(rows) - 1]])] + 1)
        counts.append(len(breaks) + 1 if len(rows) else 0)
    nothing = [np.zeros(0, np.int32)]
    return Pairs(
        np.cumsum(counts).astype(np.int64),
        np.concatenate(first or nothing).astype(np.int32),
        np.concatenate(stop or nothing).astype(np.int32),
    )
