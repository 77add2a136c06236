"""Satellite fixes of every kind of message, as their drivers write them."""

from __future__ import annotations

import json
from functools import cache, reduce
from operator import xor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.LocationFixes_pb2 import LocationFixes
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.logs.drives import LATENCY_NS, START_NS, _json, write_raw
from tests.logs.messages.test_flatbuffers import flat
from vplog import logs
from vplog.logs import TopicChoice
from vplog.logs.formats.container import Channel
from vplog.logs.messages.decode import decode
from vplog.logs.messages.records import BadMessageError, FixMessage

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from vplog.data import Gps

    Messages = list[tuple[str, str, str, int, bytes]]

COUNT = 40
STAMPS = START_NS + 200_000_000 * np.arange(COUNT)
LATITUDE = -33.9 + 2e-5 * np.arange(COUNT)
LONGITUDE = -151.2 + 1e-5 * np.arange(COUNT)
ALTITUDE_M = 40.0 + 0.1 * np.arange(COUNT)
GEOID_M = 22.5
_STATUS = """std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
_BEFORE = "latitude longitude altitude track speed climb pitch roll dip time gdop pdop hdop vdop tdop err err_horz"
_BEHIND = "err_vert err_track err_speed err_climb err_time err_pitch err_roll err_dip"


def message(store: Any, package: str, number: int, rng: np.random.Generator, known: bool) -> tuple[Any, str]:
    """A GPSFix of a package, with as many satellites as there are by chance."""
    types, kind = store.types, f"{package}/msg/GPSFix"
    ros1 = {"seq": 0} if package == "gps_common" else {}
    stamp = types["builtin_interfaces/msg/Time"](sec=int(STAMPS[number] // 10**9), nanosec=int(STAMPS[number] % 10**9))
    header = types["std_msgs/msg/Header"](**ros1, stamp=stamp, frame_id="gps" * int(rng.integers(3)))
    used, visible = (rng.integers(0, 99, rng.integers(12)).astype(np.int32) for _ in range(2))
    status = types[f"{package}/msg/GPSStatus"](
        header=header, satellites_used=len(used), satellite_used_prn=used, satellites_visible=len(visible),
        **{f"satellite_visible_{name}": visible for name in ("prn", "z", "azimuth", "snr")},
        status=-1 if number == 3 else 19, motion_source=0, orientation_source=0, position_source=1,
    )  # fmt: skip
    values = dict.fromkeys(f"{_BEFORE} {_BEHIND}".split(), 0.0)
    values |= {"latitude": LATITUDE[number], "longitude": LONGITUDE[number], "altitude": ALTITUDE_M[number]}
    values |= {"err_horz": 4.896, "err_vert": 7.84}
    covariance = np.diag([1.0, 4.0, 9.0]).ravel() * known
    values = {name: float(value) for name, value in values.items()}
    kinds = {"position_covariance": covariance, "position_covariance_type": 2 if known else 0}
    return types[kind](header=header, status=status, **values, **kinds), kind


def gps_fixes(package: str, encoding: str, known: bool) -> Messages:
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)
    numbers = "\n".join(f"float64 {name}" for name in f"{_BEFORE} {_BEHIND}".split())
    store.register(get_types_from_msg(_STATUS, f"{package}/msg/GPSStatus"))
    fields = f"std_msgs/Header header\n{package}/GPSStatus status\n{numbers}\n"
    text = f"{fields}float64[9] position_covariance\nuint8 position_covariance_type\n"
    store.register(get_types_from_msg(text, f"{package}/msg/GPSFix"))
    rng, found = np.random.default_rng(2), []
    for number in range(COUNT):
        one, kind = message(store, package, number, rng, known)
        data = store.serialize_ros1(one, kind) if encoding == "ros1" else store.serialize_cdr(one, kind)
        name = kind.replace("/msg", "") if encoding == "ros1" else kind
        found.append(("/gps", name, encoding, int(STAMPS[number]) + LATENCY_NS, bytes(data)))
    return found


def location_fixes(encoding: str) -> Messages:
    """Messages of four fixes each."""
    found: Messages = []
    for first in range(0, COUNT, 4):
        many = LocationFixes()
        for number in range(first, first + 4):
            one = many.fixes.add()
            one.timestamp.seconds, one.timestamp.nanos = divmod(int(STAMPS[number]), 10**9)
            one.latitude, one.longitude, one.altitude = LATITUDE[number], LONGITUDE[number], ALTITUDE_M[number]
            one.position_covariance.extend(np.diag([1.0, 4.0, 9.0]).ravel().tolist())
            one.position_covariance_type = LocationFix.DIAGONAL_KNOWN
        data = flat(many) if encoding == "flatbuffer" else many.SerializeToString()
        data = json.dumps(_json(many)).encode() if encoding == "json" else data
        found.append(("/gps", "foxglove.LocationFixes", encoding, int(STAMPS[first + 3]) + LATENCY_NS, data))
    return found


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n"


def minutes(value: float, digits: int) -> str:
    whole, rest = divmod(abs(value), 1)
    return f"{int(whole):0{digits}d}{60 * rest:010.7f}"


def sentences(number: int, talker: str, kinds: str) -> list[str]:
    """What a receiver sends of one fix."""
    south, west = minutes(LATITUDE[number], 2), minutes(LONGITUDE[number], 3)
    place, time = f"{south},S,{west},W", "120000.00"
    every = {
        "GSV": f"{talker}GSV,1,1,01,05,40,083,46",
        "RMC": f"{talker}RMC,{time},A,{place},10.0,45.0,010120,,,A",
        "GLL": f"{talker}GLL,{place},{time},A,A",
        "GNS": f"{talker}GNS,{time},{place},AN,08,2.0,{ALTITUDE_M[number] - GEOID_M:.3f},{GEOID_M},,",
        "GGA": f"{talker}GGA,{time},{place},4,08,2.0,{ALTITUDE_M[number] - GEOID_M:.3f},M,{GEOID_M},M,,",
    }
    return [sentence(every[kind]) for kind in kinds.split()]


def nmea(talker: str, kinds: str) -> Messages:
    store = get_typestore(Stores.ROS2_JAZZY)
    name = "nmea_msgs/msg/Sentence"
    store.register(get_types_from_msg("std_msgs/Header header\nstring sentence\n", name))
    found: Messages = []
    for number in range(COUNT):
        for late, text in enumerate(sentences(number, talker, kinds)):
            stamp_ns = int(STAMPS[number]) + late * 1_000_000
            stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="gps")
            data = store.serialize_cdr(store.types[name](header=header, sentence=text), name)
            found.append(("/nmea", name, "cdr", stamp_ns + LATENCY_NS, bytes(data)))
    return found


def gps_of(folder: Path, messages: Messages, **choice: Any) -> Gps:
    log = logs.open(write_raw(folder / "drive.mcap", messages), TopicChoice(**choice))
    found = log.gps()
    assert found is not None
    return found


KINDS: dict[str, Callable[[], Messages]] = {
    "ROS 1": lambda: gps_fixes("gps_common", "ros1", True),
    "ROS 2": lambda: gps_fixes("gps_msgs", "cdr", True),
    "errors alone": lambda: gps_fixes("gps_common", "ros1", False),
    "protobuf": lambda: location_fixes("protobuf"),
    "json": lambda: location_fixes("json"),
    "flatbuffer": lambda: location_fixes("flatbuffer"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_fixes(kind: str, tmp_path: Path) -> None:
    messages = KINDS[kind]()
    gps = gps_of(tmp_path, messages)
    rows = np.arange(COUNT) != 3 if "GPSFix" in messages[0][1] else np.ones(COUNT, bool)  # the fourth has no fix
    assert gps.stamp_ns.tolist() == STAMPS[rows].tolist()
    np.testing.assert_allclose(gps.latitude_deg, LATITUDE[rows], atol=1e-12)
    np.testing.assert_allclose(gps.longitude_deg, LONGITUDE[rows], atol=1e-12)
    np.testing.assert_allclose(gps.altitude_m, ALTITUDE_M[rows])
    expected = np.diag([4.0, 4.0, 16.0]) if kind == "errors alone" else np.diag([1.0, 4.0, 9.0])
    np.testing.assert_allclose(gps.covariance[0], expected)


NMEA = {
    "all of a receiver": ("GN", "GSV RMC GLL GNS GGA", 0.04, True),
    "without GGA": ("GP", "RMC GNS GSV", np.nan, True),
    "RMC alone": ("GL", "GSV RMC", np.nan, False),
    "GLL alone": ("GP", "GLL", np.nan, False),
}


@pytest.mark.parametrize("kind", NMEA)
def test_sentences_are_one_fix_each(kind: str, tmp_path: Path) -> None:
    talker, kinds, sigma_m, has_altitude = NMEA[kind]
    gps = gps_of(tmp_path, nmea(talker, kinds))
    assert len(gps.stamp_ns) == COUNT
    np.testing.assert_allclose(gps.latitude_deg, LATITUDE, atol=1e-8)
    np.testing.assert_allclose(gps.longitude_deg, LONGITUDE, atol=1e-8)
    if has_altitude:
        np.testing.assert_allclose(gps.altitude_m, ALTITUDE_M, atol=1e-3)
        np.testing.assert_allclose(np.sqrt(gps.covariance[0, 0, 0]), sigma_m)
    else:
        assert gps.covariance[0, 2, 2] >= 1e8  # no altitude


def test_sentences_give_way_to_fixes_with_a_covariance(tmp_path: Path) -> None:
    both = sorted([*nmea("GP", "RMC GLL GGA"), *location_fixes("protobuf")], key=lambda one: one[3])
    assert gps_of(tmp_path, both).covariance[0, 0, 0] == 1.0
    assert gps_of(tmp_path, both, gps="/nmea").covariance[0, 0, 0] == pytest.approx(0.04**2)


SENTENCE = "nmea_msgs/msg/Sentence"


@cache
def sentence_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("std_msgs/Header header\nstring sentence\n", SENTENCE))
    return store


def decoded(text: str) -> Any:
    store = sentence_store()
    stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="gps")
    data = store.serialize_cdr(store.types[SENTENCE](header=header, sentence=text), SENTENCE)
    return decode(Channel("/nmea", SENTENCE, "cdr"), bytes(data))


def test_no_damage_of_a_sentence_is_a_place_elsewhere() -> None:
    """A flipped or lost character is a known error, no position, or the same one."""
    rng = np.random.default_rng(6)
    for kind in ("GGA", "GNS", "RMC", "GLL"):
        (sound,) = sentences(7, "GP", kind)
        for _ in range(200):
            text, at = list(sound), int(rng.integers(len(sound)))
            text[at : at + 1] = [] if rng.integers(2) else [chr(rng.integers(32, 127))]
            try:
                found = decoded("".join(text))
            except BadMessageError:
                continue
            if isinstance(found, FixMessage):
                assert found.latitude_deg == pytest.approx(LATITUDE[7], abs=1e-8)
                assert found.longitude_deg == pytest.approx(LONGITUDE[7], abs=1e-8)


@pytest.mark.parametrize(
    ("text", "valid"),
    [
        ("$GPGGA,120000.00,,,,,0,00,,,M,,M,,", False),
        ("$GPRMC,120000.00,V,,,,,,,010120,,,N", False),
        ("$GPGGA,120000.00,4807.038,N,01131.000,E,1,08,,545.4,M,,M,,", True),
    ],
)
def test_sentences_without_a_fix_or_a_checksum(text: str, valid: bool) -> None:
    found = decoded(text)
    assert isinstance(found, FixMessage)
    assert found.valid == valid
    if valid:
        assert (found.latitude_deg, found.longitude_deg) == pytest.approx((48.1173, 11.5166667))
        assert np.isnan(found.covariance).all()


@pytest.mark.parametrize("write", [lambda: nmea("GN", "GSV RMC GGA"), KINDS["ROS 2"], KINDS["json"]])
def test_fixes_of_any_kind_alone_are_odometry(write: Callable[[], Messages], tmp_path: Path) -> None:
    log = logs.open(write_raw(tmp_path / "drive.mcap", write()))
    odometry = log.odometry()
    assert odometry is not None
    assert [source.kind for source in log.info().odometry_sources if source.used] == ["gps"]
    way_m = np.linalg.norm(odometry.odom_from_body[-1, :3, 3] - odometry.odom_from_body[0, :3, 3])
    assert way_m == pytest.approx(94.0, abs=3.0)  # 39 steps of 2.2 m north, .9 m east and .1 m up
