"""Messages of satellite receivers that hold no position, or one that cannot be."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.logs.drives import (
    FRAMES,
    START_NS,
    Drive,
    foxglove_messages,
    ros_messages,
    write_foxglove,
    write_ros1,
    write_ros2,
)
from vplog import logs
from vplog.geometry import geodesy
from vplog.logs.formats.container import Notes
from vplog.logs.messages.records import FixMessage
from vplog.logs.tracks import FixTrack

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Gps

DEGREE_M = 111_000.0


def track(fixes: list[FixMessage], any_status: bool = False) -> tuple[Gps | None, str]:
    notes, found = Notes(), FixTrack("/fix", any_status)
    for fix in fixes:
        found.add(fix, fix.stamp_ns)
    return found.finish(notes), " ".join(notes.lines)


def drive(seed: int, count: int = 40) -> list[FixMessage]:
    """Fixes at any rate of something at any place and speed below 50 m/s."""
    rng = np.random.default_rng(seed)
    latitude, longitude, hz = rng.uniform(-60, 60), rng.uniform(-170, 170), rng.uniform(0.5, 10)
    east, north = np.cumsum(rng.uniform(-30, 50, (2, count)) / hz / DEGREE_M, axis=1)
    return [
        FixMessage(
            START_NS + int(i / hz * 1e9), True, latitude + north[i], longitude + east[i] / 2, 500.0, np.eye(3), "gps"
        )
        for i in range(count)
    ]


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_sound_fixes_are_all_taken(seed: int) -> None:
    fixes = drive(seed)
    gps, said = track(fixes)
    assert gps is not None
    assert gps.latitude_deg.tolist() == [fix.latitude_deg for fix in fixes]
    assert said == ""


@given(seeds)
def test_fixes_of_any_status_are_taken_on_request(seed: int) -> None:
    fixes = [dataclasses.replace(fix, valid=False) for fix in drive(seed)]
    gps, said = track(fixes)
    assert gps is None
    assert "--gps-any-status" in said
    gps, said = track(fixes, any_status=True)
    assert gps is not None
    assert len(gps.stamp_ns) == len(fixes)
    assert said == ""


@given(seeds, st.sampled_from([
    ({"latitude_deg": 0.0, "longitude_deg": 0.0}, "(0, 0)"),
    ({"latitude_deg": -0.0, "longitude_deg": 1e-12}, "(0, 0)"),
    ({"valid": False}, "no fix"),
    ({"latitude_deg": np.nan}, "not a number"),
    ({"longitude_deg": np.inf}, "not a number"),
    ({"latitude_deg": 139.7, "longitude_deg": 35.6}, "swapped"),
    ({"latitude_deg": 91.0, "longitude_deg": 100.0}, "out of range"),
    ({"longitude_deg": 400.0}, "out of range"),
    ({"latitude_deg": 5.0, "longitude_deg": 5.0}, "nothing moves that far"),
]))  # fmt: skip
def test_what_is_no_position_is_left_out_and_said(seed: int, case: tuple[dict[str, Any], str]) -> None:
    rng = np.random.default_rng(seed)
    change, says = case
    fixes = drive(seed)
    rows = np.sort(rng.choice(len(fixes), 5, replace=False)) if rng.random() < 0.5 else np.arange(5)  # or at the start
    for row in rows.tolist():
        fixes[row] = dataclasses.replace(fixes[row], **change)
    gps, said = track(fixes)
    assert gps is not None
    assert gps.stamp_ns.tolist() == [fix.stamp_ns for row, fix in enumerate(fixes) if row not in rows]
    assert says in said and ("5 " in said or "4 of 40 fixes left out: they repeat" in said)


@given(seeds)
def test_a_snap_of_some_metres_splits_no_drive(seed: int) -> None:
    """At 10 Hz 14 m are 140 m/s: multipath, which the residuals of the fixes tell."""
    rng = np.random.default_rng(seed)
    north_m = 0.5 * np.arange(600) + rng.normal(0, 0.5, 600)
    north_m[rng.choice(600, 3, replace=False)] += 14.0
    gps, _ = track([
        FixMessage(START_NS + row * 10**8, True, 48 + north / DEGREE_M, 11.0, 500.0, np.eye(3), "gps")
        for row, north in enumerate(north_m.tolist())
    ])  # fmt: skip
    assert gps is not None
    assert len(gps.stamp_ns) >= 597


@given(seeds, st.sampled_from(["bursts", "one", "pairs", "same"]), st.booleans())
def test_stamps_that_crowd_make_no_fix_unreachable(seed: int, how: str, wrong: bool) -> None:
    """Log times of messages that came together, a stamp 1 ms behind its neighbour's, two receivers; 1 m of noise."""
    rng = np.random.default_rng(seed)
    at_s = np.arange(300.0)
    if how == "bursts":
        for row in (40, 90, 150, 200, 260):
            at_s[row - 2 : row] = at_s[row] - [0.002, 0.001]
    elif how == "pairs":
        at_s[1::2] = at_s[::2] + 0.01
    else:
        at_s[150] = at_s[149] + (1e-3 if how == "one" else 1e-7)
    north_m = (
        10.0 * np.arange(300) + rng.normal(0, 1, 300) + 3000.0 * wrong * np.isin(np.arange(300), [70, 71, 72, 180])
    )
    fixes = [
        FixMessage(START_NS + round(second * 1e9), True, 48 + north / DEGREE_M, 11.0, 500.0, np.eye(3), "gps")
        for second, north in zip(at_s.tolist(), north_m.tolist(), strict=True)
    ]
    gps, _ = track(fixes)
    assert gps is not None
    left_out = ~np.isin([fix.stamp_ns for fix in fixes], gps.stamp_ns)
    assert np.flatnonzero(left_out).tolist() == ([70, 71, 72, 180] if wrong else [])


