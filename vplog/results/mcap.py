"""result.mcap: the run as Foxglove and rerun show it, every message in protobuf with the schema beside it.

Frames: `map` is the root, `base_link` the body, `camera` fixed on the body, `reference` and `closure` those of pictures
that no camera of the drive took. Topics are listed in `TOPICS`.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from vplog.data import ACCEPTED, Camera, Closures, Floats, Gps, Ints, Keyframes, PoseGraph, Verdict
from vplog.geometry import se3
from vplog.results import foxglove, geo
from vplog.results.foxglove import PoseVector
from vplog.results.geo import Earth
from vplog.results.messages import descriptor_set, loop_closure_class
from vplog.results.previews import jpeg
from vplog.results.tables import TableMetadata, covariance_of
from vplog.storage.image_file import image_size
from vplog.storage.json_records import canonical_json
from vplog.storage.scratch import replacing
from vplog.version import __version__

Timed = tuple[int, str, Message]
"""Log time in ns, topic, message."""

_CHUNK_BYTES = 1 << 20
"""A reader inflates one chunk at a time; 1 MiB is what the format's own tools write."""

PICTURES, REFERENCE, FIXES, EARTH = "/closures/picture", "/reference/image", "/gps", "/gps/optimised"
VIEWS = "closures.json"
"""Attachment of the matches, boxes and votes of closures."""
_CAMERA = "/cam/NAME"
TOPICS = {
    "/path/optimised": ("foxglove.PosesInFrame", "The keyframes as solved, at the start and the end of the drive."),
    "/path/odometry": ("foxglove.PosesInFrame", "The odometry, aligned at the first solved keyframe."),
    "/path/optimised_points": ("foxglove.PointCloud", "Positions of the solved keyframes, green."),
    "/path/odometry_points": ("foxglove.PointCloud", "Positions of the odometry, grey."),
    "/graph": (
        "foxglove.SceneUpdate",
        "Odometry grey, closures green, amber without metres, red where rejected by the solver.",
    ),
    "/graph/rejected": ("foxglove.SceneUpdate", "Candidates that geometry rejected, faint red."),
    "/tf_static": (
        "foxglove.FrameTransforms",
        "The camera on the body; the map in the root of rerun's 3D view; the frames of pictures in the map's origin.",
    ),
    "/tf": ("foxglove.FrameTransforms", "The body in the map, at each keyframe."),
    "/loop_closures": ("vplog.LoopClosure", "The ledger: one message for each candidate, at its query's stamp."),
    FIXES: ("foxglove.LocationFix", "The log's satellite fixes."),
    EARTH: ("foxglove.GeoJSON", "The path and the accepted closures on earth, where there are fixes."),
    REFERENCE: ("foxglove.CompressedImage", "The library image that explains the keyframe best; a blank one first."),
    "/reference/calibration": ("foxglove.CameraCalibration", "A pinhole of its size, which rerun places it by."),
    "/reference/annotations": (
        "foxglove.ImageAnnotations",
        "The boxes mined on it, numbered as the keyframe's windows.",
    ),
    PICTURES: (
        "foxglove.CompressedImage",
        "Candidates drawn; `pictures` in the metadata has their ledger rows in this order, null for the first, blank.",
    ),
    "/closures/calibration": ("foxglove.CameraCalibration", "A pinhole of their size, which rerun places them by."),
    f"{_CAMERA}/image": ("foxglove.CompressedImage", "The keyframe, downsized, at the log's own stamp."),
    f"{_CAMERA}/calibration": ("foxglove.CameraCalibration", "The camera's calibration, at the size of these images."),
    f"{_CAMERA}/annotations": (
        "foxglove.ImageAnnotations",
        "The parts found on the reference, numbered as their boxes.",
    ),
}
"""Schema and meaning of every topic; NAME stands for the camera."""


@dataclass(frozen=True, eq=False)
class ReferenceBoxes:
    """Where the parts of one keyframe were found on the reference that explains it best.

    All places are shares of an image's sides, x0 y0 x1 y1.
    """

    references: Sequence[int]
    """References that explain it, best first; the boxes are on the first."""
    windows: Floats
    """(I, 4) parts of the keyframe."""
    boxes: Floats
    """(I, 4) where each was found, NaN where it was not."""


