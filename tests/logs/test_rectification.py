"""A stereo pair in a log becomes rectified images whose disparities are the depths of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.logs.drives import START_NS, Written, matrix, store, write_ros2
from vplog import logs
from vplog.errors import LogError
from vplog.features.sift import SiftSettings
from vplog.features.stereo_depth import StereoSettings, stereo_depth
from vplog.logs import TopicChoice
from vplog.logs.frames import RecordedFrame
from vplog.logs.rectification import rows_apart_px

if TYPE_CHECKING:
    from pathlib import Path

SIZE = (320, 240)
K = np.array([[220.0, 0, 158.0], [0, 221.0, 118.0], [0, 0, 1]])
OTHER_K = np.array([[224.0, 0, 163.0], [0, 222.0, 121.0], [0, 0, 1]])
BENT = np.array([-0.12, 0.03, 0.001, -0.001, 0.0])
FISHEYE = np.array([0.02, -0.01, 0.003, -0.001])
BASELINE_M = 0.25
RIGHT_FROM_LEFT = matrix(
    Rotation.from_euler("xyz", [0.01, -0.03, 0.02]).apply([-BASELINE_M, 0, 0]),
    Rotation.from_euler("xyz", [0.01, -0.03, 0.02]),
)
STRAIGHT = matrix(np.array([-BASELINE_M, 0.0, 0.0]), Rotation.identity())
BODY_FROM_LEFT = matrix(np.array([0.5, 0.1, 1.0]), Rotation.from_euler("xyz", [-np.pi / 2, 0, -np.pi / 2]))
NORMAL, OFFSET_M = np.array([0.2, -0.1, 1.0]), 3.0
"""The scene in the left camera's frame: a slanted wall, NORMAL . x = OFFSET_M."""
RNG = np.random.default_rng(5)
WALL = cv2.GaussianBlur(RNG.integers(0, 256, (800, 1200)).astype(np.float32), (0, 0), 2.5)
WALL = (WALL - WALL.min()) / (WALL.max() - WALL.min()) * 255
WALL_PX_PER_M = 90.0


@dataclass
class Lens:
    matrix: np.ndarray
    distortion: np.ndarray
    model: str

    def rays(self) -> np.ndarray:
        """(H * W, 3) of every pixel."""
        x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float64), np.arange(SIZE[1], dtype=np.float64))
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
        undistort = cv2.fisheye.undistortPoints if self.model == "equidistant" else cv2.undistortPoints
        flat = np.asarray(undistort(pixels, self.matrix, self.distortion))[:, 0]
        return np.column_stack([flat, np.ones(len(flat))])


def hit(rays: np.ndarray, left_from_camera: np.ndarray) -> np.ndarray:
    """(M, 3) where rays of a camera meet the wall, in the left camera's frame."""
    origin, ways = left_from_camera[:3, 3], rays @ left_from_camera[:3, :3].T
    along = (OFFSET_M - NORMAL @ origin) / (ways @ NORMAL)
    return origin + along[:, None] * ways


def wall(points: np.ndarray) -> np.ndarray:
    """(M,) brightness of points of the wall."""
    x, y = (points[:, :2] * WALL_PX_PER_M + np.array([600, 400])).T.astype(np.float32)
    shape = SIZE[1], SIZE[0]
    return cv2.remap(WALL, x.reshape(shape), y.reshape(shape), cv2.INTER_CUBIC).ravel()


def seen(lens: Lens, camera_from_left: np.ndarray) -> np.ndarray:
    picture = wall(hit(lens.rays(), np.linalg.inv(camera_from_left)))
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8).reshape(SIZE[1], SIZE[0])


