"""Many drives into one map: each in a process of its own, all described with one library, none stopping another."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from vplog.batch.drive_inputs import drive_inputs
from vplog.batch.engine import BatchOptions, Engine, LocalEngine, as_completed, open_engine
from vplog.batch.log_hashes import BESIDE, NAME, known_hashes
from vplog.batch.map_library import check_plan, map_library
from vplog.batch.plan import DriveInput, PlannedDrive, common_record, plan_drives, with_topics
from vplog.batch.worker import DriveState, Outcome, Task, made_by
from vplog.errors import ResultError, SettingsError, VplogError
from vplog.execution.execution import Execution
from vplog.logs import TopicChoice
from vplog.maps.import_places import PLACES_ONLY
from vplog.maps.joining.join import join as join_drives
from vplog.maps.joining.join import load_places
from vplog.maps.joining.joint_record import between_by_drive
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import damage_warnings
from vplog.maps.storage.damage import UnreachableError
from vplog.maps.storage.layout import folder_name
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline, load_pipeline, pipeline_from
from vplog.storage.input_hashes import bytes_of
from vplog.storage.json_records import key_of
from vplog.storage.remote_path import RemotePath, located
from vplog.storage.user_cache import cache_folder

_FREE_BYTES = 10**10
"""Free space of the map's disk below which stage caches are removed: what a drive of several hours needs while it is
computed, at 0.3 MB a keyframe."""
_PAUSE_S = 20.0
"""Time after which a finished drive is committed again to a store that could not be reached."""
_CODE = ("code", "versions")
"""Fields of drive.json that name the program that made it."""


def settings_for(root: Path, name: str | None = None, assignments: Sequence[str] = ()) -> Pipeline:
    """The pipeline of this name with `a.b=c` overrides; without a name that of the map's last batch, if there is a map,
    else the default. Raises SettingsError, ResultError."""
    if name is None and (root / "map.json").exists():
        with map_store.reading(root) as store:
            head = store.recovered_head()
        if head.library is not None:  # there may be drives
            try:
                return pipeline_from(head.settings, f"{root}/map.json", assignments)
            except SettingsError as error:
                raise SettingsError(f"{error} Or choose other settings than the map's: --pipeline default.") from None
    return load_pipeline(name or "default", assignments)


def run_batch(
    logs: Sequence[Path | DriveInput], root: Path, pipeline: Pipeline, library: Path | None = None,
    topics: TopicChoice | None = None, execution: Execution = Execution(), options: BatchOptions | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Compute into the map in `root` what of the drives of these logs is missing or made from something else. `topics`
    are those of all drives that have none of their own.

    On this machine every job has all threads; over Ray they are the cores of a cluster of this machine. Without
    `library` the map's own is used, or one is built from the first logs. A drive whose worker dies is tried again; one
    that fails is recorded and stops no other. The answer has the outcome of every log; where joining fails, its
    `join_error` says why (vplog/maps/joining). Raises VplogError where the map as a whole cannot be written or does not
    fit the library or the settings.
    """
    began, options = time.perf_counter(), options or BatchOptions()
    given = with_topics(drive_inputs(logs), topics)
    with (
        map_store.writing(root) as store,
        ThreadPoolExecutor(1) as background,
        open_engine(options, execution.threads, store.staging) as workers,
    ):
        versions = background.submit(made_by)
        digest = map_library(store, given, library, pipeline, execution)
        known = store.drives()
        hashes = known_hashes(given, _hashes_record(store), execution, options.retries)
        common = common_record(pipeline, digest) | versions.result()
        plan = plan_drives(store, given, common, hashes)
        check_plan(plan, known, pipeline, common)
        if any(one.state != "failed" for one in plan):
            store.write_head(map_store.Head(digest, pipeline.model_dump(mode="json")))
        done = dict[str, DriveState]()
        for one in plan:
            if one.state != "compute":
                log = one.record["log"]
                done[one.drive] = DriveState(one.drive, log, one.state, error=one.error, fault=one.fault)
            if one.state == "failed":
                options.on_drive(done[one.drive])
            elif one.state == "unchanged":
                map_store.annotate(store, one.drive, {"log": one.record["log"], **one.given.about})
        wanted = [one for one in plan if one.state == "compute"]
        each, concurrency = _divide_cores(workers, options.jobs, len(wanted))
        execution.progress("drives", len(done), len(plan))
        keep = options.join or options.keep_cache
        template = Task(
            "", "", store.staging, store.library(digest), pipeline, TopicChoice(), each, {}, None, keep,
            time_s=options.drive_timeout_s, memory_mb=options.drive_memory_mb,
            remote=root.url if isinstance(root, RemotePath) else "",
        )  # fmt: skip
        tasks = _tasks(store, wanted, template, longest_first=concurrency > 1)
        places = None
        is_alone = len(known.keys() | {one.drive for one in plan}) < 2
        if options.join and tasks and not is_alone:  # while this process would only wait
            places = background.submit(load_places, template.library, pipeline, execution)
        try:
            for ended in as_completed(workers, tasks, options):
                found = done[ended[0].drive] = _publish(store, *ended, options.retries)
                if found.state == "computed" and not (keep and shutil.disk_usage(store.root).free > _FREE_BYTES):
                    # else it stays for another attempt or the join
                    shutil.rmtree(_cache(store, found.drive), ignore_errors=True)
                options.on_drive(found)
                execution.progress("drives", len(done), len(plan))
        finally:  # of a batch that was interrupted, too
            failures_warning = _write_failures(store, done)
        joined, join_error = None, ""
        if options.join:
            executor_for = workers.executor_for(execution.threads)
            urls = {one.drive: one.given.url for one in plan}
            joined, join_error = _join(store, pipeline, execution, executor_for, places and places.result, urls)
        if not options.keep_cache and not join_error:  # another join would need it
            _clear_caches(store)
    outcomes = [done[one.drive] for one in plan]
    between = {} if joined is None else between_by_drive(joined["components"], done)
    return {
        "map": str(root),
        "library": digest,
        "engine": options.engine,
        "jobs": concurrency,
        "threads_per_job": each,
        "seconds": round(time.perf_counter() - began, 3),
        "failed": sum(one.state == "failed" for one in outcomes),
        "drives": [{**asdict(one), "between": between.get(one.drive)} for one in outcomes],
        "joined": joined,
        "join_error": join_error,
        "warnings": [
            *failures_warning,
            *([] if joined else damage_warnings(store)),
            *_duplicate_recordings(outcomes, [one.record["inputs"] for one in plan], known),
            *_replaced_recordings(outcomes, [one.record["inputs"] for one in plan], known),
            *_other_versions([record for drive, record in known.items() if drive not in done], common),
        ],
    }


