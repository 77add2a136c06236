from __future__ import annotations

import numpy as np
import pytest

from vplog.data import Floats, Trajectory
from vplog.geometry import se3
from vplog.geometry.motion_comparison import MotionComparison, Motions, compare_motions

PERIOD_S = 0.05
MOUNT = se3.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.3, 0.0, 0.2]))
"""body_from_camera of a camera that looks ahead."""


def drive(kind: str, rng: np.random.Generator) -> Trajectory:
    """Two minutes at 1 m/s: on a bending road, there and back, straight on, or straight on with stops."""
    seconds = np.arange(0.0, 120.0, PERIOD_S)
    speed, rate = np.full(len(seconds), 1.0), np.zeros(len(seconds))
    if kind == "bends":
        rate = 0.4 * np.sin(seconds / rng.uniform(2.0, 4.0))
    elif kind == "there and back":
        turning = (seconds > 55.0) & (seconds < 55.0 + np.pi / 0.5)
        speed[turning], rate[turning] = 0.1, 0.5
    elif kind == "stops":
        speed[seconds % 20.0 > 15.0] = 0.0
    poses = [np.eye(4)]
    for forward, turn in zip(speed[1:].tolist(), rate[1:].tolist(), strict=True):
        poses.append(poses[-1] @ se3.exp(PERIOD_S * np.array([0.0, 0.0, turn, forward, 0.0, 0.0])))
    return Trajectory((seconds * 1e9).astype(np.int64), np.array(poses))


def compared(
    track: Trajectory, rng: np.random.Generator, late_s: float = 0.0, metric: bool = True, times: float = 1.0,
    mount: Floats = MOUNT, wrong: int = 0,
) -> MotionComparison:  # fmt: skip
    """Motions of a camera on `mount` over half a second, `wrong` of them at random, compared with MOUNT as given."""
    changes = np.linalg.norm(
        np.diff(se3.log(se3.between(track.world_from_body[:-1], track.world_from_body[1:])), axis=0), axis=1
    )
    first = np.unique(
        np.r_[np.linspace(0, len(changes) - 12, 60).astype(int), np.argsort(-changes)[:8] - 4, 1100:1240:7]
    )
    last = first + 10
    seen = se3.between(track.world_from_body[first] @ mount, track.world_from_body[last] @ mount)
    seen[:, :3, 3] *= times
    seen = seen @ se3.exp(rng.normal(0.0, [0.004] * 3 + [0.01] * 3, (len(first), 6)))
    seen[rng.choice(len(first), wrong, replace=False)] = se3.exp(rng.normal(0.0, 0.5, (wrong, 6)))
    late_ns = round(late_s * 1e9)
    motions = Motions(
        track.stamp_ns[first] + late_ns, track.stamp_ns[last] + late_ns, seen, np.full(len(first), metric)
    )
    found = compare_motions(track, motions, MOUNT)
    assert found is not None
    return found


@pytest.mark.parametrize("kind", ["bends", "there and back", "stops"])
@pytest.mark.parametrize("late_s", [0.0, 0.15, 0.4, -0.83])
def test_late_stamps_are_found_on_drives_that_change_their_motion(kind: str, late_s: float) -> None:
    rng = np.random.default_rng(5)
    found = compared(drive(kind, rng), rng, late_s, wrong=8)
    assert found.offset_s.value == pytest.approx(-late_s, abs=max(5 * found.offset_s.sigma, 0.03))
    assert found.offset_s.sigma < 0.05
    assert found.offset_s.differs(0.0, 0.05) == (late_s != 0.0)
    assert found.lengths.value == pytest.approx(1.0, abs=0.05)
    assert not found.turned_rad.differs(0.0, 0.05)


def test_turns_alone_tell_the_time_offset() -> None:
    """As of a single camera, whose images have no metres."""
    rng = np.random.default_rng(6)
    found = compared(drive("there and back", rng), rng, 0.15, metric=False)
    assert found.offset_s.value == pytest.approx(-0.15, abs=0.03)
    assert np.isinf(found.lengths.sigma)


def test_a_straight_drive_does_not_determine_the_time_offset_nor_the_turns() -> None:
    rng = np.random.default_rng(7)
    found = compared(drive("straight", rng), rng, 0.4)
    assert np.isinf(found.offset_s.sigma)
    assert np.isinf(found.turns.sigma)
    assert not found.offset_s.differs(0.0, 0.05)


@pytest.mark.parametrize("times", [0.1, 0.5, 1.3, 1000.0])
def test_the_unit_of_lengths_is_found_on_any_drive(times: float) -> None:
    for kind in ("bends", "straight"):
        rng = np.random.default_rng(8)
        found = compared(drive(kind, rng), rng, times=times)
        assert found.lengths.value == pytest.approx(times, rel=0.05)
        assert found.lengths.differs(1.0, 0.05)


def test_a_wrong_mount_is_found_although_its_stamps_are_late() -> None:
    rng = np.random.default_rng(9)
    turned = se3.pose(se3.so3_exp(np.array([0.0, 0.0, 1.2])), np.zeros(3))
    found = compared(drive("bends", rng), rng, 0.2, mount=MOUNT @ turned)
    assert found.turned_rad.value == pytest.approx(1.2, abs=0.1)
    assert found.turned_rad.differs(0.0, 0.5)
    assert found.offset_s.value == pytest.approx(-0.2, abs=0.05)


def test_few_motions_tell_nothing() -> None:
    track = drive("bends", np.random.default_rng(0))
    few = Motions(track.stamp_ns[:7], track.stamp_ns[1:8], np.tile(np.eye(4), (7, 1, 1)), np.ones(7, bool))
    assert compare_motions(track, few, MOUNT) is None
