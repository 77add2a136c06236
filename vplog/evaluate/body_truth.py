"""The truth as poses of the log's body, in the log's clock, at any stamp.

A truth file may be of another point (the camera, a marker), in another clock, and sampled once a second. The drive's
own odometry tells all three: it moves as the truth does, but for a drift that is small over the few metres between two
samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.data import Trajectory
from vplog.evaluate.pairs import around, poses_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Floats, Ints

    Bools = NDArray[np.bool_]

_MOST_OFFSET_S = 5.0
"""s; clocks that are further apart were never set, and a curve of speed matches others by chance."""
_LEAST_STEP_S = 0.1
"""s; speeds are compared over steps no shorter, since the noise of positions is divided by it."""
_MOST_STEPS = 20_000
"""Steps of the speed curves: half an hour at 10 Hz; longer drives are sampled more coarsely."""
_BETTER = 0.5
"""An offset, or another frame, must halve the disagreement with the odometry to be taken: chance does not."""
_WINDOWS = 400
"""Motions that truth and odometry are compared on; six unknowns are well determined by a tenth of them."""
_WINDOW_DEG = 30.0
"""A motion ends when it has turned so far: a lever of 1 m then shows by half a metre."""
_WINDOW_SHARE = 0.05
"""Or after this share of the path: the drift of the odometry over it is a twentieth of the drive's."""
_STEPS = 10
"""Alternations between the turn and the lever; two or three suffice, as either hardly depends on the other."""
_PRIOR = 1e-6
"""Weight of no turn at all against the motions: it settles what they leave open, and nothing else."""
_LEAST_SHOWN = 0.02
"""Of the best seen direction of a lever: what shows by less is noise."""
_LEAST_TURN_DEG = 5.0
"""What the odometry must turn for a truth that never does to hold positions alone."""


@dataclass(frozen=True, eq=False)
class TruthAt:
    """The truth at N stamps."""

    world_from_body: Floats
    """(N, 4, 4), NaN where unknown."""
    known: Bools
    """(N,) at a sample of the truth, or between two near in time."""
    error: Floats
    """(N, 2) rad and m by which it may be off, as it is interpolated and by its noise."""


@dataclass(frozen=True, eq=False)
class BodyTruth:
    """Ground truth of one drive."""

    trajectory: Trajectory
    """world_from_body, in the log's clock."""
    odometry: Trajectory | None = None
    """Moves the truth from sample to sample; None interpolates on the geodesic."""
    offset_s: float = 0.0
    """What was added to the truth's stamps."""
    frame: str = "body"
    """What the truth is of: `body`, `camera`, or `estimated`, a point that was found from the odometry."""
    body_from_truth: Floats | None = None
    """(4, 4) of that point; None for the body."""
    oriented: bool = True
    """Whether the truth has orientations, not positions alone."""
    noise: tuple[float, float] = (0.0, 0.0)
    """rad and m by which single poses of the truth are off their neighbours."""

    def at(self, stamp_ns: Ints) -> TruthAt:
        """Poses at the stamps.

        Between two samples the pose follows the odometry, laid on both: a Brownian bridge, whose error has
        sqrt(s (1 - s)) of the disagreement over the gap as its sigma at the share s of it.
        """
        truth = self.trajectory
        if self.odometry is None:
            poses, known = poses_at(truth, stamp_ns)
            return TruthAt(poses, known, np.zeros((len(stamp_ns), 2)))
        left, right, known = around(truth.stamp_ns, stamp_ns)
        left, right, at_ns = left[known], right[known], stamp_ns[known]
        moved = _at(self.odometry, at_ns)
        poses = [
            truth.world_from_body[row] @ geometry.inverse(_at(self.odometry, truth.stamp_ns[row])) @ moved
            for row in (left, right)
        ]
        share = (at_ns - truth.stamp_ns[left]) / np.maximum(truth.stamp_ns[right] - truth.stamp_ns[left], 1)
        apart = geometry.between(poses[0], poses[1])
        found, error = np.full((len(stamp_ns), 4, 4), np.nan), np.zeros((len(stamp_ns), 2))
        found[known] = geometry.interpolate(poses[0], poses[1], share)
        sizes = np.stack([geometry.angle(apart), np.linalg.norm(apart[:, :3, 3], axis=1)], axis=1)
        error[known] = np.hypot(np.sqrt(share * (1.0 - share))[:, None] * sizes, self.noise)
        return TruthAt(found, known, error)


