"""Drives of random worlds: roads, aisles, rooms and the air, where the robot comes back to places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.geometry import se3

if TYPE_CHECKING:
    from tests.benchmarks.world_parameters import Parameters
    from vplog.data import Bools, Floats, Ints

RADIUS_M = {"road": 4.0, "aisles": 1.2, "room": 0.6, "drone": 6.0}
"""How far apart two views of one place may be."""
APART = 8.0
"""Keyframes are compared only if the path between them is this many radii long."""
FEWEST = 20
"""Keyframes that come back to a place; a drive with fewer is drawn again, some times."""
JOINTS = 3
"""True closures, spread over a session, that join it to earlier sessions. Without them a drive is drawn again."""
LATE_LAPS = (1.1, 1.33)
"""Least and most laps of a drive with a single late revisit."""
LATE_SHARE = 0.7
"""A late revisit is at least this share of the keyframes after the first visit: a little less than 1 / 1.33."""
SHORTEST_SESSION = 20
"""Keyframes."""
STALLED, FROZEN = (20, 60), (5, 30)
"""Smallest and largest number of consecutive odometry edges that are wrong: as many as closures within one stall need
and as a robot that waits for help produces; and what a driver that hangs for some seconds misses."""
TREMBLE = np.array([0.002] * 3 + [0.01] * 3)
"""Standard deviation of the pose of a stalled robot, whose wheels turn: rad and m."""


@dataclass(frozen=True, eq=False)
class Drive:
    """The path of a robot, and the motion that its odometry would report if it had no noise. N keyframes."""

    truth: Floats
    """(N, 4, 4) in the world's frame."""
    step: Floats
    """(N-1, 4, 4) motion from each keyframe to the next, as the odometry sees it: the identity from one session to the
    next and while it is frozen, the commanded motion while the robot is stalled, and otherwise the true motion."""
    metres: Floats
    """(N,) length of the path up to each keyframe; of the commanded path while the robot is stalled. Its growth is 0
    from one session to the next."""
    session: Ints
    """(N,) number of the session that each keyframe belongs to."""
    is_wrong: Bools
    """(N-1,) True for the edges in which the robot is stalled or the odometry is frozen."""
    aisle_shift: Floats | None = None
    """(3,) from each aisle to the next, None if the drive has no aisles."""

    @property
    def breaks(self) -> Ints:
        """The last keyframe of each session except the last session."""
        return np.flatnonzero(np.diff(self.session))

    @staticmethod
    def of(truth: Floats, aisle_shift: Floats | None = None) -> Drive:
        """A drive in one session, with odometry that works."""
        rows, step = np.zeros(len(truth), np.int64), se3.between(truth[:-1], truth[1:])
        return Drive(truth, step, way(truth), rows, np.zeros(len(step), bool), aisle_shift)


def drive(parameters: Parameters, random: np.random.Generator) -> Drive:
    """Draw a drive that comes back to places; every later session comes back to places of earlier sessions."""
    made, most = _tried(parameters, random), 100 if parameters.stratum == "sessions" else 10
    for _ in range(1, most):
        pairs = true_pairs(parameters, made)
        joins = [len(joining(made, pairs, later)) for later in range(1, int(made.session[-1]) + 1)]
        if len(pairs) >= FEWEST / parameters.spacing and min(joins, default=JOINTS) >= JOINTS:
            break
        made = _tried(parameters, random)
    return made


def _tried(parameters: Parameters, random: np.random.Generator) -> Drive:
    late, aisle_shift = parameters.stratum == "late", None
    laps = random.uniform(*LATE_LAPS) if late else None
    if parameters.kind == "room":
        truth = _hand_held(parameters, random, laps)
    else:
        if parameters.kind == "aisles":
            line, aisle_shift = _aisles(random, late)
        elif parameters.kind == "drone":
            line = _circuit(random, laps) if parameters.layout == "circuit" else _sweep(random)
        else:
            line = _loop(random, laps) if parameters.layout == "loop" else _blocks(random)
        points = _resampled(line, parameters, random)
        if parameters.kind != "drone":
            points[:, 2] = _ground(points, parameters.spatial, random)
        truth = _headed(points, parameters, random)
    made = Drive.of(truth, aisle_shift)
    if parameters.stratum == "sessions":
        return _in_sessions(made, random)
    if parameters.stratum == "stalled":
        return _stalled(made, parameters, random)
    return _frozen(made, random) if parameters.stratum == "frozen" else made


# --- strata -------------------------------------------------------------------------------------------------------


