"""A made-up place: random points, a camera that drives past them, and the features it would see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Camera, Features, Keyframes
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.loops import undistort
from vplog.loops.propose import Proposals
from vplog.loops.verify import calibration_share, drive_of, verify_between

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.data import Closures, Floats
    from vplog.loops.verify import VerifySettings

BODY_FROM_CAMERA = se3.pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.3, -0.1, 0.5]))
"""Body x forward, z up; the camera sits before and above the body's origin."""
NOISE_PX = 0.5


def camera(model: str = "none", distortion: Sequence[float] = (), calibrated: bool = True) -> Camera:
    matrix = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    return Camera(
        "front", matrix if calibrated else None, model, np.array(distortion, np.float64), 640, 480, BODY_FROM_CAMERA
    )


@dataclass(frozen=True)
class Scene:
    points: Floats
    """(P, 3) in the world."""
    descriptors: np.ndarray
    """(P, 128) uint8."""


def scene(rng: np.random.Generator, count: int = 3000, length_m: float = 60.0) -> Scene:
    """Points to both sides and ahead of a road along x."""
    low, high = np.array([2.0, -12.0, -3.0]), np.array([length_m, 12.0, 6.0])
    return Scene(rng.uniform(low, high, (count, 3)), rng.integers(0, 120, (count, 128), dtype=np.uint8))


def view(
    place: Scene,
    world_from_body: Floats,
    lens: Camera,
    rng: np.random.Generator,
    depth: bool = False,
    most: int = 600,
    clutter: int = 60,
    noise_px: float = NOISE_PX,
) -> Features:
    """What `lens` sees at a pose: points with noise, descriptors nearly as stored, and `clutter` of neither."""
    real = lens if lens.matrix is not None else camera()
    camera_from_world = se3.inverse(world_from_body @ lens.body_from_camera)
    seen = se3.transform(camera_from_world, place.points)
    pixels = undistort.project(real, seen) + rng.normal(0, noise_px, (len(seen), 2))
    inside = ((pixels > 0) & (pixels < [lens.width - 1, lens.height - 1])).all(axis=1) & (seen[:, 2] > 1.0)
    rows = np.flatnonzero(inside)[:most]
    z = 1.0 / (1.0 / seen[rows, 2] + rng.normal(0, 1.425e-3, len(rows))) if depth else np.full(len(rows), np.nan)
    noisy = place.descriptors[rows].astype(int) + rng.integers(-8, 9, (len(rows), 128))
    descriptors = np.concatenate([np.clip(noisy, 0, 255), rng.integers(0, 120, (clutter, 128))]).astype(np.uint8)
    random = rng.uniform(0, [lens.width, lens.height], (clutter, 2))
    total = len(rows) + clutter
    return Features(
        np.concatenate([pixels[rows], random]).astype(np.float32),
        np.ones(total, np.float32),
        descriptors,
        np.concatenate([z, np.full(clutter, np.nan)]).astype(np.float32),
        lens.width,
        lens.height,
    )


def empty(lens: Camera) -> Features:
    return Features(
        np.empty((0, 2), np.float32),
        np.empty(0, np.float32),
        np.empty((0, 128), np.uint8),
        np.empty(0, np.float32),
        lens.width,
        lens.height,
    )


def pose(x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0) -> Floats:
    return se3.pose(se3.so3_exp(np.array([0.0, pitch, yaw])), np.array([x, y, z]))


def keyframes(poses: Sequence[Floats]) -> Keyframes:
    return Keyframes("made-up", np.arange(len(poses), dtype=np.int64) * 10**9, np.array(poses).reshape(-1, 4, 4))


def proposals(pairs: Sequence[tuple[int, int]]) -> Proposals:
    rows = np.array(pairs, np.int32).reshape(-1, 2)
    count = len(rows)
    rank = np.array([sum(1 for q, _ in pairs[:i] if q == pairs[i][0]) for i in range(count)], np.int32)
    return Proposals(
        rows[:, 0], rows[:, 1], rank, np.linspace(1, 0, count, dtype=np.float32), np.zeros(count, np.int32)
    )


def verify(
    found: Proposals,
    frames: Keyframes,
    lens: Camera,
    features: Callable[[int], Features],
    settings: VerifySettings,
    execution: Execution = Execution(),
) -> Closures:
    """The ledger of the proposals of one drive."""
    alone = drive_of(frames, lens, features, settings)
    share = calibration_share(alone, execution) if lens.matrix is not None and len(found.query) else 0.0
    return verify_between(found, alone, alone, execution, share)
