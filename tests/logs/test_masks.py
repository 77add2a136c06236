"""Masks beside a log and in it: which image each belongs to, its size, and what is refused in one line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.logs import test_rectification as rectification
from tests.logs.drives import FRAMES, HEIGHT, START_NS, WIDTH, Drive, Written, png, ros_messages, store, write_ros2
from vplog import logs
from vplog.errors import LogError
from vplog.logs import TopicChoice
from vplog.logs.masks import Mask

if TYPE_CHECKING:
    from pathlib import Path

TOPIC = "/cam/image/compressed"
ZERO_BELOW = np.where(np.arange(HEIGHT)[:, None] < 30, 255, 0).astype(np.uint8).repeat(WIDTH, 1)


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def bag(folder: Path, masks: str = "", used: float = 1.0) -> Path:
    """The drive as a ROS 2 bag; with `masks`, an encoding, a topic of masks of which the third is missing. `used` is
    the share of their columns that is not zero throughout."""
    messages = ros_messages(Drive(), 2)
    for one in [one for one in messages if masks and one.topic == TOPIC]:
        number = (one.stamp_ns - START_NS) // 10**8
        label = (ZERO_BELOW > 0) * np.array(1 + number, np.uint8 if masks == "mono8" else np.uint16)
        label[:5] = np.iinfo(label.dtype).max // 2  # classes far apart, of which none is stretched to zero
        label[:, round(used * WIDTH) :] = 0
        image = store(2).types["sensor_msgs/msg/Image"](
            header=one.message.header, height=HEIGHT, width=WIDTH, encoding=masks, is_bigendian=0,
            step=WIDTH * label.itemsize, data=label.view(np.uint8).ravel(),
        )  # fmt: skip
        if number != 2:
            messages.append(Written("/segments", "sensor_msgs/msg/Image", one.stamp_ns, image))
    return write_ros2(folder / "bag", messages)


def masks_of(log: logs.Log) -> list[np.ndarray | None]:
    return [frame.decode().mask for frame in log.frames(log.stamps())]


@pytest.mark.parametrize("seed", range(6))
def test_one_mask_is_of_every_image_whatever_its_size_and_coding(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    scale, ending = rng.choice([0.25, 0.5, 1.0, 2.0, 3.0]), rng.choice(["png", "jpg", "bmp", "tiff"])
    size = round(WIDTH * scale), round(HEIGHT * scale)
    value = 255 if ending == "jpg" else rng.integers(1, 256)
    drawn = cv2.resize(ZERO_BELOW, size, interpolation=cv2.INTER_NEAREST) // 255 * np.uint8(value)
    if rng.integers(2):
        drawn = np.dstack([drawn] * 3)
    file = write(tmp_path / f"mask.{ending}", drawn)
    log = logs.open(bag(tmp_path), TopicChoice(masks={rng.choice(["", TOPIC]): file}))
    frames = [frame.decode() for frame in log.frames(log.stamps())]
    assert [frame.image.tolist() for frame in frames] == Drive().images.tolist()  # as recorded
    for frame in frames:
        assert frame.mask is not None
        assert frame.mask[:29].all()
        assert not frame.mask[31:].any()
    assert any("is resized" in line for line in log.warnings) == (scale != 1)


@pytest.mark.parametrize(("ending", "quality"), [("webp", 60), ("webp", 101), ("jpg", 60), ("png", 0)])
def test_blurred_edges_mask_what_is_darker_than_half(ending: str, quality: int, tmp_path: Path) -> None:
    """WebP of quality 101 is lossless, in which 1 counts."""
    sharp = ending == "png" or quality > 100
    drawn = cv2.ellipse(np.zeros((480, 640), np.uint8), (320, 240), (300, 200), 10, 0, 360, 1 if sharp else 255, -1)
    option = {"webp": cv2.IMWRITE_WEBP_QUALITY, "jpg": cv2.IMWRITE_JPEG_QUALITY}.get(ending)
    assert cv2.imwrite(str(tmp_path / f"m.{ending}"), drawn, [] if option is None else [option, quality])
    used = Mask(tmp_path / f"m.{ending}").used((640, 480))
    assert (used != (drawn > 0)).mean() < (1e-9 if sharp else 2e-3)


def test_masks_of_a_folder_go_by_name_or_stamp(tmp_path: Path) -> None:
    names = ["sub/a.jpg.png", "b.png", "drive/other/c.tiff"]
    for name in ("sub/a", "sub/b", "other/c", "other/d"):
        write(tmp_path / f"drive/{name}.jpg", ZERO_BELOW // 2)
    for number, name in enumerate(names):
        mask = np.ones((HEIGHT, WIDTH), np.uint8)
        mask[:, number] = 0
        write(tmp_path / "masks" / name, mask)
    log = logs.open(tmp_path / "drive", TopicChoice(masks={"": tmp_path / "masks"}))
    found = dict(zip(log.file_names() or [], masks_of(log), strict=True))
    columns = {name: None if mask is None else np.flatnonzero(~mask[0]).tolist() for name, mask in found.items()}
    assert columns == {"other/c.jpg": [2], "other/d.jpg": None, "sub/a.jpg": [0], "sub/b.jpg": [1]}
    assert "has no mask for 1 image" in " ".join(log.warnings)

    stamp_ns = int(Drive().stamp_ns[3])
    write(tmp_path / "stamps" / f"{stamp_ns}.png", ZERO_BELOW)
    recorded = logs.open(bag(tmp_path), TopicChoice(masks={TOPIC: tmp_path / "stamps"}))
    assert [mask is not None for mask in masks_of(recorded)] == [number == 3 for number in range(FRAMES)]


def test_masks_of_a_data_set_go_by_the_names_of_its_files(tmp_path: Path, shared_data: Path) -> None:
    kitti = shared_data / "folders" / "kitti"
    if not kitti.is_dir():
        pytest.skip(f"no folder {kitti}")
    first = logs.open(kitti)
    height, width = next(iter(first.frames(first.stamps()))).decode().image.shape
    mask = np.ones((height, width), np.uint8)
    mask[300:] = 0
    write(tmp_path / "masks/000001.png", mask)
    topic = next(topic.name for topic in first.info().topics if topic.part == "image")
    log = logs.open(kitti, TopicChoice(masks={topic: tmp_path / "masks"}))
    found = masks_of(log)
    assert [one is not None for one in found] == [number == 1 for number in range(len(found))]


@pytest.mark.parametrize("encoding", ["mono8", "16UC1"])
def test_masks_of_a_topic_are_paired_by_stamp(encoding: str, tmp_path: Path) -> None:
    path = bag(tmp_path, encoding)
    log = logs.open(path, TopicChoice(mask="/segments"))
    found = masks_of(log)
    assert found[2] is None
    assert all(mask is not None and (mask == (ZERO_BELOW > 0)).all() for mask in found[:2] + found[3:])
    assert "1 of 5 images without a mask image" in " ".join(log.warnings)
    parts = {topic.name: topic.part for topic in log.info().topics}
    assert (parts["/segments"], parts[TOPIC], parts["/cam/depth"]) == ("mask", "image", "depth")


def test_rectified_frames_have_rectified_masks(tmp_path: Path) -> None:
    width, height = rectification.SIZE
    mask = np.ones((height, width), np.uint8)
    mask[:, :80] = 0
    file = write(tmp_path / "mask.png", mask)
    options = {"tf": True, "late_ns": 3000}
    path = rectification.drive(tmp_path, rectification.PINHOLES, rectification.RIGHT_FROM_LEFT, **options)
    for i in range(3):  # by the right images' own stamps
        write(tmp_path / f"right/{START_NS + i * 10**8 + 3000}.png", mask)
    plain = logs.open(path)
    right = next(topic.name for topic in plain.info().topics if topic.part == "right")
    log = logs.open(path, TopicChoice(masks={"": file, right: tmp_path / "right"}))
    a, b = (next(iter(one.frames(one.stamps()))).decode() for one in (log, plain))
    assert a.mask is not None
    assert a.mask.shape == a.image.shape
    border = (~a.mask).sum(axis=1)  # px masked of each row: the lens bends the edge of the mask
    assert 1 < np.ptp(border) < 20
    assert (a.image == b.image).all()
    assert a.right is not None
    assert b.right is not None
    changed = (a.right != b.right).any(axis=0)
    assert changed[:50].mean() > 0.5
    assert not changed[130:].any()
    black = write(tmp_path / "black.png", 0 * mask)
    with pytest.raises(LogError, match="is black"):
        logs.open(path, TopicChoice(masks={right: black})).camera()
    apart = rectification.drive(tmp_path / "apart", rectification.PINHOLES, rectification.RIGHT_FROM_LEFT)
    assert logs.open(apart, TopicChoice(masks={right: black})).camera().baseline_m is None, "no pair, no mask of it"


REFUSED = {
    "no file": ({"": "none.png"}, "There is no mask at"),
    "a text": ({"": "text.png"}, "is no whole image"),
    "damaged": ({"": "cut.png"}, "is no whole image"),
    "another shape": ({"": "square.png"}, "another shape"),
    "black": ({"": "black.png"}, "is black"),
    "a folder of black ones": ({"": "many"}, "is black"),
    "another topic": ({"/rear": "square.png"}, "the log has no topic /rear"),
    "empty folder": ({"": "empty"}, "has no images"),
    "other names": ({"": "others"}, "called like it"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_mask_is_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    given, words = REFUSED[kind]
    write(tmp_path / "square.png", np.ones((40, 40), np.uint8))
    write(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write(tmp_path / "others/x.png", ZERO_BELOW)
    for stamp_ns in Drive().stamp_ns[:3]:
        write(tmp_path / f"many/{stamp_ns}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    (tmp_path / "cut.png").write_bytes(png(ZERO_BELOW)[:-20])
    (tmp_path / "text.png").write_text("mask")
    (tmp_path / "empty").mkdir()
    masks = {topic: tmp_path / name for topic, name in given.items()}
    with pytest.raises(LogError, match=words) as found:
        logs.open(bag(tmp_path), TopicChoice(masks=masks)).camera()
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("levels", "words"),
    [
        ([255 - ZERO_BELOW], "mask.png masks 62%"),
        ([np.dstack([0 * ZERO_BELOW + 255] * 3 + [ZERO_BELOW])], "mask.png masks nothing"),  # drawn as transparency
        ([0 * ZERO_BELOW, ZERO_BELOW, 0 * ZERO_BELOW], "mask masks 79%"),  # the first may be black
        ([0 * ZERO_BELOW, 0 * ZERO_BELOW + 255, ZERO_BELOW], ""),
    ],
)
def test_masks_that_leave_out_most_or_nothing_are_doubted(levels: list[np.ndarray], words: str, tmp_path: Path) -> None:
    for stamp_ns, level in zip(Drive().stamp_ns, levels, strict=False):
        write(tmp_path / f"mask/{stamp_ns}.png", level)
    path = tmp_path / "mask"
    if len(levels) == 1:
        path = write(tmp_path / "mask.png", levels[0])
    log = logs.open(bag(tmp_path), TopicChoice(masks={"": path}))
    log.camera()
    doubts = [line for line in log.warnings if " masks " in line]
    assert len(doubts) == bool(words)
    assert words in " ".join(doubts)


def test_masks_of_a_topic_are_looked_at_too(tmp_path: Path) -> None:
    log = logs.open(bag(tmp_path, "mono8", 0.2), TopicChoice(mask="/segments"))
    log.camera()
    assert "/segments masks 87% of the images of /cam/image/compressed; zero" in " ".join(log.warnings)
    with pytest.raises(LogError, match="/segments is black, which masks all of /cam/image/compressed"):
        logs.open(bag(tmp_path / "black", "mono8", 0.0), TopicChoice(mask="/segments")).camera()
