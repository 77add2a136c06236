"""Drives of a map as on disk: paths and settings that the verification of closures between them needs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vplog import logs
from vplog.cache.input_hashes import hash_inputs
from vplog.errors import LogError, ResultError
from vplog.maps.storage.layout import key_of
from vplog.maps.storage.map_store import folder_name
from vplog.pipeline import Pipeline
from vplog.results import run_record, tables
from vplog.run.provenance import stored_log
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.maps.storage.map_store import Store
    from vplog.stages import Log

_FRONT = ("keyframes", "features", "stereo", "places")
"""Settings that a drive's keyframes, features and places depend on; what follows them is not asked for here."""


@dataclass(frozen=True)
class Member:
    """A drive of a map, as it goes to another process or machine, which must see the map and the log there."""

    drive: str
    keyframes: Path
    """Their table."""
    cache: Path
    """Stage cache of its run, with its features while it is new."""
    features: Path
    """Stored features, for later drives."""
    log: str
    inputs: dict[str, str]
    """sha256 of the log's files, by name."""
    topics: logs.TopicChoice
    pipeline: Pipeline
    """Settings of its run."""
    key: str
    """sha256 over all that its keyframes, features and places depend on."""


def member_of(store: Store, about: dict[str, Any]) -> Member:
    """A drive by its drive.json. Raises VplogError where its run folder is of another version or damaged."""
    drive = about["drive"]
    file, record = store.file(drive, "keyframes.parquet"), store.file(drive, "run.json")
    header = tables.read_metadata(file)
    try:
        settings = json.loads(header.get("vplog.settings", "null"))
    except ValueError:
        settings = None
    if not isinstance(settings, dict):
        raise ResultError(f"{file} lacks its settings. Run `vplog batch` again with its log.")
    pipeline = Pipeline.read(settings, str(file))
    topics = run_record.read_run_json(record).get("topics")
    made_from = {
        "inputs": about["inputs"],
        "library": about["library"],
        "code": about.get("code"),
        "topics": about.get("topics"),
        "gps": pipeline.gps.use,
        **{name: settings.get(name) for name in _FRONT},
    }
    return Member(
        drive, file, store.root / ".cache" / folder_name(drive),
        store.root / "joins" / folder_name(drive) / "features.parquet", about["log"], about["inputs"],
        logs.TopicChoice.read(topics if isinstance(topics, dict) else {}, str(record)), pipeline,
        key_of(made_from),
    )  # fmt: skip


def opened_log(member: Member) -> Log:
    """Raises LogError where it is not there any more."""
    path = stored_log(member.log, f"The log of {member.drive}", "Give it again: vplog batch LOG -o MAP")
    try:
        return logs.open_drive([path], member.topics)
    except OSError as error:
        raise LogError(f"The log of {member.drive}, {path}, cannot be read: {error.strerror or error}.") from None


def check_unchanged(member: Member) -> None:
    path = located(member.log)
    try:
        found = hash_inputs(path)
    except OSError as error:
        raise LogError(f"The log of {member.drive}, {path}, cannot be read: {error.strerror or error}.") from None
    if any(member.inputs.get(name) != text for name, text in found.items()):
        raise LogError(f"The log of {member.drive}, {path}, has changed since. Run `vplog batch` with it again.")


def apart(member: Member, library: str, made_by: str) -> str:
    """Why a drive is joined with no other; empty where it may be."""
    if made_by != library:
        return (
            f"{member.drive} was described with library {made_by[:12]}, and the map's is {library[:12]}: it is joined "
            "with no other drive."
        )
    if member.pipeline.gps.use:
        return (
            f"{member.drive} was solved with GPS, which holds one drive at a time: it keeps its own place on earth and "
            "is joined with no other drive."
        )
    return ""
