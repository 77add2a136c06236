"""Data sets as other versions of their tools, and people's own recordings in their layouts, have them."""

from __future__ import annotations

import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.logs.test_datasets import (
    COUNT,
    HEIGHT,
    STAMPS,
    WIDTH,
    K,
    check_frames,
    check_truth,
    colmap,
    euroc,
    images,
    kitti,
    numbers,
    poses,
    quaternions,
    seconds,
    sensor_yaml,
    text,
    vslam_lab,
    write_images,
)
from vplog import logs
from vplog.errors import LogError
from vplog.logs import TopicChoice

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize(("unit", "unit_ns"), [("s", 10**9), ("ms", 10**6), ("us", 10**3)])
def test_tables_of_vslam_lab_name_the_unit_of_their_stamps(unit: str, unit_ns: int, tmp_path: Path) -> None:
    """Seconds, `rgb0` and `Camera0` as in earlier versions."""
    vslam_lab(tmp_path)
    stamps = STAMPS // 10**6 * 10**6
    times = [f"{stamp // unit_ns}.{stamp % unit_ns:09d}" if unit == "s" else str(stamp // unit_ns) for stamp in stamps]
    rows = [f"{time},rgb_0/{row}.png,{time},depth_0/{row}.png" for row, time in enumerate(times)]
    text(tmp_path / "rgb.csv", f"ts_rgb0 ({unit}),path_rgb0,ts_depth0 ({unit}),path_depth0", *rows)
    camera = zip(("fx", "fy", "cx", "cy"), K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)
    section = [f"Camera0.{name}: {value}" for name, value in camera]
    text(tmp_path / "calibration.yaml", "%YAML:1.0", "Camera0.model: PINHOLE", *section, "Depth0.factor: 2500.0")
    each = zip(times, poses(), quaternions(poses()), strict=True)
    rows = [",".join([time, *numbers(np.array([*pose[:3, 3], *turn])).split()]) for time, pose, turn in each]
    text(tmp_path / "groundtruth.csv", f"ts ({unit}),tx (m),ty (m),tz (m),qx,qy,qz,qw", *rows)
    text(tmp_path / "imu_0.csv", f"ts ({unit}),wx,wy,wz,ax,ay,az", *(f"{time},0,0,0,0,0,9.8" for time in times))
    log = logs.open(tmp_path)
    check_frames(log, stamps, images())
    check_truth(log, stamps, poses())
    assert log.camera().matrix is not None
    np.testing.assert_allclose(np.asarray(log.camera().matrix), K)
    frame = next(iter(log.frames(stamps[:1]))).decode()
    assert frame.depth is not None
    assert frame.depth[1, 1] == pytest.approx(1.0)
    info = log.info()
    assert (info.start_ns, info.end_ns) == (stamps[0], stamps[-1])
    assert {topic.name: topic.count for topic in info.topics}["imu_0"] == COUNT


@pytest.mark.parametrize("before", [(), ("# Made by a tool, bias of 0.1 (ms).",)])
def test_tables_of_euroc_name_the_unit_of_their_stamps(before: tuple[str, ...], tmp_path: Path) -> None:
    euroc(tmp_path)
    for table in (tmp_path / "mav0").glob("*/data.csv"):
        lines = [re.sub(r"^(\d+)(\d{9})(?=,)", r"\1.\2", line) for line in table.read_text().splitlines()]
        text(table, *before, "#timestamp [s],values", *lines[1:])
    log = logs.open(tmp_path)
    np.testing.assert_array_equal(log.stamps(), STAMPS)
    check_truth(log, STAMPS, poses())
    assert (log.info().start_ns, log.info().end_ns) == (STAMPS[0], STAMPS[-1])


def recording(root: Path) -> None:
    """Colour and depth of an own camera in the layout of TUM RGB-D, 1000 counts a metre."""
    depth = np.full((COUNT, HEIGHT, WIDTH), 2500, np.uint16)
    for kind, pictures in (("rgb", images()), ("depth", depth)):
        write_images(root / kind, [f"{row}.png" for row in range(COUNT)], pictures)
        text(root / f"{kind}.txt", *(f"{seconds(int(s))} {kind}/{i}.png" for i, s in enumerate(STAMPS)))


ORB = ("%YAML:1.0", "Camera.fx: 70.0", "Camera.fy: 71.0", "Camera.cx: 31.0", "Camera.cy: 23.0")


@pytest.mark.parametrize("factor", [1000.0, 0.0, None])
@pytest.mark.parametrize("beside", [False, True])
def test_a_calibration_has_the_unit_of_a_recordings_depth(beside: bool, factor: float | None, tmp_path: Path) -> None:
    """Given by --calibration, or as calibration.yaml in the folder; 5000 counts a metre, with a line, where it does not
    name them."""
    recording(tmp_path / "desk")
    file = tmp_path / ("desk/calibration.yaml" if beside else "orb.yaml")
    text(file, *ORB, *([] if factor is None else [f"RGBD.DepthMapFactor: {factor}"]))
    log = logs.open(tmp_path / "desk", TopicChoice(calibration_file=None if beside else file))
    assert log.info().kind == ("vslam-lab" if beside else "tum-rgbd")
    depth = next(iter(log.frames(log.stamps()[:1]))).decode().depth
    assert depth is not None
    np.testing.assert_allclose(depth, 2.5 if factor else 0.5, rtol=1e-6)
    assert ("5000 are taken" in " ".join(log.warnings)) == (not factor)


def test_the_chosen_calibration_has_the_unit_of_vslam_labs_depth(tmp_path: Path) -> None:
    vslam_lab(tmp_path / "drive")
    text(tmp_path / "orb.yaml", *ORB, "DepthMapFactor: 5000")
    log = logs.open(tmp_path / "drive", TopicChoice(calibration_file=tmp_path / "orb.yaml"))
    depth = next(iter(log.frames(log.stamps()[:1]))).decode().depth
    assert depth is not None
    assert depth[1, 1] == pytest.approx(0.5)


def vslam_lab_without_mounts(root: Path) -> None:
    vslam_lab(root)
    file = root / "calibration.yaml"
    text(file, re.sub(r",\s*T_BS: \[.*\]", "", file.read_text()))


def vslam_lab_of_orb_slam(root: Path) -> None:
    recording(root)
    text(root / "calibration.yaml", *ORB)


@pytest.mark.parametrize("write", [recording, colmap, vslam_lab_without_mounts, vslam_lab_of_orb_slam])
def test_where_nothing_places_the_camera_it_is_the_body(write: Callable[[Path], None], tmp_path: Path) -> None:
    """Whose poses are the truth, also where visual odometry is used."""
    write(tmp_path / "drive")
    text(tmp_path / "orb.yaml", *ORB)
    chosen = tmp_path / "orb.yaml" if write is recording else None
    log = logs.open(tmp_path / "drive", TopicChoice(calibration_file=chosen))
    assert log.odometry() is None
    np.testing.assert_allclose(log.camera().body_from_camera, np.eye(4), atol=1e-12)


def pictures(root: Path) -> None:
    write_images(root, [f"{row}.png" for row in range(COUNT)], images())


@pytest.mark.parametrize(("write", "name"), [(colmap, "database.db"), (pictures, "digikam4.db")])
def test_a_database_beside_pictures_is_no_log(write: Callable[[Path], None], name: str, tmp_path: Path) -> None:
    write(tmp_path)
    with closing(sqlite3.connect(tmp_path / name)) as database, database:
        database.execute("CREATE TABLE images (name TEXT)")
    logs.check(tmp_path)
    assert len(logs.open(tmp_path).stamps()) == COUNT
    for place in [file for file in tmp_path.iterdir() if file.name != name]:
        shutil.rmtree(place) if place.is_dir() else place.unlink()
    with pytest.raises(LogError, match="an SQLite file"):
        logs.open(tmp_path)


def test_a_drive_is_the_same_from_within_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kitti(tmp_path / "kitti")
    monkeypatch.chdir(tmp_path / "kitti" / "sequences")
    assert logs.open(Path("07")).truth() is not None
    Path("link").symlink_to("07", target_is_directory=True)
    assert logs.open(Path("link")).truth() is not None
    monkeypatch.chdir("07")
    assert logs.open(Path()).truth() is not None
    write_images(tmp_path / "pictures", [f"{row}.png" for row in range(COUNT)], images())
    (tmp_path / "pictures" / "notes").mkdir()
    monkeypatch.chdir(tmp_path / "pictures" / "notes")
    log = logs.open(Path(".."))
    assert (log.name, log.camera().name) == ("pictures", "pictures")


@pytest.mark.parametrize("below", [".", "day"])
def test_pictures_of_a_kind_that_is_not_read_are_counted(below: str, tmp_path: Path) -> None:
    pictures(tmp_path / below)
    for name in ("IMG_1.HEIC", "IMG_2.HEIC", "a.avif"):
        (tmp_path / below / name).write_bytes(b"\0\0\0\x18ftypheic")
    log = logs.open(tmp_path)
    assert len(log.stamps()) == COUNT
    assert "3 pictures of kinds that are not read left out (AVIF, HEIC)" in " ".join(log.warnings)
    with pytest.raises(LogError, match=r"1 picture of kinds that are not read left out .HEIC.*Convert"):
        logs.open(tmp_path / below / "IMG_1.HEIC")
    for file in (tmp_path / below).glob("*.png"):
        file.unlink()
    with pytest.raises(LogError, match=r"no images\. 3 pictures of kinds" if below == "." else "nothing"):
        logs.open(tmp_path)


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(0.0, 0.06), (2.0, 0.06), (60.0, 0.06), (0.0, 3.0)])
def test_a_camera_with_the_view_of_another_is_no_further_one(turn_deg: float, shift_m: float, tmp_path: Path) -> None:
    """As KITTI's grey and colour cameras, beside one that looks elsewhere or from elsewhere."""
    euroc(tmp_path)
    placed = np.eye(4)
    placed[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    placed[0, 3] = shift_m
    for camera in ("cam2", "cam3"):  # the same place both
        shutil.copytree(tmp_path / "mav0" / "cam0", tmp_path / "mav0" / camera)
        text(tmp_path / "mav0" / camera / "sensor.yaml", sensor_yaml(placed))
    expected = ["cam2"] if turn_deg > 50 or shift_m > 1 else []
    assert logs.open(tmp_path, TopicChoice(odometry="truth")).further_cameras() == expected


def test_an_imu_that_nothing_places_is_not_taken_to_be_the_camera(tmp_path: Path) -> None:
    vslam_lab_without_mounts(tmp_path)
    text(tmp_path / "imu_0.csv", "ts (ns),wx,wy,wz,ax,ay,az", *(f"{stamp},0,0,0.1,0,0,9.8" for stamp in STAMPS))
    log = logs.open(tmp_path)
    assert log.imu() is None
    assert "imu_0: the static transforms do not place it" in " ".join(log.warnings)


def test_the_largest_of_several_colmap_models_is_used(tmp_path: Path) -> None:
    """The mapper begins another model where it can add no image to the first."""
    colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "sparse" / "1")
    table = tmp_path / "sparse" / "1" / "images.txt"
    text(table, *table.read_text().splitlines()[: 1 + 2 * (COUNT - 2)])
    for model, count in (("0", COUNT), ("1", COUNT - 2)):
        log = logs.open(tmp_path)
        assert len(log.stamps()) == count
        remark = f"sparse/{model}, the largest of 2 models, does not have {COUNT - count} of the {COUNT} images"
        assert (remark in " ".join(log.warnings)) == (count < COUNT)
        table = tmp_path / "sparse" / "0" / "images.txt"
        text(table, *table.read_text().splitlines()[:3])  # one image


