"""Odometry from every kind of message that tells motion: poses, paths, velocities, wheels, a gyroscope, and fixes."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from tests.logs.drives import LATENCY_NS, START_NS, matrices, write_raw
from vplog import logs
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.geometry.geodesy import geodetic
from vplog.graph.noise import NoiseSettings, edge_covariance
from vplog.logs import TopicChoice
from vplog.verbs.info import preflight

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.stages import Log

    Messages = list[tuple[str, str, str, int, bytes]]

COUNT, PERIOD_NS = 600, 20_000_000
STANDS_S, SPEED_M_S, TURN_RAD_S = 2.0, 2.0, 0.2
WHEELBASE_M, TRACK_M, RADIUS_M = 2.5, 0.5, 0.1
STAMPS = START_NS + PERIOD_NS * np.arange(COUNT)
SECONDS = (STAMPS - START_NS) / 1e9
DRIVING = SECONDS > STANDS_S
SPEED, TURN = SPEED_M_S * DRIVING, TURN_RAD_S * DRIVING
YAW = TURN_RAD_S * np.maximum(SECONDS - STANDS_S, 0.0)
R = SPEED_M_S / TURN_RAD_S
POSES = matrices(
    np.stack([R * np.sin(YAW), R * (1 - np.cos(YAW)), np.zeros(COUNT)], 1),
    Rotation.from_rotvec(np.outer(YAW, [0, 0, 1])),
)
"""Two seconds at rest, then a circle."""
_PX4 = """uint64 timestamp
uint64 timestamp_sample
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
float32[3] position_variance
float32[3] orientation_variance
float32[3] velocity_variance
uint8 reset_counter
int8 quality
"""
_DRIVE = "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"


@cache
def store() -> Any:
    found = get_typestore(Stores.ROS2_HUMBLE)
    found.register(get_types_from_msg(_PX4, "px4_msgs/msg/VehicleOdometry"))
    found.register(get_types_from_msg(_DRIVE, "ackermann_msgs/msg/AckermannDrive"))
    stamped = "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
    found.register(get_types_from_msg(stamped, "ackermann_msgs/msg/AckermannDriveStamped"))
    return found


def message(type_name: str, /, **fields: Any) -> Any:
    """A message with these fields, nested ones as dicts; the others are 0 or empty."""

    def value(kind: Nodetype, about: Any, given: Any) -> Any:
        if kind == Nodetype.NAME:
            return given if hasattr(given, "__msgtype__") else message(about, **(given or {}))
        if given is not None:
            return given
        if kind == Nodetype.BASE:
            return "" if about[0] == "string" else 0
        return np.zeros(about[1], about[0][1][0] if about[0][0] == Nodetype.BASE else float)

    defined = store().fielddefs[type_name][1]
    types = {field: value(kind, about, fields.get(field)) for field, (kind, about) in defined}
    return store().types[type_name](**types)


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def pose(value: np.ndarray) -> dict[str, Any]:
    names = {"position": value[:3, 3], "orientation": Rotation.from_matrix(value[:3, :3]).as_quat()}
    return {name: dict(zip("xyzw", map(float, numbers), strict=False)) for name, numbers in names.items()}


def velocities(speed: float, turn: float) -> dict[str, Any]:
    return {"linear": {"x": float(speed)}, "angular": {"z": float(turn)}}


def topic(name: str, kind: str, fields: list[dict[str, Any]], stamps: np.ndarray = STAMPS) -> Messages:
    each = zip(stamps.tolist(), fields, strict=True)
    return [
        (name, kind, "cdr", stamp + LATENCY_NS, bytes(store().serialize_cdr(message(kind, **one), kind)))
        for stamp, one in each
    ]


def stamped(frame: str, fields: list[dict[str, Any]], stamps: np.ndarray = STAMPS) -> list[dict[str, Any]]:
    return [{"header": header(stamp, frame), **one} for stamp, one in zip(stamps.tolist(), fields, strict=True)]


TWISTS = [velocities(*both) for both in zip(SPEED, TURN, strict=True)]


def still_poses() -> Messages:
    """nav_msgs/Odometry whose driver fills in the velocities alone."""
    fields = [{"child_frame_id": "base_link", "twist": {"twist": twist}} for twist in TWISTS]
    return topic("/odom", "nav_msgs/msg/Odometry", stamped("odom", fields))


def turning_poses() -> Messages:
    """nav_msgs/Odometry whose driver fills in the velocities and the rotation of its IMU."""
    turns = [pose(matrices(np.zeros((1, 3)), Rotation.from_rotvec([[0, 0, yaw]]))[0]) for yaw in YAW.tolist()]
    fields = [{"child_frame_id": "base_link", "pose": {"pose": turned}, "twist": {"twist": twist}}
              for turned, twist in zip(turns, TWISTS, strict=True)]  # fmt: skip
    return topic("/odom", "nav_msgs/msg/Odometry", stamped("odom", fields))


def twists(scale: float = 1.0) -> Messages:
    fields = [{"twist": velocities(*both)} for both in zip(SPEED, scale * TURN, strict=True)]
    return topic("/twist", "geometry_msgs/msg/TwistStamped", stamped("base_link", fields))


def twists_with_covariance() -> Messages:
    covariance = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003]).ravel()
    fields = [{"twist": {"twist": twist, "covariance": covariance}} for twist in TWISTS]
    return topic("/twist", "geometry_msgs/msg/TwistWithCovarianceStamped", stamped("base_link", fields))


def planar() -> Messages:
    fields = [{"x": p[0, 3], "y": p[1, 3], "theta": yaw} for p, yaw in zip(POSES, YAW, strict=True)]
    return topic("/pose2d", "geometry_msgs/msg/Pose2D", fields)


def path() -> Messages:
    """Every tenth message, each with all poses up to then."""
    kind = "geometry_msgs/msg/PoseStamped"
    each = stamped("odom", [{"pose": pose(value)} for value in POSES])
    each = [message(kind, **one) for one in each]
    ends = range(10, COUNT + 1, 10)
    fields = stamped("odom", [{"poses": each[:end]} for end in ends], STAMPS[9::10])
    return topic("/path", "nav_msgs/msg/Path", fields, STAMPS[9::10])


def test_a_path_that_passes_a_time_twice_is_read(tmp_path: Path) -> None:
    """All its poses have one place in the file; a search for steps of the clock never ended."""
    kind, stamps = "geometry_msgs/msg/PoseStamped", np.concatenate([STAMPS[:20], STAMPS[5:25]])
    each = [message(kind, **one) for one in stamped("odom", [{"pose": pose(value)} for value in POSES[:40]], stamps)]
    fields = stamped("odom", [{"poses": each}], STAMPS[30:31])
    odometry = logs.open(
        write_raw(tmp_path / "a.mcap", topic("/path", "nav_msgs/msg/Path", fields, STAMPS[30:31]))
    ).odometry()
    assert odometry is not None


def px4() -> Messages:
    """North-east-down and forward-right-down, in microseconds."""
    ned_from_enu, flip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])
    fields = []
    for stamp, value in zip(STAMPS.tolist(), POSES, strict=True):
        turn = Rotation.from_matrix(ned_from_enu @ value[:3, :3] @ flip).as_quat()[[3, 0, 1, 2]]
        position = (ned_from_enu @ value[:3, 3]).astype(np.float32)
        fields.append({"timestamp": stamp // 1000, "pose_frame": 1, "position": position, "q": turn.astype(np.float32)})
    return topic("/fmu/out/vehicle_odometry", "px4_msgs/msg/VehicleOdometry", fields)


def ackermann() -> Messages:
    angle = math.atan(TURN_RAD_S / SPEED_M_S * WHEELBASE_M)
    fields = [{"drive": {"speed": float(speed), "steering_angle": angle}} for speed in SPEED]
    return topic("/ackermann", "ackermann_msgs/msg/AckermannDriveStamped", stamped("base_link", fields))


def wheels(*names: str) -> Messages:
    """Of joints with these names the first two are wheels."""
    left, right = ((SPEED + side * TURN * TRACK_M / 2) / RADIUS_M for side in (-1, 1))
    names = names or ("front_left_wheel", "front_right_wheel")
    others = np.random.default_rng(6).normal(0, 1, (COUNT, len(names) - 2))
    each = np.column_stack([left, right, others])
    fields = [{"name": [*names], "velocity": one} for one in each]
    return topic("/joint_states", "sensor_msgs/msg/JointState", stamped("base_link", fields))


def poses_in_frame() -> Messages:
    """The last pose of each message is the body's."""
    found: Messages = []
    for stamp, value in zip(STAMPS.tolist(), POSES, strict=True):
        one = PosesInFrame(frame_id="odom")
        one.timestamp.seconds, one.timestamp.nanos = stamp // 10**9, stamp % 10**9
        for each in (np.eye(4), value):
            added = one.poses.add()
            for name, numbers in pose(each).items():
                for axis, number in numbers.items():
                    setattr(getattr(added, name), axis, number)
        found.append(("/poses", "foxglove.PosesInFrame", "protobuf", stamp + LATENCY_NS, one.SerializeToString()))
    return found


