"""result.mcap: the run as Foxglove and rerun show it, every message in protobuf with the schema beside it.

Frames: `map` is the root, `base_link` the body, `camera` fixed on the body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.writer import CompressionType, Writer

import vplog
from vplog import geometry
from vplog.data import EdgeKind, Verdict
from vplog.results.atomic import replacing
from vplog.results.messages import descriptor_set, loop_closure_class
from vplog.results.tables import covariance_of

if TYPE_CHECKING:
    from pathlib import Path

    from google.protobuf.message import Message

    from vplog.data import Camera, Closures, Floats, Ints, Keyframes, PoseGraph
    from vplog.results.tables import TableMetadata

Part = tuple[list[float], list[float]]
"""Position in m and quaternion x y z w of one pose, as plain numbers."""

MAP, BODY, CAMERA = "map", "base_link", "camera"

_GREY, _GREEN, _RED = (0.6, 0.6, 0.6, 1.0), (0.1, 0.8, 0.2, 1.0), (0.9, 0.1, 0.1, 1.0)
_THICKNESS_PX = 2.0
"""Lines keep their width on the screen at any zoom."""
_CHUNK_BYTES = 1 << 20
"""A reader inflates one chunk at a time; 1 MiB is what the format's own tools write."""


def write_mcap(
    path: Path,
    keyframes: Keyframes,
    world_from_body: Floats,
    graph: PoseGraph,
    closures: Closures,
    metadata: TableMetadata,
    camera: Camera | None = None,
) -> None:
    """Write the run; `world_from_body` (N, 4, 4) are the solved poses of the keyframes.

    Messages are in the order of their log time, which is the stamp of the keyframe they are about; what is about
    the whole drive stands at its start, and the solved path once more at its end.
    """
    loop_closure = loop_closure_class()
    with replacing(path) as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library=f"vplog {vplog.__version__}")
        header = {key.removeprefix("vplog."): text for key, text in metadata.record().items()}
        writer.add_metadata("vplog", {**header, "drive": keyframes.drive})
        optimised = _Channel(writer, "/path/optimised", PosesInFrame)
        odometry = _Channel(writer, "/path/odometry", PosesInFrame)
        # the same positions as points: rerun reads the paths, but draws point clouds
        optimised_points = _Channel(writer, "/path/optimised_points", PointCloud)
        odometry_points = _Channel(writer, "/path/odometry_points", PointCloud)
        scene = _Channel(writer, "/graph", SceneUpdate)
        static = _Channel(writer, "/tf_static", FrameTransforms)
        transforms = _Channel(writer, "/tf", FrameTransforms)
        ledger = _Channel(writer, "/loop_closures", loop_closure)

        bodies, relative = _parts(world_from_body), _parts(closures.match_from_query)
        covariance = covariance_of(closures.information)
        rows = np.argsort(closures.query, kind="stable")
        first_row = np.searchsorted(closures.query[rows], np.arange(len(keyframes.stamp_ns) + 1))
        for node, stamp_ns in enumerate(keyframes.stamp_ns.tolist()):
            if node == 0:
                world_from_odom = world_from_body[0] @ geometry.inverse(keyframes.odom_from_body[0])
                optimised.write(stamp_ns, _path(stamp_ns, bodies))
                drifted = world_from_odom @ keyframes.odom_from_body
                odometry.write(stamp_ns, _path(stamp_ns, _parts(drifted)))
                optimised_points.write(stamp_ns, _points(stamp_ns, world_from_body, _GREEN))
                odometry_points.write(stamp_ns, _points(stamp_ns, drifted, _GREY))
                scene.write(stamp_ns, _scene(stamp_ns, world_from_body, graph, closures))
                if camera is not None:
                    [part] = _parts(camera.body_from_camera[None])
                    static.write(stamp_ns, _transform(stamp_ns, BODY, CAMERA, part))
            transforms.write(stamp_ns, _transform(stamp_ns, MAP, BODY, bodies[node]))
            for row in rows[first_row[node] : first_row[node + 1]].tolist():
                parts = relative[row], covariance[row]
                ledger.write(stamp_ns, _loop_closure(loop_closure(), row, closures, *parts, keyframes.stamp_ns))
            if node == len(keyframes.stamp_ns) - 1:
                optimised.write(stamp_ns, _path(stamp_ns, bodies))
        writer.finish()


class _Channel:
    """One topic of the file, with the schema of its messages."""

    def __init__(self, writer: Writer, topic: str, message: type[Message]) -> None:
        self._writer = writer
        schema = writer.register_schema(message.DESCRIPTOR.full_name, "protobuf", descriptor_set(message))
        self._id = writer.register_channel(topic, "protobuf", schema)
        self._sequence = 0

    def write(self, stamp_ns: int, message: Message) -> None:
        data = message.SerializeToString(deterministic=True)
        self._writer.add_message(self._id, stamp_ns, data, publish_time=stamp_ns, sequence=self._sequence)
        self._sequence += 1


