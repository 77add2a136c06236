"""The preflight: what would be used and why, what is wrong, and a page of it."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.logs.drives import FRAMES, Drive, ros_messages, write_raw, write_ros2
from tests.logs.test_rectification import BASELINE_M, PINHOLES, RIGHT_FROM_LEFT
from tests.logs.test_rectification import drive as write_pair
from vplog import logs
from vplog.cli import main, parser
from vplog.logs import TopicChoice
from vplog.run.keyframes import KeyframeSettings, select_keyframes
from vplog.storage.json_records import plain
from vplog.verbs.demo.scene import make_scene, take_picture
from vplog.verbs.demo.settings import DemoSettings
from vplog.verbs.info import command, page, preflight, preflight_lines

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ros2(tmp_path_factory.mktemp("info") / "drive", ros_messages(Drive(), 2))


def why(record: dict[str, Any]) -> dict[str, str]:
    return {topic["name"]: topic["why"] for topic in record["topics"]}


def test_what_is_used_and_as_what(drive: Path) -> None:
    record = preflight(drive).record
    assert why(record) == {
        "/cam/camera_info": "used as calibration",
        "/cam/depth": "used as depth",
        "/cam/image/compressed": "used as camera",
        "/fix": "used as satellite fixes",
        "/odom": "used as odometry",
        "/tf_static": "used as static transforms",
    }
    assert record["ready"]
    assert record["problems"] == []
    assert record["scale"]["source"] == "depth"
    assert record["odometry"]["frames"] == ["odom", "base_link"]
    assert record["odometry"]["count"] == record["frames"]["count"] == FRAMES
    assert record["frames"]["rate_hz"] == record["odometry"]["rate_hz"] == 10.0
    assert record["gps"]["count"] == FRAMES - 1  # one message has no fix
    assert record["clock_offset_ms"]["/odom"] == pytest.approx(7.0)
    image = next(topic for topic in record["topics"] if topic["name"] == "/cam/image/compressed")
    assert (image["pixels"], image["width"], image["height"], image["part"]) == ("png", 64, 48, "image")
    json.dumps(plain(record), allow_nan=False)


def test_the_keyframes_and_the_path_are_those_of_a_run(drive: Path) -> None:
    record, log = preflight(drive).record, logs.open(drive)
    odometry = log.odometry()
    assert odometry is not None
    keyframes, _ = select_keyframes(log.name, log.stamps(), odometry, KeyframeSettings())
    assert record["frames"]["keyframes"] == len(keyframes.stamp_ns)
    steps = np.linalg.norm(np.diff(odometry.odom_from_body[:, :3, 3], axis=0), axis=1)
    assert record["odometry"]["path_m"] == pytest.approx(steps.sum(), abs=1e-3)


def test_what_is_left_out_says_why_and_how_to_take_it(drive: Path, tmp_path: Path) -> None:
    record = preflight(drive, TopicChoice(gps="", depth="")).record
    assert why(record)["/fix"] == "left out; --gps-topic /fix takes it"
    assert record["gps"] is None
    assert record["scale"]["source"] == "odometry"
    assert preflight(drive, TopicChoice(odometry="/odom")).record["odometry"]["source"] == "/odom"
    assert why(preflight(drive, TopicChoice(odometry="/odom")).record)["/odom"] == "used as odometry, as requested"
    pair = preflight(write_pair(tmp_path, PINHOLES, RIGHT_FROM_LEFT, tf=True)).record
    assert why(pair)["/stereo/right/image_raw"] == "used as right image of the pair"
    assert pair["scale"]["source"] == "stereo"
    assert pair["camera"]["baseline_m"] == pytest.approx(BASELINE_M, abs=1e-6)
    alone = preflight(tmp_path / "drive", TopicChoice(right="")).record
    assert why(alone)["/stereo/right/image_raw"].startswith("/stereo/left/image_raw is taken; --image-topic")
    assert alone["camera"]["baseline_m"] is None


def test_what_stops_a_run_is_a_problem(drive: Path, tmp_path: Path) -> None:
    without = preflight(drive, TopicChoice(odometry=""))
    assert not without.record["ready"]
    assert "--odometry-file" in without.record["problems"][0]
    empty = preflight(write_raw(tmp_path / "empty.mcap", [("/chat", "std_msgs/msg/String", "cdr", 5, b"hello")])).record
    assert "No camera images" in empty["problems"][0]
    assert empty["camera"] is None
    assert why(empty)["/chat"] == "no use for std_msgs/msg/String in cdr"
    with pytest.raises(SystemExit) as ended:
        main.main(["info", str(tmp_path / "empty.mcap")])
    assert ended.value.code == 0  # the answer is the preflight's, not an error


@pytest.mark.parametrize("moves", [False, True])
def test_a_camera_that_stands_is_a_problem_of_visual_odometry(moves: bool, tmp_path: Path) -> None:
    """A KITTI sequence of a pair: what its run would find out after all of its images."""
    street = make_scene(DemoSettings(laps=0.5, frame_rate_hz=6, width=384, height=216, seed=3))
    assert street.camera.matrix is not None
    for side, metres in enumerate((0.0, 0.3)):
        (tmp_path / f"image_{side}").mkdir()
        for row in range(4):
            image = take_picture(street, row * moves, metres)[0]
            assert cv2.imwrite(str(tmp_path / f"image_{side}" / f"{row:06d}.png"), image)
    (tmp_path / "times.txt").write_text("".join(f"{row / 6:e}\n" for row in range(4)))
    matrices = [street.camera.matrix @ np.column_stack([np.eye(3), [-metres, 0.0, 0.0]]) for metres in (0.0, 0.3)]
    rows = [" ".join(map(str, matrix.ravel())) for matrix in matrices]
    (tmp_path / "calib.txt").write_text(f"P0: {rows[0]}\nP1: {rows[1]}\n")
    found = preflight(tmp_path).record
    assert found["visual_odometry"] == "used"
    assert [line.startswith("The camera stands") for line in found["problems"]] == [True] * (not moves)
    assert ("vplog run" in found["command"]) == moves


def words_of(told: str | None) -> list[str]:
    """A command that a record names, with a file for each of its placeholders."""
    assert told is not None
    return shlex.split(told)[1:]


def test_the_command_of_a_log_that_cannot_be_run_works_all_the_same(verb: Any, drive: Path, tmp_path: Path) -> None:
    """Another topic where one works, a library where there are images alone, nothing where there are none."""
    without = preflight(drive, TopicChoice(odometry="")).record
    assert words_of(without["command"])[-2:] == ["--odometry-topic", "/odom"]
    assert f"this works {without['command']}" in verb("info", drive, "--odometry-topic", "").out
    messages = ros_messages(Drive(), 2)
    spoiled = [
        dataclasses.replace(
            m, topic="/broken/image/compressed", message=dataclasses.replace(m.message, data=np.zeros(9, np.uint8))
        )
        for m in messages
        if m.topic == "/cam/image/compressed"
    ]
    two = write_ros2(tmp_path / "two", messages + spoiled)
    broken = preflight(two, TopicChoice(image="/broken/image/compressed")).record
    assert not broken["ready"]
    assert preflight(two, parser.topics_of(main._parser().parse_args(words_of(broken["command"])))).record["ready"]
    assert "--image-topic /cam/image/compressed" in broken["command"]
    images = write_ros2(tmp_path / "images", [m for m in messages if m.topic == "/cam/image/compressed"])
    record = preflight(images, TopicChoice(odometry="")).record
    assert words_of(record["command"])[0] == "library"
    done = verb(*[str(tmp_path / "lib") if word == "OUT" else word for word in words_of(record["command"])])
    assert done.code == 0, done.err
    blind = write_ros2(tmp_path / "blind", [m for m in messages if m.topic == "/odom"])
    assert preflight(blind).record["command"] is None
    said = verb("info", blind)
    assert "vplog run" not in said.out
    assert "vplog run" not in page(preflight(blind))


def test_check_is_one_line_and_a_status(verb: Any, drive: Path, tmp_path: Path) -> None:
    good = verb("info", drive, "--check")
    assert (good.code, good.err) == (0, "")
    assert good.out == f"{drive} can be run: vplog run {drive} -o OUT\n"
    error = verb("info", drive, "--check", "--odometry-topic", "").error
    assert error.startswith(f"{drive} cannot be run. There is no odometry")
    assert error.endswith("--odometry-topic /odom")
    told = verb("info", drive, "--check", "--json", "--odometry-topic", "")
    assert told.code == 1
    assert json.loads(told.out)["ready"] is False
    assert verb("info", drive, "--check", "--json").json["ready"] is True
    assert "no such file" in verb("info", tmp_path / "none.mcap", "--check").error


def test_the_command_runs_with_what_was_asked_for(drive: Path, tmp_path: Path) -> None:
    file = tmp_path / "with space.yaml"
    topics = TopicChoice(image="/cam/image/compressed", cameras=("/rear",), depth="", calibration_file=file)
    words = shlex.split(command(drive, topics))
    arguments = main._parser().parse_args(words[1:])
    assert parser.topics_of(arguments) == topics
    assert arguments.logs == [drive]


def test_a_folder_of_images_with_files_beside_it(tmp_path: Path) -> None:
    folder, poses = tmp_path / "images", tmp_path / "poses.tum"
    folder.mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / f"{1000 + i}.000.png"), np.zeros((8, 10), np.uint8))
    poses.write_text("".join(f"{1000 + i} {2 * i} 0 0 0 0 0 1\n" for i in range(4)))
    record = preflight(folder, TopicChoice(odometry_file=poses)).record
    assert record["ready"]
    assert why(record) == {"images": "used as camera"}
    assert (record["odometry"]["source"], record["odometry"]["path_m"]) == (str(poses), 6.0)
    assert f"--odometry-file {poses}" in record["command"]
    assert "--odometry-file" in preflight(folder, TopicChoice(odometry="")).record["problems"][0]
    poses.write_text("1001 0 0 0 0 0 0 1\n1002 2 0 0 0 0 0 1\n")
    short = preflight(folder, TopicChoice(odometry_file=poses)).record
    assert short["frames"]["keyframes"] == 2
    assert any("2 of 4 frames without odometry" in line for line in short["warnings"])
    poses.write_text("5 0 0 0 0 0 0 1\n6 2 0 0 0 0 0 1\n")
    apart = preflight(folder, TopicChoice(odometry_file=poses)).record
    assert any("no two frames have odometry" in line for line in apart["problems"])
    assert not apart["ready"]


@pytest.mark.parametrize(("names", "rate_hz"), [("{}.500.png", 1.0), ("{:06}.png", None)])
def test_the_rate_of_images_whose_names_are_no_times_is_not_made_up(
    names: str, rate_hz: float | None, tmp_path: Path
) -> None:
    for i in range(4):
        cv2.imwrite(str(tmp_path / names.format(i)), np.zeros((8, 10), np.uint8))
    record = preflight(tmp_path).record
    assert [record["frames"]["rate_hz"], record["topics"][0]["rate_hz"]] == [rate_hz, rate_hz]
    assert ("assumed to be 0.1 s apart" in dict(preflight_lines(record))["frames"]) == (rate_hz is None)
    (tmp_path / names.format(2)).write_bytes(b"")  # pictures are no drive, whichever of them are read
    for choice in (TopicChoice(), TopicChoice(start_s=0.1)):
        record = preflight(tmp_path, choice).record
        assert (record["frames"]["rate_hz"] is None, record["visual_odometry"] == "") == (rate_hz is None,) * 2


def test_gaps_are_placed_in_time(tmp_path: Path) -> None:
    messages = ros_messages(Drive(), 2)
    late = [m for m in ros_messages(Drive(), 2) if m.topic in ("/cam/image/compressed", "/odom")]
    for m in late:
        m.stamp_ns += 30 * 10**9
        m.message.header.stamp.sec += 30
    record = preflight(write_ros2(tmp_path / "drive", messages + late)).record
    found = sorted((gap["what"], gap["seconds"]) for gap in record["gaps"])
    assert found == [("images", 29.6), ("odometry", 29.6)]
    assert record["gaps"][0]["after_s"] == pytest.approx(0.4)


class Page(HTMLParser):
    """What a browser would load from elsewhere, and which elements are open."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.images = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag != "script"
        for name, value in attrs:
            if name in ("src", "href"):
                self.loads.append(value or "")
        self.images += tag == "img"


