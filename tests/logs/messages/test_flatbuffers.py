"""Foxglove messages as FlatBuffers, written with Foxglove's own builders."""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.logs.drives import HEIGHT, WIDTH, D, Drive, K, foxglove_messages, png, write_raw
from vplog import logs
from vplog.logs.formats.container import Channel
from vplog.logs.messages import flatbuffers as parser
from vplog.logs.messages.decode import decode
from vplog.logs.messages.records import BadMessageError

if TYPE_CHECKING:
    from pathlib import Path

flatbuffers = pytest.importorskip("flatbuffers", reason="foxglove-schemas-flatbuffer is not installed")
schemas = pytest.importorskip("foxglove_schemas_flatbuffer", reason="foxglove-schemas-flatbuffer is not installed")


def build(builder: Any, message: Any) -> int:
    """The offset of a table with the values of a protobuf message, by the setters of the type's own module."""
    import importlib

    kind = message.DESCRIPTOR.name
    module = importlib.import_module(f"foxglove_schemas_flatbuffer.{kind}")
    values: dict[str, Any] = {}
    for field, value in message.ListFields():
        name = "".join(part[:1].upper() + part[1:] for part in field.name.split("_"))
        if field.is_repeated and field.message_type:
            offsets = [build(builder, item) for item in value]
            getattr(module, f"{kind}Start{name}Vector")(builder, len(offsets))
            for offset in reversed(offsets):
                builder.PrependUOffsetTRelative(offset)
            values[name] = builder.EndVector()
        elif field.is_repeated:
            values[name] = builder.CreateNumpyVector(np.array(value, np.float64))
        elif isinstance(value, bytes):
            values[name] = builder.CreateByteVector(value)
        elif isinstance(value, str):
            values[name] = builder.CreateString(value)
        elif field.message_type and field.message_type.name != "Timestamp":
            values[name] = build(builder, value)
        else:
            values[name] = value
    getattr(module, f"{kind}Start")(builder)
    for name, value in values.items():
        if name == "Timestamp":
            from foxglove_schemas_flatbuffer.Time import CreateTime

            value = CreateTime(builder, value.seconds, value.nanos)  # noqa: PLW2901 (a struct is built in its table)
        getattr(module, f"{kind}Add{name}")(builder, value)
    return getattr(module, f"{kind}End")(builder)


def flat(message: Any) -> bytes:
    builder = flatbuffers.Builder(64)
    builder.Finish(build(builder, message))
    return bytes(builder.Output())


def written(path: Path) -> Path:
    found = foxglove_messages(Drive())
    return write_raw(path, [(m.topic, m.type, "flatbuffer", m.stamp_ns, flat(m.message)) for m in found])


def test_a_drive_in_flatbuffers_is_the_drive(tmp_path: Path) -> None:
    drive = Drive()
    log = logs.open(written(tmp_path / "drive.mcap"))
    np.testing.assert_array_equal(log.stamps(), drive.stamp_ns)
    np.testing.assert_array_equal([frame.decode().image for frame in log.frames(log.stamps())], drive.images)
    camera = log.camera()
    np.testing.assert_array_equal(camera.matrix, K)
    np.testing.assert_array_equal(camera.distortion, D)
    np.testing.assert_allclose(camera.body_from_camera, drive.body_from_camera, atol=1e-12)
    odometry, gps = log.odometry(), log.gps()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, drive.odom_from_body, atol=1e-12)
    assert gps is not None
    np.testing.assert_array_equal(gps.latitude_deg, drive.latitude)


def test_every_type_agrees_with_protobuf() -> None:
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.Pose_pb2 import Pose
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    raw = RawImage(frame_id="c", width=WIDTH, height=HEIGHT, encoding="mono8", step=WIDTH, data=bytes(WIDTH * HEIGHT))
    odometry = Odometry(frame_id="odom", body_frame_id="base", pose_covariance=np.arange(36.0))
    odometry.velocity_covariance.extend(np.arange(36.0) / 10)
    odometry.pose.position.x, odometry.pose.orientation.w, odometry.timestamp.seconds = 3.0, 1.0, 7
    several = FrameTransforms(transforms=[m.message for m in foxglove_messages(Drive())[:2]])
    poses = PosesInFrame(frame_id="odom", poses=[Pose(), odometry.pose])
    cloud = PointCloud(frame_id="lidar", pose=odometry.pose, point_stride=4, data=b"01234567")
    cloud.fields.add(name="x", offset=2, type=4)
    messages = [m.message for m in foxglove_messages(Drive())] + [raw, odometry, several, poses, cloud]
    for message in messages:
        name = message.DESCRIPTOR.full_name
        by_flat = decode(Channel("/t", name, "flatbuffer"), flat(message))
        by_proto = decode(Channel("/t", name, "protobuf"), message.SerializeToString())
        if isinstance(by_flat, list):
            assert isinstance(by_proto, list)
            pairs = list(zip(by_flat, by_proto, strict=True))
        else:
            pairs = [(by_flat, by_proto)]
        for a, b in pairs:
            for key, value in (b._asdict() if isinstance(b, tuple) else vars(b)).items():
                expected = bytes(value) if isinstance(value, memoryview) else value
                np.testing.assert_array_equal(getattr(a, key), expected, err_msg=f"{name}.{key}")


def test_a_vector_longer_than_the_message_is_an_error() -> None:
    """Not what there is of it."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    data = bytearray(flat(CompressedImage(frame_id="camera", data=b"0123456789", format="png")))
    at = data.index(b"0123456789")
    assert data[at - 4 : at] == (10).to_bytes(4, "little")
    data[at - 4 : at] = (len(data)).to_bytes(4, "little")
    with pytest.raises(BadMessageError, match="buffer is smaller than requested size"):
        decode(Channel("/t", "foxglove.CompressedImage", "flatbuffer"), bytes(data))


def test_entries_that_share_their_bytes_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """One transform with a long name, a thousand times over."""
    from foxglove_schemas_flatbuffer import FrameTransform, FrameTransforms

    monkeypatch.setattr(parser, "_MOST_BYTES", 2**23)
    builder = flatbuffers.Builder(2**17)
    name = builder.CreateString("x" * 2**16)
    FrameTransform.Start(builder)
    FrameTransform.AddParentFrameId(builder, name)
    one = FrameTransform.End(builder)
    for count, few in ((100, True), (1000, False)):
        FrameTransforms.StartTransformsVector(builder, count)
        for _ in range(count):
            builder.PrependUOffsetTRelative(one)
        entries = builder.EndVector()
        FrameTransforms.Start(builder)
        FrameTransforms.AddTransforms(builder, entries)
        found = FrameTransforms.End(builder)
        builder.Finish(found)
        data, builder.finished = bytes(builder.Output()), False
        channel = Channel("/t", "foxglove.FrameTransforms", "flatbuffer")
        with nullcontext() if few else pytest.raises(BadMessageError, match="its transforms take more than 8 MB"):
            poses = decode(channel, data)
            assert isinstance(poses, list)
            assert len(poses) == count


@given(st.binary(max_size=120), st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4))
def test_damage_is_a_known_error_or_a_message(junk: bytes, flips: list[tuple[int, int]]) -> None:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    channel = Channel("/t", "foxglove.CompressedImage", "flatbuffer")
    data = bytearray(flat(CompressedImage(frame_id="camera", data=png(np.zeros((4, 4), np.uint8)), format="png")))
    for at, value in flips:
        data[at % len(data)] = value
    for sample in (junk, bytes(data), bytes(data[: len(junk)])):
        try:
            assert decode(channel, sample)
        except BadMessageError as error:
            assert str(error)
