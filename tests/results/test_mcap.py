from __future__ import annotations

import dataclasses
import importlib.util
import io
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from tests.rerun import rerun
from tests.results.example import COUNT, METADATA, Run, make_run
from vplog.data import ACCEPTED, Closures, EdgeKind, Keyframes, Verdict
from vplog.geometry import se3
from vplog.results.mcap import McapExtras, write_mcap

if TYPE_CHECKING:
    from pathlib import Path

RUN = make_run()


def write(path: Path, run: Run = RUN) -> bytes:
    write_mcap(
        path,
        run.keyframes,
        run.solution.world_from_body,
        run.graph,
        run.closures,
        METADATA,
        McapExtras(camera=run.camera),
    )
    return path.read_bytes()


def decode(data: bytes) -> list[tuple[str, int, Any]]:
    """Topic, log time and message, in the order of the file, decoded with nothing but the schemas in the file."""
    classes: dict[int, Any] = {}
    messages = []
    for schema, channel, message in make_reader(io.BytesIO(data), validate_crcs=True).iter_messages(
        log_time_order=False
    ):
        assert schema is not None
        if schema.id not in classes:
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file)
            classes[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
        assert message.publish_time == message.log_time
        messages.append((channel.topic, message.log_time, classes[schema.id].FromString(message.data)))
    return messages


def of(messages: list[tuple[str, int, Any]], topic: str) -> list[tuple[int, Any]]:
    return [(time, message) for name, time, message in messages if name == topic]


def matrix(position: Any, quaternion: Any) -> Any:
    rotation = se3.rotation(np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w]))
    return se3.pose(rotation, np.array([position.x, position.y, position.z]))


def test_every_record_is_whole_and_in_order_of_time(tmp_path: Path) -> None:
    data = write(tmp_path / "result.mcap")
    assert len(list(StreamReader(io.BytesIO(data), validate_crcs=True, emit_chunks=False).records)) > COUNT
    times = [time for _, time, _ in decode(data)]
    assert times == sorted(times)
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}


def test_same_run_same_bytes(tmp_path: Path) -> None:
    assert write(tmp_path / "one.mcap") == write(tmp_path / "two.mcap")


def test_metadata_says_what_made_it(tmp_path: Path) -> None:
    data = write(tmp_path / "result.mcap")
    [record] = list(make_reader(io.BytesIO(data)).iter_metadata())
    assert record.name == "vplog"
    assert json.loads(record.metadata["settings"]) == METADATA.settings
    assert record.metadata["library"] == METADATA.library
    assert record.metadata["drive"] == RUN.keyframes.drive


def test_paths_are_the_poses_in_the_map_frame(tmp_path: Path) -> None:
    messages = decode(write(tmp_path / "result.mcap"))
    world = RUN.solution.world_from_body
    optimised, odometry = of(messages, "/path/optimised"), of(messages, "/path/odometry")
    assert [time for time, _ in optimised] == RUN.keyframes.stamp_ns[[0, -1]].tolist()
    assert [time for time, _ in odometry] == RUN.keyframes.stamp_ns[:1].tolist()
    for _, path in optimised:
        assert path.frame_id == "map"
        poses = np.array([matrix(pose.position, pose.orientation) for pose in path.poses])
        np.testing.assert_allclose(poses, world, atol=1e-12)
    assert odometry[0][1].frame_id == "map"
    poses = np.array([matrix(pose.position, pose.orientation) for pose in odometry[0][1].poses])
    np.testing.assert_allclose(poses[0], world[0], atol=1e-12)
    odom = RUN.keyframes.odom_from_body
    np.testing.assert_allclose(se3.between(poses[:1], poses), se3.between(odom[:1], odom), atol=1e-12)


def test_transforms_put_the_body_in_the_map_and_the_camera_on_the_body(tmp_path: Path) -> None:
    messages = decode(write(tmp_path / "result.mcap"))
    moving = of(messages, "/tf")
    assert [time for time, _ in moving] == RUN.keyframes.stamp_ns.tolist()
    for row, (time, message) in enumerate(moving):
        [transform] = message.transforms
        assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "base_link")
        assert transform.timestamp.ToNanoseconds() == time
        found = matrix(transform.translation, transform.rotation)
        np.testing.assert_allclose(found, RUN.solution.world_from_body[row], atol=1e-12)
    [(_, static)] = of(messages, "/tf_static")
    root, fixed, *pictures = static.transforms
    assert (root.parent_frame_id, root.child_frame_id) == ("tf#/", "map")  # where rerun's 3D view begins
    np.testing.assert_array_equal(matrix(root.translation, root.rotation), np.eye(4))
    # where pictures that no camera took are shown
    assert [(one.parent_frame_id, one.child_frame_id) for one in pictures] == [("map", "reference"), ("map", "closure")]
    assert (fixed.parent_frame_id, fixed.child_frame_id) == ("base_link", "camera")
    found = matrix(fixed.translation, fixed.rotation)
    np.testing.assert_allclose(found, RUN.camera.body_from_camera, atol=1e-12)


