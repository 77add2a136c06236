"""Data sets in their publishers' layouts: told by content, read with calibration, depth, pairs, stamps and truth."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.logs.drives import matrices
from vplog import logs
from vplog.data import Gps, Trajectory
from vplog.errors import LogError
from vplog.logs import TopicChoice
from vplog.logs.calibration_file import read_calibrations
from vplog.logs.datasets.video import VideoFrames
from vplog.stages import Log

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

COUNT, WIDTH, HEIGHT = 6, 64, 48
START_NS = 1_403_715_273_262_142_976
STAMPS = START_NS + 50_000_000 * np.arange(COUNT)
K = np.array([[70.0, 0.0, 31.0], [0.0, 71.0, 23.0], [0.0, 0.0, 1.0]])
LENS = (-0.2, 0.05, 0.001, -0.002)


def images(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (COUNT, HEIGHT, WIDTH), np.uint8)


def poses(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turned = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.05, (COUNT, 3)), axis=0))
    return matrices(np.cumsum(rng.random((COUNT, 3)), axis=0), turned)


def write_images(folder: Path, names: list[str], pictures: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in zip(names, pictures, strict=True):
        assert cv2.imwrite(str(folder / name), picture)


def text(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def quaternions(values: np.ndarray) -> np.ndarray:
    """x y z w."""
    return Rotation.from_matrix(values[:, :3, :3]).as_quat()


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.12g}" for value in np.ravel(values))


def seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9 // 1000:06d}"


def check_frames(log: Log, stamp_ns: np.ndarray, pictures: np.ndarray) -> None:
    np.testing.assert_array_equal(log.stamps(), stamp_ns)
    for frame, picture in zip(log.frames(log.stamps()), pictures, strict=True):
        np.testing.assert_array_equal(frame.decode().image, picture)


def check_truth(log: Log, stamp_ns: np.ndarray, expected: np.ndarray) -> None:
    truth = log.truth()
    assert isinstance(truth, Trajectory)
    np.testing.assert_array_equal(truth.stamp_ns, stamp_ns)
    np.testing.assert_allclose(truth.world_from_body, expected, atol=1e-6)


def kitti(root: Path, baseline_m: float = 0.5) -> np.ndarray:
    """Writes one sequence; its stamps."""
    sequence, names = root / "sequences" / "07", [f"{row:06d}.png" for row in range(COUNT)]
    stamps = np.arange(COUNT) * 103_612_000
    text(sequence / "times.txt", *(f"{stamp / 1e9:e}" for stamp in stamps))
    rows = [np.column_stack([K, K @ [-shift, 0.0, 0.0]]) for shift in (0.0, baseline_m)]
    text(sequence / "calib.txt", *(f"P{i}: {numbers(row)}" for i, row in enumerate(rows)))
    for side in (0, 1):
        write_images(sequence / f"image_{side}", names, images(side))
    text(root / "poses" / "07.txt", *(numbers(pose[:3]) for pose in poses()))
    return stamps


def test_kitti_is_a_pair_with_its_truth_and_keeps_the_stamp_0(tmp_path: Path) -> None:
    stamps = kitti(tmp_path)
    for path in (tmp_path, tmp_path / "sequences" / "07"):
        log = logs.open(path)
        assert isinstance(log, Log)
        assert log.info().kind == "kitti"
        np.testing.assert_array_equal(log.stamps(), stamps)
        check_truth(log, stamps, poses())
    camera = log.camera()
    assert camera.matrix is not None
    np.testing.assert_allclose(camera.matrix, K)
    assert camera.baseline_m == pytest.approx(0.5)
    frames = [frame.decode() for frame in log.frames(log.stamps())]
    np.testing.assert_array_equal([frame.image for frame in frames], images(0))
    np.testing.assert_array_equal([frame.right for frame in frames], images(1))
    assert log.odometry() is None
    assert "--odometry truth" in log.without_odometry()


def test_rows_of_kitti_belong_to_the_numbers_of_images(tmp_path: Path) -> None:
    stamps = kitti(tmp_path)
    for row in (0, 3):
        (tmp_path / "sequences" / "07" / "image_0" / f"{row:06d}.png").unlink()
    check_frames(logs.open(tmp_path, TopicChoice(right="")), stamps[[1, 2, 4, 5]], images(0)[[1, 2, 4, 5]])


def test_a_copy_among_the_images_of_kitti_is_left_out(tmp_path: Path) -> None:
    stamps = kitti(tmp_path)
    write_images(tmp_path / "sequences" / "07" / "image_0", ["000001 (1).png"], images(0)[5:])
    check_frames(logs.open(tmp_path, TopicChoice(right="")), stamps, images(0))


def test_images_of_kitti_that_are_none_are_counted(tmp_path: Path) -> None:
    kitti(tmp_path)
    for row in (1, 4):
        (tmp_path / "sequences" / "07" / "image_0" / f"{row:06d}.png").write_bytes(b"")
    log = logs.open(tmp_path, TopicChoice(right=""))
    assert len(log.stamps()) == COUNT - 2
    assert [(loss.reason, loss.messages) for loss in log.account.losses] == [("empty_image", 2)]  # type: ignore[attr-defined]


def test_rows_of_kittis_truth_without_a_pose_are_left_out_and_a_wrong_count_is_said(tmp_path: Path) -> None:
    stamps, file = kitti(tmp_path), tmp_path / "poses" / "07.txt"
    lines = file.read_text().splitlines()
    text(file, "nan " + lines[0].split(" ", 1)[1], *lines[1:])
    check_truth(logs.open(tmp_path), stamps[1:], poses()[1:])
    assert not logs.open(tmp_path).info().warnings
    text(file, *lines[:-1])
    log = logs.open(tmp_path)
    check_truth(log, stamps[:-1], poses()[:-1])
    assert any(f"07.txt has {COUNT - 1} poses, times.txt {COUNT} rows" in line for line in log.info().warnings)
    text(file, *(" ".join(["0"] * 12) for _ in lines))
    with pytest.raises(LogError, match="holds no pose"):
        logs.open(tmp_path)


def test_of_several_sequences_one_is_to_be_given(tmp_path: Path) -> None:
    kitti(tmp_path)
    (tmp_path / "sequences" / "07").rename(tmp_path / "sequences" / "06")
    kitti(tmp_path)
    with pytest.raises(LogError, match=r"2 drives .*: sequences/06, sequences/07"):
        logs.open(tmp_path)


def sensor_yaml(placed: np.ndarray) -> str:
    return "\n".join(
        [
            "%YAML:1.0", "sensor_type: camera", "T_BS:", "  cols: 4", "  rows: 4", f"  data: {placed.ravel().tolist()}",
            f"resolution: [{WIDTH}, {HEIGHT}]", "camera_model: pinhole", "intrinsics: [70.0, 71.0, 31.0, 23.0]",
            "distortion_model: radial-tangential", f"distortion_coefficients: {list(LENS)}",
        ]
    )  # fmt: skip


def euroc(root: Path) -> None:
    for side in (0, 1):
        folder = root / "mav0" / f"cam{side}"
        placed = np.eye(4)
        placed[:3, 3] = 0.1 * side, 0.02, 0.03
        text(folder / "sensor.yaml", sensor_yaml(placed))
        text(folder / "data.csv", "#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in STAMPS))
        write_images(folder / "data", [f"{stamp}.png" for stamp in STAMPS], images(side))
    rows = [f"{stamp},0.1,0.2,0.3,0,0,9.8" for stamp in STAMPS]
    text(root / "mav0" / "imu0" / "data.csv", "#timestamp [ns],w,w,w,a,a,a", *rows, f"{STAMPS[-1] + 1},0.1")  # cut
    each = zip(STAMPS, poses(), quaternions(poses())[:, [3, 0, 1, 2]], strict=True)
    lines = [f"{stamp},{','.join(f'{v:.9f}' for v in (*pose[:3, 3], *q))},0,0,0,0" for stamp, pose, q in each]
    text(root / "mav0" / "state_groundtruth_estimate0" / "data.csv", "#timestamp, p, q, v", *lines)


@pytest.mark.parametrize("below", ["", "mav0"])
def test_euroc_has_a_pair_an_imu_and_poses_of_the_body(below: str, tmp_path: Path) -> None:
    euroc(tmp_path)
    log = logs.open(tmp_path / below, TopicChoice(odometry="truth"))
    np.testing.assert_array_equal(log.stamps(), STAMPS)
    assert log.camera().baseline_m == pytest.approx(0.1)
    np.testing.assert_allclose(log.camera().body_from_camera[:3, 3], [0.0, 0.02, 0.03], atol=1e-9)
    check_truth(log, STAMPS, poses())
    assert {topic.name: topic.count for topic in log.info().topics}["imu0"] == COUNT  # without the line that was cut
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, poses(), atol=1e-6)
    assert "tells nothing about real odometry" in " ".join(log.warnings)


def tum_lines(stamps: np.ndarray, values: np.ndarray) -> list[str]:
    each = zip(stamps.tolist(), values, quaternions(values), strict=True)
    return [f"{seconds(stamp)} {numbers(pose[:3, 3])} {numbers(q)}" for stamp, pose, q in each]


def test_tum_rgbd_has_depth_in_5000_of_a_metre(tmp_path: Path) -> None:
    root, stamps = tmp_path / "rgbd_dataset_freiburg2_desk", STAMPS // 10**6 * 10**6
    depth = np.random.default_rng(3).integers(1, 60_000, (COUNT, HEIGHT, WIDTH)).astype(np.uint16)
    depth[:, 0, 0] = 0
    for kind, late_ns, pictures in (("rgb", 0, images()), ("depth", 7_000_000, depth)):
        names = [f"{seconds(int(stamp) + late_ns)}.png" for stamp in stamps]
        write_images(root / kind, names, pictures)
        text(root / f"{kind}.txt", "# timestamp filename", *(f"{name[:-4]} {kind}/{name}" for name in names))
    text(root / "groundtruth.txt", "# ground truth trajectory", *tum_lines(stamps, poses()))
    log = logs.open(root)
    assert log.info().kind == "tum-rgbd"
    check_truth(log, stamps, poses())
    found = [frame.decode() for frame in log.frames(log.stamps())]
    for frame, expected in zip(found, depth, strict=True):
        assert frame.depth is not None
        assert np.isnan(frame.depth[0, 0])
        np.testing.assert_allclose(frame.depth.ravel()[1:], expected.ravel()[1:] / 5000.0, rtol=1e-6)
    assert log.camera().matrix is not None  # of freiburg2, by the name


def test_a_list_of_images_leads_nowhere_else(tmp_path: Path) -> None:
    text(tmp_path / "rgb.txt", "1305031102.175304 ../../etc/passwd")
    with pytest.raises(LogError, match="outside"):
        logs.open(tmp_path)
    text(tmp_path / "rgb.txt", "1305031102.175304 rgb/1.png", "1305031102.275304 rgb/2.png")
    write_images(tmp_path / "rgb", ["1.PNG", "2.PNG"], images()[:2])
    with pytest.raises(LogError, match=r"names rgb/1\.png and others, none of which is in"):
        logs.open(tmp_path)


def vslam_lab(root: Path) -> None:
    depth = np.full((COUNT, HEIGHT, WIDTH), 2500, np.uint16)
    depth[:, 0, 0] = 0
    for kind, pictures in (("rgb_0", images()), ("depth_0", depth)):
        write_images(root / kind, [f"{row}.png" for row in range(COUNT)], pictures)
    rows = [f"{stamp},rgb_0/{row}.png,{stamp},depth_0/{row}.png" for row, stamp in enumerate(STAMPS)]
    text(root / "rgb.csv", "ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0", *rows)
    camera = (
        "  - {cam_name: rgb_0,\n     cam_type: rgb+depth,\n     depth_name: depth_0,\n     cam_model: pinhole,\n"
        "     distortion_type: radtan5,\n     focal_length: [70.0, 71.0],\n     principal_point: [31.0, 23.0],\n"
        f"     depth_factor: 1000.0,\n     distortion_coefficients: {[*LENS, 0.0]},\n"
        f"     image_dimension: [{WIDTH}, {HEIGHT}],\n     fps: 20.0,\n     T_BS: {np.eye(4).ravel().tolist()}\n    }}"
    )
    text(root / "calibration.yaml", "%YAML 1.2", "---", "cameras:", camera)
    lines = [",".join(line.split()) for line in tum_lines(STAMPS, poses())]
    lines = [f"{stamp},{line.split(',', 1)[1]}" for stamp, line in zip(STAMPS, lines, strict=True)]
    text(root / "groundtruth.csv", "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw", *lines)


def test_vslam_lab_has_its_streams_in_columns(tmp_path: Path) -> None:
    vslam_lab(tmp_path)
    log = logs.open(tmp_path)
    assert log.info().kind == "vslam-lab"
    check_frames(log, STAMPS, images())
    check_truth(log, STAMPS, poses())
    camera = log.camera()
    np.testing.assert_allclose(camera.distortion, [*LENS, 0.0])
    frame = next(iter(log.frames(STAMPS[:1]))).decode()
    assert frame.depth is not None
    assert frame.depth[1, 1] == pytest.approx(2.5)


def colmap_rows() -> list[tuple[np.ndarray, np.ndarray]]:
    """Quaternion w x y z and translation of camera_from_world."""
    found = np.linalg.inv(poses())
    return list(zip(quaternions(found)[:, [3, 0, 1, 2]], found[:, :3, 3], strict=True))


def colmap_text(model: Path) -> None:
    text(model / "cameras.txt", "# cameras", f"1 PINHOLE {WIDTH} {HEIGHT} 70 71 31.5 23.5")
    lines = []
    for row, (turn, shift) in enumerate(colmap_rows()):
        lines += [f"{row + 1} {numbers(turn)} {numbers(shift)} 1 frame {row}.png", "10.5 11.5 -1 3.0 4.0 17"]
    text(model / "images.txt", "# images", *lines)


def colmap_binary(model: Path) -> None:
    model.mkdir(parents=True)
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 70, 71, 31.5, 23.5)
    (model / "cameras.bin").write_bytes(cameras)
    data = struct.pack("<Q", COUNT)
    for row, (turn, shift) in enumerate(colmap_rows()):
        data += struct.pack("<i7di", row + 1, *turn, *shift, 1) + f"frame {row}.png".encode() + b"\0"
        data += struct.pack("<Qddq", 1, 10.5, 11.5, 17)
    (model / "images.bin").write_bytes(data)


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
@pytest.mark.parametrize("where", ["sparse/0", "."])
def test_a_colmap_model_is_calibration_and_truth(write: Callable[[Path], None], where: str, tmp_path: Path) -> None:
    root = tmp_path / "reconstruction"
    write(root / where)
    write_images(root / "images", [f"frame {row}.png" for row in range(COUNT)], images())
    for path in {root, root / where}:
        log = logs.open(path)
        assert log.info().kind == "colmap"
        assert log.assumed_times
        check_frames(log, np.arange(COUNT) * 100_000_000, images())
        check_truth(log, log.stamps(), poses())
        assert log.camera().matrix is not None
        np.testing.assert_allclose(np.asarray(log.camera().matrix), K)  # half a px for the centre of the first
        assert "sim3" in " ".join(log.warnings)


@pytest.mark.parametrize("cut", [3, 30, 200, 400])
def test_a_cut_model_is_one_line(cut: int, tmp_path: Path) -> None:
    colmap_binary(tmp_path / "model")
    write_images(tmp_path / "model" / "images", [f"frame {row}.png" for row in range(COUNT)], images())
    file = tmp_path / "model" / "images.bin"
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(LogError, match=r"images\.bin"):
        logs.open(tmp_path / "model")


def test_images_named_by_their_place_have_positions_as_truth(tmp_path: Path) -> None:
    places = np.array([[500_000.0 + 3 * row, 4_180_000.0 + 4 * row, 0.0] for row in range(COUNT)])
    names = [
        f"@{e:.2f}@{n:.2f}@10@S@{37.75 + 1e-5 * row:.6f}@{-122.5 + 1e-5 * row:.6f}@p{COUNT - row}@@90@@@@@@.jpg"
        for row, (e, n, _) in enumerate(places)
    ]
    write_images(tmp_path, names, images())
    log = logs.open(tmp_path)
    assert log.info().kind == "utm-images"
    truth, gps = log.truth(), log.gps()
    assert isinstance(truth, Trajectory)
    assert isinstance(gps, Gps)
    np.testing.assert_allclose(truth.world_from_body[:, :3, 3], places[::-1], atol=0.01)  # by panorama
    np.testing.assert_allclose(gps.latitude_deg[::-1], 37.75 + 1e-5 * np.arange(COUNT), atol=1e-6)
    assert log.warnings == [], "pictures without times are no fault"


@pytest.mark.parametrize("last", ["@", "n", "r", "T"])
def test_the_kind_does_not_depend_on_the_order_of_the_folder(
    last: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copying a folder may change the order in which a file system lists it."""
    names = [f"@{500_000 + 3 * row}.00@4180000.00@10@S@@@p{row}@@90@@@@@@.jpg" for row in range(COUNT)]
    write_images(tmp_path, names, images())
    for other in ("readme.txt", "notes.md", "Thumbs.db"):
        (tmp_path / other).write_text("none")
    listed = Path.iterdir

    def in_order(folder: Path) -> Iterator[Path]:
        return iter(sorted(listed(folder), key=lambda file: file.name.startswith(last)))

    monkeypatch.setattr(Path, "iterdir", in_order)
    assert logs.open(tmp_path).info().kind == "utm-images"