def fixes(sigma_m: float, rate: int = 10) -> Messages:
    rows = np.arange(0, COUNT, 50 // rate)
    enu = POSES[rows, :3, 3] + np.random.default_rng(4).normal(0, sigma_m, (len(rows), 3))
    covariance = (sigma_m**2 * np.eye(3)).ravel()
    fields = [
        {"latitude": float(place[0]), "longitude": float(place[1]), "altitude": float(place[2]),
         "position_covariance": covariance, "position_covariance_type": 2}
        for place in geodetic(enu, (48.0, 11.0, 500.0))
    ]  # fmt: skip
    return topic("/fix", "sensor_msgs/msg/NavSatFix", stamped("gps", fields, STAMPS[rows]), STAMPS[rows])


def gyroscope(bias: float, name: str = "/imu") -> Messages:
    """On its side: the body's z is its -x."""
    rates = -(TURN + bias) + np.random.default_rng(5).normal(0, 0.002, COUNT)
    fields = [{"angular_velocity": {"x": float(rate)}, "linear_acceleration": {"x": -9.8}} for rate in rates]
    placed = {"rotation": dict(zip("xyzw", Rotation.from_euler("y", 90, degrees=True).as_quat(), strict=True))}
    mounted = {"header": header(START_NS, "base_link"), "child_frame_id": "imu", "transform": placed}
    kind = "tf2_msgs/msg/TFMessage"
    transforms = [message("geometry_msgs/msg/TransformStamped", **mounted)]
    return [
        *topic(name, "sensor_msgs/msg/Imu", stamped("imu", fields)),
        *topic("/tf_static", kind, [{"transforms": transforms}], STAMPS[:1]),
    ]


def opened(folder: Path, *found: Messages, **choice: Any) -> Log:
    messages = sorted((one for part in found for one in part), key=lambda one: one[3])
    return logs.open(write_raw(folder / "drive.mcap", messages), TopicChoice(**choice))


def check(log: Log, within_m: float, within_rad: float) -> np.ndarray:
    """The odometry follows the drive from its first pose on; its poses at the drive's stamps."""
    odometry = log.odometry()
    assert odometry is not None
    stamps, poses = odometry.stamp_ns, odometry.odom_from_body
    inside = (stamps[0] <= STAMPS) & (stamps[-1] >= STAMPS)
    assert inside.mean() > 0.97
    found = se3.interpolate_at(stamps, poses, STAMPS[inside])
    off = se3.between(se3.inverse(POSES[inside][0]) @ POSES[inside], se3.inverse(found[0]) @ found)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < within_m
    assert se3.angle(off).max() < within_rad
    return found


def kind_of(log: Log) -> str:
    return next(source.kind for source in log.info().odometry_sources if source.used)


@pytest.mark.parametrize(
    ("write", "kind", "choice"),
    [
        (still_poses, "twist", {}),
        (turning_poses, "twist", {}),
        (twists, "twist", {}),
        (twists_with_covariance, "twist", {}),
        (planar, "poses", {}),
        (path, "poses", {}),
        (px4, "poses", {}),
        (poses_in_frame, "poses", {}),
        (ackermann, "twist", {"wheelbase_m": WHEELBASE_M}),
        (wheels, "twist", {"wheel_radius_m": RADIUS_M, "track_m": TRACK_M}),
    ],
)
def test_every_kind_of_message_becomes_the_drive(write: Any, kind: str, choice: dict, tmp_path: Path) -> None:
    log = opened(tmp_path, write(), **choice)
    late_m = SPEED_M_S * LATENCY_NS / 1e9 if write is planar else 0.0  # without a header, by its log times
    check(log, 0.05 + late_m, 0.01)
    assert kind_of(log) == kind


@pytest.mark.parametrize("written", ["", "with quaternions in the order w x y z", "with conjugated quaternions"])
@pytest.mark.parametrize("way", ["circle", "straight, spinning", "sideways"])
def test_quaternions_in_another_convention_are_not_taken_silently(way: str, written: str, tmp_path: Path) -> None:
    """A drive ahead in a bend points ahead in the right convention; a platform that spins or goes sideways does not."""
    place, yaw = POSES[:, :3, 3], YAW
    if way != "circle":
        place = np.column_stack([2 * SECONDS, np.sin(SECONDS) * (way == "sideways"), 0 * SECONDS])
        yaw = 0.5 * SECONDS
    turns = Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])).as_quat()
    turns = np.roll(turns, 1, axis=1) if "order" in written else turns * [-1, -1, -1, 1] if written else turns
    each = zip(place.tolist(), turns.tolist(), strict=True)
    fields = [
        {"pose": {name: dict(zip("xyzw", one, strict=False)) for name, one in (("position", at), ("orientation", q))}}
        for at, q in each
    ]
    log = opened(tmp_path, topic("/pose", "geometry_msgs/msg/PoseStamped", stamped("odom", fields)))
    told = " ".join(log.info().warnings)
    assert ("are they written so?" in told) == (way == "circle" and written != "")
    assert way != "circle" or written in told


