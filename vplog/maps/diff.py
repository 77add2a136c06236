"""Differences of two maps: settings, drives, closures within and between drives, poses in the joint frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import USED, Closures, Floats, Ints
from vplog.evaluate.trajectory import motion_figures
from vplog.geometry import se3
from vplog.maps.joining.joint_record import joint_components, joint_ledgers, keyframe_poses
from vplog.maps.storage.map_store import Store, reading
from vplog.results import tables
from vplog.storage.json_records import differences

Pair = tuple[str, str]


@dataclass(frozen=True, eq=False)
class _Content:
    settings: dict[str, Any]
    stamps: dict[str, Ints]
    """(N,) ns of the keyframes of each drive."""
    poses: dict[str, Floats]
    """(N, 4, 4) in the frame of the component."""
    frame: dict[str, str]
    """The first drive of the component of each drive."""
    closures: dict[Pair, None]
    """`DRIVE/STAMP` of query and match of those in the solution; `joins` of them are between drives."""
    joins: int


def diff_maps(baseline: Path, run: Path) -> dict[str, Any]:
    """The differences of the map in a folder from the one in `baseline`, in the form of `vplog.verbs.diff.diff`.

    Closures are pairs of `DRIVE/STAMP`; `drives` names those gained and lost. The poses of keyframes are compared where
    both maps have the drive, those of one joint frame aligned together. Raises ResultError.
    """
    with reading(baseline) as one, reading(run) as other:
        maps = [_content(store) for store in (one, other)]
    before, after = maps
    gained, lost = ([pair for pair in a.closures if pair not in b.closures] for a, b in (maps[::-1], maps))
    moved = _moved(before, after)
    pairs = {
        "drives": [len(one.stamps) for one in maps],
        "accepted": [len(one.closures) for one in maps],
        "joins": [one.joins for one in maps],
        "joint_frames": [len(set(one.frame.values())) for one in maps],
        "gained": [0, len(gained)],
        "lost": [0, len(lost)],
        "moved_m": [0, moved["rmse_m"]],
        "moved_deg": [0, moved["rmse_deg"]],
    }
    return {
        "baseline": str(baseline),
        "run": str(run),
        "settings": differences({"settings": before.settings}, {"settings": after.settings}),
        "drives": {kind: sorted(a.stamps.keys() - b.stamps.keys())
                   for kind, a, b in (("gained", after, before), ("lost", before, after))},
        "closures": {"common": len(after.closures) - len(gained), "gained": gained, "lost": lost},
        "trajectory": moved,
        "figures": {name: [a, b, b - a if None not in (a, b) else None] for name, (a, b) in pairs.items()},
        "seconds": {},
    }  # fmt: skip


def _content(store: Store) -> _Content:
    joint, abouts = joint_components(store), store.drives()
    stamps = {drive: tables.read_stamps(store.file(drive, "keyframes.parquet")) for drive in abouts}
    poses = {drive: keyframe_poses(store, joint, drive) for drive in abouts}
    closures: dict[Pair, None] = {}
    for drive in abouts:
        closures |= _pairs(tables.read_closures(store.file(drive, "closures.parquet")), drive, drive, stamps)
    own = len(closures)
    for (query, match), ledger in joint_ledgers(store, {one.folder.name for one in joint.values()}).items():
        closures |= _pairs(ledger, query, match, stamps)
    frame = {drive: joint[drive].drives[0] if drive in joint else drive for drive in abouts}
    return _Content(store.head().settings, stamps, poses, frame, closures, len(closures) - own)


def _pairs(ledger: Closures, query: str, match: str, stamps: dict[str, Ints]) -> dict[Pair, None]:
    """Closures in the solution between drives that are still in the map."""
    if query not in stamps or match not in stamps:
        return {}
    used = ledger.of(*USED)
    ends = stamps[query][ledger.query[used]].tolist(), stamps[match][ledger.match[used]].tolist()
    return {(f"{query}/{here}", f"{match}/{there}"): None for here, there in zip(*ends, strict=True)}


def _moved(before: _Content, after: _Content) -> dict[str, Any]:
    """Distance and angle between the keyframes of both maps, aligned frame by frame; None without three of a frame."""
    frames: dict[Pair, list[tuple[Floats, Floats]]] = {}
    for drive in before.stamps.keys() & after.stamps.keys():
        _, one, other = np.intersect1d(before.stamps[drive], after.stamps[drive], return_indices=True)
        frames.setdefault((before.frame[drive], after.frame[drive]), []).append(
            (before.poses[drive][one], after.poses[drive][other])
        )
    apart = []
    for _, parts in sorted(frames.items()):
        known, poses = map(np.concatenate, zip(*parts, strict=True))
        if len(known) >= 3:
            aligned, _ = se3.umeyama(poses[:, :3, 3], known[:, :3, 3])
            apart.append(se3.between(known, aligned @ poses))
    return motion_figures(np.concatenate([np.zeros((0, 4, 4)), *apart]))
