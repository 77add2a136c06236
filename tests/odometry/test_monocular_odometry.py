"""Visual odometry of a single camera: structure of two views, a rendered street, a camera that turns, and metres."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from vplog.data import Camera, Frame, Gps, Keyframes, Odometry
from vplog.errors import TruthError
from vplog.execution.execution import Execution
from vplog.geometry import geodesy, se3
from vplog.odometry.metric_scale import in_metres
from vplog.odometry.sensor import Sensor
from vplog.odometry.two_views import UNIT_DEPTH, rho_of, rho_variance, two_views
from vplog.odometry.visual import visual_odometry
from vplog.pipeline import load_pipeline, run
from vplog.results import run_record, tables
from vplog.run.landmarks import run_drive
from vplog.run.scale_drift import in_one_scale
from vplog.testing import pictures
from vplog.verbs.demo.scene import make_scene, take_picture
from vplog.verbs.demo.settings import DemoSettings
from vplog.verbs.evaluate_run import TruthOptions, evaluate
from vplog.verbs.report import judge

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.odometry.sensor import Points
    from vplog.verbs.demo.record import Demo

SENSOR = Sensor(Camera("camera", np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1.0]]), "none", np.zeros(0), 640, 480,
                       np.eye(4)), metric=False)  # fmt: skip
BLANK = Frame(0, SENSOR.camera, np.zeros((480, 640), np.uint8))
FRAMES = 24


def cloud() -> Floats:
    """(200, 3) m before the camera, 4 to 20 m away."""
    rng = np.random.default_rng(7)
    depth = rng.uniform(4.0, 20.0, 200)
    return np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)) * depth[:, None], depth])


def seen(at: Floats, first_from_camera: Floats, seed: int = 0) -> Points:
    """Points of a frame, with a noise of 0.2 px."""
    inside = se3.transform(se3.inverse(first_from_camera), at)
    px = inside[:, :2] / inside[:, 2:] * 500.0 + [320.0, 240.0]
    px += np.random.default_rng(seed).normal(0.0, 0.2, px.shape)
    return SENSOR.measure(BLANK, px.astype(np.float32))


def test_two_views_give_motion_and_depths_but_for_a_unit() -> None:
    at, moved = cloud(), se3.exp(np.array([0.02, -0.05, 0.01, 0.6, 0.1, 0.8]))
    found = two_views(seen(at, np.eye(4), 1), seen(at, moved, 2), SENSOR.focal_px, 30)
    assert found is not None
    unit = float(np.linalg.norm(found.first_from_second[:3, 3]) / np.linalg.norm(moved[:3, 3]))
    off = se3.between(moved, se3.stretched(found.first_from_second, 1.0 / unit))
    assert np.degrees(se3.angle(off)) < 0.2
    assert np.linalg.norm(off[:3, 3]) < 0.05
    assert np.median(np.abs(found.first[:, 2] / unit / at[found.rows, 2] - 1.0)) < 0.03
    assert np.median(found.first[:, 2]) == pytest.approx(UNIT_DEPTH)


@pytest.mark.parametrize("moved_m", [0.0, 0.03])
def test_no_translation_is_invented_where_the_camera_turns(moved_m: float) -> None:
    at, turned = cloud(), se3.exp(np.array([0.02, 0.1, 0.0, moved_m, 0.0, 0.0]))
    assert two_views(seen(at, np.eye(4), 1), seen(at, turned, 2), SENSOR.focal_px, 30) is None


def test_a_depth_is_as_sure_as_its_parallax() -> None:
    at, views = cloud(), np.stack([se3.exp(np.array([0, 0, 0, x, 0, 0.0])) for x in (-0.5, -0.25)])
    observed = np.stack([seen(at, view, row + 1).rays for row, view in enumerate(views)])
    observed[0, :100] = np.nan  # half of them are in one view only
    observed[:, 7] += 0.1  # another point
    px = 0.2 / 500.0
    rho, variance = rho_of(seen(at, np.eye(4)).rays, observed, se3.inverse(views), px * 2)
    assert np.isnan(rho[7])
    good = np.isfinite(rho)
    assert good.mean() > 0.95
    sigmas = (rho - 1.0 / at[:, 2])[good] / np.sqrt(variance[good])
    assert 0.3 < sigmas.std() < 1.2
    shown = np.asarray(np.isfinite(observed).all(axis=2))
    by_parallax = rho_variance(at, views[:, :3, 3], shown, (2 * px) ** 2)
    np.testing.assert_allclose(variance[good], by_parallax[good], rtol=0.2)


@cache
def street() -> tuple[list[Frame], Floats]:
    scene = make_scene(DemoSettings(laps=0.5, frame_rate_hz=6, width=384, height=216, seed=3))
    images = [take_picture(scene, row)[0] for row in range(FRAMES)]
    frames = [Frame(int(scene.stamp_ns[row]), scene.camera, image) for row, image in enumerate(images)]
    return frames, scene.world_from_body[:FRAMES]


def followed(frames: list[Frame]) -> Odometry:
    found = visual_odometry(frames, frames[0].camera, metric=False)
    assert found is not None
    return found


def test_a_street_is_followed_in_a_unit_of_its_own() -> None:
    frames, truth = street()
    odometry = followed(frames)
    assert not odometry.metric
    assert not len(odometry.breaks)
    rows = np.searchsorted([frame.stamp_ns for frame in frames], odometry.stamp_ns)
    assert len(rows) >= FRAMES - 2
    at, known = odometry.odom_from_body[:, :3, 3], truth[rows, :3, 3]
    known_from_at, scale = se3.umeyama(at, known, with_scale=True)
    path_m = np.linalg.norm(np.diff(known, axis=0), axis=1).sum()
    off = np.linalg.norm(se3.transform(known_from_at, scale * at) - known, axis=1)
    assert np.sqrt((off**2).mean()) < 0.02 * path_m
    turned = se3.between(se3.between(*truth[[rows[0], rows[-1]]]), se3.between(*odometry.odom_from_body[[0, -1]]))
    assert np.degrees(se3.angle(turned)) < 1.5
    again = followed(frames)
    assert again.odom_from_body.tobytes() == odometry.odom_from_body.tobytes()


def test_the_unit_is_that_of_all_that_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not of the first two views, which may look at the ground before the camera."""
    frames, truth = street()
    lengths = []
    for unit in (UNIT_DEPTH, UNIT_DEPTH / 5):
        monkeypatch.setattr(sys.modules[two_views.__module__], "UNIT_DEPTH", unit)
        lengths.append(np.linalg.norm(np.diff(followed(frames).odom_from_body[:, :3, 3], axis=0), axis=1).sum())
    assert lengths[0] == pytest.approx(lengths[1], rel=0.02)
    assert 0.5 < lengths[0] / np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum() < 2.0


