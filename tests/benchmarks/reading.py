"""Reading a drive: as fast as a bare loop over its container, in memory that does not grow with it."""

from __future__ import annotations

import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from tests.benchmarks.measure import Figure, in_turns, one_thread
from vplog import logs
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.run.keyframes import KeyframeSettings, select_keyframes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Ints

REAL = (("kitti00/kitti00.mcap", "/cam0/image_raw/compressed"), ("gardens_day_left.mcap", "/front/image"))
"""JPEG in ROS 2 messages without compression, and in Foxglove's protobuf with zstd."""
SMALL_GB, LARGE_GB = 0.5, 5.0
"""Sizes of the logs whose peaks of memory are compared."""
LONGER = 10
"""Times that the last real drive is repeated: it is 0.1 s of work on four cores, of which opening it is much."""
_SIZE = (1080, 1920)
"""px, height and width of a synthetic image. Odometry is kept, in 0.4 kB a sample: with images ten times as small it,
not the images, would be what grows."""
_RATE = 5
"""Odometry messages for each image: 50 Hz to 10 Hz."""
_PAUSE_NS = 10**9
"""ns between the end of a drive and its repetition."""
_STAMPED: dict[str, Any] = {"foxglove.CompressedImage": CompressedImage, "foxglove.PoseInFrame": PoseInFrame}
_SPARE_GB = 2.0
"""Disk that is left free beside the larger log."""


def reading(rounds: int, speed_bar: float, growth_bar: float, sizes_gb: tuple[float, float]) -> Iterator[Figure]:
    """Speed on real drives, where there are any, and growth of the peak of memory between two sizes of log.

    That on a longer log is told beside: of a short one, opening it counts as much as reading it.
    """
    folder = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "drives"
    for name, topic in REAL:
        if (folder / name).exists():
            for threads in dict.fromkeys((1, os.cpu_count() or 1)):
                yield speed(folder / name, topic, threads, rounds, speed_bar)
    with tempfile.TemporaryDirectory() as scratch:
        name, topic = REAL[-1]
        if (folder / name).exists():
            longer = Path(scratch) / f"{Path(name).stem}_{LONGER}_times.mcap"
            repeat_drive(folder / name, longer, LONGER)
            yield speed(longer, topic, os.cpu_count() or 1, rounds, None)
            longer.unlink()
        room = os.statvfs(scratch)
        if room.f_bavail * room.f_frsize / 1e9 >= sizes_gb[1] + _SPARE_GB:
            yield growth(Path(scratch), sizes_gb, growth_bar)


def speed(path: Path, topic: str, threads: int, rounds: int, bar: float | None) -> Figure:
    """Frames per second from an unopened file to decoded keyframes, to those of mcap's reader and OpenCV alone.

    Ours also tells the kind of file, chooses topics and reads odometry, calibration and transforms. Both decode the
    same keyframes with as many threads, but the bare loop is told which they are, and so starts at once. One thread is
    measured in the processor's time.
    """
    stamps = _keyframes(path)
    wanted = set(stamps.tolist())

    def ours() -> int:
        with limited(threads):
            log = logs.open(path)
            log.odometry()
            decoded = Execution(threads).map(lambda frame: frame.decode().image, log.frames(stamps), ahead=2)
            return sum(image.size for image in decoded)

    def bare() -> int:
        with path.open("rb") as file:
            found = (m.data for _, _, m in make_reader(file).iter_messages(topics=[topic]) if _stamp(m) in wanted)
            return sum(image.size for image in Execution(threads).map(_jpeg, found, ahead=2))

    def _stamp(message: object) -> int:
        return stamp_of.get((message.log_time, len(message.data)), -1)  # type: ignore[attr-defined]

    stamp_of = _stamps_by_log_time(path, topic, stamps)
    assert ours() == bare()
    with one_thread():
        turns = in_turns(bare, ours, rounds, time.process_time if threads == 1 else time.perf_counter)
    theirs, mine = (len(stamps) / seconds for seconds in turns.medians)
    facts = {"keyframes": len(stamps), "threads": threads, "vplog_fps": round(mine, 1), "bare_fps": round(theirs, 1)}
    return Figure(
        f"reading and decoding fps / mcap and OpenCV fps, {path.name}, {threads} threads", turns.ratio, bar,
        at_most=False, facts=facts,
    )  # fmt: skip


