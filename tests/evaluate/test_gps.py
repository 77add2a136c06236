from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from tests.evaluate.data import data
from vplog.data import Gps, Trajectory
from vplog.errors import TruthError
from vplog.evaluate.trajectory import ate_together
from vplog.evaluate.truth import ate_to_gps, local_enu, matched_fixes, read_truth
from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Floats

A_M, B_M = 6_378_137.0, 6_356_752.314245
"""m, the half axes of WGS84."""


def gps(latitude: Any, longitude: Any, altitude: Any) -> Gps:
    latitude, longitude, altitude = (
        np.array(value, float) for value in np.broadcast_arrays(latitude, longitude, altitude)
    )
    stamp_ns = 1_000_000_000 * np.arange(len(latitude))
    return Gps(stamp_ns, latitude, longitude, altitude, np.full((len(latitude), 3, 3), np.nan))


@given(st.floats(-80, 80), st.floats(-180, 180))
def test_short_arcs_have_the_length_of_the_ellipsoid(latitude: float, longitude: float) -> None:
    """The arc of the meridian by numerical integration of the ellipse; the circle of the parallel exactly."""
    step = 1e-4  # degrees: 11 m
    _, enu = local_enu(gps([latitude, latitude + step, latitude], [longitude, longitude, longitude + step], 0.0))

    def speed(parametric: float) -> float:
        return float(np.hypot(A_M * np.sin(parametric), B_M * np.cos(parametric)))

    start, stop = (np.arctan(B_M / A_M * np.tan(np.radians(angle))) for angle in (latitude, latitude + step))
    assert enu[1] == pytest.approx([0.0, quad(speed, start, stop)[0], 0.0], abs=1e-4)
    parallel_m = A_M * np.cos(start) * np.radians(step)
    assert enu[2] == pytest.approx([parallel_m, 0.0, 0.0], abs=1e-4)


@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(-100, 9000))
def test_up_is_altitude_and_distances_are_kept(latitude: float, longitude: float, altitude: float) -> None:
    _, enu = local_enu(gps([latitude, latitude], [longitude, longitude], [altitude, altitude + 50.0]))
    assert enu[0].tolist() == [0.0, 0.0, 0.0]
    assert enu[1] == pytest.approx([0.0, 0.0, 50.0], abs=1e-7)


def test_the_far_side_of_the_earth() -> None:
    _, enu = local_enu(gps([0.0, 0.0, 90.0], [0.0, 180.0, 0.0], 0.0))
    assert enu[1] == pytest.approx([0.0, 0.0, -2 * A_M], abs=1e-6)
    assert enu[2] == pytest.approx([0.0, B_M, -A_M], abs=1e-3)


def test_fixes_without_a_position_are_left_out() -> None:
    stamp_ns, enu = local_enu(gps([np.nan, 49.0, 95.0, 49.0], [8.0, 8.0, 8.0, 8.0], [0.0, 100.0, 0.0, 101.0]))
    assert stamp_ns.tolist() == [1_000_000_000, 3_000_000_000]
    assert enu[1] == pytest.approx([0, 0, 1], abs=1e-9)
    with pytest.raises(TruthError, match="None of the 1 GPS fixes"):
        local_enu(gps([np.nan], [8.0], [0.0]))


def straight(count: int, speed_m_s: float) -> Trajectory:
    """East along the equator, ten poses per second."""
    positions: Floats = np.zeros((count, 3))
    positions[:, 1] = speed_m_s * 0.1 * np.arange(count)  # in another frame than east-north-up
    return Trajectory(100_000_000 * np.arange(count), se3.pose(np.eye(3), positions))


def test_ate_to_fixes_between_the_poses() -> None:
    degree_m = A_M * np.radians(1.0)
    fixes = gps([0.0] * 8, np.arange(8) * 5.0 / degree_m, 0.0)
    shifted = dataclasses.replace(fixes, stamp_ns=fixes.stamp_ns + 33_333_333)
    found = ate_to_gps(straight(100, 5.0), shifted)
    assert found.count == 8
    assert found.max_m < 1e-3  # the curvature of the earth over 35 m