def _path(stamp_ns: int, parts: list[Part]) -> PosesInFrame:
    message = PosesInFrame(frame_id=MAP)
    message.timestamp.FromNanoseconds(stamp_ns)
    for position, quaternion in parts:
        pose = message.poses.add()
        pose.position.x, pose.position.y, pose.position.z = position
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion
    return message


def _points(stamp_ns: int, poses: Floats, color: tuple[float, float, float, float]) -> PointCloud:
    """The positions of poses (R, 4, 4), all in one colour."""
    packed = np.zeros(len(poses), np.dtype([("position", "<f4", 3), ("color", "u1", 4)]))
    packed["position"] = poses[:, :3, 3]
    packed["color"] = np.round(255 * np.array(color))
    message = PointCloud(frame_id=MAP, point_stride=packed.itemsize, data=packed.tobytes())
    message.timestamp.FromNanoseconds(stamp_ns)
    message.pose.orientation.w = 1.0
    for at, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * at, type=PackedElementField.FLOAT32)
    for at, name in enumerate(("red", "green", "blue", "alpha")):
        message.fields.add(name=name, offset=12 + at, type=PackedElementField.UINT8)
    return message


def _transform(stamp_ns: int, parent: str, child: str, part: Part) -> FrameTransforms:
    message = FrameTransforms()
    transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    transform.timestamp.FromNanoseconds(stamp_ns)
    position, quaternion = part
    transform.translation.x, transform.translation.y, transform.translation.z = position
    transform.rotation.x, transform.rotation.y, transform.rotation.z, transform.rotation.w = quaternion
    return message


def _scene(stamp_ns: int, world_from_body: Floats, graph: PoseGraph, closures: Closures) -> SceneUpdate:
    """Odometry edges grey, accepted closures green, closures that the robust solve rejected red."""
    message = SceneUpdate()
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind], bool)
    accepted = np.array([verdict == Verdict.ACCEPTED for verdict in closures.verdict], bool)
    rejected = np.array([verdict == Verdict.REJECTED_BY_SOLVER for verdict in closures.verdict], bool)
    for name, a, b, color in (
        ("odometry", graph.a[odometry], graph.b[odometry], _GREY),
        ("closures accepted", closures.match[accepted], closures.query[accepted], _GREEN),
        ("closures rejected by the solver", closures.match[rejected], closures.query[rejected], _RED),
    ):
        entity = message.entities.add(frame_id=MAP, id=name)
        entity.timestamp.FromNanoseconds(stamp_ns)
        entity.metadata.add(key="edges", value=str(len(a)))
        lines = entity.lines.add(type=LinePrimitive.LINE_LIST, thickness=_THICKNESS_PX, scale_invariant=True)
        lines.pose.orientation.w = 1.0
        lines.color.CopyFrom(Color(r=color[0], g=color[1], b=color[2], a=color[3]))
        ends = np.stack([world_from_body[a, :3, 3], world_from_body[b, :3, 3]], axis=1).reshape(-1, 3)
        for x, y, z in ends.tolist():
            lines.points.add(x=x, y=y, z=z)
    return message


def _loop_closure(
    message: Any, row: int, closures: Closures, match_from_query: Part, covariance: Floats, stamp_ns: Ints
) -> Message:
    message.timestamp.FromNanoseconds(int(stamp_ns[closures.query[row]]))
    message.match_timestamp.FromNanoseconds(int(stamp_ns[closures.match[row]]))
    message.frame_id = BODY
    for name in ("query", "match", "rank", "support", "matches", "landmarks", "inliers", "reverse_inliers"):
        setattr(message, name, int(getattr(closures, name)[row]))
    message.shared_references.extend(closures.shared_references[row].tolist())
    message.shared_overlap.extend(closures.shared_overlap[row].tolist())
    message.scale = closures.scale[row]
    message.score, message.spread = float(closures.score[row]), float(closures.spread[row])
    position, quaternion = match_from_query
    message.tx_m, message.ty_m, message.tz_m = position
    message.qx, message.qy, message.qz, message.qw = quaternion
    information = closures.information[row]
    if np.isfinite(information).all():
        message.information.extend(information.reshape(-1).tolist())
    if np.isfinite(covariance).all():
        message.covariance.extend(covariance.reshape(-1).tolist())
    message.verdict, message.reason = closures.verdict[row].value, closures.verdict[row].sentence
    message.residual_before_sigma = float(closures.residual_before[row])
    message.residual_after_sigma = float(closures.residual_after[row])
    message.weight = float(closures.weight[row])
    return message


def _parts(poses: Floats) -> list[Part]:
    """The parts of poses (R, 4, 4), all at once: row by row, numpy takes most of the time of a large file."""
    return list(zip(poses[:, :3, 3].tolist(), geometry.quaternion(poses[:, :3, :3]).tolist(), strict=True))
