"""Motion and fixes: the messages of one topic become arrays over time, cleaned, sorted and in vplog's conventions."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import replace
from itertools import compress, pairwise

import numpy as np

from vplog.data import RECEIVER_SIGMA_M, Bools, Floats, Gps, Ints, Odometry
from vplog.errors import plural
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu
from vplog.logs.formats.container import Channel, Notes
from vplog.logs.messages.decode import Poses
from vplog.logs.messages.nmea import SENTENCES
from vplog.logs.messages.records import FixMessage, ImuMessage, PoseMessage
from vplog.logs.stamps import NONE, Stamps
from vplog.logs.tf_odometry import are_usable, frame_name

_ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
"""ROS orders x y z, then rotations about X Y Z; vplog the other way."""
_BLOCK = 2048
"""Poses that are converted at once: 0.6 MB of covariances."""
_LARGEST = 1e15
"""m^2 or rad^2; drivers write up to 1e12 for "any", so an element beyond this is damage."""
_NULL_ISLAND_DEG = 1e-6
"""Degrees, 0.1 m: nobody drives that near to (0, 0), which lies in the Atlantic."""
_HIGHEST_M = 1e5
"""m; above it is space, so an altitude beyond is damage. As a sigma it gives an altitude no weight."""
_FASTEST_M_S = 100.0
"""m/s; ground robots and low flights are slower. Faster drives are measured by their own speed:"""
_SNAP_M = 30.0
"""m; a nearer one is multipath's, and too little to split a drive by: its residual tells it."""
_TIMES_USUAL = 10.0
"""times the usual speed between fixes, beyond which they jump."""
_TIMES_HIGH = 2.0
"""times the speed that nine of ten fixes that confirm each other do not exceed, up to which one that jumps off its
neighbours is reached from those beyond; and times the way between nine of ten, beyond which one was held back."""
_USUAL, _CROWDED = 0.75, 0.05
"""Quantile of the time between fixes, half of which are close together where they are of two receivers, and the share
of it within which two are taken to be as far apart as others."""


