"""A recording for rerun: both paths, the closures, the body with its camera, and the way on earth where it is known."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import ACCEPTED, Closures, Verdict
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.results.geo import on_earth
from vplog.results.mcap_read import read_camera_pose, read_images
from vplog.storage.scratch import put_in_place

if TYPE_CHECKING:
    from vplog.results.report.page import Tracks

_GREY, _BLUE, _GREEN, _RED = (150, 150, 150), (60, 130, 240), (40, 200, 80), (230, 50, 50)
_AMBER = (240, 180, 30)
_APPLICATION = "vplog"


def write_rrd(path: Path, tracks: Tracks, closures: Closures, result: Path) -> None:
    """Write with rerun's own SDK; the camera's pictures are those of the run's result.mcap, `result`.

    Raises ResultError where the SDK is not installed, a file cannot be read, or this one not be written.
    """
    try:
        import rerun as rr
    except ImportError:
        raise ResultError(
            "The .rrd format is written by rerun's SDK, which is not installed: pip install rerun-sdk"
        ) from None
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    recording = rr.RecordingStream(_APPLICATION, recording_id=f"vplog-{tracks.keyframes.drive}")
    try:
        recording.save(part)
        _log(recording, rr, tracks, closures)
        _log_camera(recording, rr, result)
        recording.disconnect()
        put_in_place(part, path)
    except OSError as error:
        raise ResultError(f"Cannot write {path}: {error.strerror or error}. Choose another with -o.") from None
    finally:
        part.unlink(missing_ok=True)


def _log(recording: Any, rr: Any, tracks: Tracks, closures: Closures) -> None:
    recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for name, trajectory, colour in (("odometry", tracks.before, _GREY), ("optimised", tracks.after, _BLUE)):
        strip = rr.LineStrips3D([trajectory.world_from_body[:, :3, 3]], colors=[colour])
        recording.log(f"map/path/{name}", strip, static=True)
    ends = tracks.world_from_body[:, :3, 3]
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
        indexes=[rr.TimeColumn("stamp", timestamp=tracks.keyframes.stamp_ns.astype("datetime64[ns]"))],
        columns=rr.Transform3D.columns(translation=ends, quaternion=se3.vectors(tracks.world_from_body)[:, 3:]),
    )


def _log_camera(recording: Any, rr: Any, result: Path) -> None:
    """The camera on the body, and its pictures."""
    placed = read_camera_pose(result)
    if placed is not None:
        transform = rr.Transform3D(translation=placed[:3, 3], mat3x3=placed[:3, :3])
        recording.log("map/body/camera", transform, static=True)
    known = False
    for picture in read_images(result):
        if picture.matrix is not None and not known:
            pinhole = rr.Pinhole(
                image_from_camera=picture.matrix, resolution=picture.size, camera_xyz=rr.ViewCoordinates.RDF
            )
            recording.log("map/body/camera", pinhole, static=True)
            known = True
        recording.set_time("stamp", timestamp=np.datetime64(picture.stamp_ns, "ns"))
        recording.log("map/body/camera/image", rr.EncodedImage(contents=picture.image, media_type="image/jpeg"))