@dataclass(frozen=True, eq=False)
class McapContent:
    """Pictures and fixes in result.mcap, which no table has; empty where the run was written without."""

    pictures: Mapping[int, bytes] = field(default_factory=dict)
    """JPEG of a candidate closure by its row in the ledger."""
    views: Mapping[int, dict[str, Any]] = field(default_factory=dict)
    """Matches, boxes and votes of a candidate closure by its row, see `closure_views.view`."""
    references: Mapping[int, bytes] = field(default_factory=dict)
    """JPEG of a reference of the library by its number."""
    gps: Gps | None = None
    thumbnails: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Small JPEGs of cameras beside the first, by number of the camera and row of the keyframe."""


@dataclass(frozen=True, eq=False, kw_only=True)
class McapExtras(McapContent):
    """Content of result.mcap beside the tables, all of it optional."""

    camera: Camera | None = None
    further_cameras: Sequence[Floats] = ()
    """body_from_camera (4, 4) of the cameras beside the first."""
    image: Callable[[int], bytes] | None = None
    """JPEG of a keyframe by its row."""
    image_size: tuple[int, int] = (0, 0)
    """Width and height in px of these JPEGs."""
    explained: Callable[[int], ReferenceBoxes | None] | None = None
    """By row of the keyframe."""
    earth: Earth | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    """Versions, input hashes: metadata of the file beside the settings, as plain values by name."""


def camera_topic(camera: Camera) -> str:
    """`/cam/NAME`, the name of the camera in letters that no viewer takes for something else."""
    return f"/cam/{re.sub('[^0-9A-Za-z_.-]+', '_', camera.name).strip('_') or 'camera'}"


def write_mcap(
    path: Path,
    keyframes: Keyframes,
    world_from_body: Floats,
    graph: PoseGraph,
    closures: Closures,
    metadata: TableMetadata,
    extras: McapExtras = McapExtras(),
) -> None:
    """Write the run; `world_from_body` (N, 4, 4) are the solved poses of the keyframes.

    Messages are in the order of their log time, which is the stamp of the keyframe or fix they are about; what is
    about the whole drive stands at its start, and the solved path once more at its end.
    """
    with replacing(path) as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library=f"vplog {__version__}")
        header = {key.removeprefix("vplog."): text for key, text in metadata.record().items()}
        about = {name: canonical_json(value) for name, value in extras.about.items()}
        if extras.pictures:
            about["pictures"] = canonical_json([None, *_picture_rows(closures, extras)])
        writer.add_metadata("vplog", {**header, "drive": keyframes.drive, **about})
        if len(keyframes.stamp_ns):
            start_ns = int(keyframes.stamp_ns[0])
            for number, data in sorted(extras.references.items()):
                writer.add_attachment(start_ns, start_ns, f"reference-{number}.jpg", "image/jpeg", data)
            for (number, row), data in sorted(extras.thumbnails.items()):
                writer.add_attachment(start_ns, start_ns, f"camera-{number}-keyframe-{row}.jpg", "image/jpeg", data)
            if extras.views:
                views = canonical_json({str(row): view for row, view in extras.views.items()}).encode()
                writer.add_attachment(start_ns, start_ns, VIEWS, "application/json", views)
        channels = _Channels(writer)
        solved = _solved(keyframes, world_from_body, graph, closures, extras)
        pictured = _camera_messages(keyframes, closures, extras.camera, extras) if extras.camera else iter(())
        for stamp_ns, topic, message in heapq.merge(solved, pictured, _fixes(extras), key=lambda timed: timed[0]):
            channels.write(stamp_ns, topic, message)
        writer.finish()


def _solved(
    keyframes: Keyframes, world_from_body: Floats, graph: PoseGraph, closures: Closures, extras: McapExtras
) -> Iterator[Timed]:  # fmt: skip
    """Paths, graph, transforms and ledger."""
    loop_closure = loop_closure_class()
    bodies, relative = se3.vectors(world_from_body).tolist(), se3.vectors(closures.match_from_query).tolist()
    covariance = covariance_of(closures.information)
    rows = np.argsort(closures.query, kind="stable")
    first_row = np.searchsorted(closures.query[rows], np.arange(len(keyframes.stamp_ns) + 1))
    for node, stamp_ns in enumerate(keyframes.stamp_ns.tolist()):
        if node == 0:
            drifted = world_from_body[0] @ se3.inverse(keyframes.odom_from_body[0]) @ keyframes.odom_from_body
            yield stamp_ns, "/path/optimised", foxglove.path(stamp_ns, bodies)
            yield stamp_ns, "/path/odometry", foxglove.path(stamp_ns, se3.vectors(drifted).tolist())
            # the same positions as points: rerun reads the paths, but draws point clouds
            yield stamp_ns, "/path/optimised_points", foxglove.points(stamp_ns, world_from_body, foxglove.GREEN)
            yield stamp_ns, "/path/odometry_points", foxglove.points(stamp_ns, drifted, foxglove.GREY)
            yield stamp_ns, "/graph", _graph(stamp_ns, world_from_body, graph, closures)
            yield stamp_ns, "/graph/rejected", _rejected(stamp_ns, world_from_body, closures)
            fixed = [(foxglove.RERUN_ROOT, foxglove.MAP, foxglove.IDENTITY)]
            if extras.camera is not None:
                for number, mount in enumerate([extras.camera.body_from_camera, *extras.further_cameras]):
                    fixed.append((foxglove.BODY, foxglove.camera_frame(number), se3.vectors(mount).tolist()))
                fixed += [(foxglove.MAP, frame, foxglove.IDENTITY) for frame in (foxglove.REFERENCE, foxglove.CLOSURE)]
            if extras.gps is not None and extras.gps.antenna_m is not None:
                fixed.append((foxglove.BODY, foxglove.GPS, [*extras.gps.antenna_m.tolist(), *foxglove.IDENTITY[3:]]))
            yield stamp_ns, "/tf_static", foxglove.transforms(stamp_ns, fixed)
            if extras.earth is not None:
                tree = geo.feature_collection(extras.earth, world_from_body, keyframes.stamp_ns, closures)
                yield stamp_ns, EARTH, foxglove.geojson(tree)
        yield stamp_ns, "/tf", foxglove.transforms(stamp_ns, [(foxglove.MAP, foxglove.BODY, bodies[node])])
        for row in rows[first_row[node] : first_row[node + 1]].tolist():
            pose = relative[row], covariance[row]
            yield stamp_ns, "/loop_closures", _loop_closure(loop_closure(), row, closures, *pose, keyframes.stamp_ns)
        if node and node == len(keyframes.stamp_ns) - 1:
            yield stamp_ns, "/path/optimised", foxglove.path(stamp_ns, bodies)


def _camera_messages(keyframes: Keyframes, closures: Closures, camera: Camera, extras: McapExtras) -> Iterator[Timed]:
    """The camera's pictures with what was found in them, at their exact stamps, and the pictures of closures."""
    topic, size = camera_topic(camera), extras.image_size
    if extras.image is None:
        size = camera.width, camera.height  # annotations then are drawn on the log's own images
    sizes = {number: image_size(data) or (0, 0) for number, data in extras.references.items()}
    pictures, shown = _picture_rows(closures, extras), {}
    if len(keyframes.stamp_ns):
        yield from _blanks(int(keyframes.stamp_ns[0]), extras, shown)
    for node, stamp_ns in enumerate(keyframes.stamp_ns.tolist()):
        if extras.image is not None or extras.explained is not None:
            yield stamp_ns, f"{topic}/calibration", foxglove.calibration(stamp_ns, camera, size)
        if extras.image is not None:
            yield stamp_ns, f"{topic}/image", foxglove.image(stamp_ns, foxglove.CAMERA, extras.image(node))
        found = extras.explained(node) if extras.explained is not None else None
        if found is not None and len(found.references):
            first = int(found.references[0])
            title = f"explained by {', '.join(f'reference {number}' for number in found.references[:3])}"
            windows = np.where(np.isfinite(found.boxes), found.windows, np.nan)
            yield stamp_ns, f"{topic}/annotations", foxglove.boxes(stamp_ns, windows, size, title)
            if first in sizes:
                yield from _picture(stamp_ns, REFERENCE, foxglove.REFERENCE, extras.references[first], shown)
                named = foxglove.boxes(stamp_ns, found.boxes, sizes[first], f"reference {first}")
                yield stamp_ns, "/reference/annotations", named
        while pictures and int(closures.query[pictures[0]]) == node:
            row = pictures.pop(0)
            yield from _picture(stamp_ns, PICTURES, foxglove.CLOSURE, extras.pictures[row], shown)