def repeat_drive(source: Path, target: Path, times: int) -> None:
    """A drive of Foxglove's protobuf messages several times in a row: the same frames in chunks of the same size."""
    with source.open("rb") as file:
        found = list(make_reader(file).iter_messages())
    span_ns = found[-1][2].log_time - found[0][2].log_time + _PAUSE_NS
    with target.open("wb") as file:
        writer = Writer(file, chunk_size=2**20, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, _ in found:
            if schema is not None and channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
        for shift_ns in range(0, times * span_ns, span_ns):
            for schema, channel, message in found:
                assert schema is not None
                moved = _STAMPED[schema.name].FromString(message.data)
                moved.timestamp.FromNanoseconds(moved.timestamp.ToNanoseconds() + shift_ns)
                time_ns = message.log_time + shift_ns
                writer.add_message(channels[channel.id], time_ns, moved.SerializeToString(), time_ns)
        writer.finish()


def growth(folder: Path, sizes_gb: tuple[float, float], bar: float, rounds: int = 3) -> Figure:
    """Peak memory of reading a large log to that of a small one, each time in a process of its own."""
    peaks = []
    for size_gb in sizes_gb:
        path = folder / "drive.mcap"
        write_drive(path, size_gb)
        peaks.append(statistics.median(_peak_mb(path) for _ in range(rounds)))
        path.unlink()
    facts = {f"peak_mb_at_{size:g}_gb": round(peak, 1) for size, peak in zip(sizes_gb, peaks, strict=True)}
    name = f"peak memory reading {sizes_gb[1]:g} GB / {sizes_gb[0]:g} GB"
    return Figure(name, peaks[1] / peaks[0], bar, at_most=True, facts=facts)


def write_drive(path: Path, size_gb: float) -> None:
    """A drive on a straight line: raw images at 10 Hz and odometry at 50 Hz, as ROS 2 writes them, in 4 MB chunks."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](0, 0), "camera")
    pixels = np.random.default_rng(0).integers(0, 256, _SIZE, np.uint8)
    image = t["sensor_msgs/msg/Image"](header, *_SIZE, "mono8", 0, _SIZE[1], pixels.ravel())
    zero = t["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = t["geometry_msgs/msg/TwistWithCovariance"](t["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36))
    kinds = {"/camera/image": "sensor_msgs/msg/Image", "/odom": "nav_msgs/msg/Odometry"}
    data = bytes(store.serialize_cdr(image, kinds["/camera/image"]))
    frames = max(round(size_gb * 1e9 / len(data)), 1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4 * 2**20, compression=CompressionType.NONE)
        writer.start("ros2")
        channels = {
            topic: writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
            for topic, kind in kinds.items()
        }
        for frame in range(frames * _RATE):
            stamp_ns = 10**18 + frame * 20_000_000
            stamp = struct.pack("<iI", *divmod(stamp_ns, 10**9))
            if frame % _RATE == 0:
                writer.add_message(channels["/camera/image"], stamp_ns, data[:4] + stamp + data[12:], stamp_ns)
            pose = t["geometry_msgs/msg/Pose"](
                t["geometry_msgs/msg/Point"](0.02 * frame, 0.0, 0.0),
                t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            )
            with_covariance = t["geometry_msgs/msg/PoseWithCovariance"](pose, np.eye(6).ravel() * 1e-4)
            moved = t["nav_msgs/msg/Odometry"](header, "base_link", with_covariance, twist)
            moved_data = bytes(store.serialize_cdr(moved, kinds["/odom"]))
            writer.add_message(channels["/odom"], stamp_ns, moved_data[:4] + stamp + moved_data[12:], stamp_ns)
        writer.finish()


_READ = """
import sys
from pathlib import Path
from vplog import logs
log = logs.open(Path(sys.argv[1]))
log.odometry()
for frame in log.frames(log.stamps()[::5]):
    frame.decode()
status = Path("/proc/self/status").read_text()
print(int(status.partition("VmHWM:")[2].split()[0]) / 1024)
"""
"""Opens a log, reads its odometry, decodes every fifth frame, and tells its peak in MB. Linux has it in kB; what
getrusage tells would be the peak of the process that started this one, where that is larger."""


def _peak_mb(path: Path) -> float:
    done = subprocess.run([sys.executable, "-c", _READ, str(path)], check=True, capture_output=True, text=True)
    return float(done.stdout)


def _keyframes(path: Path) -> Ints:
    log = logs.open(path)
    odometry = log.odometry()
    assert odometry is not None
    return select_keyframes(log.name, log.stamps(), odometry, KeyframeSettings())[0].stamp_ns


def _stamps_by_log_time(path: Path, topic: str, stamps: Ints) -> dict[tuple[int, int], int]:
    """Header stamps of the images by log time and size of their messages: the bare loop need not decode them."""
    with path.open("rb") as file:
        messages = [(m.log_time, len(m.data)) for _, _, m in make_reader(file).iter_messages(topics=[topic])]
    every = logs.open(path).stamps()
    assert len(every) == len(messages)
    return {
        key: int(stamp_ns) for key, stamp_ns in zip(messages, every, strict=True) if stamp_ns in set(stamps.tolist())
    }


def _jpeg(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8, offset=data.index(b"\xff\xd8\xff")), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image
