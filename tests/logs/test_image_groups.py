"""A folder of images of several cameras is refused in one line, or read as the one that is chosen."""

from __future__ import annotations

from pathlib import PosixPath
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from vplog import logs
from vplog.errors import LogError
from vplog.logs.image_folder import by_folder, select_camera, stamps_of
from vplog.logs.topic_selection import TopicChoice

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

RNG = np.random.default_rng(5)


def picture(bits: int = 8, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    return RNG.integers(0, 2**bits, size).astype(np.uint16 if bits == 16 else np.uint8)


def write(folder: Path, names: Iterator[str] | list[str], **options: Any) -> None:
    folder.mkdir(exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), picture(**options))


MIXED: dict[str, tuple[list[tuple[str, dict[str, Any]]], set[str]]] = {
    "left and right": ([("left_{:03}.png", {}), ("right_{:03}.png", {})], {"left_*.png", "right_*.png"}),
    "numbers first": ([("{:06}_l.jpg", {}), ("{:06}_r.jpg", {})], {"*_l.jpg", "*_r.jpg"}),
    "cameras by number": ([("cam0_{:04}.png", {}), ("cam1_{:04}.png", {})], {"cam0_*.png", "cam1_*.png"}),
    "an infrared pair": ([("infra1_{:04}.png", {}), ("infra2_{:04}.png", {})], {"infra1_*.png", "infra2_*.png"}),
    "numbers of cameras last": ([("{:04}-Camera_1.png", {}), ("{:04}-Camera_2.png", {})], {"*-Camera_1.png"}),
    "ScanNet": (
        [("frame-{:06}.color.jpg", {}), ("frame-{:06}.depth.png", {"bits": 16})],
        {"frame-*.color.jpg", "frame-*.depth.png"},
    ),
    "same number, two formats": ([("{:04}.jpg", {}), ("{:04}.png", {"bits": 16})], {"*.jpg", "*.png"}),
    "by bits": ([("1{:09}.png", {}), ("1{:09}5.png", {"bits": 16})], {"8 bits", "16 bits"}),
    "stamps of their own": (
        [("rgb_10000{:05}.100000.png", {}), ("depth_10000{:05}.130000.png", {"bits": 16})],
        {"rgb_*.*.png", "depth_*.*.png"},
    ),
}


@pytest.mark.parametrize("kind", MIXED)
def test_several_cameras_are_named_and_one_may_be_chosen(kind: str, tmp_path: Path) -> None:
    parts, names = MIXED[kind]
    folder = tmp_path / "drive"
    for pattern, options in parts:
        write(folder, [pattern.format(i) for i in range(10)], **options)
    with pytest.raises(LogError, match="holds images of several cameras") as found:
        logs.open(folder)
    assert "\n" not in str(found.value)
    for name in names:
        assert f"{name} (10)" in str(found.value)
        log = logs.open(folder, TopicChoice(image=name))
        assert len(log.stamps()) == 10
        assert len({frame.decode().image.shape for frame in log.frames(log.stamps())}) == 1


ONE = {
    "numbers": [f"{i}.png" for i in range(12)],
    "stamps": [f"{1_600_000_000 + i}.{i:06}.png" for i in range(12)],
    "parts": [f"part{part}_{i:03}.png" for part in range(3) for i in range(4)],
    "frames called by a camera": [f"cam{i}.png" for i in range(30)],
    "one fisheye of several": [f"fisheye2_{i:03}.png" for i in range(12)],
    "one camera of several": [f"cam1_{i:03}.png" for i in range(12)],
    "one after the other": [*(f"a_{i:03}.png" for i in range(6)), *(f"b_{i:03}.png" for i in range(6, 12))],
    "two formats in turn": [f"{i:03}.{'png' if i % 2 else 'jpg'}" for i in range(12)],
    "random": ["".join(RNG.choice(list("0123456789abcdef"), 12)) + ".png" for _ in range(30)],
}


@pytest.mark.parametrize("kind", ONE)
def test_one_camera_is_one(kind: str, tmp_path: Path) -> None:
    write(tmp_path / "drive", ONE[kind])
    assert len(logs.open(tmp_path / "drive").stamps()) == len(ONE[kind])