def _picture_rows(closures: Closures, extras: McapExtras) -> list[int]:
    """Rows of the ledger in the order of their pictures' messages."""
    return sorted(extras.pictures, key=lambda row: (int(closures.query[row]), row))


def _blanks(stamp_ns: int, extras: McapExtras, shown: dict[str, tuple[int, int]]) -> Iterator[Timed]:
    """A grey picture at the start of each topic of pictures: rerun marks a 3D view as faulty as long as one of its
    images has no frame yet."""
    for topic, frame, pictures in (
        (REFERENCE, foxglove.REFERENCE, extras.references),
        (PICTURES, foxglove.CLOSURE, extras.pictures),
    ):
        if pictures:
            width, height = image_size(pictures[min(pictures)]) or (1, 1)
            yield from _picture(stamp_ns, topic, frame, jpeg(np.full((height, width), 24, np.uint8), 75), shown)


def _picture(
    stamp_ns: int, topic: str, frame_id: str, data: bytes, shown: dict[str, tuple[int, int]]
) -> Iterator[Timed]:  # fmt: skip
    """A picture that no camera of the drive took, after a calibration where its topic's last, in `shown`, had another
    size."""
    size = image_size(data) or (0, 0)
    if shown.get(topic) != size:
        shown[topic] = size
        calibration = foxglove.picture_calibration(stamp_ns, frame_id, size)
        yield stamp_ns, f"{topic.rpartition('/')[0]}/calibration", calibration
    yield stamp_ns, topic, foxglove.image(stamp_ns, frame_id, data)


