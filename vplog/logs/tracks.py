"""Motion and fixes: the messages of one topic become arrays over time, cleaned, sorted and in vplog's conventions."""

from __future__ import annotations

import math
from array import array
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.data import Gps, Odometry
from vplog.logs.containers import Notes, plural
from vplog.logs.stamps import Stamps
from vplog.logs.transforms import are_usable, clean, is_usable

if TYPE_CHECKING:
    from vplog.data import Floats, Ints
    from vplog.logs.messages import FixMessage, PoseMessage
    from vplog.logs.odometry_message import Poses

_ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
"""ROS orders x y z, then rotations about X Y Z; vplog the other way."""

_UNKNOWN = [float("nan")] * 36
_BLOCK = 2048
"""Poses that are converted at once: 0.6 MB of covariances."""
_BACK_AND_FORTH = 1.5
"""A path by header stamps that is so many times that by log times is out of order; one that is sorted rightly is
shorter."""
_LARGEST = 1e15
"""m^2 or rad^2; drivers write up to 1e12 for "any", so an element beyond this is damage."""


class PoseTrack:
    """Collects the poses of one odometry topic."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.stamps = Stamps()
        self._poses = array("d")
        """x y z, x y z w of every pose."""
        self._covariances = array("d")
        """36 numbers of every pose, NaN where it has none."""
        self._bare = True
        """No pose has a covariance."""
        self._dropped = 0
        self.child = ""
        """The frame that moves, as the first message names it."""
        self.parent = ""
        """The frame that it moves in."""

    def add(self, message: PoseMessage, log_ns: int) -> None:
        self.child = self.child or clean(message.child)
        self.parent = self.parent or clean(message.frame)
        stamp_ns, _, _, position, quaternion, covariance = message
        if not is_usable(*position, *quaternion):
            self._dropped += 1
            return
        self.stamps.add(stamp_ns, log_ns)
        self._poses.extend(position)
        self._poses.extend(quaternion)
        self._bare = self._bare and covariance is None
        self._covariances.extend(_UNKNOWN if covariance is None else covariance)

    def add_all(self, poses: Poses, log_ns: list[int]) -> None:
        """The same of several messages that name the same frames."""
        self.child = self.child or clean(poses.child)
        self.parent = self.parent or clean(poses.frame)
        usable = are_usable(poses.poses)
        self._dropped += int((~usable).sum())
        self.stamps.extend(poses.stamp_ns[usable].tolist(), list(compress(log_ns, usable.tolist())))
        self._poses.frombytes(poses.poses[usable].tobytes())
        if poses.covariances is None:
            self._covariances.frombytes(np.full((int(usable.sum()), 36), np.nan).tobytes())
        else:
            self._covariances.frombytes(poses.covariances[usable].tobytes())
            self._bare = self._bare and not usable.any()

    def finish(self, notes: Notes) -> Odometry | None:
        """The odometry, or None where no pose is usable."""
        if self._dropped:
            notes.add(f"{self.topic}: {plural(self._dropped, 'pose')} out of range or without a rotation dropped.")
        stamp_ns, rows = self._order(notes)
        if not len(rows):
            return None
        poses, covariance = np.empty((len(rows), 4, 4)), np.empty((len(rows), 6, 6))
        logged = np.frombuffer(self._poses).reshape(-1, 7), np.frombuffer(self._covariances).reshape(-1, 6, 6)
        for start in range(0, len(rows), _BLOCK):  # or what is needed on the way would be several times the result
            part = slice(start, start + _BLOCK)
            values = logged[0][rows[part]]
            poses[part] = geometry.pose(geometry.rotation(values[:, 3:]), values[:, :3])
            covariance[part] = body_covariance(poses[part], logged[1][rows[part]])
        usable = np.isfinite(covariance).all((1, 2))
        if usable.all():
            return Odometry(stamp_ns, poses, covariance)
        if usable.any():
            bad = plural(int((~usable).sum()), "covariance")
            notes.add(f"{self.topic}: {bad} that no noise can have (zero, negative or not finite) taken as unknown.")
            return Odometry(stamp_ns, poses, covariance)
        why = "carries no covariance" if self._bare else "has no usable covariance (zero or invalid)"
        notes.add(f"{self.topic} {why}; the noise of its motion is a guess.")
        return Odometry(stamp_ns, poses, None)

    def tell_apart(self) -> None:
        """Give the stamps a number of each pose, by which a pose that was written twice shows."""
        self.stamps.content = array("d", np.frombuffer(self._poses).reshape(-1, 7)[:, :3].sum(1).tolist())

    def _order(self, notes: Notes) -> tuple[Ints, Ints]:
        """Stamps and rows; by the log times where the motion is continuous by them and not by the header stamps."""
        position = np.frombuffer(self._poses).reshape(-1, 7)[:, :3]
        _, by_header = self.stamps.order(self.topic, Notes())
        if (np.diff(by_header) < 0).any():
            _, by_log = self.stamps.by_log_times(self.topic, Notes(), "")
            ways = [
                float(np.linalg.norm(np.diff(position[rows], axis=0), axis=1).sum()) for rows in (by_header, by_log)
            ]
            if ways[0] > _BACK_AND_FORTH * ways[1]:
                why = "has header stamps by which it moves back and forth"
                return self.stamps.by_log_times(self.topic, notes, why)
        return self.stamps.order(self.topic, notes)


def body_covariance(odom_from_body: Floats, logged: Floats) -> Floats:
    """ROS covariances (T, 6, 6), translation first in the fixed axes of odom, in vplog's order and the body's axes.

    A right perturbation of the pose, R exp(phi) and t + R v, has phi = R^T w and v = R^T dt for a turn w and a shift
    dt in the fixed axes; so each 3x3 block S becomes R^T S R. Rows that no noise can have (all zero, NaN, a negative
    variance: -1 first is ROS's mark for unknown) are NaN.
    """
    variances = np.diagonal(logged, axis1=1, axis2=2)
    usable = np.asarray((np.abs(logged) < _LARGEST).all((1, 2)) & (variances >= 0).all(1) & logged.any((1, 2)))
    result = logged[:, _ROTATION_FIRST][:, :, _ROTATION_FIRST]
    turn = np.zeros_like(result)
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(odom_from_body[:, :3, :3], 1, 2)
    result = turn @ np.where(usable[:, None, None], result, 0.0) @ np.swapaxes(turn, 1, 2)
    result = (result + np.swapaxes(result, 1, 2)) / 2  # symmetric to the last bit
    result[~usable] = np.nan
    return result


class FixTrack:
    """Collects the fixes of one GPS topic."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.stamps = Stamps()
        self._fixes: list[FixMessage] = []
        self.frame = ""
        """Of the antenna, by the first fix."""
        self._dropped = 0

    def add(self, message: FixMessage, log_ns: int) -> None:
        here = (message.latitude_deg, message.longitude_deg)
        if not (message.valid and all(map(math.isfinite, here)) and abs(here[0]) <= 90 and abs(here[1]) <= 360):
            self._dropped += 1
            return
        self.frame = self.frame or message.frame
        self.stamps.add(message.stamp_ns, log_ns)
        self._fixes.append(message)

    def finish(self, notes: Notes) -> Gps | None:
        """The fixes, or None where none is usable. Altitudes may be NaN."""
        if self._dropped:
            notes.add(f"{self.topic}: {plural(self._dropped, 'message')} without a fix dropped.")
        stamp_ns, rows = self.stamps.order(self.topic, notes)
        if not len(rows):
            return None
        fixes = [self._fixes[row] for row in rows]
        covariance = np.array([fix.covariance for fix in fixes])
        covariance[~(covariance.any((1, 2)) & (np.abs(covariance) < _LARGEST).all((1, 2)))] = np.nan
        return Gps(
            stamp_ns,
            np.array([fix.latitude_deg for fix in fixes], np.float64),
            np.array([fix.longitude_deg for fix in fixes], np.float64),
            np.array([fix.altitude_m for fix in fixes], np.float64),
            covariance,
        )
