"""Many drives into one map: each in a process of its own, all described with one library, none stopping another."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog import logs
from vplog.batch.engine import RETRIES, LocalEngine, computed, opened
from vplog.batch.log_hashes import NAME, known_hashes
from vplog.batch.map_library import map_library
from vplog.batch.worker import Task, made_by
from vplog.cache.input_hashes import bytes_of
from vplog.errors import ResultError, SettingsError, VplogError
from vplog.maps.import_places import ALONE
from vplog.maps.joining.join import join as join_drives
from vplog.maps.joining.join import load_places
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.contents import left_out
from vplog.maps.storage.layout import drive_record, folder_name
from vplog.pipeline import load_pipeline, pipeline_from
from vplog.storage.remote_path import RemotePath, located
from vplog.storage.urls import shown

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vplog.batch.engine import Engine
    from vplog.batch.worker import Outcome
    from vplog.execution.process_pool import OwnProcesses
    from vplog.logs import TopicChoice
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline

    Progress = Callable[[str, int, int], None]

_FREE_BYTES = 10**10
"""Of the map's disk that stay free of what would only be quicker to have: what a drive of several hours needs while it
is computed, at 0.3 MB a keyframe."""


_OTHER = (
    "{what} made {count} of the drives that were in the map before. Give their logs too, to compute them again; the "
    "first is {first}."
)
_CODE = ("code", "versions")
"""What of drive.json tells the program that made it."""
_ALIKE = "{first} and {second} are the same recording, byte for byte: it is in the map as {drives}."


@dataclass(frozen=True)
class Drive:
    """What became of one log in a batch."""

    drive: str
    log: str
    state: str
    """`computed`, `unchanged` or `failed`."""
    attempts: int = 0
    """How often it was begun; 0 where nothing was to be done, or could be."""
    seconds: float = 0.0
    """Wall time of the last attempt, in the worker; 0 where there was none, or where the worker died."""
    worker: str = ""
    """Machine and process of that attempt."""
    peak_memory_mb: float = 0.0
    """Largest resident memory of that process, in MB (10^6 bytes)."""
    error: str = ""
    """One line, of a drive that failed."""
    keyframes: int = 0
    """Of a drive that was computed now, as the next two."""
    accepted: int = 0
    """Closures within it."""
    warnings: Sequence[str] = ()
    """What its run had to say, as losses of its log."""


def settings_for(root: Path, name: str | None = None, assignments: Sequence[str] = ()) -> Pipeline:
    """The pipeline of this name, without one that of the map's last batch, if there is a map, else the default; with
    `a.b=c` overrides. Raises SettingsError, ResultError."""
    if name is None and (root / "map.json").exists():
        with map_store.reading(root) as store:
            head = store.sound_head()
        if head.library is not None:  # there may be drives
            try:
                return pipeline_from(head.settings, f"{root}/map.json", assignments)
            except SettingsError as error:
                raise SettingsError(f"{error} Or choose other settings than the map's: --pipeline default.") from None
    return load_pipeline(name or "default", assignments)


def run_batch(
    paths: Sequence[Path],
    root: Path,
    pipeline: Pipeline,
    library: Path | None = None,
    topics: TopicChoice | None = None,
    jobs: int | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
    *,
    engine: str = "local",
    address: str | None = None,
    retries: int = RETRIES,
    join: bool = True,
    keep_cache: bool = False,
    tell: Callable[[Drive], None] = lambda _: None,
    processes: OwnProcesses | None = None,
) -> dict[str, Any]:
    """Drives in, a map in `root` out: what of it is missing or made from something else is computed, `jobs` at once.

    On this machine every job has so many `threads`, and there is one job unless told. The engine `ray` takes the
    cluster at `address`, or one of this machine with so many threads; without `jobs` as many drives as it has cores
    for. Results depend on none of this. Without `library` the map's own is used, or one is built from the first logs.
    A drive whose worker dies is tried again, `retries` times; one that fails is recorded and stops no other; `tell` is
    given each as it ends, and every log's fate is in the answer. At the end closures `join` what the map then has
    (vplog/maps/joining); where that fails, `join_error` of the answer says why. With `keep_cache` what the stages came
    to stays in MAP/.cache, so that other settings do not need the images again. `processes` are those of this machine
    that the caller has begun.
    Raises VplogError where the map as a whole cannot be written or does not fit the library or the settings.
    """
    topics = topics or logs.TopicChoice()
    began = time.perf_counter()
    jobs = jobs or 1 if engine == "local" else jobs
    given = [_place(path) for path in paths]
    if twice := [log for log, count in Counter(given).items() if count > 1]:
        raise SettingsError(f"{shown(twice[0])} is given twice. Give each log once.")
    with (
        map_store.writing(root) as store,
        ThreadPoolExecutor(1) as aside,
        opened(engine, address, jobs or 1, threads, store.staging, processes) as workers,
    ):
        maker = aside.submit(made_by)
        digest = map_library(store, paths, library, pipeline, topics, threads, progress)
        store.write_head(map_store.Head(digest, pipeline.model_dump(mode="json")))
        known = store.drives()
        inputs, errors = known_hashes(
            dict(zip(given, paths, strict=True)), topics, store.root / NAME, threads, progress
        )
        drives = layout.drive_names(
            [_name(path) for path in paths], list(map(shown, given)), {**_failed(store), **known}, inputs
        )
        alike = _alike(pipeline, topics, digest) | maker.result()
        done, wanted = dict[str, Drive](), list[dict[str, Any]]()
        urls = dict(zip(drives, given, strict=True))
        for drive, content in zip(drives, inputs, strict=True):
            about, log = {"drive": drive, "inputs": content, **alike}, shown(urls[drive])
            about |= {"key": layout.key_of(about), "log": log}
            if why := errors.get(urls[drive]):
                done[drive] = Drive(drive, log, "failed", error=why)
                tell(done[drive])
            elif drive in known and known[drive]["key"] == about["key"] and not _is_damaged(store, drive):
                done[drive] = Drive(drive, log, "unchanged")
                _relocate(store, drive, known[drive]["log"], log)
            else:
                wanted.append(about)
        each, at_once = _shares(workers, jobs, len(wanted))
        progress("drives", len(done), len(paths))
        like = Task("", "", store.staging, store.library(digest), pipeline, topics, each, {}, None, join or keep_cache)
        tasks = _tasks(store, wanted, like, urls, longest_first=at_once > 1)
        places = None
        if join and tasks and len(known.keys() | set(drives)) > 1:  # while this process would only wait
            places = aside.submit(load_places, like.library, pipeline, threads)
        try:
            for ended in computed(workers, tasks, jobs, retries):
                found = done[ended[0].drive] = _put_in(store, *ended)
                if not (like.keep_cache and _has_room(store)):
                    _forget(store, found)
                tell(found)
                progress("drives", len(done), len(paths))
        finally:  # of a batch that was interrupted, too
            unsaid = _tell_failures(store, done)
        joined, join_error = None, ""
        if join:
            ready = None if places is None else places.result
            joined, join_error = _join(store, pipeline, workers.helpers(threads), threads, progress, ready, urls)
        if not keep_cache and not join_error:  # another join would need it
            _forget_all(store)
    fate = [done[drive] for drive in drives]
    return {
        "map": str(root),
        "library": digest,
        "engine": engine,
        "jobs": at_once,
        "threads_per_job": each,
        "seconds": round(time.perf_counter() - began, 3),
        "failed": sum(one.state == "failed" for one in fate),
        "drives": [asdict(one) for one in fate],
        "joined": joined,
        "join_error": join_error,
        "warnings": [
            *unsaid,
            *([] if joined else left_out(store)),
            *_same(fate, inputs),
            *_mixed([about for drive, about in known.items() if drive not in done], alike),
        ],
    }


def _failed(store: Store) -> dict[str, dict[str, Any]]:
    """Records of failed and damaged drives, whose IDs stay reserved while the map lists them."""
    found = {drive: {"log": told.get("log"), "inputs": None} for drive, told in store.failures().items()}
    for drive in store.damaged:
        with suppress(ResultError):
            found[drive] = drive_record(store.root / "runs" / folder_name(drive))
    return found


def _is_damaged(store: Store, drive: str) -> bool:
    """Whether a file of a drive is not as it was written; then the drive is left out until it is computed."""
    if wrong := store.damaged_files(drive):
        store.damaged[drive] = wrong[0]
    return bool(wrong)


def tell_failures(store: Store, done: Mapping[str, Drive]) -> None:
    """failures.json: of this batch, and those of other drives that were there before."""
    failures = {drive: told for drive, told in store.failures().items() if drive not in done}
    for drive, one in done.items():
        if one.state == "failed":
            failures[drive] = {"log": one.log, "error": one.error, "attempts": one.attempts}
    if failures or (store.root / "failures.json").exists():
        store.write_failures(failures)


def _tell_failures(store: Store, done: Mapping[str, Drive]) -> list[str]:
    """The same where a full disk must not cost the answer: then what is wrong is a warning."""
    try:
        tell_failures(store, done)
    except (VplogError, OSError) as error:
        return [f"failures.json does not list the failures of this batch: {error}"]
    return []


def _same(fate: Sequence[Drive], inputs: Sequence[dict[str, str]]) -> list[str]:
    """A warning for each recording that is in under several names: closures between them say nothing."""
    alike: dict[tuple[str, ...], list[Drive]] = {}
    for one, content in zip(fate, inputs, strict=True):
        if content and one.state != "failed" and "://" not in one.log:  # of those the bytes are not known
            alike.setdefault(tuple(sorted(content.values())), []).append(one)
    return [
        _ALIKE.format(first=these[0].log, second=these[1].log, drives=" and ".join(one.drive for one in these))
        for these in alike.values()
        if len(these) > 1
    ]


def _mixed(others: Sequence[dict[str, Any]], alike: dict[str, Any]) -> list[str]:
    """Warnings where drives that are no part of this batch were made with other settings, or by another vplog."""
    made = [about for about in others if ALONE not in about]
    warnings = []
    for what, names in (("Other settings", ["settings"]), ("Another version of vplog or its packages", _CODE)):
        other = [about["log"] for about in made if any(about.get(name) != alike[name] for name in names)]
        if other:
            warnings.append(_OTHER.format(what=what, count=len(other), first=other[0]))
    return warnings


def _cache(store: Store, drive: str) -> Path:
    """Where a drive's stages are kept until it is in the map."""
    return store.root / ".cache" / folder_name(drive)