@pytest.mark.parametrize("folders", [("100MEDIA", "101MEDIA"), ("left", "right")])
def test_folders_of_a_colmap_models_images_are_cameras_where_they_run_side_by_side(
    folders: tuple[str, str], tmp_path: Path
) -> None:
    names = [f"{folders[row // 3]}/{row % (3 if folders[0] == 'left' else COUNT)}.png" for row in range(COUNT)]
    colmap(tmp_path)
    table = tmp_path / "sparse" / "0" / "images.txt"
    text(table, re.sub(r"frame (\d)\.png", lambda found: names[int(found[1])], table.read_text()))
    for folder in folders:
        (tmp_path / "images" / folder).mkdir()
    for row, name in enumerate(names):
        (tmp_path / "images" / f"frame {row}.png").rename(tmp_path / "images" / name)
    log = logs.open(tmp_path)
    if folders[0] == "left":
        assert len(log.stamps()) == 3
        assert "several cameras by the folders of their images: left (3), right (3)" in " ".join(log.warnings)
    else:
        check_frames(log, np.arange(COUNT) * 100_000_000, images())
        check_truth(log, log.stamps(), poses())


@pytest.mark.parametrize(
    ("write", "file", "known", "other"),
    [
        (colmap, "sparse/0/cameras.txt", "PINHOLE", "FOV"),
        (euroc, "mav0/cam*/sensor.yaml", "pinhole", "omni"),
        (vslam_lab, "calibration.yaml", "radtan5", "eucm"),
    ],
    ids=["colmap", "euroc", "vslam-lab"],
)
def test_a_data_sets_camera_of_another_kind_is_uncalibrated(
    write: Callable[[Path], None], file: str, known: str, other: str, tmp_path: Path
) -> None:
    write(tmp_path / "drive")
    for one in (tmp_path / "drive").glob(file):
        one.write_text(one.read_text().replace(known, other))
    text(tmp_path / "orb.yaml", *ORB)
    for chosen in (None, tmp_path / "orb.yaml"):
        log = logs.open(tmp_path / "drive", TopicChoice(calibration_file=chosen))
        assert (log.camera().matrix is None) == (chosen is None)
        assert len(log.stamps()) == COUNT
        assert "The calibration of the data set is not used" in " ".join(log.warnings)


@pytest.mark.parametrize("own", [True, False])
def test_a_file_of_the_left_camera_leaves_a_pair_its_right_one(own: bool, tmp_path: Path) -> None:
    euroc(tmp_path / "drive")
    placed = np.eye(4)
    placed[:3, 3] = 0.0, 0.02, 0.03
    text(tmp_path / "left.yaml", sensor_yaml(placed).replace("70.0, 71.0", "69.0, 70.0"))
    if not own:
        (tmp_path / "drive" / "mav0" / "cam1" / "sensor.yaml").unlink()
    log = logs.open(
        tmp_path / "drive", TopicChoice(image="cam0", right="cam1", calibration_file=tmp_path / "left.yaml")
    )
    assert log.camera().baseline_m == (pytest.approx(0.1) if own else None)
    assert ("cam1 has no calibration, and that of --calibration is of one camera" in " ".join(log.warnings)) != own
