"""Poses of the drives of a map in the frames that closures join them in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vplog.errors import ResultError
from vplog.maps.joining.joint_record import components_in
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.layout import folder_name
from vplog.results import tables

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.maps.storage.map_store import Store


class Component(NamedTuple):
    """Drives that closures join."""

    folder: Path
    drives: Sequence[str]
    """In the map's order; the frame is that of the first."""


def joint_components(store: Store) -> dict[str, Component]:
    """The component of each drive that is in one. Raises ResultError where their record is damaged."""
    found = [Component(store.root / "joint" / one["folder"], one["drives"]) for one in components_in(store) or []]
    return {drive: one for one in found for drive in one.drives}


def keyframe_poses(store: Store, joint: Mapping[str, Component], drive: str) -> Floats:
    """(N, 4, 4) of a drive, in the frame that it shares with those it is joined with. Raises ResultError."""
    if drive not in joint:
        with reading_drive(drive):
            return tables.read_keyframes(store.file(drive, "keyframes.parquet"))[1]
    path = joint[drive].folder / folder_name(drive) / "keyframes.parquet"
    try:
        return tables.read_keyframes(path)[1]
    except ResultError:
        raise ResultError(f"{path} is damaged. Join the drives again: vplog map join {store}") from None