def _forget(store: Store, found: Drive) -> None:
    """What the stages of a drive kept; of one that failed it stays, for another time."""
    if found.state == "computed":
        shutil.rmtree(_cache(store, found.drive), ignore_errors=True)


def _forget_all(store: Store) -> None:
    for drive in store.drives():
        shutil.rmtree(_cache(store, drive), ignore_errors=True)
    with suppress(OSError):  # not empty: what failed goes on there
        _cache(store, "").parent.rmdir()


def _relocate(store: Store, drive: str, before: str, log: str) -> None:
    """Joins and other libraries may need the log of a drive, so the map follows where it is moved."""
    if before != log:
        map_store.relocate(store, drive, log)


def _has_room(store: Store) -> bool:
    """Whether features of finished drives may stay until these are joined; they can be computed again."""
    return shutil.disk_usage(store.root).free > _FREE_BYTES


def _tasks(
    store: Store, wanted: Sequence[dict[str, Any]], like: Task, urls: Mapping[str, str], longest_first: bool
) -> list[Task]:
    """A task for each drive that is to be computed, by its drive.json.

    With `longest_first` none of the long drives is begun when all others are done.
    """
    sizes = {about["drive"]: _log_bytes(urls[about["drive"]]) for about in wanted}
    order = sorted(wanted, key=lambda about: -sizes[about["drive"]]) if longest_first else wanted
    return [
        replace(
            like, drive=about["drive"], log=urls[about["drive"]], about=about, cache=_cache(store, about["drive"]),
            folder=like.folder / f"{os.getpid()}-{number}",
            in_parts=len(wanted) == 1 or 2 * sizes[about["drive"]] > sum(sizes.values()),
        )
        for number, about in enumerate(order)
    ]  # fmt: skip


