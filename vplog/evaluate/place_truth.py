"""The truth of two drives that --truth names: the frames it covers, and which of them show the same place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Bools, Floats, Gps, Ints, Trajectory
from vplog.errors import TruthError
from vplog.evaluate import pairs
from vplog.evaluate.image_names import folders_of, numbers_of, utm_of
from vplog.evaluate.pairs import Pairs
from vplog.evaluate.truth import local_enu, read_truth
from vplog.evaluate.truth_tables import labels_by_row, listed_rows, read_array, read_table
from vplog.geometry import se3
from vplog.stages import Log
from vplog.storage.urls import shown

DISTANCE_M = 6.0
"""m; two poses closer than this show the same place: a lane and a half, the radius of the field's KITTI protocols."""
HEADING_DEG = 45.0
"""Degrees between optical axes; a forward camera of 90 degrees still shares half its view."""
UTM_DISTANCE_M = 25.0
"""m; two pictures of street level closer than this show the same place: the bound that sets with UTM names come with
(Berton et al., Deep visual geo-localization benchmark, CVPR 2022)."""
_USES = {
    "index": ("tolerance",),
    "csv": (),
    "npy": (),
    "labels": (),
    "utm": ("distance_m", "heading_deg"),
    "poses": ("distance_m", "heading_deg"),
    "tum": ("distance_m", "heading_deg"),
    "gps": ("distance_m",),
}
"""Options of each kind of truth."""


@dataclass(frozen=True)
class TruthChoice:
    """The truth as the user names it."""

    source: str
    """`index`, `labels`, `utm`, `poses`, `gps`, a table FILE.csv or FILE.npy, or FILE.tum[,MAPFILE.tum]."""
    tolerance: int | None = None
    """Frames, of `index`; None is 0."""
    distance_m: float | None = None
    """m, of `poses`, `utm`, `gps` and TUM files; None is DISTANCE_M, of `utm` UTM_DISTANCE_M."""
    heading_deg: float | None = None
    """Degrees, of `poses`, `utm` and TUM files; None is HEADING_DEG, and for `utm` any heading."""
    transposed: bool = False
    """Whether a table of pairs names the map's frames first."""

    def __post_init__(self) -> None:
        """Raises TruthError where the kind takes no such option."""
        for name in ("tolerance", "distance_m", "heading_deg"):
            if getattr(self, name) is not None and name not in _USES[self.kind]:
                option = name.replace("_", "-")
                raise TruthError(f"--truth {shown(self.source)} takes no --{option}: it is for {_takers(name)}.")

    @property
    def kind(self) -> str:
        """One of the names of `_USES`."""
        if self.source in _USES and self.source not in ("csv", "npy", "tum"):
            return self.source
        suffix = Path(self.source).suffix.lower()
        return suffix[1:] if suffix in (".csv", ".npy") else "tum"

    @property
    def lists_pairs(self) -> bool:
        """Whether it is a table of the pairs of one query and one map."""
        if self.kind == "csv" and Path(self.source).is_file():
            return read_table(Path(self.source))[0] == ["query", "match"]
        return self.kind == "npy"

    @property
    def is_labels(self) -> bool:
        """Whether it gives every image its place: by its folder, or by one table or two."""
        return self.kind == "labels" or (self.kind == "csv" and not self.lists_pairs)


@dataclass(frozen=True, eq=False)
class PlaceTruth:
    """The truth of a query and a map drive. Frames are numbered from 0 in the order of their drive."""

    about: dict[str, Any]
    """The choice as plain values; `same_place` says in words which pairs are true."""
    query_frames: Ints
    """Numbers of the query's frames it covers, increasing."""
    map_frames: Ints
    pairs: Callable[[Ints, Ints], Pairs]
    """True pairs of the rows of (Q,) query and (M,) map frames, numbers among the above, increasing."""


def no_truth(query: Log, other: Log) -> PlaceTruth:
    """The truth of drives of which none is known: it covers all frames, and no pair is true."""
    none = np.zeros((0, 2), np.int64)
    here, there = (np.arange(len(log.stamps())) for log in (query, other))
    return PlaceTruth({"source": None}, here, there, lambda q, m: pairs.listed_pairs(none, q, m))


def open_truth(choice: TruthChoice, query: Log, other: Log) -> PlaceTruth:
    """The truth for a query drive and its map, the same object where a drive is compared with itself.

    Raises TruthError where it is missing, unreadable or covers no frame.
    """
    about, here_known, there_known, true_pairs = _KINDS[choice.kind](choice, query, other)
    for name, known, log in (("query", here_known, query), ("map", there_known, other)):
        if not known.any():
            raise TruthError(
                f"--truth {shown(choice.source)} covers none of the {len(log.stamps())} frames of the {name} "
                f"{log.name}. Give the truth of this drive{_REMEDIES.get(choice.kind, '')}."
            )
    about = {"source": shown(choice.source), **about}
    return PlaceTruth(about, np.flatnonzero(here_known), np.flatnonzero(there_known), true_pairs)


