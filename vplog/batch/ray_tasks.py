"""What a batch runs on the machines of a Ray cluster, which share nothing but the logs."""

from __future__ import annotations

import platform
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ray
from ray import exceptions

from vplog.batch.worker import Outcome, compute_drive, made_by
from vplog.errors import VplogError
from vplog.results import run_record
from vplog.run.feature_extraction import compute_part, put_part
from vplog.run.provenance import library_of
from vplog.storage.scratch import files_in, pieces, scratch, unpacked

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.batch.worker import Task
    from vplog.run.feature_extraction import Part
    from vplog.storage.scratch import Bytes

    Files = tuple[tuple[str, tuple[Any, ...]], ...]

_OTHER = "{} has another vplog, or other packages, than the machine of the batch. Install the same there."


@dataclass(frozen=True)
class RemoteOutcome(Outcome):
    """How an attempt ended on another machine."""

    files: Files = ()
    """Name of every file of the run folder, drive.json last, and its pieces in the object store."""
    cache: Files = ()
    """The same of what the stages came to, where that is wanted and the batch cannot see it."""


def call(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Any function of a module as a Ray task."""
    return function(*args, **kwargs)


def about_node() -> tuple[str, dict[str, Any]]:
    """What this machine is called, and what it would compute with."""
    return node_name(), made_by()


def is_here(file: str, content: str) -> bool:
    """Whether this machine sees a file that the batch has written."""
    try:
        return Path(file).read_text(encoding="utf-8") == content
    except (OSError, ValueError):
        return False


def node_name() -> str:
    """The machine, and the start of its number in the cluster: several nodes may be on one machine."""
    return f"{platform.node()}/{ray.get_runtime_context().get_node_id()[:6]}"


def compute_remote_part(part: Part, wanted: dict[str, Any]) -> bytes:
    """A stretch of a drive's frames. `wanted` is what the batch computes with. Raises VplogError."""
    if made_by() != wanted:
        raise VplogError(_OTHER.format(node_name()))
    return compute_part(part)


def compute_remote_drive(task: Task, library: dict[str, Bytes], parts: list[tuple[Part, Any]]) -> RemoteOutcome:
    """A drive with everything on this machine's own disk; its run folder goes into the object store.

    Parts that other tasks compute are waited for, one after the other, while Ray lends out this task's cores.
    """
    where = node_name()
    if any(task.about[name] != value for name, value in made_by().items()):
        return RemoteOutcome(_OTHER.format(where), worker=where)
    try:
        with scratch("run") as folder:
            place, made = unpacked(library, f"library-{task.about['library']}"), folder / "run"
            cache = task.cache or folder / "cache"
            for part, data in parts:
                with suppress(exceptions.RayError, VplogError):  # failed, lost or damaged: it is computed here
                    put_part(cache, part, ray.get(data))
            outcome = compute_drive(replace(task, folder=made, library=place, cache=cache))
            told = {**vars(outcome), "worker": f"{where}:{outcome.worker.rpartition(':')[2]}"}
            if outcome.error:
                return RemoteOutcome(**told)
            _name_library(made, task.library)
            kept = _given_back(cache) if task.keep_cache and task.cache is None else ()
            return RemoteOutcome(**told, files=_given_back(made), cache=kept)
    except VplogError as error:
        return RemoteOutcome(str(error), worker=where)
    except OSError as error:
        why = f"Cannot write {error.filename or 'a file'} on {where}: {error.strerror}."
        return RemoteOutcome(why, may_pass=True, worker=where)


def _name_library(made: Path, library: Path) -> None:
    """Let run.json of a finished run name the map's library, not this machine's copy."""
    account = run_record.read_run_json(made / "run.json")
    account["library"]["from"] = library_of(library)
    run_record.write_run_json(made / "run.json", account)


def _given_back(folder: Path) -> Files:
    """The files of a folder as pieces in the object store, drive.json last."""
    names = sorted(files_in(folder), key=lambda name: (name == "drive.json", name))
    return tuple((name, tuple(ray.put(piece) for piece in pieces(folder / name))) for name in names)
