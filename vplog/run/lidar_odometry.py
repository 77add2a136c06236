"""Odometry of a lidar: scans registered to the map of those before by KISS-ICP (Vizzo et al. 2023), point to point.

The covariance of a step is that of its residuals: what the scan's surfaces do not hold, as the way along a tunnel, is
unknown. Points of a turning lidar lie on rings, and rings pull the pose to where the last ones were, which residuals do
not show; by how far it is off, its distance from the pose by points and planes tells.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vplog.data import Floats, Lidar, Odometry, Scan
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.stamps import longest_gap_ns

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_FARTHEST_M = 100.0
"""m; KISS-ICP's largest range, whose hundredth is the side of its voxels."""
_LONGEST_TURN = 1.5
"""Periods that the times of a scan's points span at most."""
_RANGES = 3.0, 0.95
"""Times the range that this share of the points is within: KISS-ICP's 100 m outdoors, 20 m in a room of 7 m, where
voxels of 1 m would leave nothing of it."""
_NEAREST_M = 1.0
"""m; the least of these ranges, of a room of 30 cm."""
_LEAST = 50
"""Points of a scan that can be registered: voxels of a room's walls are some hundreds."""
_LEAST_SHARE = 0.3
"""Share of the points that must have a neighbour in the scan before, within a voxel: between scans of a turning sensor
with gaps it is above a half, between different places below a fifth."""
_MOST_PERIODS = 10
"""Periods of scans that were lost, for which the motion of the last one is continued at most."""
_NEIGHBOURS = 10
"""Points whose plane is a surface: as many as PCL and Open3D take for normals, a few times the three of a plane."""
_FLAT = 0.1
"""Largest variance of a surface off its plane, as a share of that along its narrower side: noise on a wall, no edge."""
_RANGE_SIGMA_M = 0.02
"""m; noise of a range, by the data sheets of Velodyne and Ouster 1 to 5 cm: residuals below it are luck."""
_STEPS = 5
"""Steps before and behind, by which that distance is averaged: with their own more than its six dimensions."""
_UNKNOWN = np.eye(6)
"""Covariance of a motion across a break, and of what no surface holds: a radian, a metre."""


class _Scan(NamedTuple):
    """A scan in voxels, in the lidar's frame at its last point."""

    map_points: Floats
    """(P, 3) m of half the map's voxels, which the map takes."""
    points: Floats
    """(K, 3) m of one and a half, which are registered."""


class _Residuals(NamedTuple):
    """A motion by its residuals."""

    covariance: Floats
    """(6, 6) in the frame that it leads to."""
    off: Floats
    """(6,) from the motion by points and planes to it, rotation first."""