def test_a_stamp_of_px4_beyond_the_range_is_a_bad_message(tmp_path: Path) -> None:
    messages = px4()
    name, kind, encoding, log_ns, data = messages[300]
    messages[300] = name, kind, encoding, log_ns, data[:4] + b"\xff" * 8 + data[12:]
    log = opened(tmp_path, messages)
    check(log, 0.05, 0.01)
    assert "1 message" in " ".join(log.warnings)


def test_wheels_without_their_measures_are_no_odometry_and_name_them(tmp_path: Path) -> None:
    log = opened(tmp_path, ackermann())
    assert log.odometry() is None
    assert "--wheelbase-m make odometry of /ackermann" in log.without_odometry()
    with pytest.raises(LogError, match="--wheel-radius-m and --track-m"):
        opened(tmp_path, wheels(), odometry="/joint_states")


@pytest.mark.parametrize(
    "names",
    [
        ("l_wheel_joint", "r_wheel_joint", "l_gripper_finger_joint", "r_gripper_finger_joint"),
        ("wheel_left_joint", "wheel_right_joint", "caster_left_wheel_joint", "left_1_joint", "head_1_joint"),
        ("wheel_FL_joint", "wheel_FR_joint"),
        ("left_motor", "right_motor", "LeftElbow", "arm_right_2_joint", "front_left_steering"),
    ],
)
def test_other_joints_with_a_side_are_no_wheels(names: tuple[str, ...], tmp_path: Path) -> None:
    check(opened(tmp_path, wheels(*names), wheel_radius_m=RADIUS_M, track_m=TRACK_M), 0.05, 0.01)