def _fixes(extras: McapExtras) -> Iterator[Timed]:
    if extras.gps is not None:
        for row, stamp_ns in enumerate(extras.gps.stamp_ns.tolist()):
            yield stamp_ns, FIXES, foxglove.fix(extras.gps, row)


class _Channels:
    """The topics of the file, each with the schema of its messages, from its first message on."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._ids: dict[str, int] = {}
        self._sequence: Counter[str] = Counter()

    def write(self, stamp_ns: int, topic: str, message: Message) -> None:
        if topic not in self._ids:
            name = message.DESCRIPTOR.full_name
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, "protobuf", descriptor_set(type(message)))
            self._ids[topic] = self._writer.register_channel(topic, "protobuf", self._schemas[name])
        data, sequence = message.SerializeToString(deterministic=True), self._sequence[topic]
        self._writer.add_message(self._ids[topic], stamp_ns, data, publish_time=stamp_ns, sequence=sequence)
        self._sequence[topic] += 1


_VERDICT_COLOURS = {
    "closures accepted": (ACCEPTED, foxglove.GREEN),
    "closures taken without metres": ((Verdict.DIRECTION_ONLY,), foxglove.AMBER),
    "closures rejected by the solver": ((Verdict.REJECTED_BY_SOLVER,), foxglove.RED),
}
"""Closures given to the solver: name, verdicts and colour."""


def _graph(stamp_ns: int, world_from_body: Floats, graph: PoseGraph, closures: Closures) -> SceneUpdate:
    """Odometry edges grey, closures in the colour of their verdict."""
    odometry = graph.odometry
    ends = world_from_body[:, :3, 3]
    named = [("odometry", np.stack([ends[graph.a[odometry]], ends[graph.b[odometry]]], 1), foxglove.GREY)]
    for name, (verdicts, color) in _VERDICT_COLOURS.items():
        named.append((name, closures.lines(ends, closures.of(*verdicts)), color))
    return foxglove.lines(stamp_ns, named)


def _rejected(stamp_ns: int, world_from_body: Floats, closures: Closures) -> SceneUpdate:
    """Candidates that are not in the graph, faint and on a topic of their own, since they are many."""
    given = closures.of(*(one for verdicts, _ in _VERDICT_COLOURS.values() for one in verdicts))
    ends = closures.lines(world_from_body[:, :3, 3], ~given)
    return foxglove.lines(stamp_ns, [("candidates not in the graph", ends, foxglove.FAINT_RED)])


def _loop_closure(
    message: Any, row: int, closures: Closures, match_from_query: PoseVector, covariance: Floats, stamp_ns: Ints
) -> Message:
    message.timestamp.FromNanoseconds(int(stamp_ns[closures.query[row]]))
    message.match_timestamp.FromNanoseconds(int(stamp_ns[closures.match[row]]))
    message.frame_id = foxglove.BODY
    for name in ("query", "match", "rank", "support", "matches", "landmarks", "inliers", "reverse_inliers"):
        setattr(message, name, int(getattr(closures, name)[row]))
    message.shared_references.extend(closures.shared_references[row].tolist())
    message.shared_overlap.extend(closures.shared_overlap[row].tolist())
    message.scale = closures.scale[row]
    numbers = {name: getattr(closures, name)[row] for name in ("score", "spread", "weight")}
    numbers |= {f"{name}_sigma": getattr(closures, name)[row] for name in ("residual_before", "residual_after")}
    numbers |= zip(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), match_from_query, strict=True)
    for name, value in numbers.items():
        setattr(message, name, float(value))
    for name, matrix in (("information", closures.information[row]), ("covariance", covariance)):
        if np.isfinite(matrix).all():
            getattr(message, name).extend(matrix.reshape(-1).tolist())
    message.verdict, message.reason = closures.verdict[row].value, closures.verdict[row].sentence
    return message