def test_a_camera_that_turns_has_no_motion_and_one_that_goes_on_has() -> None:
    """The first picture turned about the camera, by which nothing begins; then the street."""
    frames, _ = street()
    matrix = frames[0].camera.matrix
    assert matrix is not None
    size, period_ns = frames[0].image.shape[::-1], frames[1].stamp_ns - frames[0].stamp_ns
    turned = []
    for step in range(8, 0, -1):
        H = matrix @ se3.so3_exp(np.array([0.0, 0.01 * step, 0.0])) @ np.linalg.inv(matrix)
        image = np.asarray(cv2.warpPerspective(frames[0].image, H, size, borderMode=cv2.BORDER_REFLECT), np.uint8)
        turned.append(replace(frames[0], stamp_ns=frames[0].stamp_ns - step * period_ns, image=image))
    assert visual_odometry(turned, frames[0].camera, metric=False) is None
    odometry = followed([*turned, *frames[:10]])
    first = int(np.searchsorted(odometry.stamp_ns, frames[0].stamp_ns))
    moved = np.linalg.norm(np.diff(odometry.odom_from_body[:, :3, 3], axis=0), axis=1)
    assert moved[: max(first - 1, 0)].sum() < 0.1 * moved[first:].sum()


def test_it_goes_on_as_another_piece() -> None:
    frames, _ = street()
    dark = [replace(frame, image=np.full_like(frame.image, 90)) for frame in frames]
    odometry = followed(frames[:6] + dark[6:14] + frames[14:])
    assert len(odometry.breaks) == 1
    at = int(odometry.breaks[0])
    np.testing.assert_allclose(odometry.odom_from_body[at - 1], odometry.odom_from_body[at])