def _log_bytes(url: str) -> int:
    """Length of the log of a drive; 0 where it is remote, as that would be another request, or cannot be read."""
    path = located(url)
    try:
        return 0 if isinstance(path, RemotePath) else bytes_of(path)
    except OSError:  # its own run says why
        return 0


def _join(store: Store, *how: Any) -> tuple[dict[str, Any] | None, str]:
    """What came of joining the map, or why nothing did: the fates of drives are not lost for that."""
    try:
        return join_drives(store, *how), ""
    except (VplogError, OSError) as error:
        return None, str(error)


def _shares(workers: Engine, jobs: int | None, drives: int) -> tuple[int, int]:
    """Threads of each drive, and drives at once.

    On this machine each has all threads, which the system shares out: drives are not equally long, and the last has the
    cores for itself. Else its share of the cores, as far as one machine has them; without `jobs` none waits.
    """
    if isinstance(workers, LocalEngine):
        return workers.cores, jobs or 1
    wanted = min(jobs or max(workers.at_once(1), 1), max(drives, 1))
    each = min(max(workers.cores // wanted, 1), workers.widest)
    return each, jobs or workers.at_once(each)


def _place(path: Path) -> str:
    """Absolute path of a log as it was named, links not resolved, or its URL with the query."""
    if isinstance(path, RemotePath):
        return path.url
    if path.name in ("", ".."):
        return str(path.resolve())
    # `..` is of the folder that a link leads to
    return str((path.parent.resolve() if ".." in path.parts else path.parent.absolute()) / path.name)


def _name(path: Path) -> str:
    """What a log is called: its file without the ending, or its folder."""
    with suppress(OSError):  # what cannot be asked for is said of the log elsewhere
        if path.is_dir():
            return path.name if path.name not in ("", "..") else path.resolve().name
    return Path(path.stem).stem if path.suffix in (".zst", ".zstd") else path.stem


def _alike(pipeline: Pipeline, topics: TopicChoice, library: str) -> dict[str, Any]:
    """Of all that the drives of a batch depend on, what is the same for each, as drive.json has it.

    Every setting counts, as every table names them all. Where a log lies does not: a map may move with its logs.
    """
    return {
        "topics": topics.model_dump(mode="json", exclude={"odometry_file", "calibration_file"}),
        "settings": layout.key_of(pipeline.model_dump(mode="json")),
        "library": library,
    }


def _put_in(store: Store, task: Task, outcome: Outcome, attempts: int) -> Drive:
    """Rename a finished drive in."""
    error = outcome.error
    if not error:
        try:
            map_store.publish(store, task.drive, task.folder)
        except ResultError as problem:
            error = str(problem)
    if error:
        shutil.rmtree(task.folder, ignore_errors=True)
    told = (outcome.seconds, outcome.worker, outcome.peak_memory_mb, error)
    told += (outcome.keyframes, outcome.accepted, outcome.warnings)
    return Drive(task.drive, task.about["log"], "failed" if error else "computed", attempts, *told)
