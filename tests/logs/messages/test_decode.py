"""Messages read where their bytes lie are those that rosbags and protobuf wrote; damaged ones are refused."""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from tests.logs.drives import store
from vplog.logs.formats.container import Channel
from vplog.logs.messages.decode import decode, read_poses, stamp_of
from vplog.logs.messages.records import BadMessageError, CalibrationMessage, FixMessage, ImageMessage, PoseMessage

if TYPE_CHECKING:
    from google.protobuf.message import Message as Proto

NAMES, SECONDS, NANOS = st.text(max_size=9), st.integers(0, 2**31 - 1), st.integers(0, 10**9 - 1)


def ros(kind: str, ros_version: int, sec: int, nanosec: int, frame: str, **fields: Any) -> tuple[Channel, bytes]:
    types = store(ros_version).types
    stamp = types["builtin_interfaces/msg/Time"](sec, nanosec)
    header = types["std_msgs/msg/Header"](
        **({"seq": 7} if ros_version == 1 else {}), stamp=stamp, frame_id=frame.replace("\0", "")
    )
    message = types[kind](header=header, **fields)
    encode = store(2).serialize_cdr if ros_version == 2 else store(1).serialize_ros1
    return Channel("/t", kind, "cdr" if ros_version == 2 else "ros1"), bytes(encode(message, kind))


def same(found: Any, expected: Any) -> None:
    assert type(found) is type(expected)
    for name, value in (expected._asdict() if hasattr(expected, "_asdict") else vars(expected)).items():
        actual = getattr(found, name)
        np.testing.assert_array_equal(bytes(actual) if name == "data" else actual, value, err_msg=name)


def refused(channel: Channel, *messages: bytes) -> None:
    for message in messages:
        with pytest.raises(BadMessageError):
            decode(channel, message)


@settings(deadline=None)
@given(st.integers(1, 2), SECONDS, NANOS, NAMES, NAMES, st.binary(max_size=40), st.booleans())
def test_images_of_ros(version: int, sec: int, nanos: int, frame: str, encoding: str, pixels: bytes, raw: bool) -> None:
    encoding, data = encoding.replace("\0", ""), np.frombuffer(pixels, np.uint8)
    expected = ImageMessage(sec * 10**9 + nanos, frame.replace("\0", ""), encoding, pixels, True)
    if raw:
        fields = {"height": 3, "width": 5, "encoding": encoding, "is_bigendian": 1, "step": 9, "data": data}
        channel, message = ros("sensor_msgs/msg/Image", version, sec, nanos, frame, **fields)
        expected = expected._replace(compressed=False, width=5, height=3, step=9, big_endian=True)
    else:
        channel, message = ros(
            "sensor_msgs/msg/CompressedImage", version, sec, nanos, frame, format=encoding, data=data
        )
    same(decode(channel, memoryview(message)), expected)
    assert stamp_of(channel, memoryview(message)) == sec * 10**9 + nanos
    refused(channel, message[:-1] if pixels else message[:-4], message + b"\0\0\0\0", message[:9])


@given(SECONDS, NANOS, st.binary(max_size=40))
def test_video_of_foxglove_as_ros1_has_no_sequence_number(sec: int, nanos: int, packet: bytes) -> None:
    texts = b"".join(struct.pack("<I", len(text)) + text for text in (b"camera", packet, b"h264"))
    channel, message = Channel("/t", "foxglove_msgs/CompressedVideo", "ros1"), struct.pack("<II", sec, nanos) + texts
    same(decode(channel, message), ImageMessage(sec * 10**9 + nanos, "camera", "h264", packet, True))
    assert stamp_of(channel, message) == sec * 10**9 + nanos


@settings(deadline=None)
@given(st.integers(1, 2), SECONDS, NANOS, NAMES, st.integers(-1, 2), st.integers(0, 3))
def test_fixes_of_ros(version: int, sec: int, nanos: int, frame: str, status: int, kind: int) -> None:
    state = store(version).types["sensor_msgs/msg/NavSatStatus"](status=status, service=5)
    fields = {"latitude": 48.1, "longitude": -11.2, "altitude": 520.0, "position_covariance": np.arange(9.0)}
    channel, message = ros(
        "sensor_msgs/msg/NavSatFix", version, sec, nanos, frame, status=state, position_covariance_type=kind, **fields
    )
    covariance = np.arange(9.0).reshape(3, 3) if kind else np.full((3, 3), np.nan)
    stamp_ns, name = sec * 10**9 + nanos, frame.replace("\0", "")
    same(decode(channel, message), FixMessage(stamp_ns, status >= 0, 48.1, -11.2, 520.0, covariance, name))
    refused(channel, message[:-1], message + b"\0\0\0\0", message[:19])


KINDS = (
    "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage",
)  # fmt: skip


def drawn(rng: np.random.Generator, kind: str, version: int) -> Any:
    """A message of random values."""

    def value(node: Nodetype, inner: Any) -> Any:
        if node is Nodetype.NAME:
            return drawn(rng, inner, version)
        if node is Nodetype.BASE:
            number = int(rng.integers(2)) if "int" in inner[0] or inner[0] == "bool" else rng.normal()
            return "".join(rng.choice([*"abcdé/"], rng.integers(9))) if inner[0] == "string" else number
        (node, inner), count = inner
        values = [value(node, inner) for _ in range(count or rng.integers(4))]
        return np.array(values) if node is Nodetype.BASE else values

    fields = {name: value(*described) for name, described in store(version).fielddefs[kind][1]}
    return store(version).types[kind](**fields)