class PoseTrack:
    """Collects the poses of one odometry topic, and the velocities beside them."""

    def __init__(self, topic: str, geometry: tuple[float, float] = (1.0, 1.0)) -> None:
        """`geometry` is what velocities are multiplied by, linear and angular, where they are those of wheels."""
        self.topic = topic
        self._geometry = geometry
        self._twists = array("d")
        """12 numbers of every pose, as `Poses.twists`; empty where a pose has none."""
        self.stamps = Stamps()
        self._poses = array("d")
        """x y z, x y z w of every pose."""
        self._covariances = array("d")
        """36 numbers of every pose, NaN where it has none."""
        self._without_covariance = True
        """No pose has a covariance."""
        self._dropped = self._others = 0
        """Poses that are unusable, and those of other frames."""
        self._tracks: dict[tuple[str, str], PoseTrack] = {}
        """By their frames, tracks of the poses that name others than the first."""
        self.child = ""
        """The frame that moves, as the first message names it."""
        self.parent = ""
        """The frame that it moves in."""

    def add(self, message: PoseMessage, log_ns: int, position: int | None = None) -> None:
        stamp_ns, frame, child, place, quaternion, covariance, twist = message
        known, moving = (None if one is None else np.array(one, np.float64)[None] for one in (covariance, twist))
        poses = Poses(np.array([stamp_ns]), frame, child, np.array([[*place, *quaternion]]), known, moving)
        self.add_all(poses, [log_ns], None if position is None else [position])

    def add_all(self, poses: Poses, log_ns: list[int], positions: list[int] | None = None) -> None:
        """Add several messages that name the same frames."""
        frames = frame_name(poses.frame), frame_name(poses.child)
        self.parent, self.child = self.parent or frames[0], self.child or frames[1]
        if frames != (self.parent, self.child):
            self._tracks.setdefault(frames, PoseTrack(self.topic, self._geometry)).add_all(poses, log_ns, positions)
            return
        usable = are_usable(poses.poses)
        if poses.twists is not None:
            usable |= ~poses.poses.any(1)  # drivers that give velocities alone leave the whole pose zero
        self._dropped += int((~usable).sum())
        at = None if positions is None else list(compress(positions, usable))
        self.stamps.extend(poses.stamp_ns[usable].tolist(), list(compress(log_ns, usable)), at)
        self._poses.frombytes(poses.poses[usable].tobytes())
        if poses.twists is not None:
            self._twists.frombytes(poses.twists[usable].tobytes())
        known = poses.covariances
        self._without_covariance &= known is None or not usable.any()
        self._covariances.frombytes((np.full((len(usable), 36), np.nan) if known is None else known)[usable].tobytes())

    def of_most(self) -> PoseTrack:
        """The track of the frames that most poses name; of equal ones the first."""
        counts = {track: len(track.stamps.log_ns) for track in (self, *self._tracks.values())}
        most = max(counts, key=counts.__getitem__)
        most._others = sum(counts.values()) - counts[most]
        return most

    def finish(self, notes: Notes) -> Odometry | None:
        """The odometry, or None where no pose is usable."""
        given = self._given
        if dropped := self._dropped + int((~given).sum()):
            notes.add(f"{self.topic}: {plural(dropped, 'pose')} out of range or without a rotation dropped.")
        if self._others:
            frames = " in ".join(filter(None, (self.child, self.parent)))
            notes.add(f"{self.topic}: {plural(self._others, 'pose')} of other frames than {frames} left out.")
        stamp_ns, rows = self.stamps.order(self.topic, notes)
        stamp_ns, rows = stamp_ns[given[rows]], rows[given[rows]]
        if not len(rows):
            notes.add(f"{self.topic}: none of its messages gives a motion.")
            return None
        poses, covariance = np.empty((len(rows), 4, 4)), np.empty((len(rows), 6, 6))
        logged = np.frombuffer(self._poses).reshape(-1, 7), np.frombuffer(self._covariances).reshape(-1, 6, 6)
        for start in range(0, len(rows), _BLOCK):  # or what is needed on the way would be several times the result
            part = slice(start, start + _BLOCK)
            values = logged[0][rows[part]]
            poses[part] = se3.pose(se3.rotation(values[:, 3:]), values[:, :3])
            covariance[part] = body_covariance(poses[part], logged[1][rows[part]])
        usable = np.isfinite(covariance).all((1, 2))
        if not usable.any():
            why = "carries no covariance" if self._without_covariance else "has no usable covariance (zero or invalid)"
            notes.add(f"{self.topic} {why}; its noise is that of the drift model.")
            return Odometry(stamp_ns, poses, None)
        if not usable.all():
            bad = plural(int((~usable).sum()), "covariance")
            notes.add(f"{self.topic}: {bad} with zero, negative or not finite values taken as unknown.")
        return Odometry(stamp_ns, poses, covariance)

    @property
    def twists(self) -> Floats | None:
        """(K, 12) velocities, linear in m/s, then angular in rad/s, and their variances; None where they are no whole,
        or never change from zero. Axes that are never finite are zero: drivers mark so what they do not measure."""
        found = np.array(self._twists).reshape(-1, 12)
        finite = np.isfinite(found[:, :6])
        if 7 * len(found) != len(self._poses) or not found[:, :6][finite].any():
            return None
        found[:, :6][:, ~finite.any(0)] = 0.0
        factors = np.repeat(self._geometry, 3)
        return found * np.concatenate([factors, factors**2])

    @property
    def moves(self) -> bool:
        """Whether the poses change: the places, where linear velocities lie beside them, as a driver that measures no
        poses may fill in the rotation of its IMU."""
        poses = np.frombuffer(self._poses).reshape(-1, 7)[self._given]
        change = (poses != poses[:1]).any(0)
        if not change[:3].any() and (twists := self.twists) is not None and twists[:, :3].any():
            return False
        return bool(change.any())

    @property
    def _given(self) -> Bools:
        """(K,) whether each message sets a pose, which has a quaternion."""
        return np.asarray(np.frombuffer(self._poses).reshape(-1, 7)[:, 3:].any(1))

    def set_xyz(self) -> None:
        """Give the stamps the position of each pose."""
        self.stamps.xyz_m = np.array(self._poses).reshape(-1, 7)[:, :3]


def body_covariance(odom_from_body: Floats, logged: Floats) -> Floats:
    """ROS covariances (T, 6, 6), translation first in the fixed axes of odom, in vplog's order and the body's axes.

    A right perturbation of the pose, R exp(phi) and t + R v, has phi = R^T w and v = R^T dt for a turn w and a shift
    dt in the fixed axes; so each 3x3 block S becomes R^T S R. Rows that no noise can have (all zero, NaN, a negative
    variance: -1 first is ROS's mark for unknown) are NaN.
    """
    usable = _is_set(logged)
    result = logged[:, _ROTATION_FIRST][:, :, _ROTATION_FIRST]
    turn = np.zeros_like(result)
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(odom_from_body[:, :3, :3], 1, 2)
    result = turn @ np.where(usable[:, None, None], result, 0.0) @ np.swapaxes(turn, 1, 2)
    result = (result + np.swapaxes(result, 1, 2)) / 2  # symmetric to the last bit
    result[~usable] = np.nan
    return result


def _is_set(covariance: Floats) -> np.ndarray:
    """(T,) bool: whether (T, N, N) covariances are known: not all zero, nor NaN, infinite or of a negative variance."""
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    return np.asarray((np.abs(covariance) < _LARGEST).all((1, 2)) & (variances >= 0).all(1) & covariance.any((1, 2)))


