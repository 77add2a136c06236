"""One drive of a batch, computed by a worker: its task and its outcome."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from vplog import logs
from vplog.data import Keyframes
from vplog.errors import VplogError, causes, is_of_disk
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.process_limits import process_limits
from vplog.execution.timing import peak_memory_mb
from vplog.logs import TopicChoice
from vplog.maps.import_places import write_places_run
from vplog.maps.search.query import describe_log
from vplog.maps.storage import layout
from vplog.maps.storage.damage import UnreachableError
from vplog.maps.storage.upload import SentRun, send_run
from vplog.pipeline import Pipeline
from vplog.pipeline import run as run_alone
from vplog.results import run_record, tables
from vplog.run import provenance
from vplog.run.odometry import check_metric, is_metric
from vplog.run.run_folder import CacheOptions
from vplog.stages import Log
from vplog.storage.input_hashes import hash_inputs
from vplog.storage.remote_path import RemotePath, located
from vplog.storage.urls import shown


@dataclass(frozen=True)
class Task:
    """One drive to compute, as it goes to another process."""

    drive: str
    log: str
    """Path or URL of the log, with the query that `record` omits."""
    folder: Path
    """Folder in which the run is made; it is renamed into the map."""
    library: Path
    pipeline: Pipeline
    topics: TopicChoice
    threads: int
    record: dict[str, Any]
    """drive.json: what the drive is made from."""
    cache: Path | None = None
    """Stage cache of the drive, for another attempt; None for no cache."""
    keep_cache: bool = False
    """Whether it stays of a drive that is finished, too."""
    time_s: float | None = None
    """Longest time of an attempt; None for any."""
    memory_mb: float | None = None
    """Largest resident memory of an attempt, in MB (10^6 bytes); None for any."""
    in_parts: bool = False
    """Whether its frames are extracted on all machines at once: it is longer than all other drives together."""
    remote: str = ""
    """URL of a map on an object store, to which the run folder is sent; empty for a map in a folder."""
    began: float = 0.0
    """Time at which the batch asks for this attempt, by its clock."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of an attempt at a drive."""

    error: str = ""
    """One line; none where all went well."""
    fault: str = ""
    """Kind of the error: `input`, what is given cannot be used; `network`, `io` or `memory`, a machine could not read,
    write or hold it; `worker`, its process or machine is gone; `time limit`, `memory limit`; `internal`, a fault of
    vplog's own."""
    seconds: float = 0.0
    worker: str = ""
    """Machine and process; none of a worker that died."""
    peak_memory_mb: float = 0.0
    """Largest resident memory of the worker, in MB (10^6 bytes); 0 where unknown."""
    keyframes: int = 0
    accepted: int = 0
    warnings: tuple[str, ...] = ()
    sent: SentRun | None = None
    """The run folder, where it was sent to a store: the batch commits it."""


@dataclass(frozen=True)
class DriveState:
    """State of one log in a batch; `seconds` to `warnings` as in the Outcome of the last attempt."""

    drive: str
    log: str
    state: str
    """`computed`, `unchanged` or `failed`; while it is computed `started`, or `retried` where it will be again."""
    attempts: int = 0
    """0 where nothing was to be done, or could be."""
    seconds: float = 0.0
    worker: str = ""
    peak_memory_mb: float = 0.0
    error: str = ""
    fault: str = ""
    keyframes: int = 0
    accepted: int = 0
    warnings: Sequence[str] = ()

    @classmethod
    def after(cls, task: Task, state: str, attempts: int, outcome: Outcome) -> DriveState:
        """The drive of a task with this outcome of an attempt."""
        names = (one.name for one in fields(cls)[4:])
        return cls(task.drive, shown(task.log), state, attempts, **{name: getattr(outcome, name) for name in names})


def made_by() -> dict[str, Any]:
    """Code and packages of this machine, as drive.json has them: a drive is computed where they are the batch's."""
    return {"code": layout.code_hash(), "versions": provenance.versions()}


