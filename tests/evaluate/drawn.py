"""Drives drawn by chance, whose closures are known to be right or wrong: a room, a road, a drone, aisles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tests.graph.drive import ledger
from vplog.data import Closures, Keyframes, Trajectory
from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Floats, Ints

KINDS = ("room", "road", "drone", "aisles")
METRES = {"room": 3.6, "road": 900.0, "drone": 150.0, "aisles": 220.0}
"""Of one lap."""
SPEED = {"room": 0.4, "road": 9.0, "drone": 4.0, "aisles": 1.5}
"""m/s."""
SIGMA = {"room": (0.012, 0.015), "road": (0.004, 0.05), "drone": (0.005, 0.03), "aisles": (0.005, 0.02)}
"""rad and m that closures are known by."""
LOOKS_ALONG_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of body_from_camera."""
PERIOD_NS = 50_000_000
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class Drawn:
    """A drive of two laps and a bit."""

    truth: Trajectory
    """Of the body, at 20 Hz."""
    odometry: Trajectory
    keyframes: Keyframes
    closures: Closures
    right: np.ndarray
    """(C,) the label."""
    stop: Ints
    camera: Floats
    """body_from_camera."""


def draw(kind: str, seed: int) -> Drawn:
    """Half of the closures are right: within 3 sigma of what they claim. The others are wrong as closures are."""
    rng = np.random.default_rng(seed)
    poses = _laps(kind, rng)
    stamps = START_NS + PERIOD_NS * np.arange(len(poses))
    odometry = Trajectory(stamps, _drifted(poses, rng))
    away = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    rows = np.unique(np.searchsorted(away, np.arange(0.0, away[-1], METRES[kind] / 120.0)))
    rows = rows[rows < len(poses)]
    keyframes = Keyframes(kind, stamps[rows], odometry.world_from_body[rows])
    closures, right = _closures(kind, poses[rows], rng)
    stop = np.maximum(np.arange(len(rows)) - 30, 0)
    camera = se3.pose(LOOKS_ALONG_X, rng.uniform(-0.1, 0.1, 3))
    return Drawn(Trajectory(stamps, poses), odometry, keyframes, closures, right, stop, camera)


