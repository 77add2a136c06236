from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vplog import logs
from vplog.logs.datasets.gopro import samples_of, streams_of
from vplog.logs.messages.records import FixMessage, ImuMessage

av = pytest.importorskip("av")
PLACE = np.array([48.1, 11.6, 520.0, 3.0, 3.1])
SCALE = np.array([1e7, 1e7, 1e3, 1e3, 1e2])


def item(key: str, kind: str, size: int, content: bytes) -> bytes:
    head = struct.pack(">4scBH", key.encode(), kind.encode(), size, len(content) // size)
    return head + content + bytes(-len(content) % 4)


def tree(key: str, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">4scBH", key.encode(), b"\0", 1, len(content)) + content + bytes(-len(content) % 4)


def packet(second: int, fix: int = 3) -> bytes:
    """One second of a GoPro: 10 fixes that go north, and 20 turns and accelerations in the order Z, X and -Y."""
    rows = PLACE + np.outer(second + np.arange(10) / 10, [1e-5, 0, 0, 0, 0])
    fixes = np.round(rows * SCALE).astype(">i4").tobytes()
    gyro, accel = np.tile([300, 100, -200], (20, 1)).astype(">i2"), np.tile([981, 0, -50], (20, 1)).astype(">i2")
    order = item("ORIN", "c", 1, b"ZXy")
    return tree(
        "DEVC",
        item("DVNM", "c", 1, b"Camera"),
        tree("STRM", order, item("SCAL", "s", 2, struct.pack(">h", 100)), item("ACCL", "s", 6, accel.tobytes())),
        tree("STRM", order, item("SCAL", "s", 2, struct.pack(">h", 1000)), item("GYRO", "s", 6, gyro.tobytes())),
        tree(
            "STRM", item("GPSF", "L", 4, struct.pack(">L", fix)), item("SCAL", "l", 4, SCALE.astype(">i4").tobytes()),
            item("GPS5", "l", 20, fixes),
        ),
    )  # fmt: skip


def video(path: Path, packets: list[bytes]) -> Path:
    """A film with a metadata track, as a GoPro writes it."""
    with av.open(str(path), "w") as container:
        pictures, track = container.add_stream("mpeg4", rate=10), container.add_data_stream("bin_data")
        pictures.width, pictures.height, pictures.pix_fmt = 64, 48, "yuv420p"
        track.time_base = Fraction(1, 1000)
        for number in range(10 * len(packets)):
            grey = np.full((48, 64, 3), 2 * number, np.uint8)
            container.mux(pictures.encode(av.VideoFrame.from_ndarray(grey)))
            if number % 10 == 0:
                one = av.Packet(packets[number // 10])
                one.stream, one.time_base, one.duration = track, track.time_base, 1000
                one.pts = one.dts = 100 * number
                container.mux(one)
        container.mux(pictures.encode())
    return path


def test_a_gopro_video_has_its_fixes_and_its_imu(tmp_path: Path) -> None:
    log = logs.open(video(tmp_path / "GX010001.MP4", [packet(0), packet(1), packet(2)]))
    gps = log.gps()
    assert gps is not None
    assert len(log.stamps()) == 30
    assert len(gps.stamp_ns) == 30
    np.testing.assert_allclose(gps.stamp_ns / 1e9, np.arange(30) / 10, atol=1e-3)
    np.testing.assert_allclose(gps.latitude_deg, 48.1 + 1e-5 * np.arange(30) / 10, atol=2e-7)
    np.testing.assert_allclose(gps.altitude_m, 520.0)
    imu = [topic for topic in log.info().topics if topic.role == "imu"]
    assert [topic.count for topic in imu] == [60]


def test_measurements_have_their_units_and_axes() -> None:
    fixes, imu = streams_of([(0, 10**9, packet(0)), (10**9, 10**9, packet(1, fix=0))])
    first, last = fixes.message(0), fixes.message(19)
    assert isinstance(first, FixMessage)
    assert isinstance(last, FixMessage)
    assert (first.valid, last.valid) == (True, False)
    one = imu.message(3)
    assert isinstance(one, ImuMessage)
    assert one.stamp_ns == 150_000_000
    np.testing.assert_allclose(one.gyro, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(one.accel, [0.0, 0.5, 9.81])


@given(st.data())
def test_damaged_metadata_gives_what_can_be_read(draw: st.DataObject) -> None:
    data = bytearray(packet(0))
    for _ in range(draw.draw(st.integers(1, 8))):
        data[draw.draw(st.integers(0, len(data) - 1))] = draw.draw(st.integers(0, 255))
    damaged = bytes(data[: draw.draw(st.integers(0, len(data)))])
    for one in samples_of(damaged):
        assert len(one.values) <= len(damaged)
    for stream in streams_of([(0, 10**9, damaged)]):
        for row in range(len(stream.stamp_ns)):
            stream.message(row)


def test_a_video_with_a_damaged_track_is_read(tmp_path: Path) -> None:
    log = logs.open(video(tmp_path / "a.mp4", [b"DEVC\0\1\xff\xff", packet(1)[:50], packet(2)]))
    assert len(log.stamps()) == 30
    gps = log.gps()
    assert gps is not None
    assert len(gps.stamp_ns) == 10