@pytest.mark.parametrize("names", [("l_gripper_finger_joint", "r_gripper_finger_joint"), ("torso_lift_joint",)])
def test_joints_of_another_publisher_are_neither_wheels_nor_lost(names: tuple[str, ...], tmp_path: Path) -> None:
    each = stamped("", [{"name": [*names], "velocity": np.ones(len(names))}] * COUNT, STAMPS + 1000)
    arm = topic("/joint_states", "sensor_msgs/msg/JointState", each, STAMPS + 1000)
    measures = {"wheel_radius_m": RADIUS_M, "track_m": TRACK_M}
    log = opened(tmp_path, wheels(), arm, **measures)
    check(log, 0.05, 0.01)
    assert log.warnings == ["/joint_states: the odometry is its velocities, integrated."]
    log = opened(tmp_path, arm, **measures)
    assert log.odometry() is None
    assert log.warnings == ["/joint_states: none of its messages gives a motion."]


def test_velocities_are_taken_on_request_where_there_are_poses(tmp_path: Path) -> None:
    along = [pose(np.eye(4) + 5 * row / COUNT * np.eye(4, k=3)) for row in range(COUNT)]
    both = [{"child_frame_id": "base_link", "pose": {"pose": one}, "twist": {"twist": twist}} for one, twist in
            zip(along, TWISTS, strict=True)]  # fmt: skip
    wrong = stamped("odom", both)
    messages = topic("/odom", "nav_msgs/msg/Odometry", wrong)
    assert kind_of(opened(tmp_path, messages)) == "poses"
    log = opened(tmp_path, messages, odometry="twist")
    check(log, 0.05, 0.01)