def fixes_at(stamp_ns: np.ndarray, enu_m: Floats) -> Gps:
    latitude, longitude, altitude = geodesy.geodetic(enu_m, (48.0, 8.0, 100.0)).T
    return Gps(stamp_ns, latitude, longitude, altitude, np.tile(np.eye(3), (len(stamp_ns), 1, 1)))


@pytest.mark.parametrize("claimed_m", [1.0, 0.02])
def test_fixes_give_metres_to_a_scale_that_wanders(claimed_m: float) -> None:
    """A bend of 600 m whose steps come out at a third of a metre at first, and at two thirds in the end."""
    rng, count = np.random.default_rng(5), 601
    heading = np.linspace(0.0, 2.5, count)
    poses = se3.exp(np.column_stack([np.zeros((count, 2)), heading, np.zeros((count, 3))]))
    poses[1:, :3, 3] = np.cumsum(poses[:-1, :3, 0], axis=0)
    own = poses.copy()
    own[1:, :3, 3] = np.cumsum(np.diff(poses[:, :3, 3], axis=0) * np.linspace(1 / 3, 2 / 3, count - 1)[:, None], axis=0)
    stamp_ns = np.arange(count, dtype=np.int64) * 100_000_000
    odometry = Odometry(stamp_ns, own, np.tile(np.eye(6), (count, 1, 1)), breaks=np.zeros(0, np.int64), metric=False)
    rows = np.arange(0, count, 10)
    fixes = fixes_at(stamp_ns[rows], poses[rows, :3, 3] + rng.normal(0.0, 1.0, (len(rows), 3)))
    fixes = replace(fixes, covariance=fixes.covariance * claimed_m**2)
    found = in_metres(odometry, fixes, SENSOR.camera)
    assert found is not None and found.metric and found.covariance is not None
    steps = np.linalg.norm(np.diff(found.odom_from_body[:, :3, 3], axis=0), axis=1)
    assert steps.sum() == pytest.approx(600.0, rel=0.02)
    assert np.abs(steps.reshape(-1, 50).mean(axis=1) - 1.0).max() < 0.15
    assert found.covariance[300, 4, 4] == pytest.approx(2.0**2, rel=0.2)
    still = fixes_at(stamp_ns[rows], np.zeros((len(rows), 3)))
    assert in_metres(odometry, still, SENSOR.camera) is None