def numbers_of(p: Any, q: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("little", [True, False])
def test_drawn_messages_of_ros(kind: str, version: int, little: bool) -> None:
    rng = np.random.default_rng([version, little])
    channel = Channel("/t", kind, "cdr" if version == 2 else "ros1")
    for _ in range(20):
        m = drawn(rng, kind, version)
        written = (
            store(2).serialize_cdr(m, kind, little_endian=little) if version == 2 else store(1).serialize_ros1(m, kind)
        )
        data, found = bytes(written), decode(channel, written)
        if isinstance(found, CalibrationMessage):
            assert (found.model, found.frame) == (m.distortion_model, m.header.frame_id)
            np.testing.assert_array_equal(found.distortion, m.d if version == 2 else m.D)
            np.testing.assert_array_equal(found.rotation.ravel(), m.r if version == 2 else m.R)
        else:
            expected = m.transforms if isinstance(found, list) else [m]
            assert len(expected) == len(found if isinstance(found, list) else [found])
            for one, pose in zip(expected, found if isinstance(found, list) else [found], strict=True):
                assert isinstance(pose, PoseMessage)
                assert pose.stamp_ns == one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
                assert (pose.frame, pose.child) == (one.header.frame_id, getattr(one, "child_frame_id", ""))
                where = one.transform if hasattr(one, "transform") else one.pose
                inner = getattr(where, "pose", where)
                places = (
                    (inner.translation, inner.rotation)
                    if hasattr(one, "transform")
                    else (inner.position, inner.orientation)
                )
                assert (tuple(pose.position), tuple(pose.quaternion)) == numbers_of(*places)
                if hasattr(where, "covariance"):
                    np.testing.assert_array_equal(pose.covariance, where.covariance)
        refused(channel, data[: -8 if kind != "tf2_msgs/msg/TFMessage" else 3], data + bytes(4))
        for at in rng.integers(
            0, len(data), 20
        ).tolist():  # damage is refused, or reads as something; it raises nothing else
            with suppress(BadMessageError):
                decode(channel, data[:at] + bytes([rng.integers(256)]) + data[at + 1 :])


def made(kind: int, sec: int, nanos: int, frame: str, encoding: str, pixels: bytes) -> Proto:
    if kind == 2:
        message = RawImage(frame_id=frame, encoding=encoding, data=pixels, width=4, height=2**31, step=12)
    else:
        make = CompressedImage if kind else CompressedVideo
        message = make(frame_id=frame, format=encoding, data=pixels)
    message.timestamp.seconds, message.timestamp.nanos = sec, nanos
    return message


@settings(deadline=None)
@given(st.integers(0, 2), SECONDS, NANOS, NAMES, NAMES, st.binary(max_size=300))
def test_images_of_foxglove(kind: int, sec: int, nanos: int, frame: str, encoding: str, pixels: bytes) -> None:
    message = made(kind, sec, nanos, frame, encoding, pixels)
    channel, data = Channel("/t", message.DESCRIPTOR.full_name, "protobuf"), message.SerializeToString()
    expected = ImageMessage(sec * 10**9 + nanos, frame, encoding, pixels, kind < 2)
    if kind == 2:
        expected = expected._replace(width=4, height=2**31, step=12)
    same(decode(channel, memoryview(data)), expected)
    assert stamp_of(channel, memoryview(data)) == sec * 10**9 + nanos


@settings(deadline=None)
@given(st.integers(0, 2), st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=3), st.integers(0, 60))
def test_damaged_images_of_foxglove_are_what_the_whole_message_says(
    kind: int, flips: list[tuple[int, int]], cut: int
) -> None:
    message = made(kind, 1_700_000_000, 5, "camera", "jpeg", b"pixels" * 5)
    channel, data = Channel("/t", message.DESCRIPTOR.full_name, "protobuf"), bytearray(message.SerializeToString())
    for at, value in flips:
        data[at % len(data)] = value
    sample = bytes(data[: len(data) - cut])
    whole: Any = type(message)()
    try:
        whole.ParseFromString(sample)
    except DecodeError:
        return refused(channel, sample)
    with suppress(BadMessageError):  # of a stamp out of range
        found = decode(channel, sample)
        assert isinstance(found, ImageMessage)
        assert (found.data, found.frame) == (whole.data, whole.frame_id)
    return None


def test_of_pixels_in_two_fields_the_last_count() -> None:
    channel, one = Channel("/t", "foxglove.CompressedImage", "protobuf"), CompressedImage(data=b"first")
    found = decode(channel, one.SerializeToString() + CompressedImage(data=b"last").SerializeToString())
    assert isinstance(found, ImageMessage)
    assert found.data == b"last"


@pytest.mark.parametrize("odd", [b"", b"\xff", "other"])
def test_poses_that_are_not_alike_are_read_one_by_one(odd: bytes | str) -> None:
    channel = Channel("/t", "foxglove.PoseInFrame", "protobuf")
    messages = [PoseInFrame(frame_id="odom").SerializeToString() for _ in range(3)]
    found = read_poses(channel, messages)
    assert found is not None
    assert (found.frame, found.poses.shape, found.covariances) == ("odom", (3, 7), None)
    other = PoseInFrame(frame_id=odd).SerializeToString() if isinstance(odd, str) else odd
    assert read_poses(channel, [*messages, other]) is None