def accelerometer(name: str) -> Messages:
    """As RealSense has it beside a topic of the gyroscope."""
    fields = [{"linear_acceleration": {"z": 9.8}}] * COUNT
    return topic(name, "sensor_msgs/msg/Imu", stamped("imu", fields))


def test_an_accelerometer_turns_no_velocities(tmp_path: Path) -> None:
    log = opened(tmp_path, twists(), accelerometer("/camera/accel/sample"))
    check(log, 0.05, 0.01)
    assert "turns by the gyroscope" not in " ".join(log.warnings)
    for name in ("/camera/accel/sample", "/a"):
        both = accelerometer(name), gyroscope(0.0, "/camera/gyro/sample")
        check(opened(tmp_path, twists(scale=1.3), *both), 0.1, 0.01)


def test_a_gyroscope_turns_velocities_less_its_bias_at_rest(tmp_path: Path) -> None:
    bad, bias = twists(scale=1.3), np.radians(1.0)
    with pytest.raises(AssertionError):
        check(opened(tmp_path, bad), 1.0, 0.05)
    log = opened(tmp_path, bad, gyroscope(bias))
    check(log, 0.1, 0.01)
    assert "less a bias of 1.0" in " ".join(log.warnings)
    with pytest.raises(AssertionError):
        check(opened(tmp_path, bad, gyroscope(bias), imu=""), 1.0, 0.05)


def transforms(parent: str, child: str, values: np.ndarray) -> Messages:
    """The same frame again and again."""
    fields = []
    for stamp, value in zip(STAMPS.tolist(), values, strict=True):
        at = pose(value)
        moved = {"translation": at["position"], "rotation": at["orientation"]}
        one = {"header": header(stamp, parent), "child_frame_id": child, "transform": moved}
        fields.append({"transforms": [message("geometry_msgs/msg/TransformStamped", **one)]})
    return topic("/tf", "tf2_msgs/msg/TFMessage", fields)


def images() -> Messages:
    fields = [{"height": 48, "width": 64, "step": 64, "encoding": "mono8", "data": np.zeros(48 * 64, np.uint8)}] * COUNT
    return topic("/camera/image", "sensor_msgs/msg/Image", stamped("camera", fields))


@pytest.mark.parametrize("turns", [False, True])
def test_transforms_of_joints_and_mounts_leave_the_imu(turns: bool, tmp_path: Path) -> None:
    """To velocities, and to visual odometry; where the transforms are the odometry it is not used."""
    turned = matrices(np.zeros((COUNT, 3)), Rotation.from_rotvec(np.outer(SECONDS * turns, [0, 1, 0])))
    joints = transforms("base_link", "wheel", turned)
    log = opened(tmp_path, twists(scale=1.3), gyroscope(0.0), joints)
    check(log, 0.1, 0.01)
    assert "turns by the gyroscope" in " ".join(log.warnings)
    log = opened(
        tmp_path, images(), gyroscope(0.0), joints, transforms("base_link", "camera", turned[:1].repeat(COUNT, 0))
    )
    assert log.odometry() is None
    assert (imu := log.imu()) is not None and imu.name == "/imu"
    assert {topic.name: topic.part for topic in log.info().topics}["/imu"] == "imu"
    log = opened(tmp_path, images(), gyroscope(0.0), transforms("odom", "base_link", POSES))
    check(log, 0.05, 0.01)
    assert log.imu() is None
    assert {topic.name: topic.part for topic in log.info().topics}["/imu"] == ""


