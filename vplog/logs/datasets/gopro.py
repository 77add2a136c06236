"""Satellite fixes and IMU of GoPro videos, from the metadata track in GPMF.

GPMF is a tree of items: a key of four letters, a type, the size of an element, the number of elements and the data,
padded to four bytes (github.com/gopro/gpmf-parser). Each packet has the samples of about a second, evenly spaced.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.logs.datasets.streams import Stream
from vplog.logs.formats.container import Channel
from vplog.logs.messages.records import FixMessage, ImuMessage

HANDLER = "GoPro MET"
"""Name of the track in the file."""
_ITEM = struct.Struct(">4scBH")
_NUMBERS = {b"b": ">i1", b"B": ">u1", b"s": ">i2", b"S": ">u2", b"l": ">i4", b"L": ">u4", b"f": ">f4", b"d": ">f8"}
"""NumPy's types of the types that measurements and their scales have."""
_FIX_2D = 2
"""GPSF, the kind of fix: 0 for none, 2 without and 3 with altitude."""
_AXES = {"X": 0, "Y": 1, "Z": 2}
_FRAME = "gopro"


class Samples(NamedTuple):
    """Consecutive measurements of one sensor, from one packet of the metadata track."""

    key: str
    """`GPS5`, `GYRO` or `ACCL`."""
    values: Floats
    """(K, 5) latitude and longitude in degrees, altitude in m, and speeds in m/s; (K, 3) rad/s or m/s^2."""
    valid: bool
    """False for GPS without a fix."""


def streams_of(packets: Iterable[tuple[int, int, bytes]]) -> list[Stream]:
    """Return the streams `gps` and `imu` of the track's packets; none of what it does not have.

    Each packet is its stamp and its duration in ns, and its data. Damaged packets end where they cannot be read on.
    """
    found: dict[str, list[Samples]] = {}
    times: dict[str, list[Ints]] = {}
    for stamp_ns, duration_ns, data in packets:
        for one in samples_of(data):
            count = len(one.values)
            found.setdefault(one.key, []).append(one)
            times.setdefault(one.key, []).append(stamp_ns + duration_ns * np.arange(count, dtype=np.int64) // count)
    stamps_ns = {key: np.concatenate(parts) for key, parts in times.items()}
    values = {key: np.concatenate([one.values for one in parts]) for key, parts in found.items()}
    result = []
    if "GPS5" in found:
        valid = np.repeat([one.valid for one in found["GPS5"]], [len(one.values) for one in found["GPS5"]])
        result.append(_fixes(stamps_ns["GPS5"], values["GPS5"], valid))
    if "GYRO" in found and "ACCL" in found:
        result.append(_imu(stamps_ns["GYRO"], values["GYRO"], stamps_ns["ACCL"], values["ACCL"]))
    return result


def samples_of(data: bytes) -> Iterator[Samples]:
    """Yield the measurements in the data of one packet."""
    for key, kind, _, content in _items(data):
        if key == b"DEVC" and kind == b"\0":
            for inner, inner_kind, _, stream in _items(content):
                if inner == b"STRM" and inner_kind == b"\0":
                    yield from _samples_of_stream(stream)


def _items(data: bytes) -> Iterator[tuple[bytes, bytes, int, bytes]]:
    """Key, type, size of an element, and content of each item."""
    at = 0
    while at + _ITEM.size <= len(data):
        key, kind, size, count = _ITEM.unpack_from(data, at)
        stop = at + _ITEM.size + size * count
        if stop > len(data):
            return
        yield key, kind, size, data[at + _ITEM.size : stop]
        at = stop + -stop % 4


def _samples_of_stream(stream: bytes) -> Iterator[Samples]:
    known = {key.decode("latin1"): (kind, size, content) for key, kind, size, content in _items(stream)}
    for key, columns in (("GPS5", 5), ("GYRO", 3), ("ACCL", 3)):
        scale, values = _numbers(known.get("SCAL")), _numbers(known.get(key))
        if len(scale) not in (1, columns) or not len(values) or len(values) % columns or not scale.all():
            continue
        values = values.reshape(-1, columns) / scale
        order = known["ORIN"][2].decode("latin1") if "ORIN" in known else ""
        if sorted(order.upper()) == sorted(_AXES) and columns == len(_AXES):  # lower case is a negative axis
            axes = [_AXES[letter] for letter in order.upper()]
            values[:, axes] = values * [1.0 if letter.isupper() else -1.0 for letter in order]
        yield Samples(key, values, not len(fix := _numbers(known.get("GPSF"))) or fix[0] >= _FIX_2D)


def _numbers(item: tuple[bytes, int, bytes] | None) -> Floats:
    """(K,) float64 of an item; empty if it is not there, or not of numbers."""
    kind, size, content = item or (b"", 0, b"")
    dtype = np.dtype(_NUMBERS.get(kind, ">u1"))
    if kind not in _NUMBERS or size == 0 or size % dtype.itemsize:
        return np.zeros(0)
    return np.frombuffer(content, dtype).astype(np.float64)


def _fixes(stamp_ns: Ints, values: Floats, valid: Bools) -> Stream:
    def message(row: int) -> FixMessage:
        latitude, longitude, altitude = values[row, :3].tolist()
        fixed, unknown = bool(valid[row]), np.zeros((3, 3))
        return FixMessage(int(stamp_ns[row]), fixed, latitude, longitude, altitude, unknown, _FRAME)

    return Stream(Channel("gps", "sensor_msgs/NavSatFix", "ros1"), stamp_ns, message)


def _imu(stamp_ns: Ints, gyro: Floats, accel_ns: Ints, accel: Floats) -> Stream:
    """The gyroscope's samples with the accelerations at their stamps."""
    at_stamps = np.stack([np.interp(stamp_ns, accel_ns, column) for column in accel.T], axis=1)

    def message(row: int) -> ImuMessage:
        return ImuMessage(int(stamp_ns[row]), _FRAME, gyro[row].tolist(), at_stamps[row].tolist())

    return Stream(Channel("imu", "sensor_msgs/Imu", "ros1"), stamp_ns, message)