def write_video(path: Path, pictures: np.ndarray, codec: str, turn_deg: int = 0) -> list[Fraction]:
    """Lossless frames at uneven times; these."""
    av = pytest.importorskip("av")
    times = [Fraction(row * 4 + row % 2, 100) for row in range(len(pictures))]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height = pictures.shape[2], pictures.shape[1]
        stream.pix_fmt = "gray" if codec in ("ffv1", "rawvideo") else "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 100)
        for time, picture in zip(times, pictures, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, "gray").reformat(format=stream.pix_fmt)
            frame.pts, frame.time_base = int(time * 100), Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return times


def test_a_long_video_costs_no_more_for_each_frame(tmp_path: Path) -> None:
    """Stamps are worked out once, not once for each frame of as many frames."""
    write_video(tmp_path / "a.mp4", np.zeros((9, 32, 48), np.uint8), "mpeg4")
    frames = VideoFrames(tmp_path / "a.mp4")
    assert frames.stamp_ns is frames.stamp_ns


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "mpeg4"), ("a.mov", "mpeg4"), ("a.mkv", "ffv1"), ("b", "mpeg4"), ("a.avi", "mpeg4")]
)
def test_a_video_has_its_own_time_stamps(name: str, codec: str, tmp_path: Path) -> None:
    shade = np.linspace(20, 200, 12)[:, None, None] * np.ones((12, 32, 48))
    times = write_video(tmp_path / (name if "." in name else f"{name}.mkv"), shade.astype(np.uint8), codec)
    path = next(tmp_path.iterdir()).rename(tmp_path / name)
    log = logs.open(path)
    assert log.info().kind == "video"
    np.testing.assert_array_equal(log.stamps(), [int(time * 10**9) for time in times])
    means = [frame.decode().image.mean() for frame in log.frames(log.stamps())]
    assert np.all(np.diff(means) > 5)
    wanted = log.stamps()[[1, 7, 9]]
    some = [frame.decode().image.mean() for frame in log.frames(wanted)]
    np.testing.assert_array_equal(some, np.array(means)[[1, 7, 9]])
    again = next(iter(log.frames(wanted[:1]))).decode().image.mean()  # back in time
    assert again == some[0]