def of_receiver(kind: str) -> Messages:
    """Velocities in the world's axes, of TwistStamped with the rates of the body or without, or positions alone."""
    if kind == "positions":
        fields = [
            {"pose": {"position": dict(zip("xyz", one[:3, 3].tolist(), strict=True)), "orientation": {"w": 1.0}}}
            for one in POSES
        ]
        return topic("/place", "geometry_msgs/msg/PoseStamped", stamped("map", fields))
    velocity = (POSES[:, :3, :3] @ (SPEED[:, None] * [1.0, 0.0, 0.0])[:, :, None])[:, :, 0]
    rates = TURN if kind == "rates" else np.zeros(COUNT)
    each = zip(velocity.tolist(), rates.tolist(), strict=True)
    fields = [{"twist": {"linear": {"x": x, "y": y}, "angular": {"z": rate}}} for (x, y, _), rate in each]
    return topic("/vel", "geometry_msgs/msg/TwistStamped", stamped("gps", fields))


@pytest.mark.parametrize("kind", ["velocities", "rates", "positions"])
@pytest.mark.parametrize("gyro", [False, True])
def test_what_a_receiver_measures_has_no_heading(kind: str, gyro: bool, tmp_path: Path) -> None:
    """Its velocities are not those of the body, turned by a gyroscope or not, and its positions alone no poses."""
    beside = [gyroscope(0.0)] if gyro else []
    log = opened(tmp_path, of_receiver(kind), *beside, fixes(0.02))
    assert kind_of(log) == "gps"
    log = opened(tmp_path, of_receiver(kind), *beside)
    assert log.odometry() is None
    assert "moves every way without turning" in " ".join(log.warnings)
    name = "/place" if kind == "positions" else "/vel"
    assert f"--odometry-topic {name} takes it" in " ".join(log.warnings)
    log = opened(tmp_path, of_receiver(kind), *beside, odometry=name)
    assert log.odometry() is not None
    assert f"{name} moves every way without turning; " in " ".join(log.warnings)


@pytest.mark.parametrize("kind", ["velocities", "positions"])
def test_beside_a_receiver_the_imu_and_the_lidar_are_used(kind: str, tmp_path: Path) -> None:
    """Which are not where the poses of a topic are the odometry."""
    cloud = topic("/points", "sensor_msgs/msg/PointCloud2", stamped("lidar", [{}] * COUNT))
    mount = transforms("base_link", "camera", np.tile(np.eye(4), (COUNT, 1, 1)))
    poses = topic("/poses", "geometry_msgs/msg/PoseStamped", stamped("map", [{"pose": pose(one)} for one in POSES]))
    for moving, headless in ((of_receiver(kind), True), (poses, False)):
        log = opened(tmp_path, images(), mount, gyroscope(0.0), cloud, moving)
        assert (log.odometry() is None) == headless
        assert (log.imu() is not None) == headless
        assert (log.lidar() is not None) == headless
        assert ("moves every way without turning" in " ".join(log.warnings)) == headless