@dataclass(eq=False)
class _Tracker:
    """State of the registration from scan to scan."""

    range_m: float
    patience_ns: int
    """Scans that match nothing are passed over for so long; then, as after a gap as long, the next piece begins."""
    longest_s: float
    """Times of points that span as much are shares of a turn or of another unit, and tell their order alone."""
    stamp_ns: list[int] = field(default_factory=list)
    pose: list[Floats] = field(default_factory=list)
    covariance: list[Floats] = field(default_factory=list)
    """(6, 6) of the motion since the scan before by its residuals, in the lidar."""
    off: list[Floats] = field(default_factory=list)
    """(6,) by which that motion is off the one by planes."""
    breaks: list[int] = field(default_factory=list)
    icp: Any = None
    """KISS-ICP's map, thresholds and registration of this piece."""
    surface: KDTree | None = None
    """The last scan's points, in its frame."""
    step: Floats = field(default_factory=lambda: np.eye(4))
    """Motion in a period, as KISS-ICP's last_delta."""
    period_ns: int = 0

    def add(self, scan: Scan) -> None:
        """Take the next scan."""
        seconds = np.zeros(0) if scan.seconds is None else scan.seconds
        late_s = float(seconds.max()) if len(seconds) and np.ptp(seconds) < self.longest_s else 0.0
        end_ns = scan.stamp_ns + round(late_s * 1e9)
        since_ns = end_ns - self.stamp_ns[-1] if self.stamp_ns else 0
        if len(scan.points) < _LEAST or (self.stamp_ns and since_ns <= 0):
            return
        if self.icp is None or since_ns > self.patience_ns:
            self._start(scan.points, end_ns)
            return
        turn = self._voxels(scan.points, seconds)
        if len(turn.points) < _LEAST:
            return
        periods = round(since_ns / self.period_ns) if self.period_ns else 1
        guess = self.pose[-1] @ _times(self.step, min(max(periods, 1), _MOST_PERIODS))
        pose = self._registered(turn, guess)
        moved = se3.between(self.pose[-1], pose)
        residuals = step_residuals(self.surface, turn.points, moved, self.icp.config.mapping.voxel_size)
        if residuals is None:
            return
        self.icp.adaptive_threshold.update_model_deviation(se3.between(guess, pose))
        self.step = _times(moved, 1 / max(periods, 1))
        self.period_ns = since_ns // max(periods, 1)
        self._append(turn, end_ns, pose, residuals)

    def _start(self, points: Floats, end_ns: int) -> None:
        """Begin a piece where the last one ended."""
        self.icp, self.step, self.period_ns = new_registration(self.range_m), np.eye(4), 0
        turn = self._voxels(points, np.zeros(0))
        if len(turn.points) < _LEAST:
            self.icp = None
            return
        if self.stamp_ns:
            self.breaks.append(len(self.stamp_ns))
        self._append(turn, end_ns, self.pose[-1] if self.pose else np.eye(4), _Residuals(_UNKNOWN, np.zeros(6)))

    def _append(self, turn: _Scan, end_ns: int, pose: Floats, residuals: _Residuals) -> None:
        from scipy.spatial import KDTree  # a quarter of a second that runs without a lidar need not wait

        self.icp.local_map.update(turn.map_points, pose)
        self.surface = KDTree(turn.map_points)
        self.stamp_ns.append(end_ns)
        self.pose.append(pose)
        self.covariance.append(residuals.covariance)
        self.off.append(residuals.off)

    def _voxels(self, points: Floats, seconds: Floats) -> _Scan:
        """The scan without its motion, in voxels (KISS-ICP, sections III-A and III-B)."""
        source, map_points = self.icp.voxelize(self.icp.preprocessor.preprocess(points, seconds, self.step))
        return _Scan(map_points, source)

    def _registered(self, turn: _Scan, guess: Floats) -> Floats:
        """The pose by the map (KISS-ICP, section III-C)."""
        sigma = self.icp.adaptive_threshold.get_threshold()
        return self.icp.registration.align_points_to_map(turn.points, self.icp.local_map, guess, 3 * sigma, sigma)

    def odometry(self, body_from_lidar: Floats) -> Odometry | None:
        """None where fewer than two scans have a pose."""
        if len(self.stamp_ns) < 2:
            return None
        moved = se3.adjoint(body_from_lidar)
        covariance = moved @ (np.stack(self.covariance) + _mean_square(np.stack(self.off))) @ moved.T
        poses = body_from_lidar @ np.stack(self.pose) @ se3.inverse(body_from_lidar)
        breaks = np.array(self.breaks, np.int64)
        return Odometry(np.array(self.stamp_ns), poses, covariance, breaks=breaks, increments=True)


def lidar_odometry(scans: Iterable[Scan], range_m: float, lidar: Lidar) -> Odometry | None:
    """The motion of the body by the scans of a lidar up to a range; None where fewer than two have a pose. Scans that
    match nothing have none. The covariance is that of each scan's motion since the one before it. Stamps are those of
    the last points. Raises LogError where kiss-icp is not installed."""
    periods_ns = np.diff(lidar.stamp_ns)
    longest_s = _LONGEST_TURN * float(np.median(periods_ns)) / 1e9 if len(periods_ns) else np.inf
    tracker = _Tracker(range_m, longest_gap_ns(lidar.stamp_ns), longest_s)
    for scan in scans:
        tracker.add(scan)
    return tracker.odometry(lidar.body_from_lidar)