def test_graph_shows_edges_in_the_colour_of_their_fate(tmp_path: Path) -> None:
    [(_, scene)] = of(decode(write(tmp_path / "result.mcap")), "/graph")
    odometry, accepted, partly, rejected = scene.entities
    assert {entity.frame_id for entity in scene.entities} == {"map"}
    assert len(odometry.lines[0].points) == 2 * RUN.graph.kind.count(EdgeKind.ODOMETRY)
    for entity, verdicts in (
        (accepted, ACCEPTED), (partly, [Verdict.DIRECTION_ONLY]), (rejected, [Verdict.REJECTED_BY_SOLVER]),
    ):  # fmt: skip
        rows = [RUN.closures.verdict.index(verdict) for verdict in verdicts]
        nodes = [node for row in rows for node in (RUN.closures.match[row], RUN.closures.query[row])]
        ends = RUN.solution.world_from_body[nodes, :3, 3]
        np.testing.assert_allclose([[p.x, p.y, p.z] for p in entity.lines[0].points], ends)
    assert accepted.lines[0].color.g > accepted.lines[0].color.r
    assert rejected.lines[0].color.r > rejected.lines[0].color.g


def test_every_ledger_row_is_a_message(tmp_path: Path) -> None:
    rows = of(decode(write(tmp_path / "result.mcap")), "/loop_closures")
    assert len(rows) == len(RUN.closures)
    for row, (time, message) in enumerate(rows):
        ledger = RUN.closures
        assert time == message.timestamp.ToNanoseconds() == RUN.keyframes.stamp_ns[ledger.query[row]]
        assert message.match_timestamp.ToNanoseconds() == RUN.keyframes.stamp_ns[ledger.match[row]]
        for name in ("query", "match", "rank", "score", "support", "matches", "landmarks", "inliers", "spread"):
            assert getattr(message, name) == getattr(ledger, name)[row], name
        assert (message.verdict, message.reason) == (ledger.verdict[row].value, ledger.verdict[row].sentence)
        np.testing.assert_equal(message.weight, ledger.weight[row])
        np.testing.assert_equal(message.residual_before_sigma, ledger.residual_before[row])
        np.testing.assert_equal(message.residual_after_sigma, ledger.residual_after[row])
        np.testing.assert_equal(message.tx_m, ledger.match_from_query[row, 0, 3])
        assert message.reverse_inliers == ledger.reverse_inliers[row]
        assert message.scale == ledger.scale[row]
        assert list(message.shared_references) == ledger.shared_references[row].tolist()
        assert list(message.shared_overlap) == ledger.shared_overlap[row].tolist()
        known = np.isfinite(ledger.weight[row])
        assert len(message.covariance) == (36 if known else 0)
        assert list(message.information) == (ledger.information[row].ravel().tolist() if known else [])


@pytest.mark.parametrize("count", [0, 1])
def test_drive_without_closures_or_keyframes(tmp_path: Path, count: int) -> None:
    nothing = Closures(**{f.name: getattr(RUN.closures, f.name)[:0] for f in dataclasses.fields(Closures)})
    keyframes = Keyframes("short", RUN.keyframes.stamp_ns[:count], RUN.keyframes.odom_from_body[:count])
    graph = dataclasses.replace(RUN.graph, a=RUN.graph.a[:0], b=RUN.graph.b[:0], kind=[])
    write_mcap(tmp_path / "r", keyframes, RUN.solution.world_from_body[:count], graph, nothing, METADATA)
    assert len(decode((tmp_path / "r").read_bytes())) == (8 if count else 0)


@pytest.mark.skipif(importlib.util.find_spec("rerun_cli") is None, reason="rerun-sdk is not installed")
def test_rerun_opens_it(tmp_path: Path) -> None:
    """Rerun makes poses and named transforms of it, not raw bytes."""
    write(tmp_path / "result.mcap")
    rerun(tmp_path, "mcap", "convert", "result.mcap", "-o", "result.rrd")
    chunks = rerun(tmp_path, "rrd", "print", "result.rrd").splitlines()
    for entity, rows, component in (
        ("/path/optimised", 2, "InstancePoses3D:translations"),
        ("/path/odometry", 1, "CoordinateFrame:frame"),
        ("/path/optimised_points", 1, "Points3D:positions"),
        ("/path/odometry_points", 1, "Points3D:positions"),
        ("/tf", COUNT, "Transform3D:translation"),
        ("/tf_static", 4, "Transform3D:child_frame"),
        ("/graph", 1, "foxglove.SceneUpdate:message"),
        ("/loop_closures", len(RUN.closures), "vplog.LoopClosure:message"),
    ):
        assert any(f"with {rows} rows" in c and f"- {entity} -" in c and component in c for c in chunks), entity
    frames = rerun(tmp_path, "rrd", "print", "-vvv", "--entity", "/tf", "result.rrd")
    assert "base_link" in frames
    assert "map" in frames