def test_places_are_recognised_where_nothing_can_be_tracked(tmp_path: Path) -> None:
    """Twelve places of which each looks otherwise, without a calibration; the last two are the first two again."""
    folder = tmp_path / "images"
    folder.mkdir()
    for row in range(12):
        assert cv2.imwrite(str(folder / f"{1000 + row}.0.png"), pictures.texture(20 * (row % 10)))
    settings = (
        "library.size=8",
        "keyframes.sparseness=1",
        "propose.gap_steps=0",
        "pictures.closures=0",
        "pictures.megapixels=0",
    )
    done = run(folder, tmp_path / "run", load_pipeline("quick", settings))
    assert done.record["scale"] == "unknown"
    assert (tmp_path / "run" / "report.html").exists()
    said = " ".join(done.record["warnings"])
    assert "assumed" in said and "could be tracked" in said
    pairs = zip(done.closures.query.tolist(), done.closures.match.tolist(), strict=True)
    assert {(10, 0), (11, 1)} <= set(pairs)
    assert not done.closures.accepted.any()
    # what is looked at later is that of the run, not that of the log
    assert done.record["calibrations"][0]["matrix"] is None
    done.record["calibrations"][0]["matrix"] = np.diag([7.0, 7.0, 1.0]).tolist()
    with run_drive(tmp_path / "run", done.record, load_pipeline("quick", settings), 0, Execution()) as again:
        assert again.camera.matrix is not None and again.camera.matrix[0, 0] == 7.0


def test_the_ratios_of_closures_give_one_scale() -> None:
    """A unit that shrinks to a half along a lap, seen by closures between its ends of which a fifth is false."""
    rng, count = np.random.default_rng(3), 200
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[1:, 0, 3] = np.cumsum(np.linspace(1.0, 2.0, count - 1))
    stamp_ns = np.arange(count, dtype=np.int64) * 10**9
    odometry = Odometry(stamp_ns, poses, None, breaks=np.zeros(0, np.int64), metric=False)
    query, match = np.arange(180, 200), np.arange(20)
    logs = np.log(np.interp(match, [0, count], [1.0, 2.0]) / np.interp(query, [0, count], [1.0, 2.0]))
    logs = logs + rng.normal(0.0, 0.02, 20)
    logs[::5] = 0.3
    ratios = np.column_stack([query, match, logs, np.full(20, 0.02)]).astype(np.float64)
    found, keyframes = in_one_scale(odometry, Keyframes("drive", stamp_ns, poses), SENSOR.camera, ratios)
    steps = np.linalg.norm(np.diff(found.odom_from_body[:, :3, 3], axis=0), axis=1)
    assert steps[-10:].mean() / steps[:10].mean() == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(keyframes.odom_from_body, found.odom_from_body, atol=1e-9)


def test_each_piece_keeps_its_own_scale_to_its_ends() -> None:
    """Two visits of a lane, the second in a unit half as long; no keyframe near the break."""
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[1:, 0, 3] = np.cumsum(np.where(np.arange(1, 200) < 100, 1.0, 2.0))
    stamp_ns = np.arange(200, dtype=np.int64) * 10**8
    odometry = Odometry(stamp_ns, poses, None, breaks=np.array([100]), metric=False)
    rows = np.concatenate([np.arange(0, 95, 5), np.arange(110, 200, 5)])
    match, query = np.arange(18), np.arange(19, 37)
    ratios = np.column_stack([query, match, np.full(18, -np.log(2.0)), np.full(18, 0.02)]).astype(np.float64)
    keyframes = Keyframes("drive", stamp_ns[rows], poses[rows])
    found, _ = in_one_scale(odometry, keyframes, SENSOR.camera, ratios)
    steps = np.delete(np.linalg.norm(np.diff(found.odom_from_body[:, :3, 3], axis=0), axis=1), 99)
    assert steps.max() / steps.min() < 1.1


def test_a_run_without_metres_is_evaluated_with_a_scale(finished: Path, drive: Demo, tmp_path: Path) -> None:
    """The finished run, said to have a unit of its own."""
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    record = run_record.read_finished_run(folder)
    assert record["scale"] == "metric"
    run_record.write_run_json(folder / "run.json", record | {"scale": "unknown"})
    found, known = (evaluate(one, str(drive.truth)) for one in (folder, finished))
    assert (found["ate_after"]["alignment"], known["ate_after"]["alignment"]) == ("Sim(3)", "SE(3)")
    assert found["scale"] == pytest.approx(1.0, abs=0.05)
    assert found["ate_after"]["scale"] == pytest.approx(1.0, abs=0.01)  # the unit is that of the camera's path
    assert known["scale"] is None
    assert found["closures"]["accepted_true"] == known["closures"]["accepted_true"]
    assert evaluate(folder, str(drive.truth), options=TruthOptions(align="se3"))["ate_after"]["alignment"] == "SE(3)"
    lines = [line.split() for line in drive.truth.read_text().splitlines() if not line.startswith("#")]
    standing = tmp_path / "standing.tum"
    standing.write_text("".join(f"{line[0]} 1 2 3 {' '.join(line[4:])}\n" for line in lines))
    with pytest.raises(TruthError, match="move"):
        evaluate(folder, str(standing))


