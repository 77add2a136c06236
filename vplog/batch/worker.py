"""One drive of a batch, computed by a worker: its task and its outcome."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.batch.picture_drive import pictures_of, write_pictures
from vplog.cache.input_hashes import hash_inputs
from vplog.errors import VplogError
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.timing import peak_memory_mb
from vplog.maps.storage import layout
from vplog.pipeline import Pipeline
from vplog.pipeline import run as run_alone
from vplog.results import run_record
from vplog.run import provenance
from vplog.run.run_folder import CacheOptions
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from vplog.logs import TopicChoice


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
    in_parts: bool = False
    """Whether its frames are extracted on all machines at once: it is longer than all other drives together."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of an attempt at a drive."""

    error: str = ""
    """One line; none where all went well."""
    retryable: bool = False
    """Whether the cause of the error may be gone at another attempt."""
    seconds: float = 0.0
    """Wall time in the worker."""
    worker: str = ""
    """Machine and process; none of a worker that died."""
    peak_memory_mb: float = 0.0
    """Largest resident memory of the worker, in MB (10^6 bytes); 0 where unknown."""
    keyframes: int = 0
    """Keyframes of the drive."""
    accepted: int = 0
    """Closures within it."""
    warnings: tuple[str, ...] = ()
    """Warnings of the run."""


@dataclass(frozen=True)
class Drive:
    """State of one log in a batch; `seconds` to `warnings` as in the Outcome of the last attempt."""

    drive: str
    log: str
    state: str
    """`computed`, `unchanged` or `failed`."""
    attempts: int = 0
    """0 where nothing was to be done, or could be."""
    seconds: float = 0.0
    worker: str = ""
    peak_memory_mb: float = 0.0
    error: str = ""
    keyframes: int = 0
    accepted: int = 0
    warnings: Sequence[str] = ()


def made_by() -> dict[str, Any]:
    """Code and packages of this machine, as drive.json has them: a drive is computed where they are the batch's."""
    return {"code": layout.code_hash(), "versions": provenance.head(Pipeline(), Path(), 1)["versions"]}


def compute_drive(task: Task) -> Outcome:
    """Make the run folder of a drive, drive.json last; why not, in one line, where that fails."""
    began, error, retryable, peak, found = time.perf_counter(), "", False, 0.0, dict[str, Any]()
    try:
        log = located(task.log)
        with limited(task.threads):
            record, own_name, drive = _compute(task, log)
        peak = record.get("totals", {}).get("peak_memory_mb", 0.0)
        if any(task.record["inputs"].get(name) != text for name, text in record["inputs"].items()):
            error = f"{task.record['log']} changed while it was read. Run again when it is complete."
        else:
            if own_name != task.drive:
                layout.set_drive_id(task.folder / "keyframes.parquet", task.drive)
            run_record.write_run_json(task.folder / "drive.json", drive)
            counts = record["counts"]
            found = {"keyframes": counts["keyframes"], "accepted": counts["verdicts"].get("accepted", 0)}
            found["warnings"] = tuple(record["warnings"])
    except VplogError as problem:
        error = str(problem)
    except MemoryError:
        error, retryable = "Out of memory. Use fewer --jobs, or a machine with more.", True
    except OSError as problem:
        # another attempt may be on another machine, and finds what this one had done
        error, retryable = f"Cannot read or write {problem.filename or 'a file'}: {problem.strerror or problem}.", True
    except Exception as problem:  # a fault of ours in one drive must not stop the others
        text = " ".join(str(problem).split())[:200]
        error = f"Internal error: {type(problem).__name__}: {text}. `vplog run LOG --debug` shows where."
    seconds, worker = round(time.perf_counter() - began, 3), f"{platform.node()}:{os.getpid()}"
    return Outcome(error, retryable, seconds, worker, max(peak, round(peak_memory_mb(), 1)), **found)


def _compute(task: Task, log: Path) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Make the run folder of a drive: its run.json, the name of the drive in its tables, and its drive.json."""
    execution = Execution(task.threads)
    if (pictures := pictures_of(log, task.topics)) is not None:
        about = {"log": task.record["log"], "inputs": hash_inputs(log), "topics": task.topics.model_dump(mode="json")}
        record = write_pictures(task.folder, task.drive, pictures, task.library, task.pipeline, about, execution)
        return record, task.drive, {**task.record, layout.PICTURES: True}
    options = CacheOptions(task.cache, use=task.cache is not None)
    done = run_alone(log, task.folder, task.pipeline, task.library, task.topics, execution, options)
    return done.record, done.keyframes.drive, task.record
