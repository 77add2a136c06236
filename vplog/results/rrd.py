"""A recording for rerun: both paths, the closures and their pictures, the body with its camera, errors over time, the
way on earth and the truth where they are known, and the blueprint that lays them out."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import ACCEPTED, Closures, Floats, Ints, Verdict
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.results.geo import on_earth
from vplog.results.mcap_read import read_camera_poses, read_images, read_topics
from vplog.results.report.page import Tracks, TruthComparison
from vplog.storage.scratch import replacing

_GREY, _BLUE, _GREEN, _RED = (150, 150, 150), (60, 130, 240), (40, 200, 80), (230, 50, 50)
_AMBER, _VIOLET = (240, 180, 30), (170, 90, 220)
_APPLICATION, _TIMELINE = "vplog", "stamp"
_CAMERA, _PICTURES = "map/body/camera", "closures/picture"


def write_rrd(
    path: Path, tracks: Tracks, closures: Closures, result: Path, judged: TruthComparison | None = None
) -> None:
    """Write with rerun's own SDK; the camera's pictures are those of the run's result.mcap, `result`.

    Raises ResultError where the SDK is not installed, a file cannot be read, or this one not be written.
    """
    try:
        import rerun as rr
    except ImportError:
        raise ResultError(
            "The .rrd format is written by rerun's SDK, which is not installed. Install it: pip install rerun-sdk"
        ) from None
    recording = rr.RecordingStream(_APPLICATION, recording_id=f"vplog-{tracks.keyframes.drive}")
    with replacing(path) as file:  # rerun's own writer hides a full disk
        stream = recording.binary_stream()
        recording.send_blueprint(_blueprint(tracks, read_topics(result)))
        origin = se3.far_origin(tracks.world_from_body)
        _log(recording, rr, tracks, closures, origin)
        _log_errors(recording, rr, tracks, closures, judged, origin)
        _log_camera(recording, rr, result)
        for row, picture in tracks.found.pictures.items():
            recording.set_time(_TIMELINE, timestamp=_time(tracks.keyframes.stamp_ns[closures.query[row]]))
            recording.log(_PICTURES, rr.EncodedImage(contents=picture, media_type="image/jpeg"))
        file.write(stream.read() or b"")
        recording.disconnect()


def _log(recording: Any, rr: Any, tracks: Tracks, closures: Closures, origin: Floats) -> None:
    """Paths and closures, `origin` (3,) taken off their positions."""
    recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.AnyValues(origin_m=origin), static=True)
    for name, trajectory, colour in (("odometry", tracks.before, _GREY), ("optimised", tracks.after, _BLUE)):
        strip = rr.LineStrips3D([trajectory.world_from_body[:, :3, 3] - origin], colors=[colour])
        recording.log(f"map/path/{name}", strip, static=True)
    ends = tracks.world_from_body[:, :3, 3] - origin
    for name, verdicts, colour in (
        ("accepted", ACCEPTED, _GREEN),
        ("without_metres", (Verdict.DIRECTION_ONLY,), _AMBER),
        ("rejected_by_solver", (Verdict.REJECTED_BY_SOLVER,), _RED),
    ):
        lines = rr.LineStrips3D(closures.lines(ends, closures.of(*verdicts)), colors=[colour])
        recording.log(f"map/closures/{name}", lines, static=True)
    if tracks.earth is not None:
        where = on_earth(tracks.earth, tracks.after.world_from_body)[:, [1, 0]]
        recording.log("earth/optimised", rr.GeoLineStrings(lat_lon=[where], colors=[_BLUE]), static=True)
    recording.send_columns(
        "map/body",
        indexes=[rr.TimeColumn(_TIMELINE, timestamp=_time(tracks.keyframes.stamp_ns))],
        columns=rr.Transform3D.columns(translation=ends, quaternion=se3.vectors(tracks.world_from_body)[:, 3:]),
    )


def _blueprint(tracks: Tracks, topics: Collection[str]) -> Any:
    """Map beside the pictures that there are, errors over time below; no view that asks servers for tiles of a map."""
    import rerun.blueprint as rrb

    pictures: list[Any] = []
    if any(topic.startswith("/cam/") for topic in topics):
        pictures.append(rrb.Spatial2DView(origin=f"{_CAMERA}/image", name="Camera"))
    if tracks.found.pictures:
        pictures.append(rrb.Spatial2DView(origin=_PICTURES, name="Closures"))
    space = rrb.Spatial3DView(origin="map", name="Map")
    upper = rrb.Horizontal(space, rrb.Vertical(*pictures), column_shares=[3, 2]) if pictures else space
    plots = [
        rrb.TimeSeriesView(origin="errors/sigma", name="Residual of accepted closures in sigma"),
        rrb.TimeSeriesView(origin="errors/distance", name="Distance from the solution"),
    ]
    panels = rrb.TimePanel(timeline=_TIMELINE, state="collapsed"), rrb.SelectionPanel(state="collapsed")
    return rrb.Blueprint(rrb.Vertical(upper, rrb.Horizontal(*plots), row_shares=[3, 1]), *panels)


def _log_errors(
    recording: Any, rr: Any, tracks: Tracks, closures: Closures, judged: TruthComparison | None, origin: Floats
) -> None:
    """Residuals of accepted closures at their queries' stamps, and distances of the solved keyframes from the odometry
    and from the truth."""
    rows = np.flatnonzero(closures.accepted)
    rows = rows[np.argsort(closures.query[rows], kind="stable")]
    stamp_ns, keyframes = tracks.keyframes.stamp_ns, tracks.world_from_body
    for name, sigma, colour in (
        ("before", closures.residual_before, _GREY),
        ("after", closures.residual_after, _GREEN),
    ):
        style = rr.SeriesPoints(colors=colour, names=name, markers="circle", marker_sizes=2)
        _series(recording, rr, f"errors/sigma/{name}", style, stamp_ns[closures.query[rows]], sigma[rows])
    odometry = keyframes[:1] @ se3.inverse(tracks.keyframes.odom_from_body[:1]) @ tracks.keyframes.odom_from_body
    distances = [("odometry", np.linalg.norm((odometry - keyframes)[:, :3, 3], axis=1), _GREY)]
    if judged is not None and judged.error_m is not None and judged.path is not None:
        distances.append(("truth", judged.error_m, _VIOLET))
        recording.log("map/path/truth", rr.LineStrips3D([judged.path - origin], colors=[_VIOLET]), static=True)
    for name, distance, colour in distances:
        style = rr.SeriesLines(colors=colour, names=f"to the {name}")
        _series(recording, rr, f"errors/distance/{name}", style, stamp_ns, distance)


def _series(recording: Any, rr: Any, entity: str, style: Any, stamp_ns: Ints, values: Floats) -> None:
    known = np.isfinite(values)
    recording.log(entity, style, static=True)
    recording.send_columns(
        entity,
        indexes=[rr.TimeColumn(_TIMELINE, timestamp=_time(stamp_ns[known]))],
        columns=rr.Scalars.columns(scalars=values[known]),
    )


def _time(stamp_ns: Any) -> Any:
    return stamp_ns.astype("datetime64[ns]")


def _log_camera(recording: Any, rr: Any, result: Path) -> None:
    """The camera on the body, and its pictures."""
    for placed in read_camera_poses(result)[:1]:
        transform = rr.Transform3D(translation=placed[:3, 3], mat3x3=placed[:3, :3])
        recording.log(_CAMERA, transform, static=True)
    known = False
    for picture in read_images(result):
        if picture.matrix is not None and not known:
            pinhole = rr.Pinhole(
                image_from_camera=picture.matrix, resolution=picture.size, camera_xyz=rr.ViewCoordinates.RDF
            )
            recording.log(_CAMERA, pinhole, static=True)
            known = True
        recording.set_time(_TIMELINE, timestamp=np.datetime64(picture.stamp_ns, "ns"))
        recording.log(f"{_CAMERA}/image", rr.EncodedImage(contents=picture.image, media_type="image/jpeg"))
