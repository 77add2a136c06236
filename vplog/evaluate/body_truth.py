"""The truth as poses of the log's body at any stamp.

A truth file may be of another point (the camera, a marker) and sampled once a second. Both are resolved by the drive's
odometry, whose drift is small over the few metres between two samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Bools, Floats, Ints, Trajectory
from vplog.evaluate.pairs import bracketing, poses_at
from vplog.geometry import se3
from vplog.geometry.pose_conventions import AS_GIVEN, POSE_CONVENTIONS

_OTHER_MOTION = 1.0 / 3.0
"""Disagreement with the odometry from which the truth may not be this drive's: the right one of a drive whose odometry
drifts has a tenth, another drive's or one whose stamps are 2 s off two thirds."""
_ALIKE_NS, _ALIKE_M = 30 * 10**9, 0.1
"""Longest time of the motions that tell that, over which the odometry hardly drifts; and their least mean length: of
turns on the spot the shifts are noise."""
_BETTER = 0.5
"""Largest ratio of the disagreements with the odometry at which another frame or convention is chosen: noise does not
halve it."""
_MAX_SCALE_ERROR = 0.2
"""Largest relative error of the length of odometry: uncalibrated wheels and visual odometry have up to a tenth."""
_ALTERNATES = 0.5
"""Ratio of the distances between every second pose and between neighbours; half of that of noise."""
_UNITS_PER_M = {"mm": 1000.0, "cm": 100.0}
"""Units of length in which trackers write ground truth."""
_MOTIONS = 400
"""Motions that truth and odometry are compared on; six unknowns are well determined by a tenth of them."""
_MOTION_SHARE = 20
"""Motions take one part in 20 of the drive: the drift of the odometry over it is a twentieth of the drive's."""
_PRIOR = 1e-3
"""Weight of no turn at all against the motions: it settles what they leave open, and nothing else."""
_ROUNDS = 10
"""Alternations of rotation and lever: a lever of a motion's length takes so many to settle to a tenth of a degree."""
_LEAST_SHOWN = 0.02
"""Singular values of the lever's equations below this share of the largest are noise."""
_NOISE_BOUND = 2.62
"""The length of three Gaussians: its 99.9 % bound, 4.03 sigma, over its median, 1.54 sigma."""
_MOST_OFFSET_NS = 5_000_000_000
"""Furthest that a truth's clock is looked for on either side of the log's."""
_WINDOW_NS = 1_000_000_000
"""Time of the motions that clocks are compared on: a second, as GNSS has fixes, and less than most manoeuvres take."""
_CLOCK_MOTIONS, _LEAST_MOTIONS = 100, 20
"""Motions that clocks are compared on."""
_LEAST_TURN_DEG = 5.0
"""Least rotation of the odometry by which a truth that never turns is one of positions alone."""


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
    """world_from_body."""
    odometry: Trajectory | None = None
    """Moves the truth from sample to sample, in its metres; None interpolates on the geodesic."""
    frame: str = "body"
    """Frame of the truth: `body`, `camera`, or `estimated`, a point that was found from the odometry."""
    oriented: bool = True
    """Whether the truth has orientations, not positions alone."""
    noise: tuple[float, float] = (0.0, 0.0)
    """rad and m by which single poses of the truth are off their neighbours."""
    offset_s: float = 0.0
    """s to add to the truth's stamps for its motions to be those of the odometry; 0 where that is not clear."""
    disagreement: float = 0.0
    """Median of what its motions of up to `_ALIKE_NS` and those of the odometry differ by, rad and shares of their
    length; 0 where they are shorter than `_ALIKE_M`."""

    convention: str = AS_GIVEN
    """The key of POSE_CONVENTIONS in which the file has its poses; they are converted."""
    unit: str = "m"
    """Unit of length of the file, by the path of the odometry; it is converted to m."""
    scale: float = 1.0
    """Length of the path of the ground truth, after conversion to m, per m of the odometry."""
    as_read: Trajectory | None = None
    """The poses of the file, converted to world_from_frame in m but still of `frame`; None without odometry."""

    @property
    def holds_two_trajectories(self) -> bool:
        """True if poses alternate between two places, as those of two trajectories in one file do.

        The distance between every second pose is twice the distance between neighbours on a smooth path, and as long
        as that if poses are noise.
        """
        positions = self.trajectory.world_from_body[:, :3, 3]
        second, neighbour = (np.linalg.norm(positions[k:] - positions[:-k], axis=1).sum() for k in (2, 1))
        return bool(second < _ALTERNATES * neighbour)

    @property
    def is_of_other_motion(self) -> bool:
        return self.disagreement > _OTHER_MOTION

    @property
    def has_other_scale(self) -> bool:
        """True if the lengths of ground truth and odometry differ by more than odometry is wrong."""
        return self.scale > 0 and abs(np.log(self.scale)) > np.log1p(_MAX_SCALE_ERROR)

    def at(self, stamp_ns: Ints) -> TruthAt:
        """Poses at the stamps.

        Between two samples the pose follows the odometry, laid on both: a Brownian bridge, whose error has
        sqrt(s (1 - s)) of the disagreement over the gap as its sigma at the share s of it.
        """
        truth = self.trajectory
        if self.odometry is None:
            poses, known = poses_at(truth, stamp_ns)
            return TruthAt(poses, known, np.zeros((len(stamp_ns), 2)))
        left, right, known = bracketing(truth.stamp_ns, stamp_ns)
        left, right, at_ns = left[known], right[known], stamp_ns[known]
        moved = _at(self.odometry, at_ns)
        poses = [
            truth.world_from_body[row] @ se3.inverse(_at(self.odometry, truth.stamp_ns[row])) @ moved
            for row in (left, right)
        ]
        share = (at_ns - truth.stamp_ns[left]) / np.maximum(truth.stamp_ns[right] - truth.stamp_ns[left], 1)
        apart = se3.between(poses[0], poses[1])
        found, error = np.full((len(stamp_ns), 4, 4), np.nan), np.zeros((len(stamp_ns), 2))
        found[known] = se3.interpolate(poses[0], poses[1], share)
        sizes = np.stack([se3.angle(apart), np.linalg.norm(apart[:, :3, 3], axis=1)], axis=1)
        error[known] = np.hypot(np.sqrt(share * (1.0 - share))[:, None] * sizes, self.noise)
        return TruthAt(found, known, error)


