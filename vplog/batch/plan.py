"""Plan of a batch: the drive that each log is, what it is made from, and whether the map has it already."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.errors import ResultError, SettingsError
from vplog.logs import TopicChoice
from vplog.maps.storage import layout
from vplog.storage.json_records import key_of
from vplog.storage.remote_path import RemotePath
from vplog.storage.urls import shown

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline


@dataclass(frozen=True)
class DriveInput:
    """One drive that is to be in a map, and what is known of it beside its log."""

    log: Path
    name: str = ""
    """ID in the map; empty takes the name of the file or folder."""
    topics: Mapping[str, Any] = field(default_factory=dict)
    """Fields of TopicChoice that are its own."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Fields of drive.json that results do not depend on: `tags`, texts by name, and `truth`, a file or a kind."""


@dataclass(frozen=True)
class GivenLog:
    """A log of a batch, and its topics."""

    path: Path
    url: str
    """Absolute path, links not resolved, or the URL with its query."""
    name: str
    topics: TopicChoice
    about: Mapping[str, Any]
    """As of DriveInput."""


@dataclass(frozen=True)
class PlannedDrive:
    """A drive of a batch."""

    log: GivenLog
    record: dict[str, Any]
    """drive.json: what it is made from."""
    state: str
    """`compute`, `unchanged` or `failed`."""
    error: str = ""

    @property
    def drive(self) -> str:
        """ID in the map."""
        return self.record["drive"]


def given_logs(inputs: Sequence[DriveInput], topics: TopicChoice | None) -> list[GivenLog]:
    """The logs of these drives, each with its own topics in place of those of all. Raises SettingsError where one is
    given twice."""
    found = [
        GivenLog(
            one.log, absolute_log(one.log), one.name or name_of(one.log),
            (topics or TopicChoice()).model_copy(update=dict(one.topics)), one.about,
        )
        for one in inputs
    ]  # fmt: skip
    if twice := [url for url, count in Counter(one.url for one in found).items() if count > 1]:
        raise SettingsError(f"{shown(twice[0])} is given twice. Give each log once.")
    return found


def common_record(pipeline: Pipeline, library: str | None) -> dict[str, Any]:
    """Fields of drive.json that are the same for each drive of a batch. Every setting counts, as every table names them
    all; the place of a log does not: a map may move with its logs."""
    return {"settings": key_of(pipeline.model_dump(mode="json")), "library": library}


def plan_drives(
    store: Store, given: Sequence[GivenLog], common: Mapping[str, Any], inputs: Sequence[dict[str, str]],
    errors: Mapping[str, str],
) -> list[PlannedDrive]:  # fmt: skip
    """The drives of these logs, in order. `inputs` are the hashes of their files, `errors` say by URL why there are
    none."""
    known, plan = store.drives(), list[PlannedDrive]()
    reserved = {**_failed(store), **known}
    names = layout.drive_names([one.name for one in given], [shown(one.url) for one in given], reserved, list(inputs))
    for drive, log, content in zip(names, given, inputs, strict=True):
        topics = log.topics.model_dump(mode="json", exclude={"odometry_file", "calibration_file", "masks"})
        record = {"drive": drive, "inputs": content, "topics": topics, **common}
        about = {name: value for name, value in known.get(drive, {}).items() if name in layout.ABOUT}
        record |= {**about, "key": key_of(record), "log": shown(log.url), **log.about}
        if error := errors.get(log.url, ""):
            state = "failed"
        elif drive in known and layout.made_alike(known[drive], record) and not _is_damaged(store, drive):
            state = "unchanged"
        else:
            state = "compute"
        plan.append(PlannedDrive(log, record, state, error))
    return plan


def _failed(store: Store) -> dict[str, dict[str, Any]]:
    """Records of failed and damaged drives, whose IDs stay reserved while the map lists them."""
    found = {drive: {"log": failure.get("log"), "inputs": None} for drive, failure in store.failures().items()}
    for drive in store.damaged:
        with suppress(ResultError):
            found[drive] = store.record(drive)
    return found


def _is_damaged(store: Store, drive: str) -> bool:
    if wrong := store.damaged_files(drive):
        store.damaged[drive] = wrong[0]
    return bool(wrong)


def absolute_log(path: Path) -> str:
    """Absolute path of a log as it was named, links not resolved, or its URL with the query."""
    if isinstance(path, RemotePath):
        return path.url
    if path.name in ("", ".."):
        return str(path.resolve())
    # `..` is of the folder that a link leads to
    return str((path.parent.resolve() if ".." in path.parts else path.parent.absolute()) / path.name)


def name_of(path: Path) -> str:
    """The name of a log: its file without the ending, or its folder."""
    with suppress(OSError):  # its own run raises it
        if path.is_dir():
            return path.name if path.name not in ("", "..") else path.resolve().name
    return Path(path.stem).stem if path.suffix in (".zst", ".zstd") else path.stem