@given(seeds, st.floats(0.1, 0.4))
def test_fixes_that_jump_at_random_are_left_out(seed: int, share: float) -> None:
    """Up to 40 %, by 11 km and more: those that no neighbour confirms are not taken for being in reach."""
    rng = np.random.default_rng(seed)
    fixes = drive(seed, 300)
    wrong = rng.random(len(fixes)) < share
    for row in np.flatnonzero(wrong).tolist():
        off = rng.uniform(0.1, 2) * rng.choice([-1, 1])
        fixes[row] = dataclasses.replace(fixes[row], latitude_deg=fixes[row].latitude_deg + off)
    gps, said = track(fixes)
    assert gps is not None
    taken = np.isin([fix.stamp_ns for fix in fixes], gps.stamp_ns)
    assert taken[wrong].sum() <= 2  # two may confirm each other by chance
    assert taken[~wrong].mean() > 0.95
    assert f"{300 - taken.sum()} of 300 fixes left out" in said or not wrong.any()


@given(seeds, st.integers(3, 30), st.booleans())
def test_a_receiver_that_freezes_is_left_out_while_it_does(seed: int, repeats: int, stands: bool) -> None:
    """Its driver publishes the last fix again, with new stamps; a vehicle that stands goes on from there."""
    fixes = drive(seed, 120)
    rows = np.arange(41, 41 + repeats)
    moved = [dataclasses.replace(fix, latitude_deg=fixes[0].latitude_deg + 1e-4 * row) for row, fix in enumerate(fixes)]
    back = 1e-4 * repeats if stands else 0.0
    for row in rows.tolist():
        moved[row] = dataclasses.replace(moved[40], stamp_ns=fixes[row].stamp_ns)
    for row in range(41 + repeats, 120):
        moved[row] = dataclasses.replace(moved[row], latitude_deg=moved[row].latitude_deg - back,
                                         longitude_deg=moved[40].longitude_deg)  # fmt: skip
    for row in range(40):
        moved[row] = dataclasses.replace(moved[row], longitude_deg=moved[40].longitude_deg)
    gps, said = track(moved)
    assert gps is not None
    left = [] if stands else rows.tolist()
    assert gps.stamp_ns.tolist() == [fix.stamp_ns for row, fix in enumerate(moved) if row not in left]
    assert ("lost its receiver" in said) is not stands


def test_nothing_but_zeros_is_no_gps() -> None:
    gps, said = track([dataclasses.replace(fix, latitude_deg=0.0, longitude_deg=0.0) for fix in drive(1)])
    assert gps is None
    assert "40 messages without a fix" in said


@pytest.mark.parametrize("rows", [[3], [0, 1, 2], range(40)])
@pytest.mark.parametrize("covariance", [np.eye(3), np.full((3, 3), np.nan)])
def test_fixes_without_an_altitude_still_say_where(rows: Any, covariance: np.ndarray) -> None:
    fixes = [dataclasses.replace(fix, covariance=covariance) for fix in drive(4)]
    for row in rows:
        fixes[row] = dataclasses.replace(fixes[row], altitude_m=np.nan)
    gps, said = track(fixes)
    assert gps is not None
    assert len(geodesy.local_enu(gps)) == len(fixes)
    assert set(gps.altitude_m) == ({0.0} if len(rows) == len(fixes) else {500.0})
    assert (gps.covariance[list(rows), 2, 2] > 1e9).all()
    assert np.isfinite(gps.covariance[list(rows)]).all()
    assert "no altitude" in said


@pytest.mark.parametrize("variances", [[np.inf, 1.0, 1.0], [-1.0, 0.0, 0.0], [1.0, 1.0, -1e-3], [0.0, 0.0, 0.0]])
def test_a_covariance_that_no_noise_has_is_unknown(variances: list[float]) -> None:
    fixes = drive(2)
    fixes[7] = dataclasses.replace(fixes[7], covariance=np.diag(variances))
    gps, _ = track(fixes)
    assert gps is not None
    assert np.flatnonzero(np.isnan(gps.covariance).all((1, 2))).tolist() == [7]


@pytest.mark.parametrize("fmt", ["cdr", "ros1", "protobuf", "json"])
def test_zeros_before_the_first_fix_in_every_format(fmt: str, tmp_path: Path) -> None:
    fox = fmt in ("protobuf", "json")
    messages = foxglove_messages(Drive()) if fox else ros_messages(Drive(), 1 if fmt == "ros1" else 2)
    for message in [message for message in messages if message.topic == "/fix"][:2]:
        message.message.latitude = message.message.longitude = 0.0
    if fox:
        path = write_foxglove(tmp_path / "drive.mcap", messages, fmt)
    else:
        path = write_ros1(tmp_path / "drive.bag", messages) if fmt == "ros1" else write_ros2(tmp_path / "a", messages)
    log = logs.open(path)
    gps = log.gps()
    assert gps is not None
    assert len(gps.stamp_ns) == FRAMES - 2
    assert gps.latitude_deg.min() > 47
    assert "(0, 0)" in " ".join(log.warnings)