def test_page_is_whole_and_escapes_what_the_log_says(drive: Path, tmp_path: Path) -> None:
    found = preflight(drive)
    evil = "<script>alert('x')</script>"
    found.record["warnings"].append(evil)
    found.record["topics"][0]["name"] = evil
    text = page(found)
    assert "<script" not in text
    parsed = Page()
    parsed.feed(text)
    assert parsed.images == len(found.pictures) == FRAMES
    assert all(source.startswith("data:") for source in parsed.loads)
    assert re.search(r"default-src 'none'; img-src data:; style-src &#39;sha256-[\w+/=]{44}&#39;\"", text)
    assert not re.search(r"url\(|@import|https?://", text)
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text
    for name, line in preflight_lines(found.record):
        assert f"<dt>{name}</dt>" in text
        assert line.split(":", maxsplit=1)[0] in text
    out = tmp_path / "info.html"
    with pytest.raises(SystemExit) as ended:
        main.main(["info", str(drive), "--html", str(out)])
    assert ended.value.code == 0
    assert out.read_text().startswith("<!doctype html>")


def test_pictures_are_the_drives_frames(drive: Path) -> None:
    found = preflight(drive)
    np.testing.assert_array_equal([stamp for stamp, _ in found.pictures], Drive().stamp_ns)
    np.testing.assert_array_equal([image for _, image in found.pictures], Drive().images)
