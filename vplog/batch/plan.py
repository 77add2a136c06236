"""Plan of a batch: the drive that each log is, what it is made from, and whether the map has it already."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.batch.worker import told
from vplog.errors import ResultError, SettingsError, VplogError
from vplog.logs import TopicChoice
from vplog.maps.storage import layout
from vplog.places.plugin import PluginSettings
from vplog.places.vectors import VectorsSettings, vectors_files
from vplog.run.cache.code_hash import code_of
from vplog.storage.input_hashes import hash_inputs
from vplog.storage.json_records import key_of
from vplog.storage.remote_path import RemotePath
from vplog.storage.urls import shown

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline

Hashes = dict[str, str]
"""sha256 of files, by name."""


@dataclass(frozen=True)
class DriveInput:
    """One drive that is to be in a map, and what is known of it beside its log."""

    log: Path
    name: str = ""
    """ID in the map; empty takes the name of the file or folder."""
    topics: TopicChoice = field(default_factory=TopicChoice)
    """Those that are set count in place of those of the batch."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Fields of drive.json that results do not depend on: `tags`, texts by name, and `truth`, a file or a kind."""

    @property
    def url(self) -> str:
        """Absolute path of the log, links not resolved, or its URL with the query."""
        return absolute_log(self.log)


@dataclass(frozen=True)
class PlannedDrive:
    """A drive of a batch."""

    given: DriveInput
    record: dict[str, Any]
    """drive.json: what it is made from."""
    state: str
    """`compute`, `unchanged` or `failed`."""
    error: str = ""
    fault: str = ""
    """Kind of the error, as in Outcome."""

    @property
    def drive(self) -> str:
        """ID in the map."""
        return self.record["drive"]


def with_topics(inputs: Sequence[DriveInput], topics: TopicChoice | None) -> list[DriveInput]:
    """These drives with the topics that are theirs or else those of the batch. Raises SettingsError where a log is
    given twice."""
    common, found = topics or TopicChoice(), list[DriveInput]()
    for one in inputs:
        own = {name: getattr(one.topics, name) for name in one.topics.model_fields_set}
        found.append(replace(one, topics=common.model_copy(update=own)))
    if twice := [url for url, count in Counter(one.url for one in found).items() if count > 1]:
        raise SettingsError(f"{shown(twice[0])} is given twice. Give each log once.")
    return found


def common_record(pipeline: Pipeline, library: str | None) -> dict[str, Any]:
    """Fields of drive.json that are the same for each drive of a batch. Every setting counts, as every table names them
    all, the code of a plug-in, and files of vectors; the place of a log does not: a map may move with its logs."""
    about, places = {"settings": key_of(pipeline.model_dump(mode="json")), "library": library}, pipeline.places
    if isinstance(places, VectorsSettings):
        about["vectors"] = key_of([hash_inputs(file) for file in vectors_files(places.file)])
    return about | ({"plugin": code_of(*places.modules)["code"]} if isinstance(places, PluginSettings) else {})


def plan_drives(
    store: Store, inputs: Sequence[DriveInput], common: Mapping[str, Any], hashes: Sequence[Hashes | VplogError]
) -> list[PlannedDrive]:
    """The drives of these inputs, in order. `hashes` are those of their files, or why there are none."""
    known, plan = store.drives(), list[PlannedDrive]()
    contents, urls = [{} if isinstance(one, VplogError) else one for one in hashes], [shown(one.url) for one in inputs]
    given_names = [one.name or name_of(one.log) for one in inputs]
    names = layout.drive_names(given_names, urls, {**_failed(store), **known}, contents)
    for given, drive, url, content, found in zip(inputs, names, urls, contents, hashes, strict=True):
        topics = given.topics.model_dump(mode="json", exclude={"odometry_file", "calibration_file", "masks"})
        record = {"drive": drive, "inputs": content, "topics": topics, **common}
        about = {name: value for name, value in known.get(drive, {}).items() if name in layout.ABOUT}
        record |= {**about, "key": key_of(record), "log": url, **given.about}
        if isinstance(found, VplogError):
            plan.append(PlannedDrive(given, record, "failed", *told(found, given.url)))
            continue
        if drive in known and layout.made_alike(known[drive], record) and not _is_damaged(store, drive):
            state = "unchanged"
        else:
            state = "compute"
        plan.append(PlannedDrive(given, record, state))
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