_Found = tuple[dict[str, Any], "Bools", "Bools", "Callable[[Ints, Ints], Pairs]"]
"""A record of the truth, the frames (Q,) and (M,) it covers, and its pairs."""
_REMEDIES = {"tum": ", in the log's clock", "csv": ", with its file names as they are"}


def _all_frames(query: Log, other: Log) -> tuple[Bools, Bools]:
    return np.ones(len(query.stamps()), bool), np.ones(len(other.stamps()), bool)


def _by_index(choice: TruthChoice, query: Log, other: Log) -> _Found:
    """By the numbers in file names, or by rows where these have none."""
    tolerance, names = choice.tolerance or 0, (query.file_names(), other.file_names())
    numbers = None if names[0] is None or names[1] is None else numbers_of(names[0], names[1], tolerance)
    by = "frame number, counted from 0 in each drive"
    here, there = (np.arange(len(log.stamps())) for log in (query, other))
    if numbers is not None:
        here, there, by_folder = numbers
        by = "folder and number in the file name" if by_folder else "number in the file name"
    about = {"tolerance": tolerance, "by": "rows" if numbers is None else "names"}
    about["same_place"] = f"the same {by}" + (f", give or take {tolerance}" if tolerance else "")
    known, ordered = _all_frames(query, other), all(np.all(np.diff(one) > 0) for one in (here, there))
    if ordered:
        return about, *known, lambda q, m: pairs.index_pairs(here[q], there[m], tolerance)
    return about, *known, lambda q, m: pairs.position_pairs(here[q, None], there[m, None], tolerance)


def _by_table(choice: TruthChoice, query: Log, other: Log) -> _Found:
    """By a CSV of pairs, or of labels."""
    parts = choice.source.split(",")
    files = parts if len(parts) == 2 and not Path(choice.source).is_file() else [choice.source] * 2
    (header, rows), (other_header, other_rows) = map(read_table, map(Path, files))
    if header == ["query", "match"]:
        if files[0] != files[1]:
            raise TruthError(f"--truth {shown(choice.source)}: one table `query,match` names both drives. Give one.")
        a, b = (other, query) if choice.transposed else (query, other)
        return _listed(listed_rows(rows, a, b), choice, query, other)
    if other_header != header:
        raise TruthError(f"{files[1]} has another header than {files[0]}. Give two tables `image,label`.")
    labels = [labels_by_row(table, log) for table, log in ((rows, query), (other_rows, other))]
    return _labelled(labels[0], labels[1])


def _by_array(choice: TruthChoice, query: Log, other: Log) -> _Found:
    a, b = (other, query) if choice.transposed else (query, other)
    return _listed(read_array(Path(choice.source), len(a.stamps()), len(b.stamps())), choice, query, other)


def _listed(listed: Ints, choice: TruthChoice, query: Log, other: Log) -> _Found:
    listed = listed[:, ::-1] if choice.transposed else listed
    about = {"listed": len(listed), "same_place": f"listed in {shown(choice.source)}"}
    return about, *_all_frames(query, other), lambda q, m: pairs.listed_pairs(listed, q, m)


def _by_folder(_: TruthChoice, query: Log, other: Log) -> _Found:
    names = [log.file_names() or [log.name] for log in (query, other)]
    here, there = (folders_of(own, log.name) for own, log in zip(names, (query, other), strict=True))
    return _labelled(here, there)


def _labelled(query: Sequence[str | None], other: Sequence[str | None]) -> _Found:
    """Frames with the same label; one without a label is not covered."""
    number = {label: number for number, label in enumerate(sorted({*query, *other} - {None}, key=str))}
    here, there = (np.array([[number.get(label, -1)] for label in labels]) for labels in (query, other))
    about = {"labels": len(number), "same_place": "the same label"}
    known = here[:, 0] >= 0, there[:, 0] >= 0
    return about, *known, lambda q, m: pairs.position_pairs(here[q], there[m], 0.0)


def _by_utm(choice: TruthChoice, query: Log, other: Log) -> _Found:
    """By the positions in file names, and their headings where a bound is given."""
    distance_m = UTM_DISTANCE_M if choice.distance_m is None else choice.distance_m
    found = [utm_of(log.file_names() or [log.name]) for log in (query, other)]
    (here, here_deg), (there, there_deg) = found
    about: dict[str, Any] = {"distance_m": distance_m, "same_place": f"within {distance_m:g} m by file names"}
    if choice.heading_deg is None:
        known = _all_frames(query, other)
        return about, *known, lambda q, m: pairs.position_pairs(here[q], there[m], distance_m)
    about["heading_deg"] = choice.heading_deg
    about["same_place"] += f", headings within {choice.heading_deg:g} degrees"
    poses = [_level_poses(*one) for one in found]

    def true_pairs(q: Ints, m: Ints) -> Pairs:
        return pairs.pose_pairs(poses[0][q], poses[1][m], distance_m, about["heading_deg"])

    return about, np.isfinite(here_deg), np.isfinite(there_deg), true_pairs


