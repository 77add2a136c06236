"""Visual odometry of a camera with depth, of a stereo pair, or of a single camera, whose unit of length is its own.

Corners of a reference frame are followed into the next frames by optical flow (Lucas & Kanade 1981); a frame's pose is
that of P3P in RANSAC, refined, as a closure's. A frame that shows too little of the
reference becomes the next one, and a bundle adjustment of the last references refines their poses and landmarks.
Without depth a piece begins with two views that have enough parallax, and a point becomes a landmark when the views
of the window make its depth sure.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from vplog.data import Camera, Float32s, Floats, Frame, Odometry
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.odometry.bundle_adjustment import Observations, adjust
from vplog.odometry.ground import Below, below, by_height
from vplog.odometry.metric_scale import scaled
from vplog.odometry.sensor import Points, Sensor, follow
from vplog.odometry.tracking import Motion, ReferenceFrame, cloud, corners, solve, track
from vplog.odometry.two_views import CERTAINTY, UNIT_DEPTH, rho_of, rho_variance, two_views

_WINDOW = 8
"""References that are adjusted together: as libviso's and VINS' 5 to 10; what is older hardly shares a landmark."""
_SHARED = 0.75
"""A frame with less than this share of its reference's points becomes one."""
_FLOW = 0.05
"""So does a frame whose points moved by this share of the image's width: beyond it patches no longer look alike."""
_LEAST = 30
"""Points with depth that a first frame needs: half as many again as a pose does."""
_LEFT = 0.4
"""Share of the points of a first view that must still be followed; else the next frame is taken for it."""
_MOST_BETWEEN = 256
"""Frames without parallax that are kept to be placed: 10 s of a standing camera at 25 Hz."""
PERIOD_NS = 70_000_000
"""ns between frames that are followed, at most, where the rate is higher: at 15 Hz the same references are made as at
30 Hz, for two thirds of the time. A frame between them is followed only where the next is lost."""
_MOST_PASSED = 3
"""Frames between them, at most: three at 60 Hz. Stamps may run faster than the camera did."""
_PATIENCE_NS = 10**9
"""ns for which a frame that is lost is passed over, as a blurred one; then the next piece begins."""

_UNKNOWN = np.eye(6)
"""Covariance of a motion across a break: a radian, a metre."""


@dataclass(eq=False)
class _View:
    """A reference within the window, or behind it, when only its pose counts."""

    world_from_camera: Floats
    row: int
    """Row of its frame among those with a pose."""
    motion: Floats
    """(6, 6) covariance of the motion since the reference before it."""
    depth: float = math.nan
    """Median of its landmarks'."""


@dataclass(eq=False)
class _Start:
    """The first view of a piece of a camera without depth, until a later one has parallax to it."""

    frame: Frame
    points: Points
    last: Frame
    """The last frame, to which points were followed from frame to frame."""
    rows: np.ndarray
    """Points that were found in it."""
    px: Float32s
    between: list[tuple[int, np.ndarray, Points]] = field(default_factory=list)
    """Stamp of each frame without enough parallax, the points found there, and where."""

    def follow(self, frame: Frame, sensor: Sensor) -> Points:
        """The points found in the next frame, `rows`."""
        found = follow(self.last.image, frame.image, self.px, self.px)
        observed = sensor.measure(frame, found)
        good = np.flatnonzero(np.isfinite(np.column_stack([found, observed.rays])).all(axis=1))
        self.last, self.rows, self.px = frame, self.rows[good], found[good]
        return observed.rows(good)

    def passed(self, stamp_ns: int, observed: Points) -> None:
        """Keep a frame without enough parallax, thinned out where the camera stands for long."""
        self.between.append((stamp_ns, self.rows, observed))
        if len(self.between) > _MOST_BETWEEN:
            del self.between[::2]


