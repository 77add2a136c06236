"""The library that all drives of a map are described with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog import logs
from vplog.batch.plan import DriveInput, PlannedDrive
from vplog.errors import LibraryError, LogError, VplogError
from vplog.execution.execution import Execution
from vplog.maps.merge import put_library
from vplog.maps.storage.map_store import Store
from vplog.places.library_files import read_library_record
from vplog.places.reference_choice import PAPER_SIZE, evenly
from vplog.places.vectors import check_drives
from vplog.run.reference_library import check_library, library_of_logs
from vplog.stages import Log
from vplog.storage.scratch import copy_folder

if TYPE_CHECKING:
    from vplog.pipeline import Pipeline

_TRIED = 8
"""Frames of a log, over the whole drive, that are decoded before it is relied on: one that does is enough."""


def known_library(store: Store, drives: int, given: Path | None, pipeline: Pipeline) -> str | None:
    """The hash of the map's library, or of the one given for a map that has none yet; None where one is to be made.
    Nothing is written.

    Raises LibraryError where another one is given, or where the settings describe places otherwise or cannot describe
    so many drives, and SettingsError where they have decisions.
    """
    check_drives(pipeline.places, drives)
    pipeline.decisions.check_single_drive()
    known = store.recovered_head().library if store.exists else None
    if known is not None and not store.library(known).is_dir():
        raise LibraryError(
            f"{store} lacks its library {known[:12]}. Copy it back, or make another map with `vplog batch`."
        )
    if given is None:
        check_library(None if known is None else store.library(known), pipeline)
        return known
    check_library(given, pipeline)
    digest = str(read_library_record(given)["hash"])
    if known is not None and known != digest:
        raise LibraryError(
            f"{given} has hash {digest[:12]}, and the places of {store} are described with library "
            f"{known[:12]}: they cannot be compared. Leave --library out, or make another map."
        )
    return digest


def check_plan(
    plan: Sequence[PlannedDrive], known: Mapping[str, Any], pipeline: Pipeline, common: Mapping[str, Any]
) -> None:
    """Raises LibraryError where the places of a map's drives (`known`) and of those planned are vectors of a file that
    does not say which drive they are of."""
    several = getattr(pipeline.places, "model", "")  # its drives have files of their own
    of_file = {drive for drive, one in known.items() if not several or one.get("settings") == common["settings"]}
    check_drives(pipeline.places, len(of_file | {one.drive for one in plan}))


def map_library(
    store: Store, drives: Sequence[DriveInput], given: Path | None, pipeline: Pipeline, execution: Execution
) -> str:
    """Return the hash of `known_library`. A map without a library gets the library and these settings. Nothing is
    written if none of the logs can be read, or if the map has its library already."""
    digest = known_library(store, len(drives), given, pipeline)
    if store.exists and digest is not None and store.recovered_head().library == digest:
        return digest
    made = store.staging / "library"
    if given is not None:
        _decodable(drives, 1)
        digest = pipeline.places.load(given, Execution(execution.threads)).hash  # checked against its record
        copy_folder(given, made, f"the library {given} into {store}")
    else:
        digest = library_of_logs(_decodable(drives, PAPER_SIZE), made, pipeline, execution).hash
    put_library(store, made, digest, pipeline.model_dump(mode="json"))
    return digest


def _decodable(drives: Sequence[DriveInput], most: int) -> list[Log]:
    """The first logs that have a frame that decodes, `most` of them. Errors of the others are raised by their own runs.
    Raises the error of the first where there is none."""
    sound, first = [], None
    for drive in drives:
        try:
            log = logs.open(drive.log, drive.topics)
            stamps = log.stamps()
            for encoded in log.frames(stamps[evenly(len(stamps), _TRIED)]) if len(stamps) else ():
                try:
                    encoded.decode()
                except VplogError as error:
                    first = first or error
                else:
                    sound.append(log)
                    break
        except VplogError as error:
            first = first or error
        except OSError as error:
            first = first or LogError(f"Cannot read {drive.log}: {error.strerror or error}.")
        if len(sound) == most:
            break
    if not sound:
        raise first or LibraryError("None of the logs has a frame, so there is nothing to build a library from.")
    return sound
