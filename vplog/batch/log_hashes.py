"""sha256 of the logs of a batch, which is known of those that have not changed since the last one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from pydantic import TypeAdapter

from vplog import logs as all_logs
from vplog.batch.plan import DriveInput, Hashes
from vplog.batch.worker import told
from vplog.errors import LogError, ResultError, VplogError
from vplog.results.run_record import read_run_json, write_run_json
from vplog.storage.input_hashes import bytes_of, changed_s, hash_inputs, stat_signature
from vplog.storage.remote_path import RemotePath

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.logs import TopicChoice

NAME = ".inputs.json"
"""Name of the record in the map: hidden, as it concerns the logs on this machine, not the map."""
BESIDE = "beside "
"""Prefix of the names of files beside a log."""
_SETTLED_S = 3.0
"""A file written this short a time ago could be written again without a change of its times: some file systems count
them in steps of two seconds."""
_MOST_BYTES = 10**9
"""Longest record that is read: a million logs of several files."""

_PROGRESS_EVERY_S = 0.2
"""Interval of progress."""

_Entry = dict[str, dict[str, str]]
"""`stat`, the `stat_signature` of a log when it was read, and its `hashes`."""
_ENTRIES = TypeAdapter(dict[str, _Entry])


def known_hashes(
    logs: Sequence[DriveInput], record: Path, execution: Execution, retries: int = 0
) -> list[Hashes | VplogError]:
    """sha256 of the files of each log and of those that its topics name beside it, by name, in order; the error where
    they cannot be read, even after `retries` of a server, or are no log.

    A file whose length and times are those of the record, a file that is made and updated here, is not read. A record
    that cannot be read is made again, one that cannot be written is done without. Ctrl-C ends it within a block;
    progress is in MB read.
    """
    known = _read(record)
    current: dict[str, _Entry] = {}
    done, total, stop = [0] * len(logs), [0] * len(logs), Event()

    def one(path: Path, number: int, is_log: bool) -> Hashes:
        if isinstance(path, RemotePath):
            return hash_inputs(path)
        name, stat = str(path.absolute()), stat_signature(path)
        if (entry := known.get(name, {})).get("stat") == stat and "hashes" in entry:
            current[name] = entry
            return entry["hashes"]

        def read(count: int) -> None:
            done[number] += count
            if stop.is_set():
                raise CancelledError

        if is_log:
            all_logs.check(path)  # a folder of other things may hold anything
        began, total[number] = time.time(), total[number] + bytes_of(path)
        hashes = hash_inputs(path, read)
        if stat_signature(path) == stat and changed_s(path) < began - _SETTLED_S:
            current[name] = {"stat": stat, "hashes": hashes}
        return hashes

    def of_log(given: DriveInput, number: int, left: int = retries) -> Hashes | VplogError:
        try:
            log = one(given.log, number, True)
            return log | hashes_beside(given.topics, lambda file: one(file, number, False))
        except LogError as error:
            return error
        except OSError as error:
            problem = LogError(f"Cannot read {error.filename or given.log}: {error.strerror or error}.")
            problem.__cause__ = error
            again = left and told(problem, given.url)[1] == "network"
            return of_log(given, number, left - 1) if again else problem

    with ThreadPoolExecutor(execution.threads) as pool:
        waiting = [pool.submit(of_log, log, number) for number, log in enumerate(logs)]
        try:
            while wait(waiting, _PROGRESS_EVERY_S).not_done:
                execution.progress("check (MB)", sum(done) // 10**6, sum(total) // 10**6)
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise
        answers = [one.result() for one in waiting]
        if sum(done):
            execution.progress("check (MB)", sum(done) // 10**6, sum(done) // 10**6)
    if any(known.get(name) != about for name, about in current.items()):
        every = {name: about for name, about in sorted({**known, **current}.items()) if os.path.exists(name)}  # noqa: PTH110 (never raises)
        with suppress(ResultError):
            write_run_json(record, every)
    return answers


def hashes_beside(topics: TopicChoice, hashes_of: Callable[[Path], Hashes]) -> Hashes:
    """sha256 of the files that topics name beside a log, by BESIDE, what they are, and their names."""
    return {
        f"{BESIDE}{what} {name}": text  # a drive's may all be called alike
        for what, file in topics.files.items()
        for name, text in hashes_of(file).items()
    }


def _read(record: Path) -> dict[str, _Entry]:
    """The entry of each log; nothing where there is no such file, or another thing."""
    try:
        return _ENTRIES.validate_python(read_run_json(record) if record.stat().st_size <= _MOST_BYTES else {})
    except (OSError, ValueError, ResultError):
        return {}
