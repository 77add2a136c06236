from __future__ import annotations

import pytest

from vplog.errors import LogError
from vplog.logs import TopicChoice
from vplog.logs.formats.container import Channel
from vplog.logs.topic_selection import Candidate, Selection, select

INFO, IMAGE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image"


def topic(
    name: str, role: str = "image", count: int = 10, kind: str = IMAGE, frame: str = "", set_: bool = False
) -> Candidate:
    return Candidate(Channel(name, kind, "cdr"), count, role, frame, set_)


def info(name: str, frame: str = "", calibrated: bool = True) -> Candidate:
    return topic(name, "camera_info", 10, INFO, frame, calibrated)


def names(chosen: Selection) -> dict[str, str | None]:
    parts = ("image", "depth", "right", "camera_info", "right_info", "odometry", "gps")
    return {part: channel.topic if (channel := getattr(chosen, part)) else None for part in parts}


def pick(*found: Candidate, **choice: str) -> dict[str, str | None]:
    topics = TopicChoice.model_validate(choice)
    forward = select(list(found), topics, "run.mcap")
    assert select(list(reversed(found)), topics, "run.mcap") == forward  # the order of a file has no say
    return names(forward)


def test_image_calibrated_first_then_most_messages_then_name() -> None:
    a, b, c = topic("/a/image"), topic("/b/image", count=20), topic("/c/image", count=20)
    assert pick(a, b, c)["image"] == "/b/image"
    assert pick(a, b, c, info("/a/camera_info"))["image"] == "/a/image"
    assert pick(a, b, c, info("/a/camera_info", calibrated=False))["image"] == "/b/image"
    assert pick(a, b, topic("/d/image", count=0))["image"] == "/b/image"


def test_calibration_of_the_same_namespace_then_of_the_same_frame() -> None:
    left = topic("/stereo/left/image_raw/compressed", frame="left")
    both = info("/stereo/left/camera_info", "left"), info("/stereo/right/camera_info", "left")
    assert pick(left, *both)["camera_info"] == "/stereo/left/camera_info"
    assert pick(left, info("/calibration", "left"), info("/other", "right"))["camera_info"] == "/calibration"
    assert pick(left, info("/stereo/right/camera_info", "right"))["camera_info"] is None
    realsense = topic("/device_0/Color_0/image/data"), info("/device_0/Color_0/info/camera_info", "c")
    assert pick(*realsense)["camera_info"] == "/device_0/Color_0/info/camera_info"


@pytest.mark.parametrize("role", ["depth", "right", "mask"])
@pytest.mark.parametrize("given", [{}, {"image": "/a/image"}])
def test_one_topic_is_not_asked_to_be_two_things(role: str, given: dict[str, str]) -> None:
    if role == "mask" and not given:
        assert pick(topic("/a/image"), topic("/b/image"), mask="/a/image")["image"] == "/b/image"
        return
    with pytest.raises(LogError, match=f"/a/image is the image topic of run.mcap. Choose another with --{role}-topic"):
        pick(topic("/a/image"), info("/a/camera_info"), **given, **{role: "/a/image"})


def test_depth_in_the_frame_of_the_image_first() -> None:
    image = topic("/camera/color/image", frame="color")
    aligned = topic("/camera/aligned_depth/image", "depth", 5, frame="color")
    assert (
        pick(image, aligned, topic("/camera/depth/image", "depth", 50, frame="depth"))["depth"] == aligned.channel.topic
    )
    assert pick(aligned)["depth"] is None  # depth alone is no camera


def test_pairs_by_their_names() -> None:
    """The left one is the camera even where the right one has a message more."""
    for left, right in (
        ("/stereo/left/image_raw", "/stereo/right/image_raw"),
        ("/camera_left/image", "/camera_right/image"),
        ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
        ("/cam0/image_raw", "/cam1/image_raw"),
    ):
        infos = [info(f"{name.rsplit('/', 1)[0]}/camera_info") for name in (left, right)]
        pair = [topic(left), topic(right, count=11)]
        chosen = pick(*pair, *infos)
        assert (chosen["image"], chosen["right"]) == (left, right)
        assert (chosen["camera_info"], chosen["right_info"]) == tuple(one.channel.topic for one in infos)
        assert pick(*pair, *infos, right="")["right"] is None
        assert pick(*pair, *infos, image=right)["right"] is None
        assert pick(*pair, *infos, topic("/depth", "depth"))["right"] == right, "the depth may be of no use"
    assert pick(topic("/front/left"), topic("/rear/right"))["right"] is None
    several = ("/left_stereo_camera/left/image", "/left_stereo_camera/right/image", "/right_stereo_camera/left/image",
               "/right_stereo_camera/right/image")  # fmt: skip
    for at in (0, 2):
        assert pick(*map(topic, several), image=several[at])["right"] == several[at + 1]
    several = "/camera_left/infra1/image", "/camera_left/infra2/image", "/camera_right/infra1/image"
    assert pick(*map(topic, several), image=several[0])["right"] == several[1]
    assert pick(*map(topic, several[:2]), image=several[0])["right"] == several[1]