def test_a_camera_off_the_body_keeps_its_place_there_in_metres(finished: Path, drive: Demo, tmp_path: Path) -> None:
    """The finished run as one of a camera 1.5 m ahead of the body, in a unit of ten metres: its path alone is in it."""
    folder, header = Path(shutil.copytree(finished, tmp_path / "run")), tables.TableMetadata({}, "")
    record = run_record.read_finished_run(folder)
    mount = np.array(record["calibrations"][0]["body_from_camera"])
    mount[:3, 3] = 1.5, 0.0, 1.0
    record["calibrations"][0]["body_from_camera"] = mount.tolist()
    run_record.write_run_json(folder / "run.json", record | {"scale": "unknown"})

    def own(poses: Floats) -> Floats:
        return se3.stretched(poses, 0.1, mount)

    after, odometry = tables.read_trajectory(folder / "trajectory.parquet")
    after = replace(after, world_from_body=own(after.world_from_body))
    odometry = replace(odometry, odom_from_body=own(odometry.odom_from_body))
    tables.write_trajectory(folder / "trajectory.parquet", after, odometry, header)
    keyframes, poses = tables.read_keyframes(folder / "keyframes.parquet")
    keyframes = replace(keyframes, odom_from_body=own(keyframes.odom_from_body))
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, own(poses), header)
    ledger = tables.read_closures(folder / "closures.parquet")
    ledger = replace(ledger, match_from_query=own(ledger.match_from_query))
    tables.write_closures(folder / "closures.parquet", ledger, keyframes, header)
    found, known = (evaluate(one, str(drive.truth), options=TruthOptions(align="sim3")) for one in (folder, finished))
    # the unit is found by the odometry, which is 2 % off: that moves the lever arm of 1.5 m
    assert found["ate_after"]["rmse_m"] == pytest.approx(known["ate_after"]["rmse_m"], rel=0.02)
    assert found["closures"]["accepted_true"] == known["closures"]["accepted_true"]
    shown = judge(folder, record | {"scale": "unknown"}, str(drive.truth), None, TruthOptions())
    assert shown.error_m is not None and np.nanmedian(shown.error_m) < 3.0 * known["ate_after"]["rmse_m"]


def test_fixes_without_an_altitude_give_metres() -> None:
    """As NMEA's RMC: their up is anywhere."""
    turn = np.linspace(0.0, np.pi, 200)
    metres = 60.0 * np.stack([np.sin(turn), 1.0 - np.cos(turn), 0.0 * turn], 1)
    stamp_ns = 100_000_000 * np.arange(200)
    odometry = Odometry(stamp_ns, se3.pose(np.eye(3), 0.2 * metres), None, metric=False)
    degrees = geodesy.geodetic(metres, (48.0, 11.0, 0.0))
    noise = np.tile(np.diag([9.0, 9.0, 1e10]), (200, 1, 1))
    found = in_metres(odometry, Gps(stamp_ns, degrees[:, 0], degrees[:, 1], 0.0 * turn, noise), SENSOR.camera)
    assert found is not None
    way = np.linalg.norm(np.diff(found.odom_from_body[:, :3, 3], axis=0), axis=1).sum()
    assert abs(way / (60.0 * np.pi) - 1.0) < 0.05
