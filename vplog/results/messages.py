"""Our own MCAP message, `vplog.LoopClosure`, defined once: the class, its .proto text and the table of its fields."""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.message import Message

FILE = "vplog/LoopClosure.proto"
_ABOUT = "One row of the loop closure ledger: a candidate, accepted or not, and what became of it."

LOOP_CLOSURE_FIELDS = (
    ("timestamp", "google.protobuf.Timestamp", "Stamp of the query keyframe."),
    ("match_timestamp", "google.protobuf.Timestamp", "Stamp of the match keyframe."),
    ("frame_id", "string", "Body frame, at the match, that the pose is given in."),
    ("query", "int32", "Keyframe row, the later one."),
    ("match", "int32", "Keyframe row, the earlier one."),
    ("rank", "int32", "Place among the query's candidates, 0 is the best."),
    ("score", "float", "The recogniser's similarity, on its own scale."),
    ("support", "int32", "Neighbours of the pair that agree by sequence; 0 without a sequence."),
    ("matches", "int32", "Feature matches that passed the ratio and mutual tests."),
    ("landmarks", "int32", "Matches with a known 3D position in the map frame."),
    ("inliers", "int32", "Matches that agree with the pose, or with the epipolar geometry."),
    ("spread", "float", "Share of the query image that the inliers' bounding box covers, 0 to 1."),
    ("tx_m", "double", "match_from_query: position in m, NaN where no pose was found."),
    ("ty_m", "double", ""),
    ("tz_m", "double", ""),
    ("qx", "double", "match_from_query: unit quaternion, qw >= 0, NaN where no pose was found."),
    ("qy", "double", ""),
    ("qz", "double", ""),
    ("qw", "double", ""),
    ("information", "repeated double", "6x6 row by row, rotation (rad) before translation (m); empty without a pose."),
    ("verdict", "string", "What became of the candidate."),
    ("reason", "string", "The verdict in one sentence."),
    ("residual_before_sigma", "double", "Mahalanobis distance to the odometry, NaN where not in the graph."),
    ("residual_after_sigma", "double", "Mahalanobis distance to the solution, NaN where not in the graph."),
    ("weight", "double", "Weight of the robust solve, 0 to 1, NaN where not in the graph."),
    ("shared_references", "repeated uint32", "References of the library that explain both; empty without boxes."),
    ("shared_overlap", "repeated float", "Of each, the share of a box that the two have in common, 0 to 1."),
    ("reverse_inliers", "int32", "Inliers from match to query, -1 where not tried."),
    ("scale", "string", "Where the metres of the pose come from: `odometry`, `depth`, `stereo` or `none`."),
    ("covariance", "repeated double", "The inverse of the information; empty without a pose."),
)
"""Name, type and description; the number of a field is its place here, from 1. Only ever add to the end."""

_FIELD = descriptor_pb2.FieldDescriptorProto


def _file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name=FILE, package="vplog", syntax="proto3")
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    message = file.message_type.add(name="LoopClosure")
    for number, (name, kind, _) in enumerate(LOOP_CLOSURE_FIELDS, start=1):
        repeated, _, base = kind.rpartition(" ")
        field = message.field.add(name=name, number=number)
        field.label = _FIELD.LABEL_REPEATED if repeated else _FIELD.LABEL_OPTIONAL
        if "." in base:
            field.type, field.type_name = _FIELD.TYPE_MESSAGE, f".{base}"
        else:
            field.type = _FIELD.Type.Value(f"TYPE_{base.upper()}")
    return file


def loop_closure_class() -> Any:
    """The message class. A pool of its own: two versions of the package may live in one process."""
    pool = descriptor_pool.DescriptorPool()
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    pool.Add(timestamp)
    pool.Add(_file_descriptor())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("vplog.LoopClosure"))


def loop_closure_proto() -> str:
    """The text of vplog.LoopClosure.proto."""
    lines = ['syntax = "proto3";', "", 'import "google/protobuf/timestamp.proto";', "", "package vplog;", ""]
    lines += [f"// {_ABOUT}", "message LoopClosure {"]
    for number, (name, kind, description) in enumerate(LOOP_CLOSURE_FIELDS, start=1):
        if description:
            lines.append(f"  // {description}")
        lines.append(f"  {kind} {name} = {number};")
    return "\n".join([*lines, "}", ""])


def descriptor_set(message: type[Message]) -> bytes:
    """The FileDescriptorSet that MCAP stores for a message: its file after all those it imports."""
    files: dict[str, Any] = {}

    def add(file: Any) -> None:
        for imported in file.dependencies:
            add(imported)
        files.setdefault(file.name, file)

    add(message.DESCRIPTOR.file)
    found = descriptor_pb2.FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(found.file.add())
    return found.SerializeToString(deterministic=True)