def body_truth(
    truth: Trajectory, odometry: Trajectory, body_from_camera: Floats | None = None, shift_clock: bool = True
) -> BodyTruth:
    """The truth of a file as poses of the body, by the odometry (odom_from_body) of the drive.

    The clock is shifted, where it may be, if that halves the disagreement of the two curves of speed; the frame is that
    of the body, or of the camera, or one that is estimated, each only where it halves the disagreement of the motions.
    """
    offset_s = _clock_offset_s(truth, odometry) if shift_clock else 0.0
    truth = Trajectory(truth.stamp_ns + round(offset_s * 1e9), truth.world_from_body)
    inside = (truth.stamp_ns >= odometry.stamp_ns[0]) & (truth.stamp_ns <= odometry.stamp_ns[-1])
    rows = np.flatnonzero(inside)
    if len(rows) < 3 or len(odometry.stamp_ns) < 2:
        return BodyTruth(truth, odometry if len(odometry.stamp_ns) > 1 else None, offset_s)
    true, moved = truth.world_from_body[rows], _at(odometry, truth.stamp_ns[rows])
    if _turn_deg(true) < 0.01 and _turn_deg(moved) > _LEAST_TURN_DEG:
        return BodyTruth(truth, None, offset_s, oriented=False)
    frame, body_from_truth = _frame(true, moved, body_from_camera)
    if body_from_truth is not None:
        truth = Trajectory(truth.stamp_ns, truth.world_from_body @ geometry.inverse(body_from_truth))
    noise = _noise(truth, odometry)
    return BodyTruth(truth, odometry, offset_s, frame, body_from_truth, noise=noise)


def _noise(truth: Trajectory, odometry: Trajectory) -> tuple[float, float]:
    """rad and m: twice what every other pose is off the bridge between its neighbours, by the median.

    Their noise is in it with a half more of its variance; what the bridge itself may be off is taken off.
    """
    even = BodyTruth(Trajectory(truth.stamp_ns[::2], truth.world_from_body[::2]), odometry)
    at = even.at(truth.stamp_ns[1::2])
    if not at.known.any():
        return 0.0, 0.0
    apart = geometry.between(at.world_from_body[at.known], truth.world_from_body[1::2][at.known])
    sizes = np.stack([geometry.angle(apart), np.linalg.norm(apart[:, :3, 3], axis=1)], axis=1)
    rad, m = 2.0 / np.sqrt(1.5) * np.median(np.maximum(sizes - at.error[at.known], 0.0), axis=0)
    return float(rad), float(m)


def _at(trajectory: Trajectory, stamp_ns: Ints) -> Floats:
    """Poses at stamps, held at either end."""
    within = np.clip(stamp_ns, trajectory.stamp_ns[0], trajectory.stamp_ns[-1])
    return geometry.interpolate_at(trajectory.stamp_ns, trajectory.world_from_body, within)


def _turn_deg(poses: Floats) -> float:
    return float(np.degrees(geometry.angle(geometry.between(poses[:1], poses)).max()))


def _clock_offset_s(truth: Trajectory, odometry: Trajectory) -> float:
    """Seconds to add to the truth's stamps, by its speed and turning rate, which no frame changes."""
    start_ns = max(int(truth.stamp_ns[0]), int(odometry.stamp_ns[0]))
    span_s = (min(int(truth.stamp_ns[-1]), int(odometry.stamp_ns[-1])) - start_ns) / 1e9
    if min(len(truth.stamp_ns), len(odometry.stamp_ns)) < 3 or span_s <= 0:
        return 0.0
    periods = [float(np.median(np.diff(one.stamp_ns))) / 1e9 for one in (truth, odometry)]
    step_s = max(*periods, _LEAST_STEP_S, span_s / _MOST_STEPS)
    most = int(min(_MOST_OFFSET_S, span_s / 4.0) / step_s)
    if most < 1:
        return 0.0
    grid_ns = start_ns + (np.arange(int(span_s / step_s) + 1) * step_s * 1e9).astype(np.int64)
    rates = [_rates(one, grid_ns) for one in (truth, odometry)]
    _, _, known = around(truth.stamp_ns, grid_ns)
    rates[0][~(known[1:] & known[:-1])] = np.nan
    shifts = np.arange(-most, most + 1)
    cost = np.array([_unlike(rates[0], rates[1], shift) for shift in shifts.tolist()])
    best = int(cost.argmin())
    if shifts[best] == 0 or not cost[best] < _BETTER * cost[most]:
        return 0.0
    finer = 0.0
    if 0 < best < len(cost) - 1:  # the vertex of the parabola through the best and its neighbours
        before, here, after = cost[best - 1 : best + 2]
        finer = 0.5 * (before - after) / max(before - 2.0 * here + after, 1e-12)
    return float((shifts[best] + finer) * step_s)


def _rates(trajectory: Trajectory, grid_ns: Ints) -> Floats:
    """(G - 1, 2) metres and rad of each step of the grid."""
    poses = _at(trajectory, grid_ns)
    steps = geometry.between(poses[:-1], poses[1:])
    return np.stack([np.linalg.norm(steps[:, :3, 3], axis=1), geometry.angle(steps)], axis=1)


