"""Provenance of a run in its run.json: log, library, settings, versions; and how log and library are opened again."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vplog import logs
from vplog.errors import LibraryError, LogError, ResultError
from vplog.logs.topic_selection import OPTIONS
from vplog.results import run_record
from vplog.run.cache.code_hash import version
from vplog.settings import Settings
from vplog.stages import Log
from vplog.storage.input_hashes import bytes_of, files_of, stat_signature
from vplog.storage.json_records import key_of
from vplog.storage.remote_path import address, is_elsewhere, local_copy, located, original, reason
from vplog.version import __version__

OWN_LIBRARY = "the drive's own keyframes"
"""`library.from` of a run to which no library was given."""

UNNAMED = "is on a server that the command does not name, and vplog contacts no other"
"""Why what a record names is not opened."""
_NO_QUERY = " URLs are kept without their query, which may hold a token."


def stored_log(text: str, named: str | Path, name: str, again: str) -> Path:
    """Return the log at a path or URL of a record. `named` is what the user named of it: the folder or map that has the
    record, or the log itself.

    Raises LogError, which begins with `name` and ends with how to give the log `again`, if it is gone, if it cannot be
    opened, as a signed link without its signature, or if it is a URL on another server than `named`.
    """
    path = located(text)
    try:
        if is_elsewhere(text, named):
            why = UNNAMED
        elif path.exists():
            return path
        else:
            why = "no longer exists"
    except OSError as error:
        why = f"cannot be opened ({reason(error)})"
    no_query = _NO_QUERY if text.startswith("http") else ""
    raise LogError(f"{name} {path} {why}.{no_query} {again}")


def reopened(
    folder: Path,
    record: dict[str, Any],
    log: Path | None,
    topics: logs.TopicChoice | None,
    again: str = "Say where it is: --log LOG.",
) -> Log:
    """Return the log of the run in `folder` by its run.json, or the log given in its place. Raises LogError, with
    `again` as the remedy, or ResultError if run.json names none."""
    if log is None and not isinstance(record.get("log"), str):
        raise ResultError("The run's run.json lacks log. Run `vplog run` again.")
    parts = record.get("parts") or [record.get("log")]
    known = [log] if log is not None else [stored_log(str(one), folder, "The log of the run", again) for one in parts]
    if log is not None and not log.exists():
        raise LogError(f"There is no log at {log}. {again}")
    return logs.open_drive(known, topics)


def stat_of(files: Sequence[Path]) -> dict[str, Any]:
    """Length of the files of a log, and a sha256 over their paths, lengths and times: unchanged means the same log."""
    return {"bytes": bytes_of(files), "sha256": key_of(stat_signature(files))}


def library_of(library: Path | None) -> str:
    """Field `library.from` of run.json."""
    return OWN_LIBRARY if library is None else str(original(library).resolve())


def logs_of(drives: Sequence[Path]) -> dict[str, Any]:
    """Fields of run.json about the logs of several drives."""
    return {"logs": [str(path.resolve()) for path in drives], "log_stat": stat_of(drives)}


@contextmanager
def library_at(folder: Path, record: dict[str, Any]) -> Iterator[Path]:
    """The library of a run by its run.json: in its folder if it has the run's hash, else where it is from. Raises
    LogError, LibraryError."""
    library, about = folder / "library", record.get("library")
    origin, digest = (about.get("from"), about.get("hash")) if isinstance(about, dict) else (None, None)
    there = (library / "library.json").is_file()
    if isinstance(origin, str) and origin != OWN_LIBRARY and not (there and _library_hash(library) == digest):
        if is_elsewhere(origin, folder):
            raise LibraryError(f"The library of the run {origin} {UNNAMED}. Copy the library to {library}.")
        library = located(origin)
    elif not there:
        raise LibraryError(f"{folder} has lost its library. Run `vplog run` again.")
    with local_copy(library) as here:
        yield here


def _library_hash(folder: Path) -> str | None:
    """Return the hash of a library; None if its record is damaged. One of a run before may be in a run folder."""
    from vplog.places.library_files import read_library_record  # OpenCV loads here

    with suppress(LibraryError):
        return read_library_record(folder)["hash"]
    return None


def head(
    pipeline: Settings, path: Path | Sequence[Path], threads: int, topics: logs.TopicChoice | None = None
) -> dict[str, Any]:
    """Settings, log, topics, versions and threads of a run, as run.json has them."""
    files = [str(file.resolve()) for file in files_of(path)]
    return {
        "format": run_record.FORMAT,
        "vplog": __version__,
        "log": files[0],
        **({"parts": files} if len(files) > 1 else {}),
        "log_stat": stat_of(files_of(path)),
        "threads": threads,
        "settings": pipeline.model_dump(mode="json"),
        "versions": versions(),
        **({} if topics is None else {"topics": topics.model_dump(mode="json")}),
    }


def arguments(
    paths: Sequence[Path], topics: logs.TopicChoice, pipeline: Settings | None = None, library: Path | None = None
) -> list[str]:
    """Arguments of `vplog run` for the parts of this log with these topics, settings and library; without the folder
    for the results and what `--decisions` names."""
    chosen: list[tuple[str, Any]] = [(OPTIONS[name], value) for name, value in topics if name in OPTIONS]
    chosen += [("image-topic", topic) for topic in topics.cameras or ()]
    chosen += [("mask", f"{name}={path}" if name else path) for name, path in topics.masks.items()]
    chosen += [("mask-topic", f"{name}={masks}") for name, masks in topics.mask_topics.items()]
    chosen += [("library", None if library is None else library_of(library))]
    if pipeline is not None:
        default, given = _leaves(_defaults(pipeline)), _leaves(pipeline.model_dump(mode="json"))
        changed = {name: value for name, value in given.items() if value != default.get(name)}
        chosen += [("set", f"{one}={json.dumps(value)}") for one, value in changed.items() if one != "decisions.file"]
    # a URL with its query is shown nowhere
    logs_ = ["LOG" if address(path) != str(path) else str(path) for path in paths]
    named = [(f"--{name}", value) for name, value in chosen if value is not None and value is not False]
    options = [text for name, value in named for text in ([name] if value is True else [name, str(value)])]
    return [*logs_, *(["--one-drive"] if len(paths) > 1 else []), *options]


def _defaults(pipeline: Settings) -> dict[str, Any]:
    """The settings where nothing but the kinds of methods is changed, each kind as it is unchanged."""
    plain = type(pipeline)()
    found = plain.model_dump(mode="json")
    for name, part in pipeline:
        if isinstance(part, Settings) and type(part) is not type(getattr(plain, name)):
            found[name] = {**type(part).model_construct().model_dump(mode="json"), "kind": found[name].get("kind")}
    return found


def _leaves(tree: dict[str, Any], above: str = "") -> dict[str, Any]:
    """Values of settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= _leaves(value, f"{above}{name}.") if isinstance(value, dict) else {f"{above}{name}": value}
    return found


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    packages = ("numpy", "scipy", "opencv-python-headless", "faiss-cpu", "gtsam", "numba", "pyarrow", "mcap", "rosbags")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}
