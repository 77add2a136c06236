"""A log as Foxglove's nuscenes2mcap writes it: six cameras, poses by tf alone, and a /pose that never moves."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from vplog.data import Trajectory
from vplog.geometry import se3
from vplog.geometry.tum import write_tum
from vplog.results import tables
from vplog.verbs.demo import SMALL, route
from vplog.verbs.demo.scene import FIRST_LIGHT, Light, make_scene, render

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from tests.conftest import Said
    from vplog.data import Floats

CAMERAS = {
    "cam_front": 0, "cam_front_right": -55, "cam_back_right": -110, "cam_back": 180, "cam_back_left": 110,
    "cam_front_left": 55,
}  # fmt: skip
"""Degrees to the left of the way ahead."""
SETTINGS = SMALL.model_copy(
    update={"laps": 1.05, "frame_rate_hz": 2.0, "width": 240, "height": 136, "turn_back_m": 34.0}
)
QUICK = (
    "--set", "propose.per_query=2", "--set", "features.max_features=400", "--set", "pictures.closures=2",
    "--set", "propose.gap_steps=8", "--set", "places.neighbours=8", "--set", "verify.calibration.pairs=0",
)  # fmt: skip


def stamped(message: Any, stamp_ns: int, frame: str) -> Any:
    message.timestamp.FromNanoseconds(stamp_ns)
    message.frame_id = frame
    return message


def transform(stamp_ns: int, parent: str, child: str, pose: Floats) -> FrameTransform:
    found = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    found.timestamp.FromNanoseconds(stamp_ns)
    for name, value in zip("xyz", pose[:3, 3], strict=True):
        setattr(found.translation, name, value)
    for name, value in zip("xyzw", se3.quaternion(pose[:3, :3]), strict=True):
        setattr(found.rotation, name, value)
    return found


def messages(scene: Any, odometry: Floats) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time and message, in the converter's order: every sensor's mount at every sample."""
    for frame, (stamp_ns, pose) in enumerate(zip(scene.stamp_ns.tolist(), odometry, strict=True)):
        yield "/tf", stamp_ns, transform(stamp_ns, "map", "base_link", pose)
        for number, (name, yaw_deg) in enumerate(CAMERAS.items()):
            turn = se3.pose(se3.so3_exp(np.array([0.0, 0.0, np.radians(yaw_deg)])), np.zeros(3))
            mount, camera = turn @ scene.camera.body_from_camera, scene.camera
            taken_ns = stamp_ns + 1_000_000 * number
            yield "/tf", stamp_ns, transform(taken_ns, "base_link", name, mount)
            image, _ = render(scene.world, camera, scene.world_from_body[frame] @ mount, Light(*FIRST_LIGHT))
            jpeg = cv2.imencode(".jpg", np.clip(image, 0, 255).astype(np.uint8))[1].tobytes()
            yield (
                f"/{name}/image_rect_compressed", stamp_ns,
                stamped(CompressedImage(format="jpeg", data=jpeg), taken_ns, name),
            )  # fmt: skip
            K = camera.matrix.ravel().tolist()
            calibration = CameraCalibration(width=camera.width, height=camera.height, K=K)
            calibration.R.extend(np.eye(3).ravel().tolist())
            calibration.P.extend(np.column_stack([camera.matrix, np.zeros(3)]).ravel().tolist())
            yield f"/{name}/camera_info", stamp_ns, stamped(calibration, taken_ns, name)
        still = stamped(PoseInFrame(), stamp_ns, "base_link")
        still.pose.orientation.w = 1.0
        yield "/pose", stamp_ns, still
        yield "/gps", stamp_ns, LocationFix(latitude=1.3 + 1e-5 * pose[1, 3], longitude=103.8 + 1e-5 * pose[0, 3])


@pytest.fixture(scope="module")
def drive(made_once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        scene = make_scene(SETTINGS)
        write_tum(folder / "truth.tum", Trajectory(scene.stamp_ns, scene.world_from_body))
        drifting = route.odometry(SETTINGS, np.random.default_rng([SETTINGS.seed, 6]))
        poses = se3.interpolate_at(route.odometry_stamps(SETTINGS), drifting, scene.stamp_ns)
        with (folder / "scene.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            channels: dict[str, int] = {}
            for topic, log_ns, message in messages(scene, poses):
                if topic not in channels:
                    schema = build_file_descriptor_set(type(message)).SerializeToString()
                    known = writer.register_schema(type(message).DESCRIPTOR.full_name, "protobuf", schema)
                    channels[topic] = writer.register_channel(topic, "protobuf", known)
                writer.add_message(channels[topic], log_ns, message.SerializeToString(), log_ns)
            schema = writer.register_schema("Pose", "jsonschema", b'{"type": "object"}')
            odom = writer.register_channel("/odom", "json", schema)
            for stamp_ns, pose in zip(scene.stamp_ns.tolist(), poses, strict=True):
                place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
                writer.add_message(odom, stamp_ns, json.dumps({"pos": place, "vel": place}).encode(), stamp_ns)
            writer.finish()

    return made_once("nuscenes", make)


def test_six_cameras_and_tf_are_used_unasked(drive: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    topics = {f"/{name}/image_rect_compressed" for name in CAMERAS}
    about = verb("info", drive / "scene.mcap", "--json").json
    assert {t["name"] for t in about["topics"] if t["part"] == "image"} == topics
    assert [t["name"] for t in about["topics"] if t["part"] == "odometry"] == ["/tf"]
    out = tmp_path / "run"
    found = verb("run", drive / "scene.mcap", "-o", out, "--json", *QUICK).json
    assert found["cameras"][0] == "/cam_front/image_rect_compressed"
    assert set(found["cameras"]) == topics
    closures = tables.read_closures(out / "closures.parquet")
    assert len({*closures.query_camera[closures.accepted], *closures.match_camera[closures.accepted]}) > 2
    far = closures.accepted & ~closures.of_first_camera
    assert far.any()
    assert (closures.p_false[far] < 0.1).all()
    judged = verb("evaluate", out, "--truth", drive / "truth.tum", "--json").json
    assert judged["closures"]["accepted_false"] == 0
    assert judged["ate_after"]["rmse_m"] < 0.5 * judged["ate_before"]["rmse_m"]
    assert verb("report", out).code == 0
