"""Pictures of a small drive are put where they were taken: in its run, in a map of it, by the verb and from Python."""

from __future__ import annotations

import shutil
from collections import Counter
from typing import TYPE_CHECKING, Any

import cv2
import duckdb
import numpy as np
import pytest

import vplog
from vplog import api
from vplog.data import Keyframes
from vplog.errors import LogError, ResultError, SettingsError, TruthError
from vplog.geometry import se3
from vplog.geometry.geodesy import geodetic
from vplog.geometry.tum import read_tum
from vplog.maps.joining.joint_record import joint_components, read_joint, write_joint
from vplog.maps.localization import places
from vplog.maps.storage import layout, map_store
from vplog.results import run_record, tables
from vplog.results.landmark_table import LandmarkTable

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import Said
    from vplog.data import Camera, Floats
    from vplog.verbs.demo.record import Demo

Verb = Any


def frames(drive: Demo) -> tuple[list[tuple[int, np.ndarray]], Camera]:
    log = vplog.open_log(drive.log)
    stamps = log.stamps()[1::6]
    return [(one.stamp_ns, one.decode().image) for one in log.frames(stamps)], log.camera()


@pytest.fixture(scope="session")
def pictures(drive: Demo, made_once: Callable[..., Path]) -> Path:
    """Every sixth picture of the drive as a file, and its calibration beside the folder."""

    def fill(folder: Path) -> None:
        (folder / "pictures").mkdir()
        found, camera = frames(drive)
        for stamp_ns, image in found:
            assert cv2.imwrite(str(folder / "pictures" / f"{1_600_000_000 * 10**9 + stamp_ns}.png"), image)
        assert camera.matrix is not None
        values = ", ".join(str(value) for value in camera.matrix.ravel().tolist())
        (folder / "camera.yaml").write_text(
            f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: front\n"
            f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{values}]\ndistortion_model: plumb_bob\n"
            "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
        )

    return made_once("pictures", fill)


@pytest.fixture(scope="session")
def run(finished: Path, made_once: Callable[..., Path]) -> Path:
    """A copy of the finished run, which landmarks are written into."""
    return made_once("localized", lambda folder: shutil.copytree(finished, folder / "run")) / "run"


def camera_at(run: Path, stamp_ns: int, camera: Camera) -> Floats:
    """world_from_camera at a stamp, by the run's trajectory."""
    found, _ = tables.read_trajectory(run / "trajectory.parquet")
    return se3.interpolate_at(found.stamp_ns, found.world_from_body, np.array([stamp_ns]))[0] @ camera.body_from_camera


def test_pictures_are_where_they_were_taken(drive: Demo, run: Path) -> None:
    opened, (found, camera) = vplog.open_run(run), frames(drive)
    for stamp_ns, image in found:
        one = opened.localize(image, camera)
        assert one.localized, one.sentence
        assert one.sentence.startswith("Localised by ")
        assert one.found.world_from_camera is not None
        assert one.found.covariance is not None
        assert np.linalg.eigvalsh(one.found.covariance)[0] > 0
        error = se3.between(camera_at(run, stamp_ns, camera), one.found.world_from_camera)
        assert np.linalg.norm(error[:3, 3]) < 0.15
        assert np.degrees(se3.angle(error[None]))[0] < 1.0
    assert (run / "landmarks.parquet").is_file()
    assert opened.localize(np.zeros_like(found[0][1]), camera).found.place < 0


def test_the_place_on_earth_is_that_of_the_run(drive: Demo, run: Path, tmp_path: Path) -> None:
    """By the georeference of its solve, as a run with GPS factors has it."""
    world_from_enu = se3.exp(np.array([0.0, 0.0, 0.3, 10.0, -4.0, 2.0]))
    shutil.copytree(run, tmp_path / "run")
    record = run_record.read_run_json(tmp_path / "run" / "run.json")
    origin = {"latitude_deg": 48.0, "longitude_deg": 11.0, "altitude_m": 500.0}
    about = {"origin": origin, "world_from_enu": world_from_enu.tolist()}
    run_record.write_run_json(tmp_path / "run" / "run.json", {**record, "gps": about})
    (_, image), camera = frames(drive)[0][0], frames(drive)[1]
    one = vplog.open_run(tmp_path / "run").localize(image, camera)
    assert one.found.world_from_camera is not None
    enu = se3.inverse(world_from_enu) @ one.found.world_from_camera
    latitude, longitude, altitude = geodetic(enu[None, :3, 3], (48.0, 11.0, 500.0))[0]
    values = one.record()
    assert (values["latitude"], values["longitude"]) == pytest.approx((latitude, longitude), abs=1e-9)
    assert values["altitude_m"] == pytest.approx(altitude, abs=1e-6)


