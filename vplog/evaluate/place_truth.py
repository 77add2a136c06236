"""The truth of two drives that --truth names: the frames it covers, and which of them show the same place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Gps, Trajectory
from vplog.errors import TruthError
from vplog.evaluate import pairs
from vplog.evaluate.truth import local_enu, read_truth
from vplog.storage.urls import shown

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Floats, Ints
    from vplog.evaluate.pairs import Pairs
    from vplog.stages import Log

DISTANCE_M = 6.0
"""m; two poses closer than this show the same place: a lane and a half, the radius of the field's KITTI protocols."""
HEADING_DEG = 45.0
"""Degrees between optical axes; a forward camera of 90 degrees still shares half its view."""
_USES = {
    "index": ("tolerance",),
    "csv": (),
    "poses": ("distance_m", "heading_deg"),
    "tum": ("distance_m", "heading_deg"),
    "gps": ("distance_m",),
}
"""What each kind of truth takes beside its name."""


@dataclass(frozen=True)
class TruthChoice:
    """The truth as the user names it."""

    source: str
    """`index`, `poses`, `gps`, a table FILE.csv, or FILE.tum[,MAPFILE.tum]."""
    tolerance: int | None = None
    """Frames, of `index`; None is 0."""
    distance_m: float | None = None
    """m, of `poses`, `gps` and TUM files; None is DISTANCE_M."""
    heading_deg: float | None = None
    """Degrees, of `poses` and TUM files; None is HEADING_DEG."""


@dataclass(frozen=True, eq=False)
class PlaceTruth:
    """The truth of a query and a map drive. Frames are numbered from 0 in the order of their drive."""

    about: dict[str, Any]
    """What it is, as plain values."""
    query_frames: Ints
    """Numbers of the query's frames it covers, increasing."""
    map_frames: Ints
    pairs: Callable[[Ints, Ints], Pairs]
    """True pairs of the rows of (Q,) query and (M,) map frames, numbers among the above, increasing."""


def open_truth(choice: TruthChoice, query: Log, other: Log) -> PlaceTruth:
    """The truth for a query drive and its map, the same object where a drive is compared with itself.

    Raises TruthError where it is missing, unreadable, covers no frame, or takes no such option.
    """
    kind = _kind(choice.source)
    for name in ("tolerance", "distance_m", "heading_deg"):
        if getattr(choice, name) is not None and name not in _USES[kind]:
            option = name.replace("_", "-")
            raise TruthError(f"--truth {shown(choice.source)} takes no --{option}: it is for {_takers(name)}.")
    distance_m = DISTANCE_M if choice.distance_m is None else choice.distance_m
    heading_deg = HEADING_DEG if choice.heading_deg is None else choice.heading_deg
    about: dict[str, Any]
    all_query, all_map = np.arange(len(query.stamps())), np.arange(len(other.stamps()))
    if kind == "index":
        tolerance = choice.tolerance or 0
        about = {"source": "index", "tolerance": tolerance}
        return PlaceTruth(about, all_query, all_map, lambda q, m: pairs.index_pairs(q, m, tolerance))
    if kind == "csv":
        listed = pairs.read_pairs(Path(choice.source), len(all_query), len(all_map))
        about = {"source": shown(choice.source), "listed": len(listed)}
        return PlaceTruth(about, all_query, all_map, lambda q, m: pairs.listed_pairs(listed, q, m))
    about = {"source": shown(choice.source), "distance_m": distance_m}
    if kind == "gps":
        (here, here_known), (there, there_known) = _fixes(query, other)

        def true_pairs(q: Ints, m: Ints) -> Pairs:
            return pairs.position_pairs(here[q], there[m], distance_m)
    else:
        trajectories = _odometry(query, other) if kind == "poses" else _files(choice.source)
        here, here_known = pairs.poses_at(trajectories[0], query.stamps())
        there, there_known = pairs.poses_at(trajectories[1], other.stamps())
        here_axis = pairs.optical_axis(query.camera().body_from_camera, here[here_known])
        there_axis = pairs.optical_axis(other.camera().body_from_camera, there[there_known])
        about["heading_deg"] = heading_deg

        def true_pairs(q: Ints, m: Ints) -> Pairs:
            return pairs.pose_pairs(here[q], there[m], distance_m, heading_deg, here_axis, there_axis)

    for name, known, log in (("query", here_known, query), ("map", there_known, other)):
        if not known.any():
            raise TruthError(
                f"--truth {shown(choice.source)} covers none of the {len(log.stamps())} frames of the {name} "
                f"{log.name}. Give the truth of this drive, in the log's clock."
            )
    return PlaceTruth(about, np.flatnonzero(here_known), np.flatnonzero(there_known), true_pairs)


def _kind(source: str) -> str:
    if source in ("index", "poses", "gps"):
        return source
    return "csv" if source.lower().endswith(".csv") else "tum"


def _takers(option: str) -> str:
    return " and ".join("a TUM file" if kind == "tum" else kind for kind, options in _USES.items() if option in options)


def _files(source: str) -> tuple[Trajectory, Trajectory]:
    """One TUM file for both drives, or one for each."""
    if Path(source).is_file() or "," not in source:
        truth = read_truth(source)
        return truth, truth
    here, _, there = source.partition(",")
    return read_truth(here), read_truth(there)


def _odometry(query: Log, other: Log) -> tuple[Trajectory, Trajectory]:
    def read(log: Log) -> Trajectory:
        odometry = log.odometry()
        if odometry is None or not len(odometry.stamp_ns):
            raise TruthError(f"{log.name} has no odometry, so --truth poses cannot tell. Choose another truth.")
        return Trajectory(odometry.stamp_ns, odometry.odom_from_body)

    return read(query), read(other)


def _fixes(query: Log, other: Log) -> list[tuple[Floats, Any]]:
    """East and north in m of both drives' frames in one plane, NaN and False where unknown.

    Heights are left out: satellites tell them two to three times worse, and roads rarely cross above each other.
    """
    fixes = []
    for log in (query, other):
        found = log.gps()
        if found is None or not len(found.stamp_ns):
            raise TruthError(f"{log.name} has no GPS fixes, so --truth gps cannot tell. Choose another truth.")
        fixes.append(found)
    together = {
        name: np.concatenate([getattr(part, name) for part in fixes])
        for name in ("stamp_ns", "latitude_deg", "longitude_deg", "altitude_m", "covariance")
    }
    count = len(fixes[0].stamp_ns)
    order, positions = local_enu(Gps(**{**together, "stamp_ns": np.arange(len(together["stamp_ns"]))}))
    result = []
    for log, mine in ((query, order < count), (other, order >= count)):
        stamp_ns, first = np.unique(together["stamp_ns"][order[mine]], return_index=True)
        result.append(pairs.positions_at(stamp_ns, positions[mine][first, :2], log.stamps()))
    return result
