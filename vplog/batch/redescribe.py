"""A map described again with another library, from the logs of its drives."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vplog import logs
from vplog.batch.batch import run_batch, write_failures
from vplog.batch.engine import BatchOptions
from vplog.batch.plan import DriveInput
from vplog.batch.worker import DriveState
from vplog.errors import LogError, SettingsError
from vplog.execution.execution import Execution
from vplog.logs.image_folder import natural_order
from vplog.maps.import_places import PLACES_ONLY
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import skip_damaged
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.layout import ABOUT
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline
from vplog.places.library_files import read_library_record
from vplog.results import run_record
from vplog.run.provenance import stored_log
from vplog.run.reference_library import build_library
from vplog.storage.remote_path import local_copy
from vplog.storage.scratch import scratch


def redescribe_map(
    root: Path, library: Path, target: Path, execution: Execution = Execution(), options: BatchOptions | None = None
) -> dict[str, Any]:
    """The drives of a map in a new map `target`, described with another library: one on disk, or one of a log's frames.

    Settings are those of the map, but for the library's own of places; topics those of each drive. Every drive is run
    again, as a batch runs it, from the cache of its stages where there is one; one whose log is gone fails and stops no
    other. A command that was stopped goes on. Raises VplogError.
    """
    if str(root.resolve()) == str(target.resolve()):
        raise SettingsError(f"{root} is given as its own target. Choose another map with -o.")
    with map_store.reading(root) as store:
        head = store.head()
        drives, topics = skip_damaged(store, lambda: _drives_of(store))
        damaged = {drive: DriveState(drive, "", "failed", error=why) for drive, why in store.damaged.items()}
        _bring_caches(store.root, target)
    outcomes, missing, joined, join_error = [], damaged, None, ""
    inputs = dict[str, DriveInput]()
    for drive in sorted(drives, key=natural_order):
        log = drives[drive]["log"]
        try:
            if PLACES_ONLY in drives[drive]:
                raise LogError(
                    f"The map has places of it, and no log. Add its log to the map first: vplog batch LOG -o {root}"
                )
            again = f"Put it back, and give the same command again, or add it: vplog batch LOG -o {target}"
            path = stored_log(log, root, "Its log", again)
        except LogError as error:
            missing[drive] = DriveState(drive, log, "failed", error=str(error))
        else:
            choice = logs.TopicChoice.read(topics[drive] or {}, f"{root}: {drive}/run.json")
            about = {name: drives[drive][name] for name in ABOUT[1:] if name in drives[drive]}
            inputs[drive] = DriveInput(path, drive, choice, about)
    with _made(library, Pipeline.read(head.settings, f"{root}/map.json"), execution) as (folder, pipeline):
        if read_library_record(folder)["hash"] == head.library:
            raise SettingsError(f"{root} is described with {library} already. Give another library.")
        if inputs:
            found = run_batch(list(inputs.values()), target, pipeline, folder, None, execution, options)
            joined, join_error = found["joined"], found["join_error"]
            outcomes += [{**one, "was": drive} for drive, one in zip(inputs, found["drives"], strict=True)]
        digest = read_library_record(folder)["hash"]
    outcomes += [{**asdict(lost), "was": drive} for drive, lost in missing.items()]
    if missing and inputs:  # else there is no map yet
        with map_store.writing(target) as store:
            write_failures(store, {drive: lost for drive, lost in missing.items() if drive not in store.drives()})
    return {
        "map": str(target),
        "from": str(root),
        "library": digest,
        "failed": sum(one["state"] == "failed" for one in outcomes),
        "drives": outcomes,
        "joined": joined,
        "join_error": join_error,
    }


def _drives_of(store: Store) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    _, drives = map_store.common_library(store)
    topics = {}
    for drive in drives:
        record = store.file(drive, "run.json")
        with reading_drive(drive):
            topics[drive] = run_record.read_run_json(record).get("topics")
    return drives, topics


@contextmanager
def _made(library: Path, pipeline: Pipeline, execution: Execution) -> Iterator[tuple[Path, Pipeline]]:
    """The folder of the library, and the settings with its own of places."""
    if not library.is_file() and (library / "library.json").exists():
        with local_copy(library) as folder:
            places = read_library_record(folder)["settings"]
            settings = {**pipeline.model_dump(mode="json"), "places": places}
            yield folder, Pipeline.read(settings, f"{library}/library.json")
        return
    with scratch("made") as made:
        folder = made / "library"
        build_library([library], folder, pipeline, logs.TopicChoice(), execution)
        yield folder, pipeline


def _bring_caches(root: Path, target: Path) -> None:
    """Link the caches of the drives' stages into their new map, where both are folders of one file system."""
    caches = root / ".cache"
    if not caches.is_dir() or "://" in str(target) or (target / ".cache").exists():
        return
    try:
        shutil.copytree(caches, target / ".cache", symlinks=True, copy_function=os.link)
    except (OSError, shutil.Error):  # it only spares work
        shutil.rmtree(target / ".cache", ignore_errors=True)