@pytest.mark.parametrize("seed", range(8))
def test_what_moves_sideways_keeps_its_odometry(seed: int, tmp_path: Path) -> None:
    """A platform that drives every way as it turns, a straight drive out and back, and one that hardly turns."""
    rng = np.random.default_rng(seed)
    way = rng.normal(0, 1, (12, 3)) * [0.7, 0.7, rng.choice([0.02, 0.3])]
    moving = np.repeat(way, COUNT // 12, axis=0)
    fields = [{"twist": {"linear": {"x": x, "y": y}, "angular": {"z": rate}}} for x, y, rate in moving.tolist()]
    log = opened(tmp_path, topic("/twist", "geometry_msgs/msg/TwistStamped", stamped("base_link", fields)))
    assert kind_of(log) == "twist"
    there = [{"twist": velocities(1.5 * math.copysign(1.0, x), 0.0)} for x in moving[:, 0].tolist()]
    log = opened(tmp_path, topic("/twist", "geometry_msgs/msg/TwistStamped", stamped("base_link", there)))
    assert kind_of(log) == "twist"


@pytest.mark.parametrize("sigma_m", [0.02, 0.5])
def test_fixes_alone_are_odometry_with_their_noise(sigma_m: float, tmp_path: Path) -> None:
    log = opened(tmp_path, fixes(sigma_m))
    odometry = log.odometry()
    assert odometry is not None
    assert kind_of(log) == "gps"
    assert not odometry.drifts
    moving = (odometry.stamp_ns > START_NS + int((STANDS_S + 1.0) * 1e9)) & (odometry.stamp_ns <= STAMPS[-1])
    true = se3.interpolate_at(STAMPS, POSES, odometry.stamp_ns[moving])
    found = odometry.odom_from_body[moving]
    shift = found[:, :3, 3] - true[:, :3, 3]
    off_m = np.linalg.norm((shift - np.median(shift, axis=0))[:, :2], axis=1)
    assert np.sqrt((off_m**2).mean()) < max(0.8 * sigma_m, 0.05)  # smoother than the fixes
    turned = np.arctan2(found[:, 1, 0], found[:, 0, 0]) - np.arctan2(true[:, 1, 0], true[:, 0, 0])
    turned = (turned + np.pi) % (2 * np.pi) - np.pi
    sigma_rad = np.sqrt((turned**2).mean())
    assert sigma_rad < 0.05 + 0.3 * sigma_m
    rows = np.arange(300, 1100, 50) * len(odometry.stamp_ns) // 1200
    covariance, _, source = edge_covariance(odometry, odometry.stamp_ns[rows], NoiseSettings())
    assert source == "fixes"
    steps, real = (
        se3.between(poses[:-1], poses[1:]) for poses in (odometry.odom_from_body[rows],
        se3.interpolate_at(STAMPS, POSES, np.minimum(odometry.stamp_ns[rows], STAMPS[-1])))
    )  # fmt: skip
    error = se3.log(se3.between(real, steps))[:, [2, 3, 4]]
    sigma = np.sqrt(covariance[:, [2, 3, 4], [2, 3, 4]])
    assert np.sqrt(((error / sigma) ** 2).mean()) < 2.0  # as sure as it is good


@pytest.mark.parametrize("kind", [None, "gps"])
def test_fixes_that_stand_still_are_not_called_the_odometry(kind: str | None, tmp_path: Path) -> None:
    still = [one for one in fixes(0.5) if one[3] < START_NS + int(0.5 * STANDS_S * 1e9)]
    log = opened(tmp_path, still, *([] if kind else [planar()]), odometry=kind)
    said = " ".join([*log.info().warnings, *log.warnings])
    assert (log.odometry() is None) == (kind == "gps")
    assert "The odometry is the fixes" not in said
    assert ("do not go far enough for a heading: they are no odometry" in said) == (kind == "gps")


def test_what_only_turns_is_not_taken_silently(tmp_path: Path) -> None:
    fields = [{"pose": pose(matrices(np.zeros((1, 3)), Rotation.from_rotvec([[0, 0, yaw]]))[0])} for yaw in YAW]
    log = opened(tmp_path, topic("/pose", "geometry_msgs/msg/PoseStamped", stamped("odom", fields)))
    assert "/pose turns, but never moves; did its estimator run?" in " ".join(log.info().warnings)


def test_velocities_have_the_noise_that_they_claim(tmp_path: Path) -> None:
    log = opened(tmp_path, twists_with_covariance())
    odometry = log.odometry()
    assert odometry is not None
    assert odometry.covariance is not None
    step_s = PERIOD_NS / 1e9
    variances = np.array([0.001, 0.002, 0.003, 0.01, 0.02, 0.03]) * step_s**2
    np.testing.assert_allclose(np.diagonal(odometry.covariance[5]), variances)
    assert opened(tmp_path, twists()).odometry().covariance is None  # type: ignore[union-attr]


def test_poses_come_before_velocities_before_fixes_and_info_says_why(tmp_path: Path) -> None:
    everything = [px4(), twists(), fixes(0.5)]
    for count, kind in ((3, "poses"), (2, "twist"), (1, "gps")):
        assert kind_of(opened(tmp_path, *everything[3 - count :])) == kind
    assert kind_of(opened(tmp_path, *everything, odometry="gps")) == "gps"
    assert kind_of(opened(tmp_path, *everything, odometry="/twist")) == "twist"
    record = preflight(tmp_path / "drive.mcap").record
    assert [source["kind"] for source in record["odometry_sources"]] == ["poses", "twist", "gps"]
    assert "drifts" in record["odometry"]["properties"]


def test_a_source_that_the_log_lacks_is_one_line(tmp_path: Path) -> None:
    for kind in ("gps", "truth", "twist"):
        log = opened(tmp_path, planar(), odometry=kind)
        assert log.odometry() is None
        assert log.info().odometry_sources == []
    with pytest.raises(LogError, match="twist, gps, truth"):
        opened(tmp_path, twists(), odometry="/nothing")