def drive(folder: Path, lenses: tuple[Lens, Lens], right_from_left: np.ndarray, **options: Any) -> Path:
    """Three frames of a still pair as a ROS 2 bag: images, camera_infos, transforms, odometry.

    Options: `rp` the R, P of each camera_info; `tf` whether /tf_static places the right camera; `names` of the two
    cameras; `late_ns` of the right images; `lost` the frames without a right image; `camera` the name of images;
    `depth` the rows of depth images in the left camera's frame.
    """
    t = store(2).types

    def new(name: str, **fields: Any) -> Any:
        return t[name](**fields)

    def header(stamp_ns: int, frame: str) -> Any:
        stamp = new("builtin_interfaces/msg/Time", sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))
        return new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def transform(parent: str, child: str, pose: np.ndarray) -> Any:
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        value = new(
            "geometry_msgs/msg/Transform",
            translation=new("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, pose[:3, 3]), strict=True))),
            rotation=new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, turn), strict=True))),
        )
        return new(
            "geometry_msgs/msg/TransformStamped", header=header(START_NS, parent), child_frame_id=child, transform=value
        )

    rp = options.get("rp") or [(np.eye(3), np.zeros((3, 4)))] * 2
    names = options.get("names") or ("left", "right")
    image_name = options.get("camera", "image_raw")
    tree = [transform("base_link", "left_optical", BODY_FROM_LEFT)]
    if options.get("tf"):
        tree.append(transform("base_link", "right_optical", BODY_FROM_LEFT @ np.linalg.inv(right_from_left)))
    static = new("tf2_msgs/msg/TFMessage", transforms=tree)
    found = [Written("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, static)]
    pictures = [seen(lenses[0], np.eye(4)), seen(lenses[1], right_from_left)]
    roi = new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    zero = new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    for i in range(3):
        stamp = START_NS + i * 100_000_000
        for side, (name, lens) in enumerate(zip(names, lenses, strict=True)):
            frame = header(stamp + side * options.get("late_ns", 0), f"{('left', 'right')[side]}_optical")
            if not (side and i in options.get("lost", ())):
                image = new(
                    "sensor_msgs/msg/Image", header=frame, height=SIZE[1], width=SIZE[0], encoding="mono8",
                    is_bigendian=0, step=SIZE[0], data=pictures[side].ravel(),
                )  # fmt: skip
                found.append(Written(f"/stereo/{name}/{image_name}", "sensor_msgs/msg/Image", stamp, image))
            info = new(
                "sensor_msgs/msg/CameraInfo", header=frame, height=SIZE[1], width=SIZE[0],
                distortion_model=lens.model, d=lens.distortion, k=lens.matrix.ravel(), r=rp[side][0].ravel(),
                p=rp[side][1].ravel(), binning_x=0, binning_y=0, roi=roi,
            )  # fmt: skip
            found.append(Written(f"/stereo/{name}/camera_info", "sensor_msgs/msg/CameraInfo", stamp, info))
        if rows := options.get("depth"):
            depth = new(
                "sensor_msgs/msg/Image", header=header(stamp, "left_optical"), height=rows, width=SIZE[0],
                encoding="16UC1", is_bigendian=0, step=2 * SIZE[0], data=np.full(2 * rows * SIZE[0], 8, np.uint8),
            )  # fmt: skip
            found.append(Written("/depth/image", "sensor_msgs/msg/Image", stamp, depth))
        pose = new(
            "geometry_msgs/msg/Pose", position=new("geometry_msgs/msg/Point", x=float(i), y=0.0, z=0.0),
            orientation=new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )  # fmt: skip
        odometry = new(
            "nav_msgs/msg/Odometry", header=header(stamp, "odom"), child_frame_id="base_link",
            pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip
        found.append(Written("/odom", "nav_msgs/msg/Odometry", stamp, odometry))
    return write_ros2(folder / "drive", found)


PINHOLES = Lens(K, BENT, "plumb_bob"), Lens(OTHER_K, 0.8 * BENT, "plumb_bob")
FISHEYES = Lens(K, FISHEYE, "equidistant"), Lens(OTHER_K, 0.8 * FISHEYE, "equidistant")
SAME = Lens(K, np.zeros(5), "plumb_bob"), Lens(K, np.zeros(5), "plumb_bob")


def calibrated(lenses: tuple[Lens, Lens], right_from_left: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """R and P of both, as a driver's calibration has them."""
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        lenses[0].matrix, lenses[0].distortion, lenses[1].matrix, lenses[1].distortion, SIZE,
        right_from_left[:3, :3].copy(), right_from_left[:3, 3:].copy(), flags=0, alpha=0,
    )  # fmt: skip
    return [(r1, p1), (r2, p2)]


def check(log: logs.Log) -> None:  # type: ignore[name-defined]
    """Every pixel of the rectified images shows what is there, and depth by features is the wall's."""
    camera = log.camera()
    assert camera.baseline_m is not None
    assert camera.baseline_m == pytest.approx(BASELINE_M, abs=1e-6)
    assert (camera.distortion_model, len(camera.distortion)) == ("none", 0)
    frames = [frame.decode() for frame in log.frames(log.stamps())]
    assert len(frames) == 3
    assert camera.matrix is not None
    lens = Lens(camera.matrix, np.zeros(5), "plumb_bob")
    left_from_rectified = np.linalg.inv(BODY_FROM_LEFT) @ camera.body_from_camera
    points = hit(lens.rays(), left_from_rectified)
    frame = frames[1]
    assert frame.right is not None
    inside = np.zeros((SIZE[1], SIZE[0]), bool)
    inside[8:-8, 8:-8] = True
    expected = wall(points).reshape(SIZE[1], SIZE[0])
    assert np.abs(frame.image - expected)[inside].mean() < 1.5
    depth = (points - left_from_rectified[:3, 3]) @ left_from_rectified[:3, 2]
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    shift = (camera.matrix[0, 0] * camera.baseline_m / depth).reshape(x.shape) + camera.disparity_zero_px
    beside = cv2.remap(frame.right, (x - shift).astype(np.float32), y, cv2.INTER_LINEAR)
    inside &= (x - shift > 8) & (x - shift < SIZE[0] - 8)
    assert inside.mean() > 0.5
    assert np.abs(beside.astype(float) - expected)[inside].mean() < 2.0
    sift = SiftSettings()
    left, right = sift(frame.image), sift(frame.right)
    found = stereo_depth(
        left, right, camera.matrix[0, 0], camera.baseline_m, StereoSettings(), camera.disparity_zero_px
    )
    known = np.isfinite(found)
    assert known.sum() > 40
    column, row = np.rint(left.points[known]).astype(int).T
    error = found[known] / depth.reshape(x.shape)[row, column] - 1
    assert np.median(np.abs(error)) < 0.02


def test_pair_by_the_calibrations_is_rectified(tmp_path: Path) -> None:
    rp = calibrated(PINHOLES, RIGHT_FROM_LEFT)
    log = logs.open(drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT, rp=rp))
    check(log)
    np.testing.assert_array_equal(log.camera().matrix, rp[0][1][:, :3])


@pytest.mark.parametrize("lenses", [PINHOLES, FISHEYES], ids=["pinhole", "fisheye"])
def test_pair_by_the_static_transforms_is_rectified(lenses: tuple[Lens, Lens], tmp_path: Path) -> None:
    check(logs.open(drive(tmp_path, lenses, RIGHT_FROM_LEFT, tf=True)))


@pytest.mark.parametrize("name", ["image_raw", "image_rect"])
def test_rectified_images_are_left_as_they_are(name: str, tmp_path: Path) -> None:
    p = np.column_stack([K, np.zeros(3)])
    moved = p.copy()
    moved[0, 3] = -K[0, 0] * BASELINE_M
    path = drive(tmp_path, SAME, STRAIGHT, rp=[(np.eye(3), p), (np.eye(3), moved)], camera=name)
    log = logs.open(path)
    check(log)
    frame = next(iter(log.frames(log.stamps()))).decode()
    np.testing.assert_array_equal(frame.image, seen(SAME[0], np.eye(4)))


def test_topics_named_by_hand_and_none_asked_for(tmp_path: Path) -> None:
    path = drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT, tf=True, names=("a", "b"))
    log = logs.open(path)
    assert log.camera().baseline_m is None
    assert next(iter(log.frames(log.stamps()))).decode().right is None
    check(logs.open(path, TopicChoice(image="/stereo/a/image_raw", right="/stereo/b/image_raw")))
    named = drive(tmp_path / "named", PINHOLES, RIGHT_FROM_LEFT, tf=True)
    log = logs.open(named, TopicChoice(right=""))
    assert log.camera().baseline_m is None
    np.testing.assert_array_equal(log.camera().matrix, K)
    with pytest.raises(LogError, match="--right-topic"):
        logs.open(named, TopicChoice(right="/nowhere"))


def test_right_images_pair_by_stamp_and_a_missing_one_is_said(tmp_path: Path) -> None:
    log = logs.open(drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT, tf=True, late_ns=3_000_000, lost=(1,)))
    frames = [frame.decode() for frame in log.frames(log.stamps())]
    assert [frame.right is not None for frame in frames] == [True, False, True]
    np.testing.assert_array_equal(frames[0].image, frames[1].image)  # rectified all the same
    assert "1 of 3 images without a right image" in " ".join(log.warnings)
    assert "ms off" not in " ".join(log.warnings)
    late = logs.open(drive(tmp_path / "late", PINHOLES, RIGHT_FROM_LEFT, tf=True, late_ns=20_000_000))
    late.camera()
    assert "20 ms off the left ones" in " ".join(late.warnings)