def _level_poses(positions: Floats, heading_deg: Floats) -> Floats:
    """(N, 4, 4) poses of level cameras."""
    turns = np.column_stack([np.zeros((len(positions), 2)), -np.radians(np.nan_to_num(heading_deg))])
    return se3.pose(se3.so3_exp(turns), positions)


def _by_gps(choice: TruthChoice, query: Log, other: Log) -> _Found:
    distance_m = DISTANCE_M if choice.distance_m is None else choice.distance_m
    (here, here_known), (there, there_known) = _fixes(query, other)
    about = {"distance_m": distance_m, "same_place": f"fixes within {distance_m:g} m"}
    return about, here_known, there_known, lambda q, m: pairs.position_pairs(here[q], there[m], distance_m)


def _by_poses(choice: TruthChoice, query: Log, other: Log) -> _Found:
    """By the odometry of the drives, or by TUM files."""
    distance_m = DISTANCE_M if choice.distance_m is None else choice.distance_m
    heading_deg = HEADING_DEG if choice.heading_deg is None else choice.heading_deg
    trajectories = _odometry(query, other) if choice.kind == "poses" else _files(choice.source)
    here, here_known = pairs.poses_at(trajectories[0], query.stamps())
    there, there_known = pairs.poses_at(trajectories[1], other.stamps())
    here_axis = pairs.optical_axis(query.camera().body_from_camera, here[here_known])
    there_axis = pairs.optical_axis(other.camera().body_from_camera, there[there_known])
    text = f"poses within {distance_m:g} m, optical axes within {heading_deg:g} degrees"
    about = {"distance_m": distance_m, "heading_deg": heading_deg, "same_place": text}

    def true_pairs(q: Ints, m: Ints) -> Pairs:
        return pairs.pose_pairs(here[q], there[m], distance_m, heading_deg, here_axis, there_axis)

    return about, here_known, there_known, true_pairs


_KINDS: dict[str, Callable[[TruthChoice, Log, Log], _Found]] = {
    "index": _by_index,
    "csv": _by_table,
    "npy": _by_array,
    "labels": _by_folder,
    "utm": _by_utm,
    "poses": _by_poses,
    "tum": _by_poses,
    "gps": _by_gps,
}


def _takers(option: str) -> str:
    *names, last = ["a TUM file" if kind == "tum" else kind for kind, options in _USES.items() if option in options]
    return f"{', '.join(names)} and {last}" if names else last


def _files(source: str) -> tuple[Trajectory, Trajectory]:
    """One TUM file for both drives, or one for each."""
    if Path(source).is_file() or "," not in source:
        truth = read_truth(source, [kind for kind in _USES if kind != "tum"])
        return truth, truth
    here, _, there = source.partition(",")
    return read_truth(here), read_truth(there)


def _odometry(query: Log, other: Log) -> tuple[Trajectory, Trajectory]:
    def read(log: Log) -> Trajectory:
        odometry = log.odometry()
        if odometry is None or not len(odometry.stamp_ns):
            raise TruthError(f"{log.name} has no odometry, so --truth poses is not possible. Choose another truth.")
        return odometry.trajectory

    return read(query), read(other)


def _fixes(query: Log, other: Log) -> list[tuple[Floats, Any]]:
    """East and north in m of both drives' frames in one plane, NaN and False where unknown.

    Heights are left out: fixes are two to three times less accurate there, and roads rarely cross above each other.
    """
    fixes = []
    for log in (query, other):
        found = log.gps()
        if found is None or not len(found.stamp_ns):
            raise TruthError(f"{log.name} has no GPS fixes, so --truth gps is not possible. Choose another truth.")
        fixes.append(found)
    together: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in fixes])
        for name in ("stamp_ns", "latitude_deg", "longitude_deg", "altitude_m", "covariance")
    }
    count = len(fixes[0].stamp_ns)
    order, positions = local_enu(Gps(**(together | {"stamp_ns": np.arange(len(together["stamp_ns"]))})))
    result = []
    for log, mine in ((query, order < count), (other, order >= count)):
        stamp_ns, first = np.unique(together["stamp_ns"][order[mine]], return_index=True)
        result.append(pairs.positions_at(stamp_ns, positions[mine][first, :2], log.stamps()))
    return result