def range_of(scans: Iterable[Scan]) -> float:
    """The range in m up to which points are used, by the widest of some scans."""
    times, share = _RANGES
    ranges = [np.linalg.norm(scan.points, axis=1) for scan in scans]
    widest = max((float(np.quantile(one[one > 0], share)) for one in ranges if one.any()), default=_FARTHEST_M)
    return min(max(times * widest, _NEAREST_M), _FARTHEST_M)


def new_registration(range_m: float) -> Any:
    """KISS-ICP with its defaults up to this range. Raises LogError where it is not installed."""
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        raise LogError(
            "Odometry of a lidar needs KISS-ICP, which is not installed. Install it: pip install kiss-icp"
        ) from None
    voxel_m = range_m / 100
    config = KISSConfig(  # all parts given, or environment variables would set them
        data=DataConfig(max_range=range_m),
        mapping=MappingConfig(voxel_size=voxel_m),
        registration=RegistrationConfig(max_num_threads=1),  # sums of several threads differ in their last bits
        adaptive_threshold=AdaptiveThresholdConfig(initial_threshold=2.0 * voxel_m, min_motion_th=0.1 * voxel_m),
    )
    return KissICP(config)


def step_residuals(surface: KDTree | None, points: Floats, moved: Floats, voxel_m: float) -> _Residuals | None:
    """Residuals of the motion `moved` (4, 4) from the last scan, with points `surface`, to one with (K, 3) `points`.
    The noise is that from point to point, as it is minimised; a surface holds what moves off its plane. None where too
    few points have a neighbour."""
    if surface is None:
        return _Residuals(_UNKNOWN, np.zeros(6))
    there = se3.transform(moved, points)
    distance, row = map(np.asarray, surface.query(there, distance_upper_bound=voxel_m))
    near = np.isfinite(distance)
    if near.mean() < _LEAST_SHARE:
        return None
    normals, flat = _normals(surface, row[near])
    normals, used = normals[flat], np.flatnonzero(near)[flat]
    here = normals @ moved[:3, :3]  # in the frame of the points
    jacobian = np.concatenate([np.cross(points[used], here), here], axis=1)
    off_plane = np.sum((there[used] - np.asarray(surface.data)[row[used]]) * normals, axis=1)
    scale = max(1.4826 * float(np.median(np.abs(off_plane))) if len(used) else 0.0, _RANGE_SIGMA_M)
    weighted = jacobian / (1 + (off_plane / scale) ** 2)[:, None]  # Cauchy
    prior = np.linalg.inv(_UNKNOWN)
    off = np.linalg.solve(weighted.T @ jacobian / scale**2 + prior, weighted.T @ off_plane / scale**2)
    variance = max(float((distance[near] ** 2).mean()) / 3, _RANGE_SIGMA_M**2)
    noise = np.asarray(np.linalg.inv(jacobian.T @ jacobian / variance + prior), np.float64)
    return _Residuals(noise, np.asarray(off, np.float64))


def _mean_square(off: Floats) -> Floats:
    """(T, 6, 6) means of the outer products of (T, 6) over the steps about each, the diagonals twice: the pose by
    planes errs as much again, in what direction is not known."""
    sums = np.cumsum(np.concatenate([np.zeros((1, 6, 6)), off[:, :, None] * off[:, None, :]]), axis=0)
    first = np.maximum(np.arange(len(off)) - _STEPS, 0)
    last = np.minimum(np.arange(len(off)) + _STEPS + 1, len(off))
    mean = (sums[last] - sums[first]) / (last - first)[:, None, None]
    return mean * (1 + np.eye(6))


def _normals(surface: KDTree, rows: np.ndarray) -> tuple[Floats, np.ndarray]:
    """(K, 3) normals of the surface at its points `rows`, and (K,) whether it is flat there."""
    _, around = surface.query(surface.data[rows], min(_NEIGHBOURS, surface.n))
    spread = np.asarray(surface.data)[around]
    spread = spread - spread.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(spread, 1, 2) @ spread)
    return vectors[:, :, 0], values[:, 0] < _FLAT * values[:, 1]


def _times(motion: Floats, share: float) -> Floats:
    """A share of a motion (4, 4), or several of it."""
    return motion if share == 1 else se3.exp(share * se3.log(motion[None]))[0]