def body_truth(truth: Trajectory, odometry: Trajectory, body_from_camera: Floats | None = None) -> BodyTruth:
    """The truth of a file as poses of the body, by the odometry (odom_from_body) of the drive.

    Poses in another of POSE_CONVENTIONS, or in mm or cm, are converted. The frame is the body's, the camera's, or
    estimated (hand-eye). Each of these replaces the default only if it halves the disagreement of the motions.
    """
    rows = np.flatnonzero((truth.stamp_ns >= odometry.stamp_ns[0]) & (truth.stamp_ns <= odometry.stamp_ns[-1]))
    if len(rows) < 3 or len(odometry.stamp_ns) < 2:
        return BodyTruth(truth)
    true, moved = truth.world_from_body[rows], _at(odometry, truth.stamp_ns[rows])
    turned = [se3.angle(se3.between(poses[:1], poses)).max() for poses in (true, moved)]
    if turned[0] < np.radians(0.01) and turned[1] > np.radians(_LEAST_TURN_DEG):
        return BodyTruth(truth, oriented=False)
    convention, frame, truth_from_body, scale = _frame(true, moved, body_from_camera)
    unit, per_m = _unit(scale)
    convert, scale = POSE_CONVENTIONS[convention], scale / per_m
    truth_from_body[:3, 3] /= per_m
    truth, true = Trajectory(truth.stamp_ns, _in_m(convert(truth.world_from_body), per_m)), _in_m(convert(true), per_m)
    period_ns = max(int(np.median(np.diff(truth.stamp_ns[rows]))), 1)
    a, b = _motions(true, moved, min(max(1, _ALIKE_NS // period_ns), _longest(len(rows))))
    long = np.linalg.norm(a[:, :3, 3], axis=1).mean() > _ALIKE_M
    apart = _disagreement(a, b, truth_from_body, _weights(a))[0] if long else 0.0
    poses = odometry.world_from_body.copy()
    poses[:, :3, 3] *= scale if scale > 0 else 1.0
    odometry = Trajectory(odometry.stamp_ns, poses)
    poses = truth.world_from_body @ truth_from_body
    found = BodyTruth(
        Trajectory(truth.stamp_ns, poses), odometry, frame, disagreement=apart, convention=convention, unit=unit,
        scale=scale, as_read=truth,
    )  # fmt: skip
    frames = [truth_from_body, np.eye(4)] + ([] if body_from_camera is None else [se3.inverse(body_from_camera)])
    return replace(found, noise=_noise(found.trajectory, odometry), offset_s=_offset_s(truth, odometry, frames))


def _offset_s(truth: Trajectory, odometry: Trajectory, frames: list[Floats]) -> float:
    """s to add to the stamps of the truth for its motions over _WINDOW_NS to be those of the odometry; 0 where that
    does not halve their disagreement. `frames` are what truth_from_body may be: a wrong clock hides which."""
    ends = odometry.stamp_ns[[0, -1]] + np.array([_MOST_OFFSET_NS, -_MOST_OFFSET_NS - _WINDOW_NS])
    first = np.flatnonzero((truth.stamp_ns >= ends[0]) & (truth.stamp_ns <= ends[1]))
    first = first[:: max(1, len(first) // _CLOCK_MOTIONS)]
    last = np.searchsorted(truth.stamp_ns, truth.stamp_ns[first] + _WINDOW_NS).clip(max=len(truth.stamp_ns) - 1)
    near = np.abs(truth.stamp_ns[last] - truth.stamp_ns[first] - 1.5 * _WINDOW_NS) <= 0.5 * _WINDOW_NS
    first, last = first[near], last[near]
    if len(first) < _LEAST_MOTIONS:
        return 0.0
    a = se3.between(truth.world_from_body[first], truth.world_from_body[last])
    weight = _weights(a)

    def apart(shifts_ns: Ints) -> Floats:
        here, there = (_at(odometry, truth.stamp_ns[rows] + shifts_ns[:, None]) for rows in (first, last))
        motions = se3.between(here, there)
        return np.array([min(_disagreement(a, b, frame, weight)[0] for frame in frames) for b in motions])

    best = 0
    for step_ns in (_MOST_OFFSET_NS // 25, _MOST_OFFSET_NS // 500):
        shifts_ns = best + step_ns * np.arange(-25, 26)
        best = int(shifts_ns[apart(shifts_ns).argmin()])
    least, given = apart(np.array([best, 0]))
    return best / 1e9 if least < _BETTER * given else 0.0


def _noise(truth: Trajectory, odometry: Trajectory) -> tuple[float, float]:
    """rad and m: the 99.9 % bound of single poses, by what every other one is off the bridge between its neighbours.

    A half more of its variance is from the neighbours' noise.
    """
    even = BodyTruth(Trajectory(truth.stamp_ns[::2], truth.world_from_body[::2]), odometry)
    at = even.at(truth.stamp_ns[1::2])
    if not at.known.any():
        return 0.0, 0.0
    apart = se3.between(at.world_from_body[at.known], truth.world_from_body[1::2][at.known])
    sizes = np.stack([se3.angle(apart), np.linalg.norm(apart[:, :3, 3], axis=1)], axis=1)
    rad, m = _NOISE_BOUND / np.sqrt(1.5) * np.median(sizes, axis=0)
    return float(rad), float(m)


def _at(trajectory: Trajectory, stamp_ns: Ints) -> Floats:
    """Poses at stamps, held at either end."""
    within = np.clip(stamp_ns, trajectory.stamp_ns[0], trajectory.stamp_ns[-1])
    return se3.interpolate_at(trajectory.stamp_ns, trajectory.world_from_body, within)


def _longest(count: int) -> int:
    """Samples that a motion takes at most, of so many."""
    return max(1, count // _MOTION_SHARE)


def _motions(true: Floats, moved: Floats, step: int) -> tuple[Floats, Floats]:
    """(W, 4, 4) motions of the truth and of the odometry, poses (T, 4, 4), over `step` samples, spread over both."""
    first = np.unique(np.linspace(0, len(true) - 1 - step, _MOTIONS).astype(np.int64))
    return se3.between(true[first], true[first + step]), se3.between(moved[first], moved[first + step])


def _frame(true: Floats, moved: Floats, body_from_camera: Floats | None) -> tuple[str, str, Floats, float]:
    """Return how the poses of the truth (T, 4, 4) are to be read, by those of the odometry.

    That is the key of POSE_CONVENTIONS, the name of the frame, truth_from_body (4, 4), and the length in the truth per
    m of the odometry, which is arbitrary for monocular odometry. Estimated frames come last, because their six unknowns
    fit more: in the plane they explain another convention, too.
    """
    step, mounts = _longest(len(true)), {"body": np.eye(4)}
    if body_from_camera is not None:
        mounts["camera"] = se3.inverse(body_from_camera)
    motions = {name: _motions(convert(true), moved, step) for name, convert in POSE_CONVENTIONS.items()}
    tried = [(name, frame, mounts[frame]) for name in motions for frame in mounts]
    tried += [(name, "estimated", _hand_eye(a, b, _weights(b))) for name, (a, b) in motions.items()]
    best, least = (AS_GIVEN, "body", np.eye(4), 1.0), np.inf
    for convention, frame, truth_from_body in tried:
        a, b = motions[convention]
        apart, scale = _disagreement(a, b, truth_from_body, _weights(a))
        if apart < least and (convention == AS_GIVEN or apart < _OTHER_MOTION):
            best, least = (convention, frame, truth_from_body, scale), _BETTER * apart
    return best


def _unit(scale: float) -> tuple[str, float]:
    """Return the unit of the truth and its number per m, if lengths in the truth are `scale` times the odometry's."""
    for unit, per_m in _UNITS_PER_M.items():
        if scale > 0 and abs(np.log(scale / per_m)) < np.log1p(_MAX_SCALE_ERROR):
            return unit, per_m
    return "m", 1.0


def _in_m(poses: Floats, per_m: float) -> Floats:
    poses = poses.copy()
    poses[:, :3, 3] /= per_m
    return poses


def _weights(motions: Floats) -> Floats:
    """(W,) one over the shift of each motion (W, 4, 4), the mean shift at least: a turn on the spot has no share."""
    shift = np.linalg.norm(motions[:, :3, 3], axis=1)
    return 1.0 / np.maximum(shift, max(float(shift.mean()), 1e-6))


def _hand_eye(a: Floats, b: Floats, weight: Floats) -> Floats:
    """X = truth_from_body with a X = X b for motions (W, 4, 4) of the truth and of the body (Tsai & Lenz 1989).

    The odometry's metres may be off by one factor. What no motion determines, such as a lever along the one axis
    a car turns about, stays zero; OpenCV's calibrateHandEye has neither the factor nor motions about one axis.
    """
    size = float(np.linalg.norm(b[:, :3, 3], axis=1).mean())  # the lever in units of a motion, as the scale is
    lever, rotation, weight = np.zeros(3), np.eye(3), weight[:, None]
    for _ in range(_ROUNDS):
        straight = a[:, :3, 3] + a[:, :3, :3] @ lever - lever
        across = se3.so3_log(a[:, :3, :3]).T @ se3.so3_log(b[:, :3, :3])
        across += (straight * weight).T @ (b[:, :3, 3] * weight)
        u, _, vt = np.linalg.svd(across + _PRIOR * np.linalg.norm(across) * np.eye(3))
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
        moved = b[:, :3, 3] @ rotation.T
        rows = np.concatenate([size * (np.eye(3) - a[:, :3, :3]), moved[:, :, None]], axis=2) * weight[:, :, None]
        found = np.linalg.lstsq(rows.reshape(-1, 4), (a[:, :3, 3] * weight).reshape(-1), rcond=_LEAST_SHOWN)[0]
        lever = size * np.asarray(found[:3], np.float64)
    return se3.pose(rotation, lever)


def _disagreement(a: Floats, b: Floats, truth_from_body: Floats, weight: Floats) -> tuple[float, float]:
    """Median of what the motions differ by, rad and shares of a shift, and the scale of b's shifts that it is with."""
    turned = truth_from_body[:3, :3] @ b[:, :3, :3] @ truth_from_body[:3, :3].T
    lever = truth_from_body[:3, 3] - turned @ truth_from_body[:3, 3]
    shift, wanted = b[:, :3, 3] @ truth_from_body[:3, :3].T, a[:, :3, 3] - lever
    square = (shift**2).sum(1)
    long = square >= max(float(square.mean()), 1e-12)
    scale = float(np.median((shift * wanted).sum(1)[long] / square[long])) if long.any() else 1.0
    turn = se3.angle(se3.pose(np.swapaxes(turned, 1, 2) @ a[:, :3, :3], np.zeros(3)))
    return float(np.median(np.hypot(turn, np.linalg.norm(wanted - scale * shift, axis=1) * weight))), scale
