"""One drive of a batch, computed in a process of its own."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from vplog.errors import VplogError
from vplog.pipeline import run as run_alone
from vplog.remote import located
from vplog.results import run_record, tables

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.logs import TopicChoice
    from vplog.pipeline import Pipeline


@dataclass(frozen=True)
class Task:
    """One drive to compute, as it goes to another process."""

    drive: str
    log: str
    folder: Path
    """Where the run folder is made; it is the map's when it is renamed in."""
    library: Path
    pipeline: Pipeline
    topics: TopicChoice
    threads: int
    about: dict[str, Any]
    """drive.json: what the drive is made from."""


def in_process(task: Task) -> tuple[Task, float, str]:
    """Compute a drive in a process of its own: memory is given back, and one that dies takes no other along."""
    began, error = time.perf_counter(), ""
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(1, context, _end_with_parent) as pool:
            error = pool.submit(compute_drive, task).result()
    except BrokenProcessPool:
        error = "Its process was killed, as for want of memory. Use fewer --jobs, and run again."
    return task, round(time.perf_counter() - began, 3), error


def _end_with_parent() -> None:
    """A worker whose batch was killed must not go on beside the next one."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def compute_drive(task: Task) -> str:
    """Make the run folder of a drive, drive.json last; why not, in one line, where that fails."""
    try:
        log = located(task.log)
        done = run_alone(log, task.folder, task.pipeline, task.library, task.topics, task.threads)
        if any(task.about["inputs"].get(name) != text for name, text in done.record["inputs"].items()):
            return f"{task.log} changed while it was read. Run again."
        if done.keyframes.drive != task.drive:
            _rename(task.folder / "keyframes.parquet", task.drive)
        run_record.write_run_json(task.folder / "drive.json", task.about)
    except VplogError as error:
        return str(error)
    except MemoryError:
        return "Out of memory. Use fewer --jobs."
    except OSError as error:
        return f"Cannot read or write {error.filename or 'a file'}: {error.strerror or error}."
    except Exception as error:  # a fault of ours in one drive must not stop the others
        return f"Internal error: {type(error).__name__}: {' '.join(str(error).split())[:200]}. `vplog run` shows more."
    return ""


def _rename(path: Path, drive: str) -> None:
    """Give the keyframes the drive's name in the map, where another log has that of its own."""
    header = tables.read_metadata(path)
    keyframes, world_from_body = tables.read_keyframes(path)
    about = tables.TableMetadata(json.loads(header["vplog.settings"]), header["vplog.library"])
    tables.write_keyframes(path, replace(keyframes, drive=drive), world_from_body, about)
