"""A finished run in the formats of other tools."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import collect_warnings
from vplog.geometry import tum
from vplog.results import geo, poses, tables
from vplog.results.foxglove_layout import foxglove_layout
from vplog.results.geo import Earth
from vplog.results.mcap_read import read_topics
from vplog.results.report.page import Tracks
from vplog.results.rrd import write_rrd
from vplog.results.run_record import piece_warnings, read_single_run, unit_warnings
from vplog.run.report import gather_tracks
from vplog.storage.scratch import replacing
from vplog.verbs.evaluate_run import TruthOptions
from vplog.verbs.export_images import FOLDERS, export_images
from vplog.verbs.report import judge

FORMATS = ("tum", "kitti", "euroc", "g2o", "geojson", "geoparquet", "kml", "utm", "rrd", "foxglove-layout")
"""Formats that are one file; two more are a folder."""


def export(
    folder: Path,
    kind: str,
    path: Path,
    log: Path | None = None,
    execution: Execution = Execution(),
    truth: str | None = None,
) -> dict[str, Any]:
    """Write the run in `folder` as one of `FORMATS` or `FOLDERS`; what was written. Raises VplogError.

    The pictures of a folder are those of the run's log, or of `log` in its place. `truth` is a TUM file or `auto`, the
    truth that comes with the log, which an rrd shows beside the solution.
    """
    record = read_single_run(folder)
    tracks = gather_tracks(folder, record)
    written, noted = [str(path)], list[str]()
    match kind:
        case _ if kind in FOLDERS:
            with collect_warnings() as noted:
                written = export_images(folder, record, kind, path, log, execution)
        case "tum":
            tum.write_tum(path, tracks.after)
        case "kitti":
            written.append(str(poses.write_kitti(path, tracks.after)))
        case "euroc":
            poses.write_euroc(path, tracks.after)
        case "g2o":
            _copy(folder / "graph.g2o", path, record.get("graph_sha256"))
        case "geojson" | "kml":
            closures, keyframes = tables.read_closures(folder / "closures.parquet"), tracks.keyframes
            where = _earth(folder, kind, tracks)
            tree = geo.feature_collection(where, tracks.world_from_body, keyframes.stamp_ns, closures)
            geo.write_geojson(path, tree) if kind == "geojson" else geo.write_kml(path, tree, keyframes.drive)
        case "utm":
            geo.write_utm(path, tracks.after, _earth(folder, kind, tracks))
        case "geoparquet":
            header = tables.read_metadata(folder / "trajectory.parquet")
            geo.write_geoparquet(path, tracks.after, _earth(folder, kind, tracks), header)
        case "rrd":
            closures = tables.read_closures(folder / "closures.parquet")
            judged = judge(folder, record, truth, None, TruthOptions(), log) if truth is not None else None
            if judged is not None and judged.path is None:
                raise ResultError("The log's truth is its fixes alone, which rrd does not show. Give --truth FILE.tum.")
            write_rrd(path, tracks, closures, folder / "result.mcap", judged)
        case "foxglove-layout":
            tree = foxglove_layout(read_topics(folder / "result.mcap"), tracks.world_from_body[:, :3, 3])
            with replacing(path) as stream:
                stream.write(f"{json.dumps(tree, indent=2)}\n".encode())
        case _:
            raise ResultError(f"No format {kind!r}. Formats: {', '.join([*FORMATS, *FOLDERS])}.")
    warnings = [*unit_warnings(record), *piece_warnings(record), *noted]
    poses_written = len(tracks.after.stamp_ns)
    return {"run": str(folder), "format": kind, "written": written, "poses": poses_written, "warnings": warnings}


def _copy(source: Path, path: Path, sha256: object) -> None:
    """Copy a file that has this sha256, if run.json names one. Raises ResultError."""
    try:
        data = source.read_bytes()
    except OSError as error:
        raise ResultError(f"Cannot read {source}: {error.strerror}. Write it again with `vplog run`.") from None
    if sha256 not in (None, hashlib.sha256(data).hexdigest()):
        raise ResultError(f"{source} does not have the sha256 that run.json names. Write it again with `vplog run`.")
    with replacing(path) as stream:
        stream.write(data)


def _earth(folder: Path, kind: str, tracks: Tracks) -> Earth:
    if tracks.earth is None:
        others = ", ".join(one for one in [*FORMATS, *FOLDERS] if not one.startswith(("geo", "kml", "utm")))
        raise ResultError(
            f"{folder} has fewer than three satellite fixes, so no place on earth, which {kind} needs. "
            f"Other formats: {others}."
        )
    return tracks.earth
