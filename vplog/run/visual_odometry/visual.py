"""Visual odometry of a camera with depth or of a stereo pair.

Corners of a reference frame are followed into the next frames by optical flow (Lucas & Kanade 1981); a frame's pose is
that of P3P in RANSAC, refined, as a closure's. A frame that shows too little of the
reference becomes the next one, and a bundle adjustment of the last references refines their poses and landmarks.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Odometry
from vplog.geometry import se3
from vplog.graph.bundle import Observations, adjust
from vplog.run.visual_odometry.sensor import Sensor
from vplog.run.visual_odometry.tracking import Reference, corners, track

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vplog.data import Camera, Floats, Frame
    from vplog.run.visual_odometry.sensor import Points
    from vplog.run.visual_odometry.tracking import Motion

_WINDOW = 8
"""References that are adjusted together: as libviso's and VINS' 5 to 10; what is older hardly shares a landmark."""
_SHARED = 0.75
"""A frame with less than this share of its reference's points becomes one."""
_FLOW = 0.05
"""So does one whose points moved by this share of the image's width: farther, and patches no longer look alike."""
_LEAST = 30
"""Points with depth that a first frame needs: half as many again as a pose does."""
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


@dataclass(eq=False)
class _Tracker:
    """State while the frames pass."""

    sensor: Sensor
    stamp_ns: list[int] = field(default_factory=list)
    view: list[int] = field(default_factory=list)
    """The reference of each frame with a pose."""
    view_from_camera: list[Floats] = field(default_factory=list)
    by_points: list[Floats] = field(default_factory=list)
    """(6, 6) covariance of each, by one view alone."""
    views: list[_View] = field(default_factory=list)
    breaks: list[int] = field(default_factory=list)
    """Rows of frames at which a piece begins, but for the first."""
    reference: Reference | None = None
    window: deque[tuple[int, np.ndarray, Points]] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    """View, landmarks and measurements of the last references of this piece."""
    world: dict[int, Floats] = field(default_factory=dict)
    """(3,) of the landmarks that the window shows."""

    def add(self, frame: Frame) -> None:
        """Take the next frame."""
        if self.reference is None:
            self._start(frame)
            return
        tracked = track(self.reference, frame, self._guess(frame.stamp_ns), self.sensor)
        if tracked is None:
            if frame.stamp_ns - self.stamp_ns[-1] > _PATIENCE_NS:
                self._start(frame)
            return
        extended, motion = tracked
        self.stamp_ns.append(frame.stamp_ns)
        if extended is self.reference and not self._is_far(extended, motion):
            self.view.append(self.view[-1])
            self.view_from_camera.append(motion.reference_from_camera)
            self.by_points.append(motion.covariance + motion.systematic)
        else:
            self._extend(extended)
            self._add_view(frame, extended, motion)

    def _start(self, frame: Frame) -> None:
        """Begin a piece where the last one ended; nothing where the frame has too few points with depth."""
        points = self._usable(frame, corners(frame, np.zeros((0, 2), np.float32)))
        if len(points.px) < _LEAST:
            return
        if self.stamp_ns:
            self.breaks.append(len(self.stamp_ns))
        pose = self._pose(-1) if self.stamp_ns else np.eye(4)
        first = int(max(self.world, default=-1)) + 1
        ids = first + np.arange(len(points.px))
        self.window.clear()
        self.world.clear()
        self.stamp_ns.append(frame.stamp_ns)
        self._add_reference(frame, _View(pose, len(self.stamp_ns) - 1, _UNKNOWN), ids, points)

    def _add_view(self, frame: Frame, reference: Reference, motion: Motion) -> None:
        """Make a tracked frame the next reference, and adjust the window."""
        ids, points = reference.ids[motion.rows], motion.points
        new = self._usable(frame, corners(frame, points.px))
        first = max(self.world) + 1
        pose = self.views[-1].world_from_camera @ motion.reference_from_camera
        view = _View(pose, len(self.stamp_ns) - 1, motion.covariance + motion.systematic)
        ids = np.concatenate([ids, first + np.arange(len(new.px))])
        self._add_reference(frame, view, ids, points.joined(new), motion.systematic)

    def _add_reference(
        self, frame: Frame, view: _View, ids: np.ndarray, points: Points, systematic: Floats | None = None
    ) -> None:
        self.views.append(view)
        self.view.append(len(self.views) - 1)
        self.view_from_camera.append(np.eye(4))
        self.by_points.append(view.motion)
        self.window.append((len(self.views) - 1, ids, points))
        self._place(view, ids, points)
        if systematic is not None:
            self._adjust(systematic)
        self.reference = self._reference(frame)

    def _usable(self, frame: Frame, px: np.ndarray) -> Points:
        """The points that have a ray and a depth."""
        points = self.sensor.measure(frame, px)
        return points.rows(np.isfinite(points.rho) & np.isfinite(points.noise).all(axis=(1, 2)))

    def _place(self, view: _View, ids: np.ndarray, points: Points) -> None:
        """Landmarks where the view that first shows them measures them."""
        new = np.array([number not in self.world for number in ids.tolist()], bool)
        ray = np.column_stack([points.rays, np.ones(len(ids))])[new]
        placed = se3.transform(view.world_from_camera, ray / points.rho[new, None])
        self.world.update(zip(ids[new].tolist(), placed, strict=True))

    def _extend(self, reference: Reference) -> None:
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
        landmarks = often[count > 1]
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
        found = adjust(start, np.stack([self.world[number] for number in landmarks.tolist()]), observed)
        if found is not None:
            for view, pose in zip(views, found.world_from_camera, strict=True):
                view.world_from_camera = pose
            views[-1].motion = found.last_motion + systematic
            self.world.update(zip(landmarks.tolist(), found.points, strict=True))
        self.world = {number: self.world[number] for number in often.tolist()}

    def _reference(self, frame: Frame) -> Reference:
        """The newest view, its landmarks by all views that show them."""
        view, ids, points = self.window[-1]
        pose = self.views[view].world_from_camera
        at = se3.transform(se3.inverse(pose), np.stack([self.world[number] for number in ids.tolist()]))
        front = at[:, 2] > 0
        at, ids, points = at[front], ids[front], points.rows(front)
        shown = np.concatenate([other for _, other, _ in self.window])
        times = (np.sort(shown).searchsorted(ids, "right") - np.sort(shown).searchsorted(ids, "left")).clip(1)
        own = np.where(np.isfinite(points.variance), points.variance, np.nanmedian(points.variance))
        rho = 1.0 / at[:, 2]
        estimated = type(points)(points.px, at[:, :2] * rho[:, None], points.noise, rho, own / times)
        return Reference(frame, ids, estimated, max(self.world) + 1)

    def _is_far(self, reference: Reference, motion: Motion) -> bool:
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
        if len(self.stamp_ns) < 2:
            return None
        camera = self.sensor.camera
        poses = np.stack([self._pose(row) for row in range(len(self.stamp_ns))])
        odom_from_body = camera.body_from_camera @ poses @ se3.inverse(camera.body_from_camera)
        covariance = self._increments()
        moved = se3.adjoint(camera.body_from_camera)
        covariance = moved @ covariance @ moved.T
        return Odometry(
            np.array(self.stamp_ns, np.int64), odom_from_body, covariance, breaks=np.array(self.breaks, np.int64)
        )

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


def visual_odometry(frames: Iterable[Frame], camera: Camera) -> Odometry | None:
    """The motion of the body by the images of a calibrated camera with depth or of a stereo pair; None where fewer than
    two frames have a pose. Frames that are lost have none. The covariance is that of each frame's motion since the one
    before it, by the bundle adjustment's marginals."""
    tracker = _Tracker(Sensor(camera))
    for frame in frames:
        tracker.add(frame)
    return tracker.odometry()