class ImuTrack:
    """Collects the measurements of an IMU."""

    def __init__(self, channel: Channel | None) -> None:
        self.topic = channel.topic if channel else ""
        self.stamps = Stamps()
        self.frame = ""
        """Frame of the IMU, by the first message."""
        self._values = array("d")

    def add(self, message: ImuMessage, log_ns: int, position: int | None = None) -> None:
        self.frame = self.frame or message.frame
        if all(map(math.isfinite, message.gyro)):
            self.stamps.add(message.stamp_ns, log_ns, position)
            self._values.extend((*message.gyro, *message.accel))

    def finish(self, notes: Notes) -> tuple[Ints, Floats]:
        """Increasing stamps (K,), and (K, 6) rates in rad/s about the axes of its frame, accelerations in m/s^2. Of an
        accelerometer alone, whose rates are zero, nothing."""
        stamp_ns, rows = self.stamps.order(self.topic, notes)
        values = np.frombuffer(self._values).reshape(-1, 6)[rows]
        return (stamp_ns, values) if values[:, :3].any() else (NONE, values[:0])


class FixTrack:
    """Collects the fixes of one GPS topic."""

    def __init__(self, topic: str, any_status: bool = False) -> None:
        """With `any_status`, a status that says "no fix" does not matter."""
        self.topic = topic
        self._any_status = any_status
        self.stamps = Stamps()
        self._fixes: list[FixMessage] = []
        self.frame = ""
        """Frame of the antenna, by the first fix."""
        self._dropped: Counter[str] = Counter()
        """Messages by why they are no fix."""
        self._sentences: list[tuple[FixMessage, int, int | None]] = []
        """Fixes of NMEA, of which several sentences are one."""

    def add_sentences(self) -> None:
        """Add the fixes of the one type of NMEA's sentences with a position that comes often and holds most."""
        counts = Counter(one.sentence for one, _, _ in self._sentences if not _no_position(one, self._any_status))
        often = [kind for kind in SENTENCES if counts and counts[kind] > max(counts.values()) / 2]
        found, self._sentences = [one for one in self._sentences if one[0].sentence in often[:1]], []
        for message, log_ns, position in found:
            self.add(replace(message, sentence=""), log_ns, position)

    def add(self, message: FixMessage, log_ns: int, position: int | None = None) -> None:
        if message.sentence:
            self._sentences.append((message, log_ns, position))
            return
        if why := _no_position(message, self._any_status):
            self._dropped[why] += 1
            return
        self.frame = self.frame or message.frame
        self.stamps.add(message.stamp_ns, log_ns, position)
        self._fixes.append(message)

    def finish(self, notes: Notes) -> Gps | None:
        """The fixes, or None where none is usable. Missing altitudes are interpolated,
        with a variance that gives them no weight."""
        for why, count in sorted(self._dropped.items()):
            notes.add(f"{self.topic}: {plural(count, 'message')} without a fix dropped: {why}.")
        stamp_ns, rows = self.stamps.order(self.topic, notes)
        if not len(rows):
            return None
        fixes = [self._fixes[row] for row in rows]
        covariance = np.array([fix.covariance for fix in fixes])
        covariance[~_is_set(covariance)] = np.nan
        latitude, longitude, altitude = np.array(
            [(fix.latitude_deg, fix.longitude_deg, fix.altitude_m) for fix in fixes], np.float64
        ).T
        known = np.abs(altitude) < _HIGHEST_M
        if not known.all():
            missing = f"{int((~known).sum())} of {len(known)} fixes have no altitude"
            notes.add(f"{self.topic}: {missing}; neighbouring altitudes, or 0 m, are used without weight.")
            altitude = np.interp(stamp_ns, stamp_ns[known], altitude[known]) if known.any() else np.zeros(len(stamp_ns))
            covariance[~known] = _without_altitude(covariance[~known])
        gps = Gps(stamp_ns, latitude, longitude, altitude, covariance)
        for left_out, why in (
            (_frozen, "they repeat the one before them, up to a jump, as a driver does that lost its receiver"),
            (_unreachable, "nothing moves that far in the time"),
        ):
            bad = left_out(gps)
            if bad.any():
                notes.add(f"{self.topic}: {int(bad.sum())} of {len(bad)} fixes left out: {why}.")
                columns = ("stamp_ns", "latitude_deg", "longitude_deg", "altitude_m", "covariance")
                gps = replace(gps, **{name: getattr(gps, name)[~bad] for name in columns})
        return gps