def test_images_of_a_set_keep_their_sizes(tmp_path: Path) -> None:
    """Any number of sizes, in grey and in colour, with a mask and without; each frame has a camera of its size."""
    sizes = [(48, 64), (24, 32), (40, 40), (64, 48)]
    for number in range(12):
        write(tmp_path / "set", [f"{number:03}.png"], size=sizes[number % 4])
    (tmp_path / "mask.png").write_bytes(cv2.imencode(".png", np.full((24, 32), 255, np.uint8))[1].tobytes())
    for choice in (None, TopicChoice(image="*")):
        log = logs.open(tmp_path / "set", choice)
        for number, frame in enumerate(log.frames(log.stamps())):
            found = frame.decode(colour=True)
            read = cv2.imread(str(tmp_path / "set" / f"{number:03}.png"), cv2.IMREAD_GRAYSCALE)
            np.testing.assert_array_equal(found.image, read)
            assert (found.camera.height, found.camera.width) == found.image.shape == sizes[number % 4]
            assert found.colour is not None
            assert found.colour.shape == (*sizes[number % 4], 3)
        assert not log.warnings
    masked = logs.open(tmp_path / "set", TopicChoice(masks={"": tmp_path / "mask.png"}))
    frame = next(iter(masked.frames(masked.stamps()))).decode()
    assert frame.mask is not None
    assert frame.mask.shape == frame.image.shape