def test_the_verb_gives_a_record_and_a_table(
    verb: Callable[..., Said], run: Path, pictures: Path, tmp_path: Path
) -> None:
    calibration, out = pictures / "camera.yaml", tmp_path / "poses.parquet"
    files = sorted((pictures / "pictures").iterdir())
    record = verb("localize", run, *files, "--calibration", calibration, "-o", out, "--json").json
    assert record["pictures"] == record["localized"] == len(files)
    assert [one["picture"] for one in record["answers"]] == [file.name for file in files]
    rows = duckdb.read_parquet(str(out)).select("picture", "tx", "covariance").fetchall()
    assert [(row[0], row[1]) for row in rows] == [(one["picture"], one["tx"]) for one in record["answers"]]
    assert {len(row[2]) for row in rows} == {36}
    folder = verb("localize", run, pictures / "pictures", "--calibration", calibration, "--json").json
    assert folder["answers"] == record["answers"]
    for number, given in enumerate((files, [pictures / "pictures"])):  # the cameras of pictures, however they are given
        verb("localize", run, *given, "--calibration", calibration, "-o", tmp_path / f"{number}.tum")
    assert (tmp_path / "0.tum").read_text() == (tmp_path / "1.tum").read_text()
    shown = verb("localize", run, files[0], "--calibration", calibration)
    assert (shown.code, "1 of 1 picture localised in" in shown.out) == (0, True)
    one = vplog.open_run(run).localize(files[0], calibration).record()
    assert one["tx"] == record["answers"][0]["tx"]


def test_without_calibration_it_says_what_is_missing(verb: Callable[..., Said], run: Path, pictures: Path) -> None:
    record = verb("localize", run, pictures / "pictures", "--json").json
    assert record["localized"] == 0
    assert "--calibration" in record["answers"][0]["sentence"]
    out = run.parent / "none.tum"
    assert "None of" in verb("localize", run, pictures / "pictures", "-o", out).error
    assert not out.exists()


def test_pictures_of_several_sizes_are_answered_one_by_one(
    verb: Callable[..., Said], run: Path, pictures: Path, tmp_path: Path
) -> None:
    """The calibration is that of the whole pictures, so cropped ones have no pose, and each says why."""
    files = sorted((pictures / "pictures").iterdir())
    for number, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(tmp_path / file.name), image[:, :-40] if number % 2 else image)
    for calibration in ((), ("--calibration", pictures / "camera.yaml")):
        record = verb("localize", run, tmp_path, *calibration, "--json").json
        assert [one["picture"] for one in record["answers"]] == [file.name for file in files]
        assert [one["localized"] for one in record["answers"][::2]] == [bool(calibration)] * len(files[::2])
        assert all("calibration" in one["sentence"] for one in record["answers"][1::2])


def test_a_log_is_joined_by_its_odometry(drive: Demo, run: Path, tmp_path: Path) -> None:
    """Its odometry begins elsewhere, and half of its frames are dark: all samples still are where they were."""
    log = vplog.open_log(drive.log)
    odometry, out = log.odometry(), tmp_path / "log.tum"
    assert odometry is not None
    record = api.localize(run, drive.log, out=out)
    assert record["joined_by_odometry"]
    stamps, poses = read_tum(out, TruthError, "-o")
    assert np.array_equal(stamps, odometry.stamp_ns)
    known, _ = tables.read_trajectory(run / "trajectory.parquet")
    assert np.linalg.norm(poses[:, :3, 3] - known.world_from_body[:, :3, 3], axis=1).max() < 0.3


