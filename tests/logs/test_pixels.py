"""Every frame of every format holds the pixels that the packages mcap and rosbags give, decoded by OpenCV."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader

from tests.logs.drives import PERIOD_NS, START_NS, Written, store, write_foxglove, write_ros1, write_ros2
from vplog import logs
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.logs.messages.pixels import rgb
from vplog.logs.messages.records import ImageMessage
from vplog.logs.topic_selection import TopicChoice

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FRAMES = 12
ENCODINGS = ("jpeg", "png", "webp", "bmp", "mono8", "rgb8", "bgr8", "bayer_rggb8", "mono16")
RAW: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "mono16": (2, None),
}
"""Bytes of a px, and OpenCV's conversion to grey."""
SIDES = ((24, 18), (64, 48), (200, 150), (331, 97))
"""px: small images lie within one window of 4 kB, large ones reach over several."""


class Format(NamedTuple):
    """A way to write a drive."""

    name: str
    write: Callable[[Path, list[Written], dict[str, Any]], Path]
    family: str
    """`ros2`, `ros1` or `foxglove`."""
    options: dict[str, Any]


def _mcap(path: Path, messages: list[Written], options: dict[str, Any]) -> Path:
    """ROS 2 CDR in an MCAP file whose writer is told the chunk size."""
    from mcap.writer import Writer

    file = path.with_suffix(".mcap")
    with file.open("wb") as out:
        writer = Writer(out, **options)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for m in messages:
            if m.topic not in channels:
                text, _ = store(2).generate_msgdef(m.type, ros_version=2)
                channels[m.topic] = writer.register_channel(
                    m.topic, "cdr", writer.register_schema(m.type, "ros2msg", text.encode())
                )
            writer.add_message(channels[m.topic], m.stamp_ns, bytes(store(2).serialize_cdr(m.message, m.type)), 0)
        writer.finish()
    return file


def _foxglove(path: Path, messages: list[Written], options: dict[str, Any]) -> Path:
    return write_foxglove(path.with_suffix(".mcap"), messages, "protobuf", **options)


def _ros1(path: Path, messages: list[Written], options: dict[str, Any]) -> Path:
    return write_ros1(path.with_suffix(".bag"), messages, **options)


def _ros2(path: Path, messages: list[Written], options: dict[str, Any]) -> Path:
    return write_ros2(path, messages, **options)


FORMATS = [
    *(Format(f"cdr-{kind.name}", _mcap, "ros2", {"compression": kind}) for kind in CompressionType),
    *(Format(f"protobuf-{kind.name}", _foxglove, "foxglove", {"compression": kind}) for kind in CompressionType),
    Format("cdr-no-chunks", _mcap, "ros2", {"use_chunking": False}),
    *(Format(f"ros1-{kind or 'none'}", _ros1, "ros1", {"compression": kind}) for kind in ("", "bz2", "lz4")),
    Format("rosbags-mcap", _ros2, "ros2", {"storage": "mcap"}),
    Format("db3", _ros2, "ros2", {"storage": "sqlite3"}),
    Format("db3-messages-packed", _ros2, "ros2", {"storage": "sqlite3", "compression": True}),
]


