"""The groups of a map's drives: those that changed are solved, and joint.json says which components count."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

from vplog.errors import VplogError
from vplog.maps.joining import components
from vplog.maps.joining.joint_record import read_joint, write_joint
from vplog.maps.storage.damage import DamagedDriveError
from vplog.storage.scratch import put_in_place

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vplog.maps.joining.components import Group, Tie
    from vplog.maps.joining.join_order import Drives
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline

    Progress = Callable[[str, int, int], None]


def solve_groups(
    store: Store, drives: Drives, ties: Sequence[Tie], pipeline: Pipeline, progress: Progress
) -> dict[str, Any]:
    """Solve the groups that are not solved yet, and let joint.json say so; then the folders of others go."""
    groups = components.groups_of([member.drive for member in drives.members], drives.keys, ties, pipeline)
    known = {group["key"]: group for group in _joint(store).get("groups", [])}
    folder, solved = store.root / "joint", []
    for done, group in enumerate(groups):
        progress("solve together", done, len(groups))
        if not _is_there(folder, known.get(group.key)):
            known[group.key] = _solved(store, group, pipeline, drives.library)
        solved.append(known[group.key])
    progress("solve together", len(groups), len(groups))
    together = {drive for group in solved for component in group["components"] for drive in component["drives"]}
    alone = [member.drive for member in drives.members if member.drive not in together]
    keys = {drive: drives.keys[drive] for drive in sorted(together)}
    record = {"groups": solved, "alone": sorted([*alone, *drives.apart]), "apart": drives.apart, "keys": keys}
    if solved or (store.root / "joint.json").exists():
        write_joint(store.root, record)
    named = {component["folder"] for group in solved for component in group["components"]}
    for path in folder.glob("component=*"):
        if path.name not in named:
            shutil.rmtree(path, ignore_errors=True)
    return record


def _joint(store: Store) -> dict[str, Any]:
    try:
        return read_joint(store.root)
    except VplogError:  # damaged, or of another version: made anew
        return {}


def _is_there(folder: Path, known: dict[str, Any] | None) -> bool:
    return known is not None and all(
        (folder / component["folder"] / "component.json").is_file() for component in known["components"]
    )


def _solved(store: Store, group: Group, pipeline: Pipeline, library: str) -> dict[str, Any]:
    """Solve a group, and rename in its components."""
    staging = store.staging / "joint"
    shutil.rmtree(staging, ignore_errors=True)
    runs = {drive: store.run(drive) for drive in group.drives}
    try:
        record = components.solve_group(group, runs, pipeline, library, staging)
    except DamagedDriveError:  # the others are solved without it
        raise
    except VplogError as error:  # one group must not take the others along; it is tried again
        return {"key": "", "drives": list(group.drives), "components": [], "apart": [], "reason": str(error)}
    for component in record["components"]:
        place = store.root / "joint" / component["folder"]
        if (place / "component.json").is_file():  # of a join that was killed; its name says that it is the same
            continue
        place.parent.mkdir(exist_ok=True)
        shutil.rmtree(place, ignore_errors=True)
        put_in_place(staging / component["folder"], place)
    shutil.rmtree(staging, ignore_errors=True)
    return record