def test_a_calibration_needs_one_size(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path / "set", [f"{number}.png"], size=(24, 32) if number == 2 else (48, 64))
    yaml = tmp_path / "camera.yaml"
    yaml.write_text(
        "image_width: 64\nimage_height: 48\ncamera_name: c\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [50, 0, 32, 0, 50, 24, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    log = logs.open(tmp_path / "set", TopicChoice(calibration_file=yaml))
    assert log.camera().matrix is not None
    assert {frame.decode().image.shape for frame in log.frames(log.stamps())} == {(48, 64)}
    assert any("resampled" in line for line in log.warnings)


def test_images_of_another_size_in_a_drive_are_resampled_or_left_out(tmp_path: Path) -> None:
    write(tmp_path, [f"{i:03}.png" for i in range(40)])
    write(tmp_path, ["007.png"], size=(24, 32))
    write(tmp_path, ["009.png"], size=(24, 24))
    log: Any = logs.open_drive([tmp_path])
    decoded = []
    for frame in log.frames(log.stamps()):
        try:
            decoded.append(frame.decode().image.shape)
        except LogError as error:
            assert "24 x 24 px among those of 64 x 48 px" in str(error)
    assert decoded == 39 * [(48, 64)]
    assert any("resampled" in line for line in log.warnings)
    assert [loss.messages for loss in log.account.losses] == [1]


def test_folders_of_several_cameras_are_named(tmp_path: Path) -> None:
    for name in ("front", "rear"):
        write(tmp_path / name, [f"{i}.png" for i in range(4)])
    with pytest.raises(LogError, match=r"several cameras: front \(4\), rear \(4\)\. Choose one") as found:
        logs.open(tmp_path)
    assert "\n" not in str(found.value)
    assert logs.open(tmp_path, TopicChoice(image="front")).file_names() == [f"front/{i}.png" for i in range(4)]
    assert len(logs.open(tmp_path, TopicChoice(image="*")).stamps()) == 8


def test_folders_left_and_right_are_a_stereo_pair(tmp_path: Path) -> None:
    """Images with the same name were taken together; the left one of `2.png` is missing."""
    write(tmp_path / "left", [f"{i}.png" for i in (1, 3, 10)])
    write(tmp_path / "right", [f"{i}.png" for i in (1, 2, 3, 10)])
    settings = {"Camera1.fx": 60.0, "Camera1.fy": 60.0, "Camera1.cx": 32.0, "Camera1.cy": 24.0, "Stereo.b": 0.1}
    calibration = tmp_path / "pair.yaml"
    calibration.write_text("".join(f"{name}: {value}\n" for name, value in settings.items()))
    log = logs.open(tmp_path, TopicChoice(calibration_file=calibration))
    np.testing.assert_array_equal(log.stamps() // 10**8, [0, 2, 3])
    assert log.camera().baseline_m == pytest.approx(0.1)
    assert len([*log.frames(log.stamps())]) == 3
    (tmp_path / "right" / "1.png").rename(tmp_path / "right" / "x.png")
    for name in ("2", "3", "10"):
        (tmp_path / "right" / f"{name}.png").unlink()
    with pytest.raises(LogError, match="Name both images of a pair alike"):
        logs.open(tmp_path)


def test_folders_of_places_are_one_set(tmp_path: Path) -> None:
    """A few views of many places, with the same names in each folder; what is no image is passed over."""
    for place in ("10", "9", "b/1"):
        (tmp_path / place).mkdir(parents=True)
        write(tmp_path / place, ["1.png", "2.png"])
    (tmp_path / "9" / "notes.txt").write_text("none")
    log = logs.open(tmp_path)
    assert log.file_names() == ["9/1.png", "9/2.png", "10/1.png", "10/2.png", "b/1/1.png", "b/1/2.png"]
    assert not log.warnings
    frames = [frame.decode().image for frame in log.frames(log.stamps()[[3, 4]])]
    np.testing.assert_array_equal(frames[0], cv2.imread(str(tmp_path / "10" / "2.png"), cv2.IMREAD_GRAYSCALE))


@pytest.mark.parametrize("name", ["info", "run", "library", "compare"])
def test_every_verb_refuses_in_one_line(name: str, verb: Callable[..., Said], tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    write(folder, [f"{side}_{i}.png" for side in ("left", "right") for i in range(5)])
    given = [folder, *([] if name == "info" else ["-o", tmp_path / "out"])]
    if name == "compare":
        write(tmp_path / "map", [f"{i}.png" for i in range(5)])
        given = [folder, tmp_path / "map", "--truth", "index", "--methods", "bovf"]
    error = verb(name, *given).error
    assert "left_*.png (5), right_*.png (5). Choose one with --image-topic 'left_*.png'" in error
    if name == "info":
        assert verb("info", folder, "--image-topic", "left_*.png", "--json").json["messages"] == 5


@pytest.mark.parametrize("name", ["frame_{}.png", "cam0_{}.png", "{}_left.png", "rgb-{}.color.png"])
def test_times_in_names_are_read_beside_words(name: str, tmp_path: Path) -> None:
    stamps = 1_403_715_273_262_142_976 + 50_000_000 * np.arange(5)
    write(tmp_path / "ns", [name.format(stamp) for stamp in stamps])
    np.testing.assert_array_equal(logs.open(tmp_path / "ns").stamps(), stamps)
    write(tmp_path / "s", [name.format(f"{stamp // 10**9}.{stamp % 10**9 // 1000:06}") for stamp in stamps])
    np.testing.assert_array_equal(logs.open(tmp_path / "s").stamps(), stamps // 1000 * 1000)
    write(tmp_path / "counted", [name.format(f"{10 * number:06}") for number in range(5)])
    np.testing.assert_array_equal(logs.open(tmp_path / "counted").stamps(), 100_000_000 * np.arange(5))


DOTS = {
    "behind a camera": ("cam0.{}", range(1, 25), False),
    "behind a camera, padded": ("cam0.{:03}", range(1, 25), False),
    "behind a shot": ("shot1.{:04}", range(1, 25), False),
    "in two shots": ("{}", [f"{shot}.{number}" for shot in (1, 2) for number in range(1, 13)], False),
    "since a start": ("frame_{:.6f}", np.arange(24) / 30, False),
    "of a drive since a start": ("frame_{:.6f}", np.arange(60) / 30, True),
    "of a second since 1970": ("{:.6f}", 1_403_715_273 + np.arange(6) / 30, True),
}


@pytest.mark.parametrize("kind", DOTS)
def test_numbers_behind_a_dot_are_counters_or_times(kind: str) -> None:
    pattern, values, timed = DOTS[kind]
    found = stamps_of([pattern.format(value) for value in values])
    assert (found is not None) == timed
    if found is not None:
        np.testing.assert_allclose(np.diff(found), 1e9 / 30, atol=1001)


def test_decimal_seconds_may_be_far_apart_or_near() -> None:
    for step in (5.5, 0.002):
        found = stamps_of([f"{12 + step * row:.3f}" for row in range(600)])
        assert found is not None
        np.testing.assert_allclose(np.diff(found), step * 1e9, atol=1)


class CountedPath(PosixPath):
    """A path that counts how often its name is looked at."""

    looks = 0

    @property
    def name(self) -> str:
        CountedPath.looks += 1
        return super().name


@pytest.mark.parametrize("side", [3, 30])
def test_the_work_is_in_proportion_to_the_images(side: int, tmp_path: Path) -> None:
    """15,000 images of 5,000 places took seven minutes when the names of each two places were compared."""
    looks = []
    for places in (30, 300):
        folder = tmp_path / str(places)
        folder.mkdir()
        names = [
            f"place{chr(65 + place // 26)}{chr(65 + place % 26)}_{view}.png"
            for place in range(places)
            for view in range(side)
        ]
        files = [CountedPath(folder / name) for name in names]
        for file in files:
            file.write_bytes(b"")
        CountedPath.looks = 0
        assert select_camera(folder, [*files], "placeAA_*.png") == (files if side < places else files[:side])
        looks.append(CountedPath.looks / len(files))
    assert looks[1] <= 1.1 * looks[0]


@pytest.mark.parametrize("rate_hz", [0.3, 2, 30, 190])
@pytest.mark.parametrize("start_s", [10, 640, 980.128, 4000, 20_000, 600_000])
@pytest.mark.parametrize("unit_ns", [1, 1000])
def test_times_of_a_simulation_are_read_in_the_unit_of_a_camera(rate_hz: float, start_s: float, unit_ns: int) -> None:
    """980 s in ns may be ms of the year 2001, but no camera takes an image every nine hours."""
    stamp_ns = (start_s * 1e9 + np.arange(40) * 1e9 / rate_hz).astype(np.int64) // unit_ns * unit_ns
    assert stamps_of([f"{stamp // unit_ns}" for stamp in stamp_ns.tolist()]) == stamp_ns.tolist()


def test_an_image_folder_of_a_simulation_lasts_as_long_as_the_drive(tmp_path: Path) -> None:
    write(tmp_path, [f"{980_128_000_000 + 33_333_333 * row}.jpg" for row in range(12)])
    log = logs.open(tmp_path)
    np.testing.assert_array_equal(log.stamps(), 980_128_000_000 + 33_333_333 * np.arange(12))
    assert not log.warnings


@pytest.mark.parametrize("step_s", [10, 3000, 4000])
def test_times_that_give_no_frame_rate_are_named_in_a_warning(step_s: int, tmp_path: Path) -> None:
    write(tmp_path, [f"{1_600_000_000 + step_s * row}.jpg" for row in range(6)])
    log = logs.open(tmp_path)
    np.testing.assert_array_equal(np.diff(log.stamps()), step_s * 10**9)
    [warning] = log.warnings
    assert f"{step_s:.4g} s apart" in warning
    assert "\n" not in warning


@pytest.mark.parametrize("few", ["cam0", "cam2"])
def test_a_camera_of_few_images_leaves_the_others_cameras(few: str, tmp_path: Path) -> None:
    folders = ("cam0", "cam1", "cam2")
    files = [tmp_path / name / f"{row}.png" for name in folders for row in range(2 if name == few else 30)]
    assert [*by_folder(tmp_path, files)] == [*folders]
    after = [tmp_path / f"{row // 30}" / f"{row}.png" for row in range(90)]
    assert not by_folder(tmp_path, after)


def test_what_the_system_hides_beside_images_is_none(tmp_path: Path) -> None:
    write(tmp_path, [f"{number}.png" for number in range(5)])
    (tmp_path / "._1.png").write_bytes(b"\0\5\x16\7")  # as macOS writes them on other disks
    log = logs.open(tmp_path)
    assert len(log.stamps()) == 5
    assert not log.info().warnings