def _in_sessions(whole: Drive, random: np.random.Generator) -> Drive:
    """Cut a drive into two to four sessions, without the keyframes of up to a twentieth of the drive at each cut. The
    odometry holds its pose from one session to the next."""
    n, count = len(whole.truth), int(random.integers(2, 5))
    room = n - count * SHORTEST_SESSION - (count - 1) * (n // 20)  # for what sessions are longer than the shortest
    starts = np.sort(random.integers(0, room + 1, count - 1)) + np.arange(1, count) * (SHORTEST_SESSION + n // 20)
    session = np.searchsorted(starts, np.arange(n), "right")
    kept = np.ones(n, bool)
    for start, missing in zip(starts, random.integers(1, n // 20 + 1, count - 1), strict=True):
        kept[start - missing : start] = False
    made, session = Drive.of(whole.truth[kept], whole.aisle_shift), session[kept]
    is_break = np.diff(session) > 0
    step = np.where(is_break[:, None, None], np.eye(4), made.step)
    metres = np.concatenate([[0.0], np.cumsum(np.where(is_break, 0.0, np.diff(made.metres)))])
    return replace(made, step=step, metres=metres, session=session)


def _stalled(moving: Drive, parameters: Parameters, random: np.random.Generator) -> Drive:
    """Hold the robot in place one to three times, with odometry that goes straight on at the speed before."""
    n, stalls = len(moving.truth), np.zeros(len(moving.truth), np.int64)
    at = random.choice(np.arange(10, n - 10), int(random.integers(1, 4)), replace=False)
    stalls[at] = random.integers(STALLED[0], STALLED[1] + 1, len(at))
    rows = np.repeat(np.arange(n), stalls + 1)
    is_wrong = np.diff(rows) == 0
    tremble = random.normal(size=(len(rows), 6)) * TREMBLE
    tremble[~np.insert(is_wrong, 0, False)] = 0.0
    truth = moving.truth[rows] @ se3.exp(tremble)
    step = se3.between(truth[:-1], truth[1:])
    shift = moving.step[rows[:-1] - 1, :3, 3]
    # far enough that keyframes of one stall may be compared
    least = 2.0 * APART * place_radius(parameters, truth) / np.maximum(stalls[rows[:-1]], 1)
    shift = shift * np.maximum(least / np.maximum(np.linalg.norm(shift, axis=1), 1e-9), 1.0)[:, None]
    step[is_wrong] = se3.pose(np.eye(3), shift[is_wrong])
    metres = np.concatenate([[0.0], np.cumsum(np.linalg.norm(step[:, :3, 3], axis=1))])
    return replace(Drive.of(truth, moving.aisle_shift), step=step, metres=metres, is_wrong=is_wrong)


def _frozen(moving: Drive, random: np.random.Generator) -> Drive:
    """Let the odometry report no motion for one or two stretches."""
    is_wrong = np.zeros(len(moving.step), bool)
    for _ in range(int(random.integers(1, 3))):
        start = int(random.integers(10, len(is_wrong) - 10))
        is_wrong[start : start + int(random.integers(FROZEN[0], FROZEN[1] + 1))] = True
    return replace(moving, step=np.where(is_wrong[:, None, None], np.eye(4), moving.step), is_wrong=is_wrong)


# --- paths --------------------------------------------------------------------------------------------------------


def _loop(random: np.random.Generator, laps: float | None) -> Floats:
    """(K, 3) laps of a closed road of 200-1500 m, each a little beside the other."""
    laps, length = laps or random.uniform(1.15, 3.0), random.uniform(200.0, 1500.0)
    t = np.linspace(0.0, laps, 4000)
    angle, radius = 2 * np.pi * t, np.ones(len(t))
    for k in range(2, 5):
        radius += random.uniform(0.0, 0.5 / k) * np.cos(k * angle + random.uniform(0, 2 * np.pi))
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle) * random.uniform(0.4, 1.0)], axis=1)
    lap = np.linalg.norm(np.diff(circle[t <= 1.0], axis=0), axis=1).sum()
    beside = 0.5 * _smooth(random, t, 6)
    circle = circle * length / lap * (1.0 + beside / length)[:, None]
    return np.concatenate([circle, np.zeros((len(t), 1))], axis=1)


def _blocks(random: np.random.Generator) -> Floats:
    """(K, 3) a drive of 600-3000 m over the crossings of a town, corners rounded."""
    side, across, length = random.uniform(40.0, 150.0), int(random.integers(3, 6)), random.uniform(600.0, 3000.0)
    steps, at, heading = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]), np.array([0, 0]), 0
    corners = [at]
    while len(corners) * side < length:
        # straight on twice as often as either turn; never back
        turns = [turn for turn in (0, 0, 1, -1) if _within(at + steps[(heading + turn) % 4], across)]
        heading = (heading + turns[int(random.integers(len(turns)))]) % 4
        at = at + steps[heading]
        corners.append(at)
    line = _dense(np.array(corners, float) * side, 1.0)
    return np.concatenate([_rounded(line, 8), np.zeros((len(line), 1))], axis=1)


