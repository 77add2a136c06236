"""Messages read where their bytes lie are those that the general decoders read, and what is odd is left to them."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.logs.drives import store
from vplog.logs.formats.container import Channel
from vplog.logs.messages.decode import decode_generally, stamp_of
from vplog.logs.messages.image_views import read_image
from vplog.logs.messages.navsatfix import read_fix
from vplog.logs.messages.odometry import read_poses
from vplog.logs.messages.records import BadMessageError

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
    assert found is not None
    assert type(found) is type(expected)
    for name, value in (expected._asdict() if hasattr(expected, "_asdict") else vars(expected)).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


@settings(deadline=None)
@given(st.integers(1, 2), SECONDS, NANOS, NAMES, NAMES, st.binary(max_size=40), st.booleans())
def test_images_of_ros(version: int, sec: int, nanos: int, frame: str, encoding: str, pixels: bytes, raw: bool) -> None:
    encoding, data = encoding.replace("\0", ""), np.frombuffer(pixels, np.uint8)
    if raw:
        fields = {"height": 3, "width": 5, "encoding": encoding, "is_bigendian": 1, "step": 9, "data": data}
        channel, message = ros("sensor_msgs/msg/Image", version, sec, nanos, frame, **fields)
    else:
        channel, message = ros(
            "sensor_msgs/msg/CompressedImage", version, sec, nanos, frame, format=encoding, data=data
        )
    expected = decode_generally(channel, message)
    same(read_image(channel, memoryview(message)), expected)
    assert stamp_of(channel, memoryview(message)) == sec * 10**9 + nanos
    for other in (message[:-1], message + b"\0", message[:9]):
        assert read_image(channel, other) is None


@settings(deadline=None)
@given(st.integers(1, 2), SECONDS, NANOS, NAMES, st.integers(-1, 2), st.integers(0, 3))
def test_fixes_of_ros(version: int, sec: int, nanos: int, frame: str, status: int, kind: int) -> None:
    state = store(version).types["sensor_msgs/msg/NavSatStatus"](status=status, service=5)
    fields = {"latitude": 48.1, "longitude": -11.2, "altitude": 520.0, "position_covariance": np.arange(9.0)}
    channel, message = ros(
        "sensor_msgs/msg/NavSatFix", version, sec, nanos, frame, status=state, position_covariance_type=kind, **fields
    )
    same(read_fix(channel, message), decode_generally(channel, message))
    for other in (message[:-1], message + b"\0", message[:19]):
        assert read_fix(channel, other) is None


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
    same(read_image(channel, memoryview(data)), decode_generally(channel, data))
    assert stamp_of(channel, memoryview(data)) == sec * 10**9 + nanos


@settings(deadline=None)
@given(st.integers(0, 2), st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=3), st.integers(0, 60))
def test_damaged_images_of_foxglove_are_what_the_general_decoder_says(
    kind: int, flips: list[tuple[int, int]], cut: int
) -> None:
    message = made(kind, 1_700_000_000, 5, "camera", "jpeg", b"pixels" * 5)
    channel, data = Channel("/t", message.DESCRIPTOR.full_name, "protobuf"), bytearray(message.SerializeToString())
    for at, value in flips:
        data[at % len(data)] = value
    sample = bytes(data[: len(data) - cut])
    try:
        expected = decode_generally(channel, sample)
    except BadMessageError:
        with suppress(BadMessageError):
            assert read_image(channel, sample) is None
        return
    found = read_image(channel, sample)
    if found is not None:
        same(found, expected)


def test_pixels_in_two_fields_are_left_to_the_general_decoder() -> None:
    """Of a field that comes twice, the last one counts."""
    channel, one = Channel("/t", "foxglove.CompressedImage", "protobuf"), CompressedImage(data=b"first")
    assert read_image(channel, one.SerializeToString() + CompressedImage(data=b"last").SerializeToString()) is None


@pytest.mark.parametrize("odd", [b"", b"\xff", "other"])
def test_poses_that_are_not_alike_are_read_one_by_one(odd: bytes | str) -> None:
    channel = Channel("/t", "foxglove.PoseInFrame", "protobuf")
    messages = [PoseInFrame(frame_id="odom").SerializeToString() for _ in range(3)]
    found = read_poses(channel, messages)
    assert found is not None
    assert (found.frame, found.poses.shape, found.covariances) == ("odom", (3, 7), None)
    other = PoseInFrame(frame_id=odd).SerializeToString() if isinstance(odd, str) else odd
    assert read_poses(channel, [*messages, other]) is None