@pytest.mark.parametrize(("name", "codec"), [("a.mkv", "ffv1"), ("a.avi", "ffv1"), ("b.avi", "rawvideo")])
def test_grey_video_keeps_its_black_and_white(name: str, codec: str, tmp_path: Path) -> None:
    picture = np.tile(np.linspace(0, 255, 64), (32, 1)).astype(np.uint8)
    write_video(tmp_path / name, np.stack([picture] * 3), codec)
    log = logs.open(tmp_path / name)
    for frame in log.frames(log.stamps()):
        assert np.abs(frame.decode().image.astype(int) - picture).mean() < 1


def test_a_video_has_its_colours(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        red = av.VideoFrame.from_ndarray(np.full((32, 48, 3), (220, 30, 30), np.uint8), "rgb24")
        for _ in range(3):
            container.mux(stream.encode(red))
        container.mux(stream.encode())
    log = logs.open(tmp_path / "a.mp4")
    frame = next(iter(log.frames(log.stamps()[:1]))).decode(colour=True)
    assert frame.colour is not None
    assert np.abs(frame.colour.astype(int) - (220, 30, 30)).max() < 20


@pytest.mark.parametrize(("matrix", "turns"), [((0, 1, -1, 0), -1), ((-1, 0, 0, -1), 2), ((0, -1, 1, 0), 1)])
def test_a_video_is_turned_as_its_flag_says(matrix: tuple[int, ...], turns: int, tmp_path: Path) -> None:
    """`tkhd` holds a, b, u, c, d, v, x, y, w: a b c d turn the picture clockwise as it is shown."""
    picture = np.zeros((32, 48), np.uint8)
    picture[:8, :8] = 200
    write_video(tmp_path / "a.mp4", np.stack([picture] * 3), "mpeg4")
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    at = data.index(b"tkhd") + 44
    a, b, c, d = (value << 16 for value in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    (tmp_path / "a.mp4").write_bytes(data)
    log = logs.open(tmp_path / "a.mp4")
    found = next(iter(log.frames(log.stamps()[:1]))).decode().image
    assert np.abs(found.astype(int) - np.rot90(picture, turns)).max() < 40


def test_start_and_stop_leave_images_out(tmp_path: Path) -> None:
    stamps = kitti(tmp_path)
    log = logs.open(tmp_path, TopicChoice(start_s=0.1, stop_s=0.4))
    np.testing.assert_array_equal(log.stamps(), stamps[1:4])
    right = [frame.decode().right for frame in log.frames(log.stamps())]
    np.testing.assert_array_equal(np.array(right), images(1)[1:4])
    with pytest.raises(LogError, match="No image is left by --start and --stop: the last one is at 0"):
        logs.open(tmp_path, TopicChoice(start_s=9)).stamps()


def test_an_image_offset_moves_the_stamps_and_nothing_else(tmp_path: Path) -> None:
    stamps = kitti(tmp_path)
    given, moved = (logs.open(tmp_path, TopicChoice(image_offset_s=offset)) for offset in (None, -0.05))
    np.testing.assert_array_equal(moved.stamps(), stamps - 50_000_000)
    for name in ("image", "right"):
        before, after = ([getattr(one.decode(), name) for one in log.frames(log.stamps())] for log in (given, moved))
        np.testing.assert_array_equal(np.array(before), np.array(after))
    assert moved.file_names() == given.file_names()


def test_clips_are_to_be_joined_to_one_drive(tmp_path: Path) -> None:
    clips = [tmp_path / "a.mp4", tmp_path / "b.mp4"]
    for clip in clips:
        clip.write_bytes(b"\0\0\0\x18ftypisom")
    with pytest.raises(LogError, match=r"a\.mp4 is a video.*ffmpeg -f concat"):
        logs.open_drive(clips)


def test_what_is_cut_from_a_video_is_one_line(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", np.zeros((4, 32, 48), np.uint8), "mpeg4")
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").write_bytes(data[:100])
    with pytest.raises(LogError, match=r"a\.mp4"):
        logs.open(tmp_path / "a.mp4")


@pytest.mark.parametrize(
    ("name", "content", "lens"),
    [
        ("sensor.yaml", sensor_yaml(np.eye(4)), LENS),
        ("opencv.yml", "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
         f"   cols: 3\n   dt: d\n   data: {K.ravel().tolist()}\ndistortion_coefficients: !!opencv-matrix\n   rows: 4\n"
         f"   cols: 1\n   dt: d\n   data: {list(LENS)}\n", LENS),
        ("orb.yaml", "%YAML:1.0\nCamera.type: PinHole\nCamera1.fx: 70.0\nCamera1.fy: 71.0\nCamera1.cx: 31.0\n"
         "Camera1.cy: 23.0\nCamera1.k1: -0.2\nCamera1.k2: 0.05\nCamera1.p1: 0.001\nCamera1.p2: -0.002\n", (*LENS, 0)),
        ("calib.txt", f"P0: {numbers(np.column_stack([K, np.zeros(3)]))}\n", ()),
        ("cameras.txt", "# c\n7 OPENCV 64 48 70 71 31.5 23.5 -0.2 0.05 0.001 -0.002\n", LENS),
        ("cameras.txt", "7 SIMPLE_RADIAL 64 48 70 31.5 23.5 -0.2\n", (-0.2, 0, 0, 0)),
    ],
    ids=["euroc", "opencv", "orb-slam", "kitti", "colmap", "colmap-radial"],
)  # fmt: skip
def test_every_kind_of_calibration_is_told_by_its_content(name: str, content: str, lens: tuple, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    found = read_calibrations(tmp_path / name)[0].calibration
    expected = K if "SIMPLE" not in content else np.array([[70.0, 0, 31], [0, 70, 23], [0, 0, 1]])
    np.testing.assert_allclose(found.matrix, expected)
    np.testing.assert_allclose(found.distortion, lens)


@pytest.mark.parametrize("content", ["7 FOV 64 48 70 71 31.5 23.5 0.9\n", "7 PINHOLE 64 48 70 71\n", "P0: 1 2 3\n"])
def test_what_is_no_calibration_is_one_line(content: str, tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(content)
    with pytest.raises(LogError, match=r"calib\.txt: .*A calibration is YAML"):
        read_calibrations(tmp_path / "calib.txt")


@pytest.mark.parametrize("name", ["kitti", "euroc", "tum_rgbd", "phone.mp4"])
def test_excerpts_as_they_are_published(name: str, shared_data: Path) -> None:
    path = shared_data / "folders" / name
    if not path.exists():
        pytest.skip(f"no {path}: set VPLOG_DATA to the folder with the real data")
    log = logs.open(path)
    frames = [frame.decode() for frame in log.frames(log.stamps())]
    assert len(frames) == len(log.stamps()) > 5
    assert (log.camera().matrix is None) == (name == "phone.mp4")
    assert all(frame.depth is not None for frame in frames) == (name == "tum_rgbd")
    assert log.info().kind == {"tum_rgbd": "tum-rgbd", "phone.mp4": "video"}.get(name, name)


def tum(root: Path) -> None:
    write_images(root / "rgb", [f"{row}.png" for row in range(COUNT)], images())
    text(root / "rgb.txt", "# of freiburg1", *(f"{seconds(int(s))} rgb/{i}.png" for i, s in enumerate(STAMPS)))
    text(root / "groundtruth.txt", *tum_lines(STAMPS, poses()))


def colmap(root: Path) -> None:
    colmap_text(root / "sparse" / "0")
    write_images(root / "images", [f"frame {row}.png" for row in range(COUNT)], images())


def colmap_in_bytes(root: Path) -> None:
    colmap_binary(root / "sparse" / "0")
    write_images(root / "images", [f"frame {row}.png" for row in range(COUNT)], images())


@pytest.mark.parametrize("write", [kitti, euroc, tum, vslam_lab, colmap, colmap_in_bytes])
def test_damage_of_any_file_is_a_known_error_or_none(write: Callable[[Path], object], tmp_path: Path) -> None:
    write(tmp_path)
    rng = np.random.default_rng(8)
    files = sorted(file for file in tmp_path.rglob("*") if file.is_file() and file.suffix != ".png")
    for file in files:
        whole = file.read_bytes()
        for change in range(12):
            data = bytearray(whole)
            at = int(rng.integers(len(data)))
            if change % 3 == 0:
                data = data[:at]
            else:
                count = int(rng.integers(1, 9))
                data[at : at + count] = rng.choice(list(b"\x00\xff-.,9eN \n:[{*&"), count).astype(np.uint8).tobytes()
            file.write_bytes(data)
            try:
                log = logs.open(tmp_path, TopicChoice(odometry="truth"))
                _ = log.info(), log.truth(), log.odometry(), log.gps()
                for frame in log.frames(log.stamps()[:1]):
                    frame.decode()
            except LogError as error:
                assert "\n" not in str(error)
        file.write_bytes(whole)