@pytest.mark.parametrize("fits", [False, True])
def test_depth_that_is_of_no_use_leaves_the_pair(fits: bool, tmp_path: Path) -> None:
    rows = SIZE[1] if fits else SIZE[1] // 2
    log = logs.open(drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT, tf=True, late_ns=20_000_000, depth=rows))
    frame = next(iter(log.frames(log.stamps()))).decode()
    assert (frame.depth is not None, frame.right is not None) == (fits, not fits)
    assert ("ms off the left ones" in " ".join(log.warnings)) == (not fits)
    assert ("right" in {topic.part for topic in log.info().topics}) == (not fits)


def test_a_damaged_right_image_costs_its_depth_alone_and_is_counted(tmp_path: Path) -> None:
    log = logs.open(drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT, tf=True))
    whole, damaged, _ = list(log.frames(log.stamps()))
    assert isinstance(damaged, RecordedFrame)
    assert damaged.right is not None
    assert isinstance(damaged.right.data, bytes | memoryview)
    damaged = replace(damaged, right=replace(damaged.right, data=damaged.right.data[:-1000]))
    assert whole.decode().right is not None
    frame = damaged.decode()
    assert frame.right is None
    np.testing.assert_array_equal(frame.image, whole.decode().image)
    assert "/stereo/right/image_raw 1" in " ".join(log.warnings)


