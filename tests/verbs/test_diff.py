"""Two runs of a drive compared: nothing differs from itself, and what differs is named with its size."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from vplog.data import Trajectory
from vplog.errors import ResultError, SettingsError
from vplog.geometry import se3
from vplog.maps.diff import diff_maps
from vplog.results import tables
from vplog.results.run_cameras import unit_camera
from vplog.results.run_record import read_run_json, write_run_json
from vplog.verbs.diff import FIGURES, check_limits, diff, exceeded

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo


@pytest.fixture
def changed(finished: Path, tmp_path: Path) -> Path:
    """The run turned as a whole, its last third lifted by 3 m, without its first closure, by another setting."""
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    header = tables.TableMetadata({}, "")
    trajectory, odometry = tables.read_trajectory(out / "trajectory.parquet")
    poses = trajectory.world_from_body.copy()
    poses[2 * len(poses) // 3 :, 2, 3] += 3.0
    turned = se3.exp(np.array([[0.1, 0.2, 0.3, 50.0, 0.0, 1.0]]))[0] @ poses
    tables.write_trajectory(out / "trajectory.parquet", Trajectory(trajectory.stamp_ns, turned), odometry, header)
    closures = tables.read_closures(out / "closures.parquet")
    keyframes, _ = tables.read_keyframes(out / "keyframes.parquet")
    tables.write_closures(out / "closures.parquet", closures.rows(np.arange(1, len(closures))), keyframes, header)
    record = read_run_json(out / "run.json")
    record["settings"]["verify"]["min_matches"] = 7
    record["totals"]["seconds"] *= 2.0
    write_run_json(out / "run.json", record)
    return out


def test_a_run_does_not_differ_from_itself(finished: Path, drive: Demo) -> None:
    found = diff(finished, finished, str(drive.truth))
    assert found["settings"] == {}
    assert found["closures"]["gained"] == found["closures"]["lost"] == []
    assert list(found["figures"]) == list(FIGURES)
    assert all(change == pytest.approx(0.0, abs=1e-5) for *_, change in found["figures"].values())


def test_what_differs_is_named_with_its_size(finished: Path, changed: Path) -> None:
    found = diff(finished, changed)
    assert found["settings"] == {"verify.min_matches": [25, 7]}
    closures = tables.read_closures(finished / "closures.parquet")
    stamps = tables.read_keyframes(finished / "keyframes.parquet")[0].stamp_ns
    lost = [(stamps[closures.query[0]], stamps[closures.match[0]])] if closures.accepted[0] else []
    assert (found["closures"]["lost"], found["closures"]["gained"]) == (lost, [])
    assert 0.5 < found["trajectory"]["rmse_m"] < 2.0  # turned back, and the step shared among all
    back = diff(changed, finished)
    assert back["closures"]["gained"] == lost
    assert back["figures"]["seconds"][2] == pytest.approx(-found["figures"]["seconds"][2])


def test_the_page_has_both_trajectories_and_what_changed(
    finished: Path, changed: Path, verb: Callable[..., Said], tmp_path: Path
) -> None:
    assert verb("diff", changed, finished, "-o", tmp_path / "diff.html").code == 0
    text = (tmp_path / "diff.html").read_text(encoding="utf-8")
    assert "verify.min_matches" in text
    audit = json.loads(text.partition('id="audit">')[2].partition("</script>")[0])
    gained = diff(changed, finished)["closures"]["gained"]
    assert audit["columns"]["change"].count("gained") == len(gained)
    path = next(one["points"] for one in audit["map"]["paths"] if one["kind"] == "other")
    apart = np.array(path) - next(one["points"] for one in audit["map"]["paths"] if one["kind"] == "after")
    assert 0.5 < np.sqrt((apart**2).sum(1).mean()) < 2.0  # aligned: the step alone is left


def test_a_limit_sets_the_exit_status(finished: Path, changed: Path, verb: Callable[..., Said]) -> None:
    good = verb("diff", finished, changed, "--fail-on", "seconds>101%", "--fail-on", "moved_m > 2")
    assert (good.code, "min_matches" in good.out) == (0, True)
    bad = verb("diff", changed, "--baseline", finished, "--fail-on", "seconds>=99%", "--json")
    assert bad.code == 1
    assert "error: seconds changed by +100%" in bad.err
    assert verb("diff", finished).code == 2
    assert "Give --truth" in verb("diff", finished, finished, "--fail-on", "recall<0").err


@pytest.mark.parametrize("limit", ["", "recall", "recall<", "recal<1", "recall=1", "recall<1e999", "a.b<1", "a<b"])
def test_what_is_no_limit_is_refused(limit: str) -> None:
    with pytest.raises(SettingsError, match="is no limit"):
        check_limits([limit])


@pytest.mark.parametrize(
    ("limit", "fails"),
    [("recall<-0.01", True), ("recall<-0.03", False), ("recall<=-2%", True), ("recall > .1", False)],
)  # fmt: skip
def test_limits_are_of_the_change(limit: str, fails: bool) -> None:
    found: dict[str, Any] = {"figures": {"recall": [1.0, 0.98, -0.02]}}
    assert bool(exceeded(found, [limit])) is fails


def test_a_change_that_is_not_known_fails_no_limit_silently() -> None:
    with pytest.raises(SettingsError, match="not known"):
        exceeded({"figures": {"recall": [None, 0.9, None]}}, ["recall<0"])


def test_two_maps(halves: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    """One loses a drive, and with it its closures and those between both."""
    assert diff_maps(halves, halves)["trajectory"]["max_m"] == pytest.approx(0.0, abs=1e-9)
    less = tmp_path / "map"
    shutil.copytree(halves, less)
    assert verb("map", "remove", less, "before").code == 0
    found = verb("diff", halves, less, "--json").json
    assert found["drives"] == {"gained": [], "lost": ["before"]}
    assert found["figures"]["drives"] == [2, 1, -1]
    joins = [ends for ends in found["closures"]["lost"] if len({end.split("/")[0] for end in ends}) == 2]
    assert len(joins) == found["figures"]["joins"][0] > 0
    assert not found["closures"]["gained"]
    assert found["settings"] == {}
    assert "drives lost" in verb("diff", halves, less).out
    assert verb("diff", halves, less, "--fail-on", "drives<0").code == 1
    assert verb("diff", halves, tmp_path).code == 2


def test_a_run_without_metres_is_compared_by_its_shape(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    trajectory, odometry = tables.read_trajectory(out / "trajectory.parquet")
    unknown = read_run_json(out / "run.json") | {"scale": "unknown"}
    own = Trajectory(trajectory.stamp_ns, se3.stretched(trajectory.world_from_body, 0.1, unit_camera(unknown)))
    tables.write_trajectory(out / "trajectory.parquet", own, odometry, tables.TableMetadata({}, ""))
    assert diff(finished, out)["trajectory"]["rmse_m"] > 1.0
    write_run_json(out / "run.json", unknown)
    assert diff(finished, out)["trajectory"]["rmse_m"] < 1e-6


def test_runs_with_odometry_of_other_stamps_are_compared_at_those_of_the_baseline(
    finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    trajectory, odometry = tables.read_trajectory(out / "trajectory.parquet")
    at_ns = trajectory.stamp_ns[:-1] + 1_000_000
    poses = se3.interpolate_at(trajectory.stamp_ns, trajectory.world_from_body, at_ns)
    for shift_ns in (0, 10**12):
        own = Trajectory(at_ns + shift_ns, poses)
        other = replace(odometry, stamp_ns=own.stamp_ns, odom_from_body=odometry.odom_from_body[:-1], covariance=None)
        tables.write_trajectory(out / "trajectory.parquet", own, other, tables.TableMetadata({}, ""))
        if shift_ns == 0:
            found = diff(finished, out)["trajectory"]
            assert (found["samples"], found["rmse_m"] < 1e-3) == (len(at_ns) - 1, True)
        else:
            with pytest.raises(ResultError, match="have 0 stamps in common"):
                diff(finished, out)
