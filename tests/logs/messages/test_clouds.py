"""Point clouds in every encoding become the same scan; what does not fit its bytes is refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from tests.logs.drives import _json, store
from vplog.logs.formats.container import Channel
from vplog.logs.messages.clouds import scan_of
from vplog.logs.messages.decode import decode
from vplog.logs.messages.records import BadMessageError, CloudMessage

STAMP_NS = 1_600_000_000_123_456_789
COUNT = 12
POINTS = np.random.default_rng(2).normal(0, 10, (COUNT, 3)).astype(np.float32)
OFFSETS = np.linspace(0.0, 0.09, COUNT)
OUSTER = np.dtype({"names": ["x", "y", "z", "ring", "t"], "formats": ["<f4", "<f4", "<f4", "<u2", "<u4"],
                   "offsets": [0, 4, 8, 16, 20], "itemsize": 32})  # fmt: skip
ROS_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
FOXGLOVE_TYPES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}


def packed(layout: np.dtype = OUSTER, times: np.ndarray = OFFSETS * 1e9, name: str = "t") -> np.ndarray:
    """(COUNT,) points in a layout, the third without a return."""
    found = np.zeros(COUNT, layout)
    for axis, column in zip("xyz", POINTS.T, strict=True):
        found[axis] = column
    found[name] = times.round() if np.issubdtype(layout[name], np.integer) else times
    found["x"][2] = np.nan
    return found


def columns(layout: Any, types: dict[str, int]) -> list[tuple[str, int, int]]:
    """Name, offset and type of each field."""
    return [(name, layout.fields[name][1], types[layout.fields[name][0].str[1:]]) for name in layout.names]


def by_ros(ros: int, cloud: np.ndarray, height: int = 3, padding: int = 8) -> tuple[Channel, bytes]:
    """An organised cloud whose rows are padded."""
    t, order = store(ros).types, ">" if cloud.dtype["x"].byteorder == ">" else "<"
    stamp = t["builtin_interfaces/msg/Time"](sec=STAMP_NS // 10**9, nanosec=STAMP_NS % 10**9)
    header = t["std_msgs/msg/Header"](**({"seq": 0} if ros == 1 else {}), stamp=stamp, frame_id="os_lidar")
    field = t["sensor_msgs/msg/PointField"]
    fields = [field(name=n, offset=at, datatype=kind, count=1) for n, at, kind in columns(cloud.dtype, ROS_TYPES)]
    rows = cloud.view(np.uint8).reshape(height, -1)
    data = np.pad(rows, [(0, 0), (0, padding)])
    message = t["sensor_msgs/msg/PointCloud2"](
        header=header, height=height, width=COUNT // height, fields=fields, is_bigendian=order == ">",
        point_step=cloud.itemsize, row_step=data.shape[1], data=data.ravel(), is_dense=False,
    )  # fmt: skip
    name = "sensor_msgs/msg/PointCloud2"
    raw = store(1).serialize_ros1(message, name) if ros == 1 else store(2).serialize_cdr(message, name)
    return Channel("/points", "sensor_msgs/PointCloud2", "ros1" if ros == 1 else "cdr"), bytes(raw)


def by_foxglove(encoding: str, cloud: np.ndarray) -> tuple[Channel, bytes]:
    """With the origin a metre above the frame."""
    message = PointCloud(frame_id="os_lidar", point_stride=cloud.itemsize, data=cloud.tobytes())
    message.timestamp.seconds, message.timestamp.nanos = divmod(STAMP_NS, 10**9)
    message.pose.position.z, message.pose.orientation.w = 1.0, 1.0
    for name, offset, kind in columns(cloud.dtype, FOXGLOVE_TYPES):
        message.fields.add(name=name, offset=offset, type=kind)
    raw = message.SerializeToString() if encoding == "protobuf" else json.dumps(_json(message)).encode()
    return Channel("/points", "foxglove.PointCloud", encoding), raw


def read(channel: Channel, raw: bytes) -> Any:
    cloud = decode(channel, raw)
    assert isinstance(cloud, CloudMessage)
    assert (cloud.stamp_ns, cloud.frame) == (STAMP_NS, "os_lidar")
    return scan_of(cloud, 5)


@pytest.mark.parametrize("encoding", ["ros1", "cdr", "big endian", "protobuf", "json"])
def test_every_encoding_gives_the_scan(encoding: str) -> None:
    cloud = packed(OUSTER.newbyteorder(">") if encoding == "big endian" else OUSTER)
    if encoding in ("protobuf", "json"):
        message, above = by_foxglove(encoding, cloud), [0.0, 0.0, 1.0]
    else:
        message, above = by_ros(1 if encoding == "ros1" else 2, cloud), [0.0, 0.0, 0.0]
    scan = read(*message)
    kept = np.arange(COUNT) != 2
    assert scan.stamp_ns == 5
    np.testing.assert_allclose(scan.points, POINTS[kept] + above)
    np.testing.assert_allclose(scan.seconds, OFFSETS[kept], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "kind", "times"),
    [
        ("time", "<f4", OFFSETS - 0.09),  # Velodyne: s up to the stamp
        ("timestamp", "<f8", STAMP_NS / 1e9 + OFFSETS),  # Hesai, RoboSense: s since 1970
        ("timestamp", "<f8", STAMP_NS + OFFSETS * 1e9),  # Livox: ns since 1970
        ("timestamp", "<f8", 77.0 + OFFSETS),  # of a clock of its own
    ],
)
def test_times_of_points_have_the_unit_that_a_turn_takes(name: str, kind: str, times: np.ndarray) -> None:
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, kind)])
    scan = read(*by_ros(2, packed(layout, times, name)))
    expected = np.delete(OFFSETS if name == "timestamp" else times, 2)
    np.testing.assert_allclose(scan.seconds, expected, atol=1e-6)


def test_a_row_step_of_the_whole_cloud_is_none() -> None:
    """As drivers write that take the cloud for one row."""
    cloud = decode(*by_ros(2, packed(), padding=0))
    assert isinstance(cloud, CloudMessage)
    np.testing.assert_array_equal(
        scan_of(cloud._replace(row_step=len(cloud.data)), 5).points, POINTS[np.arange(COUNT) != 2]
    )


def test_equal_times_are_none() -> None:
    assert read(*by_ros(2, packed(times=np.full(COUNT, 5e6)))).seconds is None


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"width": 2**31}, "do not fit its"),
        ({"row_step": 2**31}, "do not fit its"),
        ({"row_step": 16}, "do not fit its"),
        ({"step": 8}, "lies beyond the 8 bytes"),
        ({"fields": [("x", 0, "<f4"), ("y", 4, "<f4")]}, "no fields x, y and z"),
    ],
)
def test_what_does_not_fit_its_bytes_is_refused(change: dict[str, Any], why: str) -> None:
    cloud = decode(*by_ros(2, packed()))
    assert isinstance(cloud, CloudMessage)
    with pytest.raises(BadMessageError, match=why):
        scan_of(cloud._replace(**change), 0)