def picture(rng: np.random.Generator, encoding: str, width: int, height: int) -> np.ndarray:
    """(H, W, bytes of a px) uint8, smooth, so that JPEG and WebP are small; 12 bits in those of 16."""
    channels, _ = RAW.get(encoding, (3, None))
    coarse = rng.integers(0, 256, (height // 8 + 2, width // 8 + 2, channels)).astype(np.uint8)
    pixels = cv2.resize(coarse, (width, height)).reshape(height, width, channels)
    if encoding == "mono16":
        return (pixels[..., 0].astype(np.uint16) * 16).view(np.uint8).reshape(height, width, 2)
    return pixels


def message(family: str, encoding: str, stamp_ns: int, pixels: np.ndarray) -> tuple[str, Any]:
    """Type and message of a picture."""
    height, width, channels = pixels.shape
    raw = encoding in RAW
    data = pixels.tobytes() if raw else cv2.imencode(f".{encoding}", pixels)[1].tobytes()
    if family == "foxglove":
        made = (
            RawImage(frame_id="c", width=width, height=height, encoding=encoding, step=width * channels, data=data)
            if raw
            else CompressedImage(frame_id="c", format=encoding, data=data)
        )
        made.timestamp.seconds, made.timestamp.nanos = divmod(stamp_ns, 10**9)
        return made.DESCRIPTOR.full_name, made
    types = store(1 if family == "ros1" else 2).types
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](**({"seq": 0} if family == "ros1" else {}), stamp=time, frame_id="c")
    name = f"sensor_msgs/msg/{'Image' if raw else 'CompressedImage'}"
    fields: dict[str, Any] = {"format": encoding}
    if raw:
        fields = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": width * channels}
    return name, types[name](header=header, **fields, data=np.frombuffer(data, np.uint8))


def small(family: str, stamp_ns: int) -> tuple[str, int, Any]:
    """Type, stamp and message of a pose."""
    if family == "foxglove":
        pose = PoseInFrame(frame_id="odom")
        pose.timestamp.seconds, pose.timestamp.nanos = divmod(stamp_ns, 10**9)
        pose.pose.orientation.w = 1.0
        return "foxglove.PoseInFrame", stamp_ns, pose
    types = store(1 if family == "ros1" else 2).types
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](**({"seq": 0} if family == "ros1" else {}), stamp=time, frame_id="odom")
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=stamp_ns * 1e-9, y=0.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    name = "geometry_msgs/msg/PoseStamped"
    return name, stamp_ns, types[name](header=header, pose=pose)


def drive(rng: np.random.Generator, family: str, encoding: str) -> tuple[list[Written], list[str]]:
    """One to three topics of images in sizes and encodings of their own, the first in `encoding`, among many poses."""
    topics = [f"/{'abc'[i]}/image" for i in range(rng.integers(1, 4))]
    kinds = [encoding, *rng.choice(ENCODINGS, len(topics) - 1).tolist()]
    sides = rng.permutation(np.array(SIDES))[: len(topics)].tolist()
    messages: list[Written] = []
    for i in range(FRAMES):
        stamp = posed_ns = START_NS + i * PERIOD_NS
        for topic, kind, (width, height) in zip(topics, kinds, sides, strict=True):
            if kind == encoding or rng.random() < 0.8:
                found = message(family, kind, stamp, picture(rng, kind, width, height))
                messages.append(Written(topic, found[0], stamp, found[1]))
            for _ in range(rng.choice([0, 1, 3, 40])):
                posed_ns += 500_000
                messages.append(Written("/pose", *small(family, posed_ns)))
    return messages, topics


def recorded(path: Path, family: str, topic: str) -> list[Any]:
    """The image messages of a topic as the packages mcap and rosbags read them."""
    if family == "foxglove":
        kinds: dict[str, Any] = {"foxglove.RawImage": RawImage, "foxglove.CompressedImage": CompressedImage}
        with path.open("rb") as file:
            found = list(make_reader(file).iter_messages(topics=[topic]))
        return [kinds[schema.name].FromString(one.data) for schema, _, one in found if schema]
    with AnyReader([path], default_typestore=store(2)) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(connections)]


def pixels_of(found: Any) -> np.ndarray:
    """(H, W) uint8, or uint16 of 16 bits."""
    data = np.frombuffer(bytes(found.data), np.uint8)
    if not hasattr(found, "step"):
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
    channels, conversion = RAW[found.encoding]
    if found.encoding == "mono16":
        return data.view("<u2").reshape(found.height, found.width)
    shape = (found.height, found.width, channels) if channels > 1 else (found.height, found.width)
    return data.reshape(shape) if conversion is None else cv2.cvtColor(data.reshape(shape), conversion)


def by_levels(images: list[np.ndarray]) -> list[np.ndarray]:
    """uint8 of uint16: linear from the value that 0.2 % of all pixels reach to that which 0.2 % exceed."""
    if images[0].dtype != np.uint16:
        return images
    everything = np.concatenate([image.ravel() for image in images])
    black, white = np.quantile(everything, [0.002, 0.998], method="inverted_cdf").astype(float)
    scaled = [np.rint((image - black) * (255 / max(white - black, 255))) for image in images]
    return [np.clip(image, 0, 255).astype(np.uint8) for image in scaled]