def write_failures(store: Store, done: Mapping[str, DriveState]) -> None:
    """Note the failures of this batch in the map, beside those of other drives."""
    changes = dict[str, dict[str, Any] | None]()
    for drive, one in done.items():
        failed = {"log": one.log, "error": one.error, "fault": one.fault, "attempts": one.attempts}
        changes[drive] = failed if one.state == "failed" else None
    store.update_failures(changes)


def _write_failures(store: Store, done: Mapping[str, DriveState]) -> list[str]:
    """`write_failures`; a warning where a full disk refuses it, which must not cost the answer."""
    try:
        write_failures(store, done)
    except (VplogError, OSError) as error:
        return [f"failures.json does not list the failures of this batch: {error}"]
    return []


def _duplicate_recordings(
    outcomes: Sequence[DriveState], inputs: Sequence[dict[str, str]], known: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """A warning for each recording of a batch that the map has under several names, be it by an earlier batch: closures
    between them mean nothing."""
    common: dict[tuple[str, ...], dict[str, str]] = {}
    for one, content in zip(outcomes, inputs, strict=True):
        if content and one.state != "failed" and "://" not in one.log:  # of those the bytes are not known
            common.setdefault(tuple(sorted(content.values())), {})[one.drive] = one.log
    for drive, record in known.items():
        if (content := tuple(sorted(record["inputs"].values()))) in common:
            common[content].setdefault(drive, record["log"])
    return [
        f"{' and '.join(list(these.values())[:2])} are the same recording, byte for byte: it is in the map as "
        f"{' and '.join(these)}."
        for these in common.values()
        if len(these) > 1
    ]


def _replaced_recordings(
    outcomes: Sequence[DriveState], inputs: Sequence[dict[str, str]], known: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """A warning for each drive that took the place of one whose log had its path, and no file in common with it."""
    result = []
    for one, new in zip(outcomes, inputs, strict=True):
        before = known.get(one.drive, {}).get("inputs", {})
        old = {text for name, text in before.items() if not name.startswith(BESIDE)}
        if one.state == "computed" and old and old.isdisjoint(new.values()):
            result.append(
                f"{one.drive} is replaced: {one.log} is another file than before. If it holds another drive, give each "
                "a path of its own, or a name in a manifest, to have both in the map."
            )
    return result


def _other_versions(others: Sequence[dict[str, Any]], common: dict[str, Any]) -> list[str]:
    """Warnings where drives that are no part of this batch were made with other settings, or by another vplog."""
    made = [record for record in others if PLACES_ONLY not in record]
    warnings = []
    for what, names in (("Other settings", ["settings"]), ("Another version of vplog or its packages", _CODE)):
        other = [record["log"] for record in made if any(record.get(name) != common[name] for name in names)]
        if other:
            warnings.append(
                f"{what} made {len(other)} of the drives that were in the map before. Give their logs too, to compute "
                f"them again; the first is {other[0]}."
            )
    return warnings


def _hashes_record(store: Store) -> Path:
    """Path of the record of `known_hashes`: in the map's folder, or in the user's cache of a map on an object store."""
    folder = None if store.mirror is None else cache_folder(None, "hashes")
    return folder / f"{key_of(str(store))}.json" if folder is not None else store.root / NAME


def _cache(store: Store, drive: str) -> Path:
    return store.root / ".cache" / folder_name(drive)


def _clear_caches(store: Store) -> None:
    for drive in store.drives():
        shutil.rmtree(_cache(store, drive), ignore_errors=True)
    with suppress(OSError):  # not empty: what failed goes on there
        _cache(store, "").parent.rmdir()


def _join(store: Store, *how: Any) -> tuple[dict[str, Any] | None, str]:
    """The record of joining the map, or why it failed: the outcomes of drives are not lost with it."""
    try:
        return join_drives(store, *how), ""
    except (VplogError, OSError) as error:
        return None, str(error)


def _tasks(store: Store, wanted: Sequence[PlannedDrive], template: Task, longest_first: bool) -> list[Task]:
    """A task for each drive that is to be computed.

    With `longest_first` none of the long drives is begun when all others are done.
    """
    sizes = {one.drive: _log_bytes(one.given.url) for one in wanted}
    order = sorted(wanted, key=lambda one: -sizes[one.drive]) if longest_first else wanted
    return [
        replace(
            template, drive=one.drive, log=one.given.url, topics=one.given.topics, record=one.record,
            cache=_cache(store, one.drive), folder=template.folder / f"{os.getpid()}-{number}",
            in_parts=len(wanted) == 1 or 2 * sizes[one.drive] > sum(sizes.values()),
        )
        for number, one in enumerate(order)
    ]  # fmt: skip


def _log_bytes(url: str) -> int:
    """Length of the log of a drive; 0 where it is remote, as that would be another request, or cannot be read."""
    path = located(url)
    try:
        return 0 if isinstance(path, RemotePath) else bytes_of(path)
    except OSError:  # its own run raises it
        return 0


def _divide_cores(workers: Engine, jobs: int | None, drives: int) -> tuple[int, int]:
    """Threads of each drive, and drives at once.

    On this machine each has all threads, which the system shares out: drives are not equally long, and the last has the
    cores for itself. Else its share of the cores, as far as one machine has them; without `jobs` none waits.
    """
    if isinstance(workers, LocalEngine):
        return workers.cores, jobs or 1
    wanted = min(jobs or max(workers.concurrency(1), 1), max(drives, 1))
    each = min(max(workers.cores // wanted, 1), workers.max_cores)
    return each, jobs or workers.concurrency(each)


def _publish(store: Store, task: Task, outcome: Outcome, attempts: int, retries: int) -> DriveState:
    drive, done = task.drive, False
    while not (done or outcome.error):
        try:
            drive, done = map_store.publish(store, task.drive, task.folder, outcome.sent), True
        except ResultError as problem:
            fault = "network" if isinstance(problem, UnreachableError) else "io"
            if fault == "io" or not retries:
                outcome = replace(outcome, error=str(problem), fault=fault)
            else:
                retries -= 1
                time.sleep(_PAUSE_S)
    if outcome.error:
        shutil.rmtree(task.folder, ignore_errors=True)
    state = "failed" if outcome.error else "computed"
    return replace(DriveState.after(task, state, attempts, outcome), drive=drive)