def _unlike(truth: Floats, odometry: Floats, shift: int) -> float:
    """1 less the correlation, mean over speed and turning rate, of the truth put `shift` steps later; 1 without any."""
    count = len(truth) - abs(shift)
    earlier, later = truth[max(-shift, 0) :][:count], odometry[max(shift, 0) :][:count]
    rows = np.isfinite(earlier).all(1)
    values = []
    for a, b in zip(earlier[rows].T, later[rows].T, strict=True):
        spread = float(a.std() * b.std()) if len(a) else 0.0
        if spread > 1e-12:
            values.append(1.0 - float(((a - a.mean()) * (b - b.mean())).mean()) / spread)
    return float(np.mean(values)) if values else 1.0


def _frame(true: Floats, moved: Floats, body_from_camera: Floats | None) -> tuple[str, Floats | None]:
    """What the truth's poses (T, 4, 4) are of, by those of the odometry: a name, and its pose on the body."""
    first, last = _windows(true)
    if len(first) < 3:
        return "body", None
    a = geometry.between(true[first], true[last])
    b = geometry.between(moved[first], moved[last])
    path = np.linalg.norm(b[:, :3, 3], axis=1)
    weight = 1.0 / np.maximum(path, max(float(path.mean()), 1e-6))  # turns on the spot tell no share of a shift
    same = _disagreement(a, b, np.eye(4), weight)
    camera = np.inf if body_from_camera is None else _disagreement(a, b, geometry.inverse(body_from_camera), weight)
    truth_from_body = _hand_eye(a, b, weight)
    found = _disagreement(a, b, truth_from_body, weight)
    if body_from_camera is not None and camera < _BETTER * same and camera <= found / _BETTER:
        return "camera", body_from_camera
    if found < _BETTER * same:
        return "estimated", geometry.inverse(truth_from_body)
    return "body", None


def _windows(poses: Floats) -> tuple[Ints, Ints]:
    """Ends of motions that turn by 30 degrees or take a twentieth of the path, spread over the drive."""
    steps = geometry.between(poses[:-1], poses[1:])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps[:, :3, 3], axis=1))])
    turned = np.concatenate([[0.0], np.cumsum(geometry.angle(steps))])
    share = length / max(_WINDOW_SHARE * length[-1], 1e-9)
    first = np.unique(np.linspace(0, len(poses) - 1, _WINDOWS).astype(np.int64))
    last = np.minimum(
        np.searchsorted(share, share[first] + 1.0), np.searchsorted(turned, turned[first] + np.radians(_WINDOW_DEG))
    )
    whole = last < len(poses)
    return first[whole], last[whole]


def _hand_eye(a: Floats, b: Floats, weight: Floats) -> Floats:
    """X = truth_from_body with a X = X b for motions (W, 4, 4) of the truth and of the body (Tsai & Lenz 1989).

    The odometry's metres may be off by one factor. What no motion tells, such as a lever along the one axis a car
    turns about, stays zero.
    """
    turn_a, turn_b = geometry.so3_log(a[:, :3, :3]), geometry.so3_log(b[:, :3, :3])
    size = float(np.linalg.norm(b[:, :3, 3], axis=1).mean())  # the lever in units of a motion, as the scale is
    shift, rotation = np.zeros(3), np.eye(3)
    for _ in range(_STEPS):
        # by turns and by shifts, both rotated by X; the lever's share of a shift is taken off first
        straight = a[:, :3, 3] + (a[:, :3, :3] @ shift) - shift
        across = turn_a.T @ turn_b + (straight * weight[:, None]).T @ (b[:, :3, 3] * weight[:, None])
        u, _, vt = np.linalg.svd(across + _PRIOR * np.linalg.norm(across) * np.eye(3))
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
        moved = b[:, :3, 3] @ rotation.T
        rows = np.concatenate([size * (np.eye(3) - a[:, :3, :3]), moved[:, :, None]], axis=2) * weight[:, None, None]
        wanted = (a[:, :3, 3] * weight[:, None]).reshape(-1)
        # directions that hardly show are left out: a turn of a degree tells no lever
        lever = np.linalg.lstsq(rows.reshape(-1, 4), wanted, rcond=_LEAST_SHOWN)[0][:3]
        shift = size * np.asarray(lever, np.float64)
    return geometry.pose(rotation, shift)


def _disagreement(a: Floats, b: Floats, truth_from_body: Floats, weight: Floats) -> float:
    """Root mean square of what the motions differ by, rad and shares of a shift, the largest twentieth left out."""
    predicted = truth_from_body @ b @ geometry.inverse(truth_from_body)
    rotation = geometry.between(predicted, a)[:, :3, :3]
    lever = truth_from_body[:3, 3] - a[:, :3, :3] @ truth_from_body[:3, 3]
    straight, moved = a[:, :3, 3] - lever, b[:, :3, 3] @ truth_from_body[:3, :3].T
    scale = float((straight * moved).sum() / max((moved**2).sum(), 1e-12))
    shift = np.linalg.norm(straight - max(scale, 0.0) * moved, axis=1) * weight
    error = np.sort(geometry.angle(rotation) ** 2 + shift**2)
    return float(np.sqrt(error[: max(1, int(0.95 * len(error)))].mean()))