def compute_drive(task: Task) -> Outcome:
    """Make the run folder of a drive, drive.json last; why not, in one line, where that fails."""
    began, error, fault, peak, found = time.perf_counter(), "", "", 0.0, dict[str, Any]()
    try:
        log = located(task.log)
        with limited(task.threads), process_limits(task.time_s, task.memory_mb):
            record, own_name, drive = _compute(task, log)
        peak = record.get("totals", {}).get("peak_memory_mb", 0.0)
        if any(task.record["inputs"].get(name) != text for name, text in record["inputs"].items()):
            error, fault = f"{task.record['log']} changed while it was read. Run again when it is complete.", "input"
        else:
            if own_name != task.drive:
                layout.set_drive_id(task.folder / "keyframes.parquet", task.drive)
            run_record.write_run_json(task.folder / "drive.json", drive)
            if task.remote:
                sent_after_s = time.perf_counter() - began  # other clocks than the batch's may be wrong
                remote = cast("RemotePath", located(task.remote))
                found["sent"] = send_run(remote, task.folder, task.began + sent_after_s)
            counts = record["counts"]
            found |= {"keyframes": counts["keyframes"], "accepted": counts["verdicts"].get("accepted", 0)}
            found["warnings"] = tuple(record["warnings"])
    except Exception as problem:  # a fault of ours in one drive must not stop the others
        error, fault = told(problem, task.log)
    seconds, worker = round(time.perf_counter() - began, 3), f"{platform.node()}:{os.getpid()}"
    return Outcome(error, fault, seconds, worker, max(peak, round(peak_memory_mb(), 1)), **found)


def told(error: Exception, url: str) -> tuple[str, str]:
    """An error of computing or reading a log in one line, and the fault as in `Outcome`: `network` where it is that of
    the server of a remote one, and not that it has no such file."""
    if isinstance(error, MemoryError):
        return "Out of memory. Use fewer --jobs, or a machine with more.", "memory"
    if isinstance(error, OSError):  # another attempt may be on another machine, and finds what this one had done
        return f"Cannot read or write {error.filename or 'a file'}: {error.strerror or error}.", "io"
    if not isinstance(error, VplogError):
        text = f"Internal error: {type(error).__name__}: {' '.join(str(error).split())[:200]}."
        return f"{text} `vplog run LOG --debug` shows where.", "internal"
    kinds = [type(one) for one in causes(error) if isinstance(one, OSError)] if "://" in url else []
    remote = any(not issubclass(kind, FileNotFoundError | PermissionError) for kind in kinds)
    network = remote or isinstance(error, UnreachableError)
    return str(error), "network" if network else "io" if is_of_disk(error) else "input"


def _compute(task: Task, path: Path) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Make the run folder of a drive: its run.json, the name of the drive in its tables, and its drive.json."""
    execution, log = Execution(task.threads), logs.open(path, task.topics)
    if task.topics.odometry != "visual" and _is_pictures(log):
        return _write_pictures(task, path, log, execution), task.drive, {**task.record, layout.PICTURES: True}
    check_metric(log, task.topics)
    options = CacheOptions(task.cache, use=task.cache is not None)
    done = run_alone(path, task.folder, task.pipeline, task.library, task.topics, execution, options)
    check_metric(done.log, task.topics, done.odometry)
    return done.record, done.keyframes.drive, task.record


def _is_pictures(log: Log) -> bool:
    """Whether a log is a folder of images without odometry, or depth or scans that give one: these can be found again
    in a map, and no more than that."""
    computed = is_metric(log) or log.lidar() is not None
    return log.file_names() is not None and log.odometry() is None and not computed


def _write_pictures(task: Task, path: Path, log: Log, execution: Execution) -> dict[str, Any]:
    """Describe every picture with the map's library, and write the run folder of the drive; its run.json.

    Poses are not known: all are the identity, and the drive is joined with no other.
    """
    state = task.pipeline.places.load(task.library, execution)
    stamps, descriptors, warnings = describe_log(log, log.stamps(), task.pipeline, state, execution, query=False)
    rows, names = np.searchsorted(log.stamps(), stamps).tolist(), log.file_names() or []
    account = {
        "log": task.record["log"],
        "log_stat": provenance.stat_of([path]),
        "inputs": hash_inputs(path),
        "topics": task.topics.model_dump(mode="json"),
        "library": {"hash": state.hash, "from": provenance.library_of(task.library)},
        "names": [names[row] for row in rows],
        "warnings": [*log.warnings, *warnings],
    }
    header = tables.TableMetadata(task.pipeline.model_dump(mode="json"), state.hash)
    keyframes = Keyframes(task.drive, stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    task.folder.mkdir(parents=True, exist_ok=True)
    return write_places_run(task.folder, keyframes, state.to_arrow(descriptors), header, account)