@dataclass(eq=False)
class Tracker:
    """State of the tracking from frame to frame."""

    sensor: Sensor
    height_m: float | None = None
    """Height of the camera over the ground, where it gives a camera without depth its metres."""
    below: list[Below] = field(default_factory=list)
    """Landmarks below the camera in each view, where its height is known."""
    stamp_ns: list[int] = field(default_factory=list)
    view: list[int] = field(default_factory=list)
    """The reference of each frame with a pose."""
    view_from_camera: list[Floats] = field(default_factory=list)
    by_points: list[Floats] = field(default_factory=list)
    """(6, 6) covariance of each, by one view alone."""
    views: list[_View] = field(default_factory=list)
    breaks: list[int] = field(default_factory=list)
    """Rows of frames at which a piece begins, but for the first."""
    reference: ReferenceFrame | None = None
    start: _Start | None = None
    passed: list[Frame] = field(default_factory=list)
    """Frames since the last that was followed."""
    arrived_ns: int = 0
    """Stamp of the last frame."""
    window: deque[tuple[int, np.ndarray, Points]] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    """View, landmarks and measurements of the last references of this piece."""
    world: dict[int, Floats] = field(default_factory=dict)
    """(3,) of the landmarks that the window shows."""

    def add(self, frame: Frame) -> None:
        """Take the next frame."""
        period_ns, self.arrived_ns = frame.stamp_ns - self.arrived_ns, frame.stamp_ns
        following = self.reference is not None and self.start is None
        since_ns = frame.stamp_ns - self.stamp_ns[-1] if self.stamp_ns else 0
        if following and not self._is_needed(frame) and since_ns + period_ns <= PERIOD_NS:
            self.passed.append(frame)
            return
        passed, self.passed = self.passed, []
        if passed and since_ns <= PERIOD_NS and self._follow(frame):
            return
        for one in (*passed, frame):
            self._take(one)

    def _is_needed(self, frame: Frame) -> bool:
        """Whether the frame must not be passed over: after some that were, or with depth where the reference has none,
        as with depth at a lower rate."""
        return len(self.passed) == _MOST_PASSED or self._gives_depth(frame)

    def _gives_depth(self, frame: Frame) -> bool:
        reference = self.reference
        return self.sensor.metric and reference is not None and _has_depth(frame) and not _has_depth(reference.frame)

    def _take(self, frame: Frame) -> None:
        followed_ns = self.stamp_ns[-1] if self.stamp_ns else -math.inf
        if self.start is not None:
            self._follow_start(self.start, frame)
        elif not self._follow(frame) and frame.stamp_ns - followed_ns > _PATIENCE_NS:
            self._start(frame)

    def _follow(self, frame: Frame) -> bool:
        """Add a frame that can be followed from the reference; False where it is lost."""
        if self.reference is None:
            return False
        tracked = track(self.reference, frame, self._guess(frame.stamp_ns), self.sensor)
        if tracked is None:
            return False
        extended, motion = tracked
        if extended is self.reference and not self._is_far(extended, motion) and not self._gives_depth(frame):
            self._add_frame(frame.stamp_ns, motion)
        else:
            self.stamp_ns.append(frame.stamp_ns)
            self._extend(extended)
            self._add_view(frame, extended, motion)
        return True

    def _add_frame(self, stamp_ns: int, motion: Motion) -> None:
        """Add a frame that is no reference."""
        self.stamp_ns.append(stamp_ns)
        self.view.append(self.view[-1])
        self.view_from_camera.append(motion.reference_from_camera)
        self.by_points.append(motion.covariance + motion.systematic)

    def _start(self, frame: Frame) -> None:
        """Begin a piece where the last one ended; nothing where the frame has too few points with depth."""
        points = self._usable(frame, corners(frame, np.zeros((0, 2), np.float32)))
        self.start = None
        if len(points.px) < _LEAST:
            return
        if not self.sensor.metric:
            self.start = _Start(frame, points, frame, np.arange(len(points.px)), points.px)
            return
        ids = self._free() + np.arange(len(points.px))
        self._add_reference(frame, self._first_view(frame.stamp_ns), ids, points)

    def _first_view(self, stamp_ns: int) -> _View:
        """The first of a piece, where the last one ended."""
        if self.stamp_ns:
            self.breaks.append(len(self.stamp_ns))
        pose = self._pose(-1) if self.stamp_ns else np.eye(4)
        self.window.clear()
        self.world.clear()
        self.stamp_ns.append(stamp_ns)
        return _View(pose, len(self.stamp_ns) - 1, _UNKNOWN)

    def _follow_start(self, start: _Start, frame: Frame) -> None:
        """Begin the piece where the frame has enough parallax to its first view."""
        observed = start.follow(frame, self.sensor)
        if len(start.rows) < max(_LEAST, len(start.points.px) * _LEFT):
            self._start(frame)
            return
        first = start.points.rows(start.rows)
        found = two_views(first, observed, self.sensor.focal_px, _LEAST)
        if found is not None:
            rows, first = start.rows[found.rows], first.rows(found.rows)
            centre, ray_variance = found.first_from_second[:3, 3], (self.sensor.pixel_sigma / self.sensor.focal_px) ** 2
            shown = np.ones((1, len(rows)), bool)
            variance = rho_variance(found.first, centre[None], shown, ray_variance)
            points = replace(first, rays=found.first[:, :2] / found.first[:, 2:], rho=1.0 / found.first[:, 2])
            ids = self._free() + np.arange(len(rows))
            reference = ReferenceFrame(start.frame, ids, replace(points, variance=variance), int(ids[-1]) + 1)
            motion = solve(reference, np.arange(len(rows)), observed.rows(found.rows), self.sensor)
            if motion is not None:
                self._begin(start, rows, reference, first)
                self.stamp_ns.append(frame.stamp_ns)
                self._add_view(frame, reference, motion)
                return
        start.passed(frame.stamp_ns, observed)

    def _begin(self, start: _Start, rows: np.ndarray, reference: ReferenceFrame, measured: Points) -> None:
        """Add the first view, and the frames between it and the second one, by the points `rows` of the start."""
        view = self._first_view(start.frame.stamp_ns)
        at = se3.transform(view.world_from_camera, cloud(reference.points))
        self.world.update(zip(reference.ids.tolist(), at, strict=True))
        self._add_pose(view, reference.ids, measured)
        self.start = None
        for stamp_ns, there, observed in start.between:
            both, mine, theirs = np.intersect1d(rows, there, assume_unique=True, return_indices=True)
            if len(both) and (motion := solve(reference, mine, observed.rows(theirs), self.sensor)) is not None:
                self._add_frame(stamp_ns, motion)

    def _add_view(self, frame: Frame, reference: ReferenceFrame, motion: Motion) -> None:
        """Make a tracked frame the next reference, and adjust the window."""
        ids, points = reference.ids[motion.rows], motion.points
        new = self._usable(frame, corners(frame, points.px))
        first = self._free()
        pose = self.views[-1].world_from_camera @ motion.reference_from_camera
        view = _View(pose, len(self.stamp_ns) - 1, motion.covariance + motion.systematic)
        ids = np.concatenate([ids, first + np.arange(len(new.px))])
        self._add_reference(frame, view, ids, points.joined(new), motion.systematic)

    def _add_reference(
        self, frame: Frame, view: _View, ids: np.ndarray, points: Points, systematic: Floats | None = None
    ) -> None:
        self._add_pose(view, ids, points)
        self._place(view, ids, points)
        if systematic is not None:
            self._adjust(systematic)
        self.reference = self._reference(frame)

    def _add_pose(self, view: _View, ids: np.ndarray, points: Points) -> None:
        """Add a view to the window."""
        self.views.append(view)
        self.view.append(len(self.views) - 1)
        self.view_from_camera.append(np.eye(4))
        self.by_points.append(view.motion)
        self.window.append((len(self.views) - 1, ids, points))

    def _free(self) -> int:
        """The least number that no landmark has."""
        return 1 + max((int(ids.max(initial=-1)) for _, ids, _ in self.window), default=-1)

    def _usable(self, frame: Frame, px: np.ndarray) -> Points:
        """The points that have a ray, and a depth where there are any."""
        points = self.sensor.measure(frame, px)
        known = np.isfinite(points.noise).all(axis=(1, 2)) & np.isfinite(points.rays).all(axis=1)
        return points.rows(np.flatnonzero(known & np.isfinite(points.rho) if self.sensor.metric else known))

    def _place(self, view: _View, ids: np.ndarray, points: Points) -> None:
        """Landmarks where the view that first shows them measures them; without depth, where the window's views make
        their depth sure."""
        if not self.sensor.metric:
            self._triangulate(view, ids, points)
            return
        new = np.array([number not in self.world for number in ids.tolist()], bool)
        ray = np.column_stack([points.rays, np.ones(len(ids))])[new]
        placed = se3.transform(view.world_from_camera, ray / points.rho[new, None])
        self.world.update(zip(ids[new].tolist(), placed, strict=True))

    def _triangulate(self, view: _View, ids: np.ndarray, points: Points) -> None:
        new = np.flatnonzero([number not in self.world for number in ids.tolist()])
        if len(self.window) < 2 or not len(new):
            return
        poses = np.stack([self.views[other].world_from_camera for other, _, _ in self.window])[:-1]
        observed = self._observed(ids[new])[:-1]
        views = se3.between(poses, view.world_from_camera)
        rho, variance = rho_of(points.rays[new], observed, views, self.sensor.pixel_sigma / self.sensor.focal_px)
        sure = np.flatnonzero(rho > CERTAINTY * np.sqrt(variance))
        ray = np.column_stack([points.rays[new[sure]], np.ones(len(sure))])
        placed = se3.transform(view.world_from_camera, ray / rho[sure, None])
        self.world.update(zip(ids[new[sure]].tolist(), placed, strict=True))

    def _observed(self, ids: np.ndarray) -> Floats:
        """(V, K, 2) rays of landmarks in the views of the window, NaN where they are not shown."""
        result = np.full((len(self.window), len(ids), 2), np.nan)
        for row, (_, shown, points) in enumerate(self.window):
            _, mine, theirs = np.intersect1d(ids, shown, assume_unique=True, return_indices=True)
            result[row, mine] = points.rays[theirs]
        return result

    def _extend(self, reference: ReferenceFrame) -> None:
        """Give the newest view the points that were matched since."""
        view, ids, points = self.window[-1]
        more = np.flatnonzero(~np.isin(reference.ids, ids))
        if len(more):
            added = reference.points.rows(more)
            self._place(self.views[view], reference.ids[more], added)
            self.window[-1] = view, np.concatenate([ids, reference.ids[more]]), points.joined(added)

    def _adjust(self, systematic: Floats) -> None:
        """Bundle adjustment of the window; `systematic` (6, 6) adds to the covariance of the newest motion."""
        shown = np.concatenate([ids for _, ids, _ in self.window])
        often, count = np.unique(shown, return_counts=True)
        placed = np.array([number in self.world for number in often.tolist()], bool)
        landmarks = often[(count > 1) & placed]
        columns = []
        for row, (_, ids, points) in enumerate(self.window):
            used = np.isin(ids, landmarks)
            chosen = points.rows(used)
            xyrho = np.column_stack([chosen.rays, chosen.rho])
            at = np.searchsorted(landmarks, ids[used])
            columns.append((np.full(len(at), row), at, xyrho, chosen.noise, chosen.variance))
        observed = Observations(*(np.concatenate(column) for column in zip(*columns, strict=True)))
        views = [self.views[view] for view, _, _ in self.window]
        start = np.stack([view.world_from_camera for view in views])
        points = np.stack([self.world[number] for number in landmarks.tolist()])
        found = adjust(start, points, observed, self.sensor.metric)
        if found is not None:
            for view, pose in zip(views, found.world_from_camera, strict=True):
                view.world_from_camera = pose
            views[-1].motion = found.last_motion + systematic
            self.world.update(zip(landmarks.tolist(), found.points, strict=True))
        self.world = {number: self.world[number] for number in often[placed].tolist()}

    def _reference(self, frame: Frame) -> ReferenceFrame:
        """The newest view, its landmarks by all views that show them."""
        view, ids, points = self.window[-1]
        pose = self.views[view].world_from_camera
        nowhere = np.full(3, np.nan)
        at = se3.transform(se3.inverse(pose), np.stack([self.world.get(number, nowhere) for number in ids.tolist()]))
        front = ~(at[:, 2] <= 0)
        at, ids, points = at[front], ids[front], points.rows(front)
        if not self.sensor.metric:
            estimated = self._estimated(ids, points, at)
            if len(known := at[np.isfinite(at[:, 2]), 2]):
                self.views[view].depth = float(np.median(known))
            if self.height_m is not None:
                sure = estimated.rho > CERTAINTY * np.sqrt(estimated.variance)
                found = below(self.views[view].row, cloud(estimated.rows(np.flatnonzero(sure))), self.sensor.camera)
                self.below.append(found)
            return ReferenceFrame(frame, ids, estimated, self._free())
        shown = np.concatenate([other for _, other, _ in self.window])
        times = (np.sort(shown).searchsorted(ids, "right") - np.sort(shown).searchsorted(ids, "left")).clip(1)
        rho = 1.0 / at[:, 2]
        # a point without depth in this view, or every one, is as sure as one that is measured there
        own = np.where(np.isfinite(points.variance), points.variance, self.sensor.rho_variance(rho))
        estimated = type(points)(points.px, at[:, :2] * rho[:, None], points.noise, rho, own / times)
        return ReferenceFrame(frame, ids, estimated, self._free())

    def _estimated(self, ids: np.ndarray, points: Points, at: Floats) -> Points:
        """The points with the depths of their landmarks at (K, 3) in the newest view, and the variance by parallax."""
        poses = np.stack([self.views[other].world_from_camera for other, _, _ in self.window])
        centres = se3.between(poses[-1], poses)[:, :3, 3]
        known = np.isfinite(at[:, 2])
        rays, rho, variance = points.rays.copy(), np.full(len(ids), np.nan), np.full(len(ids), np.nan)
        rays[known], rho[known] = at[known, :2] / at[known, 2:], 1.0 / at[known, 2]
        shown = np.asarray(np.isfinite(self._observed(ids[known])).all(axis=2))
        ray_variance = (self.sensor.pixel_sigma / self.sensor.focal_px) ** 2
        variance[known] = rho_variance(at[known], centres, shown, ray_variance)
        return replace(points, rays=rays, rho=rho, variance=variance)

    def _is_far(self, reference: ReferenceFrame, motion: Motion) -> bool:
        flow = np.linalg.norm(motion.points.px - reference.points.px[motion.rows], axis=1)
        few = len(motion.rows) < _SHARED * len(reference.ids)
        return few or float(np.median(flow)) > _FLOW * self.sensor.camera.width

    def _guess(self, stamp_ns: int) -> Floats:
        """reference_from_camera at a stamp, the motion of the last two frames continued."""
        here = self.view_from_camera[-1]
        rows = len(self.stamp_ns)
        if rows < 2 or self.breaks[-1:] == [rows - 1]:
            return here
        step = se3.log(se3.between(self._pose(-2), self._pose(-1))[None])
        share = (stamp_ns - self.stamp_ns[-1]) / (self.stamp_ns[-1] - self.stamp_ns[-2])
        return here @ se3.exp(step * min(share, 2.0))[0]

    def _pose(self, row: int) -> Floats:
        return self.views[self.view[row]].world_from_camera @ self.view_from_camera[row]

    def odometry(self) -> Odometry | None:
        """None where fewer than two frames have a pose."""
        passed, self.passed = self.passed, []
        if passed and not self._follow(passed[-1]):
            for frame in passed:
                self._take(frame)
        if len(self.stamp_ns) < 2:
            return None
        camera = self.sensor.camera
        poses = np.stack([self._pose(row) for row in range(len(self.stamp_ns))])
        odom_from_body = camera.body_from_camera @ poses @ se3.inverse(camera.body_from_camera)
        covariance = self._increments()
        moved = se3.adjoint(camera.body_from_camera)
        covariance = moved @ covariance @ moved.T
        found = Odometry(
            np.array(self.stamp_ns, np.int64),
            odom_from_body,
            covariance,
            breaks=np.array(self.breaks, np.int64),
            metric=self.sensor.metric,
            of_images=True,
            increments=True,
        )
        metres = None if self.height_m is None else by_height(found, self.below, self.height_m, camera)
        if self.sensor.metric or metres is not None:
            return metres or found
        return scaled(found, self._typical_unit(), camera)

    def _typical_unit(self) -> Floats:
        """(T,) by which steps without metres are multiplied, so that references of a piece show landmarks at
        UNIT_DEPTH: its first two views may have looked at the ground before the camera."""
        depth, row = np.array([view.depth for view in self.views]), np.array([view.row for view in self.views])
        piece, of_view = (np.searchsorted(self.breaks, one, "right") for one in (np.arange(len(self.stamp_ns)), row))
        known, scale = np.isfinite(depth), np.ones(len(piece))
        for one in np.unique(of_view[known]):
            scale[piece == one] = UNIT_DEPTH / np.median(depth[known & (of_view == one)])
        return scale

    def _increments(self) -> Floats:
        """(T, 6, 6) of the motion since the frame before, in the camera: that between two references in equal parts,
        as that from the last of a piece to its end."""
        result = np.tile(_UNKNOWN, (len(self.stamp_ns), 1, 1))
        for row, view in enumerate(self.views):
            end = self.views[row + 1].row if row + 1 < len(self.views) else len(self.stamp_ns)
            if end in self.breaks or end == len(self.stamp_ns):
                end -= 1
                covariance = self.by_points[end]
            else:
                covariance = self.views[row + 1].motion
            if end > view.row:
                result[view.row + 1 : end + 1] = covariance / (end - view.row)
        return result


def _has_depth(frame: Frame) -> bool:
    return frame.right is not None or (frame.depth is not None and bool(np.isfinite(frame.depth).any()))


def visual_odometry(
    frames: Iterable[Frame], camera: Camera, metric: bool = True, height_m: float | None = None
) -> Odometry | None:
    """The motion of the body by the images of a calibrated camera, `metric` where it has depth or is that of a stereo
    pair; None where fewer than two frames have a pose. Frames that are lost have none. The covariance is that of each
    frame's motion since the one before it, by the bundle adjustment's marginals. The height of a camera without depth
    over the ground gives metres where its images show the ground."""
    tracker = Tracker(Sensor(camera, metric), None if metric else height_m)
    for _ in Execution().map(tracker.add, frames):  # in one thread, while this one reads the next frames
        pass
    return tracker.odometry()