def _within(at: Any, across: int) -> bool:
    return bool((at >= 0).all() and (at < across).all())


def _aisles(random: np.random.Generator, late: bool) -> tuple[Floats, Floats]:
    """(K, 3) up and down parallel aisles 3-8 m apart, first all of them, then some (if `late`, the first) again; and
    the shift to the next."""
    count, apart, length = int(random.integers(4, 11)), random.uniform(3.0, 8.0), random.uniform(15.0, 50.0)
    again = random.integers(0, count, int(random.uniform(0.5, 2.0) * count))
    if late:  # an even number, so that the first is entered from the same side again
        count, again = count + count % 2, np.zeros(1, np.int64)
    order, corners, end = [*range(count), *again.tolist()], [], 0.0
    for aisle in order:
        corners += [[end, aisle * apart], [length - end, aisle * apart]]
        end = length - end
    line = _rounded(_dense(np.array(corners), 0.1), 6)
    return np.concatenate([line, np.zeros((len(line), 1))], axis=1), np.array([0.0, apart, 0.0])


def _circuit(random: np.random.Generator, laps: float | None) -> Floats:
    """(K, 3) rounds of a closed curve in the air, each 1-2 m beside the other."""
    laps = laps or random.uniform(1.2, 3.0)
    t = np.linspace(0.0, laps, 4000)
    size = np.array([random.uniform(20.0, 150.0), random.uniform(20.0, 150.0), random.uniform(3.0, 20.0)])
    line = np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t), np.zeros(len(t))], axis=1)
    for k in range(2, 4):
        line += random.uniform(-0.4, 0.4, 3) * np.cos(2 * np.pi * k * t[:, None] + random.uniform(0, 2 * np.pi, 3))
    beside = np.stack([_smooth(random, t, 5) for _ in range(3)], axis=1)
    return line * size + beside + [0.0, 0.0, 30.0]


def _sweep(random: np.random.Generator) -> Floats:
    """(K, 3) strips of a field flown one way, then across."""
    width, apart, climb = random.uniform(50.0, 200.0), random.uniform(10.0, 30.0), random.uniform(0.0, 5.0)
    across, corners, end = np.arange(0.0, width, apart), [], 0.0
    for at in across.tolist():
        corners += [[end, at, 30.0], [width - end, at, 30.0]]
        end = width - end
    for at in across[::-1].tolist():
        corners += [[at, end, 30.0 + climb], [at, width - end, 30.0 + climb]]
        end = width - end
    return _rounded(_dense(np.array(corners), 1.0), 6)


def _hand_held(parameters: Parameters, random: np.random.Generator, laps: float | None) -> Floats:
    """(N, 4, 4) wandering about a room, looking around; in so many laps of a closed curve if told."""
    n = parameters.keyframes
    t = np.linspace(0.0, n / 80.0, n) + random.uniform(-0.2, 0.2, n) / 80.0
    if laps:
        t *= laps / t[-1]
    size = np.array([random.uniform(0.8, 2.5), random.uniform(0.8, 2.5), random.uniform(0.1, 0.3)])
    points = np.stack([_smooth(random, t, 3, 1.0 if laps else 0.4, bool(laps)) for _ in range(3)], axis=1) * size
    turns = [_smooth(random, t, 3, 1.0 if laps else 0.3, bool(laps)) for _ in range(3)]
    yaw, pitch, roll = (turn * spread for turn, spread in zip(turns, (1.2, 0.25, 0.15), strict=True))
    return se3.pose(_turned(yaw, pitch, roll), points)


def _dense(corners: Floats, step: float) -> Floats:
    """(K, d) a broken line at even steps."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.arange(0.0, at[-1], step)
    return np.stack([np.interp(along, at, axis) for axis in corners.T], axis=1)


def _rounded(line: Floats, half: int) -> Floats:
    """A running mean over as many points either side."""
    padded = np.pad(line, ((half, half), (0, 0)), mode="edge")
    total = np.cumsum(np.concatenate([np.zeros((1, line.shape[1])), padded]), axis=0)
    width = 2 * half + 1
    return (total[width:] - total[:-width]) / width


def _resampled(line: Floats, parameters: Parameters, random: np.random.Generator) -> Floats:
    """(N, 3) points along a line at uneven steps, no further apart than two views of one place may be, twice."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    n = int(np.clip(at[-1] / (2.0 * RADIUS_M[parameters.kind]), parameters.keyframes, 600))
    step = at[-1] / (n - 1)
    along = np.linspace(0.0, at[-1], n) + random.uniform(-0.2, 0.2, n) * step
    return np.stack([np.interp(along, at, axis) for axis in line.T], axis=1)