def test_a_map_localises_in_the_frame_of_its_joined_drives(halves: Path, pictures: Path, tmp_path: Path) -> None:
    """Two halves of the drive, joined or not: a picture of either has a pose in a frame that the answer names."""
    root = halves
    record = api.localize(root, pictures / "pictures", topics={"calibration_file": pictures / "camera.yaml"})
    assert record["localized"] == record["pictures"]
    assert {one["drive"] for one in record["answers"]} == {"before", "after"}
    components = {name for one in record["answers"] if (name := one["frame"])}
    assert components <= {"before", "after"}
    apart = tmp_path / "apart"
    shutil.copytree(root, apart)
    shutil.rmtree(apart / "joint", ignore_errors=True)
    (apart / "joint.json").unlink(missing_ok=True)
    out, calibration = tmp_path / "poses.tum", {"calibration_file": pictures / "camera.yaml"}
    alone = api.localize(apart, pictures / "pictures", topics=calibration, out=out)
    (most, count), (_, others) = Counter(one["frame"] for one in alone["answers"]).most_common(2)
    assert len(read_tum(out, TruthError, "-o")[0]) == count
    assert any(f"in the frame of {most}, and lacks {others} picture" in text for text in alone["warnings"])
    less, replaced = tmp_path / "less", tmp_path / "replaced"
    for copy in (less, replaced):
        shutil.copytree(root, copy)
    with map_store.writing(less) as store:
        map_store.remove(store, ["before"])  # whose frame it was
        assert joint_components(store)["after"].drives == ["after"]
    left = api.localize(less, pictures / "pictures", topics=calibration)
    assert {one["drive"] for one in left["answers"] if one["localized"]} == {"after"}
    joint = read_joint(replaced)
    write_joint(replaced, {**joint, "keys": {**joint["keys"], "after": "of another state"}})
    with map_store.reading(replaced) as store:
        assert "after" not in joint_components(store), "its joint poses are of other keyframes"
    image = next((pictures / "pictures").iterdir())
    assert vplog.open_map(root).localize(image, pictures / "camera.yaml").localized
    assert vplog.open_map(root).info(check=True)["damaged_files"] == []
    shutil.copytree(root, tmp_path / "moved")
    for name, damaged in (("keyframes", "before"), ("descriptors", "after")):  # the other is searched all the same
        shutil.copytree(root, tmp_path / name)
        path = tmp_path / name / "runs" / f"drive={damaged}" / f"{name}.parquet"
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 4
        path.write_bytes(data)
        part = api.localize(
            tmp_path / name, pictures / "pictures", topics={"calibration_file": pictures / "camera.yaml"}
        )
        assert [text.partition(":")[0] for text in part["warnings"]] == [f"{damaged} is damaged and left out"]
        assert {one["drive"] for one in part["answers"] if one["localized"]} == {"before", "after"} - {damaged}
    for log in root.parent.glob("*.mcap"):
        log.rename(tmp_path / log.name)
    try:  # landmarks stand for the logs
        again = api.localize(tmp_path / "moved", image, topics={"calibration_file": pictures / "camera.yaml"})
    finally:
        for log in tmp_path.glob("*.mcap"):
            log.rename(root.parent / log.name)
    assert again["localized"] == 1


def test_a_drive_without_landmarks_and_log_is_left_out(
    halves: Path, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And so are places that were imported. The other drives answer, of which few are open at once."""
    calibration, image = pictures / "camera.yaml", min((pictures / "pictures").iterdir())
    opened, closed = list[str](), list[int]()

    class Counted(LandmarkTable):
        def __init__(self, path: Path, made_from: str) -> None:
            super().__init__(path, made_from)
            opened.append(path.parent.name)

        def close(self) -> None:
            super().close()
            closed.append(1)

    monkeypatch.setattr(places, "_LOADED", 1)
    monkeypatch.setattr(places, "LandmarkTable", Counted)
    whole = vplog.open_map(halves)
    found = whole.localize(image, calibration)
    assert (found.localized, found.drive) == (True, "before")
    assert whole.localize(max((pictures / "pictures").iterdir()), calibration).drive == "after"
    assert set(opened) == {"drive=before", "drive=after"}
    assert len(opened) - len(closed) == 1
    for name, about in (("gone", {}), ("imported", {layout.PLACES_ONLY: "file"})):
        root = shutil.copytree(halves, tmp_path / name)
        for stored in ("joins", ".cache"):
            shutil.rmtree(root / stored / "drive=before", ignore_errors=True)
        record = root / "runs" / "drive=before" / "drive.json"
        run_record.write_run_json(record, run_record.read_run_json(record) | about | {"log": "/none.mcap"})
        part = api.localize(root, image, topics={"calibration_file": calibration})
        assert {one["drive"] for one in part["answers"]} <= {"after", None}
        warned = [text.partition(". ")[0] for text in part["warnings"]]
        assert warned == ["before is left out"] * (name == "gone")


def test_a_log_of_one_keyframe_is_localised_without_a_trajectory(
    drive: Demo, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a robot that stands still."""
    stamps = vplog.open_log(drive.log).stamps()[1:2]
    standing = stamps, Keyframes("drive", stamps, np.eye(4)[None]), list[str]()
    monkeypatch.setattr("vplog.maps.localization.verb.select_views", lambda *_: standing)
    record = api.localize(run, drive.log)
    assert (record["localized"], record["joined_by_odometry"]) == (1, False)
    assert any("Not joined by odometry" in text for text in record["warnings"])


def test_wrong_inputs_are_refused_in_a_line(verb: Callable[..., Said], drive: Demo, run: Path, tmp_path: Path) -> None:
    assert "poses are a table or a trajectory" in verb("localize", run, drive.log, "-o", tmp_path / "poses.txt").error
    assert "no local file of an image" in verb("localize", run, drive.log, drive.log).error
    assert "No log at" in verb("localize", run, tmp_path / "none.png").error
    assert "run.json" in verb("localize", tmp_path, drive.log).error
    image, camera = np.zeros((8, 8), np.uint8), vplog.open_log(drive.log).camera()
    opened = vplog.open_run(run)
    with pytest.raises(LogError, match="8x8"):
        opened.localize(image, camera)
    with pytest.raises(SettingsError, match="in memory"):
        opened.localize(image, "camera.yaml")
    with pytest.raises(LogError, match="uint8"):
        opened.localize(np.zeros((8, 8), np.float32), camera)  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ResultError):
        vplog.open_run(tmp_path)