def _laps(kind: str, rng: np.random.Generator) -> Floats:
    """(T, 4, 4) at 20 Hz along a closed line, at a speed that varies, each lap a little beside the other."""
    corners = _aisles() if kind == "aisles" else _ring(kind, rng)
    line = _even(np.concatenate([corners, corners, corners[: len(corners) // 8]]), METRES[kind] / 2000.0)
    half = 40  # a fiftieth of a lap: no vehicle turns on the spot
    line = np.stack([np.convolve(axis, np.ones(2 * half) / (2 * half), "valid") for axis in line.T], axis=1)
    count = int(20 * len(line) * METRES[kind] / 2000.0 / SPEED[kind])
    seconds = np.arange(count) / 20.0
    speed = 1.0 + 0.6 * np.sin(2 * np.pi * seconds / rng.uniform(4, 8) + rng.uniform(0, 6))
    at = np.cumsum(speed) / speed.sum() * (len(line) - 2)
    position = np.stack([np.interp(at, np.arange(len(line)), axis) for axis in line.T], axis=1)
    ahead = np.stack([np.interp(at + 1.0, np.arange(len(line)), axis) for axis in line.T], axis=1) - position
    turn = np.zeros((count, 3))
    turn[:, 2] = np.arctan2(ahead[:, 1], ahead[:, 0])
    poses = se3.pose(se3.so3_exp(turn), position)
    if kind in ("room", "drone"):  # rolls about the axis it looks along, and nods
        most = np.radians(25.0 if kind == "room" else 8.0)
        roll, nod = (most * np.sin(2 * np.pi * seconds / rng.uniform(3, 5) + rng.uniform(0, 6)) for _ in range(2))
        poses = poses @ se3.pose(se3.so3_exp(np.stack([roll, 0.4 * nod, 0 * nod], axis=1)), np.zeros(3))
    return poses


def _ring(kind: str, rng: np.random.Generator) -> Floats:
    """(P, 3) a closed, wavy line."""
    phase = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    radius = 1.0 + 0.15 * np.sin(3 * phase + rng.uniform(0, 6)) + 0.1 * np.sin(2 * phase + rng.uniform(0, 6))
    size = METRES[kind] / 6.6
    height = np.zeros(400) if kind == "road" else 0.1 * size * np.sin(2 * phase + rng.uniform(0, 6))
    return np.stack([size * radius * np.cos(phase), size * radius * np.sin(phase), height], axis=1)


def _aisles() -> Floats:
    """Aisles of 40 m, 8 m apart, one after the other, and back along the ends."""
    return np.array([
        [0, 0, 0], [40, 0, 0], [40, 8, 0], [0, 8, 0], [0, 16, 0], [40, 16, 0], [40, 24, 0], [-8, 24, 0], [-8, 0, 0],
    ], np.float64)  # fmt: skip


def _even(points: Floats, step_m: float) -> Floats:
    """The line through the points, one every `step_m`."""
    away = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.stack([np.interp(np.arange(0.0, away[-1], step_m), away, axis) for axis in points.T], axis=1)


def _drifted(poses: Floats, rng: np.random.Generator) -> Floats:
    """Odometry: 2 % too long, noise of 1 % of each step, and a slow turn, from the identity on."""
    steps = se3.log(se3.between(poses[:-1], poses[1:]))
    length = np.linalg.norm(steps[:, 3:], axis=1, keepdims=True)
    steps[:, 3:] = 1.02 * steps[:, 3:] + 0.01 * length * rng.normal(size=(len(steps), 3))
    steps[:, :3] += 1e-4 * rng.normal(size=(len(steps), 3)) + np.array([0.0, 0.0, 2e-5])
    found = np.empty_like(poses)
    found[0] = np.eye(4)
    for row, step in enumerate(se3.exp(steps), start=1):
        found[row] = found[row - 1] @ step
    return found


def _closures(kind: str, poses: Floats, rng: np.random.Generator) -> tuple[Closures, np.ndarray]:
    """Closures of the second lap with the nearest keyframe of the first."""
    half = len(poses) // 2
    query = np.sort(rng.choice(np.arange(half, len(poses)), 60, replace=False)).astype(np.int32)
    away = np.linalg.norm(poses[query, None, :3, 3] - poses[None, : half - 20, :3, 3], axis=2)
    match = away.argmin(1).astype(np.int32)
    sigma = np.repeat(SIGMA[kind], 3)
    draws = rng.normal(size=(60, 6))
    parts = draws.reshape(60, 2, 3)  # no honest outlier: the labels are exact
    draws = (parts * np.minimum(1.0, 3.0 / np.linalg.norm(parts, axis=2, keepdims=True))).reshape(60, 6)
    measured = se3.between(poses[match], poses[query]) @ se3.exp(draws * sigma)
    information = np.tile(np.diag(1.0 / sigma**2), (60, 1, 1))
    right = rng.random(60) < 0.5
    for row in np.flatnonzero(~right).tolist():
        name, fault = _fault(kind, rng)
        measured[row] = measured[row] @ fault
        if name != "road" and rng.random() < 0.3:  # and claims to know next to nothing
            information[row] = np.diag(1.0 / np.repeat([1.0, 100.0], 3) ** 2)
    return replace(ledger(query, match, measured), information=information), right


def _fault(kind: str, rng: np.random.Generator) -> tuple[str, Floats]:
    """To another aisle, or off by 1.1 m and 8 degrees, or far more in either."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    faults = {
        "aisle": np.concatenate([np.zeros(3), 8.0 * axis]),
        "road": np.concatenate([np.radians(rng.uniform(8.0, 40)) * axis, 1.1 * axis]),
        "turn": np.concatenate([np.radians(rng.uniform(15, 170)) * axis, np.zeros(3)]),
        "far": np.concatenate([np.zeros(3), axis * METRES[kind] * rng.uniform(0.1, 0.5)]),
    }
    name = str(rng.choice(sorted(faults)))
    return name, se3.exp(faults[name])