def _ground(points: Floats, spatial: bool, random: np.random.Generator) -> Floats:
    """(N,) heights of the ground: hills of some metres, or of some centimetres in a plane."""
    height, wave = (random.uniform(2.0, 15.0), 300.0) if spatial else (random.uniform(0.01, 0.1), 60.0)
    turn = random.uniform(0, 2 * np.pi, 4)
    x, y = points[:, 0] / wave, points[:, 1] / wave
    return height * (np.sin(2 * np.pi * x + turn[0]) * np.cos(2 * np.pi * y + turn[1]) + 0.3 * np.sin(4 * x + turn[2]))


def _headed(points: Floats, parameters: Parameters, random: np.random.Generator) -> Floats:
    """(N, 4, 4) looking along the way, give or take."""
    ahead = np.gradient(points, axis=0)
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) + random.normal(0.0, np.radians(1.0), len(points))
    if parameters.layout == "sweep":
        yaw = np.full(len(points), random.uniform(-np.pi, np.pi)) + random.normal(0.0, 0.05, len(points))
    pitch = -np.arctan2(ahead[:, 2], np.linalg.norm(ahead[:, :2], axis=1))
    t = np.linspace(0.0, 10.0, len(points))
    shake = np.radians(5.0 if parameters.kind == "drone" else 0.5)
    return se3.pose(_turned(yaw, pitch + shake * _smooth(random, t, 5), shake * _smooth(random, t, 5)), points)


def _turned(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """(N, 3, 3)."""
    x, y, z = np.eye(3)
    R = se3.so3_exp(yaw[:, None] * z) @ se3.so3_exp(pitch[:, None] * y) @ se3.so3_exp(roll[:, None] * x)
    return np.asarray(R, np.float64)


def way(truth: Floats) -> Floats:
    """(N,) metres travelled at each pose."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])


def true_pairs(parameters: Parameters, made: Drive) -> Ints:
    """(K, 2) match and query of every pair of keyframes that a true closure may join; in a `late` world only of pairs
    of the end and the beginning."""
    pairs = revisits(parameters, made, np.eye(4))
    if parameters.stratum == "late":
        pairs = pairs[pairs[:, 1] - pairs[:, 0] > LATE_SHARE * len(made.truth)]
    return pairs


def joining(made: Drive, pairs: Ints, later: int) -> Ints:
    """Of pairs (K, 2), match and query, those that join session `later` to an earlier one."""
    return pairs[(made.session[pairs[:, 1]] == later) & (made.session[pairs[:, 0]] < later)]


def revisits(parameters: Parameters, made: Drive, D: Floats, wider: float = 1.0) -> Ints:
    """(K, 2) of each query, at the spacing of the world, its nearest earlier keyframe that sees the same place, or
    would if the world were displaced."""
    truth, metres = made.truth, made.metres
    moved = D @ truth
    radius, rows = place_radius(parameters, truth) * wider, np.arange(len(truth))
    here, there = truth[:, :3, 3] - truth[0, :3, 3], moved[:, :3, 3] - truth[0, :3, 3]
    gap = (here**2).sum(1)[:, None] + (there**2).sum(1) - 2.0 * here @ there.T
    # of the angle between two rotations, by the trace of one's transpose times the other
    cosine = (truth[:, :3, :3].reshape(-1, 9) @ moved[:, :3, :3].reshape(-1, 9).T - 1.0) / 2.0
    apart = (metres - metres[:, None] > APART * radius) & (rows - rows[:, None] > 10)
    gap[~apart | (cosine < np.cos(np.radians(40.0)))] = np.inf
    best = gap.argmin(0)
    query = np.flatnonzero((gap[best, rows] < radius**2) & (rows % parameters.spacing == 0))
    return np.stack([best[query], query], axis=1)


def place_radius(parameters: Parameters, truth: Floats) -> float:
    """m; at least so much that a drive along the same line sees its keyframes again."""
    return max(RADIUS_M[parameters.kind], 0.75 * way(truth)[-1] / len(truth))


def _smooth(
    random: np.random.Generator, t: Floats, harmonics: int, first: float = 1.0, periodic: bool = False
) -> Floats:
    """A random smooth function of t (K,) of root mean square 1 or so: harmonics of frequency `first` on; multiples of
    `first` if periodic."""
    phase, size = random.uniform(0, 2 * np.pi, harmonics), random.uniform(0.3, 1.0, harmonics)
    frequency = first * (np.arange(harmonics) + 1.0)
    if not periodic:
        frequency = frequency * random.uniform(0.8, 1.2, harmonics)
    waves = np.sin(2 * np.pi * frequency * t[:, None] + phase) * size
    return waves.sum(1) / np.sqrt((size**2).sum() / 2.0)