def test_drives_with_fixes_are_aligned_together() -> None:
    """Two halves of a straight drive, the second of them 3 m off to the side. A line that is fitted to a step of 3 m
    leaves half of the 1.5 m that its mean would leave."""
    degree_m = A_M * np.radians(1.0)
    fixes = gps([0.0] * 16, np.arange(16) * 5.0 / degree_m, 0.0)
    halves = [
        Gps(*(getattr(fixes, one.name)[rows] for one in dataclasses.fields(Gps)[:5]))
        for rows in (slice(8), slice(8, None))
    ]
    whole, aside = straight(160, 5.0), se3.pose(np.eye(3), np.array([3.0, 0.0, 0.0]))
    for second, wrong_m in ((whole, 0.0), (Trajectory(whole.stamp_ns, aside @ whole.world_from_body), 0.75)):
        matched = [matched_fixes(whole, halves[0]), matched_fixes(second, halves[1])]
        together, *each = ate_together(matched)
        assert (together.count, [one.count for one in each]) == (16, [8, 8])
        assert together.rmse_m == pytest.approx(wrong_m, abs=0.01)
        assert all(ate_to_gps(*one).rmse_m < 1e-3 for one in ((whole, halves[0]), (second, halves[1])))


def test_fixes_outside_the_drive_are_one_line() -> None:
    fixes = gps([0.0] * 8, np.arange(8) * 1e-5, 0.0)
    for trajectory, says in ((straight(15, 1.0), "Only 2 of 8"), (straight(1, 1.0), "fewer than 2 poses")):
        with pytest.raises(TruthError, match=says):
            ate_to_gps(trajectory, fixes)
    assert ate_to_gps(straight(25, 1.0), fixes).count == 3, "so many are needed"


def test_fixes_of_a_real_drive_lie_on_its_truth() -> None:
    """The fixes claim a noise of 1.5 m east and north and 3 m up, and the error to the truth is just that."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    truth = read_truth(data("drives/kitti00.groundtruth.tum"))
    rows = []
    with highlevel.AnyReader([data("drives/kitti00")]) as reader:
        topics = [connection for connection in reader.connections if connection.topic == "/gps/fix"]
        for connection, _, raw in reader.messages(topics):
            fix = reader.deserialize(raw, connection.msgtype)
            stamp = fix.header.stamp
            rows.append((stamp.sec * 10**9 + stamp.nanosec, fix.latitude, fix.longitude, fix.altitude))
    stamps, latitude, longitude, altitude = zip(*rows, strict=True)
    fixes = Gps(
        np.array(stamps), np.array(latitude), np.array(longitude), np.array(altitude), np.zeros((len(rows), 3, 3))
    )
    found = ate_to_gps(truth, fixes)
    assert found.count > 160
    assert found.rmse_m == pytest.approx(np.sqrt(1.5**2 + 1.5**2 + 3.0**2), rel=0.1)


def test_fixes_are_those_of_the_antenna_where_its_place_is_known() -> None:
    """In a circle the antenna, 2 m ahead of the body, is on a wider one."""
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    rotation = se3.so3_exp(angle[:, None] * [0.0, 0.0, 1.0])
    body = np.stack([10.0 * np.sin(angle), -10.0 * np.cos(angle), 0.0 * angle], axis=1)
    antenna = body + (rotation @ [2.0, 0.0, 0.0])
    degree_m = A_M * np.radians(1.0)
    parallel = degree_m * (B_M / A_M) ** 2  # of a meridian at the equator
    found = gps(antenna[:, 1] / parallel, antenna[:, 0] / degree_m, 0.0)
    estimate = Trajectory(found.stamp_ns, se3.pose(rotation, body))
    assert ate_to_gps(estimate, found).rmse_m > 0.1
    placed = dataclasses.replace(found, antenna_m=np.array([2.0, 0.0, 0.0]))
    assert ate_to_gps(estimate, placed).rmse_m < 1e-3