def _no_position(fix: FixMessage, any_status: bool) -> str:
    """Why a message holds no position, as it follows `dropped:`; empty where it does."""
    latitude, longitude = fix.latitude_deg, fix.longitude_deg
    if not (fix.valid or any_status):
        return "its status says that there is no fix; --gps-any-status uses it"
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return "latitude or longitude is not a number"
    if abs(latitude) < _NULL_ISLAND_DEG and abs(longitude) < _NULL_ISLAND_DEG:
        return "it lies at (0, 0), which drivers write before the first fix"
    if abs(latitude) > 90 and abs(latitude) <= 180 and abs(longitude) <= 90:
        return "the latitude is beyond 90 degrees and the longitude is not; are the two swapped?"
    if abs(latitude) > 90 or abs(longitude) > 360:
        return "latitude or longitude is out of range"
    return ""


def _without_altitude(covariance: Floats) -> Floats:
    """(K, 3, 3) with the horizontal part alone; where that is unknown, a plain receiver's."""
    result, plane = np.zeros_like(covariance), covariance[:, :2, :2]
    known = np.isfinite(plane).all((1, 2), keepdims=True)
    result[:, :2, :2] = np.where(known, plane, RECEIVER_SIGMA_M**2 * np.eye(2))
    result[:, 2, 2] = _HIGHEST_M**2
    return result


def _frozen(gps: Gps) -> Bools:
    """(T,) bool: fixes that repeat the place before them to the last bit, where the next that does not is further off
    than a fix from the one before it usually is; a receiver at rest goes on from where it stood."""
    place = np.stack([gps.latitude_deg, gps.longitude_deg], axis=1)
    step_m = np.linalg.norm(np.diff(local_enu(gps).enu_m[:, :2], axis=0), axis=1)
    same = (place[1:] == place[:-1]).all(1)
    frozen = np.zeros(len(place), bool)
    if same.all():
        return frozen
    usual_m = float(np.quantile(step_m[~same], 0.9))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same, [0]])))
    for first, last in edges.reshape(-1, 2).tolist():
        if last < len(step_m) and step_m[last] > _TIMES_HIGH * usual_m:
            frozen[first + 1 : last + 1] = True
    return frozen


def _unreachable(gps: Gps) -> Bools:
    """(T,) bool: all but the fixes of the longest run without a jump, of those from where it can be reached, and those
    that no neighbour confirms where they lie on the way between such runs."""
    place, steps = local_enu(gps).enu_m, np.diff(gps.stamp_ns) / 1e9
    if len(place) < 2:
        return np.zeros(len(place), bool)
    # stamps crowd, as log times of messages that came together, and of two receivers: by them all would be fast
    usual_s = float(np.quantile(steps, _USUAL))
    seconds = np.append(0.0, np.cumsum(np.where(steps < _CROWDED * usual_s, usual_s, steps)))
    speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / np.diff(seconds)
    fastest = max(_FASTEST_M_S, _TIMES_USUAL * _usual_speed_m_s(place, seconds))
    jumps = speed > np.maximum(fastest, _SNAP_M / np.diff(seconds))
    bounds = [0, *(np.flatnonzero(jumps) + 1).tolist(), len(place)]
    every = [(a, b - 1) for a, b in pairwise(bounds)]
    runs = [(a, b) for a, b in every if a < b] or every
    first, last = main = max(runs, key=lambda run: (run[1] - run[0], -run[0]))
    reached = np.zeros(len(place), bool)
    for a, b in [main, *(run for run in runs[::-1] if run < main), *(run for run in runs if run > main)]:
        near, end = (b, first) if b < first else (a, last) if a > last else (a, a)
        if np.linalg.norm(place[near] - place[end]) <= max(fastest * abs(seconds[near] - seconds[end]), _SNAP_M):
            reached[a : b + 1] = True
            first, last = min(first, a), max(last, b)
    sure, known = np.flatnonzero(reached), speed[reached[1:] & reached[:-1] & (speed <= fastest)]
    usual = min(fastest, _TIMES_HIGH * float(np.quantile(known, 0.9))) if len(known) else 0.0
    for alone in (a for a, b in every if a == b and runs is not every):
        at = int(np.searchsorted(sure, alone))
        beside = sure[max(at - 1, 0) : at + 1]
        far = np.linalg.norm(place[beside] - place[alone], axis=1)
        reached[alone] = bool((far <= usual * np.abs(seconds[beside] - seconds[alone])).all())
    return ~reached


def _usual_speed_m_s(place: Floats, seconds: Floats) -> float:
    """Median of the lowest speed between a fix and each of the two before and behind it: of half of the fixes wrong."""
    lowest = np.full(len(place), np.inf)
    for step in (1, 2):
        speed = np.linalg.norm(place[step:] - place[:-step], axis=1) / (seconds[step:] - seconds[:-step])
        lowest[step:] = np.minimum(lowest[step:], speed)
        lowest[:-step] = np.minimum(lowest[:-step], speed)
    return float(np.median(lowest))