def test_cameras_to_two_sides_are_no_pair_but_two_cameras(tmp_path: Path) -> None:
    turned = matrix(np.array([-0.5, 0, 0.2]), Rotation.from_euler("y", 1.0))
    path, right = drive(tmp_path, PINHOLES, turned, tf=True, late_ns=20_000_000), "/stereo/right/image_raw"
    log = logs.open(path)
    assert log.camera().baseline_m is None
    assert log.further_cameras() == [right]
    assert "right image" not in " ".join(log.info().warnings)
    log = logs.open(path, TopicChoice(right=right))
    assert log.camera().baseline_m is None
    assert log.further_cameras() == []
    assert "57 degrees" in " ".join(log.warnings)


def test_a_calibrated_camera_that_nothing_places_is_said(tmp_path: Path) -> None:
    log = logs.open(drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT, names=("front", "rear")))
    assert log.further_cameras() == []
    (line,) = [line for line in log.warnings if "not used" in line]
    assert "/stereo/rear/image_raw is calibrated but not used: no static transforms lead from base_link" in line


@pytest.mark.parametrize("tilt_rad", [0.02, -0.03])
def test_right_images_that_are_a_constant_number_of_rows_off_are_moved(tilt_rad: float, tmp_path: Path) -> None:
    """As of a stereo head that was knocked: the calibration is of another tilt."""
    left, (rotation, projection) = calibrated(PINHOLES, RIGHT_FROM_LEFT)
    tilted = Rotation.from_euler("x", tilt_rad).as_matrix() @ rotation
    for name, right in (("sound", rotation), ("tilted", tilted)):
        log = logs.open(drive(tmp_path / name, PINHOLES, RIGHT_FROM_LEFT, rp=[left, (right, projection)]))
        pictures = [(frame.image, frame.right) for one in log.frames(log.stamps()) if (frame := one.decode())]
        apart_px = np.median(rows_apart_px([(one, other) for one, other in pictures if other is not None]))
        assert abs(apart_px) < 1.0
        moved = [line for line in log.warnings if "they are moved by as much" in line]
        assert len(moved) == (name == "tilted")
        assert all(("above" if tilt_rad > 0 else "below") in line for line in moved)


def test_what_is_no_pair_is_said_and_left_out(tmp_path: Path) -> None:
    def why(name: str, right_from_left: np.ndarray = RIGHT_FROM_LEFT, **options: Any) -> str:
        log = logs.open(drive(tmp_path / name, PINHOLES, right_from_left, **options))
        assert log.camera().baseline_m is None
        assert next(iter(log.frames(log.stamps()))).decode().right is None
        (line,) = [line for line in log.warnings if "right image is not used" in line]
        return line

    assert "neither P of the calibration" in why("no-baseline")
    rp = calibrated(PINHOLES, RIGHT_FROM_LEFT)
    rolled = Rotation.from_euler("z", 0.08).as_matrix() @ rp[1][0]
    assert "its rows lie" in why("unfit", rp=[rp[0], (rolled, rp[1][1])])
    assert "to the left of" in why("swapped", np.linalg.inv(STRAIGHT), tf=True)
    below = matrix(np.array([0.0, -0.3, 0.0]), Rotation.identity())
    assert "beside" in why("below", below, tf=True)
