"""Many drives into one map: each in a process of its own, all described with one library, none stopping another."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog import logs, record
from vplog.batch_worker import Task, in_process
from vplog.errors import LibraryError, ResultError, SettingsError, VplogError
from vplog.maps import keys
from vplog.maps import store as map_store
from vplog.pipeline import build_library, check_library
from vplog.references import PAPER_SIZE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.logs import TopicChoice
    from vplog.maps.store import Store
    from vplog.pipeline import Pipeline

    Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Drive:
    """What became of one log in a batch."""

    drive: str
    log: str
    state: str
    """`computed`, `unchanged` or `failed`."""
    seconds: float = 0.0
    """Wall time of computing it, process and all; 0 where it was not computed."""
    error: str = ""
    """One line, of a drive that failed."""


def run_batch(
    paths: Sequence[Path],
    root: Path,
    pipeline: Pipeline,
    library: Path | None = None,
    topics: TopicChoice | None = None,
    jobs: int = 1,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """Drives in, a map in `root` out: what of it is missing or made from something else is computed, `jobs` at once.

    `threads` are shared by the jobs; results do not depend on either. Without `library` the map's own is used, or one
    is built from the first logs. A drive that fails is recorded and stops no other; every log's fate is in the answer.
    Raises VplogError where the map as a whole cannot be written or does not fit the library or the settings.
    """
    topics = topics or logs.TopicChoice()
    began = time.perf_counter()
    given = [str(path.resolve()) for path in paths]
    twice = [log for log, count in Counter(given).items() if count > 1]
    if twice:
        raise SettingsError(f"{twice[0]} is given twice. Give each log once.")
    with map_store.writing(root) as store:
        digest = _library(store, paths, library, pipeline, topics, threads, progress)
        store.write_head(map_store.Head(digest, pipeline.model_dump(mode="json")))
        known = store.drives()
        inputs, errors = _hashed(paths, topics, threads)
        drives = keys.drive_names([_name(path) for path in paths], given, known, inputs)
        done: dict[str, Drive] = {}
        tasks = []
        alike = _alike(pipeline, topics, digest)
        for drive, log, content in zip(drives, given, inputs, strict=True):
            about = {"drive": drive, "inputs": content, **alike}
            about |= {"key": keys.key_of(about), "log": log}
            if drive in known and known[drive]["key"] == about["key"] and log not in errors:
                done[drive] = Drive(drive, log, "unchanged")
            elif log in errors:
                done[drive] = Drive(drive, log, "failed", error=errors[log])
            else:
                made = store.staging / f"{os.getpid()}-{len(tasks)}"
                tasks.append(Task(drive, log, made, store.library(digest), pipeline, topics, 1, about))
        each = max(threads // max(min(jobs, len(tasks)), 1), 1)
        failures = {drive: told for drive, told in store.failures().items() if drive not in set(drives)}
        with ThreadPoolExecutor(jobs) as pool:  # a thread per job, which waits for the process of its drive
            waiting = [pool.submit(in_process, replace(task, threads=each)) for task in tasks]
            try:
                for future in as_completed(waiting):
                    found = _put_in(store, *future.result())
                    done[found.drive] = found
                    progress("drives", len(done), len(paths))
            except BaseException:
                for future in waiting:
                    future.cancel()
                for child in multiprocessing.active_children():
                    child.terminate()
                raise
        failures |= {one.drive: {"log": one.log, "error": one.error} for one in done.values() if one.state == "failed"}
        if failures or (root / "failures.json").exists():
            store.write_failures(failures)
    fate = [done[drive] for drive in drives]
    return {
        "map": str(root),
        "library": digest,
        "jobs": jobs,
        "threads_per_job": each,
        "seconds": round(time.perf_counter() - began, 3),
        "failed": sum(one.state == "failed" for one in fate),
        "drives": [vars(one) for one in fate],
    }


def _name(path: Path) -> str:
    """What a log is called: its file without the ending, or its folder."""
    if path.is_dir():
        return path.name
    return Path(path.stem).stem if path.suffix in (".zst", ".zstd") else path.stem


def _library(
    store: Store, paths: Sequence[Path], given: Path | None, pipeline: Pipeline, topics: TopicChoice, threads: int,
    progress: Progress,
) -> str:  # fmt: skip
    """The hash of the map's library, which is put into the map where it has none yet.

    Raises LibraryError where another one is given, or where the settings describe places otherwise.
    """
    settings = pipeline.model_dump(mode="json")
    if not (store.root / "map.json").exists():
        store.write_head(map_store.Head(None, settings))
    known = store.head().library
    if known is not None and not store.library(known).is_dir():
        raise LibraryError(f"{store.root} has lost its library {known[:12]}. Make the map anew in another folder.")
    made = store.staging / "library"
    if given is not None:
        check_library(given, pipeline)
        digest = pipeline.places.load(given, threads).hash
        if known not in (None, digest):
            raise LibraryError(
                f"{given} has hash {digest[:12]}, and the places of {store.root} are described with library "
                f"{known[:12]}: they would not compare. Leave --library out, or make another map."
            )
        if known is None:
            shutil.copytree(given, made)
    elif known is None:
        digest = build_library(_that_can_be_read(paths, topics), made, pipeline, topics, threads, progress).hash
    else:
        check_library(store.library(known), pipeline)
        digest = known
    if known is None:
        map_store.add_library(store, made, digest)
    return digest


def _that_can_be_read(paths: Sequence[Path], topics: TopicChoice) -> list[Path]:
    """The first logs, as many as a library has references, without those that tell no frames: their own run says why.

    Raises LogError of the first where none has any.
    """
    sound, first = [], None
    for path in paths:
        try:
            if len(logs.open(path, topics).stamps()):
                sound.append(path)
        except VplogError as error:
            first = first or error
        if len(sound) == PAPER_SIZE:
            break
    if not sound:
        raise first or LibraryError("None of the logs has a frame, so there is nothing to build a library from.")
    return sound


def _hashed(paths: Sequence[Path], topics: TopicChoice, threads: int) -> tuple[list[Any], dict[str, str]]:
    """sha256 of the files of each log and of those beside it, in order; why not by log, where they cannot be read."""
    beside = [file for file in (topics.odometry_file, topics.calibration_file) if file is not None]

    def hashes(path: Path) -> dict[str, str] | str:
        try:
            found = [record.hash_inputs(one) for one in (path, *beside)]
        except OSError as error:
            return f"Cannot read {error.filename or path}: {error.strerror or error}."
        return {**found[0], **{f"beside {name}": text for other in found[1:] for name, text in other.items()}}

    with ThreadPoolExecutor(threads) as pool:
        answers = list(pool.map(hashes, paths))
    errors = {
        str(path.resolve()): answer for path, answer in zip(paths, answers, strict=True) if isinstance(answer, str)
    }
    return [{} if isinstance(answer, str) else answer for answer in answers], errors


def _alike(pipeline: Pipeline, topics: TopicChoice, library: str) -> dict[str, Any]:
    """Of all that the drives of a batch depend on, what is the same for each, as drive.json has it.

    Every setting counts, as every table names them all. Where a log lies does not: a map may move with its logs.
    """
    return {
        "topics": topics.model_dump(mode="json", exclude={"odometry_file", "calibration_file"}),
        "settings": keys.key_of(pipeline.model_dump(mode="json")),
        "library": library,
        "code": keys.code_hash(),
        "versions": record.head(pipeline, Path(), 1)["versions"],
    }


def _put_in(store: Store, task: Task, seconds: float, error: str) -> Drive:
    """Rename a finished drive in."""
    if not error:
        try:
            map_store.publish(store, task.drive, task.folder)
        except ResultError as problem:
            error = str(problem)
    if error:
        shutil.rmtree(task.folder, ignore_errors=True)
    return Drive(task.drive, task.log, "failed" if error else "computed", seconds, error)
