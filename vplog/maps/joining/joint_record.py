"""joint.json of a map: which joint graphs count, and the keyframes of its drives in the frames of those."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NotRequired

from pydantic import TypeAdapter
from typing_extensions import TypedDict  # as pydantic needs it below Python 3.12

from vplog.data import Closures, Floats
from vplog.errors import ResultError
from vplog.maps.storage.damage import damaged_table, reading_drive
from vplog.maps.storage.layout import Below, folder_name, write_changed
from vplog.maps.storage.map_store import Store
from vplog.results import run_record, tables
from vplog.storage.parquet_limits import check_version


class Component(NamedTuple):
    """The component of one drive: the drives that closures join with it, and where its own poses are."""

    folder: Path
    """Folder in MAP/joint with the poses of that drive."""
    drives: Sequence[str]
    """The frame is that of the first."""


class _Component(TypedDict):
    folder: Below
    """In MAP/joint, of the last solve of the whole."""
    drives: list[str]
    grown: NotRequired[dict[str, Below]]
    """Folders of the drives that came or moved since."""
    between: NotRequired[dict[str, int]]
    """`count_between`; an older vplog wrote none."""


class _Group(TypedDict):
    key: str
    components: list[_Component]


_GROUPS = TypeAdapter(list[_Group])


def read_joint(root: Path) -> dict[str, Any]:
    """joint.json as plain values; empty where nothing was joined yet. Raises ResultError where it is damaged.

    `groups` are the drives that verified closures join, each with the `components` that came of it (`folder` in
    MAP/joint, `drives`, `grown`: the folders of those that came since the whole was solved, and `between`: how many
    closures each drive has with other drives) and the pairs kept
    `apart`; `alone` are the drives in no component, `apart` says of some why; `keys` are those that the drives of
    components had in their drive.json, `judged` those of what the closures of each drive were decided by.
    """
    path = root / "joint.json"
    if not path.is_file():
        return {}
    record = run_record.read_run_json(path)
    check_version(path, record.get("format"), run_record.FORMAT)
    try:
        _GROUPS.validate_python(record.get("groups"))
    except ValueError:
        raise ResultError(f"{path} is damaged. Write it again: vplog map join {root}") from None
    return record


def is_whole(store: Store, folder: str, drives: Sequence[str]) -> bool:
    """Whether the record and the tables of a component, in a folder of MAP/joint, are as they were written."""
    if not store.has_beside(f"joint/{folder}/component.json"):
        return False
    names = [f"{folder_name(drive)}/{table}.parquet" for drive in drives for table in ("keyframes", "trajectory")]
    names = [f"joint/{folder}/{name}" for name in ("component.json", "joins.parquet", *names)]
    store.fetch_beside(names)
    try:
        run_record.read_run_json(store.root / names[0])
    except ResultError:
        return False
    return not any(damaged_table(store.root / name) for name in names[1:])


def fetch_poses(store: Store, folders: Mapping[str, str]) -> None:
    """Fetch the keyframes of drives from their folders in MAP/joint, of a map on an object store."""
    store.fetch_beside(f"joint/{one}/{folder_name(drive)}/keyframes.parquet" for drive, one in folders.items() if one)


def components_in(store: Store) -> list[dict[str, Any]] | None:
    """The components that count: `folder` in MAP/joint and `drives`, in order of their first drives; None where nothing
    was joined yet. Raises ResultError where the record is damaged."""
    store.fetch_beside(["joint.json"])
    groups = read_joint(store.root).get("groups")
    return groups and [component for group in groups for component in group["components"]]


def joint_ledgers(store: Store, folders: Iterable[str]) -> dict[tuple[str, str], Closures]:
    """Return the closures between drives of the components in these folders of MAP/joint, by query and match drive.
    Raises ResultError if a table is damaged."""
    names, found = [f"joint/{folder}/joins.parquet" for folder in sorted(folders)], dict[tuple[str, str], Closures]()
    store.fetch_beside(names)
    for name in names:
        try:
            found |= tables.read_joins(store.root / name)
        except ResultError:
            raise ResultError(f"{store}/{name} is damaged. Join the drives again: vplog map join {store}") from None
    return found


def count_between(ledgers: Mapping[tuple[str, str], Closures]) -> Counter[str]:
    """Return how many accepted closures each drive has with other drives. Each closure counts for both of its ends."""
    found = Counter[str]()
    for pair, ledger in ledgers.items():
        found.update(dict.fromkeys(pair, int(ledger.accepted.sum())))
    return found


def between_by_drive(components: Iterable[Mapping[str, Any]], drives: Iterable[str]) -> dict[str, int | None]:
    """Return `count_between` of each drive by the components of joint.json, 0 for a drive in none, and None for a drive
    in a component that an older vplog wrote."""
    found: dict[str, int | None] = dict.fromkeys(drives, 0)
    for component in components:
        counts = component.get("between")
        found |= {drive: None if counts is None else counts.get(drive, 0) for drive in component["drives"]}
    return found


def recorded_components(store: Store, without: Callable[[str], bool] = lambda _: False) -> dict[str, Component]:
    """The component of each drive as joint.json has them, `without` some drives. Raises ResultError where it is
    damaged."""
    joint, found = store.root / "joint", dict[str, Component]()
    for one in components_in(store) or []:
        grown, there = one.get("grown", {}), [drive for drive in one["drives"] if not without(drive)]
        found |= {drive: Component(joint / grown.get(drive, one["folder"]), there) for drive in there}
    return found


def joint_components(store: Store) -> dict[str, Component]:
    """The component of each drive that is in one; drives that were removed or replaced since are in none, as a join may
    be still to come. Raises ResultError as `recorded_components`."""
    store.fetch_beside(["joint.json"])
    known = store.drives()
    replaced = set(replaced_since(store.root, known))
    return recorded_components(store, lambda drive: drive not in known or drive in replaced)


def keyframe_poses(store: Store, joint: Mapping[str, Component], drive: str) -> Floats:
    """(N, 4, 4) of a drive, in the frame that it shares with those it is joined with. Raises ResultError."""
    if drive not in joint:
        with reading_drive(drive):
            return tables.read_keyframes(store.file(drive, "keyframes.parquet"))[1]
    path = joint[drive].folder / folder_name(drive) / "keyframes.parquet"
    store.fetch_beside([path.relative_to(store.root).as_posix()])
    try:
        return tables.read_keyframes(path)[1]
    except ResultError:
        raise ResultError(f"{path} is damaged. Join the drives again: vplog map join {store}") from None


def joint_folder(store: Store, joint: Mapping[str, Component], drive: str) -> Path | None:
    """Return the folder with the trajectory of a drive in the frame of its component, or None for a drive in none.
    Raises ResultError if the trajectory is damaged."""
    if drive not in joint:
        return None
    path = joint[drive].folder / folder_name(drive) / "trajectory.parquet"
    store.fetch_beside([path.relative_to(store.root).as_posix()])
    if damaged_table(path):
        raise ResultError(f"{path} is damaged. Join the drives again: vplog map join {store}")
    return path.parent


def replaced_since(root: Path, drives: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Drives of components in whose place others of that name came, by the records of those that are there."""
    keys = read_joint(root).get("keys")
    keys = keys if isinstance(keys, dict) else {}
    return sorted(drive for drive, about in drives.items() if drive in keys and about.get("key") != keys[drive])


def write_joint(root: Path, record: dict[str, Any]) -> None:
    """Write joint.json, unless it holds the record already. Raises ResultError."""
    write_changed(root / "joint.json", {"format": run_record.FORMAT, **record})