@pytest.mark.parametrize(
    ("form", "encoding"),
    [
        pytest.param(form, encoding, id=f"{form.name}-{encoding}")
        for number, form in enumerate(FORMATS)
        for at, encoding in enumerate(ENCODINGS)
        if (number + at) % 3 == 0  # every encoding in each family, some in each format
    ],
)
def test_pixels_are_those_of_the_reference_readers(form: Format, encoding: str, tmp_path: Path) -> None:
    rng = np.random.default_rng([FORMATS.index(form), ENCODINGS.index(encoding)])
    options = dict(form.options)
    if form.write in (_mcap, _foxglove):
        options["chunk_size"] = int(rng.choice([500, 9_000, 60_000, 4_000_000]))
    messages, topics = drive(rng, form.family, encoding)
    path = form.write(tmp_path / "drive", messages, options)
    for topic in topics:
        expected = by_levels([pixels_of(found) for found in recorded(path, form.family, topic)])
        for threads in (1, 4):
            with limited(threads):
                log: Any = logs.open(path, TopicChoice(image=topic))
                log.odometry()
                log.camera()
                frames = log.frames(log.stamps())
                images = list(Execution(threads).map(lambda frame: frame.decode().image, frames))
            assert log.account.losses == []
            assert len(images) == len(expected)
            for image, reference in zip(images, expected, strict=True):
                np.testing.assert_array_equal(image, reference)


def test_colours_of_every_layout_are_those_of_the_picture() -> None:
    """Two halves of one colour each, so that a mosaic and rows of shared chroma hold them, too."""
    picture = np.full((16, 24, 3), (200, 60, 30), np.uint8)
    picture[:, 12:] = 20, 90, 220
    blue_first = picture[..., ::-1]
    alpha = np.full((16, 24, 1), 255, np.uint8)
    mosaic = picture[..., 2].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = picture[::2, ::2, 0], blue_first[1::2, 1::2, 0]
    mosaic[::2, 1::2], mosaic[1::2, ::2] = picture[::2, 1::2, 1], picture[1::2, ::2, 1]
    # ITU-R BT.601, 2.5.3: luma over 16..235, both differences over 16..240
    coded = picture / 255 @ np.array([[65.481, -37.797, 112.0], [128.553, -74.203, -93.786], [24.966, 112.0, -18.214]])
    y, u, v = np.moveaxis(np.rint(coded + np.array([16, 128, 128])).astype(np.uint8), 2, 0)
    uyvy = np.stack([np.where(np.arange(24) % 2, v, u), y], axis=-1)
    raw = {
        "rgb8": picture, "bgr8": blue_first, "rgba8": np.concatenate([picture, alpha], 2),
        "bgra8": np.concatenate([blue_first, alpha], 2), "bayer_rggb8": mosaic, "uyvy": uyvy, "yuyv": uyvy[..., ::-1],
    }  # fmt: skip
    for encoding, pixels in raw.items():
        data = np.ascontiguousarray(pixels).tobytes()
        message = ImageMessage(0, "", encoding, data, False, 24, 16, len(data) // 16, False)
        error = np.abs(rgb(message).astype(int) - picture)[:, [4, 5, 18, 19]]
        assert error.max() <= (3 if encoding in ("uyvy", "yuyv") else 0), encoding
    for suffix in (".png", ".jpg", ".webp"):
        coded = cv2.imencode(suffix, blue_first)[1].tobytes()
        error = np.abs(rgb(ImageMessage(0, "", suffix, coded, True)).astype(int) - picture)[:, [4, 5, 18, 19]]
        assert error.max() <= (0 if suffix == ".png" else 12), suffix
    shades = cv2.imencode(".png", picture[..., 0])[1].tobytes()
    np.testing.assert_array_equal(rgb(ImageMessage(0, "", "png", shades, True)), np.dstack([picture[..., 0]] * 3))


def test_a_folder_keeps_colour_where_it_is_requested(tmp_path: Path) -> None:
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:, :30], picture[:, 30:] = (250, 10, 10), (10, 10, 250)
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture[..., ::-1])
    log = logs.open(tmp_path)
    plain, coloured = (next(log.frames(log.stamps())).decode(colour) for colour in (False, True))
    assert plain.colour is None
    assert coloured.colour is not None
    np.testing.assert_array_equal(coloured.colour, picture)
    np.testing.assert_array_equal(coloured.image, plain.image)