def test_pair_or_depth_but_not_both() -> None:
    found = topic("/a"), topic("/b"), topic("/depth", "depth")
    chosen = pick(*found, image="/a", right="/b")
    assert (chosen["right"], chosen["depth"]) == ("/b", None)
    with pytest.raises(LogError, match="Leave out --depth-topic or --right-topic"):
        pick(*found, image="/a", right="/b", depth="/depth")
    with pytest.raises(LogError, match=r"No topic '/c' in run.mcap. Image topics: /a, /b"):
        pick(*found, right="/c")


def test_the_sources_of_odometry_are_all_poses_and_the_transforms() -> None:
    """Which of them it is shows when they are read (test_odometry_choice.py)."""
    moving = [topic(name, "tf", count, "tf2_msgs/msg/TFMessage") for name, count in (("/tf", 50), ("/arm/tf", 9))]
    static = topic("/tf_static", "tf_static", 1, "tf2_msgs/msg/TFMessage")
    poses = topic("/b", "odometry", 9), topic("/a", "odometry", 99), topic("/empty", "odometry", 0)

    def sources(*found: Candidate, **choice: str) -> list[str]:
        chosen = select(list(found), TopicChoice.model_validate(choice), "run.mcap")
        assert chosen == select(list(reversed(found)), TopicChoice.model_validate(choice), "run.mcap")
        return [source.topic for source in chosen.sources]

    assert sources(*moving, static, *poses) == ["/a", "/b", "/tf"]
    assert sources(*moving, static, *poses, odometry="/tf") == ["/tf"]
    assert sources(*moving, static, *poses, odometry="") == []
    topics = TopicChoice(odometry="/a")
    chosen = select([*moving, static, *poses], topics, "a")
    assert [c.topic for c in chosen.tf] == ["/tf", "/arm/tf"]  # static ones may be there
    assert len(chosen.with_odometry(chosen.sources[0], has_static=True, turned=False).tf) == 2
    assert chosen.with_odometry(chosen.sources[0], has_static=False, turned=False).tf == ()
    assert len(chosen.with_odometry(moving[0].channel, has_static=False, turned=False).tf) == 2


def test_an_imu_and_a_lidar_are_read_beside_transforms_and_commands() -> None:
    """Which may turn out to be no odometry; where it is another's, the IMU is left out again."""
    image, imu, cloud = topic("/image"), topic("/imu", "imu"), topic("/points", "lidar")
    twist = topic("/twist", "odometry", kind="geometry_msgs/msg/TwistStamped")
    goal, moving = topic("/move_base_simple/goal", "odometry", 2), topic("/tf", "tf", 99, "tf2_msgs/msg/TFMessage")

    def read(*found: Candidate, **choice: str) -> tuple[bool, bool]:
        chosen = select(list(found), TopicChoice.model_validate(choice), "run.mcap")
        return chosen.imu is not None, chosen.lidar is not None

    for beside in ([], [moving], [goal], [moving, goal]):
        assert read(image, imu, cloud, *beside) == (True, True), beside
        assert read(image, imu, cloud, twist, *beside) == (True, False)
        assert read(image, imu, cloud, topic("/pose", "odometry"), *beside) == (False, False)
    assert read(image, imu, cloud, moving, odometry="/tf") == (False, False)
    assert read(image, imu, cloud, moving, twist, odometry="/twist") == (True, False)
    chosen = select([image, imu, moving], TopicChoice(), "run.mcap")
    assert chosen.with_odometry(moving.channel, has_static=False, turned=False).imu is None


def test_choice_overrides_and_empty_means_none() -> None:
    found = (topic("/a", "odometry", 5), topic("/b", "odometry", 9), topic("/c"), topic("/d", "depth"))
    assert pick(*found, odometry="/a")["odometry"] == "/a"
    assert pick(*found, odometry="", depth="")["odometry"] is None
    assert pick(*found, image="/d")["image"] == "/d"  # 16 bits of grey look like depth; who asks gets it


def test_wrong_names_say_what_there_is() -> None:
    found = [topic("/right"), topic("/left"), topic("/odom", "odometry", 5, "nav_msgs/msg/Odometry")]
    with pytest.raises(LogError) as error:
        select(found, TopicChoice(image="/cam0"), "run.mcap")
    assert str(error.value) == (
        "No topic '/cam0' in run.mcap. Image topics: /left, /right. Choose one with --image-topic."
    )
    with pytest.raises(LogError, match=r"'/odom' in run.mcap is nav_msgs/msg/Odometry\. Image topics: /left, /right"):
        select(found, TopicChoice(image="/odom"), "run.mcap")
    with pytest.raises(LogError, match=r"GPS topics: none"):
        select(found, TopicChoice(gps="/fix"), "run.mcap")
